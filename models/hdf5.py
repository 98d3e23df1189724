"""Import h5py with HDF5 plug-ins disabled; no other module imports h5py.

An HDF5 file names the filters that were applied to its data.  HDF5 searches for unknown filters as
plug-ins: shared libraries in a folder set by an environment variable, by default below
``/usr/local``.  This module disables the search (TensorFlow before 2.21 does not: CVE-2026-2492).
HDF5 reads the environment variable once, at its first search.
"""

from __future__ import annotations

import os

# "::" disables plug-ins.  An empty search path instead would mean the current folder.
os.environ["HDF5_PLUGIN_PRELOAD"] = "::"

import h5py

USUAL_FILTERS = frozenset(
    {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
)
"""Filters that MATLAB uses for compression, and the checksum filter."""


def unusual_filters(dataset) -> list:
    """Ids of the filters of a dataset that are not in :data:`USUAL_FILTERS`.

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
