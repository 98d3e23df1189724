"""Tactile images: events aggregated over a recording, one pixel per taxel (paper, Section 3.2.1).

The paper leaves open what "aggregating the FA responses" and "normalized" mean.  Both are settings:

aggregation
    ``count``    physical events of either polarity (default)
    ``columns``  columns of the file, as the paper's Table 1 counts; weights ON by about 1.8
    ``signed``   ON minus OFF events
    ``on``, ``off``  events of one polarity
normalisation
    ``max``      divided by the image's largest magnitude (default)
    ``sum``      divided by the sum of magnitudes
    ``sqrt-max`` square root of the magnitude, then as ``max``; reduces the effect of very active
                 taxels
    ``none``     unchanged; counts would spike too often for the chip, except at a low
                 ``deployment.input_rate``
"""

from __future__ import annotations

import numpy as np

from pipeline.data.events import Events, Recordings, Sensor, TaxelMap, collect
from pipeline.data.steps import EventTable
from pipeline.settings import AGGREGATIONS, NORMALISATIONS


def aggregate(recordings: Recordings, aggregation: str = "count") -> np.ndarray:
    """Aggregate each recording's events by taxel.

    Parameters
    ----------
    recordings : Recordings
    aggregation : str
        See the module's description.

    Returns
    -------
    ndarray of float, shape (n_samples, rows, columns)
        Indexed [sample, row, column], rows from the top and columns from the left.  Places
        without a taxel are 0.

    Raises
    ------
    ValueError
        Unknown aggregation.
    """
    events = recordings.events
    if aggregation == "count":
        weights = np.ones(len(events))
    elif aggregation == "columns":
        weights = events.columns.astype(float)
    elif aggregation == "signed":
        weights = events.polarity.astype(float)
    elif aggregation in ("on", "off"):
        weights = (events.polarity == (1 if aggregation == "on" else -1)).astype(float)
    else:
        raise ValueError(f"aggregation {aggregation!r} is not one of {', '.join(AGGREGATIONS)}")
    taxels, sensor = recordings.taxels, recordings.sensor
    cell = recordings.sample_of_event * len(taxels) + events.taxel
    total = np.bincount(cell, weights, minlength=len(recordings) * len(taxels))
    images = np.zeros((len(recordings), sensor.rows, sensor.columns))
    images[:, taxels.row, taxels.column] = total.reshape(-1, len(taxels))
    return images


def normalise(images: np.ndarray, normalisation: str = "max") -> np.ndarray:
    """Normalise each image separately.

    Parameters
    ----------
    images : ndarray, shape (n_samples, rows, columns)
    normalisation : str
        See the module's description.

    Returns
    -------
    ndarray of float, same shape
        An image without events stays zero.

    Raises
    ------
    ValueError
        Unknown normalisation.
    """
    if normalisation not in NORMALISATIONS:
        raise ValueError(
            f"normalisation {normalisation!r} is not one of {', '.join(NORMALISATIONS)}"
        )
    if normalisation == "none":
        return images.astype(float)
    if normalisation == "sqrt-max":
        images = np.sign(images) * np.sqrt(np.abs(images))
    reduce = np.sum if normalisation == "sum" else np.max
    scale = reduce(np.abs(images), axis=(1, 2), keepdims=True)
    return images / np.where(scale > 0, scale, 1.0)


def tactile_images(recordings, aggregation="count", normalisation="max") -> np.ndarray:
    """Normalised tactile images, shape (n_samples, rows, columns, 1), float32."""
    images = normalise(aggregate(recordings, aggregation), normalisation)
    return images[..., None].astype(np.float32)


def growing(
    events: Events,
    taxels: TaxelMap,
    ends,
    aggregation: str = "count",
    sensor: Sensor | None = None,
) -> np.ndarray:
    """A recording's tactile image as it grows, not normalised.

    Parameters
    ----------
    events : Events
        Events of one recording.
    taxels : TaxelMap
    ends : sequence of int
        End times in nanoseconds; an image has the events before its end.
    aggregation : str
        See the module's description.
    sensor : Sensor, optional

    Returns
    -------
    ndarray of float, shape (n_ends, rows, columns)
    """
    parts = [
        Events(*(getattr(events, name)[events.time_ns < end] for name in vars(events)))
        for end in ends
    ]
    n = len(parts)
    grown = collect(parts, [0] * n, ["part"] * n, [-1] * n, None, taxels, sensor)
    return aggregate(grown, aggregation)


def sliced_counts(recordings: Recordings, slices: int, duration_ms: float) -> np.ndarray:
    """Count the events of each taxel and polarity in equal slices of time.

    Parameters
    ----------
    recordings : Recordings
    slices : int
    duration_ms : float
        Time from a recording's first event that is divided into slices.  Later events are counted
        in the last one.

    Returns
    -------
    ndarray of float32, shape (n_samples, slices, rows, columns, 2)
        First ON, then OFF.
    """
    table = EventTable.of(recordings)
    sample = np.repeat(np.arange(len(table)), np.diff(table.offsets))
    part = np.minimum((table.time_ms * np.float32(slices / duration_ms)).astype(int), slices - 1)
    shape = (len(table), slices, *table.size, 2)
    cell = np.ravel_multi_index((sample, part, table.row, table.column, table.polarity), shape)
    return np.bincount(cell, minlength=np.prod(shape)).astype(np.float32).reshape(shape)


def typical_duration_ms(recordings: Recordings) -> float:
    """The time that nine recordings in ten do not exceed, in ms; at least 1."""
    durations = EventTable.of(recordings).duration_ms
    return max(float(np.quantile(durations, 0.9)), 1.0) if len(durations) else 1.0
