"""Training of all networks, and the interface to NengoDL."""
