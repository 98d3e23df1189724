"""The result of a check: its JSON schema, validation, and comparison."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from importlib import metadata
from typing import Dict, List, Optional

import numpy as np

from .. import __version__
from ..errors import CheckFailed, UserError
from ..files import read_json
from ..loading import Limit, WrongValue, between, limited_field, load_dataclass
from ..network.decision import compute_share_of_time
from ..network.provenance import read_classes
from ..network.stimulus import find_last_steps
from ..terminal import WARNING
from .intervals import compute_mcnemar_p, compute_wilson_interval

SCHEMA = "stmnist-check/1"

# Fields of a sample in a result. The last two only exist with a confidence for early decisions, and
# for targets that record single spikes.
PUBLISHED = ("id", "label", "prediction", "scores", "stopped_at", "spike_hash")

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


def make_result(bundle, target, seed, samples, wall_seconds, extra=None) -> dict:
    """Assemble a result from its samples.

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
    extra = dict(extra or {})

    return {
        "schema": SCHEMA,
        "target": target,
        "bundle": bundle.id,
        "seed": seed,
        "simulated": bundle.spec.provenance.simulated,
        "steps_per_sample": presentation.steps,
        "n_samples": len(samples),
        "classes_without_samples": _find_classes_without_samples(bundle.spec, labels),
        "accuracy": correct / len(samples),
        "accuracy_ci95": list(compute_wilson_interval(correct, len(samples))),
        "anytime_accuracy": [float(share) for share in right.mean(0)],
        **_measure_while_written(bundle, decisions, labels, samples),
        "samples": [_select_published(sample) for sample in samples],
        "spikes": _sum_by_layer(samples, "spikes"),
        "synaptic_operations": _sum_by_layer(samples, "operations"),
        "multiply_accumulates": bundle.spec.multiply_accumulates,
        "wall_seconds": wall_seconds,
        "versions": {**list_versions(), **extra.pop("versions", {})},
        **extra,
    }


def _select_published(sample) -> dict:
    return {key: sample[key] for key in PUBLISHED if key in sample}


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


def _measure_while_written(bundle, decisions, labels, samples) -> dict:
    """Accuracy during the recording of a sample; for event frames only.

    A step without a decision counts as a wrong answer.

    A recording ends with the sample's last event; steps after the end count as the last step.
    """
    spec = bundle.spec
    if spec.stimulus.is_static:
        return {}
    written = find_last_steps(bundle.checks.inputs) + 1
    rows = np.arange(len(labels))

    def right_at(steps):
        return decisions[rows, np.minimum(steps, decisions.shape[1]) - 1] == labels

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
            "confidence": spec.presentation.threshold,
            "accuracy": float(right.mean()),
            "accuracy_ci95": list(compute_wilson_interval(int(right.sum()), len(right))),
            "share_of_writing_mean": float(compute_share_of_time(stopped - 1, written - 1).mean()),
            "before_the_end": float((stopped < written).mean()),
        }
    return {"while_written": value}


def read_result(path, remedy="run the check again") -> dict:
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
    try:
        load_dataclass(_Result, result, ignore_extra=True)
    except WrongValue as error:
        raise UserError(f"{path}: not a complete check result ({error}); {remedy}") from error
    samples = result["samples"]
    right = sum(sample["label"] == sample["prediction"] for sample in samples)
    sound = (
        len(samples) == result["n_samples"]
        and len({sample["id"] for sample in samples}) == len(samples)
        and len({len(sample["scores"]) for sample in samples}) == 1
        and all(max(s["label"], s["prediction"]) < len(s["scores"]) for s in samples)
        and abs(right / len(samples) - result["accuracy"]) < 1e-9
    )
    if not sound:
        raise UserError(f"{path}: its samples contradict each other or its accuracy; {remedy}")
    return result


COUNT = between(0, 2**53)
SHARE = between(0, 1)
INTERVAL = Limit(
    lambda pair: len(pair) == 2 and all(map(SHARE.holds, pair)), "two numbers from 0 to 1"
)
SHARES_OF_1 = Limit(lambda values: all(map(SHARE.holds, values)), "numbers from 0 to 1")
COUNTS = Limit(lambda counts: all(n >= 0 for n in counts.values()), "counts of at least 0")


@dataclass(frozen=True)
class _Sample:
    """The fields of a sample in a result."""

    id: str
    label: int = limited_field(COUNT)
    prediction: int = limited_field(COUNT)
    scores: List[float]
    stopped_at: Optional[int] = limited_field(COUNT, None)
    spike_hash: Optional[str] = None


@dataclass(frozen=True)
class _ByItself:
    """The fields of the network's own decisions, from ``while_written``."""

    confidence: float = limited_field(SHARE)
    accuracy: float = limited_field(SHARE)
    accuracy_ci95: List[float] = limited_field(INTERVAL)
    share_of_writing_mean: float = limited_field(SHARE)
    before_the_end: float = limited_field(SHARE)


@dataclass(frozen=True)
class _WhileWritten:
    """The fields of the accuracy while samples are being written."""

    shares: List[float] = limited_field(SHARES_OF_1)
    accuracy: List[float] = limited_field(SHARES_OF_1)
    step_ms: float
    written_steps_mean: float
    by_itself: Optional[_ByItself] = None

    def __post_init__(self):
        if not len(self.shares) == len(self.accuracy) > 0:
            raise WrongValue("accuracy", "must be as long as 'shares'")


