"""Data augmentation: samples altered in time and space, with events left out and faulty taxels.

:func:`alter_events` makes altered samples for a network on events.  A network on images uses
the functions that it consists of: :func:`move_places` for the places of taxels, and
:func:`pipeline.recordings.faulty_taxels.draw_faults` for hot and dead ones, see
:class:`pipeline.recordings.images.AlteredImages`.
"""

from dataclasses import dataclass, replace

import numpy as np

from pipeline.recordings.columns import EventColumns
from pipeline.recordings.events import Events
from pipeline.recordings.faulty_taxels import draw_faults
from pipeline.recordings.recordings import Recordings, is_handwriting


@dataclass(frozen=True)
class Alteration:
    """The parameters of the alterations; each z below is standard normal, drawn for each sample.

    The sample begins at a random time within its first step.  An event is assigned to the nearest
    taxel; events beyond the edge are lost.

    Attributes
    ----------
    stretch : float
        The times of a sample are multiplied by exp(``stretch`` z).
    drop : float
        Each event is dropped with a probability that is drawn from 0 to ``drop``.
    turn : float
        Places are rotated around the middle of the skin by ``turn`` z radians.
    shift : float
        Places are shifted by ``shift`` z taxels in both directions.
    scale : float
        Distances from the middle are multiplied by exp(``scale`` z), along rows and along columns.
    shear : float
        Places are sheared by ``shear`` z, before they are rotated.
    hot, dead : float
        Probabilities that a sample has hot and dead taxels, see
        :mod:`pipeline.recordings.faulty_taxels`.
    """

    stretch: float = 0.1
    drop: float = 0.2
    turn: float = 0.08
    shift: float = 0.4
    scale: float = 0.08
    shear: float = 0.08
    hot: float = 0.25
    dead: float = 0.25

    @property
    def is_spatial(self) -> bool:
        """True if events move to other taxels."""
        return any((self.turn, self.shift, self.scale, self.shear))


# Alterations in time, dropped events and faulty taxels, for sensors on which a position may have a
# meaning of its own or neighbours in the grid are not neighbours on the sensor.
TIME_ONLY = Alteration(turn=0.0, shift=0.0, scale=0.0, shear=0.0)

# Movements half as large as those of handwriting on the simulated skin, for other grids of taxels:
# they take few events to another taxel.
SLIGHT = Alteration(turn=0.04, shift=0.2, scale=0.04, shear=0.04)

