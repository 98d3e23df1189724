"""What depends on the kind of network: on images, on events, or from a NIR graph."""
