"""Five gestures on a skin of 16 by 12, from event files to the report."""

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from deploy.files import read_json
from tests.command import call
from tests.pipeline.handmade import archive, npz

NAMES = ("circle", "line 2", "line 10", "wave", "zig-zag")
ROWS, COLUMNS = 16, 12


def gesture(kind, rng):
    """A stroke over the skin as a `.npz` of x, y, t, p."""
    along = np.sort(rng.uniform(0, 1, 60))
    y, x = {
        "circle": (8 + 5 * np.cos(2 * np.pi * along), 6 + 4 * np.sin(2 * np.pi * along)),
        "line 2": (15 * along, 2 + 0 * along),
        "line 10": (15 * along, 10 + 0 * along),
        "wave": (8 + 6 * np.sin(4 * np.pi * along), 11 * along),
        "zig-zag": (4 + 8 * (along * 4 % 1), 11 * along),
    }[kind]
    y, x = (np.clip(np.rint(a + rng.normal(0, 0.5, 60)), 0, n - 1).astype(int)
            for a, n in ((y, ROWS), (x, COLUMNS)))  # fmt: skip
    return npz(x=x, y=y, t=0.2 + along, p=rng.choice([-1, 1], 60))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gestures")
    rng = np.random.default_rng(0)
    members = {f"{name}/{i:02d}.npz": gesture(name, rng) for name in NAMES for i in range(30)}
    archive(folder / "gestures.zip", members)
    architecture = "cnn.architecture=16x12-4c4s2-5o"
    status = call(
        *("ladder", folder / "run", "--data", folder / "gestures.zip", "--set", architecture),
        *("--set", "cnn.epochs=15", "--set", "snn.epochs=5"),
        *("--samples", "20", "--steps", "40"),
    )
    assert status == 0
    return folder / "run"


def test_names_and_sizes_in_the_run(run):
    facts = read_json(run / "dataset.json", "")
    assert facts["samples_per_class"] == dict.fromkeys(NAMES, 30)
    assert (facts["sensor"]["rows"], facts["sensor"]["columns"]) == (ROWS, COLUMNS)
    spec = read_bundle(run / "bundle").spec
    assert spec.input_shape == (ROWS, COLUMNS, 1)
    assert tuple(spec.provenance["classes"]) == NAMES


def test_names_in_the_ladder(run):
    table = read_json(run / "ladder.json", "")
    assert tuple(table["classes"]) == NAMES
    for row in table["rows"]:
        assert np.shape(row["confusion"]) == (5, 5)
    rows = {row["stage"]: row["accuracy"] for row in table["rows"]}
    assert rows["cnn"] >= 0.8
    assert rows["emulator"] >= 0.6


def test_names_in_the_report(run):
    assert call("report", run) == 0
    page = (run / "report.html").read_text(encoding="utf-8")
    for name in NAMES:
        assert f"</b> {name}</th>" in page  # beside the confusion matrix
        assert f"<td>{name}</td>" in page
    assert "digit" not in page
