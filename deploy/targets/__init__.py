"""What can answer a bundle."""
