"""Recordings that the page plays as examples: the samples of the network's check.

An example is played at its original speed to the decider that is used for the pen.
"""

from dataclasses import dataclass, replace

import numpy as np

from deploy.check.bundle import Bundle
from deploy.errors import UserError
from pipeline.recordings.events import Events
from pipeline.recordings.recordings import Recordings
from pipeline.settings import read_settings
from pipeline.simulation.pen import START_S
from pipeline.sources import load_named_recordings
from pipeline.storage.run_folder import RunFolder

# Time from an example's last event to its end.
END_MARGIN_S = 0.05


@dataclass(frozen=True)
class Example:
    """A recording to be played.

    Attributes
    ----------
    events : Events
        Events of the page's sensor, whose taxels are numbered column by column; the first event is
        at :data:`pipeline.simulation.pen.START_S`.
    label : int
    name : str
    """

    events: Events
    label: int
    name: str


class Examples:
    """Examples in random order; none is repeated before all of its class have been played.

    Parameters
    ----------
    examples : list of Example
    seed : sequence of int
    """

    def __init__(self, examples, seed):
        self._examples = examples
        self._rng = np.random.default_rng(seed)
        self._decks = {}

    def count_by_class(self, n_classes: int) -> list:
        """Number of examples of each class."""
        labels = np.array([example.label for example in self._examples], int)
        return np.bincount(labels, minlength=n_classes).tolist()

    def draw(self, label: int | None = None) -> Example:
        """The next example of a class; default: of any.

        Raises
        ------
        UserError
            There is none.
        """
        fitting = [e for e in self._examples if label in (None, e.label)]
        if not fitting:
            raise UserError("there is no example of this class; choose another class")
        deck = self._decks.get(label) or self._rng.permutation(len(fitting)).tolist()
        self._decks[label] = deck[:-1]
        return fitting[deck[-1]]


class ReplayedTouch:
    """An existing recording, instead of a :class:`~pipeline.simulation.pen.Writing`.

    Parameters
    ----------
    events : Events
    """

    def __init__(self, events: Events):
        self._all_events = events
        self.time_s = START_S
        last_s = events.time_ns[-1] * 1e-9 if len(events) else START_S
        self.settled_s = float(last_s) + END_MARGIN_S

    @property
    def events(self) -> Events:
        """All events so far."""
        return self._select_between(0, self.time_s)

    def advance(self, until_s: float) -> Events:
        """Advance the time and return the events of this interval."""
        begun_s = self.time_s
        self.time_s = max(self.time_s, until_s)
        return self._select_between(begun_s, self.time_s)

    def _select_between(self, begun_s, until_s):
        first, end = np.searchsorted(self._all_events.time_ns, np.array([begun_s, until_s]) * 1e9)
        return Events(
            *(getattr(self._all_events, name)[first:end] for name in vars(self._all_events))
        )


def list_check_examples(run: RunFolder, bundle: Bundle) -> list:
    """The samples of a network's check: the recordings themselves, if its run has them.

    Parameters
    ----------
    run : RunFolder
        The folder around the bundle, which need not be a run.
    bundle : Bundle

    Raises
    ------
    UserError
        There are no examples; the message has the reason.
    """
    try:
        if not run.experiment.exists():
            raise UserError(f"{bundle.path}: is a bundle without its run and recordings")
        return list_recorded_examples(run, bundle)
    except UserError:
        if not (examples := list_bundle_examples(bundle)):
            raise
        return examples


def list_recorded_examples(run: RunFolder, bundle: Bundle) -> list:
    """The samples of a run's check, as they were recorded.

    Raises
    ------
    UserError
        The recordings do not exist any more, or have changed since the training.
    """
    settings = read_settings(run.experiment)
    recordings = load_named_recordings(settings)
    if recordings.source.sha256 != bundle.spec.provenance.source_sha256:
        raise UserError(f"{settings.data.source}: has changed since the network was trained")
    index = {name: i for i, name in enumerate(recordings.ids)}
    indices = [index[name] for name in bundle.checks.ids if name in index]
    part = recordings.subset(
        [i for i in indices if recordings.offsets[i] < recordings.offsets[i + 1]]
    )
    return [
        Example(_from_start(_number_by_columns(part, i)), int(part.labels[i]), part.ids[i])
        for i in range(len(part))
    ]


def _number_by_columns(recordings: Recordings, index):
    """Events of a recording with the taxels numbered as on the page."""
    events = recordings[index]
    taxels = recordings.taxels
    number = taxels.column * recordings.sensor.rows + taxels.row
    return replace(events, taxel=number[events.taxel])


def list_bundle_examples(bundle: Bundle) -> list:
    """The samples of a bundle's check, with the precision of a step.

    A bundle on images has no examples, because an image has no times of events.
    """
    stimulus = bundle.spec.stimulus
    checks = bundle.checks
    if stimulus.is_static:
        return []
    step_ns = round(1e9 * stimulus.step_seconds)
    return [
        Example(_from_start(_make_events(frames, step_ns)), int(label), name)
        for frames, label, name in zip(checks.inputs, checks.labels, checks.ids, strict=True)
        if frames.any()
    ]


def _make_events(frames, step_ns):
    """Frames, shape (steps, rows, columns, 2), as events in the middle of their steps.

    Events of the first step are at its start, from which the network counts.
    """
    step, row, column, polarity = np.nonzero(frames)
    return Events(
        step * step_ns + np.where(step > 0, step_ns // 2, 0),
        column * frames.shape[1] + row,
        np.where(polarity == 0, 1, -1),
        np.ones(len(step)),
    )


def _from_start(events):
    """Events shifted so that the first one is at the time of a pen's first touch."""
    if not len(events):
        return events
    return replace(events, time_ns=events.time_ns - events.time_ns[0] + round(START_S * 1e9))
