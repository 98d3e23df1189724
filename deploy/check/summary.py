"""Summarise the samples of a check as its result."""

from __future__ import annotations

import platform
from importlib import metadata
from typing import Optional

import numpy as np

from .. import __version__
from ..loading import load_dataclass
from ..network.decision import compute_share_of_time
from ..network.provenance import read_classes
from ..network.stimulus import find_last_steps
from .intervals import compute_wilson_interval
from .results import CheckResult, EarlyDecisions, SampleResult, WhileWritten

# Shares of the writing time at which the accuracy is computed.
SHARES = tuple(tenths / 10 for tenths in range(1, 11))


def list_versions() -> dict:
    """Versions of the software that computed a result."""
    return {
        "stmnist": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "nengo": _find_version("nengo"),
        "nengo_loihi": _find_version("nengo-loihi"),
    }


def _find_version(package):
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:  # a target need not use it
        return "not installed"


def make_result(
    bundle, target: str, seed: int, samples, wall_seconds: float, versions=None
) -> CheckResult:
    """Summarise the samples of a check.

    Parameters
    ----------
    bundle : Bundle
    target : str
    seed : int
    samples : list of dict
        One dict per sample of the bundle's check, in order: ``id``, ``label``, ``prediction``,
        ``scores``, ``decisions`` (at each step),
        ``spikes`` and ``operations`` (of each layer).
    wall_seconds : float
        Time spent on the samples, over all sessions.
    versions : dict of str to str, optional
        Versions of other software that computed the result.
    """
    labels = np.array([sample["label"] for sample in samples])
    decisions = np.array([sample["decisions"] for sample in samples])
    decisions[:, -1] = [sample["prediction"] for sample in samples]  # also of an empty output
    right = decisions == labels[:, None]
    n_right = int(right[:, -1].sum())
    return CheckResult(
        target=target,
        bundle_id=bundle.id,
        seed=seed,
        simulated=bundle.spec.provenance.simulated,
        steps_per_sample=bundle.spec.presentation.steps,
        n_samples=len(samples),
        classes_without_samples=_find_classes_without_samples(bundle.spec, labels),
        accuracy=n_right / len(samples),
        accuracy_ci95=list(compute_wilson_interval(n_right, len(samples))),
        anytime_accuracy=[float(share) for share in right.mean(0)],
        while_written=_measure_while_written(bundle, decisions, labels, samples),
        samples=[load_dataclass(SampleResult, sample, ignore_extra=True) for sample in samples],
        spikes=_sum_by_layer(samples, "spikes"),
        synaptic_operations=_sum_by_layer(samples, "operations"),
        multiply_accumulates=bundle.spec.multiply_accumulates,
        wall_seconds=wall_seconds,
        versions={**list_versions(), **(versions or {})},
    )


def _sum_by_layer(samples, name) -> dict:
    """The counts of all samples together, by layer."""
    totals = dict.fromkeys(samples[0][name], 0)
    for sample in samples:
        for layer in totals:
            totals[layer] += sample[name][layer]
    return totals


def _find_classes_without_samples(spec, labels) -> list:
    """Names of the classes of which there is no sample: their accuracy is unknown."""
    presented = set(labels.tolist())
    return [name for label, name in enumerate(read_classes(spec)) if label not in presented]


def _measure_while_written(bundle, decisions, labels, samples) -> Optional[WhileWritten]:
    """Accuracy during the recording of a sample; for event frames only.

    A step without a decision counts as a wrong answer.

    A recording ends with the sample's last event; steps after the end count as the last step.
    """
    spec = bundle.spec
    if spec.stimulus.is_static:
        return None
    written = find_last_steps(bundle.checks.inputs) + 1
    rows = np.arange(len(labels))

    def find_right_at(steps):
        return decisions[rows, np.minimum(steps, decisions.shape[1]) - 1] == labels

    early = None
    if all("stopped_at" in sample for sample in samples):
        stopped = np.array([sample["stopped_at"] for sample in samples])
        right = find_right_at(stopped)
        early = EarlyDecisions(
            confidence=spec.presentation.threshold,
            accuracy=float(right.mean()),
            accuracy_ci95=list(compute_wilson_interval(int(right.sum()), len(right))),
            share_of_writing_mean=float(compute_share_of_time(stopped - 1, written - 1).mean()),
            before_the_end=float((stopped < written).mean()),
        )
    return WhileWritten(
        step_ms=1000 * spec.stimulus.step_seconds,
        written_steps_mean=float(written.mean()),
        shares=list(SHARES),
        accuracy=[float(find_right_at(np.ceil(s * written).astype(int)).mean()) for s in SHARES],
        early=early,
    )
