"""Trainable networks: architectures, the Keras CNN, rate-LIF neurons, SLAYER, events."""
