"""Avoid the cost of zero-width padding in Nengo's convolutions.

Nengo pads the input of a convolution at each step; without padding NumPy makes a plain copy, but
only after much Python code: three tenths of the reference simulator's time on the paper's network.
"""

from __future__ import annotations

import types

import numpy as np
from nengo.builder import transforms


def pad(array, widths, **more):
    """Replacement for :func:`numpy.pad` that copies directly if all widths are 0.

    The copy is necessary: Nengo takes its windows from the memory of a whole array, not of a view.
    """
    return np.pad(array, widths, **more) if any(map(any, widths)) else array.copy()


def pad_only_where_needed():
    """Give Nengo's convolutions a NumPy in which only `pad` is replaced."""
    if getattr(transforms, "np", None) is np:
        theirs = types.ModuleType("numpy")
        vars(theirs).update(vars(np), pad=pad)
        transforms.np = theirs
