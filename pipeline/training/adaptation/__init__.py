"""The readout of a bundle, fitted to one person."""
