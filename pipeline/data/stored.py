"""Validation of stored recordings, as strict as that of imported files."""

from __future__ import annotations

import numpy as np

from pipeline.data.matfile import LATEST_S, MAX_SIDE, MAX_TAXELS


def problem_with(arrays: dict) -> str | None:
    """Find a problem with the arrays of a set of recordings.

    Parameters
    ----------
    arrays : dict of str to ndarray
        As :func:`pipeline.data.cache.store` writes them.

    Returns
    -------
    str or None
        The problem in a few words, or None.

    Raises
    ------
    KeyError
        An array is missing.
    """
    size, classes, ids = arrays["size"], arrays["classes"], arrays["ids"]
    duration_s = arrays["duration_s"]
    if not _are_whole(size, 1, MAX_SIDE) or size.shape != (3,) or size[2] > 2:
        return "a sensor of no size"
    if duration_s.shape != () or duration_s.dtype.kind != "f" or not 0 < duration_s <= LATEST_S:
        return "a duration out of range"
    for name, texts in (("classes", classes), ("ids", ids), ("source", arrays["source"])):
        if texts.dtype.kind != "U" or texts.ndim != 1:
            return f"{name} that are not texts"
    if len(classes) == 0 or len(set(classes.tolist())) != len(classes):
        return "classes of the same name"
    rows, columns, _ = size.tolist()
    n = len(ids)
    places = arrays["row"].shape
    if len(places) != 1 or places != arrays["column"].shape or not 1 <= places[0] <= MAX_TAXELS:
        return "taxels without positions"
    for name, least, most, shape in (
        ("labels", 0, len(classes) - 1, (n,)),
        ("writers", -1, None, (n,)),
        ("offsets", 0, None, (n + 1,)),
        ("row", 0, rows - 1, places),
        ("column", 0, columns - 1, places),
        ("taxel", 0, places[0] - 1, arrays["time_ns"].shape),
        ("polarity", -1, 1, arrays["time_ns"].shape),
        ("columns", 1, None, arrays["time_ns"].shape),
        ("time_ns", 0, LATEST_S * 1e9, arrays["time_ns"].shape),
    ):
        if arrays[name].shape != shape or len(shape) != 1:
            return f"{name} of a wrong length"
        if not _are_whole(arrays[name], least, most):
            return f"{name} out of range"
    if not arrays["polarity"].all():
        return "polarity out of range"
    offsets = arrays["offsets"]
    if offsets[0] != 0 or offsets[-1] != len(arrays["time_ns"]) or (np.diff(offsets) < 0).any():
        return "offsets out of range"
    earlier = np.flatnonzero(np.diff(arrays["time_ns"]) < 0) + 1
    if not np.isin(earlier, offsets).all():
        return "time_ns not in order"
    return None


def _are_whole(array, least, most):
    """True if all are whole numbers from ``least`` to ``most`` (None: no upper limit)."""
    if array.dtype.kind not in "iu":
        return False
    if array.size == 0:
        return True
    return array.min() >= least and (most is None or array.max() <= most)
