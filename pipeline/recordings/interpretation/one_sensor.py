"""Find recordings with coordinates that cannot be of the same sensor as the others."""

from collections import Counter

import numpy as np

from deploy.errors import UserError
from pipeline.recordings.interpretation.interpretation import GIVE_SIZE, refuse_two_sensors

# Number of rows and columns from which the extents of the events of train and test identify a
# sensor, and the factor between both extents above which the sensors differ.
MIN_SENSOR_SIDE = 6
MAX_SIZE_FACTOR = 2

# Factor between the extents of train and test above which the user is told.
MAX_EXTENT_FACTOR = 1.25


def find_other_sensors(path, recordings, parts, options) -> tuple:
    """Find recordings that cannot be from the same sensor as the others.

    Parameters
    ----------
    path : path-like
        Path of the source, for messages.
    recordings : list of EventRecording
    parts : list of str
        Part of the published split of each, or empty.
    options : ReadingOptions

    Returns
    -------
    refused : dict of int to str
        Index of each such recording, and the reason.
    remarks : tuple of str
        What the user should know about the parts of a published split.

    Raises
    ------
    UserError
        Most recordings, or the parts of a published split, are of another sensor.
    """
    extents = _measure_extents(recordings)
    refused = _find_outside(path, recordings, extents, options)
    sizes = Counter(recording.size for recording in recordings if recording.size)
    remarks = _compare_parts(path, recordings, extents, parts, options)
    if len(sizes) > 1:
        most_frequent = sizes.most_common(1)[0][0]
        for index, recording in enumerate(recordings):
            if recording.size and recording.size != most_frequent:
                texts = ("x".join(map(str, size)) for size in (recording.size, most_frequent))
                refused.setdefault(
                    index, "is of a sensor of {}, most others are of {}".format(*texts)
                )
    for index in _find_zero_polarities(recordings):
        refused.setdefault(
            index,
            "has the polarity 0 in all events, and other files have -1 (OFF) and 1 (ON); write one "
            "of these",
        )
    return refused, remarks


def _find_zero_polarities(recordings):
    """Indices of recordings whose polarity is always 0, if others have -1 for OFF."""
    if not any(recording.off == -1 for recording in recordings):
        return []
    return [
        index
        for index, recording in enumerate(recordings)
        if recording.off == 0 and (recording.polarity < 0).all()
    ]


def find_unknown_taxels(path, recordings, lookup) -> dict:
    """Recordings that have taxels that the look-up table does not have, each with the reason.

    Parameters
    ----------
    path : path-like
        Path of the source, for messages.
    recordings : list of EventRecording
        Their taxels are numbered by x.
    lookup : TaxelMap

    Raises
    ------
    UserError
        The recordings are of a sensor with several rows.
    """
    extents = _measure_extents(recordings)
    if extents[:, 0].max() > 1:
        raise UserError(
            f"{path}: LUT.mat is for sensors whose taxels are numbered by x, in one row; these "
            f"recordings have {extents[:, 0].max()} rows: remove LUT.mat"
        )
    return {
        int(index): f"has taxel {extents[index, 1] - 1}, LUT.mat has those from 0 to "
        f"{len(lookup) - 1}"
        for index in np.flatnonzero(extents[:, 1] > len(lookup))
    }


def _measure_extents(recordings):
    """Rows and columns in which the events of each recording lie, shape (recordings, 2)."""
    return np.array(
        [(int(recording.y.max()) + 1, int(recording.x.max()) + 1) for recording in recordings]
    )


def _find_outside(path, recordings, extents, options):
    """Recordings with events outside the rows and columns that the user states."""
    limits = np.array([options.rows or np.inf, options.columns or np.inf])
    outside = (extents > limits).any(axis=1)
    if 2 * outside.sum() >= len(recordings):
        sizes = Counter(r.size for r in recordings if r.size)
        size = sizes.most_common(1)[0][0] if sizes else extents.max(axis=0)
        raise UserError(
            f"{path}: recordings of a sensor of {size[0]} rows x {size[1]} columns, larger than "
            f"the required size ({_describe_stated_size(options)}); give recordings of a sensor of "
            "that size"
        )
    reasons = {}
    for index in np.flatnonzero(outside).tolist():
        recording = recordings[index]
        first = int(np.argmax((recording.y >= limits[0]) | (recording.x >= limits[1])))
        reasons[index] = (
            f"has an event at x = {recording.x[first]}, y = {recording.y[first]}, outside the "
            f"sensor ({_describe_stated_size(options)}; x and y count from 0)"
        )
    return reasons


def _describe_stated_size(options):
    """The rows and columns that the user states."""
    sizes = {"skin.rows": options.rows, "skin.columns": options.columns}
    return " and ".join(f"{name}={size}" for name, size in sizes.items() if size)


def _compare_parts(path, recordings, extents, parts, options):
    """Compare the sensors of train and test; remarks if the events of one reach less far.

    The size of the sensor is that of all recordings together, or the one that the user states: a
    small test set may have no events at the edge.  Files that state different sizes, and extents of
    which one is a multiple of the other in both directions, are of different sensors.
    """
    stated_sizes = {}
    part_extents = {}
    for part in sorted(set(parts)):
        is_in_part = np.array([each == part for each in parts])
        sizes = [recordings[index].size for index in np.flatnonzero(is_in_part)]
        stated = Counter(size for size in sizes if size is not None)
        stated_sizes[part] = stated.most_common(1)[0][0] if stated else None
        part_extents[part] = extents[is_in_part].max(axis=0)
    if None not in stated_sizes.values() and len(set(stated_sizes.values())) > 1:
        refuse_two_sensors(path, _describe_sizes(stated_sizes))
    texts = _describe_sizes(part_extents)
    smallest = np.min(list(part_extents.values()), axis=0)
    largest = np.max(list(part_extents.values()), axis=0)
    has_side = largest > 1  # a sensor in one row has one extent
    is_multiple = (largest > MAX_SIZE_FACTOR * smallest)[has_side].all() and has_side.any()
    is_large = (smallest >= MIN_SENSOR_SIDE)[has_side].all()
    if is_multiple and is_large and not (options.rows or options.columns):
        refuse_two_sensors(path, texts, f", or give the size if it is one sensor: {GIVE_SIZE}")
    if (largest > MAX_EXTENT_FACTOR * smallest).any():
        listed = ", ".join(f"those of {part} in {text}" for part, text in texts.items())
        size = f"{options.rows or largest[0]} x {options.columns or largest[1]} taxels"
        return (f"the events lie in different places: {listed}; the sensor is read as {size}",)
    return ()


def _describe_sizes(sizes):
    """Rows and columns of each part, in words."""
    return {part: f"{rows} x {columns} taxels" for part, (rows, columns) in sizes.items()}
