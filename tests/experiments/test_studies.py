"""The experiments: their lines, tables and commands, and the parts of documents made from them."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from experiments import adapt, document, measuring, results, speed, studies, study_tables, tables
from experiments.__main__ import OTHERS, main
from experiments.catalogue import EXPERIMENTS, FAULTY_STAGES
from pipeline.results.study import Case
from pipeline.settings import Settings
from pipeline.sources import load_named_recordings
from pipeline.storage.artifacts import Library
from pipeline.training.adaptation.adapt import add_rehearsal
from tests.command import call, missing
from tests.experiments.test_tables import row

BY_NAME = {experiment.name: experiment for experiment in EXPERIMENTS}


def cases_of(experiment, seeds=(0,)):
    """The cases on random splits, without what would be chosen for recordings."""
    settings = studies.list_settings(experiment, experiment.lines, Settings())
    return studies.list_cases(experiment, experiment.lines, settings, seeds, ("random",))


@pytest.mark.parametrize("experiment", EXPERIMENTS, ids=lambda e: e.name)
def test_the_lines_of_an_experiment_are_cases(experiment):
    names = [line.name for line in experiment.lines]
    assert len(set(names)) == len(names)
    assert set(itertools.chain(*experiment.pairs)) <= set(names)
    cases = cases_of(experiment, (0, 1))
    keys = {case.compute_key("0") for case in cases}
    assert len(keys) == len(cases) == 2 * len(names)  # no two lines are the same measurement


def test_rows_on_the_chip_say_where_the_readout_is():
    for experiment in EXPERIMENTS:
        cases = cases_of(experiment)
        for case, line in zip(cases, experiment.lines, strict=True):
            if "emulated Loihi, readout on" in line.title:
                assert case.stage.startswith("fast")
                assert line.title.endswith(f"readout on {case.settings.deployment.readout}")


def test_architectures_are_chosen_on_validation_samples():
    experiment = BY_NAME["architectures"]
    for case in cases_of(experiment):
        assert case.part == "validation"
        assert case.settings.split.validation_fraction > 0


def test_the_paper_is_beside_random_splits_only():
    rows = [
        row(name, seed, [1, 1, 0], split)
        for name in ("cnn", "loihi")
        for seed in range(3)
        for split in ("random", "writers")
    ]
    result = tables.make_table(rows, against=BY_NAME["table2"].pairs)
    random, writers = (
        study_tables.make_cells(BY_NAME["table2"], result, s) for s in ("random", "writers")
    )
    assert [line[-1] for line in random] == ["paper, real data", "0.89 (0.01)", "0.86 (0.02)"]
    assert len(writers[0]) == len(random[0]) - 1
    titles = {line.name: line.title for line in BY_NAME["table2"].lines}
    pairs = [tuple(cells[:3]) for cells in tables.make_comparison_cells(result, titles)[1:]]
    assert (titles["loihi"], titles["cnn"], "random") in pairs
    text = study_tables.format_result(BY_NAME["table2"], result)
    assert missing(text, "random splits", "writers splits", "this row", "against", "Holm") == []


def test_an_unknown_row_and_an_unknown_experiment_are_one_line(tmp_path, capsys):
    assert call("losses", "--only", "nothing", "--out", tmp_path / "out", main=main) == 2
    assert missing(capsys.readouterr().err, "'nothing'", "chip-100") == []
    assert not (tmp_path / "out").exists()
    assert call("nothing", main=main) == 2
    assert "python -m experiments" in capsys.readouterr().err


def test_the_list_has_every_experiment(capsys):
    main([])
    assert missing(capsys.readouterr().out, *BY_NAME, *OTHERS) == []


@pytest.mark.slow
def test_an_experiment_from_end_to_end(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(studies, "RESULTS", tmp_path)
    out = tmp_path / "out"
    tiny = ("data.samples_per_digit=20", "cnn.epochs=2", "snn.epochs=1", "presentation.steps=30")
    options = [word for setting in tiny for word in ("--set", setting)]
    command = ("table2", "--only", "cnn,own-loihi,own-loihi-chip", "--seeds", "1", "--jobs", "1")
    command = (*command, "--out", out, *options, "--json", "--store", "stored")
    assert call(*command, main=main) == 0
    result = json.loads(capsys.readouterr().out)
    assert result == json.loads((tmp_path / "stored.json").read_text())
    assert {entry["split"] for entry in result["rows"]} == {"random", "writers"}
    assert all(entry["n_test"] in (40, 60) or entry["n_test"] > 20 for entry in result["rows"])
    before = {path: path.stat().st_mtime_ns for path in (out / "rows").iterdir()}
    assert len(before) == 6
    assert call(*command, main=main) == 0
    assert {path: path.stat().st_mtime_ns for path in (out / "rows").iterdir()} == before
    assert json.loads(capsys.readouterr().out)["rows"] == result["rows"]


def test_faulty_taxels_are_in_the_test_samples_only(tmp_path):
    changes = {
        "data": {"samples_per_digit": 20},
        "cnn": {"epochs": 1},
        "snn": {"recipe": "as-is"},
    }
    settings = Settings().with_values(changes)
    networks = Library(tmp_path)
    rows = [
        measuring.measure(Case(stage, settings, stage), networks)
        for stage in ("fast", *FAULTY_STAGES)
    ]
    assert [row["stage"] for row in rows] == ["fast", *FAULTY_STAGES]
    assert len({tuple(row["samples"]) for row in rows}) == 1
    assert len({row["costs"]["operations"] for row in rows}) == 3
    assert len(list(tmp_path.rglob("weights.npz"))) == 2  # a CNN and its rates, for all three


@pytest.mark.slow
def test_slayer_is_trained_on_events(tmp_path, monkeypatch):
    from experiments import slayer
    from pipeline.storage.artifacts import Library

    whole = slayer.Slayer
    small = {"epochs": 1, "bins": 20}
    monkeypatch.setattr(slayer, "Slayer", lambda **given: whole(**given, **small))
    settings = Settings().with_values({"data": {"samples_per_digit": 12}})
    result = measuring.measure(Case("slayer", settings, "slayer"), Library(tmp_path))
    assert (result["n_train"], len(result["right"]), len(result["history"])) == (96, 24, 1)


def test_the_gain_over_people_by_hand():
    people = [
        {"who": who, "each": 1, "before": 0.5, "after": after, "others_before": 0.9,
         "others_after": 0.8, "used": 1.0}
        for who, after in enumerate((0.6, 0.7, 0.8))
    ]  # fmt: skip
    (result,) = adapt.summarise(people)
    reach = 4.302652729911275 * 0.1 / 3**0.5
    assert result["gain"] == pytest.approx(0.2)
    np.testing.assert_allclose(result["ci95"], [0.2 - reach, 0.2 + reach])
    assert (result["people"], result["worst"]) == (3, pytest.approx(0.1))
    assert adapt.summarise(people[:2])[0]["ci95"] is None


def test_what_a_readout_is_fitted_to_is_not_what_it_is_tested_on():
    labels = np.repeat(np.arange(3), 9)
    first, rest = adapt.split_recordings(labels, 0)
    assert first.shape == (3, max(adapt.RECORDINGS_PER_CLASS))
    assert sorted([*first.ravel(), *rest]) == list(range(27))
    assert (labels[first] == np.arange(3)[:, None]).all()


def test_people_are_fitted_one_by_one(tiny_run, monkeypatch):
    monkeypatch.setattr(adapt, "RECORDINGS_PER_CLASS", (2,))
    bundle = read_bundle(tiny_run / "bundle")
    recordings = load_named_recordings(Settings().with_values({"data": {"samples_per_digit": 60}}))
    some = recordings.subset(np.arange(0, len(recordings), 10))
    some = replace(some, writers=np.arange(len(some)) % 2)
    inputs = bundle.checks.inputs, bundle.checks.labels
    spec = bundle.spec
    if spec.rehearsal is None:
        spec = add_rehearsal(spec, *inputs, np.arange(len(inputs[1])), 0)
    result = list(adapt.measure_fits_to_people(spec, inputs, some, draws=1, seed=0))
    assert {(row["who"], row["each"]) for row in result} == {(0, 2), (1, 2)}
    for person in result:
        assert all(0 <= person[name] <= 1 for name in adapt.MEASURES)
        if not person["used"]:
            assert person["after"] == person["before"]


def test_fast_is_compared_with_the_emulator_in_turns(tiny_run):
    result = speed.measure_on_bundle(read_bundle(tiny_run / "bundle"), samples=10)
    assert result["identical"]
    assert result["ratio"] > 0
    slow, fast = result["samples_per_second"]
    assert min(slow, fast) > 0


def test_fast_simulator_is_compared_with_nengoloihis_in_turns():
    result = speed.measure_on_network("a channel", lambda: speed.build_channel(20), 8)
    assert result["identical"]
    assert result["ratio_emulator"] > 0


def test_a_figure_of_a_document(tmp_path, monkeypatch):
    monkeypatch.setattr(document, "RESULTS", tmp_path)
    result = {"rows": [{"name": "a", "mean": 0.1234}], "n": 7}
    (tmp_path / "some.json").write_text(json.dumps(result))
    assert document.read_figure("some rows a mean .3f") == "0.123"
    assert document.read_figure("some rows 0 mean 100*.1f") == "12.3"
    text = "x <!-- figure: some n d -->old\ntext<!-- /figure --> y"
    assert document.with_parts(text) == "x <!-- figure: some n d -->7<!-- /figure --> y"
    for wrong in ("some rows b mean .3f", "none n d", "some rows a mean .q"):
        with pytest.raises(ValueError, match="figure"):
            document.read_figure(wrong)


@pytest.mark.parametrize("path", sorted(results.RESULTS.glob("*.json")), ids=lambda path: path.stem)
def test_every_result_is_a_table_of_the_documents(path):
    """Its lines exist, and none has an interval that the statistics would not give."""
    assert document.make_part(path.stem)
    content = json.loads(path.read_text())
    for entry in content.get("rows", ()):
        if entry.get("values") and len(entry["values"]) > 1 and "split" in entry:
            expected = tables.make_table(
                [
                    {**row(entry["name"], seed, [0], entry["split"]), "accuracy": value,
                     "n_train": entry["n_train"], "n_test": entry["n_test"]}
                    for seed, value in zip(entry["seeds"], entry["values"], strict=True)
                ]
            )["rows"][0]  # fmt: skip
            if expected["ci95"] is None:  # of two splits
                assert entry["ci95"] is None
            else:
                np.testing.assert_allclose(entry["ci95"], expected["ci95"])
