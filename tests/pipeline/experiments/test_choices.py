import nengo
import numpy as np
import pytest

from pipeline.experiments import choices
from pipeline.settings import Settings
from tests.command import call


def test_every_choice_is_a_valid_setting_and_has_a_title_of_its_own():
    for choice in choices.CHOICES:
        settings = choice.apply(Settings())
        assert settings.snn.recipe == "paper"
        assert settings.snn.max_rate(0) == settings.snn.max_rate(1) == choice.max_rate
        assert choice.row == "ann-snn" or not choice.smoothed
    titles = [(choice.row, choice.title) for choice in choices.CHOICES]
    assert len(set(titles)) == len(titles)


def test_smoothing_is_nengos_low_pass():
    outputs = np.random.default_rng(0).normal(size=(3, 40, 10))
    low_pass = nengo.Lowpass(choices.SMOOTHING)
    expected = [low_pass.filt(sample, dt=0.001, y0=0)[-1] for sample in outputs]
    np.testing.assert_allclose(choices.smoothed(outputs), expected, atol=1e-12)


def test_losses_are_paired_with_the_networks_of_the_same_rate():
    n = len(choices.CHOICES)
    results = [
        {"seed": seed, "n_train": 80, "n_test": 20, "rate": rate, "choices": [accuracy] * n}
        for seed, rate, accuracy in (
            (0, {"100.0": 0.8, "150.0": 0.9}, 0.7),
            (1, {"100.0": 0.6, "150.0": 0.9}, 0.6),
        )
    ]
    summary = choices.summarise(results, simulated=True)
    assert summary["rate_accuracy"] == pytest.approx({"100.0": 0.7, "150.0": 0.9})
    for choice, row in zip(choices.CHOICES, summary["choices"], strict=True):
        assert row["accuracy"] == pytest.approx(0.65)
        assert row["loss"] == pytest.approx(0.05 if choice.max_rate == 100 else 0.25)
    text = choices.choices_text(summary)
    assert "100 Hz 0.700, 150 Hz 0.900" in text
    assert text.count("25.00") + text.count(" 5.00") == n


def test_networks_on_events_are_refused(tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ("--splits", 1, "--jobs", 1, "--set", "input.kind=events")
    assert call("benchmark", "conversion", "--out", out, *arguments) == 2
    assert "input.kind" in capsys.readouterr().err
    assert not out.exists()
