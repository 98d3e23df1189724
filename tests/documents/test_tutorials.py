"""The tutorials are executed as a user does it, and their lessons hold."""

import itertools
import json
import shutil

import numpy as np
import pytest

from experiments.tutorials import FOLDER, execute
from pipeline.recordings.files.writing import write_recordings
from tests.command import ROOT, printed_by, users_environment
from tests.documents.brief import hurry_runs
from tests.test_tutorials import LESSONS, notebooks, read_stored_ladders

# The published training part of ST-MNIST, which is not in the repository.
REAL = ROOT.parent / "shared" / "data" / "stmnist-train.zip"

EXECUTE = """
import json, sys
from experiments.tutorials import FOLDER, execute
execute(json.loads((FOLDER / f"{sys.argv[1]}.ipynb").read_text(encoding="utf-8")), ".")
"""


def read_accuracies(run):
    ladder = json.loads((run / "ladder.json").read_text(encoding="utf-8"))
    return {row["stage"]: row["accuracy"] for row in ladder["rows"]}


@pytest.mark.slow
@pytest.mark.parametrize("name", LESSONS)
def test_lessons_hold(tmp_path, name):
    """As a user executes it, in a process of its own."""
    shutil.copy(FOLDER / "network.nir", tmp_path)
    printed_by(EXECUTE, name, env=users_environment(), cwd=tmp_path)
    check, runs = LESSONS[name]
    ladders = [read_accuracies(tmp_path / "runs" / run) for run in runs]
    check(*ladders)
    for ladder, stored in zip(ladders, read_stored_ladders(name), strict=True):
        assert ladder.keys() == stored.keys()


def write_objects(folder):
    """Recordings that stand in for the real objects, each class on taxels of its own."""
    rng, recordings, parts = np.random.default_rng(0), [], []
    for label, part in itertools.product(range(21), ("train", "train", "train", "test")):
        x, t = rng.integers(label, label + 3, 60), np.sort(rng.uniform(0, 2, 60))
        recordings.append(((x, np.zeros(60, int), t, rng.integers(0, 2, 60)), label))
        parts.append(part)
    names = [str(label) for label in range(21)]
    return write_recordings(folder / "objects.zip", recordings, names, "s", parts=parts)


def write_digits(folder):
    """Recordings that stand in for the real digits: each in rows of its own, one hot taxel."""
    rng, recordings = np.random.default_rng(0), []
    for number in range(500):
        digit, n = number % 10, 60
        x, y = rng.integers(0, 10, n), rng.integers(digit, min(digit + 3, 10), n)
        x[:20], y[:20] = 1, 4
        t = np.sort(rng.integers(0, 100, n)) * 20_000
        recordings.append(((x, y, t, rng.integers(0, 2, n)), str(digit)))
    names = [str(digit) for digit in range(10)]
    return write_recordings(folder / "digits.zip", recordings, names, "us")


@pytest.mark.slow
@pytest.mark.parametrize("is_real", [False, True])
def test_real_touch(tmp_path, monkeypatch, is_real):
    """On objects that stand in; on digits that stand in, and on the real ones."""
    if is_real and not REAL.exists():
        pytest.skip(f"{REAL.name}, real recordings, is not here")
    monkeypatch.setenv("TOUCH", str(write_objects(tmp_path)))
    monkeypatch.setenv("DIGITS", str(REAL if is_real else write_digits(tmp_path)))
    with hurry_runs():
        execute(notebooks()["4-real-touch"], tmp_path)
    run = tmp_path / "runs" / "objects"
    assert read_accuracies(run).keys() == {"counts", "trained", "emulator"}
    assert read_accuracies(run)["counts"] > 0.5
    assert (run / "report.html").is_file()
