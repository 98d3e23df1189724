"""Training of every kind of network, and NengoDL."""
