"""Compare two check results of the same samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import List, Optional, Union

from ..errors import CheckFailed, UserError
from ..terminal import WARNING
from .intervals import compute_mcnemar_p
from .results import CheckResult, to_result

# McNemar's p below which a lower accuracy causes a warning. It is lower than the 0.05 of tables,
# because every check of every target is compared.
WARNING_P_VALUE = 0.01


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

    @property
    def accuracy_change(self) -> float:
        """Accuracy of B minus that of A."""
        return self.accuracies[1] - self.accuracies[0]

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


def compare_results(a: Union[CheckResult, dict], b: Union[CheckResult, dict]) -> Comparison:
    """Compare two results sample by sample.

    Parameters
    ----------
    a, b : CheckResult or dict
        Results, or their plain values.

    Raises
    ------
    UserError
        They are of different bundles or of different samples.
    """
    a = to_result(a)
    b = to_result(b)
    if a.bundle_id != b.bundle_id and not _are_of_the_same_data(a, b):
        raise UserError(
            f"the results are of different bundles ({a.bundle_id[:12]} and {b.bundle_id[:12]}); "
            "run both checks on the same bundle"
        )
    if _list_labels(a) != _list_labels(b):
        remedy = "on the same bundle"
        if a.data or b.data:
            remedy = "with the same --data, --samples and --seed"
        raise UserError(f"the results are of different samples; run both checks {remedy}")
    pairs = list(zip(a.samples, b.samples))
    return Comparison(
        targets=(a.target, b.target),
        accuracies=(a.accuracy, b.accuracy),
        n_samples=len(pairs),
        disagreements=[
            {
                "id": in_a.id,
                "label": in_a.label,
                "a": in_a.prediction,
                "b": in_b.prediction,
            }
            for in_a, in_b in pairs
            if in_a.prediction != in_b.prediction
        ],
        p_value=compute_mcnemar_p(_list_right(a), _list_right(b)),
        other_spikes=_count_other_spikes(pairs),
    )


def _list_labels(result) -> list:
    """(id, label) of each sample."""
    return [(sample.id, sample.label) for sample in result.samples]


def _list_right(result) -> list:
    """For each sample, True if its prediction is right."""
    return [sample.is_right for sample in result.samples]


def _count_other_spikes(pairs):
    """Number of samples with other spikes in the two results; None if a hash is missing."""
    hashes = [(in_a.spike_hash, in_b.spike_hash) for in_a, in_b in pairs]
    if any(None in pair for pair in hashes):
        return None
    return sum(of_a != of_b for of_a, of_b in hashes)


def describe_loss(reference: CheckResult, result: CheckResult) -> Optional[str]:
    """A message if a target is significantly less accurate than the trained network.

    Parameters
    ----------
    reference : CheckResult
        The trained network's answers to the same samples.
    result : CheckResult

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
        f"{result.target} is significantly less accurate than {reference.target} on the same "
        f"samples: {of_result:.3f} instead of {of_reference:.3f} "
        f"(McNemar p = {compared.p_value:.2g}, below {WARNING_P_VALUE:g})"
    )


def _are_of_the_same_data(a, b):
    """True if two results are of the same other recordings (``check run --data``)."""
    return a.data is not None and b.data is not None and a.data.sha256 == b.data.sha256


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
