"""Tutorials run as they are shown, and their lessons hold."""

import itertools
import json
import shutil

import numpy as np
import pytest

from experiments.tutorials import FOLDER, execute
from pipeline.recordings.writing import write_recordings
from tests.command import ROOT, printed_by, users_environment

# The published training part of ST-MNIST, which is not in the repository.
REAL = ROOT.parent / "shared" / "data" / "stmnist-train.zip"

CODE = """
import json, sys
from experiments.tutorials import FOLDER, execute
text = (FOLDER / f"{sys.argv[1]}.ipynb").read_text(encoding="utf-8")
for change in sys.argv[2:]:
    before, after = change.split(" -> ")
    assert before in text
    text = text.replace(before, after)
execute(json.loads(text), ".")
"""


def notebooks():
    return {path.stem: json.loads(path.read_text("utf-8")) for path in FOLDER.glob("*.ipynb")}


def accuracies(run):
    ladder = json.loads((run / "ladder.json").read_text(encoding="utf-8"))
    return {row["stage"]: row["accuracy"] for row in ladder["rows"]}


@pytest.mark.parametrize("name", sorted(notebooks()))
def test_outputs_are_stored_and_small(name):
    cells = [c for c in notebooks()[name]["cells"] if c["cell_type"] == "code"]
    assert (FOLDER / f"{name}.ipynb").stat().st_size < 400_000
    assert [c["execution_count"] for c in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert {"stream", "display_data"} <= {output["output_type"] for output in outputs}


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
def test_the_first_network(tmp_path):
    printed_by(CODE, "1-first-network", env=users_environment(), cwd=tmp_path)
    images, events = (accuracies(tmp_path / "runs" / name) for name in ("image", "events"))
    assert 0.65 < images["emulator"] < 0.9
    assert 0.65 < events["emulator"] < 0.9
    assert abs(images["emulator"] - images["rate-lif"]) < 0.08  # 120 recordings
    assert abs(events["emulator"] - events["trained"]) < 0.03


@pytest.mark.slow
def test_your_own_sensor(tmp_path):
    printed_by(CODE, "2-own-sensor", env=users_environment(), cwd=tmp_path)
    events = accuracies(tmp_path / "runs" / "gestures")
    images = accuracies(tmp_path / "runs" / "gestures-image")
    assert 0.75 < events["emulator"] < 1  # noisy gestures, so that there is something to learn
    assert max(events["counts"], images["emulator"]) < events["emulator"]
    assert (tmp_path / "runs" / "gestures" / "report.html").is_file()


@pytest.mark.slow
def test_a_network_from_pytorch(tmp_path):
    shutil.copy(FOLDER / "network.nir", tmp_path)
    printed_by(CODE, "3-from-pytorch", env=users_environment(), cwd=tmp_path)
    of_torch = accuracies(tmp_path / "runs" / "torch")
    assert of_torch["nir"] > 0.75
    assert abs(of_torch["emulator"] - of_torch["nir"]) < 0.04


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
def test_real_touch(tmp_path, is_real):
    """On objects that stand in, with two epochs; on digits that stand in, and on the real ones."""
    if is_real and not REAL.exists():
        pytest.skip(f"{REAL.name}, real recordings, is not here")
    quick = (
        r"data=OBJECTS, input=\"events\", quiet=True -> "
        r"data=OBJECTS, input=\"events\", quiet=True, **{\"events.epochs\": 2}"
    )
    digits = REAL if is_real else write_digits(tmp_path)
    env = {**users_environment(), "TOUCH": str(write_objects(tmp_path)), "DIGITS": str(digits)}
    printed_by(CODE, "4-real-touch", quick, env=env, cwd=tmp_path)
    run = tmp_path / "runs" / "objects"
    assert accuracies(run).keys() == {"counts", "trained", "emulator"}
    assert accuracies(run)["counts"] > 0.5
    assert (run / "report.html").is_file()
