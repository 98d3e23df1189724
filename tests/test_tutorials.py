"""What the tutorials show: their outputs are stored, and teach what the text says.

`tests/documents/test_tutorials.py` executes them.
"""

import json
import re

import pytest

from experiments.tutorials import FOLDER, execute


def notebooks():
    return {path.stem: json.loads(path.read_text("utf-8")) for path in FOLDER.glob("*.ipynb")}


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
