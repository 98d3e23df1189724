"""A readout that learns on the chip: PES, in the integers of NengoLoihi's emulator.

The hidden neurons' spike counts of a sample are sent to an ensemble on the chip, a neuron for each
count, as evenly spaced spikes.  The ensemble's decoders start as the readout's weights.  The host
adds up the decoded output while a sample is presented; afterwards it returns the error, softmax
minus target, for a few steps, and PES (the prescribed error sensitivity; D. MacNeil and
C. Eliasmith, PLoS ONE 6, 2011) changes the weights by error times trace, a low-pass filter of the
ensemble's spikes.  It is the delta rule of logistic regression, with weights of 8 bits, traces of
7 bits, errors of 8 bits and stochastic rounding.

The spikes of a sample are few enough that no two of a neuron are in one epoch of the trace (two
steps), which would count them once.  In the gap after a sample its trace decays.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import nengo
import numpy as np

from deploy.network.build import Relay
from deploy.network.loihi_import import nengo_loihi
from deploy.network.rehearsal import Rehearsal
from fastloihi import FastSimulator
from pipeline.training.readout import Person

DT = 0.001

LATENCY = 8
"""Steps after which a spike sent by the host has reached the decoded output that the host reads."""

EPOCH = 4
"""Steps between two changes of the weights, on the chip's fixed grid."""

USUAL = 99.5
"""Percentile of the responses to training samples that is sent as the most spikes."""

LARGEST = 0.3
"""Decoded output of a spike through the largest weight, far from the range of the output."""

RATE = 1e-7
"""Learning rate of the first build, per input: with it, the trace's increment is finely resolved
and far from its limit."""

SIMULATORS = {"fast": FastSimulator, "emulator": nengo_loihi.Simulator}


@dataclass(frozen=True)
class Rule:
    """Parameters of the learning of the readout.

    Attributes
    ----------
    wgt_exp : int
        ``pes_wgt_exp``: the readout's largest weight has 128 / 2 ** wgt_exp levels at the start;
        a learning weight can reach 127 levels.  NengoLoihi's default is 4.
    steps : int
        Steps for which a sample is presented.
    gap : int
        Steps without input after each training sample, in which the trace decays.
    tau : int
        Time constant of the trace in steps.
    trace : float
        The trace after a sample in which a neuron has the maximum number of spikes.
    error : float
        Error, in integers, of a class whose target is 1 and whose probability is 0.
    passes : int
        Number of presentations of each training sample.
    rehearsal : float
        Number of rehearsal samples presented for each sample of the person.
    """

    wgt_exp: int = 1
    steps: int = 32
    gap: int = 32
    tau: int = 32
    trace: float = 110.0
    error: float = 64.0
    passes: int = 1
    rehearsal: float = 1.0

    @property
    def most(self) -> int:
        """Maximum number of spikes of a neuron in a sample."""
        return self.steps // 2

    def decayed(self, count: int) -> float:
        """A trace of increments of 1 at the end of a sample of evenly spaced spikes."""
        at = (np.arange(count) + 0.5) * self.steps / max(count, 1)
        return float(np.exp((at - self.steps) / self.tau).sum())


@dataclass(frozen=True)
class Lesson:
    """Samples in the order in which they are presented.

    Attributes
    ----------
    spikes : ndarray of int, shape (n, inputs)
        Spikes of each neuron, from 0 to :attr:`Rule.most`.
    labels : ndarray of int, shape (n,)
    errors : ndarray of float, shape (n,)
        Factor on the error of each sample; 0 for samples that are only classified.
    """

    spikes: np.ndarray
    labels: np.ndarray
    errors: np.ndarray


