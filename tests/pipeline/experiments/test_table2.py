import json
import re
from dataclasses import replace

import numpy as np
import pytest

from deploy.errors import UserError
from deploy.files import write_json
from pipeline.commands.benchmark import BY_DEFAULT
from pipeline.data.own import write_recordings
from pipeline.experiments import table2 as table2_command
from pipeline.experiments import table2_splits as table2
from pipeline.experiments.study import Workers, concluded
from pipeline.experiments.table2 import summarise, table_text
from pipeline.experiments.table2_splits import MODELS, checkpoint_of
from pipeline.jobs import Failure
from pipeline.run import RunFolder, refuse_results
from pipeline.settings import Settings, read_settings
from tests.command import ROOT, call, missing
from tests.own_sensor import CLASSES, gestures, write_folder
from tests.untraced import untraced


@pytest.fixture
def benchmark(tmp_path):
    return table2.Benchmark(
        Settings(), "0" * 64, tmp_path, ("random",), 3, ("cnn", "ann-snn", "loihi")
    )


def store(benchmark, model, seed, right, samples=None, kind="random"):
    """A split's result with the given answers right (1) or wrong (0)."""
    right = np.array(right)
    samples = list(range(len(right))) if samples is None else samples
    labels = [s % 10 for s in samples]
    result = {
        "model": model,
        "split": kind,
        "simulated": True,
        "made_from": benchmark.task(kind, seed, model).origin.to_json(),
        "n_train": 4 * len(right),
        "n_test": len(right),
        "accuracy": float(right.mean()),
        "samples": samples,
        "labels": labels,
        "predictions": [(y + 1 - r) % 10 for y, r in zip(labels, right.tolist(), strict=True)],
        "seconds": 1.0,
    }
    write_json(benchmark.folder / table2.split_file(kind, seed, model), result)


def test_models_that_share_a_training_are_a_group(benchmark):
    models = ("cnn", "slayer", "slayer-small", "loihi", "events", "events-loihi")
    asked = replace(benchmark, models=models, kinds=("random", "writers"), splits=2)
    groups = asked.groups()
    assert [[task.subject for task in group] for group in groups] == (
        4 * [["cnn", "loihi"]]
        + 4 * [["events", "events-loihi"]]
        + 4 * [["slayer"]]
        + 4 * [["slayer-small"]]
    )
    assert [(group[0].split, group[0].seed) for group in groups[:4]] == [
        ("random", 0), ("random", 1), ("writers", 0), ("writers", 1)
    ]  # fmt: skip
    names = [task.name for group in groups for task in group]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    ("section", "change", "redone"),
    [
        ("cnn", {"epochs": 3}, {"cnn", "ann-snn", "loihi"}),
        ("snn", {"epochs": 3}, {"ann-snn", "loihi"}),
        ("check", {"samples": 50}, {"loihi", "events-loihi"}),
        ("deployment", {"input_rate": 400.0}, {"loihi"}),
        ("deployment", {"synapse": 0.01}, {"ann-snn", "loihi"}),
        ("presentation", {"gap": 3}, {"loihi", "events-loihi"}),
        ("presentation", {"steps": 50}, {"ann-snn", "loihi", "events", "events-loihi"}),
        ("input", {"refractory": 20}, {"events", "events-loihi"}),
        ("input", {"kind": "events"}, set()),
        ("events", {"epochs": 3}, {"events", "events-loihi"}),
        ("slayer", {"epochs": 3}, {"slayer", "slayer-small"}),
        ("slayer", {"conv_scale": 50.0}, {"slayer"}),
        ("image", {"aggregation": "signed"}, {"cnn", "ann-snn", "loihi", "events-loihi"}),
    ],
)
def test_a_setting_redoes_what_depends_on_it(benchmark, section, change, redone):
    settings = Settings().with_values({section: change}, "test")
    other = replace(benchmark, settings=settings)
    models = ("cnn", "ann-snn", "loihi", "slayer", "slayer-small", "events", "events-loihi")

    def origins(of):
        return {model: of.task("random", 0, model).origin for model in models}

    before, after = origins(benchmark), origins(other)
    assert {model for model in models if before[model] != after[model]} == redone


