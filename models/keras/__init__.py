"""Keras: the version that NengoDL works with, and models of the user."""
