"""The value of timing: intervals, what a variant loses, what is kept, a network of each end."""

import json
import math
from dataclasses import replace

import pytest
from scipy import stats

from deploy.check.intervals import mcnemar, wilson_interval
from deploy.files import read_json
from pipeline.data.variants import VARIANTS
from pipeline.experiments import events
from tests.command import call, missing


def result(variant, seed, right, **figures):
    """A training's result, with answers that are right (1) or wrong (0)."""
    labels = [n % 10 for n in range(len(right))]
    return {
        "variant": variant,
        "seed": seed,
        "n_train": 4 * len(right),
        "n_test": len(right),
        "labels": labels,
        "predictions": [(y + 1 - r) % 10 for y, r in zip(labels, right, strict=True)],
        **(dict.fromkeys(events.MEANS, 0.5) | figures),
    }


def test_of_one_seed_the_intervals_are_of_the_test_samples():
    as_is, counts = [1] * 9 + [0], [1, 0, 0, 0, 0, 0, 0, 1, 1, 1]
    results = [result("as-is", 3, as_is, operations=0.9), result("counts", 3, counts)]
    rows = events.summarise(results, simulated=True)["variants"]
    assert rows["as-is"]["accuracy"]["mean"] == pytest.approx(0.9)
    assert rows["as-is"]["accuracy"]["ci95"] == pytest.approx(wilson_interval(9, 10))
    assert rows["as-is"]["loss"] is None
    assert rows["as-is"]["operations"] == 0.9
    assert rows["counts"]["loss"]["mean"] == pytest.approx(0.5)
    assert rows["counts"]["loss"]["ci95"] is None
    # Six samples only as-is has right, one only counts.
    assert rows["counts"]["loss"]["p_value"] == pytest.approx(mcnemar(as_is, counts))
    assert rows["counts"]["loss"]["p_value"] == pytest.approx(2 * (1 + 7) / 2**7)


def test_losses_are_paired_by_seed_and_a_missing_training_is_left_out():
    results = [
        result("as-is", 0, [1, 1, 1, 0], share=0.5),
        result("as-is", 1, [1, 1, 1, 1], share=0.7),
        result("even", 0, [1, 1, 1, 0]),
        result("even", 1, [1, 1, 0, 0]),
        result("counts", 1, [1, 0, 0, 0]),
    ]
    rows = events.summarise(results, simulated=False)["variants"]
    assert list(rows) == ["as-is", "even", "counts"]
    assert rows["as-is"]["share"] == pytest.approx(0.6)
    loss = rows["even"]["loss"]
    assert loss["values"] == pytest.approx([0, 0.5])
    # Two splits of 16 and 4: sd * sqrt(1/2 + 4/16) times t of one degree of freedom.
    reach = 0.5 / math.sqrt(2) * math.sqrt(0.75) * stats.t.ppf(0.975, 1)
    assert loss["ci95"] == pytest.approx([0.25 - reach, 0.25 + reach])
    assert rows["counts"]["loss"]["values"] == [0.75]
    assert rows["even"]["accuracy"]["ci95"] == [0, 1]  # no share is past these


def test_the_text():
    results = [result(name, 0, [1, 1, 0, 0]) for name in VARIANTS]
    text = events.events_text(events.summarise(results, simulated=True))
    assert missing(text.splitlines()[0], "simulated", "1 seed", "split of 4") == []
    for name, what in VARIANTS.items():
        assert f"\n{name} " in text
        assert f"\n{name}: {what}\n" in text
    assert "nan" not in text
    assert "None" not in text
    alone = events.events_text(events.summarise(results[1:2] * 2, simulated=False))
    assert "as-is:" not in alone


TINY = (
    *("--jobs", "1", "--set", "data.samples_per_digit=6", "--set", "events.epochs=1"),
    *("--set", "input.step=500", "--set", "events.architecture=10x10x2-4c4s3-10o", "--json"),
)


def test_trainings_are_done_once_and_failed_ones_tried_again(tmp_path, monkeypatch, capsys):
    asked = []

    def measure(task):
        asked.append((task.subject, task.seed))
        if task.subject == "even" and len(asked) <= 10:
            raise ArithmeticError("out of order")
        return result(task.subject, task.seed, [1, 0])

    monkeypatch.setattr(events, "EXPERIMENT", replace(events.EXPERIMENT, measure=measure))
    command = ("benchmark", "events", "--out", tmp_path / "out", "--seeds", "2", *TINY)
    assert call(*command) == 1
    assert missing(capsys.readouterr().err, "even of seed 0", "even of seed 1") == []
    assert sorted(asked) == sorted((name, seed) for name in VARIANTS for seed in (0, 1))
    assert call(*command) == 0
    assert asked[10:] == [("even", 0), ("even", 1)]
    summary = json.loads(capsys.readouterr().out)
    assert list(summary["variants"]) == list(VARIANTS)
    assert read_json(tmp_path / "out" / "events.json", "") == summary
    assert call(*command, "--set", "events.early=0.5") == 0
    assert len(asked) == 22


def test_if_nothing_succeeds_it_says_so(tmp_path, monkeypatch, capsys):
    def fail(job):
        raise ArithmeticError("no")

    monkeypatch.setattr(events, "EXPERIMENT", replace(events.EXPERIMENT, measure=fail))
    assert call("benchmark", "events", "--out", tmp_path / "out", *TINY) == 1
    assert not (tmp_path / "out" / "events.json").exists()


@pytest.mark.slow
def test_networks_of_both_ends(tmp_path, monkeypatch, capsys):
    """As it is and counts only: trained, deployed, judged."""
    monkeypatch.setattr(events, "VARIANTS", {name: VARIANTS[name] for name in ("as-is", "counts")})
    out = tmp_path / "out"
    assert call("benchmark", "events", "--out", out, *TINY) == 0
    rows = json.loads(capsys.readouterr().out)["variants"]
    assert list(rows) == ["as-is", "counts"]
    for name, row in rows.items():
        assert 0 < row["share"] <= 1
        assert 0 <= row["agreement"] <= 1
        assert row["operations"] > 0
        kept = read_json(out / f"{name}-00.json", "")
        assert kept["n_test"] == len(kept["predictions"]) == 12
        assert len(kept["predictions_from_rest"]) == 12
        assert 0.5 <= kept["confidence"] <= 1
    assert rows["as-is"]["merged"] != rows["counts"]["merged"]
    assert not list(out.glob("*.npz"))
