"""The maintainers' tools run; that their figures are good is for a quiet machine to say."""

import json
import subprocess
import sys
from dataclasses import replace

import pytest

from deploy.errors import UserError
from pipeline.artifacts import CURRENT, MISSING, OUTDATED
from pipeline.commands.options import Given
from pipeline.experiments.study import Workers
from tests.command import environment
from tests.untraced import untraced
from tools import difficulty, results
from tools.training_speed import WAYS, measure_simulated, speed_text


@pytest.mark.slow
def test_the_training_speed_is_measured():
    with untraced():
        result = measure_simulated(samples=12, networks=1, rounds=1)
    assert result["ratio_to_nengodl"]["nengodl"] == 1
    assert set(result["seconds_per_epoch"]) == set(WAYS)
    assert all(seconds > 0 for seconds in result["seconds_per_epoch"].values())
    assert result["samples"] == 96
    assert len(speed_text(result).splitlines()) == 2 + len(WAYS)


@pytest.mark.slow
def test_the_difficulty_of_recordings_is_measured(tmp_path, capsys):
    tiny = Given(seed=7, assignments=["data.samples_per_digit=6", "cnn.epochs=1"])
    difficulty.main(tmp_path, 1, given=tiny, workers=Workers(1), as_json=True)
    summary = json.loads(capsys.readouterr().out)
    assert summary["seeds"] == [7]
    assert 0 <= summary["mean"] == summary["accuracies"][0] <= 1
    assert json.loads((tmp_path / "difficulty.json").read_text()) == summary


def test_a_tool_is_a_command_whose_errors_are_one_line(tmp_path):
    command = [sys.executable, "-m", "tools.emulator_limits", str(tmp_path)]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert str(tmp_path) in done.stderr


@pytest.fixture
def two(tmp_path, monkeypatch):
    """Two results that are measured at once, the first of which is there."""
    monkeypatch.setattr(results, "FOLDER", tmp_path / "results")
    (tmp_path / "results").mkdir()
    one = results.Result("one", 1, lambda work: {"value": 0.5}, ("numpy",))
    other = replace(one, name="other")
    results.measure(one, results.Work(tmp_path, 1), "a" * 64)
    return one, other


def of(found):
    return [state.state for _, state in found]


def test_a_result_says_what_it_was_made_from_and_on_what(two):
    one, _ = two
    content = json.loads(one.artifact("a" * 64).record.read_text())
    assert content["value"] == 0.5
    contents = content["made_from"]["contents"]
    assert contents["recordings"] == "a" * 64
    assert "version of numpy" in contents
    assert content["measured"]["processor"] == results.processor()


def test_results_that_are_missing_or_out_of_date_are_listed(two):
    assert of(results.states("a" * 64, two)) == [CURRENT, MISSING]
    found = results.states("b" * 64, two)
    assert of(found) == [OUTDATED, MISSING]
    listed = results.listing(found)
    assert "recordings" in listed
    assert max(map(len, listed.splitlines())) <= 80


def test_another_version_of_a_package_makes_a_result_out_of_date(two, monkeypatch):
    monkeypatch.setattr(results, "version", lambda package: "99.0")
    assert of(results.states("a" * 64, two)) == [OUTDATED, MISSING]


def test_recordings_of_another_pen_file_are_made_again(tmp_path, monkeypatch):
    made = []

    def simulated(work, *words):
        made.append(words[-1])
        words[-1].write_bytes(b"zip")

    monkeypatch.setattr(results.Work, "run", simulated)
    for name, content in (("a", b"1"), ("b", b"2"), ("copy of a", b"1")):
        (tmp_path / name).write_bytes(content)
    a, b, again = (
        results.Work(tmp_path / "work", 1, str(tmp_path / name)).pen_recordings()
        for name in ("a", "b", "copy of a")
    )
    assert a == again != b
    assert made == [a, b]


@pytest.mark.parametrize(
    "given", [Given(data="own.zip"), Given(assignments=["data.samples_per_digit=6"])]
)
def test_only_the_difficulty_of_the_built_in_recordings_is_stored(given, tmp_path, monkeypatch):
    monkeypatch.setattr(difficulty, "measure_splits", lambda *_: pytest.fail("measured"))
    with pytest.raises(UserError, match="--store"):
        difficulty.main(tmp_path, 1, given=given, store=True, workers=Workers(1))


def test_rows_of_table_2_are_kept_apart(tmp_path, monkeypatch):
    rows = [{"model": name} for name in ("cnn", "loihi", "slayer")]
    pairs = [
        {"split": split, "a": "cnn", "b": b}
        for b in ("loihi", "slayer")
        for split in ("random", "writers")
    ]
    table = {"rows": rows, "writer_rows": rows, "comparisons": pairs}
    monkeypatch.setattr(results.Work, "summary", lambda *words: dict(table))
    found = results._table2("cnn,loihi")(results.Work(tmp_path, 1))
    assert [row["model"] for row in found["rows"]] == ["cnn", "loihi"]
    assert found["writer_rows"] == found["rows"]
    assert found["comparisons"] == pairs[:2]
    found = results._table2("cnn,loihi", "writers")(results.Work(tmp_path, 1))
    assert found["rows"] == []
    assert [row["model"] for row in found["writer_rows"]] == ["cnn", "loihi"]
    assert found["comparisons"] == pairs[1:2]


