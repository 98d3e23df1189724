"""``stmnist deploy``: plan, export and energy from the command line."""

import json

import numpy as np
import pytest

from deploy.check.run import run_check
from deploy.conformance.networks import make_image_network
from tests.command import call, missing
from tests.deploy.networks import bundle_at
from tests.deploy.preflight.test_plan import spec_of


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return bundle_at(tmp_path_factory.mktemp("run") / "bundle", make_image_network(), 7)


def run(capsys, *arguments):
    return call(*arguments), *capsys.readouterr()


def test_plan(bundle, capsys):
    status, out, _ = run(capsys, "deploy", "plan", bundle.path)
    assert status == 0
    assert "conv2" in out


def test_plan_refuses_what_will_not_fit(capsys, tmp_path):
    big = bundle_at(tmp_path / "bundle", spec_of((24, 3), block_shape=(8, 8, 24)), 2)
    status, out, err = run(capsys, "deploy", "plan", big.path)
    assert status == 2
    assert missing(err, "conv1", "1536 compartments", 1024) == []
    assert len(err.strip().splitlines()) == 1
    assert "1536 compartments" in out


def test_export_with_inputs(bundle, capsys, tmp_path):
    nir = pytest.importorskip("nir")
    status, out, _ = run(
        capsys, "deploy", "export", bundle.path, "--format", "nir",
        "--out", tmp_path / "network.nir", "--inputs", tmp_path / "in.npz",
    )  # fmt: skip
    assert status == 0
    assert "7 samples" in out
    assert "conv1_neurons" in nir.read(str(tmp_path / "network.nir")).nodes
    with np.load(tmp_path / "in.npz", allow_pickle=False) as arrays:
        assert arrays["spikes"].shape == (7, 35, 1, 6, 6)


def test_no_output_replaces_another_or_the_settings_of_a_run(bundle, capsys, tmp_path):
    (tmp_path / "experiment.toml").write_text("seed = 1")
    export = ["deploy", "export", bundle.path, "--format", "nir", "--out"]
    for command in (
        [*export, tmp_path / "a.nir", "--inputs", tmp_path / "a.nir"],
        [*export, tmp_path / "experiment.toml"],
        ["check", "run", bundle.path, "--target", "fast", "--out", tmp_path / "experiment.toml"],
    ):
        assert run(capsys, *command)[0] == 2
    assert [path.name for path in tmp_path.iterdir()] == ["experiment.toml"]
    assert (tmp_path / "experiment.toml").read_text() == "seed = 1"


def test_energy(bundle, capsys):
    checks = bundle.path / "checks"
    run_check(bundle, "fast", checks / "fast.json")
    status, out, _ = run(capsys, "deploy", "energy", bundle.path)
    assert status == 0
    assert out.startswith("ESTIMATE")
    _, out, _ = run(capsys, "deploy", "energy", bundle.path, checks / "fast.json", "--json")
    assert json.loads(out)["joules_per_inference"]["loihi"] > 0


def test_check_run_takes_board_options_for_a_board_only(bundle, capsys):
    status, _, err = run(
        capsys, "check", "run", bundle.path, "--target", "emulator", "--partition", "nahuku32"
    )
    assert status == 2
    assert missing(err, "--partition", "loihi", "emulator") == []
