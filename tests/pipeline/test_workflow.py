"""Several stages at once: their streams shared between processes."""

import json
from types import SimpleNamespace

import pytest

from deploy.check.results import read_result
from deploy.check.run import OpenCheck, run_check
from deploy.errors import UserError
from pipeline.kinds.registry import find_kind
from pipeline.settings import Settings
from pipeline.storage.artifacts import Origin
from pipeline.storage.run_folder import RunFolder
from pipeline.workflow import check_stages, open_experiment
from tests.deploy.checks import interrupted, partial, same_answers
from tests.deploy.networks import bundle_at

TARGETS = ["nengo", "emulator", "fast"]


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    """Seven samples in streams of three."""
    return bundle_at(tmp_path_factory.mktemp("bundle") / "bundle")


def answered(folder, bundle, targets=TARGETS):
    no_data = SimpleNamespace(origin=Origin())
    opened = open_experiment(RunFolder(folder), Settings(), no_data, lambda line: None)
    return check_stages(opened, bundle, targets, jobs=2)


def check_of(folder, target):
    return RunFolder(folder).find_check_file(target)


def test_shared_streams_give_the_answers_of_one_process(bundle, tmp_path):
    results = answered(tmp_path, bundle)
    assert [result["target"] for result in results] == TARGETS
    for result in results:
        alone = run_check(bundle, result["target"], tmp_path / "alone.json")
        same_answers(result, alone)
        assert read_result(check_of(tmp_path, result["target"])) == result
        assert result["wall_seconds"] > 0
    assert sorted(path.name for path in (tmp_path / "checks").iterdir()) == sorted(
        f"{target}.json" for target in TARGETS
    )


def test_what_is_done_is_not_done_again(bundle, tmp_path):
    interrupted(bundle, check_of(tmp_path, "nengo"), 2, "nengo")
    saved = partial(check_of(tmp_path, "nengo"))
    _, first, second = saved.read_text().splitlines()
    record = json.loads(first)
    record["samples"][0]["scores"][0] = 123.0
    saved.write_text("\n".join(["", json.dumps(record), second]) + "\n")
    # Of the emulator all streams are there, the result is not.
    interrupted(bundle, check_of(tmp_path, "emulator"), 3, "emulator")
    nengo, emulator = answered(tmp_path, bundle, ["nengo", "emulator"])
    assert nengo["samples"][0]["scores"][0] == 123.0
    whole = run_check(bundle, "emulator", tmp_path / "whole.json")
    same_answers(emulator, whole)


def test_an_interruption_keeps_every_stream_that_was_answered(bundle, tmp_path, monkeypatch):
    """Wherever it was answered, and before this process had heard of it."""

    def stop(self, record):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(OpenCheck, "add_record", stop)
        with pytest.raises(KeyboardInterrupt):
            answered(tmp_path, bundle, ["nengo", "emulator"])
    paths = [partial(check_of(tmp_path, target)) for target in ("nengo", "emulator")]
    assert sum(path.read_text().count('"first": ') for path in paths if path.exists()) >= 1
    for result in answered(tmp_path, bundle, ["nengo", "emulator"]):
        alone = run_check(bundle, result["target"], tmp_path / "alone.json")
        same_answers(result, alone)
    assert not partial(check_of(tmp_path, "nengo")).exists()


def test_an_unknown_name_is_answered_with_the_known_ones(bundle, tmp_path):
    with pytest.raises(UserError, match="emulator"):
        answered(tmp_path, bundle, ["emu"])
    with pytest.raises(ValueError, match="cnn"):
        find_kind(Settings()).find_step("cn")


def test_a_target_that_fails_leaves_the_others_results(bundle, tmp_path):
    with pytest.raises(UserError, match="NxSDK"):
        answered(tmp_path, bundle, ["nengo", "loihi"])
    assert len(read_result(check_of(tmp_path, "nengo"))["samples"]) == 7
    assert not check_of(tmp_path, "loihi").exists()
