"""Nengo's convolutions without a copy of what needs no padding.

At each step Nengo pads what a convolution reads, and where there is nothing to pad NumPy copies it
all the same, in Python: three tenths of the reference simulator's time on the paper's network.
"""

from __future__ import annotations

import types

import numpy as np
from nengo.builder import transforms


def pad(array, widths, **more):
    """As :func:`numpy.pad`, but the array itself where all widths are 0."""
    return np.pad(array, widths, **more) if any(map(any, widths)) else array


def copy_no_unpadded():
    """Give Nengo's convolutions a NumPy of which only `pad` is another."""
    if getattr(transforms, "np", None) is np:
        theirs = types.ModuleType("numpy")
        vars(theirs).update(vars(np), pad=pad)
        transforms.np = theirs
