"""Decisions of the network on the events received so far.

A :class:`PageDecider` is made once from a bundle and answers for all pages; the state of one
recording between two answers is in the object that :meth:`PageDecider.begin` returns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from deploy import limits
from deploy.check.bundle import Bundle
from deploy.network.decision import compute_confidence, compute_probabilities
from deploy.network.readout import (
    compute_running_sums,
    find_score_unit,
    round_scores,
    select_readout,
)
from deploy.network.responses import compute_responses
from deploy.stream.presentation import SharedNetwork
from deploy.stream.stream import Stream
from deploy.targets.emulation import Emulation
from pipeline.recordings.dataset import make_inputs_for
from pipeline.recordings.events import Events
from pipeline.recordings.recordings import Source, join_recordings
from pipeline.recordings.sensor import Sensor, TaxelMap

# Maximum number of neurons of a layer whose spikes are sent to the page, limited by the rows of a
# screen.
MAX_DRAWN_NEURONS = 4096

# Time for which a network on events receives them, in multiples of its presentation: a slow hand
# takes longer than the recordings of the training.
MAX_SLOWNESS = 3


@dataclass(frozen=True)
class Curve:
    """The confidence and the probabilities over the time of a recording.

    Attributes
    ----------
    seconds : ndarray of float, shape (n,)
        Time from the start of the recording.
    confidences : ndarray of float, shape (n,)
        See :func:`deploy.network.decision.compute_confidence`.
    classes : ndarray of int, shape (n,)
        The class with the highest score at these times.
    probabilities : ndarray of float, shape (n, n_classes)
        Probabilities of the classes at these times, see :func:`compute_probabilities`.
    """

    seconds: np.ndarray
    confidences: np.ndarray
    classes: np.ndarray
    probabilities: np.ndarray

    def find_first(self, threshold: float | None, until_s: float = np.inf) -> PageVerdict | None:
        """The early decision up to a time, or None if there is none."""
        is_sure = self.confidences >= (np.inf if threshold is None else threshold)
        reached = np.flatnonzero(is_sure & (self.seconds <= until_s))
        return self._make_verdict(reached[0], True) if len(reached) else None

    def find_last(self) -> PageVerdict:
        """The answer at the end."""
        return self._make_verdict(-1)

    def _make_verdict(self, index, early=False):
        at = float(self.seconds[index])
        return PageVerdict(int(self.classes[index]), float(self.confidences[index]), at, early)


class PageVerdict(NamedTuple):
    """The answer that counts: an early decision, or else the answer at the end, as in a check.

    Attributes
    ----------
    label : int
    confidence : float
        The confidence at that time.
    seconds : float
        Time from the start of the recording.
    early : bool
    """

    label: int
    confidence: float
    seconds: float
    early: bool


@dataclass(frozen=True)
class NetworkOutput:
    """The output of the network at one moment.

    Attributes
    ----------
    scores : ndarray of float, shape (classes,)
    spikes : dict of str to ndarray of uint8, shape (steps, n_bytes)
        Spikes of each layer at each step of the network's time, eight neurons per byte
        (`numpy.packbits`).
    curve : Curve
        Its last values are the present ones.
    decided : PageVerdict or None
        The network's early decision, if there is one.
    exceeds_training : bool
        True if the recording is longer than the samples of the training, on which the
        estimate of the confidence was trained: it is far too high then.
    """

    scores: np.ndarray
    spikes: dict
    curve: Curve
    decided: PageVerdict | None = None
    exceeds_training: bool = False


class PageDecider:
    """A network on the target ``fast``, ready to run; the common part of both kinds.

    Attributes
    ----------
    layers : dict of str to int
        Number of neurons of each spiking layer that is drawn, in order.
    steps : int
        Number of time steps of the spikes in an answer.
    first_step : int
        Number of the first step; negative if the network rests before the presentation.
    changes_with_time : bool
        True if an answer can change without an event, as time passes.
    threshold : float or None
        Confidence at which the network decides early; None if it always decides at the end.
    window_s : float or None
        Seconds from the first event on for which the network receives events; None for images.
    usual_s : float or None
        As `window_s`, of the samples that the network was trained on.
    """

    changes_with_time = False
    window_s: float | None = None
    usual_s: float | None = None

    def __init__(self, bundle: Bundle, sensor: Sensor):
        self._spec = spec = bundle.spec
        self._sensor = sensor
        self._emulation = Emulation(spec, bundle.seed)
        self.steps = spec.presentation.period
        self.first_step = -spec.presentation.gap
        threshold = spec.presentation.threshold_or_1
        self.threshold = threshold if threshold < 1 else None
        sizes = {layer.name: layer.size for layer in spec.layers}
        sizes["input"] = int(np.prod(spec.input_shape))
        self.layers = {n: sizes[n] for n in spec.spiking_layers if sizes[n] <= MAX_DRAWN_NEURONS}


class ImageDecider(PageDecider):
    """A decider for a bundle on images: each answer presents the image so far, from rest.

    Making a decider takes a few seconds, and about five more the first time on a machine, when the
    emulator is compiled.  Each answer then takes about a millisecond.

    Parameters
    ----------
    bundle : Bundle
    sensor : Sensor
    """

    def __init__(self, bundle: Bundle, sensor: Sensor):
        super().__init__(bundle, sensor)
        self._taxels = TaxelMap.grid(sensor.rows, sensor.columns)
        self._present(np.zeros((1, *self._spec.input_shape)))  # compiles the emulator

    def begin(self):
        """Begin a recording; its answers are stored for the curve."""
        return SimpleNamespace(compute_output=partial(self._compute_output, []))

    def _compute_output(self, points, events: Events, time_s: float) -> NetworkOutput | None:
        """The answer for all events up to a time (infinity: to the end of the recording)."""
        if len(events) == 0:
            return None
        source = Source("live", "", True)
        recording = join_recordings([events], [0], [""], [-1], source, self._taxels, self._sensor)
        presented = self._present(make_inputs_for(self._spec, recording))
        if presented is None:
            return None
        scores, spikes, sums = presented
        # The softmax was trained on the scores, which are means.  Sums of many steps would always
        # give a confidence of nearly 1 unless a threshold was chosen for them.
        if self.threshold is None:
            confidence = compute_confidence(scores[None])[-1]
        else:
            first = self._spec.presentation.readout_start
            confidence = compute_confidence(sums, self._spec.estimator, first)[-1]
        now_s = float(events.time_ns[-1] * 1e-9) if np.isinf(time_s) else time_s
        best = int(np.argmax(round_scores(scores, find_score_unit(self._spec))))
        points.append((now_s, confidence, best, compute_probabilities(scores, confidence)))
        curve = Curve(*map(np.array, zip(*points, strict=True)))
        return NetworkOutput(scores, spikes, curve, curve.find_first(self.threshold))

    def _present(self, images):
        """Scores, spikes and accumulated readout of one image; None if its output is empty."""
        spec = self._spec
        spikes = {}

        def watch(packed):
            for name in self.layers:
                spikes[name] = packed[name][0].copy()

        outputs = self._emulation.run(spec.stimulus.flatten(images)[None], watch)
        counts = {name: outputs.counts[name][0] for name in spec.spiking_layers}
        output = select_readout(spec, outputs.output[0, :, spec.presentation.gap :])
        responses = compute_responses(spec, output, counts)
        if responses.decisions[0, -1] < 0:
            return None
        return responses.scores[0], spikes, compute_running_sums(spec, output)[0]


class EventDecider(PageDecider):
    """A decider for a bundle on events: each recording is a touch of a stream.

    Parameters
    ----------
    bundle : Bundle
    sensor : Sensor
    """

    changes_with_time = True
    window_s: float
    usual_s: float

    def __init__(self, bundle: Bundle, sensor: Sensor):
        super().__init__(bundle, sensor)
        presentation = self._spec.presentation
        step_s = self._spec.stimulus.step_seconds
        longest = min(MAX_SLOWNESS * presentation.steps, limits.STEPS)
        self.steps = presentation.gap + longest
        self.usual_s = step_s * presentation.steps
        self.window_s = step_s * longest
        self._bundle = bundle
        self._network = SharedNetwork(self._emulation, self.layers)
        self.begin()  # compiles the emulator

    def begin(self):
        """Begin a recording: a fresh network, whose only touch ends when the recording does."""
        stream = Stream(
            self._bundle,
            unit="ns",
            silence=math.inf,
            longest=self.window_s,
            stream_length=1,
            network=self._network,
        )
        return TouchDecider(self, stream, self._sensor.rows)

    def describe(self, stream: Stream) -> NetworkOutput | None:
        """The answer for the touch of a stream so far."""
        spec = self._spec
        touch = stream.touch
        if touch is None:
            return None
        readout = touch.presentation.readout
        if not len(readout.sums) or not readout.spoke[-1]:
            return None
        first_s = touch.start_ns * 1e-9
        steps = np.arange(spec.presentation.readout_start + 1, readout.n_steps + 1)
        curve = Curve(
            first_s + spec.stimulus.step_seconds * steps,
            readout.confidences.copy(),
            readout.sums.argmax(axis=1),
            compute_probabilities(readout.sums, readout.confidences),
        )
        # Slower than all recordings of the training, confidence is too high to decide early.
        usual_s = first_s + self.usual_s + spec.stimulus.step_seconds / 2
        spikes = {name: rows.copy() for name, rows in touch.presentation.spikes.items()}
        verdict = curve.find_first(self.threshold, usual_s)
        scores = readout.compute_scores(readout.n_steps)
        return NetworkOutput(scores, spikes, curve, verdict, stream.exceeds_training)


class TouchDecider:
    """The answers for one recording on events.

    Parameters
    ----------
    decider : EventDecider
    stream : Stream
    rows : int
        Rows of the sensor, whose taxels are numbered column by column.
    """

    def __init__(self, decider: EventDecider, stream: Stream, rows: int):
        self._decider = decider
        self._stream = stream
        self._rows = rows
        self._n_taken = 0

    def compute_output(self, events: Events, time_s: float) -> NetworkOutput | None:
        """The answer for all events up to a time (infinity: to the end of the recording).

        Parameters
        ----------
        events : Events
            All of the recording so far, those of the last call first.
        time_s : float
            Never before that of the last call.
        """
        if len(events) == 0:
            return None
        time_ns = events.time_ns[self._n_taken :]
        column, row = np.divmod(events.taxel[self._n_taken :], self._rows)
        # The page says that later ones are not received.
        received = time_ns < events.time_ns[0] + 1e9 * self._decider.window_s
        polarity = events.polarity[self._n_taken :]
        self._stream.push(
            time_ns[received],
            column[received],
            row[received],
            polarity[received],
        )
        self._n_taken = len(events)
        if np.isinf(time_s):
            self._stream.finish()
        else:
            self._stream.advance(1e9 * time_s)
        return self._decider.describe(self._stream)


def make_decider(bundle: Bundle, sensor: Sensor) -> PageDecider:
    """The decider for a bundle; compiles the emulator if necessary."""
    decider = ImageDecider if bundle.spec.stimulus.is_static else EventDecider
    return decider(bundle, sensor)
