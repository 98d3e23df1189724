"""Checks that new targets and operations must pass; tests of another package can call them."""
