"""The sweep: its grid, its Pareto front, its tables, and a small one from end to end."""

import json
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from deploy.errors import UserError
from deploy.files import read_json
from pipeline.kinds.events.kind import EventsKind
from pipeline.kinds.image.kind import ImageKind
from pipeline.kinds.preparation import choose_settings
from pipeline.results import sweep
from pipeline.settings import Settings, read_settings
from pipeline.sources import load_recordings
from tests.command import call
from tests.own_sensor import write_folder

SMALL = Settings().with_values(
    {"data": {"samples_per_digit": 12}, "split": {"validation_fraction": 0.25}}, "test"
)


def test_every_combination_of_the_grid():
    grid = ["presentation.steps=30, 50, 30", "snn.max_rates=[100,150],[200],120"]
    points = sweep.make_points(SMALL, grid)
    assert len(points) == 6
    assert points[0][0] == {"presentation.steps": 30, "snn.max_rates": [100, 150]}
    assert points[-1][0] == {"presentation.steps": 50, "snn.max_rates": [120]}
    assert points[-1][1].snn.max_rates == (120.0,)
    assert points[-1][1].presentation.steps == 50


def test_what_is_open_is_chosen_for_each_point(tmp_path):
    """Half the step takes twice the steps, and four slices another network."""
    source = str(write_folder(tmp_path / "own", per_class=5))
    recordings = load_recordings(source, jobs=1)

    def make_points(base, grid):
        return [choose_settings(point, recordings) for _, point in sweep.make_points(base, grid)]

    own = Settings().with_values({"data": {"source": source}, "input": {"kind": "events"}}, "")
    fine, coarse = make_points(own, ["input.step=5,10"])
    assert fine.input.step == 5
    assert fine.steps == pytest.approx(2 * coarse.steps, abs=1)
    auto, none = make_points(own, ["events.augment=auto,none"])
    assert auto.events.augment not in ("auto", "none")
    assert none.events.augment == "none"
    images = own.with_values({"input": {"kind": "image"}}, "")
    sliced, plain = make_points(images, ["image.slices=4,1"])
    assert sliced.cnn.architecture.startswith("9x12x4")
    assert plain.cnn.architecture.startswith("9x12-")


@pytest.mark.parametrize(
    ("entry", "problem"),
    [
        ("presentation.steps", "--grid"),
        ("presentation.steps=", "--grid"),
        ("presentation.steps=30,,50", "--grid"),
        ("presentation.steps=30,many", "'presentation.steps'"),
        ("presentation.steps=5", "'presentation.readout_start'"),
        ("seed=0,1", "'seed=0,1'.* --set"),
        ("split.test_fraction=0.2,0.3", "split.test_fraction with --set"),
    ],
)
def test_a_wrong_grid_is_refused_before_anything_is_trained(entry, problem):
    with pytest.raises(UserError, match=problem):
        sweep.make_points(SMALL, [entry])


def test_the_default_grids_are_grids():
    assert len(sweep.make_points(SMALL, ImageKind.grid)) == 16
    assert len(sweep.make_points(SMALL, EventsKind.grid)) == 4


def test_pareto_front_by_hand():
    costs = [
        (1, 5),  # on it: the least of the first
        (2, 3),  # on it
        (3, 3),  # beaten by (2, 3)
        (4, 1),  # on it: the least of the second
        (4, 1),  # its equal is on it too
        (5, 5),  # beaten by all
    ]
    assert sweep.find_pareto_front(costs).tolist() == [True, True, False, True, True, False]
    assert sweep.find_pareto_front([(7, 7, 7)]).tolist() == [True]


@given(arrays(int, st.tuples(st.integers(1, 12), st.just(3)), elements=st.integers(0, 4)))
def test_whatever_is_off_the_front_is_beaten_from_on_it(costs):
    front = sweep.find_pareto_front(costs)
    assert front.any()
    for cost in costs[~front]:
        assert any((other <= cost).all() and (other < cost).any() for other in costs[front])
    for cost in costs[front]:
        assert not any((other <= cost).all() and (other < cost).any() for other in costs)


TINY = (
    *("--set", "data.samples_per_digit=40", "--set", "cnn.epochs=4", "--set", "snn.epochs=2"),
    *("--set", "presentation.readout_start=10", "--jobs", 1),
)
GRID = ("--grid", "presentation.steps=24,40", "--grid", "snn.spike_penalty=0,3")


@pytest.fixture(scope="module")
def tiny_sweep(made_once):
    """Four points from three trainings, on a cluster."""
    distributed = pytest.importorskip("distributed")

    def make(folder):
        with distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
        ) as cluster:
            workers = ("--scheduler", cluster.scheduler_address)
            assert call("sweep", folder / "out", *TINY, *GRID, *workers) == 0

    return made_once("sweep", make) / "out"


def test_a_small_sweep(tiny_sweep):
    summary = read_json(tiny_sweep / "sweep.json", "")
    points = summary["points"]
    assert summary["failed"] == []
    assert (len(points), len(list((tiny_sweep / "rows").iterdir()))) == (4, 8)
    assert len(list((tiny_sweep / "networks" / "cnn").iterdir())) == 1
    assert len(list((tiny_sweep / "networks" / "snn").iterdir())) == 2
    assert all(p["simulated"] is True for p in points)
    assert {p["n_samples"] for p in points} == {48}  # 15 % of 320
    assert any(p["pareto"] for p in points)
    by_setting = {tuple(p["changes"].values()): p for p in points}
    # Longer presentations and no price on spikes mean more operations, whatever was learnt.
    assert by_setting[40, 0]["operations"] > by_setting[24, 0]["operations"]
    assert by_setting[40, 3]["operations"] < by_setting[40, 0]["operations"]
    assert by_setting[24, 0]["trained_accuracy"] == by_setting[40, 0]["trained_accuracy"]
    for p in points:
        low, high = p["accuracy_ci95"]
        assert low <= p["accuracy"] <= high


