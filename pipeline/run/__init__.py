"""A run: its folder, its stages, the bundle, and what each stage answers."""
