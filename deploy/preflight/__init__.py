"""Before a board: what the network takes of it."""
