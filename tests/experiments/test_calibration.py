"""The fit of the simulation to recordings; simulated ones stand in for real ones."""

import copy

import numpy as np
import pytest

from deploy.errors import UserError
from deploy.files import read_json
from experiments import calibration
from experiments.calibration import (
    FitData,
    find_sessions,
    fit_digit_boxes,
    simulate_fit,
    step_digits,
)
from pipeline.recordings.files.writing import write_mat_zip
from pipeline.simulation import parameters, shape_model
from pipeline.simulation.handwriting import Trace
from pipeline.simulation.simulate import make_source, simulate_recordings

BUILT_IN = read_json(parameters.FITTED, "restore it")
SHAPES = shape_model.read_shape_model(parameters.FITTED_SHAPES)


def changed_fit(**values):
    """The built-in fit without faults, with other values of all digits."""
    fit = copy.deepcopy(BUILT_IN)
    fit["sections"]["faults"] |= {"sessions": [], "strays": 0.0}
    for form in fit["digits"]:
        form |= values
    return fit


def target_of(fit, each=15, seed=5):
    return FitData(*simulate_fit(fit, SHAPES, each, seed, 1))


def test_sample_counts_are_the_papers():
    counts = [697, 690, 699, 690, 690, 693, 698, 704, 697, 695]
    assert sum(counts) == 6953
    assert make_source(0) == make_source(0, counts)


def test_the_built_in_fit_has_its_source_and_no_recording():
    assert BUILT_IN["source"]["recordings"] > 1000
    assert parameters.FITTED.stat().st_size < 200_000


def test_a_step_moves_digits_towards_the_recordings():
    here, there = changed_fit(force=0.0, contact=0.0), changed_fit(force=0.0, contact=0.2)
    moved = step_digits(here, target_of(there), *simulate_fit(here, SHAPES, 15, 5, 1))
    result = np.mean([form["contact"] for form in moved["digits"]])
    assert 0.04 < result < 0.3


def test_places_and_sizes_of_digits_are_those_of_the_paths():
    rng = np.random.default_rng(0)
    boxes = rng.multivariate_normal([4, 5, 2], np.diag([0.4, 0.6, 0.02]), 400)
    traces = [
        Trace(digit, -1, (np.array([[-0.5, 0], [0.5, 0.1]]) * np.exp(size) + [down, right],))
        for digit in range(10)
        for down, right, size in boxes
    ]
    for form in fit_digit_boxes(BUILT_IN, traces)["digits"]:
        assert form["down"] == pytest.approx(4, abs=0.1)
        assert form["height"] == pytest.approx(np.exp(2), rel=0.03)
        root = np.array(form["variation"])
        np.testing.assert_allclose(root @ root.T, np.cov(boxes.T), atol=0.05)


def test_hot_taxels_are_found_with_their_sessions():
    fit = changed_fit(down=4.5, right=4.5, height=6.0)
    sessions = [[0.4, [[8, 1], [2, 0]]], [0.4, [[9, 8]]]]
    fit["sections"]["faults"]["sessions"] = sessions
    result = find_sessions(*simulate_fit(fit, SHAPES, 30, 5, 1))
    assert {frozenset(map(tuple, taxels)) for _, taxels in result} == {
        frozenset({(8, 1), (2, 0)}),
        frozenset({(9, 8)}),
    }
    for share, _ in result:
        assert share == pytest.approx(0.4, abs=0.25)


def test_recordings_that_cannot_be_fitted_to(tmp_path):
    few = tmp_path / "few.zip"
    write_mat_zip(few, simulate_recordings(0, [2] * 10, 1))
    with pytest.raises(UserError, match="at least 100"):
        calibration.read_target(few, 1)
    letters = tmp_path / "letters"
    for name in "ab":
        folder = letters / name
        folder.mkdir(parents=True)
        np.savez(folder / "1.npz", x=[1, 2], y=[3, 9], t=[0, 1000], p=[True, False])
    with pytest.raises(UserError, match="ten digits"):
        calibration.read_target(letters, 1)


def test_the_command_writes_the_parameters_and_the_ways(tmp_path, monkeypatch):
    monkeypatch.setattr(calibration, "STEP_SAMPLES", 8)
    monkeypatch.setattr(calibration, "STEPS", 1)
    monkeypatch.setattr(calibration, "MIN_RECORDINGS_PER_DIGIT", 20)
    recordings, out = tmp_path / "real.zip", tmp_path / "fit.json"
    write_mat_zip(recordings, simulate_recordings(0, [40] * 10, 1))
    calibration.main(data=recordings, out=out, jobs=1)
    written = read_json(out, "write it")
    assert written["source"]["recordings"] == 320
    fitted = parameters.from_fit(written, shape_model.read_shape_model(out.with_suffix(".npz")))
    assert fitted.compute_hash() != parameters.read_parameters().compute_hash()
