"""Decisions of the network on the events received so far.

A :class:`Decider` is made once from a bundle and answers for all pages; the state of one recording
between two answers is in the object that :meth:`Decider.begin` returns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from deploy import limits
from deploy.check.bundle import Bundle
from deploy.network.decision import confidence, probabilities
from deploy.network.responses import decoded, read_output, running_sums, score_unit, settled
from deploy.network.stimulus import EventFrames
from deploy.targets.fast import Emulation
from pipeline.recordings.dataset import inputs_for
from pipeline.recordings.events import Events, Sensor, Source, TaxelMap, collect
from pipeline.recordings.steps import EventTable

# Maximum number of neurons of a layer whose spikes are sent to the page, limited by the rows of a
# screen.
MOST_DRAWN = 4096


# Time for which a network on events receives them, in multiples of its presentation: a slow hand
# takes longer than the recordings of the training.
SLOWER = 3


@dataclass(frozen=True)
class Curve:
    """The confidence for early decisions over the time of a recording.

    Attributes
    ----------
    seconds : ndarray of float, shape (n,)
        Time from the start of the recording.
    values : ndarray of float, shape (n,)
        See :func:`deploy.network.decision.confidence`.
    classes : ndarray of int, shape (n,)
        The class with the highest score at these times.
    shares : ndarray of float, shape (n, n_classes)
        Probabilities of the classes at these times, see :func:`probabilities`.
    """

    seconds: np.ndarray
    values: np.ndarray
    classes: np.ndarray
    shares: np.ndarray

    def first(self, threshold: float | None, until_s: float = np.inf) -> Verdict | None:
        """The early decision up to a time, or None if there is none."""
        sure = self.values >= (np.inf if threshold is None else threshold)
        reached = np.flatnonzero(sure & (self.seconds <= until_s))
        return self._verdict(reached[0], True) if len(reached) else None

    def last(self) -> Verdict:
        """The answer at the end."""
        return self._verdict(-1)

    def shares_at(self, verdict: Verdict | None) -> np.ndarray:
        """Probabilities of the classes at the time of a verdict; without one, at the end."""
        return self.shares[np.searchsorted(self.seconds, verdict.seconds) if verdict else -1]

    def _verdict(self, index, early=False):
        at = float(self.seconds[index])
        return Verdict(int(self.classes[index]), float(self.values[index]), at, early)


class Verdict(NamedTuple):
    """The answer that counts: an early decision, or else the answer at the end, as in a check.

    Attributes
    ----------
    label : int
    confidence : float
        At that time.
    seconds : float
        Time from the start of the recording.
    early : bool
    """

    label: int
    confidence: float
    seconds: float
    early: bool


@dataclass(frozen=True)
class Answer:
    """The output of the network at one moment.

    Attributes
    ----------
    scores : ndarray of float, shape (classes,)
    spikes : dict of str to ndarray of uint8, shape (steps, n_bytes)
        Spikes of each layer at each step of the network's time, eight neurons per byte
        (`numpy.packbits`).
    curve : Curve
        Its last values are the present ones.
    decided : Verdict or None
        The network's early decision, if there is one.
    """

    scores: np.ndarray
    spikes: dict
    curve: Curve
    decided: Verdict | None = None


class Decider:
    """A network on the target ``fast``, ready to run; the common part of both kinds.

    Attributes
    ----------
    layers : dict of str to int
        Number of neurons of each spiking layer that is drawn, in order.
    steps : int
        Number of time steps of the spikes in an answer.
    first_step : int
        Number of the first step; negative if the network rests before the presentation.
    clocked : bool
        True if an answer can change without an event, as time passes.
    threshold : float or None
        Confidence for early decisions; None if the network always decides at the end.
    window_s : float or None
        Seconds from the first event on for which the network receives events; None for images.
    usual_s : float or None
        As `window_s`, of the samples that the network was trained on.
    """

    clocked = False
    window_s, usual_s = None, None

    def __init__(self, bundle: Bundle, sensor: Sensor):
        self._spec = spec = bundle.spec
        self._sensor, self._taxels = sensor, TaxelMap.grid(sensor.rows, sensor.columns)
        self._emulation = Emulation(spec)
        self.steps, self.first_step = spec.presentation.period, -spec.presentation.gap
        limit = spec.presentation.threshold
        self.threshold = limit if limit < 1 else None
        sizes = {layer.name: layer.size for layer in spec.layers}
        sizes["input"] = int(np.prod(spec.input_shape))
        self.layers = {n: sizes[n] for n in spec.spiking_layers if sizes[n] <= MOST_DRAWN}
        shape = spec.stimulus.sample_shape(spec.input_shape, spec.presentation.steps)
        self._show(np.zeros((1, *shape)), spec.presentation.steps)  # compiles the kernel

    def _recording(self, events):
        """One recording of the page's sensor."""
        source = Source("live", "", True)
        return collect([events], [0], [""], [-1], source, self._taxels, self._sensor)

    def _show(self, samples, steps):
        """Scores, spikes and accumulated readout of one sample after some of its steps.

        Returns
        -------
        scores : ndarray, shape (classes,)
        spikes : dict
            See :class:`Answer`.
        sums : ndarray, shape (steps - readout_start, classes)
            See :func:`deploy.network.responses.running_sums`.
        """
        spec, spikes = self._spec, {}
        gap = spec.presentation.gap

        def watch(packed):
            for name in self.layers:
                spikes[name] = packed[name][0].copy()
                spikes[name][gap + steps :] = 0

        done = self._emulation.run(spec.stimulus.flat(samples)[None], watch)
        counts = {name: done.counts[name][0] for name in spec.spiking_layers}
        output = decoded(spec, done.output[0, :, gap : gap + steps])
        responses = read_output(spec, output, counts)
        if responses.decisions[0, -1] < 0:  # an empty output is no answer
            return None
        return responses.scores[0], spikes, running_sums(spec, output)[0]

    def _confidence(self, sums):
        """The confidence for early decisions at each step of the sums."""
        return confidence(sums, self._spec.estimator, self._spec.presentation.readout_start)


