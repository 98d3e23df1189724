"""The responses of a network to samples: scores and decisions from the output of a target.

A run of a target over samples gives, for each sample, the output at each of its steps.  The score
of a class at a step is the mean of its output from ``readout_start`` up to that step (plus the
readout's bias); the decision at a step is the class with the highest score.  As long as no spike
has reached the readout, its output is empty and there is no decision.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Dict, Optional

import numpy as np

from .decision import compute_confidence, find_decisions
from .output import TargetOutput
from .readout import (
    compute_running_means,
    find_score_unit,
    round_scores,
    select_readout,
    sum_running_means,
)
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


def make_responses(
    spec: NetworkSpec, output: TargetOutput, n_samples: int, target: str
) -> Responses:
    """Refuse what no target may yield for a stream, and read scores and decisions from it.

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
    output.require_shapes(spec, n_samples, target)
    readout = np.asarray(output.readout, float)
    if readout.shape[-1] != spec.layers[-1].size:
        readout = select_readout(spec, readout)
    responses = compute_responses(spec, readout, output.spikes)
    return replace(responses, spike_hashes=output.spike_hashes, notes=output.notes)


def compute_responses(spec: NetworkSpec, output: np.ndarray, spikes: Optional[dict]) -> Responses:
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
    threshold = spec.presentation.threshold
    scores = compute_running_means(spec, output)
    decisions = np.full(output.shape[:2], -1)
    best = np.argmax(round_scores(scores, find_score_unit(spec)), axis=2)
    empty = ~np.logical_or.accumulate((output[:, start:] != 0).any(2), axis=1)
    decisions[:, start:] = np.where(empty, -1, best)
    stopped = None
    confidence = None
    if threshold is not None:
        sums = sum_running_means(spec, scores)
        confidences = compute_confidence(sums, spec.estimator, start)
        stopped = start + 1 + find_decisions(sums, confidences, threshold)[0]
        confidence = confidences[:, -1]
    elif spec.layers[-1].neurons is None:
        confidence = compute_confidence(scores[:, -1])
    if confidence is not None:
        confidence = np.where(empty[:, -1] | (confidence == 0), np.nan, confidence)
    return Responses(
        scores=round_scores(scores[:, -1], find_score_unit(spec)),
        decisions=decisions,
        spikes={name: counts.sum(axis=-1) for name, counts in spikes.items()},
        operations=spec.count_synaptic_operations(spikes) if spikes else {},
        stopped_at=stopped,
        probabilities=confidence,
    )


def join_responses(by_stream) -> Responses:
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
