"""Units of time of recordings, and times in nanoseconds.

Files of events often have times without their unit.  It is inferred from the duration of the
recordings, unless the files or the user state it.
"""

import numpy as np

from deploy.errors import UserError
from pipeline.recordings.formats.recording import MAX_DURATION_S, UNIT_NAMES, UNITS

# Minimum duration of a recording of a gesture or a saccade, in seconds; a unit with which most
# recordings would be shorter is excluded.
MIN_DURATION_S = 0.02

# Factor between durations above which their units differ; units differ by a factor of 1,000.
MIN_UNIT_FACTOR = 100

GIVE_UNIT = "--set data.time_unit=..."


def find_span(time: np.ndarray) -> float:
    """The time from the first event to the last."""
    return float(time[-1] - time[0])


def infer_unit(times) -> str:
    """The unit of recordings, inferred from their duration.

    Times with fractions are seconds if they are as short as recordings are.  Whole numbers are
    taken for the longest unit in which the recordings last at most a minute.

    Parameters
    ----------
    times : sequence of ndarray
        Times of each recording, in order.

    Returns
    -------
    str
        One of :data:`pipeline.recordings.formats.recording.UNITS`, or empty if none fits.
    """
    spans = np.array([find_span(time) for time in times])
    spans = spans[spans > 0]
    if not len(spans):
        return "s" if all(time[-1] <= MAX_DURATION_S for time in times) else ""
    typical = float(np.median(spans))
    whole = all(time.dtype.kind == "i" for time in times)
    for unit, seconds in UNITS.items():
        if unit == "s" and whole:
            continue  # no sensor has times in whole seconds
        if MIN_DURATION_S <= typical * seconds <= MAX_DURATION_S:
            return unit
    return "s" if not whole and typical <= MAX_DURATION_S else ""


def choose_unit(path, recordings, parts, options) -> str:
    """The unit of time: the user's, the files', that of similar recordings, or inferred.

    That of similar recordings holds unless these recordings would last longer than any can.

    Parameters
    ----------
    path : path-like
        Path of the source, for messages.
    recordings : list of EventRecording
    parts : list of str
        Part of the published split of each, or empty.
    options : pipeline.recordings.interpretation.options.ReadingOptions

    Raises
    ------
    UserError
        The unit differs between files or parts, or none fits.
    """
    if options.time_unit:
        return options.time_unit
    stated = {recording.unit for recording in recordings if recording.unit}
    if len(stated) > 1:
        names = [UNIT_NAMES[unit] for unit in UNITS if unit in stated]
        raise UserError(f"{path}: files with times in {' and in '.join(names)}; use one unit")
    if stated:
        return stated.pop()
    spans: dict = {}
    for recording, part in zip(recordings, parts, strict=True):
        spans.setdefault(part, []).append(find_span(recording.time))
    _require_equal_units(path, spans)
    if options.usual_unit:
        usual_s = np.median(np.concatenate(list(spans.values()))) * UNITS[options.usual_unit]
        if usual_s <= MAX_DURATION_S:
            return options.usual_unit
    unit = infer_unit([recording.time for recording in recordings])
    if not unit:
        raise UserError(
            f"{path}: no unit of time fits recordings of up to {MAX_DURATION_S:g} s; give the unit "
            f"({GIVE_UNIT})"
        )
    return unit


def _require_equal_units(path, spans):
    """Refuse a published split one of whose parts lasts a hundred times as long as the other."""
    typical = {part: float(np.median(spans[part])) for part in sorted(spans)}
    if max(typical.values()) > MIN_UNIT_FACTOR * min(typical.values()) > 0:
        listed = ", ".join(
            f"{part} has times of typically {span:.4g}"
            for part, span in sorted(typical.items(), reverse=True)
        )
        raise UserError(
            f"{path}: train and test have different units of time: {listed}; use one unit, or "
            f"give it if it is one ({GIVE_UNIT})"
        )


def find_other_units(times) -> list:
    """Indices of recordings whose times cannot be in the unit of the others.

    Recordings with a single event have no duration, and fit any unit.
    """
    spans = np.array([find_span(time) for time in times])
    with_events = np.flatnonzero(spans > 0)
    if len(with_events) < 2:
        return []
    ratio = spans[with_events] / np.median(spans[with_events])
    return with_events[(ratio > MIN_UNIT_FACTOR) | (ratio < 1 / MIN_UNIT_FACTOR)].tolist()


def are_clock_times(times, unit: str) -> bool:
    """True if the times of recordings are a running clock's, not relative to their start.

    A camera's clock starts when it is switched on, or in 1970.  One recording that starts later
    than the longest one lasts, or that ends later than any can last, shows that the recordings
    were cut from a longer one, also those from its first minute.
    """
    first = max((float(time[0]) for time in times), default=0)
    last = max((float(time[-1]) for time in times), default=0)
    longest = max(map(find_span, times), default=0)
    return last * UNITS[unit] > MAX_DURATION_S or first > longest > 0


def to_ns(time: np.ndarray, unit: str, from_first: bool = False) -> np.ndarray:
    """Times in nanoseconds.

    Parameters
    ----------
    time : ndarray
        Times in increasing order.
    unit : str
    from_first : bool
        True for times relative to the first event.
    """
    if from_first:
        time = time - time[0]
    if time.dtype.kind == "i":
        return time * round(UNITS[unit] * 1e9)
    return np.rint(time * UNITS[unit] * 1e9).astype(np.int64)
