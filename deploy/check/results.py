"""The result of a check: its JSON schema, validation, and comparison."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from typing import List, Optional

import nengo
import numpy as np

from .. import __version__
from ..errors import CheckFailed, UserError
from ..files import read_json
from ..network.decision import share_of_time
from ..network.loihi_import import nengo_loihi
from ..network.operations import multiply_accumulates
from ..network.stimulus import last_steps
from ..terminal import WARNING
from .intervals import mcnemar, wilson_interval

SCHEMA = "stmnist-check/1"

PUBLISHED = ("id", "label", "prediction", "scores", "stable_after", "stopped_at", "spike_hash")
"""Fields of a sample in a result.  The last two only exist with a confidence for early decisions,
and for targets that record single spikes."""

SHARES = tuple(tenths / 10 for tenths in range(1, 11))
"""Shares of the writing time at which the accuracy is computed."""


def versions() -> dict:
    """Versions of the software that computed a result."""
    return {
        "stmnist": __version__,
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
        One dict per sample of the bundle's check, in order: ``id``, ``label``, ``prediction``,
        ``scores``, ``stable_after`` (None without a decision), ``decisions`` (at each step),
        ``spikes`` and ``operations`` (of each layer).
    wall_seconds : float
        Time spent on the samples, over all sessions.
    extra : dict, optional
        Further fields from the target, such as the board; its ``versions`` are merged.

    Returns
    -------
    dict
        Ready for JSON.
    """
    presentation = bundle.spec.presentation
    labels = np.array([sample["label"] for sample in samples])
    decisions = np.array([sample["decisions"] for sample in samples])
    decisions[:, -1] = [sample["prediction"] for sample in samples]  # also of an empty output
    right = decisions == labels[:, None]
    correct = int(right[:, -1].sum())
    stable = [sample["stable_after"] for sample in samples if sample["stable_after"] is not None]
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
        "stable_after_median": float(np.median(stable)) if stable else None,
        "anytime_accuracy": [float(share) for share in right.mean(0)],
        **_while_written(bundle, decisions, labels, samples),
        "samples": [{key: sample[key] for key in PUBLISHED if key in sample} for sample in samples],
        "spikes": total("spikes"),
        "synaptic_operations": total("operations"),
        "multiply_accumulates": multiply_accumulates(bundle.spec),
        "wall_seconds": wall_seconds,
        "versions": {**versions(), **extra.pop("versions", {})},
        **extra,
    }


def _while_written(bundle, decisions, labels, samples) -> dict:
    """Accuracy while a sample is still being written; for event frames only.

    A step without a decision counts as a wrong answer.

    Writing ends with the sample's last event; steps after the end count as the last step.
    """
    spec = bundle.spec
    if spec.stimulus.static:
        return {}
    written = last_steps(bundle.checks.inputs) + 1
    everyone = np.arange(len(labels))

    def right_at(steps):
        return decisions[everyone, np.minimum(steps, decisions.shape[1]) - 1] == labels

    value = {
        "step_ms": 1000 * spec.stimulus.step_seconds,
        "written_steps_mean": float(written.mean()),
        "shares": list(SHARES),
        "accuracy": [float(right_at(np.ceil(s * written).astype(int)).mean()) for s in SHARES],
    }
    if all("stopped_at" in sample for sample in samples):
        stopped = np.array([sample["stopped_at"] for sample in samples])
        right = right_at(stopped)
        value["by_itself"] = {
            "confidence": spec.presentation.confidence,
            "accuracy": float(right.mean()),
            "accuracy_ci95": list(wilson_interval(int(right.sum()), len(right))),
            "share_of_writing_mean": float(share_of_time(stopped - 1, written - 1).mean()),
            "before_the_end": float((stopped < written).mean()),
        }
    return {"while_written": value}


def read_result(path, remedy="run 'stmnist check run' again") -> dict:
    """Read and validate a result.

    Parameters
    ----------
    path : path-like
    remedy : str
        The user's remedy for a missing or damaged file, at the end of the error message.

    Raises
    ------
    UserError
        The file is missing, damaged, of another schema, or inconsistent.
    """
    result = read_json(path, remedy)
    if result.get("schema") != SCHEMA:
        raise UserError(
            f"{path}: schema {result.get('schema')!r}, but this version reads {SCHEMA!r}; {remedy}"
        )
    for name, fits in _FIELDS.items():
        if not fits(result[name]) if name in result else name not in _OPTIONAL:
            raise UserError(
                f"{path}: not a complete check result ({name!r} is missing or wrong); {remedy}"
            )
    samples = result["samples"]
    for index, sample in enumerate(samples):
        if not _is_sample(sample):
            raise UserError(f"{path}: not a complete check result (sample {index + 1}); {remedy}")
    right = sum(sample["label"] == sample["prediction"] for sample in samples)
    sound = (
        len(samples) == result["n_samples"]
        and len({sample["id"] for sample in samples}) == len(samples)
        and len({len(sample["scores"]) for sample in samples}) == 1
        and abs(right / len(samples) - result["accuracy"]) < 1e-9
    )
    if not sound:
        raise UserError(f"{path}: its samples contradict each other or its accuracy; {remedy}")
    return result


