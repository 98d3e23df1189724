"""The part that runs without TensorFlow: the bundle, its network, and the targets.

This package travels inside a bundle to INRC hosts.  It runs on Python 3.8 and imports numpy,
scipy, nengo, nengo_loihi and the standard library, nothing else.
"""

__version__ = "0.1.0"
