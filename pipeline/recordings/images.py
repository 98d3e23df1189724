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
    ``max``       divided by the image's largest magnitude, as a reader of the paper would
    ``sum``       divided by the sum of magnitudes
    ``sqrt-max``  square root of the magnitude, then as ``max``; reduces the effect of very active
                  taxels
    ``sqrt-clip`` square root of the magnitude, divided by the largest one among all taxels but
                  the :data:`IGNORED_SHARE` with the largest, which are clipped at 1 (default).  A
                  hot taxel, which spikes all the time, does not make the others dark
    ``none``      unchanged; counts would spike too often for the chip, except at a low
                  ``deployment.input_rate``
"""

import math
from dataclasses import replace

import numpy as np

from pipeline.recordings.altering import AUGMENTATIONS, move_places
from pipeline.recordings.events import Recordings
from pipeline.recordings.faults import draw_faults
from pipeline.recordings.steps import EventTable
from pipeline.run.settings import Image

# Share of the taxels that are ignored by ``sqrt-clip``, and may be hot; two of 100 taxels.
IGNORED_SHARE = 0.02


# Alterations in space, and their strength on images: whole taxels move, with all of their events.
IN_SPACE = ("turn", "shift", "scale", "shear")
SPACE_STRENGTH = 0.5


def normalise(images: np.ndarray, normalisation: str = "max") -> np.ndarray:
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


def tactile_images(recordings: Recordings, image: Image | None = None) -> np.ndarray:
    """Normalised tactile images, shape (n_samples, rows, columns, channels), float32.

    Parameters
    ----------
    recordings : Recordings
    image : pipeline.run.settings.schema.Image, optional
        Default: the default settings.
    """
    image = image or Image()
    return _as_images(_counts(recordings, image), image)


def _as_images(counts, image):
    """Images of the counts of :meth:`EventTable.sliced_counts`."""
    on, off = counts[..., 0], counts[..., 1]
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
    return normalise(np.moveaxis(images, 1, 3), image.normalisation).astype(np.float32)


def _counts(recordings, image):
    weights = recordings.events.columns if image.aggregation == "columns" else None
    return EventTable.of(recordings).sliced_counts(image.slices, image.duration_ms, weights)


class AlteredImages:
    """Images of training samples whose events are altered anew for each epoch.

    The alterations are those of :mod:`pipeline.recordings.altering`, in space at half the strength:
    the events of a taxel all move to the same place, so that their counts are moved, and of the
    counts a random share is dropped.  Times are not stretched.  The counts of a taxel that is dead
    from some time on are reduced to the share of the recording before it, and the spikes of hot
    taxels are counted.

    Parameters
    ----------
    recordings : Recordings
        The training samples.
    image : pipeline.run.settings.schema.Image
    how : str
        A key of :data:`pipeline.recordings.altering.AUGMENTATIONS`.
    """

    def __init__(self, recordings: Recordings, image: Image, how: str):
        self._counts, self._image = _counts(recordings, image), image
        self._durations_ms = EventTable.of(recordings).duration_ms
        how = AUGMENTATIONS[how]
        in_space = {name: SPACE_STRENGTH * getattr(how, name) for name in IN_SPACE}
        self._how = replace(how, **in_space)

    def __call__(self, rng, indices) -> np.ndarray:
        """Altered images of some samples, shape (n, rows, columns, channels), float32."""
        counts = self._counts[indices]
        kept = np.broadcast_to(
            1 - rng.uniform(0, self._how.drop, len(counts))[:, None, None, None, None], counts.shape
        )
        some = counts > 0
        counts[some] = rng.binomial(counts[some].astype(np.int64), kept[some])
        if self._how.is_spatial:
            counts = self._moved(rng, counts)
        if self._how.hot or self._how.dead:
            self._add_faults(rng, counts, self._durations_ms[indices])
        return _as_images(counts, self._image)

    def _add_faults(self, rng, counts, durations_ms):
        slices, rows, columns = counts.shape[1:4]
        faults = draw_faults(self._how.hot, self._how.dead, rng, durations_ms, (rows, columns))
        share = faults.silent_from_ms / np.maximum(durations_ms, 1)[:, None, None]
        counts *= np.minimum(share, 1)[:, None, :, :, None]
        hot = faults.hot_events()
        part = (hot.time_ms * slices / self._image.duration_ms).astype(np.int64)
        where = hot.sample, np.minimum(part, slices - 1), hot.row, hot.column, hot.polarity
        np.add.at(counts, where, 1)

    def _moved(self, rng, counts):
        n, slices, rows, columns, _ = counts.shape
        places = np.indices((rows, columns)).reshape(2, -1).T
        sample = np.repeat(np.arange(n), len(places))
        to = move_places(self._how, rng, n, sample, np.tile(places, (n, 1)), (rows, columns))
        inside = ((to >= 0) & (to < (rows, columns))).all(1)
        cell = ((sample * rows + to[:, 0]) * columns + to[:, 1])[inside]
        values = np.moveaxis(counts, 1, 3).reshape(len(sample), -1)[inside]
        summed = np.stack(
            [np.bincount(cell, part, minlength=n * rows * columns) for part in values.T], axis=-1
        )
        return np.moveaxis(summed.reshape(n, rows, columns, slices, 2), 3, 1)