def _is_count(value, below=2**53):
    return type(value) is int and 0 <= value < below


def _is_number(value):
    return type(value) in (int, float) and -1e300 <= value <= 1e300  # False for NaN


def _are_numbers(values):
    return isinstance(values, list) and all(map(_is_number, values))


def _is_text(value):
    try:
        return isinstance(value, str) and len(value.encode("utf-8")) <= 10_000
    except UnicodeEncodeError:
        return False


def _are_counts(values):
    """True for counts by layer."""
    return isinstance(values, dict) and all(_is_number(v) and v >= 0 for v in values.values())


def is_share(value) -> bool:
    """True if a value is a number from 0 to 1."""
    return _is_number(value) and 0 <= value <= 1


def _are_shares(values):
    return isinstance(values, list) and all(map(is_share, values))


def _is_while_written(value):
    if not isinstance(value, dict):
        return False
    shares, accuracy = value.get("shares"), value.get("accuracy")
    return (
        _are_shares(shares)
        and _are_shares(accuracy)
        and len(shares) == len(accuracy) > 0
        and _is_number(value.get("step_ms"))
        and _is_number(value.get("written_steps_mean"))
        and ("by_itself" not in value or _is_by_itself(value["by_itself"]))
    )


def _is_by_itself(value):
    names = ("confidence", "accuracy", "share_of_writing_mean", "before_the_end")
    return (
        isinstance(value, dict)
        and all(is_share(value.get(name)) for name in names)
        and _are_shares(value.get("accuracy_ci95"))
        and len(value["accuracy_ci95"]) == 2
    )


def _is_part(value):
    """True for valid results on the samples of a class or of a writer."""
    return (
        isinstance(value, dict)
        and _is_count(value.get("n"))
        and is_share(value.get("accuracy"))
        and _are_shares(value.get("accuracy_ci95"))
        and len(value["accuracy_ci95"]) == 2
    )


_FIELDS = {
    "bundle": _is_text,
    "target": _is_text,
    "n_samples": _is_count,
    "samples": lambda v: isinstance(v, list) and len(v) >= 1,
    "accuracy": _is_number,
    "accuracy_ci95": lambda v: _are_numbers(v) and len(v) == 2,
    "stable_after_median": lambda v: v is None or _is_number(v),
    "anytime_accuracy": _are_numbers,
    "steps_per_sample": _is_count,
    "simulated": lambda v: v is None or isinstance(v, bool),
    "spikes": _are_counts,
    "synaptic_operations": _are_counts,
    "wall_seconds": lambda v: _is_number(v) and v >= 0,
    "versions": lambda v: isinstance(v, dict) and all(map(_is_text, v.values())),
    "while_written": _is_while_written,
    "data": lambda v: (
        isinstance(v, dict)
        and all(_is_text(v.get(name)) for name in ("source", "sha256"))
        and _is_count(v.get("recordings"))
    ),
    "classes": lambda v: isinstance(v, list) and all(map(_is_text, v)),
    "confusion": lambda v: (
        isinstance(v, list)
        and all(
            isinstance(row, list) and len(row) == len(v) and all(map(_is_count, row)) for row in v
        )
    ),
    "per_class": lambda v: isinstance(v, list) and all(map(_is_part, v)),
    "per_writer": lambda v: isinstance(v, list) and all(map(_is_part, v)),
}
"""Fields that are read from a result, with their validation."""

_OPTIONAL = {"while_written", "data", "classes", "confusion", "per_class", "per_writer"}
"""Fields that exist for networks on events, or for results on other recordings."""


def _is_sample(value):
    if not isinstance(value, dict) or not _are_numbers(value.get("scores")):
        return False
    classes = len(value["scores"])
    return (
        _is_text(value.get("id"))
        and _is_count(value.get("label"), classes)
        and _is_count(value.get("prediction"), classes)
        and (value.get("stable_after") is None or _is_count(value["stable_after"]))
        and ("stopped_at" not in value or _is_count(value["stopped_at"]))
        and ("spike_hash" not in value or _is_text(value["spike_hash"]))
    )