def test_benchmarks_with_other_first_seeds_share_splits(benchmark):
    """They have the same files and origins, and no others replace them."""
    later = replace(benchmark, settings=replace(Settings(), seed=1))
    tasks = [[t for group in of.groups() for t in group] for of in (benchmark, later)]
    before, after = ({t.artifact.record: t.origin for t in of} for of in tasks)
    assert len(before.keys() & after.keys()) == 2 * 3  # of seeds 1 and 2, of three models
    assert all(before[file] == after[file] for file in before.keys() & after.keys())
    assert {file.parent.name for file in before} == {"random-00", "random-01", "random-02"}
    assert {t.name for t in tasks[0] if t.seed == 1} == {t.name for t in tasks[1] if t.seed == 1}
    for seed, right in enumerate(([1, 1], [1, 0], [0, 0])):
        store(benchmark, "cnn", seed, right)
    assert summarise(benchmark)["rows"][0]["per_split"] == [1.0, 0.5, 0.0]
    row = summarise(later)["rows"][0]
    assert (row["indices"], row["per_split"]) == ([1, 2], [0.5, 0.0])


def test_other_recordings_redo_everything(benchmark):
    store(benchmark, "cnn", 0, [1, 0])
    assert len(benchmark.results("random", "cnn")) == 1
    assert replace(benchmark, source_sha256="1" * 64).results("random", "cnn") == []


def test_slayer_continues_only_its_own_training(benchmark):
    def key(seed=0, **changes):
        task = replace(benchmark, **changes).task("random", seed, "slayer")
        return checkpoint_of(task).key

    def settings(**changes):
        return Settings().with_values({"slayer": changes}, "test")

    assert key(settings=settings(epochs=3)) == key()
    assert key(settings=settings(tau_s=0.5)) != key()
    assert key(seed=1) != key()
    assert key(source_sha256="1" * 64) != key()


def test_the_table_by_hand(benchmark):
    store(benchmark, "cnn", 0, [1, 1, 1, 0])
    store(benchmark, "cnn", 1, [1, 1, 0, 0])
    store(benchmark, "ann-snn", 0, [1, 0, 1, 0])
    store(benchmark, "loihi", 0, [0, 0], samples=[2, 3])
    table = summarise(benchmark)
    assert table["simulated"] is True
    assert table["splits"] == 3
    cnn, ann, loihi = table["rows"]
    assert cnn["per_split"] == [0.75, 0.5]
    assert cnn["accuracy_mean"] == 0.625
    assert cnn["accuracy_sd"] == pytest.approx(0.125 * np.sqrt(2))
    assert (cnn["paper_mean"], cnn["paper_sd"]) == (0.89, 0.01)
    assert ann["per_split"] == [0.5]
    assert ann["accuracy_sd"] is None
    assert loihi["n_test"] == 2
    first, whole, second = table["comparisons"]
    assert (whole["a"], whole["b"], whole["difference"]) == ("cnn", "loihi", 0.5)
    # Split 0 only, since ann-snn has no split 1: 0.75 less 0.5.
    assert (first["a"], first["b"], first["difference"]) == ("cnn", "ann-snn", 0.25)
    # On the two samples that both have seen: right, wrong against wrong, wrong.
    assert (second["a"], second["b"], second["difference"]) == ("ann-snn", "loihi", 0.5)
    assert second["n_samples"] == 2
    text = table_text(table)
    assert "simulated" in text
    assert "0.625 (0.177)" in text
    assert "0.89 (0.01)" in text


def test_splits_of_several_sizes_count_by_their_mean(benchmark):
    for index, right in enumerate(([1, 0], [1, 0, 1, 1])):
        for model in ("cnn", "ann-snn"):
            store(benchmark, model, index, right)
    table = summarise(benchmark)
    assert table["rows"][0]["n_test"] == 3
    assert table["comparisons"][0]["n_samples"] == 3


def test_the_same_answers_differ_by_nothing(benchmark):
    for index in range(3):
        for model in ("cnn", "ann-snn"):
            store(benchmark, model, index, [1, 0, index % 2, 1])
    comparison = summarise(benchmark)["comparisons"][0]
    assert comparison["difference"] == 0
    assert comparison["p_value"] == 1


def test_a_failed_split_is_reported_and_not_counted(benchmark):
    store(benchmark, "cnn", 0, [1, 0])
    store(benchmark, "cnn", 1, [1, 1])
    name = benchmark.task("random", 2, "cnn").name
    table = summarise(benchmark, {name: Failure("MemoryError: no message", "")})
    assert table["rows"][0]["per_split"] == [0.5, 1.0]
    assert table["failures"] == [{"result": name, "error": "MemoryError: no message"}]
    assert f"{name}: MemoryError" in table_text(table)


def test_the_guide_for_clusters_shows_a_failure_as_it_is_printed(benchmark):
    failures = {
        benchmark.task("random", 1, model).name: Failure("KilledWorker: Attempted", "")
        for model in benchmark.models
    }
    lines = table_text(summarise(benchmark, failures)).splitlines()
    found = concluded(RunFolder(benchmark.folder), "table2", {}, "3 of 40 results")
    guide = (ROOT / "docs" / "slurm.md").read_text(encoding="utf-8")
    assert missing(guide, *lines[-3:], f"stmnist: {found.failed}\n") == []


