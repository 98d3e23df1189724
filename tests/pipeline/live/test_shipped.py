"""The network that comes with the package: what it was made from, how good and how large it is."""

import re

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from deploy.files import read_json
from deploy.targets.registry import run_target
from pipeline.live.network import SHIPPED, find_sensor
from pipeline.recordings.sensor import Sensor
from pipeline.settings import read_settings
from pipeline.sources import find_hash_and_split
from tests.command import ROOT, call

RECIPE = SHIPPED.with_name("shipped.toml")
AGAIN = "the recipe or the simulation has changed since it was trained; run: make shipped-bundle"


@pytest.fixture(scope="module")
def bundle():
    return read_bundle(SHIPPED)


def test_it_is_of_its_recipe_and_of_the_built_in_recordings(bundle):
    provenance, settings = bundle.spec.provenance, read_settings(RECIPE)
    assert provenance.source_sha256 == find_hash_and_split(settings)[0], AGAIN
    assert provenance.simulated is True
    made_from, flat = provenance.settings, settings.flatten()
    for name, recorded in made_from.items():
        value = list(flat[name]) if isinstance(flat[name], tuple) else flat[name]
        assert value in (recorded, "auto"), AGAIN
    assert bundle.spec.architecture == settings.events.architecture, AGAIN


def test_it_is_small_and_has_all_that_the_page_needs(bundle):
    assert sum(file.stat().st_size for file in SHIPPED.iterdir()) <= 1_500_000
    assert find_sensor(bundle) == Sensor()
    assert bundle.spec.rehearsal is not None
    assert bundle.spec.estimator is not None


def test_its_accuracy_is_that_of_the_readme(bundle):
    predictions = run_target(bundle.spec, bundle.checks.inputs, "fast").predictions
    accuracy = np.mean(predictions == bundle.checks.labels)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    told = re.search(r"(0\.\d{3}) on (\d+)\s+simulated samples", readme)
    assert told is not None
    assert (f"{accuracy:.3f}", len(predictions)) == (told[1], int(told[2]))


def test_its_commands_work(tmp_path, capsys):
    out = tmp_path / "fast.json"
    assert call("check", "run", SHIPPED, "--target", "fast", "--out", out) == 0
    assert read_json(out, "")["n_samples"] > 50
    assert call("deploy", "plan", SHIPPED) == 0
    assert call("deploy", "energy", SHIPPED, out) == 0
    assert sorted(file.name for file in SHIPPED.iterdir()) == sorted(
        ("MANIFEST.json", "checks.npz", "deploy.pyz", "network.json", "weights.npz")
    )
