"""Networks that were trained elsewhere and come as a NIR graph."""
