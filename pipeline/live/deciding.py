"""Decisions of the network on the events so far.

A :class:`Decider` is made once from a bundle and answers for all pages; the state of one recording
between two answers is in the object that :meth:`Decider.begin` returns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from deploy.check.bundle import Bundle
from deploy.network.decision import confidence
from deploy.network.responses import read_output, running_sums, score_unit, settled
from deploy.network.stimulus import EventFrames
from deploy.targets.fast.emulation import Emulation, compile_spec
from pipeline.inputs.images import tactile_images
from pipeline.recordings.events import Events, Source, collect
from pipeline.recordings.steps import EventTable
from pipeline.settings import Image


@dataclass(frozen=True)
class Answer:
    """The output of the network at one moment.

    Attributes
    ----------
    scores : ndarray of float, shape (10,)
    confidence : ndarray of float, shape (10,)
        The same as probabilities (softmax), as the network was trained to read them.
    spikes : dict of str to ndarray of uint8, shape (steps, n_bytes)
        Spikes of each layer at each step of the network's time, eight neurons a byte
        (`numpy.packbits`).
    sure : bool
        Whether the confidence is one at which the network decides by itself, before the end.
    unit : float
        See :func:`deploy.network.responses.score_unit`.
    """

    scores: np.ndarray
    confidence: np.ndarray
    spikes: dict
    sure: bool = False
    unit: float = 1.0

    @property
    def decision(self) -> int:
        """The digit with the highest score."""
        return int(np.argmax(settled(self.scores, self.unit)))


@dataclass(frozen=True)
class DrawnLayer:
    """A layer as the page draws it."""

    name: str
    neurons: int


class Deciding(Protocol):
    """The state of a decider for one recording."""

    def answer(self, events: Events, time_s: float) -> Answer | None:
        """Answer to all events of a recording up to a time, infinity at its end; may be slow."""


class Decider(Protocol):
    """A network that is ready to run.

    Attributes
    ----------
    about : str
        How the page's picture of the spikes goes on after "One row for each neuron, every mark is
        a spike; ".
    layers : tuple of DrawnLayer
        Those that spike, in order.
    steps : int
        Of the network's time in an answer's spikes.
    first_step : int
        The first one's number; below 0 where the network rests before it is shown anything.
    clocked : bool
        Whether an answer changes while time passes without an event.
    """

    about: str
    layers: tuple
    steps: int
    first_step: int
    clocked: bool

    def begin(self) -> Deciding:
        """A recording begins."""


class _Fast:
    """What both kinds have in common: a network on the target ``fast``, ready to run."""

    clocked = False

    def __init__(self, bundle: Bundle, seed: int):
        self._spec = spec = bundle.spec
        self._emulation = Emulation(compile_spec(spec, seed))
        self.steps, self.first_step = spec.presentation.period, -spec.presentation.gap
        sizes = {layer.name: layer.size for layer in spec.layers}
        sizes["input"] = int(np.prod(spec.input_shape))
        self.layers = tuple(DrawnLayer(name, sizes[name]) for name in spec.spiking_layers)
        shape = spec.stimulus.sample_shape(spec.input_shape, spec.presentation.steps)
        self._show(np.zeros((1, *shape)), spec.presentation.steps)  # compiles the kernel

    def begin(self):
        """Nothing is kept from one answer to the next: each begins at the network's rest."""
        return self

    def _show(self, samples, steps):
        """The answer to one sample after some of its steps."""
        spec, spikes = self._spec, {}
        shown, gap = spec.presentation, spec.presentation.gap

        def watch(packed):
            for name in spec.spiking_layers:
                spikes[name] = packed[name][0].copy()
                spikes[name][gap + steps :] = 0

        done = self._emulation.run(spec.stimulus.flat(samples)[None], shown.steps, gap, watch)
        counts = {name: done.counts[name][0] for name in spec.spiking_layers}
        output = done.output[0, :, gap : gap + steps]
        said = read_output(spec, output, counts)
        scores = said.scores[0]
        logits = self._logits(scores, steps)
        odds = np.exp(logits - logits.max())
        reached = False
        if shown.confidence is not None:
            sums = running_sums(spec, output)[0]
            reached = confidence(sums, spec.judge, shown.readout_start)[-1] >= shown.confidence
        return Answer(scores, odds / odds.sum(), spikes, bool(reached), score_unit(spec))

    def _logits(self, scores, steps):
        """What the softmax was taken of when the network was trained."""
        return scores


class ImageDecider(_Fast):
    """A decider for a bundle on images: it presents the image so far, from rest, every time.

    Making one takes a few seconds, some five more the first time ever, when the kernel is compiled;
    then every answer takes a millisecond or so.

    Parameters
    ----------
    bundle : Bundle
    image : Image
        How events become an image.
    seed : int
    """

    def __init__(self, bundle: Bundle, image: Image, seed: int = 0):
        super().__init__(bundle, seed)
        self._image = image
        self.about = (
            "the part at the left is before it is shown anything. This network is shown the image "
            f"as it is at the moment for {self._spec.presentation.steps} steps of 1 ms, from rest, "
            "again and again while you write."
        )

    def answer(self, events: Events, time_s: float) -> Answer | None:
        """See :class:`Deciding`."""
        if len(events) == 0:
            return None
        image = tactile_images(_alone(events), self._image.aggregation, self._image.normalisation)
        return self._show(image, self._spec.presentation.steps)


class EventDecider(_Fast):
    """A decider for a bundle on events, in the time steps of the network.

    No later event can change an earlier step: running all steps so far again gives what going on
    from the last one would, and takes a millisecond.

    Parameters
    ----------
    bundle : Bundle
    seed : int
    """

    clocked = True

    def __init__(self, bundle: Bundle, seed: int = 0):
        super().__init__(bundle, seed)
        milliseconds = 1e3 * self._spec.stimulus.step_seconds
        self.about = (
            "time runs to the right as it does on the skin. This network feels the events "
            f"themselves, in steps of {milliseconds:g} ms, and decides while they come."
        )

    def answer(self, events: Events, time_s: float) -> Answer | None:
        """See :class:`Deciding`."""
        if len(events) == 0:
            return None
        shown, seconds = self._spec.presentation, self._spec.stimulus.step_seconds
        since = (time_s - events.time_ns[0] * 1e-9) / seconds  # steps of the first event on
        steps = int(min(max(since, 0), shown.steps))
        if steps <= shown.readout_start:
            return None
        table, rest = EventTable.of(_alone(events)), self._spec.stimulus.rest
        frames = table.frames([0], 1e3 * seconds, shown.steps, rest)
        return self._show(np.moveaxis(frames, 0, 1), steps)

    def _logits(self, scores, steps):
        """Sums from the first event on, as they were trained."""
        return scores * (steps - self._spec.presentation.readout_start)


def _alone(events):
    return collect([events], [0], [""], [-1], Source("live", "", True))


def decider_of(bundle: Bundle, image: Image) -> Decider:
    """The decider for a bundle; compiles what has to be compiled."""
    if isinstance(bundle.spec.stimulus, EventFrames):
        return EventDecider(bundle)
    return ImageDecider(bundle, image)
