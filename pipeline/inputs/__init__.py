"""From recordings to what networks are shown: images, event frames, splits."""
