"""The fit of the simulation to recordings, for which other simulated ones stand."""

import copy
import json

import numpy as np
import pytest

from deploy.errors import UserError
from deploy.files import read_json
from experiments import calibration
from experiments.calibration import Target, adapt_ways, find_sessions, simulate_fit, step_forms
from pipeline.recordings.writing import write_zip
from pipeline.simulation import parameters
from pipeline.simulation.simulate import simulate, source_of

BUILT_IN = read_json(parameters.FITTED, "restore it")


def changed_fit(**values):
    """The built-in fit without faults, with other values of all digits."""
    fit = copy.deepcopy(BUILT_IN)
    fit["sections"]["faults"] |= {"sessions": [], "strays": 0.0}
    for form in fit["digits"]:
        form |= values
    return fit


def target_of(fit, each=15, seed=5):
    return Target(*simulate_fit(fit, each, seed, 1))


def test_sample_counts_are_the_papers():
    counts = [697, 690, 699, 690, 690, 693, 698, 704, 697, 695]
    assert sum(counts) == 6953
    assert source_of(0) == source_of(0, counts)


def test_the_built_in_fit_has_its_source_and_no_recording():
    assert BUILT_IN["source"]["recordings"] > 1000
    assert parameters.FITTED.stat().st_size < 200_000


def test_a_step_moves_digits_towards_the_recordings():
    moves = {"down": 0.8, "right": -0.8, "height": -2.0}
    here = changed_fit(shear=0.0, down=4.5, right=4.5, height=7.0, width=7.0)
    there = copy.deepcopy(here)
    for form in there["digits"]:
        for name, by in moves.items():
            form[name] += by
    moved = step_forms(here, target_of(there), *simulate_fit(here, 15, 5, 1))
    for name, by in moves.items():
        found = np.mean([form[name] for form in moved["digits"]]) - here["digits"][0][name]
        assert 0.4 < found / by < 1.6


def test_hot_taxels_are_found_with_their_sessions():
    fit = changed_fit(down=4.5, right=4.5, width=4.0)
    sessions = [[0.4, [[8, 1], [2, 0]]], [0.4, [[9, 8]]]]
    fit["sections"]["faults"]["sessions"] = sessions
    found = find_sessions(*simulate_fit(fit, 60, 5, 1))
    assert {frozenset(map(tuple, taxels)) for _, taxels in found} == {
        frozenset({(8, 1), (2, 0)}),
        frozenset({(9, 8)}),
    }
    for share, _ in found:
        assert share == pytest.approx(0.4, abs=0.25)


def test_ways_that_people_use_get_larger_shares(monkeypatch):
    monkeypatch.setattr(calibration, "WAY_SAMPLES", 30)
    shares = []
    for used in (0, 4):
        there = changed_fit()
        for number, way in enumerate(there["ways"][2]):
            way["share"] = float(number == used)
        found = adapt_ways(changed_fit(), target_of(there), 3, 1)
        shares.append([way["share"] for way in found["ways"][2]])
    assert shares[0][0] > shares[1][0]
    assert shares[0][4] < shares[1][4]


def test_recordings_that_cannot_be_fitted_to(tmp_path):
    few = tmp_path / "few.zip"
    write_zip(few, simulate(0, [2] * 10, 1))
    with pytest.raises(UserError, match="at least 100"):
        calibration.read_target(few, 1)
    letters = tmp_path / "letters"
    for name in "ab":
        folder = letters / name
        folder.mkdir(parents=True)
        np.savez(folder / "1.npz", x=[1, 2], y=[3, 9], t=[0, 1000], p=[True, False])
    with pytest.raises(UserError, match="ten digits"):
        calibration.read_target(letters, 1)


def test_the_command_writes_one_file(tmp_path, monkeypatch):
    monkeypatch.setattr(calibration, "STEP_SAMPLES", 8)
    monkeypatch.setattr(calibration, "GROUPS", ("forms",))
    monkeypatch.setattr(calibration, "FEWEST_OF_A_DIGIT", 20)
    recordings, out = tmp_path / "real.zip", tmp_path / "fit.json"
    write_zip(recordings, simulate(0, [20] * 10, 1))
    calibration.main(data=recordings, out=out, jobs=1)
    written = json.loads(out.read_text())
    assert written["source"]["recordings"] == 200
    assert parameters.from_fit(written).fingerprint() != parameters.load().fingerprint()
