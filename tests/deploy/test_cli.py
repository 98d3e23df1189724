"""The command of a copied bundle ends in one line, whatever happens to its files and its output."""

import json
import subprocess
import sys
from dataclasses import replace

import pytest

from deploy import cli
from deploy.conformance.networks import make_image_network
from deploy.errors import CheckFailed, UserError
from tests.command import environment
from tests.deploy.networks import bundle_at


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return bundle_at(tmp_path_factory.mktemp("bundle") / "bundle")


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (CheckFailed("2 disagreements"), 1, "2 disagreements"),
        (UserError("a: wrong; mend it"), 2, "a: wrong; mend it"),
        (
            PermissionError(13, "Permission denied", "b/weights.npz"), 2,
            "b/weights.npz: Permission denied",
        ),
        (OSError("no more"), 2, "no more"),
        (MemoryError(), 2, "not enough memory"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)  # fmt: skip
def test_every_error_is_one_line_and_a_status(monkeypatch, capsys, error, status, line):
    def fail(path):
        raise error

    monkeypatch.setattr(cli, "read_bundle", fail)
    assert cli.main(["plan", "b"]) == status
    said = capsys.readouterr().err
    assert said.startswith(f"deploy: {line}")
    assert said.count("\n") == 1


def test_a_check_runs_with_the_seed_of_the_bundle_s_run(tmp_path):
    spec = make_image_network()
    spec = replace(spec, provenance=spec.provenance.with_entries(seed=3))
    bundle = bundle_at(tmp_path / "bundle", spec)
    for options, seed in (([], 3), (["--seed", "5"], 5)):
        assert cli.main(["check", str(bundle.path), "--target", "fast", *options]) == 0
        assert json.loads((bundle.path / "checks" / "fast.json").read_text())["seed"] == seed


def plan(bundle, out, **more):
    run = subprocess.run(
        [sys.executable, "-m", "deploy", "plan", str(bundle.path)],
        stdout=out, stderr=subprocess.PIPE, env=environment(**more), text=True, timeout=300,
    )  # fmt: skip
    return run.returncode, run.stderr
