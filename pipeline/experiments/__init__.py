"""Experiments over seeds, splits and settings."""
