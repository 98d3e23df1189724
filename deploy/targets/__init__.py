"""Targets: simulators and hardware that run a bundle."""