# The alterations of each value of ``events.augment`` but ``auto``.
AUGMENTATIONS = {
    "none": Alteration(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "time": TIME_ONLY,
    "slight": SLIGHT,
    "space": Alteration(),
}


def choose_augmentation(recordings: Recordings) -> str:
    """The augmentation that suits recordings.

    It is ``space`` for handwriting on the simulated sensor, ``slight`` for other grids of taxels,
    and ``time`` for sensors with few rows or columns, such as a strip.
    """
    if is_handwriting(recordings):
        return "space"
    return "slight" if recordings.sensor.is_grid else "time"


def alter_events(
    alteration: Alteration, rng, events: EventColumns, n_samples: int, step_ms: float, size=(10, 10)
) -> EventColumns:
    """Alter samples.

    Parameters
    ----------
    alteration : Alteration
    rng : numpy.random.Generator
    events : EventColumns
    n_samples : int
        Number of samples.
    step_ms : float
        The step, in milliseconds, within which a sample begins at a random time.
    size : (int, int)
        Rows and columns of taxels.

    Returns
    -------
    EventColumns
        The remaining events, and those of hot taxels.
    """
    altered, kept = _alter_each(alteration, rng, events, n_samples, step_ms, size)
    altered = altered.select(kept)
    if not alteration.hot and not alteration.dead:
        return altered
    faults = draw_faults(
        alteration.hot, alteration.dead, rng, altered.measure_durations_ms(n_samples), size
    )
    return faults.apply(altered)


def alter_recordings(
    recordings: Recordings, indices, alteration: Alteration, step_ms: float, seed
) -> Recordings:
    """Altered copies of some recordings, without faulty taxels.

    Parameters
    ----------
    recordings : Recordings
    indices : sequence of int
        Indices of recordings; one that occurs several times is altered differently each time.
    alteration : Alteration
    step_ms : float
        The step within which a sample begins at a random time.
    seed : int or sequence of int

    Returns
    -------
    Recordings
        In the order of the indices.
    """
    chosen = recordings.subset(indices)
    rng = np.random.default_rng(seed)
    taxels = chosen.taxels
    sensor = chosen.sensor
    old = chosen.events
    sample = chosen.sample_of_event
    has_events = np.diff(chosen.offsets) > 0
    begins = np.zeros(len(chosen), np.int64)
    begins[has_events] = old.time_ns[chosen.offsets[:-1][has_events]]
    time_ms = (old.time_ns - begins[sample]) / 1e6
    size = (sensor.rows, sensor.columns)
    events = EventColumns(
        sample, time_ms, taxels.row[old.taxel], taxels.column[old.taxel], old.polarity
    )
    altered, kept = _alter_each(alteration, rng, events, len(chosen), step_ms, size)
    taxel_at = np.full(size, -1)  # there may be places without a taxel
    taxel_at[taxels.row, taxels.column] = np.arange(len(taxels))
    taxel = np.full(len(kept), -1)
    taxel[kept] = taxel_at[altered.row[kept], altered.column[kept]]
    kept &= taxel >= 0
    time_ns = begins[sample] + np.rint(1e6 * altered.time_ms).astype(np.int64)
    order = np.flatnonzero(kept)
    order = order[np.lexsort((time_ns[order], sample[order]))]
    counts = np.bincount(sample[order], minlength=len(chosen))
    return replace(
        chosen,
        events=Events(time_ns[order], taxel[order], old.polarity[order], old.columns[order]),
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        ids=tuple(f"{name}+{number}" for number, name in enumerate(chosen.ids)),
    )


def _alter_each(alteration, rng, events, samples, step_ms, size):
    """Every event at its new time and place, and the mask of those that remain."""
    pace = np.exp(rng.normal(0, alteration.stretch, samples))
    begin_ms = step_ms * rng.uniform(0, 1, samples)
    time_ms = events.time_ms * pace[events.sample] + begin_ms[events.sample]
    kept = rng.random(len(time_ms)) >= rng.uniform(0, alteration.drop, samples)[events.sample]
    places = np.stack([events.row, events.column], -1)
    places = move_places(alteration, rng, samples, events.sample, places, size)
    kept &= ((places >= 0) & (places < size)).all(1)
    altered = events._replace(time_ms=time_ms, row=places[:, 0], column=places[:, 1])
    return altered, kept


def move_places(alteration: Alteration, rng, n_samples: int, sample, places, size) -> np.ndarray:
    """The places of events after the change of their sample in space.

    Parameters
    ----------
    alteration : Alteration
    rng : numpy.random.Generator
    n_samples : int
    sample : ndarray of int, shape (n_events,)
        Sample of each event.
    places : ndarray, shape (n_events, 2)
        Row and column of each event.
    size : (int, int)

    Returns
    -------
    ndarray of int, shape (n_events, 2)
        In whole taxels; places outside of ``size`` are beyond the edge.
    """
    angle = rng.normal(0, alteration.turn, n_samples)
    cosine = np.cos(angle)
    sine = np.sin(angle)
    turned = np.moveaxis(np.array([[cosine, -sine], [sine, cosine]]), 2, 0)
    slanted = np.tile(np.eye(2), (n_samples, 1, 1))
    slanted[:, 1, 0] = rng.normal(0, alteration.shear, n_samples)  # columns move with the row
    stretched = np.exp(rng.normal(0, alteration.scale, (n_samples, 2)))[:, :, None]
    matrix = stretched * (turned @ slanted)
    centre = (np.array(size) - 1) / 2
    row, column = (places - centre).T
    to_rows, to_columns = matrix.transpose(1, 2, 0)
    shift = centre[:, None] + rng.normal(0, alteration.shift, (n_samples, 2)).T
    moved_rows = to_rows[0][sample] * row + to_rows[1][sample] * column
    moved_columns = to_columns[0][sample] * row + to_columns[1][sample] * column
    moved = np.stack([moved_rows + shift[0][sample], moved_columns + shift[1][sample]], -1)
    return np.floor(moved + 0.5).astype(np.int64)
