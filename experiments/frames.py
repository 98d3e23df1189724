"""Events in time bins: the input of a network that is trained on events."""

from __future__ import annotations

import numpy as np

from pipeline.data.events import Recordings


def bin_events(recordings: Recordings, bins: int = 200) -> np.ndarray:
    """Frames that mark the events of each polarity in each bin (paper, Section 3.2.3).

    The bins divide a recording's duration evenly: of two seconds, 200 bins are 10 ms each.
    Several events of one taxel and polarity in one bin count as one spike.  The result is therefore
    the same whether or not the decoder's repeated columns were merged before.  Events
    after the duration are left out.

    Parameters
    ----------
    recordings : Recordings
    bins : int

    Returns
    -------
    ndarray of uint8, shape (n_samples, bins, rows, columns, 2)
        1 or 0 for each sample, bin, row and column of the tactile image, and polarity: first ON,
        then OFF, which is empty for a sensor that has only ON events.
    """
    events, taxels, sensor = recordings.events, recordings.taxels, recordings.sensor
    shape = (len(recordings), bins, sensor.rows, sensor.columns, 2)
    frames = np.zeros(shape, np.uint8)
    time = _bin_of_event(recordings, bins)
    inside = (time >= 0) & (time < bins)
    taxel = events.taxel[inside]
    frames[
        recordings.sample_of_event[inside],
        time[inside],
        taxels.row[taxel],
        taxels.column[taxel],
        (events.polarity[inside] < 0).astype(np.int64),
    ] = 1
    return frames


def _bin_of_event(recordings, bins):
    duration_ns = recordings.sensor.duration_s * 1e9
    return (recordings.events.time_ns * bins / duration_ns).astype(np.int64)
