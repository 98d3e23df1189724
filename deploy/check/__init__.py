"""Bundles, their checks, and the results of checks."""
