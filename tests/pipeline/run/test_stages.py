"""Several stages at once: their streams shared between processes."""

import fcntl
import json
from dataclasses import replace

import pytest

from deploy.check.results import read_result
from deploy.check.run import OpenCheck, open_check, run_check
from deploy.errors import UserError
from pipeline.run.folder import RunFolder
from pipeline.run.stages import answer_all
from pipeline.settings import Settings
from tests.deploy.networks import bundle_at, paper_spec

TARGETS = ["nengo", "emulator", "fast"]


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    """Seven samples in streams of three."""
    return bundle_at(tmp_path_factory.mktemp("bundle") / "bundle")


def answered(folder, bundle, targets=TARGETS, **given):
    return answer_all(RunFolder(folder), Settings(), bundle, targets, jobs=2, **given)


def partial(folder, target):
    return folder / "checks" / f".{target}.json.partial"


def interrupted(folder, bundle, target, after):
    """Run a target's check that is interrupted after some streams."""
    told = []

    def advance(n):
        told.append(n)
        if len(told) == after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_check(bundle, target, RunFolder(folder).check(target), advance=advance)


def without_times(result):
    return {key: value for key, value in result.items() if key != "wall_seconds"}


def test_shared_streams_give_the_answers_of_one_process(bundle, tmp_path):
    results = answered(tmp_path, bundle)
    assert [result["target"] for result in results] == TARGETS
    for result in results:
        alone = run_check(bundle, result["target"], tmp_path / "alone.json")
        assert without_times(result) == without_times(alone)
        assert read_result(RunFolder(tmp_path).check(result["target"])) == result
        assert result["wall_seconds"] > 0
    assert sorted(path.name for path in (tmp_path / "checks").iterdir()) == sorted(
        f"{target}.json" for target in TARGETS
    )


def test_what_is_done_is_not_done_again(bundle, tmp_path):
    interrupted(tmp_path, bundle, "nengo", 2)
    saved = partial(tmp_path, "nengo")
    header, first, second = saved.read_text().splitlines()
    record = json.loads(first)
    record["samples"][0]["scores"][0] = 123.0
    saved.write_text("\n".join([header, json.dumps(record), second]) + "\n")
    interrupted(tmp_path, bundle, "emulator", 3)  # all streams are there, the result is not
    nengo, emulator = answered(tmp_path, bundle, ["nengo", "emulator"])
    assert nengo["samples"][0]["scores"][0] == 123.0
    whole = run_check(bundle, "emulator", tmp_path / "whole.json")
    assert without_times(emulator) == without_times(whole)


def test_an_interruption_keeps_every_stream_that_was_answered(bundle, tmp_path, monkeypatch):
    """Wherever it was answered, and before this process had heard of it."""

    def stop(self, record):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(OpenCheck, "take", stop)
        with pytest.raises(KeyboardInterrupt):
            answered(tmp_path, bundle, ["nengo", "emulator"])
    texts = [partial(tmp_path, target).read_text() for target in ("nengo", "emulator")]
    assert sum(text.count('"first": ') for text in texts) >= 1
    for result in answered(tmp_path, bundle, ["nengo", "emulator"]):
        alone = run_check(bundle, result["target"], tmp_path / "alone.json")
        assert without_times(result) == without_times(alone)
    assert not partial(tmp_path, "nengo").exists()


def test_streams_are_resumed_in_whatever_order_they_came(bundle, tmp_path):
    interrupted(tmp_path, bundle, "emulator", 3)
    saved = partial(tmp_path, "emulator")
    first, second, third = saved.read_text().splitlines()[1:]
    cut, other = second[:-9], json.dumps({**json.loads(first), "of": {"bundle": "another"}})
    saved.write_text("\n".join(["", third, cut, other]))
    check = RunFolder(tmp_path).check("emulator")
    with open_check(bundle, "emulator", check) as opened:
        assert opened.left == [slice(0, 3), slice(3, 6)]
    (result,) = answered(tmp_path, bundle, ["emulator"])
    assert without_times(result) == without_times(run_check(bundle, "emulator", check))


def test_a_target_that_fails_leaves_the_others_results(tmp_path):
    spec = paper_spec(steps=30, gap=5, readout_start=8, stream_length=3)
    layers = (replace(spec.layers[0], pop_type=16), *spec.layers[1:])  # of filters not in fours
    bundle = bundle_at(tmp_path / "bundle", replace(spec, layers=layers))
    with pytest.raises(UserError, match="target emulator: NengoLoihi cannot build this network"):
        answered(tmp_path, bundle, ["nengo", "emulator"])
    assert len(read_result(RunFolder(tmp_path).check("nengo"))["samples"]) == 7
    assert not RunFolder(tmp_path).check("emulator").exists()


def test_a_result_that_another_process_writes(bundle, tmp_path):
    interrupted(tmp_path, bundle, "nengo", 1)
    with partial(tmp_path, "nengo").open("a") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(UserError, match="another process is writing this result"):
            answered(tmp_path, bundle, ["nengo", "emulator"])