def test_results_of_earlier_commands_stay_in_the_table(benchmark):
    """A later call for SLAYER alone must not take the other rows away."""
    for index in range(2):
        store(benchmark, "cnn", index, [1, 0])
    store(benchmark, "cnn", 0, [1, 1], kind="writers")
    store(benchmark, "slayer", 0, [1, 1])
    table = summarise(replace(benchmark, models=("slayer",), splits=1))
    assert [(row["model"], row["indices"]) for row in table["rows"]] == [
        ("cnn", [0, 1]),
        ("slayer", [0]),
    ]
    assert [row["model"] for row in table["writer_rows"]] == ["cnn"]
    assert [(c["a"], c["b"]) for c in table["comparisons"]] == [("cnn", "slayer")]


def test_a_worker_with_other_recordings_is_found_out(benchmark):
    data = replace(Settings().data, samples_per_digit=2)
    other = replace(benchmark, settings=replace(Settings(), data=data))
    with pytest.raises(UserError, match="recordings"):
        table2.measure(other.task("random", 0, "cnn"))


def test_the_time_of_trainings_that_are_missing(benchmark):
    asked = replace(benchmark, models=("cnn", "slayer"), splits=3)
    line = table2_command._time_of_slayer(asked, 6953, Workers(2))
    assert ": 3," in line
    store(asked, "slayer", 1, [1, 0])
    assert ": 2," in table2_command._time_of_slayer(asked, 6953, Workers(2))
    assert table2_command._time_of_slayer(replace(asked, models=("cnn",)), 6953, Workers(2)) is None


def test_a_row_that_was_not_run_says_so(benchmark):
    table = summarise(benchmark)
    assert table["rows"][0]["accuracy_mean"] is None
    title = table["rows"][0]["title"]
    (line,) = (line for line in table_text(table).splitlines() if title in line)
    assert not re.search(r"\d\.\d{3}|nan|None", line)  # the paper's has two digits


SMALL = (
    *("--splits", "1", "--jobs", "1", "--kind", "random", "--set", "data.samples_per_digit=12"),
    *("--set", "cnn.epochs=1", "--set", "snn.epochs=1", "--set", "slayer.epochs=1"),
    *("--set", "slayer.bins=20", "--set", "check.samples=5", "--set", "presentation.steps=20"),
    *("--set", "presentation.readout_start=5"),
)


def run(capsys, *arguments):
    return call("benchmark", "table2", *arguments), capsys.readouterr()