def learn_on_chip(
    weights,
    bias,
    person: Person,
    kept: Rehearsal,
    rest,
    scale: float,
    rule: Rule,
    seed: int = 0,
) -> tuple:
    """Train a readout on the chip on a person's samples, then classify other samples.

    Parameters
    ----------
    weights, bias
        Weights and bias of the readout; the host adds the bias.
    person : Person
        The training samples, with their augmented copies.
    kept : Rehearsal
        Responses to rehearsal samples.  The largest ones determine the count that a spike
        represents, and some are presented between the person's samples if the rule says so.
    rest : ndarray, shape (n, inputs)
        Responses to the samples to classify.
    scale : float
        Factor that converts scores to the logits of the training.
    rule : Rule
    seed : int
        Seed of the order of the samples and of the chip's stochastic rounding.

    Returns
    -------
    scores : ndarray, shape (n, classes)
        Scores of the samples to classify.
    learned : ndarray, shape (classes, inputs)
        The readout's weights on the chip afterwards.
    """
    rng = np.random.default_rng([seed, 0x9E5])
    own, labels = person.learned(np.arange(len(person)))
    order = np.concatenate([rng.permutation(len(own)) for _ in range(rule.passes)])
    mixed = rng.integers(len(kept), size=round(rule.rehearsal * len(order)))
    presented = np.concatenate([own[order], kept.responses[mixed]])
    labels = np.concatenate([labels[order], kept.labels[mixed]])
    order = rng.permutation(len(presented)) if len(mixed) else np.arange(len(presented))
    unit = max(np.percentile(kept.responses, USUAL), 1e-12) / rule.most
    responses = np.concatenate([presented[order], rest])
    lesson = Lesson(
        np.clip(np.rint(responses / unit), 0, rule.most).astype(int),
        np.concatenate([labels[order], np.zeros(len(rest), int)]),
        # Decreasing errors, so that the last samples do not have the largest effect.
        np.concatenate([1 - np.arange(len(order)) / len(order), np.zeros(len(rest))]),
    )
    scores, learned = present(
        np.asarray(weights) * scale * unit, np.asarray(bias) * scale, lesson, rule, seed
    )
    return scores[len(order) :], learned / (scale * unit)


def present(weights, bias, lesson: Lesson, rule: Rule, seed: int = 0, on: str = "fast") -> tuple:
    """Present samples to a readout on the chip that learns from them.

    Parameters
    ----------
    weights : ndarray, shape (classes, inputs)
        Logits for each spike.
    bias : ndarray, shape (classes,)
    lesson : Lesson
    rule : Rule
    seed : int
        Seed of the chip's stochastic rounding.
    on : str
        ``"fast"`` (:class:`fastloihi.simulator.FastSimulator`) or ``"emulator"``
        (NengoLoihi's own); both give the same result.

    Returns
    -------
    scores : ndarray, shape (n, classes)
        Logits of each sample when it was presented.
    learned : ndarray, shape (classes, inputs)
        The weights on the chip afterwards.
    """
    weights = np.asarray(weights)
    # A first build gives the chip's units: the largest weight in levels, and the trace's increment,
    # which is proportional to the learning rate.
    gain, first = LARGEST / max(np.abs(weights).max(), 1e-12), RATE * weights.shape[1]
    with warnings.catch_warnings():
        # Warnings about units of learning rates, and about traces and weights at their limits.
        warnings.simplefilter("ignore")
        with _Chip(weights, bias, lesson, rule, gain, first, seed).simulator("emulator") as built:
            synapse = _synapse(built)
            level = np.abs(weights).max() / max(_levels(synapse).max(), 1)
            rate = first * rule.trace / rule.decayed(rule.most) / synapse.tracing_mag
        chip = _Chip(weights, bias, lesson, rule, gain, rate, seed)
        with chip.simulator(on) as simulator:
            simulator.run_steps(chip.host.steps)
            learned = level * _levels(_synapse(simulator))[: len(weights)]
    return np.array(chip.host.answers), learned


