"""The simulated recording rig of the paper's Section 2: writers, skin, receptors, ACES."""
