"""Data augmentation: samples altered in time and space, and with events left out."""

from dataclasses import dataclass, replace

import numpy as np

from pipeline.recordings.events import Events, Recordings, is_handwriting


@dataclass(frozen=True)
class Alteration:
    """The parameters of the alterations.

    The times of a sample are multiplied by exp(``stretch`` z), the sample begins at a random time
    within its first step, and each event is dropped with a probability drawn from 0 to ``drop``.
    Positions relative to the middle of the skin are sheared by ``shear`` z, rotated by ``turn`` z
    radians, scaled by exp(``scale`` z) along rows and along columns, and shifted by ``shift`` z
    taxels in both directions.  Each z is standard normal and drawn for each sample.  An event is
    assigned to the nearest taxel; events beyond the edge are lost.
    """

    stretch: float = 0.1
    drop: float = 0.2
    turn: float = 0.08
    shift: float = 0.4
    scale: float = 0.08
    shear: float = 0.08


# Alterations in time and dropped events, for sensors on which a position may have a meaning of its
# own or neighbours in the grid are not neighbours on the sensor.
TIME_ONLY = Alteration(turn=0.0, shift=0.0, scale=0.0, shear=0.0)

# The alterations of each value of ``events.augment`` but ``auto``.
AUGMENTATIONS = {
    "none": Alteration(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "time": TIME_ONLY,
    "space": Alteration(),
}


def augmentation_for(recordings: Recordings) -> str:
    """The augmentation that suits recordings: ``space`` for handwriting, otherwise ``time``."""
    return "space" if is_handwriting(recordings) else "time"


def alter(how: Alteration, rng, samples: int, sample, step, row, column, polarity, size=(10, 10)):
    """Alter samples.

    Parameters
    ----------
    how : Alteration
    rng : numpy.random.Generator
    samples : int
    sample, row, column, polarity : ndarray
        See :meth:`pipeline.recordings.steps.EventTable.pick`.
    step : ndarray of float
        Time of each event in steps from its sample's first event on.
    size : (int, int)
        Rows and columns of taxels.

    Returns
    -------
    sample, step, row, column, polarity : ndarray
        Properties of the remaining events; steps are fractions.
    """
    kept, step, place = _altered(how, rng, samples, sample, step, row, column, size)
    return sample[kept], step[kept], place[kept, 0], place[kept, 1], polarity[kept]


def altered_recordings(
    recordings: Recordings, indices, how: Alteration, step_ms: float, seed
) -> Recordings:
    """Altered copies of some recordings.

    Parameters
    ----------
    recordings : Recordings
    indices : sequence of int
        Indices of recordings; one that occurs several times is altered differently each time.
    how : Alteration
    step_ms : float
        The step within which a sample begins at a random time.
    seed : int or sequence of int

    Returns
    -------
    Recordings
        In the order of the indices.
    """
    chosen, rng = recordings.part(indices), np.random.default_rng(seed)
    taxels, sensor, old, sample = (
        chosen.taxels, chosen.sensor, chosen.events, chosen.sample_of_event
    )  # fmt: skip
    some = np.diff(chosen.offsets) > 0
    begins = np.zeros(len(chosen), np.int64)
    begins[some] = old.time_ns[chosen.offsets[:-1][some]]
    step = (old.time_ns - begins[sample]) / (1e6 * step_ms)
    size = (sensor.rows, sensor.columns)
    kept, step, place = _altered(
        how, rng, len(chosen), sample, step, taxels.row[old.taxel], taxels.column[old.taxel], size
    )
    at = np.full(size, -1)  # which taxel is where; there may be places without one
    at[taxels.row, taxels.column] = np.arange(len(taxels))
    taxel = np.full(len(kept), -1)
    taxel[kept] = at[tuple(place[kept].T)]
    kept &= taxel >= 0
    time_ns = begins[sample] + np.rint(1e6 * step_ms * step).astype(np.int64)
    order = np.flatnonzero(kept)
    order = order[np.lexsort((time_ns[order], sample[order]))]
    counts = np.bincount(sample[order], minlength=len(chosen))
    return replace(
        chosen,
        events=Events(time_ns[order], taxel[order], old.polarity[order], old.columns[order]),
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        ids=tuple(f"{name}+{number}" for number, name in enumerate(chosen.ids)),
    )


def _altered(how, rng, samples, sample, step, row, column, size):
    """The remaining events, with the step and the (row, column), in whole taxels, of each."""
    pace = np.exp(rng.normal(0, how.stretch, samples))
    step = step * pace[sample] + rng.uniform(0, 1, samples)[sample]
    kept = rng.random(len(sample)) >= rng.uniform(0, how.drop, samples)[sample]
    place = moved(how, rng, samples, sample, np.stack([row, column], -1), size)
    return kept & ((place >= 0) & (place < size)).all(1), step, place


def moved(how: Alteration, rng, samples: int, sample, place, size) -> np.ndarray:
    """The places of events after the change of their sample in space.

    Parameters
    ----------
    how : Alteration
    rng : numpy.random.Generator
    samples : int
    sample : ndarray of int, shape (n_events,)
        Sample of each event.
    place : ndarray, shape (n_events, 2)
        Row and column of each event.
    size : (int, int)

    Returns
    -------
    ndarray of int, shape (n_events, 2)
        In whole taxels; places outside of ``size`` are beyond the edge.
    """
    angle = rng.normal(0, how.turn, samples)
    cosine, sine = np.cos(angle), np.sin(angle)
    turned = np.moveaxis(np.array([[cosine, -sine], [sine, cosine]]), 2, 0)
    slanted = np.tile(np.eye(2), (samples, 1, 1))
    slanted[:, 1, 0] = rng.normal(0, how.shear, samples)  # columns move with the row
    stretched = np.exp(rng.normal(0, how.scale, (samples, 2)))[:, :, None]
    matrix = stretched * (turned @ slanted)
    centre = (np.array(size) - 1) / 2
    place = np.einsum("nij,nj->ni", matrix[sample], place - centre)
    place += centre + rng.normal(0, how.shift, (samples, 2))[sample]
    return np.floor(place + 0.5).astype(np.int64)
