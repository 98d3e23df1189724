"""Check results for tests that read or compare them."""

from deploy.check.results import CheckResult, SampleResult


def make_result(predictions=(0, 1, 2, 3), labels=(0, 1, 2, 3), ids=None, **changes) -> CheckResult:
    """A result with these predictions, and other values of no meaning."""
    ids = ids or [f"x/{number}" for number in range(len(labels))]
    n_right = sum(a == b for a, b in zip(predictions, labels, strict=True))
    values = {
        "target": "nengo",
        "bundle_id": "b" * 64,
        "seed": 0,
        "simulated": True,
        "steps_per_sample": 100,
        "n_samples": len(labels),
        "accuracy": n_right / len(labels),
        "accuracy_ci95": [0.0, 1.0],
        "anytime_accuracy": [n_right / len(labels)],
        "samples": [
            SampleResult(name, label, prediction, [0.0] * 10)
            for name, label, prediction in zip(ids, labels, predictions, strict=True)
        ],
        "spikes": {"conv1": 10},
        "synaptic_operations": {"output": 100},
        "wall_seconds": 1.0,
        "versions": {},
    }
    return CheckResult(**{**values, **changes})
