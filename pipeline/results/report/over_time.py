"""Probabilities of the classes at each step of a sample, from the network on the chip."""

from __future__ import annotations

import numpy as np

from deploy.check.bundle import Bundle
from deploy.network.responses import running_sums
from deploy.network.stream import streams_of
from deploy.targets.fast.emulation import Emulation, compile_spec


def softmax(scores) -> np.ndarray:
    """Probabilities of the classes from outputs that were trained as logits, over the last axis."""
    scores = np.asarray(scores, float)
    powers = np.exp(scores - scores.max(axis=-1, keepdims=True))
    return powers / powers.sum(axis=-1, keepdims=True)


def final_probabilities(spec, scores) -> np.ndarray:
    """Probabilities at the end of a sample.

    Parameters
    ----------
    spec : NetworkSpec
    scores : array_like, shape (..., classes)
        Scores of a check's result: means over the steps.  Training on events uses their sum.
    """
    steps = 1 if spec.stimulus.static else spec.presentation.steps - spec.presentation.readout_start
    return softmax(steps * np.asarray(scores, float))


def probabilities(bundle: Bundle, indices, seed: int = 0) -> dict:
    """Probabilities of the classes at each step of some samples of the check.

    Computed with target ``fast``, whose integers are those of NengoLoihi's emulator.

    Parameters
    ----------
    bundle : Bundle
    indices : sequence of int
    seed : int

    Returns
    -------
    dict of int to ndarray of float, shape (steps - readout_start, classes)
        In the order of ``indices``.
    """
    spec, wanted, found = bundle.spec, set(indices), {}
    emulation, shown = Emulation(compile_spec(spec, seed)), spec.presentation
    for part in streams_of(len(bundle.checks), shown.stream_length):
        mine = sorted(wanted & set(range(part.start, part.stop)))
        if not mine:
            continue
        # The state that previous samples leave matters, so the stream is run from its start.
        samples = spec.stimulus.flat(bundle.checks.inputs[part.start : mine[-1] + 1])
        output = emulation.run(np.asarray(samples)[None], shown.steps, shown.gap).output[0]
        sums = running_sums(spec, output[:, shown.gap :])
        if spec.stimulus.static:
            sums = sums / np.arange(1, sums.shape[1] + 1)[:, None]
        chances = softmax(sums)
        found |= {index: chances[index - part.start] for index in mine}
    return {index: found[index] for index in indices}
