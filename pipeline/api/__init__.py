"""Runs and their results from Python, for scripts and notebooks; public names are in `stmnist`."""