class ImageDecider(Decider):
    """A decider for a bundle on images: each answer presents the image so far, from rest.

    Making a decider takes a few seconds, and about five more the first time on a machine, when the
    kernel is compiled.  Each answer then takes about a millisecond.

    Parameters
    ----------
    bundle : Bundle
    sensor : Sensor
    """

    def begin(self):
        """Begin a recording; its answers are stored for the curve."""
        return SimpleNamespace(answer=partial(self._answer, []))

    def _answer(self, points, events: Events, time_s: float) -> Answer | None:
        """The answer for all events up to a time (infinity: to the end of the recording)."""
        if len(events) == 0:
            return None
        image = inputs_for(self._spec, self._recording(events))
        shown = self._show(image, self._spec.presentation.steps)
        if shown is None:
            return None
        scores, spikes, sums = shown
        # The softmax was trained on the scores, which are means.  Sums of many steps would always
        # give a confidence of nearly 1 unless a threshold was chosen for them.
        sure = (confidence(scores[None]) if self.threshold is None else self._confidence(sums))[-1]
        now = float(events.time_ns[-1] * 1e-9) if np.isinf(time_s) else time_s
        best = int(np.argmax(settled(scores, score_unit(self._spec))))
        points.append((now, sure, best, probabilities(scores, sure)))
        curve = Curve(*map(np.array, zip(*points, strict=True)))
        return Answer(scores, spikes, curve, curve.first(self.threshold))


class EventDecider(Decider):
    """A decider for a bundle on events, in the time steps of the network.

    A later event cannot change an earlier step.  Running all steps so far again therefore gives the
    same result as continuing from the last step, and takes a millisecond.

    Parameters
    ----------
    bundle : Bundle
    sensor : Sensor
    """

    clocked = True

    def __init__(self, bundle: Bundle, sensor: Sensor):
        spec, step_s = bundle.spec, bundle.spec.stimulus.step_seconds
        self.usual_s = step_s * spec.presentation.steps
        longer = spec.with_presentation(steps=min(SLOWER * spec.presentation.steps, limits.STEPS))
        super().__init__(replace(bundle, spec=longer), sensor)
        self.window_s = step_s * longer.presentation.steps

    def begin(self):
        """Begin a recording; its answers do not depend on earlier answers."""
        return self

    def answer(self, events: Events, time_s: float) -> Answer | None:
        """The answer for all events up to a time (infinity: to the end of the recording)."""
        if len(events) == 0:
            return None
        shown, seconds = self._spec.presentation, self._spec.stimulus.step_seconds
        first_s, last_s = events.time_ns[[0, -1]] * 1e-9
        since = (time_s - first_s) / seconds  # steps of the first event on
        # A recording of the usual length ends with its presentation, as in the check.
        settles = len(self._spec.layers) + 2  # steps that a spike needs to the output
        end_s = max(self.usual_s, last_s - first_s + settles * seconds)
        steps = int(min(max(since, 0), round(end_s / seconds), shown.steps))
        if steps <= shown.readout_start:
            return None
        table, refractory = EventTable.of(self._recording(events)), self._spec.stimulus.refractory
        frames = table.frames([0], 1e3 * seconds, shown.steps, refractory)
        answered = self._show(np.moveaxis(frames, 0, 1), steps)
        if answered is None:
            return None
        scores, spikes, sums = answered
        ends = first_s + seconds * np.arange(shown.readout_start + 1, steps + 1)
        sure = self._confidence(sums)
        curve = Curve(ends, sure, sums.argmax(axis=1), probabilities(sums, sure))
        # Slower than all recordings of the training, confidence is too high to decide early.
        usual_s = first_s + self.usual_s + seconds / 2
        return Answer(scores, spikes, curve, curve.first(self.threshold, usual_s))


def decider_of(bundle: Bundle, sensor: Sensor) -> Decider:
    """The decider for a bundle; compiles the kernel if necessary."""
    if isinstance(bundle.spec.stimulus, EventFrames):
        return EventDecider(bundle, sensor)
    return ImageDecider(bundle, sensor)
