"""Tests of the projects that ours stands on, run through ours: ``make test-peers``."""
