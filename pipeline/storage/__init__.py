"""What is on disk: artifacts with a record of what they were made from, and a run's folder."""
