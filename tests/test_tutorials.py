"""Tutorials run as they are shown, and their lessons hold."""

import itertools
import json
import os
import re
import shutil

import numpy as np
import pytest

from experiments.tutorials import FOLDER, execute
from pipeline.recordings.writing import write_recordings
from tests.brief import hurry_runs
from tests.command import ROOT, printed_by, users_environment

# The published training part of ST-MNIST, which is not in the repository.
REAL = ROOT.parent / "shared" / "data" / "stmnist-train.zip"

EXECUTE = """
import json, sys
from experiments.tutorials import FOLDER, execute
execute(json.loads((FOLDER / f"{sys.argv[1]}.ipynb").read_text(encoding="utf-8")), ".")
"""


def notebooks():
    return {path.stem: json.loads(path.read_text("utf-8")) for path in FOLDER.glob("*.ipynb")}


def read_accuracies(run):
    ladder = json.loads((run / "ladder.json").read_text(encoding="utf-8"))
    return {row["stage"]: row["accuracy"] for row in ladder["rows"]}


def read_stored_ladders(name):
    """The accuracy of each stage, for each ladder that a notebook has among its outputs."""
    cells = [cell for cell in notebooks()[name]["cells"] if cell["cell_type"] == "code"]
    texts = ["".join(output.get("text", ())) for cell in cells for output in cell["outputs"]]
    return [
        {
            stage: float(accuracy)
            for stage, accuracy in re.findall(r"^(\S+) +(0\.\d{3}) ", text, re.M)
        }
        for text in texts
        if text.startswith("Loss ladder")
    ]


def check_the_first_network(images, events):
    assert 0.65 < images["emulator"] < 0.9
    assert 0.65 < events["emulator"] < 0.9
    assert abs(images["emulator"] - images["rate-lif"]) < 0.08  # 120 recordings
    assert abs(events["emulator"] - events["trained"]) < 0.03


def check_your_own_sensor(events, images):
    assert 0.75 < events["emulator"] < 1  # noisy gestures, so that there is something to learn
    assert max(events["counts"], images["emulator"]) < events["emulator"]


def check_a_network_from_pytorch(of_torch):
    assert of_torch["nir"] > 0.75
    assert abs(of_torch["emulator"] - of_torch["nir"]) < 0.04


# For each tutorial that needs no other data: its lessons, and its runs in their order.
LESSONS = {
    "1-first-network": (check_the_first_network, ("image", "events")),
    "2-own-sensor": (check_your_own_sensor, ("gestures", "gestures-image")),
    "3-from-pytorch": (check_a_network_from_pytorch, ("torch",)),
}


@pytest.mark.parametrize("name", sorted(notebooks()))
def test_outputs_are_stored_and_small(name):
    cells = [c for c in notebooks()[name]["cells"] if c["cell_type"] == "code"]
    assert (FOLDER / f"{name}.ipynb").stat().st_size < 400_000
    assert [c["execution_count"] for c in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert {"stream", "display_data"} <= {output["output_type"] for output in outputs}


@pytest.mark.parametrize("name", LESSONS)
def test_stored_outputs_show_the_lessons(name):
    check, runs = LESSONS[name]
    ladders = read_stored_ladders(name)
    assert len(ladders) == len(runs)
    check(*ladders)


def test_a_notebook_gets_the_outputs_of_its_cells(tmp_path):
    cell = {"cell_type": "code", "metadata": {}, "outputs": [], "execution_count": None}
    code = ["import matplotlib.pyplot as plt\n", "print(1)\n", "plt.plot([1, 2])"]
    text = {"cell_type": "markdown", "metadata": {}, "source": ["# title"]}
    cells = [{**cell, "source": code}, text, {**cell, "source": ["x = 2"]}]
    made, names = execute({"cells": cells}, tmp_path)
    first, second, third = made["cells"]
    assert [output["output_type"] for output in first["outputs"]] == ["stream", "display_data"]
    assert first["outputs"][0]["text"] == ["1\n"]
    assert second == text
    assert third["outputs"] == []
    assert (third["execution_count"], names["x"]) == (2, 2)


@pytest.mark.slow
@pytest.mark.parametrize("name", LESSONS)
def test_every_cell_runs(tmp_path, name):
    """With networks that learn little, so that no lesson is looked for."""
    shutil.copy(FOLDER / "network.nir", tmp_path)
    with hurry_runs():
        notebook, _ = execute(notebooks()[name], tmp_path)
    kinds = [
        [[output["output_type"] for output in cell.get("outputs", ())] for cell in each["cells"]]
        for each in (notebook, notebooks()[name])
    ]
    assert kinds[0] == kinds[1]
    _, runs = LESSONS[name]
    for run, stored in zip(runs, read_stored_ladders(name), strict=True):
        assert read_accuracies(tmp_path / "runs" / run).keys() == stored.keys()


@pytest.mark.slow
@pytest.mark.skipif(
    not os.environ.get("TEST_TUTORIALS"), reason="trains for minutes; 'make test-tutorials'"
)
@pytest.mark.parametrize("name", LESSONS)
def test_lessons_hold(tmp_path, name):
    """As a user executes it, in a process of its own."""
    shutil.copy(FOLDER / "network.nir", tmp_path)
    printed_by(EXECUTE, name, env=users_environment(), cwd=tmp_path)
    check, runs = LESSONS[name]
    check(*(read_accuracies(tmp_path / "runs" / run) for run in runs))


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
    if is_real and not os.environ.get("TEST_TUTORIALS"):
        pytest.skip("reads thousands of recordings; 'make test-tutorials'")
    monkeypatch.setenv("TOUCH", str(write_objects(tmp_path)))
    monkeypatch.setenv("DIGITS", str(REAL if is_real else write_digits(tmp_path)))
    with hurry_runs():
        execute(notebooks()["4-real-touch"], tmp_path)
    run = tmp_path / "runs" / "objects"
    assert read_accuracies(run).keys() == {"counts", "trained", "emulator"}
    assert read_accuracies(run)["counts"] > 0.5
    assert (run / "report.html").is_file()
