"""Trainable networks: architectures, the Keras CNN, rate-based LIF neurons, SLAYER, events."""
