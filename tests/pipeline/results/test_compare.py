"""Runs side by side, by hand, and through the command."""

import json
import re
import shutil
from dataclasses import replace

import pytest

from deploy.check.intervals import compute_fisher_p, compute_wilson_interval
from deploy.check.results import EarlyDecisions, WhileWritten
from deploy.conformance.networks import make_event_network, make_image_network
from deploy.errors import UserError
from pipeline.kinds.registry import find_kind
from pipeline.recordings.dataset import make_dataset_origin
from pipeline.results import compare
from pipeline.results.compare import (
    ComparedRun,
    compare_accuracies,
    compare_runs,
    compute_inference,
    format_runs,
    read_runs,
)
from pipeline.settings import Settings
from tests.command import call, missing
from tests.deploy.results import make_result

LABELS = (0, 1, 2, 3, 4, 5, 6, 7)


def result(stage, predictions, labels=LABELS, ids=None, operations=None, **more):
    n_right = sum(a == b for a, b in zip(predictions, labels, strict=True))
    return make_result(
        predictions,
        labels,
        ids,
        target=stage,
        accuracy_ci95=list(compute_wilson_interval(n_right, len(labels))),
        synaptic_operations=operations or {},
        **more,
    )


def run(name, results, spec=None, changes=None, cores=2, source="s" * 64, **more):
    spec = spec or make_image_network()
    spec.provenance.entries["source_sha256"] = source
    settings = Settings().with_values(changes or {}, "here")
    origin = find_kind(settings).make_bundle_origin(make_dataset_origin(settings, source))
    spec.provenance.entries["made_from"] = origin.to_json()
    return ComparedRun(name, settings, spec, cores, 1, {r.target: r for r in results}, **more)


ALL = list(LABELS)
FIVE_RIGHT = [0, 1, 2, 3, 4, 0, 0, 0]
LAST_FOUR = [9, 9, 9, 9, 4, 5, 6, 7]


def test_a_paired_difference_by_hand():
    a, b = run("a", [result("nengo", FIVE_RIGHT)]), run("b", [result("nengo", LAST_FOUR)])
    found = compare_accuracies(a, b, "nengo")
    assert found["paired"]
    assert found["difference"] == pytest.approx(-1 / 8)
    assert (found["only_a"], found["only_b"]) == (4, 3)  # 0 to 3, and 5 to 7
    assert found["p"] == pytest.approx(1)  # 4 of 7
    found = compare_accuracies(b, run("c", [result("nengo", ALL)]), "nengo")
    assert (found["only_a"], found["only_b"]) == (0, 4)
    assert found["p"] == pytest.approx(2 * 0.5**4)


def test_the_same_samples_in_another_order_are_paired():
    ids = [f"x/{i}" for i in range(8)]
    backwards = result("nengo", LAST_FOUR[::-1], LABELS[::-1], ids[::-1])
    a = run("a", [result("nengo", LAST_FOUR)])
    found = compare_accuracies(a, run("b", [backwards]), "nengo")
    assert found["paired"]
    assert (found["only_a"], found["only_b"], found["p"]) == (0, 0, 1)


@pytest.mark.parametrize(
    "other",
    [
        {"results": [result("nengo", FIVE_RIGHT, ids=[f"y/{i}" for i in range(8)])]},
        {"results": [result("nengo", FIVE_RIGHT, labels=(0, 1, 2, 3, 4, 5, 6, 9))]},
        {"results": [result("nengo", FIVE_RIGHT[:5], labels=LABELS[:5])]},
        {"results": [result("nengo", FIVE_RIGHT)], "source": "t" * 64},
    ],
    ids=["ids", "labels", "fewer", "recordings of the same names"],
)
def test_other_samples_are_not_paired(other):
    a = run("a", [result("nengo", LAST_FOUR)])
    found = compare_accuracies(a, run("b", **other), "nengo")
    assert not found["paired"]
    assert found["only_a"] is None
    text = format_runs(compare_runs([a, run("b", **other)]))
    assert "unpaired" in text


def test_the_test_of_what_is_not_paired_by_hand():
    # Of the tables with four of each kind: 3 of 4 against 1 of 4, or more uneven, either way.
    assert compute_fisher_p(3, 4, 1, 4) == pytest.approx((16 + 1 + 1 + 16) / 70)
    assert compute_fisher_p(2, 4, 2, 4) == pytest.approx(1)


def test_settings_that_differ_and_no_others():
    a = run("a", [result("fast", ALL)], changes={"seed": 3})
    b = run("b", [result("fast", ALL)], changes={"snn": {"max_rates": [100.0]}})
    compared = compare_runs([a, b])
    assert compared["settings"] == [
        {"name": "seed", "values": [3, 0]},
        {"name": "snn.max_rates", "values": [[150.0], [100.0]]},
    ]
    assert compare_runs([a, a])["settings"] == []
    assert "seed" not in format_runs(compare_runs([a, a]))


def test_where_a_network_comes_from():
    graph = {"nir": {"file": "graph.nir", "sha256": "a" * 64}, "input": {"kind": "events"}}
    runs = [run("a", [result("fast", ALL)]), run("b", [result("fast", ALL)], changes=graph)]
    values = {row["name"]: row["values"] for row in compare_runs(runs)["settings"]}
    assert values["network from"] == ["training", "graph.nir"]
    assert "nir.sha256" not in values


