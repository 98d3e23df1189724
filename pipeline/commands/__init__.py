"""The verbs of the command ``stmnist``, one module a group."""
