"""NIR graphs: read, simulated, and turned into layers for the chip."""
