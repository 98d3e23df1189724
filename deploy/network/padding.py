"""Nengo's convolutions without the cost of a padding where there is none.

At each step Nengo pads what a convolution reads; where there is nothing to pad, NumPy comes to a
plain copy only after a good deal of Python: three tenths of the reference simulator's time on the
paper's network.
"""

from __future__ import annotations

import types

import numpy as np
from nengo.builder import transforms


def pad(array, widths, **more):
    """As :func:`numpy.pad`; a copy at once where all widths are 0.

    A copy it must be: Nengo takes its windows from the memory of a whole array, not of a view.
    """
    return np.pad(array, widths, **more) if any(map(any, widths)) else array.copy()


def pad_only_where_needed():
    """Give Nengo's convolutions a NumPy of which only `pad` is another."""
    if getattr(transforms, "np", None) is np:
        theirs = types.ModuleType("numpy")
        vars(theirs).update(vars(np), pad=pad)
        transforms.np = theirs