def test_what_an_inference_takes_by_hand(monkeypatch):
    counts = {"operations": {"conv1": 600, "conv2": 200}}
    images = run("a", [result("nengo", ALL), result("emulator", ALL, **counts)])
    first, second = compare_runs([images, run("b", [result("nengo", ALL)])])["runs"]
    assert first["counted_on"] == "emulator"
    assert first["synaptic_operations"] == 100
    # 6x6-4c3-8c2-10o: 16 * 9 * 4, 9 * 16 * 8, 72 * 10
    assert first["operations_per_mac"] is None  # the paper's CNN is for the digits of its sensor
    monkeypatch.setattr(compare, "is_st_mnist_sensor", lambda rows, columns, classes: True)
    assert compute_inference(images)["operations_per_mac"] == pytest.approx(100 / 43104)
    assert first["neurons"] == 64 + 72
    assert (second["counted_on"], second["synaptic_operations"]) == (None, None)


def test_time_to_decide_of_events():
    early = EarlyDecisions(0.9, 0.75, [0.4, 0.9], share_of_writing_mean=0.82, before_the_end=0.9)
    written = WhileWritten(10.0, 50.0, [1.0], [0.75], early)
    answer = result("fast", ALL, operations={"conv1": 8}, while_written=written)
    changes = {"input": {"kind": "events"}}
    events = run("b", [answer], spec=make_event_network(), changes=changes)
    compared = compare_runs([run("a", [result("fast", ALL)]), events])
    assert compared["runs"][0]["writing"] is None
    assert compared["runs"][1]["writing"]["share"] == 0.82
    text = format_runs(compared)
    assert missing(text, "82%", "image", "events") == []
    at_end = replace(written, early=replace(early, confidence=1.0))
    answer = replace(answer, while_written=at_end)
    events = run("b", [answer], spec=make_event_network(), changes=changes)
    assert compare_runs([run("a", [answer]), events])["runs"][1]["writing"] is None


def test_simulated_and_other_samples_are_told_apart():
    real = make_image_network()
    real.provenance.entries["simulated"] = False
    runs = [run("a", [result("cnn", ALL)]), run("b", [result("cnn", ALL)], spec=real)]
    assert "8 samples" in format_runs(compare_runs(runs))
    assert "simulated" not in format_runs(compare_runs([runs[1], runs[1]]))


@pytest.fixture(scope="module")
def pair(tiny_run, tmp_path_factory):
    """Copies of the small run, the second one shown for fewer steps."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("first", "shorter"):
        shutil.copytree(tiny_run, folder / name)
    assert call("convert", folder / "shorter", "--steps", "30", "--samples", "20") == 0
    for name in ("first", "shorter"):
        assert call("check", "run", folder / name / "bundle", "--target", "fast") == 0
    return folder / "first", folder / "shorter"


def test_the_command(pair, capsys):
    assert call("compare", *pair, "--json") == 0
    compared = json.loads(capsys.readouterr().out)
    assert compared["settings"] == [{"name": "presentation.steps", "values": [40, 30]}]
    stages = {stage["stage"]: stage for stage in compared["stages"]}
    assert set(stages) == {"cnn", "rate-lif", "spiking-lif", "fast"}
    assert all(stage["differences"][1]["paired"] for stage in stages.values())
    assert stages["cnn"]["differences"][1]["difference"] == 0  # it knows nothing of steps
    first, second = compared["runs"]
    assert 0 < second["synaptic_operations"] < first["synaptic_operations"]
    assert first["cores"] == second["cores"] == 2
    assert call("compare", *pair) == 0
    assert "presentation.steps    40  30" in capsys.readouterr().out


def test_results_of_an_earlier_bundle_are_left_out(pair, tmp_path):
    mixed = tmp_path / "mixed"
    shutil.copytree(pair[1], mixed)
    shutil.copy(pair[0] / "checks" / "nengo.json", mixed / "checks")
    _, found = read_runs([pair[0], mixed])
    assert "nengo" in found.stale
    assert "fast" not in found.stale
    assert "nengo" not in found.results


def test_bad_input_is_one_clear_line_and_status_2(pair, tmp_path, capsys):
    run, _ = pair

    def copy(name, without):
        shutil.copytree(run, tmp_path / name)
        (shutil.rmtree if (tmp_path / name / without).is_dir() else lambda path: path.unlink())(
            tmp_path / name / without
        )
        return tmp_path / name

    for arguments, fact in (
        ([run], "two"),
        ([], "(?i)runs"),
        ([run, tmp_path], "experiment.toml"),
        ([run, tmp_path / "none"], "experiment.toml"),
        ([run, run / "ladder.json"], "is a file"),
        ([run, copy("a", "bundle")], "bundle.*stmnist convert"),
        ([run, copy("b", "checks")], "'stmnist ladder"),
    ):
        assert call("compare", *arguments) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert len(err.splitlines()) == 1
        assert re.search(fact, err), err


def test_a_damaged_result_is_named(pair, tmp_path):
    damaged = tmp_path / "damaged"
    shutil.copytree(pair[1], damaged)
    (damaged / "checks" / "nengo.json").write_text("{")
    with pytest.raises(UserError, match=r"nengo\.json"):
        read_runs([pair[0], damaged])
