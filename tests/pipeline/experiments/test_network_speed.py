"""``stmnist benchmark emulator --networks``: the comparison, on networks that take no time."""

import json

import pytest

from pipeline.experiments import network_speed
from pipeline.experiments.network_speed import Case, channel, convolutions, learning
from tests.command import call

pytest.importorskip("numba")

CASES = (
    Case("channel", lambda: channel(20), 40),
    Case("PES", lambda: learning(20), 20),
    Case("convolutions", lambda: convolutions(14), 20),
)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(network_speed.measure_networks, "__defaults__", (CASES, 2))


def test_each_network_is_a_row_with_its_times(capsys):
    assert call("benchmark", "emulator", "--networks", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["identical"]
    assert [row["network"] for row in found["rows"]] == [case.title for case in CASES]
    for row, case in zip(found["rows"], CASES, strict=True):
        assert row["steps"] == case.steps
        assert row["ratio_emulator"] > 0
        assert row["ratio_whole"] > 0
        assert 0 <= row["share_of_host"] + row["share_of_emulator"] <= 1


def test_results_that_differ_are_a_failed_check(monkeypatch, capsys):
    class Off(network_speed.FastSimulator):
        def run_steps(self, steps):
            super().run_steps(steps)
            self.sims["emulator"].compartment.voltage[0] += 1

    monkeypatch.setattr(network_speed, "FastSimulator", Off)
    assert call("benchmark", "emulator", "--networks") == 1
    assert "differ" in capsys.readouterr().err


def test_the_table_fits_80_columns():
    rows = [
        {
            "network": case.title,
            "steps": 4000,
            "ratio_emulator": 503.4,
            "ratio_whole": 197.2,
            "microseconds_a_step": 159.9,
            "share_of_host": 0.79,
            "share_of_emulator": 0.13,
        }
        for case in network_speed.CASES
    ]
    text = network_speed.networks_text({"rows": rows, "turns": 4, "identical": True})
    assert max(map(len, text.splitlines())) <= 80