def test_its_networks_were_never_shown_the_test_split(tiny_sweep):
    for path in tiny_sweep.glob("networks/*nn/*/metrics.json"):
        metrics = read_json(path, "")
        assert set(metrics["accuracy"]) == {"train", "validation"}
        assert metrics["n_validation"] == 48
        assert "n_test" not in metrics
    assert read_settings(tiny_sweep / "experiment.toml").split.validation_fraction == 0.15


def test_a_sweep_is_no_run(tiny_sweep, refused):
    for verb in ("convert", "status", "report", "ladder", "live"):
        assert "results of a sweep" in refused(verb, tiny_sweep)
    for more in (["compare", tiny_sweep], ["check", "run", "--target=fast"], ["adapt", "--data=x"]):
        assert "results of a sweep" in refused(*more, tiny_sweep)
    assert not (tiny_sweep / "bundle").exists()


def test_a_setting_without_effect_is_no_grid(tmp_path, refused):
    few = ("--set", "data.samples_per_digit=40", "--jobs", 1)
    line = refused("sweep", tmp_path / "out", "--grid", "events.epochs=2,3", *few)
    assert "events.epochs" in line
    for name, option in (("cnn.model", "--model"), ("nir.file", "--nir")):
        assert option in refused("sweep", tmp_path / "out", "--set", f"{name}=a.keras", *few)
    as_is = (*few, "--set", "snn.recipe=as-is")
    assert "snn.epochs" in refused("sweep", tmp_path / "out", "--grid", "snn.epochs=2,3", *as_is)
    assert not (tmp_path / "out").exists()


def test_a_sweep_is_resumed(tiny_sweep, tmp_path, capsys):
    folder = tmp_path / "out"
    shutil.copytree(tiny_sweep, folder)
    lost, *kept = sorted((folder / "rows").iterdir())
    expected = read_json(lost, "")
    lost.unlink()
    before = {
        path: path.stat().st_mtime_ns
        for path in [*kept, *folder.glob("networks/*nn/*/weights.npz")]
    }
    assert call("sweep", folder, "--jobs", 1, *GRID, "--json") == 0
    assert {path: path.stat().st_mtime_ns for path in before} == before
    again = read_json(lost, "")
    # Made by this process, the others by a cluster's worker.
    assert {**again, "seconds": 0} == {**expected, "seconds": 0}
    summary = json.loads(capsys.readouterr().out)
    assert summary == read_json(folder / "sweep.json", "")
    resumed, whole = (read_json(f / "sweep.json", "")["points"] for f in (folder, tiny_sweep))
    np.testing.assert_equal([p["accuracy"] for p in resumed], [p["accuracy"] for p in whole])
    # The file is the same but for times: its keys are in the same order too.
    assert [list(point) for point in resumed] == [list(point) for point in whole]


def test_a_sweep_that_has_no_point_yet_is_no_run(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sweep, "run_study", lambda *arguments: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        call("sweep", tmp_path / "out", *TINY, *GRID)
    assert call("train", tmp_path / "out") == 2
    assert "results of a sweep" in capsys.readouterr().err
    monkeypatch.setattr(sweep, "run_study", lambda *arguments: ([], {}))
    assert call("sweep", tmp_path / "out", *TINY, *GRID) == 0


def test_a_sweep_on_events(tmp_path, capsys):
    folder = tmp_path / "out"
    tiny = ("--set", "data.samples_per_digit=40", "--set", "events.epochs=1", "--jobs", 1)
    tiny += ("--set", "input.step=500", "--set", "events.batch_size=96")
    grid = ("--grid", "events.architecture=10x10x2-4c4s3-16-10o,10x10x2-6c4s3-10o")
    assert call("sweep", folder, "--input", "events", *tiny, *grid) == 0
    assert "10x10x2-6c4s3-10o" in capsys.readouterr().out
    points = read_json(folder / "sweep.json", "")["points"]
    sizes = {p["changes"]["events.architecture"].count("-"): p for p in points}
    assert list(sizes[3]["spikes"]) == ["input", "conv1", "dense1"]
    assert list(sizes[2]["spikes"]) == ["input", "conv1"]
    assert (sizes[3]["cores"], sizes[2]["cores"]) == (2, 1)
    for p in points:
        assert p["n_samples"] == 48
    assert not (folder / "networks" / "cnn").exists()
    for curve in folder.rglob("history.csv"):
        assert "val_accuracy" in curve.read_text().splitlines()[0].split(",")  # of held-out samples


def test_a_sweep_over_the_kind_of_input(tmp_path):
    """Each point has the stages of its own kind of network."""
    tiny = ("--set", "data.samples_per_digit=40", "--set", "events.epochs=1", "--set")
    tiny += ("cnn.epochs=1", "--set", "snn.epochs=1", "--set", "input.step=500", "--jobs", 1)
    assert call("sweep", tmp_path / "out", *tiny, "--grid", "input.kind=image,events") == 0
    sweep = read_json(tmp_path / "out" / "sweep.json", "")
    assert {point["changes"]["input.kind"] for point in sweep["points"]} == {"image", "events"}
    assert all(point["trained_accuracy"] is not None for point in sweep["points"])
