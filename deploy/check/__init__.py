"""The check: bundle, results, and what they say."""
