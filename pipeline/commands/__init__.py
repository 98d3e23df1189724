"""The sub-commands of ``stmnist``, one module per group."""
