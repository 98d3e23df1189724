"""What the paper and our documents measure.  It is not installed; ``python -m experiments``."""
