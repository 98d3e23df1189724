"""Networks on tactile images: the CNN of the paper, or a Keras model of the user."""
