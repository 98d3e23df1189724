import math
from dataclasses import replace

import pytest
from scipy import stats

from deploy.errors import UserError
from pipeline.experiments import losses
from tests.command import call, missing
from tests.own_sensor import write_folder

STAGES = ("cnn", "cnn-annealed", "rate-lif", "spiking-lif", "chip-100", "chip-50")


def result(seed, *accuracies):
    chips = {"chip-100": 2.0 + seed, "chip-50": 1.0}
    return {
        "seed": seed,
        "n_train": 80,
        "n_test": 20,
        "accuracy": dict(zip(STAGES, accuracies, strict=True)),
        "disagreements": {"spiking-lif": 0.0, **chips},
        "operations": chips,
        "decided_at_median": {"chip-100": 30.0, "chip-50": 20.0},
    }


def test_losses_are_from_the_stronger_cnn_and_paired_by_seed():
    results = [
        result(0, 0.8, 0.9, 0.9, 0.85, 0.8, 0.7),
        result(1, 0.9, 0.9, 0.8, 0.85, 0.9, 0.7),
    ]
    summary = losses.summarise(results, simulated=True)
    assert summary["stronger_cnn"] == "cnn-annealed"
    assert summary["accuracy"]["cnn"]["mean"] == pytest.approx(0.85)
    loss = summary["loss"]
    assert set(loss) == set(STAGES[2:])
    assert loss["rate-lif"]["values"] == pytest.approx([0.0, 0.1])
    assert loss["spiking-lif"]["mean"] == pytest.approx(0.05)
    # Two splits of 80 and 20: sd * sqrt(1/2 + 20/80) times t of one degree of freedom.
    reach = 0.1 / math.sqrt(2) * math.sqrt(0.75) * stats.t.ppf(0.975, 1)
    assert loss["rate-lif"]["ci95"] == pytest.approx([0.05 - reach, 0.05 + reach])
    assert summary["operations"]["chip-100"]["mean"] == pytest.approx(2.5)


def test_of_events_the_trained_network_takes_the_place_of_conversion():
    found = {
        "seed": 0,
        "n_train": 80,
        "n_test": 20,
        "accuracy": {"cnn": 0.9, "cnn-annealed": 0.8, "trained": 0.95, "chip": 0.94},
        "disagreements": {"chip": 0.02},
        "operations": {"chip": 0.9},
        "decided_at_median": {"chip": 40.0},
    }
    summary = losses.summarise([found], simulated=True)
    assert summary["stronger_cnn"] == "cnn"
    assert summary["loss"]["chip"]["mean"] == pytest.approx(-0.04)
    text = losses.losses_text(summary)
    assert missing(text, "(cnn)", "2.0") == []


def test_text_says_what_is_simulated_and_leaves_out_an_interval_of_one_seed():
    one = losses.losses_text(
        losses.summarise([result(0, 0.8, 0.9, 0.9, 0.85, 0.8, 0.7)], simulated=True)
    )
    assert missing(one, "20", "simulated") == []
    assert "nan" not in one
    assert "  cnn           80.00\n" in one


def test_both_networks_fit_own_recordings(tmp_path, monkeypatch, capsys):
    """Those on events, and the CNNs on images with which they are compared."""
    asked = []

    def measure(task):
        asked.append(task.settings)
        raise UserError("not measured here")

    monkeypatch.setattr(losses, "EXPERIMENT", replace(losses.EXPERIMENT, measure=measure))
    data = write_folder(tmp_path / "own", per_class=4)
    command = ("benchmark", "losses", "--input", "events", "--data", data, "--seeds", "1")
    command += ("--jobs", "1", "--out", tmp_path / "out")
    assert call(*command) == 1
    (settings,) = asked
    assert settings.cnn.architecture == "9x12-6c4-24c3-4o"
    assert settings.events.architecture.startswith("9x12x2-")
    assert call(*command, "--set", "cnn.architecture=12x9-8-4o") == 2
    assert len(asked) == 1
    assert missing(capsys.readouterr().err, "cnn.architecture", "9x12-8-4o") == []
