"""``stmnist.Run``: the command line's results as objects, and mistakes in one line."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from deploy.errors import UserError
from pipeline import workflow
from pipeline.api.results import Predictions
from pipeline.recordings.recordings import Recordings
from pipeline.results.other_recordings import Prediction
from pipeline.results.status import list_states
from pipeline.storage.run_folder import RunFolder
from stmnist import Run, compare_runs
from tests.command import missing, without_processes

CLASSES = ["left", "right"]


def arrays(count, seed=0):
    """Events of presses on the left and on the right of a sensor, and their labels."""
    rng = np.random.default_rng(seed)
    events, labels = [], []
    for index in range(count):
        label = index % 2
        x = rng.integers(0, 4, 40) + 4 * label
        t = np.sort(rng.uniform(0, 0.3, 40))
        events.append({"x": x, "y": rng.integers(0, 6, 40), "t": t, "p": rng.integers(0, 2, 40)})
        labels.append(label)
    return events, labels


@pytest.fixture(scope="module", autouse=True)
def in_this_process():
    with without_processes():
        yield


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    events, labels = arrays(60)
    recordings = Recordings.from_arrays(events, labels, classes=CLASSES, time_unit="s")
    folder = tmp_path_factory.mktemp("api") / "run"
    changes = {"events.epochs": 6, "check.samples": 10}
    made = Run(folder, data=recordings, input="events", quiet=True, **changes)
    made.ladder(["counts", "trained", "emulator"])
    return made


def is_one_line(value):
    return len(repr(value).splitlines()) == 1


def test_recordings_from_arrays_are_those_of_their_file(tmp_path):
    events, labels = arrays(6)
    recordings = Recordings.from_arrays(events, labels, classes=CLASSES, time_unit="s")
    assert recordings.sensor.classes == ("left", "right")
    assert recordings.labels.tolist() == labels
    again = Recordings.read(recordings.write(tmp_path / "mine.zip"))
    assert dict(zip(again.ids, again.hashes, strict=True)) == dict(
        zip(recordings.ids, recordings.hashes, strict=True)
    )
    assert is_one_line(recordings)
    for index in (5, -1, np.int64(5)):
        np.testing.assert_array_equal(recordings[index].time_ns, np.rint(1e9 * events[5]["t"]))
    for wrong, error in ((6, "no recording 6"), (-7, "no recording -7")):
        with pytest.raises(IndexError, match=error):
            recordings[wrong]
    with pytest.raises(TypeError, match="subset"):
        recordings[:2]
    assert len(list(recordings)) == 6
    assert "<table>" in recordings._repr_html_()
    assert recordings.source.name == "arrays"


def test_a_guessed_unit_is_said(capsys):
    events, labels = arrays(4)
    Recordings.from_arrays(events, labels, time_unit="s")
    assert "seconds" not in capsys.readouterr().err
    assert Recordings.from_arrays(events, labels).source.time_unit == "s"
    assert "read as seconds" in capsys.readouterr().err


def test_recordings_without_labels_cannot_be_checked(run):
    unlabelled = Recordings.from_arrays(arrays(3)[0], time_unit="s")
    with pytest.raises(UserError, match="no labels"):
        run.check("fast", data=unlabelled)
    with pytest.raises(UserError, match=r"1\.5 samples"):
        run.check("fast", data=unlabelled, samples=1.5)


def test_recordings_without_a_spike_at_the_readout_have_no_probabilities():
    """Their row is NaN, and null in JSON."""
    silent = Predictions([Prediction("0", "left", None)], CLASSES)
    assert silent.class_probabilities.shape == (1, 2)
    assert np.isnan(silent.class_probabilities).all()
    assert silent.to_dict()["predictions"][0]["class_probabilities"] is None


@pytest.mark.parametrize(("events", "labels", "remedy"), [
    ({"x": [1], "y": [1], "t": [0.1], "p": [1]}, None, "[events]"),
    (np.zeros((5, 4)), None, "[events]"),
    ([np.zeros(5)] * 4, None, "[events]"),
    (np.zeros(3, [("x", int), ("y", int), ("t", float), ("p", int)]), None, "[events]"),
    (arrays(2)[0], np.array([0.0, 1.0]), "labels.astype(int)"),
    (arrays(2)[0], np.eye(2), "labels.argmax(1)"),
    (arrays(3)[0], "tap", "a list"),
    (arrays(3)[0], [-1, -1, -1], "numbers from 0"),
])  # fmt: skip
def test_arrays_that_a_beginner_gives_have_a_remedy(events, labels, remedy):
    with pytest.raises(UserError) as caught:
        Recordings.from_arrays(events, labels, time_unit="s")
    assert remedy in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_recordings_from_arrays_have_a_name(run):
    events, labels = arrays(4)
    with pytest.raises(TypeError, match=r"from_arrays\(\).*'unit'"):
        Recordings.from_arrays(events, labels, unit="s")
    with pytest.raises(UserError, match="without a slash"):
        Recordings.from_arrays(events, labels, name="a/b")
    named = Recordings.from_arrays(
        events, labels, classes=CLASSES, time_unit="s", name="today 2.5 N"
    )
    assert named.source.name == "today 2.5 N"
    result = run.check("fast", data=named)
    assert result.to_dict()["data"]["source"] == "today 2.5 N"
    with pytest.raises(UserError, match=r"^today 2\.5 N: "):
        run.check("fast", data=named, samples=9)


def test_recordings_from_arrays_keep_their_order(run):
    events, labels = arrays(7, seed=5)
    labels = [CLASSES[label] for label in labels[::-1]]
    recordings = Recordings.from_arrays(events, labels, classes=CLASSES, time_unit="s")
    assert list(recordings.ids) == [f"{name}/{i:06}" for i, name in enumerate(labels)]
    for index, given in enumerate(events):
        read = recordings[index]
        assert len(read) == len(given["t"])
        np.testing.assert_array_equal(recordings.taxels.column[read.taxel], given["x"])
    assert run.predict(recordings).ids == list(recordings.ids)
    with pytest.raises(UserError, match="give a list"):
        Recordings.from_arrays(events, labels, classes="left")


def test_arrays_that_are_no_events_are_refused_in_one_line():
    events, labels = arrays(3)
    with pytest.raises(UserError, match="3 recordings and 2 labels"):
        Recordings.from_arrays(events, labels[:2])
    events[1]["x"] = events[1]["x"] - 9
    with pytest.raises(UserError, match="arrays: 1 of 3"):
        Recordings.from_arrays(events, labels)


def test_the_order_of_the_classes_is_kept_in_files(tmp_path):
    events, labels = arrays(6)
    names = ["right", "left"]
    recordings = Recordings.from_arrays(events, labels, classes=names, time_unit="s")
    assert recordings.sensor.classes == ("right", "left")
    assert recordings.labels.tolist() == labels
    first = next(i for i, name in enumerate(recordings.ids) if name.startswith("right"))
    assert recordings.labels[first] == 0
    read = Recordings.read(recordings.write(tmp_path / "six.zip"))
    assert read.sensor.classes == ("right", "left")
    assert dict(zip(read.ids, read.labels, strict=True)) == dict(
        zip(recordings.ids, recordings.labels, strict=True)
    )


def test_the_size_of_the_sensor_is_kept_in_files(tmp_path):
    """Also of some of the recordings, which may have no events at the edge."""
    events, labels = arrays(4)
    recordings = Recordings.from_arrays(events, labels, time_unit="s", rows=16, columns=20)
    assert (recordings.sensor.rows, recordings.sensor.columns) == (16, 20)
    again = Recordings.read(recordings.subset([0, 1]).write(tmp_path / "some.zip"))
    assert (again.sensor.rows, again.sensor.columns) == (16, 20)


@pytest.mark.parametrize(("change", "remedy"), [
    ({"t": lambda t: t + 1e12 * (t > 0.2)}, "time_unit="), ({"x": lambda x: 50 * x}, "downsample="),
])  # fmt: skip
def test_errors_in_arrays_name_arguments_of_python(change, remedy):
    events, labels = arrays(4)
    ((name, alter),) = change.items()
    changed = [{**each, name: alter(each[name])} for each in events]
    with pytest.raises(UserError) as caught:
        Recordings.from_arrays(changed, labels)
    assert remedy in str(caught.value)
    assert "--" not in str(caught.value)


def test_the_ladder_has_the_commands_values(run):
    ladder = run.ladder(["counts", "trained", "emulator"])
    assert ladder.to_dict() == json.loads((run.path / "ladder.json").read_text())
    assert list(ladder) == ["counts", "trained", "emulator"]
    assert ladder["emulator"].accuracy == ladder.rows[-1].accuracy
    assert "emulator" in str(ladder)
    assert is_one_line(ladder)
    assert ladder._repr_html_().count("<tr>") == 4
    with pytest.raises(KeyError, match="no stage 'chip'"):
        ladder["chip"]


def test_a_check_has_arrays(run):
    result = run.check("fast")
    assert result.accuracy == np.mean(result.labels == result.predictions)
    assert result.confusion.sum() == len(result) == 10
    assert result.to_dict()["target"] == "fast"
    assert is_one_line(result)


def test_the_stages_of_a_check_are_known(run):
    assert run.check("trained").target == "trained"
    with pytest.raises(UserError, match="no stage or target 'chip'; they are counts"):
        run.check("chip")


def test_recordings_in_memory_are_predicted_and_checked(run):
    events, labels = arrays(8, seed=1)
    recordings = Recordings.from_arrays(events, labels, classes=CLASSES, time_unit="s")
    predictions = run.predict(recordings)
    assert predictions.ids == list(recordings.ids)
    assert set(predictions.names) <= set(CLASSES)
    assert predictions[recordings.ids[0]] == predictions[0] == predictions.names[0]
    assert predictions[np.int64(1)] == predictions.names[1]
    assert max(map(len, map(repr, (run.bundle, run.dataset, run.replay([0])[0])))) < 300
    assert all(0 < probability < 1 for probability in predictions.probabilities)
    assert predictions.classes == recordings.classes == ("left", "right")
    shares = predictions.class_probabilities
    assert shares.shape == (8, 2)
    np.testing.assert_allclose(shares.sum(1), 1)
    np.testing.assert_allclose(shares.max(1), predictions.probabilities, atol=1e-3)
    assert [CLASSES[index] for index in shares.argmax(1)] == predictions.names
    assert is_one_line(predictions)
    backwards = recordings.subset(range(7, -1, -1))
    again = run.predict(backwards)
    assert {name: again[name] for name in recordings.ids} == dict(
        zip(predictions.ids, predictions.names, strict=True)
    )
    unlabelled = Recordings.from_arrays(events, time_unit="s")
    by_press = [recordings.ids.index(name) for name in sorted(recordings.ids, key=_number)]
    assert run.predict(unlabelled).names == [predictions.names[index] for index in by_press]
    checked = run.check("fast", data=recordings, samples=0)
    assert len(checked) == 8
    assert checked.classes == ("left", "right")


def test_the_unit_of_the_training_files_is_not_that_of_recordings_in_memory(run, tmp_path):
    """Nor of files that have a unit; they are stretched otherwise."""
    copied = tmp_path / "run"
    shutil.copytree(run.path, copied)
    settings = (copied / "experiment.toml").read_text()
    assert 'time_unit = ""' in settings
    settings = settings.replace('time_unit = ""', 'time_unit = "us"')
    (copied / "experiment.toml").write_text(settings)
    events, labels = arrays(8, seed=4)
    recordings = Recordings.from_arrays(events, labels, classes=CLASSES, time_unit="s")
    expected = run.predict(recordings).class_probabilities
    opened = Run(copied, quiet=True)
    np.testing.assert_array_equal(opened.predict(recordings).class_probabilities, expected)
    assert not any("unit" in line for line in opened.notes)
    written = recordings.write(tmp_path / "written.zip")
    assert sorted(opened.predict(written).names) == sorted(run.predict(recordings).names)
    with pytest.raises(UserError, match=r"leave out data\.time_unit"):
        Run(tmp_path / "new", data=recordings, **{"data.time_unit": "us"})
    assert Run(copied, data=recordings, quiet=True)._user_settings.data.time_unit == ""


def test_a_quiet_run_reports_no_progress(run, monkeypatch):
    reported = []

    def report(label, total, unit):
        reported.append(label)
        return SimpleNamespace(advance=lambda n=1, note=None: None)

    monkeypatch.setattr("pipeline.progress.ProgressLines", report)
    events, labels = arrays(8, seed=2)
    recordings = Recordings.from_arrays(events, labels, classes=CLASSES, time_unit="s")
    reported.clear()  # reading is not the run's
    run.check("fast", data=recordings)
    assert reported == []
    Run(run.path).check("fast", data=recordings)
    assert reported != []


def test_an_error_names_recordings_in_memory_and_no_temporary_file(run):
    outside = Recordings.from_arrays([{"x": [20], "y": [1], "t": [0.1], "p": [1]}], time_unit="s")
    with pytest.raises(UserError, match=r"^arrays: "):
        run.predict(outside)


def test_wrong_recordings_and_samples_are_refused(run, tmp_path):
    events, labels = arrays(4)
    with pytest.raises(TypeError, match=r"Recordings\.from_arrays"):
        run.predict(events)
    with pytest.raises(TypeError, match="not int"):
        Run(tmp_path / "new", data=3)
    with pytest.raises(UserError, match="-1 samples"):
        run.check("fast", data=Recordings.from_arrays(events, labels), samples=-1)
    for samples in (-1, 1.5, True):
        with pytest.raises(UserError, match="whole number"):
            run.check("fast", samples=samples)
    with pytest.raises(UserError, match=r"data=.*check\.samples"):
        run.check("fast", samples=3)
    with pytest.raises(UserError, match="no sample 99"):
        run.replay([99])


def _number(name):
    return int(name.rpartition("/")[2])


def test_the_plan_of_a_run(run):
    plan = run.plan()
    assert plan.fits
    assert plan.cores == len(plan.to_dict()["cores"])
    assert "compartments" in plan._repr_html_()
    assert is_one_line(plan)


def test_the_energy_of_a_run(run):
    energy = run.energy()
    assert energy.estimate.chip_joules > 0
    assert is_one_line(energy)
    assert "uJ" in repr(energy)


def test_the_notes_are_those_of_the_last_method(run):
    opened = Run(run.path, quiet=True)
    opened.train()
    lines = list(opened.notes)
    assert lines
    assert len(opened.dataset.split.test) >= 10
    assert opened.bundle.spec
    assert opened.notes[: len(lines)] == lines
    for method in (opened.plan, lambda: opened.replay([0]), opened.report):
        opened.train()
        method()
        assert missing(opened.notes, *lines) == lines


def test_a_new_run_names_the_run_that_may_be_meant(run, capsys):
    misspelt = run.path.with_name(run.path.name + "n")
    assert repr(Run(misspelt)) == f"Run({str(misspelt)!r}: new, image, simulated)"
    assert f"did you mean the run {run.path}?" in capsys.readouterr().err
    Run(misspelt, data=run.settings.data.source)
    Run(run.path)
    assert "new" not in repr(Run(run.path))
    assert capsys.readouterr().err == ""
    assert not misspelt.exists()


def test_a_run_writes_its_report(run):
    assert run.report().is_file()


def test_a_run_replays_samples(run):
    assert list(run.replay([3])) == list(run.replay(3)) == [3]


def test_an_existing_run_keeps_its_settings(run):
    again = Run(run.path, quiet=True)
    assert again.settings.events.epochs == 6
    assert len(again.recordings) == 60
    assert len(again.dataset.split.test) >= 10


def test_an_existing_run_trains_nothing_again(run):
    again = Run(run.path, quiet=True)
    training = again.train()
    assert list(training.networks) == ["events"]
    assert training["events"]["epochs"] == 6
    assert repr(training).startswith(
        f"Training(events {training['events']['accuracy']['train']:.3f} "
    )
    assert any("up to date" in note for note in again.notes)
    assert "events" in repr(again)


@pytest.mark.parametrize(("changes", "fact"), [
    ({"input": "image"}, "input.kind from 'events' to 'image'"),
    ({"events.epochs": 9}, "events.epochs from 6 to 9"),
    ({"data": "simulated"}, "data.source"),
])  # fmt: skip
def test_changes_of_an_existing_run_are_said_at_once_and_by_its_old_bundle(run, changes, fact):
    changed = Run(run.path, quiet=True, **changes)
    assert missing(changed.notes[0], fact, str(run.path), "again", "another path") == []
    changed.plan()
    assert missing(changed.notes[-1], fact, "convert()") == []
    assert Run(run.path, quiet=True, input="events").notes == []


def test_other_recordings_in_memory_are_said(run, tmp_path):
    copied = tmp_path / "run"
    copied.mkdir()
    for name in ("experiment.toml", "dataset.json"):
        (copied / name).write_bytes((run.path / name).read_bytes())
    (copied / "bundle").mkdir()
    events, labels = arrays(60)
    recordings = Recordings.from_arrays(events, labels, classes=CLASSES, time_unit="s")
    text = (copied / "experiment.toml").read_text()
    text = text.replace(str(run.path.parent), str(tmp_path))
    (copied / "experiment.toml").write_text(text)
    assert Run(copied, data=recordings, quiet=True).notes == []
    other = Run(copied, data=recordings.subset(range(50)), quiet=True)
    assert "recordings in memory" in other.notes[0]


def test_choices_are_printed_once_and_kept_in_the_notes(run, capsys):
    opened = Run(run.path)
    opened.train()
    notes = [line for line in opened.notes if "up to date" not in line]
    assert notes
    assert missing(capsys.readouterr().err, *notes) == []
    opened.train()
    assert missing(opened.notes, *notes) == []
    assert not any(line in capsys.readouterr().err for line in notes)


def test_other_recordings_are_warned_of_once_and_only_if_they_are_others(run, tmp_path, capsys):
    copied = tmp_path / "run"
    shutil.copytree(run.path, copied)
    same = shutil.copy(run.settings.data.source, tmp_path / "same.zip")
    Run(copied, quiet=True).train()
    with workflow.open_locked_run(copied, {"data": {"source": str(same)}}, say=print):
        assert "made again" not in capsys.readouterr().out
    other = run.recordings.subset(range(50)).write(tmp_path / "other.zip")
    changed = Run(copied, data=other)
    changed.train()
    printed = capsys.readouterr().err
    assert printed.count("other.zip'") == printed.count("another path") == 1
    with workflow.open_locked_run(copied, {"data": {"source": str(same)}}, say=print):
        assert missing(capsys.readouterr().out, "same.zip", "made again", "another RUN") == []


def test_a_size_that_nobody_has_stated_is_said_with_the_settings_for_another(run, tmp_path):
    source = {"data": {"source": run.settings.data.source}}
    for skin, n_lines in (({}, 1), ({"skin": {"rows": 6, "columns": 8}}, 0)):
        lines = []
        with workflow.open_locked_run(tmp_path / f"run{n_lines}", source | skin, say=lines.append):
            said = [line for line in lines if "largest y and x" in line]
        assert len(said) == n_lines
        assert all("6 rows x 8 columns" in line and "skin.rows" in line for line in said)


def test_runs_side_by_side(run):
    compared = compare_runs(run, run.path)
    assert len(compared.to_dict()["runs"]) == 2
    assert str(run.path) in str(compared)


def test_mistakes_are_one_line_and_write_nothing(tmp_path):
    folder = tmp_path / "new"
    for wrong in (
        {"input": "sound"},
        {"events.epoch": 3},
        {"seed": "one"},
        {"data": "no-such-file.zip", "input": "events"},
    ):
        with pytest.raises(UserError) as caught:
            Run(folder, **wrong).train()
        assert len(str(caught.value).splitlines()) == 1
    with pytest.raises(UserError, match="no bundle yet"):
        Run(folder).plan()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "notes.txt").touch()
    with pytest.raises(UserError, match="is a file"):
        Run(tmp_path / "notes.txt", data=Recordings.from_arrays(*arrays(4)))
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("jobs", [0, -1, 2.5, "two", None, True])
def test_a_number_of_processes_that_is_none_is_refused(tmp_path, jobs):
    with pytest.raises(UserError, match="jobs"):
        Run(tmp_path / "run", jobs=jobs)


def test_a_misspelt_argument_is_suggested(tmp_path):
    with pytest.raises(UserError, match=r"'dat'.*'data'"):
        Run(tmp_path / "run", dat="own")
    with pytest.raises(UserError, match=r"'snn\.epoch'.*'snn\.epochs'"):
        Run(tmp_path / "run", **{"snn.epoch": 3})


def test_the_accuracy_of_a_network_on_events_is_in_its_own_row(run):
    rows = {status.state.name: status for status in list_states(RunFolder(run.path))}
    metrics = json.loads((run.path / "snn/metrics.json").read_text())
    assert rows["events"].accuracy == metrics["accuracy"]["test"]
    assert rows["events"].seconds == metrics["seconds"]
    assert rows["threshold"].accuracy is None
