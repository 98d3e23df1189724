"""What is trained: the paper's notation, the Keras CNN, rate-based LIF activations, SLAYER."""
