"""A check is saved stream by stream, and goes on where it stopped."""

import fcntl
from dataclasses import replace

import numpy as np
import pytest

from deploy import __version__
from deploy.check.run import run_check
from deploy.check.text import format_result
from deploy.conformance.networks import make_image_network
from deploy.errors import UserError
from deploy.files import read_json
from deploy.network.stimulus import ImageSpikes
from tests.deploy.checks import interrupted, partial, same_answers
from tests.deploy.networks import bundle_at

CONTRACT = {
    *("schema", "target", "bundle", "seed", "steps_per_sample", "n_samples", "accuracy"),
    *("accuracy_ci95", "samples", "spikes", "wall_seconds", "versions"),
}


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    """Seven samples in streams of three."""
    spec = make_image_network(steps=20, gap=3, readout_start=4)
    return bundle_at(tmp_path_factory.mktemp("bundle") / "bundle", spec)


@pytest.fixture(scope="module")
def whole(bundle, tmp_path_factory):
    """The result of a check that nothing disturbed."""
    return run_check(bundle, "emulator", tmp_path_factory.mktemp("whole") / "emulator.json")


@pytest.fixture(scope="module")
def begun(bundle, tmp_path_factory):
    """What is saved of a check that was interrupted after two streams."""
    return interrupted(bundle, tmp_path_factory.mktemp("begun") / "emulator.json", 2).read_bytes()


def test_the_result_has_the_contracts_entries(bundle, whole):
    assert whole.to_dict().keys() >= CONTRACT
    assert whole["schema"] == "stmnist-check/1"
    assert (whole["target"], whole["bundle"]) == ("emulator", bundle.id)
    assert (whole["n_samples"], whole["steps_per_sample"]) == (7, 20)
    assert [s["id"] for s in whole["samples"]] == list(bundle.checks.ids)
    assert [s["label"] for s in whole["samples"]] == bundle.checks.labels.tolist()
    for sample in whole["samples"]:
        assert len(sample["scores"]) == 10
        assert sample["prediction"] == max(range(10), key=sample["scores"].__getitem__)
    right = sum(s["label"] == s["prediction"] for s in whole["samples"])
    assert whole["accuracy"] == right / 7
    assert list(whole["spikes"]) == ["input", "conv1", "conv2"]
    assert min(whole["spikes"].values()) > 0
    assert {"python", "numpy", "nengo", "nengo_loihi"} <= whole["versions"].keys()
    assert whole["versions"]["stmnist"] == __version__
    assert whole["simulated"] is True
    labels = set(bundle.checks.labels.tolist())
    assert whole["classes_without_samples"] == [str(k) for k in range(10) if k not in labels]
    assert len(whole["classes_without_samples"]) >= 3
    assert whole["classes_without_samples"][-1] in format_result(whole).splitlines()[-1]
    assert whole["wall_seconds"] > 0


@pytest.mark.parametrize("after", [1, 2, 3])
def test_an_interrupted_check_goes_on_and_ends_the_same(bundle, whole, tmp_path, after):
    out = tmp_path / "emulator.json"
    saved = interrupted(bundle, out, after)
    assert len(saved.read_text().splitlines()) == 1 + after
    told = []
    same_answers(run_check(bundle, "emulator", out, advance=told.append), whole)
    assert told == [3, 3, 1]
    assert [path.name for path in tmp_path.iterdir()] == ["emulator.json"]


@pytest.mark.parametrize("target", ["nengo", "simreal", "emulator", "fast"])
def test_a_network_that_no_integers_hold_is_refused_and_nothing_is_left(tmp_path, target):
    unfit = bundle_at(
        tmp_path / "bundle", replace(make_image_network(), stimulus=ImageSpikes(max_rate=1e-3))
    )
    with pytest.raises(UserError, match="layer conv1: "):
        run_check(unfit, target, tmp_path / "result.json")
    assert [path.name for path in tmp_path.iterdir()] == ["bundle"]


@pytest.mark.parametrize("cut", [1, 40, 400])
def test_a_line_that_was_cut_short_is_done_again(bundle, whole, begun, tmp_path, cut):
    out = tmp_path / "emulator.json"
    partial(out).write_bytes(begun[:-cut])
    same_answers(run_check(bundle, "emulator", out), whole)


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"[]",
        b"3",
        b"null",
        b"{}",
        b'"samples"',
        b'{"samples": [1]}',
        b"\xff\xfe\x00",
        b"[" * 100_000,
    ]
    + [b'{"samples": [{"id": 1}], "seconds": 1.0}'],
)
def test_a_damaged_line_starts_the_check_afresh(bundle, whole, begun, tmp_path, line):
    out = tmp_path / "emulator.json"
    header = begun.splitlines()[0]
    partial(out).write_bytes(header + b"\n" + line + b"\n")
    same_answers(run_check(bundle, "emulator", out), whole)


def test_the_answers_to_another_bundle_are_not_taken(bundle, whole, tmp_path):
    out = tmp_path / "emulator.json"
    other = bundle_at(tmp_path / "other", make_image_network(seed=1))
    interrupted(other, out, 1)
    same_answers(run_check(bundle, "emulator", out), whole)


def test_a_second_writer_is_refused_and_loses_nothing(bundle, tmp_path):
    out = tmp_path / "nengo.json"
    saved = interrupted(bundle, out, 1, "nengo")
    before = saved.read_bytes()
    with saved.open("a") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(UserError, match=rf"{out}\b"):
            run_check(bundle, "nengo", out)
    assert saved.read_bytes() == before


def test_a_seed_of_numpy(bundle, tmp_path):
    run_check(bundle, "fast", tmp_path / "fast.json", seed=np.arange(4)[3])
    assert read_json(tmp_path / "fast.json", "")["seed"] == 3


def test_a_place_that_cannot_be_written(bundle, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"file: .*--out"):
        run_check(bundle, "nengo", tmp_path / "file" / "nengo.json")
    with pytest.raises(UserError, match=f"{tmp_path}: .*--out"):
        run_check(bundle, "nengo", tmp_path)
    with pytest.raises(UserError, match="'gpu'"):
        run_check(bundle, "gpu", tmp_path / "gpu.json")
    with pytest.raises(UserError, match=r"seed -1: .* 0 to 2147483647\b"):
        run_check(bundle, "nengo", tmp_path / "nengo.json", seed=-1)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
