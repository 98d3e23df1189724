"""Arrays of counts in bins: the time of a bin, and the channel of rising pressure."""

from collections import Counter
from dataclasses import replace

import numpy as np

from deploy.errors import UserError
from pipeline.recordings.events import Events
from pipeline.recordings.formats.recording import MAX_DURATION_S, EventRecording
from pipeline.recordings.interpretation.interpretation import Interpretation
from pipeline.recordings.interpretation.options import AUTOMATIC_RISE, ReadingOptions
from pipeline.recordings.sensor import GRID, N_TAXELS


def find_other_shapes(recordings) -> dict:
    """Arrays of counts with other numbers of channels or bins than most, with the reason."""
    most_frequent = Counter(recording.bins for recording in recordings).most_common(1)[0][0]
    return {
        index: "has {} channels and {} bins, most others have {} and {}".format(
            *recording.bins, *most_frequent
        )
        for index, recording in enumerate(recordings)
        if recording.bins != most_frequent
    }


def add_events(path, interpretation: Interpretation, recordings, options) -> Interpretation:
    """An interpretation with the events of arrays of counts, after choosing the channel.

    Parameters
    ----------
    path : path-like
        Path of the source, for messages.
    interpretation : Interpretation
        Has the taxels, and no events.
    recordings : list of EventRecording
        Those that are kept.
    options : ReadingOptions

    Raises
    ------
    UserError
        The recordings would last too long, or have no such channel.
    """
    channels, n_bins = recordings[0].bins
    duration_s = n_bins * options.bin_ms / 1000
    if duration_s > MAX_DURATION_S:
        raise UserError(
            f"{path}: {n_bins} bins of {options.bin_ms:g} ms last {duration_s:.4g} s, more than "
            f"{MAX_DURATION_S:g} s; give the width of a bin in milliseconds: --set data.bin=..."
        )
    is_grid = (
        interpretation.rows == interpretation.columns == GRID
        and len(interpretation.taxels) == N_TAXELS
    )
    rise = choose_rise(path, channels, is_grid, options)
    remark = f"{n_bins} bins, read as {options.bin_ms:g} ms each (data.bin)"
    if channels == 2:
        remark += f"; channel {rise} is read as the rise of pressure (data.rise)"
    if is_grid:
        remark += (
            "; the bins of ST-MNIST-SPLIT are hundredths of each recording's columns, so they keep "
            "the order of the events and not their time"
        )
    return replace(
        interpretation,
        events=[make_events(recording, rise, options.bin_ms) for recording in recordings],
        duration_s=duration_s,
        bin_ms=options.bin_ms,
        rise=rise,
        remarks=(remark,),
    )


def choose_rise(path, n_channels: int, is_grid: bool, options: ReadingOptions) -> int:
    """The channel of rising pressure in arrays of counts: the user's, or 1 on ST-MNIST's grid.

    Raises
    ------
    UserError
        The user's is not a channel of the arrays.
    """
    if options.rise == AUTOMATIC_RISE:
        return 1 if is_grid and n_channels == 2 else 0
    if options.rise >= n_channels:
        raise UserError(
            f"{path}: data.rise is {options.rise}, and the arrays have one channel; use --set "
            "data.rise=0"
        )
    return options.rise


def make_events(recording: EventRecording, rise: int, bin_ms: float) -> Events:
    """The events of an array of counts.

    Parameters
    ----------
    recording : EventRecording
        From :func:`pipeline.recordings.formats.bins.make_binned_recording`.
    rise : int
        Channel of rising pressure.
    bin_ms : float
        Width of a bin.
    """
    sign = 1 if rise == 0 else -1
    time_ns = np.rint(recording.time * bin_ms * 1e6).astype(np.int64)
    return replace(recording, polarity=sign * recording.polarity).to_events(1, time_ns)