class _Host:
    """Sends spikes, adds up the decoded output, and returns the error."""

    def __init__(self, bias, lesson, rule, gain):
        self.lesson, self.rule, self._gain, self._bias = lesson, rule, gain, bias
        pause = np.where(lesson.errors > 0, max(rule.gap, LATENCY + 2 * EPOCH), LATENCY + 2)
        self._ends = np.cumsum(rule.steps + pause)
        self.steps = int(self._ends[-1])
        self.answers, self._index, self._at = [], -1, 0
        self._next()

    def _next(self):
        self._index += 1
        if self._index < len(self.lesson.labels):
            counts = self.lesson.spikes[self._index]
            edges = np.arange(self.rule.steps + 1)[:, None] * counts / self.rule.steps + 0.5
            self._trains = np.diff(np.floor(edges), axis=0)
        self._at = 0
        self._sum = np.zeros(len(self._bias))
        self._error = np.zeros(len(self._bias))

    def spikes(self, time_s):
        """The values that are sent at a step."""
        step = round(time_s / DT) - 1
        if self._index < len(self._ends) and step >= self._ends[self._index]:
            self._next()
        at, self._at = self._at, self._at + 1
        return self._trains[at] if at < self.rule.steps else np.zeros(self._trains.shape[1])

    def error(self, _, output):
        """The values that are returned for the output of a step."""
        at = self._at - 1
        if at == self.rule.steps + LATENCY:
            scores = self._sum / self._gain + self._bias
            self.answers.append(scores)
            factor = self.lesson.errors[self._index]
            if factor > 0:
                wrong = np.exp(scores - scores.max())
                wrong /= wrong.sum()
                wrong[self.lesson.labels[self._index]] -= 1
                self._error = factor * self.rule.error * wrong
        elif at == self.rule.steps + LATENCY + EPOCH:
            self._error = np.zeros_like(self._error)
        self._sum += output
        return self._error


class _Chip:
    """The ensemble whose decoders learn; a host provides its spikes and its error."""

    def __init__(self, weights, bias, lesson, rule, gain, rate, seed):
        classes, inputs = weights.shape
        self.host = _Host(bias, lesson, rule, gain)
        self._wgt_exp, self._seed = rule.wgt_exp, seed
        units = {
            "n_neurons": inputs, "dimensions": 1, "gain": np.ones(inputs),
            "bias": np.zeros(inputs), "encoders": np.ones((inputs, 1)),
            "eval_points": np.full((2, 1), 1 / DT),
        }  # fmt: skip
        with nengo.Network(seed=seed) as self._network:
            nengo_loihi.add_params(self._network)
            source = nengo.Node(self.host.spikes, size_out=inputs)
            relay = nengo.Ensemble(neuron_type=Relay(DT), **units)
            self._network.config[relay].on_chip = False
            nengo.Connection(source, relay.neurons, synapse=None)
            spiking = nengo_loihi.neurons.LoihiSpikingRectifiedLinear()
            ensemble = nengo.Ensemble(neuron_type=spiking, **units)
            once = nengo.Dense((inputs, inputs), init=1.1 / DT * np.eye(inputs))
            nengo.Connection(relay.neurons, ensemble.neurons, transform=once, synapse=None)
            host = nengo.Node(self.host.error, size_in=classes, size_out=classes)
            readout = nengo.Connection(
                ensemble, host, synapse=None, function=lambda x: np.zeros(classes),
                solver=nengo.solvers.NoSolver(gain * DT * weights.T),
                learning_rule_type=nengo.PES(rate, pre_synapse=nengo.Lowpass(rule.tau * DT)),
            )  # fmt: skip
            nengo.Connection(host, readout.learning_rule, synapse=None)

    def simulator(self, on):
        """A simulator of the network, see :data:`SIMULATORS`."""
        model = nengo_loihi.builder.Model(dt=DT)
        model.pes_wgt_exp, model.pes_error_scale = self._wgt_exp, 1.0
        return SIMULATORS[on](
            self._network, model=model, target="sim", progress_bar=False, seed=self._seed
        )


def _synapse(simulator):
    """The learning synapse."""
    (synapse,) = simulator.sims["emulator"].synapses.pes_errors
    return synapse


def _levels(synapse):
    """Weights of the learning synapse in levels, shape (2 * classes, inputs): first on neurons."""
    form = synapse.synapse_cfg
    unit = 2.0 ** (form.real_weight_exp + form.shift_bits)
    return np.concatenate(synapse.weights).T / unit