def test_a_command_that_fails_leaves_no_result(two, tmp_path):
    def fail(work):
        work.run("benchmark", "nothing")

    _, other = two
    with pytest.raises(UserError, match="nothing"):
        results.measure(replace(other, measure=fail), results.Work(tmp_path, 1), "a" * 64)
    assert of(results.states("a" * 64, two)) == [CURRENT, MISSING]


def test_what_a_command_prints_is_read(tmp_path):
    printed = results.Work(tmp_path, 1).printed("data", "inspect", handmade_csv(tmp_path))
    assert printed["events"] == 2


def handmade_csv(folder):
    path = folder / "one.csv"
    path.write_text("t,x,y,p\n0.0,0,0,1\n0.5,1,1,0\n")
    return path


def test_splits_with_slayer_are_kept_also_if_the_others_are_interrupted(tmp_path, monkeypatch):
    def interrupted(work, file, *words):
        folder = work.folder / "table2" / "splits" / "random-01"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "slayer.json").write_text('{"accuracy": 0.5}')
        raise UserError("interrupted")

    monkeypatch.setattr(results, "KEPT", tmp_path / "kept")
    monkeypatch.setattr(results.Work, "summary", interrupted)
    earlier = tmp_path / "kept" / "random-00" / "slayer-small.json"
    earlier.parent.mkdir(parents=True)
    earlier.write_text('{"accuracy": 0.75}')
    with pytest.raises(UserError, match="interrupted"):
        results._slayer("random")(results.Work(tmp_path / "work", 1))
    splits = tmp_path / "work" / "table2" / "splits"
    assert json.loads((splits / "random-00" / "slayer-small.json").read_text())["accuracy"] == 0.75
    kept = tmp_path / "kept" / "random-01" / "slayer.json"
    assert json.loads(kept.read_text())["accuracy"] == 0.5


def test_the_last_epochs_of_slayer_are_averaged_over_the_splits(tmp_path):
    for split, accuracies in enumerate(([0.1, 0.5, 0.7], [0.9, 0.8, 0.6])):
        folder = tmp_path / f"random-{split:02d}"
        folder.mkdir()
        history = [{"test_accuracy": value, "accuracy": value + 0.1} for value in accuracies]
        (folder / "slayer.json").write_text(json.dumps({"history": history}))
    found = results._last_epochs(tmp_path, "random", "slayer", count=2)
    assert found["test_accuracy"] == pytest.approx(0.65)
    assert found["test_accuracy_sd_of_epochs"] == pytest.approx(0.2 / 2**0.5)
    assert found["training_accuracy"] == pytest.approx(0.75)


def test_every_result_has_a_name_of_its_own():
    names = [result.name for result in results.RESULTS]
    assert len(set(names)) == len(names)


def test_the_effect_of_the_state_is_counted_over_all_seeds():
    """Two seeds of ten samples: three right only in streams, one only from rest."""
    runs = [
        {
            "n_test": 10,
            "fast": 0.9,
            "fast_from_rest": 0.8,
            "only_in_stream": 2,
            "only_from_rest": 1,
        },
        {
            "n_test": 10,
            "fast": 1.0,
            "fast_from_rest": 0.9,
            "only_in_stream": 1,
            "only_from_rest": 0,
        },
    ]
    found = results._effect_of_state(runs)
    assert (found["samples"], found["only_in_stream"], found["only_from_rest"]) == (20, 3, 1)
    assert (found["in_stream"], found["from_rest"]) == pytest.approx((0.95, 0.85))
    assert found["p_value"] == pytest.approx(2 * (1 + 4) / 2**4)


def test_a_run_on_events_is_compared_with_its_answers_from_rest(tmp_path):
    kept = dict.fromkeys(
        ("trained", "operations", "agreement", "share", "accuracy_by_itself", "confidence"), 0.5
    )
    kept |= {"labels": [1, 2, 3, 4], "predictions": [1, 2, 3, 0], "n_test": 4}
    kept["predictions_from_rest"] = [1, 0, 0, 4]
    (tmp_path / "events").mkdir()
    (tmp_path / "events" / "as-is-00.json").write_text(json.dumps(kept))
    found = results._run_on_events(results.Work(tmp_path, 1), "events", 0)
    assert (found["fast"], found["fast_from_rest"]) == (0.75, 0.5)
    assert (found["only_in_stream"], found["only_from_rest"]) == (2, 1)