@dataclass(frozen=True)
class Comparison:
    """Comparison of two results on the same samples.

    Attributes
    ----------
    targets : tuple of str
        Targets of A and B.
    accuracies : tuple of float
    n_samples : int
    disagreements : list of dict
        Samples with different predictions: ``id``, ``label``, ``a``, ``b``.
    p_value : float
        McNemar's exact test on right and wrong predictions.
    other_spikes : int or None
        Number of samples in which any spike of any layer differs; None if a result has no spike
        hashes.
    """

    targets: tuple
    accuracies: tuple
    n_samples: int
    disagreements: List[dict]
    p_value: float
    other_spikes: Optional[int] = None

    @property
    def accuracy_drop(self) -> float:
        """Accuracy of A minus that of B."""
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

    Parameters
    ----------
    a, b : dict
        See :func:`result_of`.

    Raises
    ------
    UserError
        They are of different bundles or of different samples.
    """
    if a["bundle"] != b["bundle"] and not _are_of_the_same_data(a, b):
        raise UserError(
            f"the results are of different bundles ({a['bundle'][:12]} and {b['bundle'][:12]}); "
            "run both checks on the same bundle"
        )
    of_a, of_b = ([(s["id"], s["label"]) for s in result["samples"]] for result in (a, b))
    if of_a != of_b:
        remedy = "on the same bundle"
        if "data" in a or "data" in b:
            remedy = "with the same --data, --samples and --seed"
        raise UserError(f"the results are of different samples; run both checks {remedy}")
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


ALARMING = 0.01
"""McNemar's p below which a lower accuracy causes a warning.  It is lower than the 0.05 of tables,
because every check of every target is compared."""


def loss_text(reference: dict, result: dict) -> Optional[str]:
    """A message if a target is significantly less accurate than the trained network.

    Parameters
    ----------
    reference : dict
        The trained network's answers to the same samples.
    result : dict

    Returns
    -------
    str or None
        None if the difference is not significant (p of :data:`ALARMING` or more).

    Raises
    ------
    UserError
        The results are of different bundles or of different samples.
    """
    compared = compare_results(reference, result)
    if compared.accuracy_drop <= 0 or compared.p_value >= ALARMING:
        return None
    own, found = compared.accuracies
    return WARNING + (
        f"{result['target']} is significantly less accurate than {reference['target']} on the same "
        f"samples: {found:.3f} instead of {own:.3f} (McNemar p = {compared.p_value:.2g}, "
        f"below {ALARMING:g})"
    )


def require_limits(
    max_disagreements: Optional[int] = None, max_accuracy_drop: Optional[float] = None
):
    """Refuse invalid limits of a comparison.

    Raises
    ------
    UserError
        A limit is negative, or a share is not a number up to 1.  With NaN no drop would exceed the
        limit.
    """
    if max_disagreements is not None and max_disagreements < 0:
        raise UserError(f"--max-disagreements {max_disagreements}: must be at least 0")
    if max_accuracy_drop is not None and not 0 <= max_accuracy_drop <= 1:
        raise UserError(f"--max-accuracy-drop {max_accuracy_drop:g}: must be from 0 to 1")


def _are_of_the_same_data(a, b):
    """True if two results are of the same other recordings (``check run --data``)."""
    of_a, of_b = (result.get("data") for result in (a, b))
    return bool(of_a) and bool(of_b) and of_a["sha256"] == of_b["sha256"]


def enforce(
    comparison: Comparison,
    max_disagreements: Optional[int] = None,
    max_accuracy_drop: Optional[float] = None,
):
    """Raise an error if a comparison exceeds a limit.

    Parameters
    ----------
    comparison : Comparison
    max_disagreements : int, optional
    max_accuracy_drop : float, optional
        Maximum of A's accuracy minus B's.

    Raises
    ------
    CheckFailed
        A limit is exceeded; the message names it.
    UserError
        See :func:`require_limits`.
    """
    require_limits(max_disagreements, max_accuracy_drop)
    count = len(comparison.disagreements)
    if max_disagreements is not None and count > max_disagreements:
        raise CheckFailed(f"{count} disagreements, more than the {max_disagreements} allowed")
    # An accuracy is a fraction of n samples: differences below 5e-7 are rounding.
    if max_accuracy_drop is not None and comparison.accuracy_drop > max_accuracy_drop + 5e-7:
        raise CheckFailed(
            f"accuracy drops by {comparison.accuracy_drop:.4f}, "
            f"more than the {max_accuracy_drop:g} allowed"
        )
