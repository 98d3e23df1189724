"""Recordings as counts of events in bins of time: arrays (taxels, channels, bins).

The public repositories ``GuoFM/DeepTactile`` and ``clear-nus/TactileSGNet`` have such arrays, as
``.npy`` files.  A value is the number of events of a taxel and channel in a bin.  The width of a
bin, the channel of rising pressure and the places of the taxels are not in the file.
"""

import numpy as np

from pipeline.recordings.formats.recording import (
    MAX_EVENTS,
    MAX_TAXELS,
    BadRecording,
    EventRecording,
)

# Numbers of channels: one for each polarity, or both together.
CHANNELS = (1, 2)


def make_binned_recording(counts: np.ndarray) -> EventRecording:
    """Turn an array of counts into events.

    The n events of a bin are spread evenly over it: the first is at its beginning, and each of the
    others follows after one n-th of the bin's width.

    Parameters
    ----------
    counts : ndarray, shape (n_taxels, n_channels, n_bins)
        Whole numbers from 0, of any type.

    Returns
    -------
    EventRecording
        ``time`` is in bins.  ``polarity`` is 1 for channel 0 and -1 for channel 1;
        :func:`pipeline.recordings.interpretation.binned_counts.choose_rise` decides which of them
        is the rise of pressure.

    Raises
    ------
    BadRecording
        The array has another shape, other values, no events or too many.
    """
    _require_shape(counts.shape)
    if counts.dtype.kind == "b":
        counts = counts.astype(np.uint8)
    if not np.isfinite(counts).all():
        raise BadRecording("has a value that is NaN or infinite, not a count of events")
    wrong = (counts < 0) | (counts != np.floor(counts))
    if wrong.any():
        raise BadRecording(
            f"has the value {counts[wrong][0]:g}, not counts of events: whole numbers from 0"
        )
    taxel, channel, index = np.nonzero(counts)
    number = counts[taxel, channel, index]
    total = number.sum(dtype=float)
    if total == 0:
        raise BadRecording("is empty: no events")
    if total > MAX_EVENTS:
        raise BadRecording(f"has {total:.0f} events, more than {MAX_EVENTS}")
    number = number.astype(np.int64)
    time = index.astype(np.int64)
    if number.max() > 1:
        first = np.cumsum(number) - number
        within = np.arange(number.sum()) - np.repeat(first, number)
        time = np.repeat(index, number) + within / np.repeat(number, number)
        taxel = np.repeat(taxel, number)
        channel = np.repeat(channel, number)
    order = np.argsort(time, kind="stable")
    return EventRecording(
        x=taxel[order],
        y=np.zeros(len(order), np.int64),
        time=time[order],
        polarity=np.where(channel[order] == 0, 1, -1).astype(np.int8),
        n_taxels=counts.shape[0],
        bins=tuple(counts.shape[1:]),
    )


def _require_shape(shape):
    size = " x ".join(map(str, shape))
    if len(shape) != 3:
        raise BadRecording(
            f"is an array of {len(shape)} dimensions ({size}), not of three (taxels, channels, "
            "bins) or rows of events"
        )
    n_taxels, n_channels, n_bins = shape
    if n_channels not in CHANNELS:
        raise BadRecording(
            f"is an array of {size} with {n_channels} channels, not 1 or 2; the dimensions are "
            "(taxels, channels, bins)"
        )
    if not 1 <= n_taxels <= MAX_TAXELS or n_bins < 1:
        raise BadRecording(f"is an array of {size}, not of 1 to {MAX_TAXELS} taxels and some bins")