@dataclass(frozen=True)
class _Data:
    """The fields of the recordings, if they are not those of the bundle."""

    source: str
    sha256: str
    recordings: int = limited_field(COUNT)


@dataclass(frozen=True)
class _Part:
    """The fields of the accuracy on a part of the samples."""

    n: int = limited_field(COUNT)
    accuracy: float = limited_field(SHARE)
    accuracy_ci95: List[float] = limited_field(INTERVAL)


@dataclass(frozen=True)
class _Result:
    """The fields that are read from a result; the last ones exist for some results only."""

    bundle: str
    target: str
    n_samples: int = limited_field(COUNT)
    samples: List[_Sample] = limited_field(Limit(len, "a sample or more"))
    accuracy: float = limited_field(SHARE)
    accuracy_ci95: List[float] = limited_field(INTERVAL)
    anytime_accuracy: List[float] = limited_field(SHARES_OF_1)
    steps_per_sample: int = limited_field(COUNT)
    simulated: Optional[bool]
    spikes: Dict[str, float] = limited_field(COUNTS)
    synaptic_operations: Dict[str, float] = limited_field(COUNTS)
    wall_seconds: float = limited_field(COUNT)
    versions: Dict[str, str]
    while_written: Optional[_WhileWritten] = None
    data: Optional[_Data] = None
    classes_without_samples: Optional[List[str]] = None
    classes: Optional[List[str]] = None
    confusion: Optional[List[List[int]]] = None
    per_class: Optional[List[_Part]] = None
    per_writer: Optional[List[_Part]] = None


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
        See :func:`make_result`.

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
    if _list_labels(a) != _list_labels(b):
        remedy = "on the same bundle"
        if "data" in a or "data" in b:
            remedy = "with the same --data, --samples and --seed"
        raise UserError(f"the results are of different samples; run both checks {remedy}")
    pairs = list(zip(a["samples"], b["samples"]))
    return Comparison(
        targets=(a["target"], b["target"]),
        accuracies=(a["accuracy"], b["accuracy"]),
        n_samples=len(pairs),
        disagreements=[
            {
                "id": in_a["id"],
                "label": in_a["label"],
                "a": in_a["prediction"],
                "b": in_b["prediction"],
            }
            for in_a, in_b in pairs
            if in_a["prediction"] != in_b["prediction"]
        ],
        p_value=compute_mcnemar_p(_list_right(a), _list_right(b)),
        other_spikes=_count_other_spikes(pairs),
    )


def _list_labels(result) -> list:
    """(id, label) of each sample."""
    return [(sample["id"], sample["label"]) for sample in result["samples"]]


def _list_right(result) -> list:
    """Whether the prediction of each sample is right."""
    return [sample["prediction"] == sample["label"] for sample in result["samples"]]


def _count_other_spikes(pairs):
    """Number of samples with other spikes in the two results; None if a hash is missing."""
    hashes = [(in_a.get("spike_hash"), in_b.get("spike_hash")) for in_a, in_b in pairs]
    if any(None in pair for pair in hashes):
        return None
    return sum(of_a != of_b for of_a, of_b in hashes)


# McNemar's p below which a lower accuracy causes a warning. It is lower than the 0.05 of tables,
# because every check of every target is compared.
WARNING_P_VALUE = 0.01


def describe_loss(reference: dict, result: dict) -> Optional[str]:
    """A message if a target is significantly less accurate than the trained network.

    Parameters
    ----------
    reference : dict
        The trained network's answers to the same samples.
    result : dict

    Returns
    -------
    str or None
        None if the difference is not significant (p of :data:`WARNING_P_VALUE` or more).

    Raises
    ------
    UserError
        The results are of different bundles or of different samples.
    """
    compared = compare_results(reference, result)
    if compared.accuracy_drop <= 0 or compared.p_value >= WARNING_P_VALUE:
        return None
    of_reference, of_result = compared.accuracies
    return WARNING + (
        f"{result['target']} is significantly less accurate than {reference['target']} on the same "
        f"samples: {of_result:.3f} instead of {of_reference:.3f} "
        f"(McNemar p = {compared.p_value:.2g}, below {WARNING_P_VALUE:g})"
    )


def _are_of_the_same_data(a, b):
    """True if two results are of the same other recordings (``check run --data``)."""
    of_a, of_b = (result.get("data") for result in (a, b))
    return bool(of_a) and bool(of_b) and of_a["sha256"] == of_b["sha256"]


def enforce_limits(
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
    """
    count = len(comparison.disagreements)
    if max_disagreements is not None and count > max_disagreements:
        raise CheckFailed(f"{count} disagreements, more than the {max_disagreements} allowed")
    # An accuracy is a fraction of n samples: differences below 5e-7 are rounding.
    if max_accuracy_drop is not None and comparison.accuracy_drop > max_accuracy_drop + 5e-7:
        raise CheckFailed(
            f"accuracy drops by {comparison.accuracy_drop:.4f}, "
            f"more than the {max_accuracy_drop:g} allowed"
        )
