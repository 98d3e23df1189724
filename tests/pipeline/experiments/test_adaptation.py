"""What fitting the readout is worth, over people."""

import json
from dataclasses import replace

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from deploy.errors import UserError
from pipeline.data.archive import write_zip
from pipeline.experiments.adaptation import Plan, _mistaken, measure_adaptation, summary_of
from pipeline.live.network import SHIPPED
from pipeline.skin.simulate import simulate
from tests.command import call, missing

BUNDLE = read_bundle(SHIPPED)


@pytest.fixture(scope="module")
def recordings():
    """Three writers, three of each digit."""
    few = simulate(3, [9] * 10, 1)
    return replace(few, writers=np.arange(len(few)) % 3)


def test_over_people(recordings, tmp_path, capsys):
    write_zip(tmp_path / "three.zip", recordings)
    out = tmp_path / "adapt.json"
    arguments = ("--each", "1,2", "--draws", 1, "--jobs", 1, "--json", "--out", out)
    assert call("benchmark", "adapt", SHIPPED, "--data", tmp_path / "three.zip", *arguments) == 0
    measured = json.loads(capsys.readouterr().out)
    assert measured == json.loads(out.read_text())
    found = measured["methods"]["readout"]
    assert (found["people"], measured["simulated"]) == (3, True)
    assert set(found["each"]) == {"1", "2"}
    for row in found["each"].values():
        assert row["interval95"][0] <= row["gain_points"] <= row["interval95"][1]
        assert row["gain_points"] == pytest.approx(100 * (row["after"] - row["before"]))
        assert row["worst"] <= row["gain_points"]
    # The judged recordings are the same, so the accuracy before is.
    assert found["each"]["1"]["before"] == found["each"]["2"]["before"]


def test_too_few(recordings):
    with pytest.raises(UserError, match="--each"):
        measure_adaptation(BUNDLE, recordings, Plan(each=(3,)))
    nobody = replace(recordings, writers=np.full(len(recordings), -1))
    with pytest.raises(UserError, match="--each"):
        measure_adaptation(BUNDLE, nobody, Plan(each=(1,)))


@pytest.mark.parametrize("each", ["0", "x", "1,,2"])
def test_bad_numbers(each, capsys):
    assert call("benchmark", "adapt", SHIPPED, "--data", "none.zip", "--each", each) == 2
    assert "--each" in capsys.readouterr().err


@pytest.mark.parametrize("option", [
    ("--set", "seed=3"), ("--settings", "my.toml"), ("--input", "events"), ("--folds", 3),
    ("--fitted", 0), ("--scheduler", "tcp://host:1"),
])  # fmt: skip
def test_options_for_networks_that_are_trained_are_refused_with_a_run(option, capsys):
    assert call("benchmark", "adapt", SHIPPED, "--data", "none.zip", *option) == 2
    assert missing(capsys.readouterr().err, option[0], "--handwriting") == []


def test_the_draws_have_the_seed_of_the_settings(tmp_path, monkeypatch):
    """Not only that of --seed: it may be in a file of settings, or in --set."""
    from pipeline.experiments import rotation

    seeds = []

    def measure(what, folder, settings, *_):
        seeds.append((what.plan.seed, settings.seed))
        raise UserError("enough")

    monkeypatch.setattr(rotation, "measure_rotation", measure)
    for chosen in ((), ("--seed", 2), ("--set", "seed=3")):
        arguments = ("--handwriting", "pen", "--out", tmp_path / "out", *chosen)
        assert call("benchmark", "adapt", *arguments) == 2
    assert seeds == [(0, 0), (2, 2), (3, 3)]


def test_a_summary_by_hand():
    names = ["who", "before", "after", "exact", "others_before", "others_after", "used", "seconds"]
    cases = [
        (1, 0.5, 0.7, 0.7, 0.9, 0.9, 1, 0.1),
        (1, 0.5, 0.6, 0.6, 0.9, 0.8, 1, 0.3),
        (2, 0.9, 0.85, 0.87, 0.9, 0.9, 0, 0.2),
    ]
    found = summary_of(
        [{"each": 5, "draw": 0, **dict(zip(names, case, strict=True))} for case in cases]
    )
    assert (found["people"], found["lowest"], found["highest"]) == (2, 0.5, 0.9)
    row = found["each"]["5"]
    assert (row["before"], row["after"], row["exact"]) == pytest.approx((0.7, 0.75, 0.76))
    assert (row["gain_points"], row["worst"], row["lost"]) == pytest.approx((5, -5, 2.5))
    assert (row["used"], row["seconds"]) == pytest.approx((0.5, 0.2))
    assert row["interval95"] == pytest.approx([5 - 12.706 * 10, 5 + 12.706 * 10], abs=0.1)


def test_mistaken_labels():
    labels = np.repeat(np.arange(10), 4)
    wrong = _mistaken(labels, 0.1, np.random.default_rng(0))
    assert (wrong != labels).sum() == 4
    assert set(wrong) <= set(range(10))
    assert (_mistaken(labels, 0.0, np.random.default_rng(0)) == labels).all()