@pytest.mark.slow
def test_the_command_runs_resumes_and_prints(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("STMNIST_CACHE", str(tmp_path / "cache"))
    out = tmp_path / "out"
    names = ["cnn", "ann-snn", "slayer", "own-loihi"]  # each recipe and each kind of answer once
    models = ",".join(names)
    with untraced():
        status, said = run(capsys, "--out", str(out), "--models", models, *SMALL)
    assert status == 0, said.err
    table = json.loads((out / "table2.json").read_text())
    assert [row["model"] for row in table["rows"]] == names
    assert all(len(row["per_split"]) == 1 for row in table["rows"])
    assert [row["n_test"] for row in table["rows"]] == [24, 24, 24, 5]
    curve = (out / "splits/random-00/slayer.csv").read_text().splitlines()
    assert curve[0] == "epoch,loss,accuracy,seconds,test_accuracy"
    assert len(curve) == 2
    assert "epochs = 1\n" in (out / "experiment.toml").read_text()

    # One result gone, the model that it is of is run again, nothing else.
    lost = out / "splits/random-00/cnn.json"
    result, asked = json.loads(lost.read_text()), []

    def again(task):
        asked.append((task.seed, task.subject))
        return result

    monkeypatch.setattr(table2_command, "measure", again)
    before = (out / "splits/random-00/ann-snn.json").stat().st_mtime_ns
    lost.unlink()
    status, said = run(capsys, "--out", str(out), "--models", models, "--json", *SMALL)
    assert status == 0, said.err
    assert asked == [(0, "cnn")]
    assert json.loads(said.out) == json.loads((out / "table2.json").read_text())
    assert [row["per_split"] for row in json.loads(said.out)["rows"]] == [
        row["per_split"] for row in table["rows"]
    ]
    assert (out / "splits/random-00/ann-snn.json").stat().st_mtime_ns == before


@pytest.mark.slow
def test_the_rows_on_events(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("STMNIST_CACHE", str(tmp_path / "cache"))
    out = tmp_path / "out"
    tiny = ("--set", "events.epochs=1", "--set", "input.step=500", "--json")
    tiny += ("--set", "events.architecture=10x10x2-4c4s3-10o")
    status, said = run(capsys, "--out", str(out), "--models", "events,events-loihi", *SMALL, *tiny)
    assert status == 0, said.err
    table = json.loads(said.out)
    assert [row["model"] for row in table["rows"]] == ["events", "events-loihi"]
    assert [row["n_test"] for row in table["rows"]] == [24, 5]
    assert [(c["a"], c["b"]) for c in table["comparisons"]] == [("events", "events-loihi")]
    assert not list(out.rglob("checkpoint.npz"))


def test_slayer_on_own_recordings_needs_no_architecture(tmp_path, capsys):
    out, data = tmp_path / "out", write_folder(tmp_path / "own", per_class=8)
    few = ("--models", "slayer", "--splits", "1", "--set", "slayer.epochs=1", "--json")
    status, said = run(capsys, "--out", str(out), "--data", str(data), *few)
    assert status == 0, said.err
    (row,) = json.loads(said.out)["rows"]
    assert (row["model"], row["n_test"]) == ("slayer", 6)  # a fifth of 32
    assert read_settings(out / "experiment.toml").slayer.architecture == "9x12x2-6c4-24c3-4o"


def made_up(task):
    """A result of a model on a split, without a training."""
    return {
        "simulated": False,
        "n_train": 24,
        "n_test": 2,
        "accuracy": 0.5,
        "samples": [0, 1],
        "labels": [0, 1],
        "predictions": [0, 0],
        "seconds": 1.0,
    }


def test_events_and_images_of_own_recordings_are_presented_differently(
    tmp_path, monkeypatch, capsys
):
    """Events as long as the recordings last, images with the steps of the settings."""
    out, asked = tmp_path / "out", {}

    def measure(task):
        asked[task.subject] = task.settings
        return made_up(task)

    monkeypatch.setattr(table2_command, "measure", measure)
    long = [((x, y, 3 * t, p), label) for (x, y, t, p), label in gestures(4)]  # up to 5.85 s
    data = write_recordings(tmp_path / "own.zip", long, CLASSES)
    few = ("--splits", "1", "--jobs", "1", "--json")
    status, said = run(
        capsys, "--out", out, "--models", "ann-snn,events", "--data", str(data), *few
    )
    assert status == 0, said.err
    lasts = 1000 * max(t[-1] - t[0] for (_, _, t, _), _ in long)
    step = asked["events"].input.step
    assert lasts < asked["events"].steps * step <= lasts + step
    assert asked["ann-snn"].presentation.steps == 0
    kept = read_settings(out / "experiment.toml")
    assert kept.presentation == Settings().presentation
    assert kept.cnn.architecture == "9x12-6c4-24c3-4o"
    assert kept.events.architecture.startswith("9x12x2-")
    assert "merged into one spike" in said.err
    with pytest.raises(UserError, match="not of a run"):
        refuse_results(out)
    # A later command for other rows keeps those on events.
    status, said = run(capsys, "--out", out, "--models", "cnn", *few)
    assert status == 0, said.err
    rows = [(row["model"], row["per_split"]) for row in json.loads(said.out)["rows"]]
    assert rows == [("cnn", [0.5]), ("ann-snn", [0.5]), ("events", [0.5])]


def test_what_takes_long_is_only_run_if_asked_for():
    slow = {"slayer-small", "events", "events-loihi"}
    assert set(MODELS) - set(BY_DEFAULT) == slow


def test_a_failing_split_ends_with_status_1(tmp_path, monkeypatch, capsys):
    def fail(task):
        raise RuntimeError("the disk is on fire")

    monkeypatch.setenv("STMNIST_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(table2_command, "measure", fail)
    status, said = run(capsys, "--out", str(tmp_path / "out"), "--models", "cnn", *SMALL)
    assert status == 1
    assert "1 of 1 " in said.err
    assert "the disk is on fire" in said.out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--models", "cnn,svm"], "'svm'"),
        (["--models", ","], "models"),
        (["--kind", "stratified"], "stratified"),
        (["--set", "check.samples=100"], "check.samples"),
        (["--set", "slayer.epochs=0"], "slayer.epochs"),
    ],
)
def test_mistakes_end_with_status_2(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("STMNIST_CACHE", str(tmp_path / "cache"))
    status, said = run(capsys, "--out", str(tmp_path / "out"), *SMALL, *arguments)
    assert status == 2
    assert message in said.err
    assert "Traceback" not in said.err
