"""h5py, for files from outside: the one module that imports it.

A file names the filters that its data went through, and HDF5 looks for those it does not know as
plug-ins: shared libraries in a folder that an environment variable names, by default one below
``/usr/local``.  It is told to look nowhere (TensorFlow before 2.21 does not tell it:
CVE-2026-2492).  HDF5 asks once, when it first looks for one.
"""

from __future__ import annotations

import os

os.environ["HDF5_PLUGIN_PRELOAD"] = "::"  # none; a path of nothing would be looked for here

import h5py

USUAL_FILTERS = frozenset(
    {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
)
"""What MATLAB compresses with, and a checksum."""


def unusual_filters(dataset) -> list:
    """Numbers of the filters, other than :data:`USUAL_FILTERS`, that reading a dataset would run.

    Parameters
    ----------
    dataset : h5py.Dataset

    Returns
    -------
    list of int
    """
    plan = dataset.id.get_create_plist()
    filters = [plan.get_filter(index)[0] for index in range(plan.get_nfilters())]
    return [number for number in filters if number not in USUAL_FILTERS]


__all__ = ["USUAL_FILTERS", "h5py", "unusual_filters"]
