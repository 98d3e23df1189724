"""The inputs of networks, made from recordings: images, event frames, splits."""
