"""Five gestures on a skin of 16 by 12, from event files to the report."""

import io
import shutil
import zipfile

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from deploy.files import read_json
from pipeline.sources import load_recordings
from tests.command import call, hurry_emulator
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
def run(made_once):
    return made_once("gestures", make) / "run"


def make(folder):
    rng = np.random.default_rng(0)
    members = {f"{name}/{i:02d}.npz": gesture(name, rng) for name in NAMES for i in range(30)}
    archive(folder / "gestures.zip", members)
    architecture = "cnn.architecture=16x12-4c4s2-5o"
    with hurry_emulator():
        status = call(
            *("ladder", folder / "run", "--data", folder / "gestures.zip", "--set", architecture),
            *("--set", "cnn.epochs=15", "--set", "snn.epochs=5"),
            *("--samples", "20", "--steps", "40"),
        )
    assert status == 0


def test_names_and_sizes_in_the_run(run):
    facts = read_json(run / "dataset.json", "")
    assert facts["samples_per_class"] == dict.fromkeys(NAMES, 30)
    assert (facts["sensor"]["rows"], facts["sensor"]["columns"]) == (ROWS, COLUMNS)
    spec = read_bundle(run / "bundle").spec
    assert spec.input_shape == (ROWS, COLUMNS, 1)
    assert tuple(spec.provenance.classes) == NAMES


def test_names_in_the_ladder(run):
    table = read_json(run / "ladder.json", "")
    assert tuple(table["classes"]) == NAMES
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


def part_of(run, folder, names=NAMES[:2], count=4, change=None):
    """Some recordings of the run's source in a new folder, perhaps changed."""
    with zipfile.ZipFile(run.parent / "gestures.zip") as file:
        for name in names:
            for i in range(count):
                content = file.read(f"{name}/{i:02d}.npz")
                if change is not None:
                    with np.load(io.BytesIO(content)) as arrays:
                        content = npz(**change(dict(arrays)))
                (folder / name).mkdir(parents=True, exist_ok=True)
                (folder / name / f"copy{i}.npz").write_bytes(content)
    return folder


def checked(run, folder, capsys):
    """The result of a check on other recordings, and what was said."""
    out = folder.parent / "out.json"
    command = ("check", "run", run, "--target", "fast", "--data", folder, "--out", out)
    status = call(*command)
    return status, read_json(out, "") if status == 0 else None, capsys.readouterr()


def test_recordings_of_the_training_are_recognised_by_their_content(run, tmp_path, capsys):
    """Copies of single recordings with other names, in another folder and format."""
    bundle = read_bundle(run / "bundle")
    trained = bundle.spec.provenance.entries["training_recordings"]
    assert len(trained) == len(set(trained)) == 120
    same = load_recordings(str(part_of(run, tmp_path / "same")), jobs=1)
    expected = sum(content in trained for content in same.hashes)
    assert 0 < expected < 8
    _, result, printed = checked(run, tmp_path / "same", capsys)
    assert result["data"]["trained_on"] == expected
    assert f"{expected} of 8 recordings were used to make the network" in printed.err
    assert f"{expected} of them were used" in printed.out
    copied = shutil.copytree(run / "bundle", tmp_path / "elsewhere" / "bundle")
    _, result, printed = checked(copied, tmp_path / "same", capsys)
    assert result["data"]["trained_on"] == expected
    later = part_of(run, tmp_path / "new", change=lambda a: {**a, "t": 1.01 * a["t"]})
    _, result, printed = checked(run, later, capsys)
    assert result["data"]["trained_on"] == 0
    assert "used to make" not in printed.err
