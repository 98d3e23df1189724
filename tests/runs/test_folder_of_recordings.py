"""A folder of a user's own recordings: ladder, report and checks without any option."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from deploy.check.results import read_result
from deploy.files import read_json
from pipeline.api.results import Predictions
from pipeline.recordings.files.writing import write_recordings
from pipeline.results import other_recordings
from pipeline.results.check_on_others import OtherRecordings
from tests.command import call, hurry_emulator, missing, users_environment
from tests.own_sensor import CLASSES, gestures, write_folder

# What a user need not give: the test would take minutes without it.
QUICK = {
    "image": ("--set", "cnn.epochs=6", "--set", "snn.epochs=2"),
    "events": ("--input", "events", "--set", "events.epochs=3"),
}


@pytest.fixture(scope="module")
def folder(made_once):
    return made_once("own-kind", make)


def make(folder):
    write_folder(folder / "own", per_class=25)
    people = write_recordings(
        folder / "people.zip", gestures(6, seed=7), CLASSES, "s", writers=[i % 3 for i in range(24)]
    )
    assert people.exists()
    with hurry_emulator():
        for kind, quick in QUICK.items():
            assert call("ladder", folder / kind, "--data", folder / "own", *quick) == 0


@pytest.mark.parametrize("kind", QUICK)
def test_the_ladder_has_the_user_s_classes_and_as_many_samples_as_there_are(folder, kind):
    ladder = read_json(folder / kind / "ladder.json", "")
    assert tuple(ladder["classes"]) == CLASSES
    assert ladder["n_samples"] == 20
    spec = read_bundle(folder / kind / "bundle").spec
    assert spec.input_shape == (9, 12, 1 if kind == "image" else 2)


def test_the_accuracy_of_training_is_that_of_the_ladder(folder):
    """Both wait for the last spikes as long as the chip, and the check has all test samples."""
    metrics = read_json(folder / "events" / "snn" / "metrics.json", "")
    rows = read_json(folder / "events" / "ladder.json", "")["rows"]
    accuracy = {row["stage"]: row["accuracy"] for row in rows}
    assert metrics["accuracy"]["test"] == accuracy["trained"]


def test_few_recordings_choose_no_early_decision(folder):
    presentation = read_bundle(folder / "events" / "bundle").spec.presentation
    assert presentation.threshold == 1
    metrics = read_json(folder / "events" / "snn" / "metrics.json", "")
    assert metrics["decides_by_itself"]["samples"] < 100


@pytest.mark.parametrize("kind", QUICK)
def test_other_recordings_are_answered_by_the_same_network(folder, kind, capsys):
    run, out = folder / kind, folder / f"{kind}.json"
    others = ("--target", "fast", "--data", folder / "people.zip", "--out", out)
    assert call("check", "run", run, *others) == 0
    said = capsys.readouterr().out
    result = read_result(out)
    assert result["n_samples"] == result["data"]["recordings"] == 24
    assert tuple(result["classes"]) == CLASSES
    assert np.sum(result["confusion"]) == 24
    right = np.trace(result["confusion"])
    assert result["accuracy"] == pytest.approx(right / 24)
    assert [row["n"] for row in result["per_class"]] == [6, 6, 6, 6]
    assert [row["n"] for row in result["per_writer"]] == [8, 8, 8]
    assert sum(row["n"] * row["accuracy"] for row in result["per_writer"]) == pytest.approx(right)
    assert "writer" in said
    assert call("check", "run", run / "bundle", *others, "--samples", 5, "--json") == 0
    assert json.loads(capsys.readouterr().out)["n_samples"] == 5


@pytest.mark.parametrize("kind", QUICK)
def test_recordings_without_labels_are_classified(folder, kind, tmp_path, capsys):
    bundle = read_bundle(folder / kind / "bundle")
    for name in CLASSES[:2]:
        (tmp_path / "known" / name).mkdir(parents=True)
        shutil.copy(folder / "own" / name / "003.npz", tmp_path / "known" / name)
    known = Predictions(
        other_recordings.predict_recordings(bundle, OtherRecordings(tmp_path / "known")), CLASSES
    )
    assert set(known) == {f"{name}/003" for name in CLASSES[:2]}
    (tmp_path / "new" / "today").mkdir(parents=True)
    for name in CLASSES[:2]:
        shutil.copy(folder / "own" / name / "003.npz", tmp_path / "new" / "today" / f"{name}.npz")
    expected = {f"today/{name}": known[f"{name}/003"] for name in CLASSES[:2]}
    assert predict_by_command(folder / kind, tmp_path / "new", capsys) == expected
    # The same files without a folder around them, and one of them alone.
    flat = {name: known[f"{name}/003"] for name in CLASSES[:2]}
    assert predict_by_command(folder / kind, tmp_path / "new" / "today", capsys) == flat
    one = CLASSES[0]
    single = tmp_path / "new" / "today" / f"{one}.npz"
    assert predict_by_command(folder / kind, single, capsys) == {one: flat[one]}
    assert call("predict", folder / kind, single) == 0
    assert missing(capsys.readouterr().out, one, "probability") == []


def predict_by_command(run, path, capsys):
    """The predictions of the command line, by recording."""
    capsys.readouterr()
    assert call("predict", run, path, "--jobs", 1, "--json") == 0
    rows = json.loads(capsys.readouterr().out)["predictions"]
    for row in rows:
        if row["probability"] is not None:
            by_class = row["class_probabilities"]
            assert max(by_class, key=by_class.get) == row["class"]
            assert by_class[row["class"]] == pytest.approx(row["probability"], abs=1e-3)
    return {row["recording"]: row["class"] for row in rows}


def test_where_such_results_are_kept(folder):
    others = ("--target", "fast", "--data", folder / "people.zip")
    assert call("check", "run", folder / "image", *others) == 0
    (kept,) = (folder / "image" / "checks" / "other").glob("*.json")
    assert read_result(kept)["target"] == "fast"
    assert call("check", "run", folder / "events", *others) == 0
    (other,) = (folder / "events" / "checks" / "other").glob("*.json")
    assert call("check", "compare", kept, other) == 0  # two networks, the same recordings


def test_the_own_recordings_are_said_to_be_known(folder, capsys):
    out = folder / "own.json"
    shown = ("--target", "fast", "--data", folder / "own", "--samples", 0, "--out", out)
    assert call("check", "run", folder / "image", *shown) == 0
    assert read_result(out)["n_samples"] == 100
    assert missing(capsys.readouterr().err, "warning", "own: 80 of 100") == []


@pytest.mark.parametrize("kind", QUICK)
def test_a_readout_fitted_to_samples_of_the_check_is_said_to_be(folder, kind, tmp_path, capsys):
    new, out = tmp_path / "new", tmp_path / "out.json"
    command = ("adapt", folder / kind, "--data", folder / "own", "--out", new, "--json")
    assert call(*command) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["trained_on"], told["in_check"]) == (80, 20)
    assert told["others_before"] is told["others_after"] is None
    if told["bundle"] is None:
        pytest.skip("the fit of this network is no better")
    check = ("check", "run", new, "--target", "fast", "--out", out)
    assert call(*check) == 0
    assert "fitted to 20 of the 20 samples" in capsys.readouterr().err
    assert read_json(out, "")["trained_on"] == 20
    assert call(*check, "--data", folder / "own") == 0
    assert "100 of 100 recordings were used" in capsys.readouterr().err


def test_cut_ends_new_polarities_and_a_smaller_sensor_are_said(folder, tmp_path):
    slow = [((x, y, 2 * t, p), label) for (x, y, t, p), label in gestures(3, seed=5)]
    ends = [events[2][-1] - events[2][0] for events, _ in slow]
    source = write_recordings(tmp_path / "slow.zip", slow, CLASSES, "s")
    bundle = read_bundle(folder / "events" / "bundle")
    of_one = replace(bundle.spec, provenance=bundle.spec.provenance.with_entries(polarities=1))
    settings, changed = other_recordings.find_settings_around(bundle), replace(bundle, spec=of_one)
    read = other_recordings.read_recordings_for(changed, str(source), settings)
    said = other_recordings.list_warnings(changed, read)
    cut = sum(end >= bundle.spec.presentation.steps * 0.01 for end in ends)
    assert 0 < cut < len(ends)
    assert missing(" ".join(said), f"{cut} of {len(ends)} recordings are longer", "OFF") == []
    small = [((x // 3, y // 3, t, p), label) for (x, y, t, p), label in gestures(3)]
    source = write_recordings(tmp_path / "small.zip", small, CLASSES, "s")
    read = other_recordings.read_recordings_for(bundle, str(source), settings)
    said = " ".join(other_recordings.list_warnings(bundle, read))
    assert missing(said, "3 of 9 rows and 4 of 12 columns") == []


def test_a_short_touch_is_not_said_to_be_of_a_smaller_sensor(folder, tmp_path):
    bundle = read_bundle(folder / "events" / "bundle")
    settings = other_recordings.find_settings_around(bundle)
    (x, y, t, p), label = gestures(1)[0]
    source = write_recordings(
        tmp_path / "touch.zip", [((x // 2, y // 2, t, p), label)], CLASSES, "s"
    )
    read = other_recordings.read_recordings_for(bundle, str(source), settings)
    assert "smaller sensor" not in " ".join(other_recordings.list_warnings(bundle, read))


def test_recordings_of_other_classes_or_sensors_are_refused(folder, tmp_path, capsys):
    renamed = [(events, f"class {label}") for events, label in gestures(2)]
    write_recordings(tmp_path / "renamed.zip", renamed)
    larger = [((2 * x, y, t, p), label) for (x, y, t, p), label in gestures(2)]
    write_recordings(tmp_path / "larger.zip", larger, CLASSES)
    for name, reason in (
        ("renamed.zip", "class 0"),
        ("larger.zip", "of a sensor of 9 rows x 23 columns"),
    ):
        shown = ("--target", "fast", "--data", tmp_path / name)
        assert call("check", "run", folder / "image", *shown) == 2
        assert reason in capsys.readouterr().err
    for others in (("--samples", 5), ("--skip-bad",)):
        assert call("check", "run", folder / "image", "--target", "fast", *others) == 2


@pytest.mark.parametrize("kind", QUICK)
def test_an_animation_of_a_sample(folder, tmp_path, monkeypatch, kind):
    from PIL import Image

    from pipeline.results.report.figures import animation

    monkeypatch.setattr(animation, "FRAMES", 4)
    assert call("animate", folder / kind, "--out", tmp_path / "a.gif") == 0
    with Image.open(tmp_path / "a.gif") as picture:
        assert picture.n_frames >= 4  # equal ones are joined
        frames = []
        for number in range(picture.n_frames):
            picture.seek(number)
            frames.append(picture.convert("L").tobytes())
    assert len(set(frames)) >= 4
    assert call("animate", folder / kind, "--out", tmp_path / "a.txt") == 2
    assert call("animate", folder / kind, "--out", tmp_path / "b.gif", "--sample", "x/1") == 2
    assert [path.name for path in tmp_path.iterdir()] == ["a.gif"]


def test_a_run_without_a_bundle_is_told_what_to_do(tmp_path, capsys):
    (tmp_path / "experiment.toml").write_text("")
    for command in (["deploy", "plan"], ["adapt", "--data", "x"], ["live"]):
        assert call(*command, tmp_path) == 2
        assert f"'stmnist convert {tmp_path}'" in capsys.readouterr().err


def test_the_report_has_the_user_s_words(folder):
    for kind in QUICK:
        assert call("report", folder / kind) == 0
        page = (folder / kind / "report.html").read_text(encoding="utf-8")
        for name in CLASSES:
            assert name in page
        for word in ("digit", "Table 1", "Table 2", "ST-MNIST", "of the writing"):
            assert word not in page
        assert f"<title>own: {folder / kind}</title>" in page
        assert page.count('<details class="sample"') >= 2
        assert page.index(">wrong</b>") < page.index(">correct</b>")
        assert page.count('class="confusion"') == 1


def test_settings_that_apply_to_one_run_only_differ_from_nothing(folder, capsys):
    assert call("compare", folder / "image", folder / "events", "--json") == 0
    names = [setting["name"] for setting in json.loads(capsys.readouterr().out)["settings"]]
    assert "input.kind" in names
    assert not [name for name in names if name.startswith(("cnn.", "snn.", "events."))]


def test_the_page_opens_for_an_own_run_and_plays_its_recordings(folder, tmp_path):
    """As a user starts it: one command, no options but those that keep the test to itself.

    tests/pipeline/live/test_command.py opens it for a run on images.
    """
    pytest.importorskip("uvicorn", reason="the extra 'live' is not installed")
    client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")
    command = [sys.executable, "-m", "pipeline", "live", str(folder / "events")]
    command += ["--port", "0", "--no-browser"]
    with subprocess.Popen(
        command, cwd=tmp_path, env=users_environment(), stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            url = process.stdout.readline().split()[1]
            with client.connect(url.replace("http", "ws") + "pen", proxy=None) as page:
                said = {}

                def until(kind):
                    while (message := json.loads(page.recv(timeout=300)))["type"] != kind:
                        said[message["type"]] = message
                    return message

                def show(label):
                    ask = {"type": "example", "now": 0.0, "label": label}
                    page.send(json.dumps(ask))
                    until("cleared")
                    for now in (100.0, 5000.0):
                        page.send(json.dumps({"type": "pen", "now": now, "points": []}))

                until("ready")
                counts = until("examples")["counts"]
                hello = said["hello"]
                assert tuple(hello["classes"]) == CLASSES
                assert (hello["rows"], hello["columns"], hello["digits"]) == (9, 12, False)
                assert sum(counts) == 20
                show(int(np.argmax(counts)))
                assert len(until("answer")["shares"]) == 4
        finally:
            process.terminate()
    assert [path.name for path in tmp_path.iterdir()] == ["written-own"]
