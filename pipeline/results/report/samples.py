"""Replay some samples of a check, with every spike and the probabilities at each step."""

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from deploy.check.bundle import Bundle
from deploy.check.results import CheckResult
from deploy.network.decision import compute_confidence, compute_probabilities, decide
from deploy.network.readout import compute_running_sums, select_readout
from deploy.targets.emulation import Emulation

# Number of classes whose probability is drawn: the decision, the prediction at the end, the right
# one, and rivals.
N_DRAWN_CLASSES = 4


class Spikes(NamedTuple):
    """The spikes of a layer, or of the input, in a sample.

    Attributes
    ----------
    name, unit : str
        Name of the layer, and of what has a row each, such as ``"neurons"``.
    size : int
        Number of rows.
    groups : tuple of (str, ndarray of int, ndarray of int)
        Colour, the step of each spike, from 0 at the start of the presentation, and its row.
    """

    name: str
    unit: str
    size: int
    groups: tuple


@dataclass(frozen=True)
class Replay:
    """A sample on the chip, as the target ``fast`` computes it.

    Attributes
    ----------
    layers : tuple of Spikes
    probabilities : ndarray of float, shape (steps - readout_start, classes)
        Probabilities of the classes at each step; the largest is the confidence.
    decided, prediction : int
        Index in ``probabilities`` of the decision, the last one if none is early, and its class.
    """

    layers: tuple
    probabilities: np.ndarray
    decided: int
    prediction: int

    def __repr__(self):
        layers = ", ".join(layer.name for layer in self.layers)
        return f"Replay(class {self.prediction}, decided at {self.decided}; spikes of {layers})"

    def choose_classes(self, label: int) -> list:
        """The classes whose probability is drawn, for a sample of a class."""
        top = np.argsort(-self.probabilities[self.decided], kind="stable").tolist()
        drawn = dict.fromkeys([top[0], int(self.probabilities[-1].argmax()), label, *top])
        return list(drawn)[:N_DRAWN_CLASSES]


def choose_samples(result: CheckResult, wrong: int = 8, right: int = 2) -> list:
    """Indices of samples to replay: mistakes, the most frequent first, then right ones."""
    samples = result.samples
    rights = [i for i, s in enumerate(samples) if s.is_right]
    pairs = [(s.label, s.prediction) for s in samples]
    mistakes = [i for i, (label, prediction) in enumerate(pairs) if label != prediction]
    often = Counter(pairs)
    mistakes = sorted(mistakes, key=lambda i: (-often[pairs[i]], pairs[i]))[:wrong]
    first = {samples[i].label: i for i in reversed(rights)}  # of each class
    mixed = [number for i in mistakes for number in pairs[i]]
    order = [*(first[label] for label in mixed if label in first), *sorted(first.values()), *rights]
    return mistakes + list(dict.fromkeys(order))[:right]


def replay_samples(bundle: Bundle, indices, seed: int = 0, advance=None) -> dict:
    """Run some samples of the check again, each with those before it in its stream.

    The state that previous samples leave matters, so a stream is run from its start.

    Parameters
    ----------
    bundle : Bundle
    indices : sequence of int
    seed : int
    advance : callable, optional
        Called with the number of samples done since the last call.

    Returns
    -------
    dict of int to Replay
        In the order of ``indices``.
    """
    spec = bundle.spec
    chosen = set(indices)
    replays = {}
    emulation = Emulation(spec, seed)
    presentation = spec.presentation
    sizes = {"input": int(np.prod(spec.input_shape))}
    sizes |= {layer.name: layer.size for layer in spec.layers}
    for stream in presentation.list_streams(len(bundle.checks)):
        here = sorted(chosen & set(range(stream.start, stream.stop)))
        if not here:
            continue
        packed: list[dict] = []
        samples = spec.stimulus.flatten(bundle.checks.inputs[stream.start : here[-1] + 1])
        samples = np.asarray(samples)[None]
        output = emulation.run(samples, packed.append).output[0]
        sums = compute_running_sums(spec, select_readout(spec, output[:, presentation.gap :]))
        threshold = presentation.threshold_or_1
        decided, predictions = decide(sums, threshold, spec.estimator, presentation.readout_start)
        if (
            spec.stimulus.is_static and threshold == 1
        ):  # trained on means, without a threshold for sums
            sums = sums / np.arange(1, sums.shape[1] + 1)[:, None]
        probabilities = compute_probabilities(
            sums, compute_confidence(sums, spec.estimator, presentation.readout_start)
        )
        for index in here:
            layers = []
            for name in spec.spiking_layers:
                bits = packed[index - stream.start][name][0, presentation.gap :]
                steps, neurons = np.nonzero(np.unpackbits(bits, axis=1, count=sizes[name]))
                layers.append(_draw_layer_spikes(spec, name, sizes[name], steps, neurons))
            at = index - stream.start
            replays[index] = Replay(
                tuple(layers), probabilities[at], int(decided[at]), int(predictions[at])
            )
            if advance is not None:
                advance(1)
    return {index: replays[index] for index in indices}


def _draw_layer_spikes(spec, name, size, steps, neurons):
    if name != "input" or spec.stimulus.is_static:
        return Spikes(name, "neurons", size, (("s1", steps, neurons),))
    taxels = neurons // 2
    is_on = neurons % 2 == 0
    groups = (("on", steps[is_on], taxels[is_on]), ("off", steps[~is_on], taxels[~is_on]))
    return Spikes(name, "taxels", size // 2, groups)
