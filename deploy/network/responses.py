"""Presentation of a stream to a simulator or board, and scores and decisions from its output.

A run of a target over samples gives, for each sample, the output at each of its steps.  The score
of a class at a step is the mean of its output from ``readout_start`` up to that step (plus the
readout's bias); the decision at a step is the class with the highest score.  As long as no spike
has reached the readout, its output is empty and there is no decision.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field, fields, replace
from typing import Dict, Iterator, NamedTuple, Optional

import numpy as np

from .chip import LOIHI
from .decision import compute_confidence, continue_confidence, find_decisions
from .spec import NetworkSpec


@dataclass(frozen=True)
class Responses:
    """Responses of a network to some samples.

    Attributes
    ----------
    scores : ndarray, shape (n_samples, n_classes)
        Scores at the last step of the presentation.
    decisions : ndarray of int, shape (n_samples, steps)
        Decision at each step; -1 before the readout starts and while its output is empty.
    spikes : dict of str to ndarray of int, shape (n_samples,)
        Number of spikes of each layer during the sample and the gap before it.
    operations : dict of str to ndarray of int, shape (n_samples,)
        Synaptic operations by the receiving layer, in the same time.
    stopped_at : ndarray of int, shape (n_samples,), or None
        Step (from 1) at which the confidence was first reached, or the last one; None if the
        presentation has no confidence.
    probabilities : ndarray of float, shape (n_samples,), or None
        Estimated probability that the class at the last step is right: that of the confidence, or
        without one the softmax of the scores.  NaN where no spike has reached the readout; None if
        the readout counts spikes of output neurons, which are no logits.
    spike_hashes : ndarray of str, shape (n_samples,), or None
        Hash of every spike of every layer and step of each sample, including its gap; None from a
        target that does not record single spikes.
    notes : dict
        Further data of the target about the stream, such as a board's timing; plain values.
    """

    scores: np.ndarray
    decisions: np.ndarray
    spikes: Dict[str, np.ndarray]
    operations: Dict[str, np.ndarray]
    stopped_at: Optional[np.ndarray] = None
    probabilities: Optional[np.ndarray] = None
    spike_hashes: Optional[np.ndarray] = None
    notes: dict = field(default_factory=dict)

    @property
    def predictions(self) -> np.ndarray:
        """Class with the highest score at the last step, shape (n_samples,).

        A network has to answer at the end: for an empty output this is the class with the largest
        bias, or the first class.
        """
        last = self.decisions[:, -1]
        return np.where(last < 0, self.scores.argmax(1), last)


@dataclass(frozen=True)
class TargetOutput:
    """The output of a target for the samples of a stream.

    Attributes
    ----------
    readout : ndarray, shape (n_samples, steps, outputs)
        The readout at each step of a sample's presentation, without the gap before it.  On the
        host: decoded values, without the bias, of the classes, or of the classes in all sections
        (``sections * n_classes`` outputs) of which each step's is taken then; see
        :func:`deploy.network.reference.read_out`.  On the chip: the output neurons' spikes,
        ``amplitude / dt`` in a step with a spike.
    spikes : dict of str to ndarray of int, shape (n_samples, n_neurons), or None
        Number of spikes of each neuron of each spiking layer (``spec.spiking_layers``), including
        the gap before the sample; None if the target does not count them.
    spike_hashes : ndarray of str, shape (n_samples,), or None
        See `Responses`.
    notes : dict
        See `Responses`.
    """

    readout: np.ndarray
    spikes: Optional[Dict[str, np.ndarray]] = None
    spike_hashes: Optional[np.ndarray] = None
    notes: dict = field(default_factory=dict)

    @classmethod
    def of_stream(cls, spec: NetworkSpec, output, spikes) -> TargetOutput:
        """The output for a stream of which every step was recorded.

        Parameters
        ----------
        spec : NetworkSpec
        output : ndarray, shape (n_samples * period, outputs)
            The readout at each step, the gaps included.
        spikes : dict of str to ndarray, shape (n_samples * period, n_neurons)
            Spikes of each spiking layer, in order.
        """
        presentation = spec.presentation
        period = presentation.period

        def split_by_sample(values):
            return values.reshape(-1, period, values.shape[-1])

        by_layer = {name: split_by_sample(rows) != 0 for name, rows in spikes.items()}
        packed = [np.packbits(rows, axis=2) for rows in by_layer.values()]
        hashes = [hash_spikes(of_sample) for of_sample in zip(*packed)]
        return cls(
            readout=split_by_sample(output)[:, presentation.gap :],
            spikes={name: np.count_nonzero(rows, axis=1) for name, rows in by_layer.items()},
            spike_hashes=np.array(hashes),
        )

    def require_fit(self, spec: NetworkSpec, n_samples: int, target: str):
        """Refuse what cannot be the output of a network for some samples.

        Raises
        ------
        ValueError
            A shape or a type is wrong; the message names the target.
        """
        outputs = _count_outputs(spec, self.readout)
        shape = (n_samples, spec.presentation.steps, outputs)
        _require_array(target, "readout", self.readout, shape, "biuf")
        if not np.isfinite(self.readout).all():
            raise ValueError(f"target {target!r}: its readout has NaN or infinite values")
        if self.spikes is not None:
            sizes = {"input": math.prod(spec.input_shape)}
            sizes.update((layer.name, layer.size) for layer in spec.layers if layer.neurons)
            if self.spikes.keys() != sizes.keys():
                raise ValueError(
                    f"target {target!r}: it gives the spikes of {', '.join(self.spikes)}; the "
                    f"spiking layers are {', '.join(sizes)}"
                )
            for name, size in sizes.items():
                counts = self.spikes[name]
                _require_array(target, f"spikes of {name!r}", counts, (n_samples, size), "iu")
        if self.spike_hashes is not None:
            _require_array(target, "spike_hashes", self.spike_hashes, (n_samples,), "U")


def _count_outputs(spec, readout) -> int:
    """The number of outputs of a step that a readout should have."""
    last = spec.layers[-1]
    has_only_classes = np.shape(readout)[-1:] == (last.size,)
    return last.size if has_only_classes else last.sections * last.size


def _require_array(target, what, array, shape, kinds):
    found = np.asarray(array)
    if found.shape != shape:
        raise ValueError(f"target {target!r}: {what} of shape {found.shape} should have {shape}")
    if found.dtype.kind not in kinds:
        raise ValueError(f"target {target!r}: {what} must not have the type {found.dtype}")


def make_responses(
    spec: NetworkSpec, output: TargetOutput, n_samples: int, target: str
) -> Responses:
    """Check what a target yields for a stream, and read scores and decisions from it.

    Parameters
    ----------
    spec : NetworkSpec
    output : TargetOutput
    n_samples : int
        Number of samples of the stream.
    target : str
        Name of the target, for messages.

    Raises
    ------
    ValueError
        A shape or a type is wrong.
    """
    if not isinstance(output, TargetOutput):
        kind = type(output).__name__
        raise ValueError(f"target {target!r}: it yields {kind}, not TargetOutput")
    output.require_fit(spec, n_samples, target)
    readout = np.asarray(output.readout, float)
    if readout.shape[-1] != spec.layers[-1].size:
        readout = select_readout(spec, readout)
    responses = read_output(spec, readout, output.spikes)
    return replace(responses, spike_hashes=output.spike_hashes, notes=output.notes)


class ShortOfSteps(Exception):
    """A simulator or board returned an impossible number of steps or spikes."""


class SampleOutput(NamedTuple):
    """Output and spikes of one sample, including the gap before it.

    Attributes
    ----------
    output : ndarray, shape (period, n_outputs)
        The readout at each step.
    spikes : dict of str to ndarray of bool, shape (period, n_neurons)
        Spikes of each spiking layer, in order.
    """

    output: np.ndarray
    spikes: Dict[str, np.ndarray]


def show(built, sim, samples) -> Iterator[SampleOutput]:
    """Present one stream, sample by sample, so that the probes only store one sample's steps.

    Parameters
    ----------
    built : deploy.network.build.Built
        The network that ``sim`` runs.
    sim : nengo.Simulator or nengo_loihi.Simulator
        A simulator at its first step; its probes are cleared after each sample.
    samples : ndarray
        Samples in the format of ``built.feed``.

    Raises
    ------
    ShortOfSteps
        The simulator returned an impossible number of steps or spikes.
    """
    built.feed.samples = samples
    period = built.feed.period
    for _ in samples:
        sim.run_steps(period)
        spikes = {}
        for name, probe in built.spikes.items():
            rows = sim.data[probe]
            if len(rows) != period:
                raise ShortOfSteps(f"{len(rows)} of {period} steps of layer {name} were returned")
            spikes[name] = np.asarray(rows) != 0
            amplitude_per_step = probe.target.ensemble.neuron_type.amplitude / LOIHI.dt
            if not np.allclose(np.asarray(rows)[spikes[name]], amplitude_per_step, rtol=1e-6):
                raise ShortOfSteps(f"layer {name} had more than one spike per step and neuron")
        output = np.array(sim.data[built.output])
        sim.clear_probes()
        yield SampleOutput(output, spikes)


def record_stream(spec: NetworkSpec, built, sim, samples) -> TargetOutput:
    """Present one stream to a simulator, or to a board run by NengoLoihi, and record its output.

    Parameters
    ----------
    spec : NetworkSpec
    built : Built
        The network that ``sim`` runs.
    sim : nengo.Simulator or nengo_loihi.Simulator
        A simulator at its first step.
    samples : ndarray
        Samples as returned by `Stimulus.flatten`.

    Raises
    ------
    ShortOfSteps
        The simulator returned fewer steps than requested.
    """
    readouts: list = []
    hashes: list = []
    counts: dict = {name: [] for name in built.spikes}
    for shown in show(built, sim, samples):
        for name, rows in shown.spikes.items():
            counts[name].append(np.count_nonzero(rows, axis=0))
        hashes.append(hash_spikes(np.packbits(rows, axis=1) for rows in shown.spikes.values()))
        readouts.append(shown.output[spec.presentation.gap :])
    spikes = {name: np.array(rows) for name, rows in counts.items()}
    return TargetOutput(np.array(readouts), spikes, np.array(hashes))


def hash_spikes(packed) -> str:
    """Hash of every spike of a sample.

    Parameters
    ----------
    packed : iterable of uint8 ndarray, shape (period, n_neurons / 8)
        Spikes of each layer, in order, eight neurons per byte (`numpy.packbits`).
    """
    every_spike = hashlib.sha256()
    for rows in packed:
        every_spike.update(rows.tobytes())
    return every_spike.hexdigest()[:16]


def select_readout(spec: NetworkSpec, output: np.ndarray, first: int = 0) -> np.ndarray:
    """The readout of the section of the presentation that each step belongs to.

    Parameters
    ----------
    spec : NetworkSpec
    output : ndarray, shape (..., steps, sections * n_classes)
        The probe of the readout.
    first : int
        Number in the sample, from 0, of the first of these steps.

    Returns
    -------
    ndarray, shape (..., steps, n_classes)
    """
    readout = spec.layers[-1]
    if readout.sections == 1:
        return output
    steps = np.arange(output.shape[-2])
    by_section = output.reshape(*output.shape[:-1], readout.sections, readout.size)
    return by_section[..., steps, readout.find_section(first + steps), :]


def read_output(spec: NetworkSpec, output: np.ndarray, spikes: Optional[dict]) -> Responses:
    """Convert a target's raw output to scores and decisions.

    Parameters
    ----------
    spec : NetworkSpec
    output : ndarray, shape (n_samples, steps, n_classes)
        The readout at each step of a sample's presentation: decoded on the host, or spikes of the
        output neurons (``amplitude / dt`` in a step with a spike); see :func:`select_readout`.
    spikes : dict of str to ndarray of int, shape (n_samples, n_neurons), or None
        Number of spikes of each neuron of each spiking layer, including the gap before the sample;
        None if they are unknown: the responses then have neither spikes nor operations.

    Returns
    -------
    Responses
    """
    spikes = {} if spikes is None else spikes
    start = spec.presentation.readout_start
    limit = spec.presentation.confidence
    scores = _compute_running_means(spec, output)
    decisions = np.full(output.shape[:2], -1)
    best = np.argmax(round_scores(scores, find_score_unit(spec)), axis=2)
    empty = ~np.logical_or.accumulate((output[:, start:] != 0).any(2), axis=1)
    decisions[:, start:] = np.where(empty, -1, best)
    stopped = None
    sure = None
    if limit is not None:
        sums = _compute_sums(spec, scores)
        confidences = compute_confidence(sums, spec.estimator, start)
        stopped = start + 1 + find_decisions(sums, confidences, limit)[0]
        sure = confidences[:, -1]
    elif spec.layers[-1].neurons is None:
        sure = compute_confidence(scores[:, -1])
    if sure is not None:
        sure = np.where(empty[:, -1] | (sure == 0), np.nan, sure)
    return Responses(
        scores=round_scores(scores[:, -1], find_score_unit(spec)),
        decisions=decisions,
        spikes={name: counts.sum(axis=-1) for name, counts in spikes.items()},
        operations=spec.count_synaptic_operations(spikes) if spikes else {},
        stopped_at=stopped,
        probabilities=sure,
    )


def compute_running_sums(spec: NetworkSpec, output: np.ndarray) -> np.ndarray:
    """Accumulated readout during a sample, from which early decisions are made.

    Parameters
    ----------
    spec, output
        As in :func:`read_output`.

    Returns
    -------
    ndarray, shape (n_samples, steps - readout_start, n_classes)
        Sums of the readout from ``readout_start`` on.
    """
    return _compute_sums(spec, _compute_running_means(spec, output))


def _compute_sums(spec, means):
    """Sums, computed from the running means."""
    return round_scores(means * np.arange(1, means.shape[1] + 1)[:, None], find_score_unit(spec))


def _compute_running_means(spec, output):
    """Running means of the readout from ``readout_start`` on."""
    window = output[:, spec.presentation.readout_start :]
    totals = np.cumsum(window, axis=1)
    counts = np.arange(1, window.shape[1] + 1)
    return _compute_mean(spec, totals, counts[:, None])


def _compute_mean(spec, total, count):
    """The mean of a readout, with its bias, from a total over some steps."""
    readout = spec.layers[-1]
    bias = readout.bias if readout.neurons is None else 0.0
    return total / count + bias


class RunningReadout:
    """The accumulated readout of one sample, some steps at a time, as :func:`read_output` has it.

    Parameters
    ----------
    spec : NetworkSpec
    steps : int
        Maximum number of steps.

    Attributes
    ----------
    n_steps : int
        Number of steps so far.
    """

    def __init__(self, spec: NetworkSpec, steps: int):
        self._spec = spec
        self._unit = find_score_unit(spec)
        self._start = spec.presentation.readout_start
        classes = spec.layers[-1].size
        self._total = np.zeros((1, classes))
        self._means = np.zeros((max(steps - self._start, 0), classes))
        self._sums = np.zeros_like(self._means)
        self._confidences = np.zeros(len(self._sums))
        self._spoke = np.zeros(len(self._sums), bool)
        self.n_steps = 0

    @property
    def sums(self) -> np.ndarray:
        """Sums from ``readout_start`` on, shape (n, classes); see :func:`compute_running_sums`."""
        return self._sums[: self._n_read]

    @property
    def confidences(self) -> np.ndarray:
        """The confidence at each step from ``readout_start`` on, shape (n,)."""
        return self._confidences[: self._n_read]

    @property
    def spoke(self) -> np.ndarray:
        """False as long as the output is empty, at each step from ``readout_start`` on."""
        return self._spoke[: self._n_read]

    @property
    def _n_read(self):
        return max(self.n_steps - self._start, 0)

    def compute_scores(self, step: int) -> np.ndarray:
        """Scores of the classes after some number of steps, above ``readout_start``."""
        return round_scores(self._means[step - self._start - 1], self._unit)

    def take(self, output: np.ndarray):
        """Add the readout of the next steps.

        Parameters
        ----------
        output : ndarray, shape (steps, sections * n_classes)
        """
        done = self._n_read
        values = select_readout(self._spec, output, self.n_steps)
        window = values[max(self._start - self.n_steps, 0) :]
        self.n_steps += len(values)
        if not len(window):
            return
        new = slice(done, done + len(window))
        # A cumulative sum adds in the same order, whether it is interrupted or not.
        totals = np.cumsum(np.concatenate([self._total, window]), axis=0)[1:]
        counts = np.arange(new.start + 1, new.stop + 1)[:, None]
        self._total = totals[-1:]
        self._means[new] = _compute_mean(self._spec, totals, counts)
        self._sums[new] = round_scores(self._means[new] * counts, self._unit)
        before = self._spoke[done - 1] if done else False
        self._spoke[new] = np.logical_or.accumulate((window != 0).any(axis=1)) | before
        estimator = self._spec.estimator
        known = self._confidences[:done]
        sums = self._sums[: new.stop]
        self._confidences[new] = continue_confidence(sums, known, estimator, self._start)


def find_score_unit(spec: NetworkSpec) -> float:
    """Unit to which scores are rounded: 1, or a power of ten for a readout of unusual scale.

    Scaling all weights and biases of the readout, even by 1e-25, does not change the decisions.
    """
    readout = spec.layers[-1]
    largest = max(np.abs(readout.weights).max(initial=0), np.abs(readout.bias).max(initial=0))
    if readout.neurons is not None or largest == 0 or 1e-3 <= largest <= 1e3:
        return 1.0
    return 10.0 ** float(np.floor(np.log10(largest)))


def round_scores(scores: np.ndarray, unit: float = 1.0) -> np.ndarray:
    """Round away the last bits, so that the same spikes give the same scores on every target.

    Targets add the same spikes in different orders, which must not resolve a tie.

    Parameters
    ----------
    scores : ndarray
    unit : float
        See :func:`find_score_unit`.

    Returns
    -------
    ndarray
        Scores rounded to 1e-9 of the unit.
    """
    return np.round(scores / unit, 9) * unit


def join(by_stream) -> Responses:
    """Concatenate the responses to consecutive samples."""
    by_stream = list(by_stream)

    def concatenate(name):
        values = [getattr(responses, name) for responses in by_stream]
        if isinstance(values[0], dict):
            joined = {}
            for key in values[0]:
                joined[key] = np.concatenate([value[key] for value in values])
            return joined
        return np.concatenate(values)

    names = [entry.name for entry in fields(Responses) if entry.name != "notes"]
    for name in ("stopped_at", "probabilities", "spike_hashes"):
        if any(getattr(responses, name) is None for responses in by_stream):
            names.remove(name)
    return Responses(**{name: concatenate(name) for name in names})


def compute_seconds_per_sample(spec: NetworkSpec) -> float:
    """Duration of one sample in the stimulus's time, including the gap."""
    return spec.presentation.period * spec.stimulus.step_seconds
