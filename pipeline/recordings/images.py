"""Tactile images: events aggregated over a recording, one pixel per taxel (paper, Section 3.2.1).

The paper leaves open what "aggregating the FA responses" and "normalized" mean.  Both are settings:

aggregation
    ``count``    physical events of either polarity (default)
    ``columns``  columns of the file, as the paper's Table 1 counts; weights ON by about 1.8
    ``signed``   ON minus OFF events
    ``on``, ``off``  events of one polarity
    ``polarities``  ON and OFF events as two channels
slices
    number of equal slices of time, each with channels of its own: with 4 slices and two polarities
    an image has 8 channels.  It is still presented as one image, all channels at once.
normalisation
    ``max``       divided by the image's largest magnitude (default)
    ``sum``       divided by the sum of magnitudes
    ``sqrt-max``  square root of the magnitude, then as ``max``; reduces the effect of very active
                  taxels
    ``sqrt-clip`` square root of the magnitude, divided by the largest one among all taxels but
                  the :data:`IGNORED_SHARE` with the largest, which are clipped at 1; chosen for
                  networks that are trained here.  A hot taxel, which spikes all the time, does not
                  make the others dark
    ``none``      unchanged; counts would spike too often for the chip, except at a low
                  ``deployment.input_rate``
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.recordings.augmentation import AUGMENTATIONS, move_places
from pipeline.recordings.cache import make_empty_array
from pipeline.recordings.faulty_taxels import draw_faults
from pipeline.recordings.recordings import Recordings
from pipeline.settings import Image

# Share of the taxels that are ignored by ``sqrt-clip``, and may be hot; two of 100 taxels.
IGNORED_SHARE = 0.02

# Samples that are altered at once, so that their images fit into the processor's cache.
ALTERED_AT_ONCE = 256


def normalise_images(images: np.ndarray, normalisation: str = "max") -> np.ndarray:
    """Normalise each image separately.

    Parameters
    ----------
    images : ndarray, shape (n_samples, rows, columns) or (n_samples, rows, columns, channels)
    normalisation : str
        See the module's description.

    Returns
    -------
    ndarray of float, same shape
        An image without events stays zero.
    """
    if normalisation == "none":
        return images.astype(float)
    if normalisation.startswith("sqrt"):
        images = np.sign(images) * np.sqrt(np.abs(images))
    scale = _find_scales(np.abs(images), normalisation)
    scale = scale.reshape(-1, *[1] * (images.ndim - 1))
    images = images / np.where(scale > 0, scale, 1.0)
    return np.clip(images, -1.0, 1.0) if normalisation == "sqrt-clip" else images


def _find_scales(magnitudes, normalisation):
    """The divisor of each image, shape (n_samples,)."""
    if normalisation == "sum":
        return magnitudes.reshape(len(magnitudes), -1).sum(1)
    of_taxels = magnitudes.reshape(len(magnitudes), math.prod(magnitudes.shape[1:3]), -1).max(2)
    if normalisation != "sqrt-clip":
        return of_taxels.max(1)
    ignored = round(IGNORED_SHARE * of_taxels.shape[1])
    scales = np.partition(of_taxels, -1 - ignored, axis=1)[:, -1 - ignored]
    # Where only the ignored taxels have events they are all that the image shows.
    return np.where(scales > 0, scales, of_taxels.max(1))


def make_tactile_images(recordings: Recordings, image: Image | None = None) -> np.ndarray:
    """Normalised tactile images, shape (n_samples, rows, columns, channels), float32.

    Parameters
    ----------
    recordings : Recordings
    image : pipeline.settings.groups.Image, optional
        Default: the default settings.
    """
    return make_images_of(recordings, image or Image(), np.arange(len(recordings)))


def make_images_of(recordings: Recordings, image: Image, indices) -> np.ndarray:
    """As :func:`make_tactile_images`, for some recordings.

    Parameters
    ----------
    recordings : Recordings
    image : pipeline.settings.groups.Image
    indices : array_like of int
    """
    sensor = recordings.sensor
    shape = (len(indices), sensor.rows, sensor.columns, image.channels)
    images = make_empty_array(shape, np.float32)
    for span, counts in _count_batches(recordings, image, indices):
        images[span] = _make_images(counts, image)
    return images


def _make_images(counts, image):
    """Images of the counts of :meth:`EventTable.count_in_slices`."""
    on = counts[..., 0]
    off = counts[..., 1]
    channels = {
        "count": [on + off],
        "columns": [on + off],  # these counts are of columns already
        "signed": [on - off],
        "on": [on],
        "off": [off],
        "polarities": [on, off],
    }[image.aggregation]
    n, _, rows, columns = on.shape
    images = np.stack(channels, axis=2).reshape(n, -1, rows, columns)
    return normalise_images(np.moveaxis(images, 1, 3), image.normalisation).astype(np.float32)


def _count_batches(recordings, image, indices=None):
    """Counts of all or some recordings, a few recordings at a time; see `EventTable.batches`."""
    table = recordings.table
    indices = np.arange(len(table)) if indices is None else np.asarray(indices)
    for span, events in table.select_in_batches(indices):
        batch = indices[span]
        weights = None
        if image.aggregation == "columns":
            weights = recordings.events.columns[table.find_events(batch)[1]]
        yield span, table.count(events, len(batch), image.slices, image.duration_ms, weights)


class TaxelCounts(NamedTuple):
    """The counts above 0 of some samples, one row for each: an altered image is made of these.

    Attributes
    ----------
    sample, time_slice, row, column, polarity : ndarray of int, shape (n_counts,)
        Sample, slice of time, place, and 0 for ON or 1 for OFF.
    value : ndarray, shape (n_counts,)
        The count.
    """

    sample: np.ndarray
    time_slice: np.ndarray
    row: np.ndarray
    column: np.ndarray
    polarity: np.ndarray
    value: np.ndarray

    def select(self, chosen) -> TaxelCounts:
        """Some of the rows."""
        return TaxelCounts(*(values[chosen] for values in self))

    def join(self, others: TaxelCounts) -> TaxelCounts:
        """These rows and others."""
        return TaxelCounts(*map(np.concatenate, zip(self, others, strict=True)))


class StoredCounts:
    """The counts above 0 of all samples, of 8 bytes each.

    Parameters
    ----------
    shape : tuple of int
        (slices, rows, columns, 2), of the counts of a sample.
    batches : iterable of ndarray
        Counts of one sample after the other, in the order of the samples.
    """

    def __init__(self, shape: tuple, batches):
        self.shape = shape
        cells = []
        values = []
        numbers = [np.zeros(1, int)]
        for counts in batches:
            flat = counts.reshape(len(counts), -1)
            sample, cell = np.nonzero(flat)
            cells.append(cell.astype(np.int32))
            values.append(flat[sample, cell].astype(np.int32))
            numbers.append(np.bincount(sample, minlength=len(counts)))
        self._cell = np.concatenate([np.empty(0, np.int32), *cells])
        self._value = np.concatenate([np.empty(0, np.int32), *values])
        self._offsets = np.cumsum(np.concatenate(numbers))

    def select(self, indices) -> TaxelCounts:
        """The counts of some samples, which are numbered from 0 in the order of ``indices``."""
        first = self._offsets[indices]
        number = self._offsets[indices + 1] - first
        sample = np.repeat(np.arange(len(indices)), number)
        begins = np.cumsum(number) - number
        chosen = np.arange(len(sample)) + np.repeat(first - begins, number)
        time_slice, row, column, polarity = np.unravel_index(self._cell[chosen], self.shape)
        value = self._value[chosen].astype(np.int64)
        return TaxelCounts(sample, time_slice, row, column, polarity, value)


class AlteredImages:
    """Images of training samples whose events are altered anew for each epoch.

    The alterations are those of :mod:`pipeline.recordings.augmentation`: the events of a taxel all
    move to the same place, so that their counts are moved, and of the counts a random share is
    dropped.  Times are not stretched.  The counts of a taxel that is dead from some time on are
    reduced to the share of the slice before it, and the spikes of hot taxels are counted.

    Parameters
    ----------
    recordings : Recordings
    image : pipeline.settings.groups.Image
    augmentation : str
        A key of :data:`pipeline.recordings.augmentation.AUGMENTATIONS`.
    samples : ndarray of int, optional
        Indices of the training samples; default: all.
    """

    def __init__(self, recordings: Recordings, image: Image, augmentation: str, samples=None):
        table = recordings.table
        samples = np.arange(len(table)) if samples is None else samples
        shape = (image.slices, *table.size, 2)
        counts = (batch for _, batch in _count_batches(recordings, image, samples))
        self._counts = StoredCounts(shape, counts)
        self._size = table.size
        self._image = image
        self._durations_ms = table.duration_ms[samples]
        self._how = AUGMENTATIONS[augmentation]

    def __call__(self, rng, indices) -> np.ndarray:
        """Altered images of some samples, shape (n, rows, columns, channels), float32."""
        indices = np.asarray(indices)
        batches = np.split(indices, range(ALTERED_AT_ONCE, len(indices), ALTERED_AT_ONCE))
        return np.concatenate([self._alter_batch(rng, batch) for batch in batches])

    def _alter_batch(self, rng, indices):
        augmentation = self._how
        n = len(indices)
        counts = self._counts.select(indices)
        kept_share = 1 - rng.uniform(0, augmentation.drop, n)
        counts = counts._replace(value=rng.binomial(counts.value, kept_share[counts.sample]))
        if augmentation.is_spatial:
            counts = self._move(rng, counts, n)
        if augmentation.hot or augmentation.dead:
            counts = self._add_faults(rng, counts, self._durations_ms[indices])
        shape = n, self._image.slices, *self._size, 2
        cell = np.ravel_multi_index(counts[:-1], shape)
        dense = np.bincount(cell, counts.value, minlength=math.prod(shape))
        return _make_images(dense.reshape(shape).astype(np.float32), self._image)

    def _move(self, rng, counts, n):
        places = np.stack([counts.row, counts.column], -1)
        places = move_places(self._how, rng, n, counts.sample, places, self._size)
        is_inside = ((places >= 0) & (places < self._size)).all(1)
        return counts._replace(row=places[:, 0], column=places[:, 1]).select(is_inside)

    def _add_faults(self, rng, counts, durations_ms):
        faults = draw_faults(self._how.hot, self._how.dead, rng, durations_ms, self._size)
        slice_ms = self._image.duration_ms / self._image.slices
        silent_from_ms = faults.silent_from_ms[counts.sample, counts.row, counts.column]
        before = np.clip(silent_from_ms / slice_ms - counts.time_slice, 0, 1)
        hot = faults.draw_hot_events()
        time_slice = np.minimum((hot.time_ms / slice_ms).astype(np.int64), self._image.slices - 1)
        spikes = TaxelCounts(
            hot.sample, time_slice, hot.row, hot.column, hot.polarity, np.ones(len(time_slice))
        )
        return counts._replace(value=counts.value * before).join(spikes)
