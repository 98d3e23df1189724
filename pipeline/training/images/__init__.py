"""Training of networks on images: the paper's CNN, and the same network with rate-LIF neurons."""
