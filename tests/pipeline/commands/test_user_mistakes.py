"""A mistake is one clear line on standard error with the remedy, status 2, and nothing is lost."""

import contextlib
import json
import os
import shutil
import signal

import numpy as np
import pytest
from joblib import delayed

from deploy.check.results import read_result
from deploy.files import read_arrays, read_json, write_json
from pipeline import progress, workflow
from pipeline.jobs import call_in_processes
from pipeline.kinds import records
from pipeline.recordings.files.writing import write_recordings
from pipeline.settings import Settings, read_settings
from pipeline.storage.run_folder import RunFolder
from tests.command import call, missing, plain, started, wait_until_said
from tests.pipeline.handmade import archive, good_members

TINY = ["--set", "data.samples_per_digit=20", "--set", "check.samples=20"]


def content(folder):
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file() and p.name != ".lock"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "'stmnist --help'"),
        (["check"], "'stmnist check --help'"),
        (["fly"], "'fly'"),
        (["check", "run"], "bundle"),
        (["check", "run", "x"], "--target"),
        (["train", "x", "--seed", "one"], "--seed"),
        (["train", "x", "--fast"], "--fast"),
        (["data", "import", "nowhere.zip"], "nowhere.zip: "),
        (["data", "inspect", "nowhere.mat"], "nowhere.mat: "),
        (["data", "inspect", "."], "data stats --data"),
        (["check", "run", "nowhere", "--target", "nengo"], "nowhere: "),
        (["check", "compare", "a.json", "b.json"], "a.json: "),
    ],
)
def test_wrong_usage_and_wrong_paths(refused, tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    assert said in refused(*arguments)
    assert not list(tmp_path.iterdir())


def test_inspecting_a_zip_says_what_describes_all_of_it(refused, tmp_path):
    path = tmp_path / "own.zip"
    path.touch()
    assert missing(refused("data", "inspect", path), "own.zip: is a zip", "data stats") == []


def test_a_wrong_path_does_not_stick_to_the_run(refused, run):
    before = content(run)
    assert "nowhere.zip: " in refused("ladder", run, "--data", "nowhere.zip")
    assert content(run) == before
    assert call("ladder", run) == 0


def test_more_samples_than_the_test_split_has(refused, run):
    before = content(run)
    line = refused("ladder", run, "--samples", 121)
    assert missing(line, 121, 120, "--samples") == []
    assert content(run) == before
    assert call("ladder", run) == 0


@pytest.mark.parametrize(
    ("toml", "said"),
    [
        ("[cnn]\nepoch = 3\n", "'cnn.epoch'"),
        ("seed = 1\nseed = 2\n", "TOML"),
        (b"\xff\xfe", "TOML"),
    ],
)
def test_a_broken_experiment_toml(refused, run, toml, said):
    path = run / "experiment.toml"
    path.write_bytes(toml if isinstance(toml, bytes) else toml.encode())
    before = content(run)
    line = refused("ladder", run)
    assert said in line
    assert "experiment.toml" in line
    assert content(run) == before
    assert said in refused("train", run.parent / "new", "--settings", path)


def test_a_run_folder_that_cannot_be_written(refused, tmp_path):
    (tmp_path / "file").write_text("mine")
    for folder in (tmp_path / "file" / "run", tmp_path / "file"):
        assert f"{folder}: " in refused("ladder", folder, *TINY)
    assert (tmp_path / "file").read_text() == "mine"


def test_a_corrupt_cache(refused, tmp_path, monkeypatch):
    archive(tmp_path / "st.zip", good_members(2))
    monkeypatch.setenv("STMNIST_CACHE", str(tmp_path / "cache"))
    command = ("data", "import", tmp_path / "st.zip", "--jobs", 1)
    assert call(*command) == 0
    (cached,) = (tmp_path / "cache").glob("recordings-*.npz")
    damaged = bytearray(cached.read_bytes())
    damaged[len(damaged) // 2] ^= 0xFF
    cached.write_bytes(damaged)
    line = refused(*command)
    assert str(cached) in line
    cached.unlink()
    assert call(*command) == 0
    column = next((tmp_path / "cache").glob("recordings-*-time_ns.npy"))
    column.write_bytes(column.read_bytes()[:-8])
    assert str(column) in refused(*command)
    cached.unlink()
    assert call(*command) == 0
    (source,) = (tmp_path / "cache").glob("source-*.json")
    source.write_text("{")
    assert str(source) in refused(*command)


def test_a_process_that_is_killed(refused, tmp_path, monkeypatch):
    archive(tmp_path / "st.zip", good_members(2))

    def killed(_):
        with call_in_processes([delayed(os.kill)(0, 0), delayed(os.abort)()], 2) as results:
            return list(results)

    monkeypatch.setattr("pipeline.recordings.facts.list_facts_with_events", killed)
    assert "--jobs" in refused("data", "import", tmp_path / "st.zip", "--jobs", 1)


def test_recordings_that_are_there_twice(tmp_path):
    """Copies on both sides of the split, or in two classes, are said before a training."""
    times = [[0, 1000 + n, 90_000] for n in range(20)]
    own = [(([0, 1, 2], [0, 1, 1], t, [1, 0, 1]), f"class {n % 2}") for n, t in enumerate(times)]

    def said(name, recordings):
        data, lines = write_recordings(tmp_path / name, recordings, time_unit="us"), []
        changes = {"data": {"source": str(data)}, "input": {"kind": "events"}}
        workflow.open_run(
            RunFolder(tmp_path / "run"), Settings().with_values(changes), say=lines.append
        )
        return " ".join(lines)

    once = said("once.zip", own)
    assert "also in" not in once
    assert "only 4" in once
    both = said("twice.zip", own * 2)
    assert "also in training" in both
    assert "another class" not in both
    moved = said("moved.zip", [*own, (own[0][0], "class 1")])
    assert "also in another class: 1, such as " in moved


def test_every_kind_of_bad_recording_has_a_line(tmp_path, capsys):
    bad = {"data_submission/3/a.mat": b"x", "data_submission/4/b.mat": b""}
    archive(tmp_path / "st.zip", {**good_members(), **bad})
    assert call("data", "import", tmp_path / "st.zip", "--jobs", 1) == 2
    first, *lines = capsys.readouterr().err.splitlines()
    assert missing(first, "2 of 12", "data.skip_bad") == []
    assert len(lines) == 2
    for name in ("3/a.mat", "4/b.mat"):
        assert sum(name in line for line in lines) == 1


def test_skipping_them_lists_them_and_goes_on(tmp_path, capsys):
    archive(tmp_path / "st.zip", {**good_members(), "3/a.mat": b"x", "4/b.mat": b""})
    command = (
        "data",
        "import",
        tmp_path / "st.zip",
        "--jobs",
        1,
        "--set",
        "data.skip_bad=true",
        "--json",
    )
    assert call(*command) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["samples"] == 10
    assert missing(err, "3/a.mat: ", "4/b.mat: ") == []


def test_a_bundle_with_a_changed_byte(refused, run):
    path = run / "bundle" / "weights.npz"
    damaged = bytearray(path.read_bytes())
    damaged[100] ^= 1
    path.write_bytes(damaged)
    before = content(run)
    for command in (["check", "run", run / "bundle", "--target", "nengo"], ["ladder", run]):
        line = refused(*command)
        assert f"{path}: " in line
    assert content(run) == before
    shutil.rmtree(run / "bundle")
    assert call("ladder", run) == 0


def test_a_result_of_another_bundle(refused, run):
    result = read_json(run / "checks" / "emulator.json", "")
    write_json(run / "other.json", {**result, "bundle": "0" * 64})
    line = refused("check", "compare", run / "checks" / "nengo.json", run / "other.json")
    assert "bundles" in line


OTHERS = (
    {"bundle": "0" * 64},
    {"target": "fast"},
    {"data": {"source": "a", "sha256": "b", "recordings": 9}},
)


@pytest.mark.parametrize("other", OTHERS, ids=lambda other: next(iter(other)))
def test_a_result_of_another_check_in_the_run_is_made_anew(run, other, capsys):
    path = run / "checks" / "emulator.json"
    original = read_result(path)
    write_json(path, {**original.to_dict(), **other})
    assert call("status", run) == 0
    assert "outdated" in capsys.readouterr().out
    assert call("ladder", run) == 0
    again = read_result(path)
    assert again["bundle"] == original["bundle"]
    assert again["samples"] == original["samples"]


BROKEN = {"empty": b"", "half": None, "text": b"hello", "list": b"[]", "another": b"{}"}


@pytest.mark.parametrize(
    ("stage", "how"), [("cnn", "half"), ("cnn", "another"), *(("nengo", how) for how in BROKEN)]
)
def test_a_broken_check_result(refused, run, stage, how):
    path = run / "checks" / f"{stage}.json"
    half = path.read_bytes()[: path.stat().st_size // 2]
    path.write_bytes(half if BROKEN[how] is None else BROKEN[how])
    before = content(run)
    line = refused("ladder", run)
    assert str(path) in line
    assert content(run) == before


def test_a_broken_check_result_is_made_anew_once_it_is_removed(refused, run):
    path = run / "checks" / "nengo.json"
    path.write_bytes(BROKEN["text"])
    refused("ladder", run)
    path.unlink()
    assert call("ladder", run) == 0
    assert read_result(path)["target"] == "nengo"


@pytest.mark.parametrize("network", ["cnn", "snn"])
def test_broken_metrics(refused, run, network):
    path = run / network / "metrics.json"
    path.write_bytes(path.read_bytes()[:50])
    line = refused("ladder", run)
    assert str(path) in line
    path.write_text("{}")  # says nothing: the stage is done again
    assert call("convert", run) == 0
    assert "accuracy" in read_json(path, "")


@pytest.mark.parametrize(
    ("network", "how"),
    [("cnn", "half"), *(("snn", how) for how in ("half", "other arrays", "other shape", "pickle"))],
)
def test_broken_weights(refused, run, network, how):
    path = run / network / "weights.npz"
    with np.load(path) as file:
        arrays = dict(file)
    if how == "half":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    elif how == "other arrays":
        np.savez(path, x=np.zeros(3))
    else:
        new = np.zeros((3, 3)) if how == "other shape" else np.array([{}], dtype=object)
        np.savez(path, **{**arrays, "conv1.kernel": new})
    shutil.rmtree(run / "bundle")
    line = refused("convert", run)
    assert str(path) in line


def interrupt(process):
    """Ctrl-C on a terminal: the whole group gets it, and none of it is left."""
    os.killpg(process.pid, signal.SIGINT)
    err = plain(process.communicate(timeout=300)[1])
    assert process.returncode == 130, err
    assert "Traceback" not in err, err
    assert "stmnist: interrupted" in err


def temporaries(folder):
    kept = {".lock"}
    return [p for p in folder.rglob(".*") if p.name not in kept]


@pytest.mark.slow
def test_ctrl_c_in_training(tmp_path):
    folder = RunFolder(tmp_path / "run")
    with started("train", folder.path, *TINY, "--set", "cnn.epochs=100000") as process:
        wait_until_said(process, r"train cnn accuracy \d")
        interrupt(process)
    assert not temporaries(folder.path)
    assert not (folder.path / "cnn").exists()
    assert read_settings(folder.experiment).cnn.epochs == 100000
    assert call("train", folder.path, "--set", "cnn.epochs=1") == 0
    assert (folder.path / "cnn" / "metrics.json").exists()


def test_a_training_that_was_killed_goes_on_and_ends_alike(tmp_path, monkeypatch):
    """A killed process leaves the folder as it is after an epoch."""
    whole, killed = (RunFolder(tmp_path / name) for name in ("whole", "killed"))
    options = (*TINY, "--set", "cnn.epochs=3")

    @contextlib.contextmanager
    def copy_after_an_epoch(label, total, unit):
        def advance(n=1, note=None):
            if not killed.path.exists():
                shutil.copytree(whole.path, killed.path)

        yield advance

    with monkeypatch.context() as patched:
        patched.setattr(records, "progress", copy_after_an_epoch)
        assert call("train", whole.path, *options) == 0
    assert not (killed.path / "cnn" / "metrics.json").exists()
    assert call("train", killed.path, *options) == 0
    assert not temporaries(killed.path)
    expected, found = (
        read_arrays(folder.path / "cnn" / "weights.npz", "") for folder in (whole, killed)
    )
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array)


def test_a_check_that_was_interrupted_goes_on(run, monkeypatch):
    out = run / "checks" / "again.json"
    partial = out.with_name(".again.json.partial")
    command = ("check", "run", run / "bundle", "--target", "nengo", "--out", out)

    @contextlib.contextmanager
    def ctrl_c_after_a_stream(label, total):
        def advance(n=1, note=None):
            raise KeyboardInterrupt

        yield advance

    with monkeypatch.context() as patched:
        patched.setattr(progress, "progress", ctrl_c_after_a_stream)
        assert call(*command) == 130
    assert not out.exists()
    assert temporaries(run) == [partial]
    assert partial.read_text().count('"first": ') == 1
    assert call(*command) == 0
    assert not temporaries(run)
    assert read_result(out)["samples"] == read_result(run / "checks" / "nengo.json")["samples"]
