"""Files of events, each with its column x and row y: unit of time, size, and events on taxels."""

from dataclasses import replace

from pipeline.recordings.formats.recording import MAX_DURATION_S, UNIT_NAMES, UNITS
from pipeline.recordings.interpretation import times
from pipeline.recordings.interpretation.interpretation import Interpretation, renumber_doubts
from pipeline.recordings.interpretation.one_sensor import find_other_sensors, find_unknown_taxels
from pipeline.recordings.interpretation.size import SensorSize, measure_size, require_possible
from pipeline.recordings.interpretation.taxel_tables import find_table_size
from pipeline.recordings.sensor import TaxelMap


def interpret_coordinates(path, recordings, parts, lookup, options) -> Interpretation:
    """Interpret recordings whose events have coordinates.

    Parameters
    ----------
    path : path-like
        Path of the source, for messages.
    recordings : list of EventRecording
    parts : list of str
        Part of the published split of each, or empty.
    lookup : TaxelMap or None
        Row and column of each taxel, if ``x`` numbers the taxels.
    options : ReadingOptions

    Raises
    ------
    UserError
        Rows, columns or the unit of time cannot be determined, or differ between train and test.
    """
    recordings = _combine_pixels(recordings, options.downsample)
    unit = times.choose_unit(path, recordings, parts, options)
    if lookup is None:
        refused, remarks = find_other_sensors(path, recordings, parts, options)
    else:
        refused = find_unknown_taxels(path, recordings, lookup)
        remarks = ()
    for index, reason in _find_unfit_durations(recordings, unit).items():
        refused.setdefault(index, reason)
    if lookup is None:
        size, damaged = _measure_size_without_damaged(recordings, refused, options)
        refused |= damaged
        require_possible(path, size, options.downsample)
        taxels = TaxelMap.grid(size.rows, size.columns)
        rows_in_files = size.rows
    else:
        size = SensorSize(*find_table_size(path, lookup, options.rows, options.columns), doubts=())
        taxels = lookup
        rows_in_files = 1
    kept = _list_kept(recordings, refused)
    recordings = [recordings[index] for index in kept]
    if lookup is None:
        remarks = (*remarks, *_doubt_first_places(recordings, options))
    from_first = times.are_clock_times([recording.time for recording in recordings], unit)
    return Interpretation(
        kept,
        [
            recording.to_events(rows_in_files, times.to_ns(recording.time, unit, from_first))
            for recording in recordings
        ],
        refused,
        taxels,
        size.rows,
        size.columns,
        time_unit=unit,
        remarks=remarks,
        doubts=renumber_doubts(size.doubts, kept),
    )


def _doubt_first_places(recordings, options):
    """A line if coordinates may count from 1; those of a sensor of a known size do not."""
    is_known = options.rows or options.columns or options.downsample > 1
    if is_known or not recordings or any(recording.size for recording in recordings):
        return ()
    for places in ([each.x for each in recordings], [each.y for each in recordings]):
        is_line = not any(each.any() for each in places)  # a sensor in one row
        if not is_line and min(each.min() for each in places) != 1:
            return ()
    return ("no event has x = 0 or y = 0; if the files count from 1, subtract 1 from x and y",)


def _combine_pixels(recordings, side):
    """Recordings with the coordinates of squares of pixels, which become taxels."""
    if side == 1:
        return recordings
    return [
        replace(recording, x=recording.x // side, y=recording.y // side) for recording in recordings
    ]


def _list_kept(recordings, refused):
    """Indices of the recordings that are not refused."""
    return [index for index in range(len(recordings)) if index not in refused]


def _measure_size_without_damaged(recordings, refused, options):
    """The size of the sensor, and recordings that alone would make it impossibly large."""
    kept = _list_kept(recordings, refused)
    size = measure_size([recordings[index] for index in kept], options)
    if size.is_possible:
        return size, {}
    damaged = {}
    for indices, text in renumber_doubts(size.doubts, kept):
        damaged.update(dict.fromkeys(indices, f"has {text}"))
    kept = _list_kept(recordings, refused | damaged)
    return measure_size([recordings[index] for index in kept], options), damaged


def _find_unfit_durations(recordings, unit):
    """Recordings whose times are in another unit, or that last too long, each with the reason."""
    reasons = {}
    for index in times.find_other_units([recording.time for recording in recordings]):
        reasons[index] = (
            f"is more than {times.MIN_UNIT_FACTOR} times longer or shorter than most recordings; "
            "if they are in another unit, convert them to that of the others"
        )
    for index, recording in enumerate(recordings):
        seconds = times.find_span(recording.time) * UNITS[unit]
        if seconds > MAX_DURATION_S and index not in reasons:
            reasons[index] = (
                f"lasts {seconds:.4g} s with its times as {UNIT_NAMES[unit]}, more than "
                f"{MAX_DURATION_S:g} s; if they are in another unit, give it ({times.GIVE_UNIT})"
            )
    return reasons
