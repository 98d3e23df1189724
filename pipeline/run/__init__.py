"""A run: its folder, its stages, its bundle, and the predictions of each stage."""
