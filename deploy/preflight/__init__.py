"""Pre-flight: the resources of the chip that a network needs."""
