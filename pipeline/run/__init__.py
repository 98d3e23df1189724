"""A run: its settings, its folder, and the artifacts in it."""
