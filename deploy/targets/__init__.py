"""Targets: simulators and hardware that run a bundle; :mod:`.registry` has their list."""
