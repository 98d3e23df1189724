"""A bundle of the first schema, made on NumPy 1.23 and Nengo 3.2: read, and answered the same."""

from pathlib import Path

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from deploy.check.results import compare_results, read_result
from deploy.check.run import run_check
from deploy.network.stimulus import ImageSpikes

OLD = Path(__file__).parent.parent / "data" / "old_bundle"


def test_the_first_schema_is_read():
    bundle = read_bundle(OLD / "bundle")
    assert bundle.spec.stimulus == ImageSpikes(500.0, 0.5)
    assert [(layer.stride, layer.padding, layer.pool) for layer in bundle.spec.layers] == [
        (1, "valid", 1)
    ] * 3
    assert bundle.checks.inputs.shape == (20, 10, 10, 1)


@pytest.mark.parametrize("target", ["nengo", "emulator", "fast"])
def test_every_spike_is_what_it_was(target, tmp_path):
    then = read_result(OLD / "checks" / f"{target}.json")
    now = run_check(read_bundle(OLD / "bundle"), target, tmp_path / "now.json")
    assert then["versions"]["numpy"].startswith("1.")
    comparison = compare_results(then, now)
    assert (comparison.disagreements, comparison.other_spikes) == ([], 0)
    scores = [[sample["scores"] for sample in result["samples"]] for result in (then, now)]
    np.testing.assert_allclose(*scores, rtol=0, atol=1e-9)
    for counts in ("spikes", "synaptic_operations", "multiply_accumulates"):
        assert then[counts] == now[counts]
