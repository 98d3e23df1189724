"""The result of a check: its JSON schema, reading it back, and comparing two."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from typing import List, Optional

import nengo
import numpy as np

from ..errors import UserError
from ..files import read_json
from ..network.loihi_import import nengo_loihi
from ..network.operations import multiply_accumulates
from .intervals import mcnemar, wilson_interval

SCHEMA = "stmnist-check/1"

PUBLISHED = ("id", "label", "prediction", "scores", "decided_at", "spike_hash")
"""What a result says of each sample; the last from targets that keep single spikes."""


def versions() -> dict:
    """Versions of what computed a result."""
    return {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "nengo": nengo.__version__,
        "nengo_loihi": nengo_loihi.__version__,
    }


def result_of(bundle, target, seed, samples, wall_seconds, extra=None) -> dict:
    """Assemble a result from its samples.

    Parameters
    ----------
    bundle : Bundle
    target : str
    seed : int
    samples : list of dict
        One a sample of the bundle's check, in its order: ``id``, ``label``, ``prediction``,
        ``scores``, ``decided_at``, ``decisions`` (each step's), ``spikes`` and ``operations`` (each
        layer's).
    wall_seconds : float
        Time spent on the samples, over all sessions.
    extra : dict, optional
        What only this target can say, such as the board; ``versions`` in it are added to ours.

    Returns
    -------
    dict
        Ready for JSON.
    """
    presentation = bundle.spec.presentation
    labels = np.array([sample["label"] for sample in samples])
    decisions = np.array([sample["decisions"] for sample in samples])
    right = decisions == labels[:, None]
    correct = int(right[:, -1].sum())
    extra = dict(extra or {})

    def total(name):
        return {layer: sum(s[name][layer] for s in samples) for layer in samples[0][name]}

    return {
        "schema": SCHEMA,
        "target": target,
        "bundle": bundle.id,
        "seed": seed,
        "simulated": bundle.spec.provenance.get("simulated"),
        "steps_per_sample": presentation.steps,
        "n_samples": len(samples),
        "accuracy": correct / len(samples),
        "accuracy_ci95": list(wilson_interval(correct, len(samples))),
        "decided_at_median": float(np.median([sample["decided_at"] for sample in samples])),
        "anytime_accuracy": [float(share) for share in right.mean(0)],
        "samples": [{key: sample[key] for key in PUBLISHED if key in sample} for sample in samples],
        "spikes": total("spikes"),
        "synaptic_operations": total("operations"),
        "multiply_accumulates": multiply_accumulates(bundle.spec),
        "wall_seconds": wall_seconds,
        "versions": {**versions(), **extra.pop("versions", {})},
        **extra,
    }


def read_result(path, remedy="run 'stmnist check run' again") -> dict:
    """Read a result and make sure that it is one.

    Parameters
    ----------
    path : path-like
    remedy : str
        What the user can do if the file is missing or damaged; ends the error's line.

    Raises
    ------
    UserError
        The file is missing, damaged, of another schema, or contradicts itself.
    """
    result = read_json(path, remedy)
    if result.get("schema") != SCHEMA:
        raise UserError(
            f"{path}: schema {result.get('schema')!r}, but this version reads {SCHEMA!r}; {remedy}"
        )
    try:
        samples = result["samples"]
        right = sum(int(sample["label"]) == int(sample["prediction"]) for sample in samples)
        sound = (
            len(samples) == result["n_samples"]
            and len({sample["id"] for sample in samples}) == len(samples)
            and abs(right / len(samples) - result["accuracy"]) < 1e-9
            and isinstance(result["bundle"], str)
            and isinstance(result["target"], str)
            and len([float(bound) for bound in result["accuracy_ci95"]]) == 2
            and {"simulated", "spikes", "wall_seconds", "steps_per_sample"} <= result.keys()
        )
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise UserError(f"{path}: not a whole check result ({error!r}); {remedy}") from error
    if not sound:
        raise UserError(f"{path}: its samples and its accuracy contradict each other; {remedy}")
    return result


@dataclass(frozen=True)
class Comparison:
    """Two results of the same samples, side by side.

    Attributes
    ----------
    targets : tuple of str
        A's and B's.
    accuracies : tuple of float
    n_samples : int
    disagreements : list of dict
        Samples with different predictions: ``id``, ``label``, ``a``, ``b``.
    p_value : float
        McNemar's exact test on right against wrong.
    other_spikes : int or None
        Samples in which not every spike of every layer is the same; None where a result does not
        tell.
    """

    targets: tuple
    accuracies: tuple
    n_samples: int
    disagreements: List[dict]
    p_value: float
    other_spikes: Optional[int] = None

    @property
    def accuracy_drop(self) -> float:
        """Accuracy of A less that of B."""
        return self.accuracies[0] - self.accuracies[1]

    def to_json(self) -> dict:
        """The comparison as plain values."""
        return {
            "targets": list(self.targets),
            "accuracies": list(self.accuracies),
            "accuracy_drop": self.accuracy_drop,
            "n_samples": self.n_samples,
            "n_disagreements": len(self.disagreements),
            "mcnemar_p": self.p_value,
            "other_spikes": self.other_spikes,
            "disagreements": self.disagreements,
        }


def compare_results(a: dict, b: dict) -> Comparison:
    """Compare two results sample by sample.

    Raises
    ------
    UserError
        They are of different bundles or of different samples.
    """
    if a["bundle"] != b["bundle"]:
        raise UserError(
            f"the results are of different bundles ({a['bundle'][:12]} and {b['bundle'][:12]}); "
            "run both checks on the same bundle"
        )
    of_a, of_b = ([(s["id"], s["label"]) for s in result["samples"]] for result in (a, b))
    if of_a != of_b:
        raise UserError("the results are of different samples; run both checks on the same bundle")
    pairs = list(zip(a["samples"], b["samples"]))
    told = all("spike_hash" in sample for pair in pairs for sample in pair)
    right = [[s["prediction"] == s["label"] for s in result["samples"]] for result in (a, b)]
    return Comparison(
        targets=(a["target"], b["target"]),
        accuracies=(a["accuracy"], b["accuracy"]),
        n_samples=len(pairs),
        disagreements=[
            {"id": x["id"], "label": x["label"], "a": x["prediction"], "b": y["prediction"]}
            for x, y in pairs
            if x["prediction"] != y["prediction"]
        ],
        p_value=mcnemar(*right),
        other_spikes=sum(x["spike_hash"] != y["spike_hash"] for x, y in pairs) if told else None,
    )
