"""Studies: rows are measured once and kept, and a failure is said."""

import json
from dataclasses import replace

import numpy as np
import pytest

from deploy.errors import CheckFailed, UserError
from pipeline.results import study
from pipeline.results.study import Case, Workers
from pipeline.settings import Settings
from pipeline.sources import load_dataset, load_named_recordings

SMALL = Settings().with_values(
    {"data": {"samples_per_digit": 12}, "split": {"validation_fraction": 0.25}}, "test"
)
ONE = Workers(1)


def counting(case, networks):
    """A measurement that leaves a mark, and fails for the seed 3."""
    if case.seed == 3:
        raise UserError("seed 3 is not measured")
    with open(networks.path.parent / "calls", "a") as file:
        file.write(f"{case.name} {case.seed}\n")
    return {"recordings": "0", "seed": case.seed}


def test_rows_are_measured_once_and_what_is_missing_later(tmp_path):
    cases = [Case("a", SMALL, "cnn", seed) for seed in range(2)]
    more = [*cases, Case("a", SMALL, "cnn", 2)]
    for some in (cases, more, more):
        rows, failed = study.run_study(some, tmp_path, "0", ONE, print, counting)
        assert [r["seed"] for r in rows] == [case.seed for case in some]
        assert failed == {}
    assert (tmp_path / "calls").read_text().split() == ["a", "0", "a", "1", "a", "2"]


def test_a_failure_is_said_and_the_others_stand(tmp_path):
    cases = [Case("a", SMALL, "cnn", seed) for seed in (2, 3)]
    said = []
    rows, failed = study.run_study(cases, tmp_path, "0", ONE, said.append, counting)
    assert [r["seed"] for r in rows] == [2]
    assert "seed 3 is not measured" in failed[cases[1]]
    assert said == ["seed 3 is not measured"]
    with pytest.raises(CheckFailed):
        study.run_study(cases[1:], tmp_path, "0", ONE, said.append, counting)


def test_a_worker_with_other_recordings_is_refused(tmp_path):
    with pytest.raises(CheckFailed):
        study.run_study([Case("a", SMALL, "cnn")], tmp_path, "1", ONE, print, counting)


def test_the_key_of_a_case_is_of_all_that_it_depends_on():
    case = Case("a", SMALL, "cnn")
    others = [
        replace(case, seed=1),
        replace(case, split="writers"),
        replace(case, part="validation"),
        replace(case, alter="even"),
        replace(case, stage="fast"),
        replace(case, settings=SMALL.with_values({"cnn": {"epochs": 7}}, "")),
    ]
    keys = {one.compute_key("0") for one in (case, *others)} | {case.compute_key("1")}
    assert len(keys) == 8
    assert replace(case, name="b").compute_key("0") == case.compute_key("0")


def test_cases_that_differ_in_deployment_share_networks():
    one, two, three = (
        Case("a", SMALL.with_values(changes, ""), "fast")
        for changes in ({}, {"presentation": {"steps": 50}}, {"snn": {"spike_penalty": 0.1}})
    )
    assert one.trained == two.trained != three.trained


def test_validation_samples_are_never_test_samples():
    whole = load_dataset(SMALL)
    dataset = study.make_dataset(Case("a", SMALL, "fast", part="validation"))
    assert len(dataset.split.test) == 0
    assert len(dataset.split.validation) == 24  # of 96 that are not for testing
    assert not {*dataset.split.train, *dataset.split.validation} & {*whole.split.test}
    assert dataset.origin.key != whole.origin.key


@pytest.mark.slow
def test_a_small_study_of_a_network(tmp_path):
    tiny = {"data": {"samples_per_digit": 20}, "cnn": {"epochs": 2}, "snn": {"epochs": 1}}
    settings = Settings().with_values({**tiny, "presentation": {"steps": 30}}, "test")
    stages = ("cnn", "rate-lif", "spiking-lif", "fast")
    cases = [Case(stage, settings, stage) for stage in stages]
    sha256 = load_named_recordings(settings).source.sha256
    rows, failed = study.run_study(cases, tmp_path, sha256, ONE, print)
    assert failed == {}
    assert json.loads(json.dumps(rows)) == rows
    for found in rows:
        assert (found["n_train"], found["n_test"]) == (160, 40)
        assert found["accuracy"] == np.mean(found["right"])
    costs = rows[-1]["costs"]
    assert costs["per_cnn"] == costs["per_dense"] > 0  # it has the architecture of the paper's CNN
    assert costs["updates"] == 894 * 50
    assert len(list((tmp_path / "rows").iterdir())) == 4
