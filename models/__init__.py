"""What is trained: architectures, the Keras CNN, rate-based LIF activations, SLAYER."""
