"""Networks trained in PyTorch, exported by their packages' own exporters, converted here.

They are trained in an environment of their own (``make setup-nir``), which takes minutes, so that
only ``make test-nir`` runs this.
"""

import os
import subprocess

import numpy as np
import pytest

from deploy.check.bundle import read_bundle
from deploy.targets.registry import run_target
from tests.command import ROOT
from tests.nir_networks import compare, frames

PYTHON = ROOT / ".venv-nir" / "bin" / "python"
EPOCHS = 3

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(3 * 3600),  # longer than all of its commands may take
    pytest.mark.skipif(
        not PYTHON.exists() or not os.environ.get("TEST_NIR"),
        reason="trains for minutes in .venv-nir; 'make test-nir'",
    ),
]


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    file = tmp_path_factory.mktemp("frames") / "frames.npz"
    frames.main(file, 20)
    return file


@pytest.mark.parametrize(
    ("package", "options"), [("snntorch", []), ("norse", ["--set", "nir.method=euler"])]
)
def test_a_trained_network_answers_as_in_pytorch(package, options, shown, tmp_path):
    graph, answers, run = (tmp_path / name for name in ("net.nir", "answers.npz", "run"))
    train = ROOT / "tests" / "nir_networks" / "train.py"
    arguments = [PYTHON, train, package, shown, graph, answers, 0, EPOCHS]
    subprocess.run(list(map(str, arguments)), check=True, timeout=3600)
    compare.convert(graph, run, "--step", "20", *options)
    result = compare.figures(graph, answers, run)
    assert result["pytorch"] > 0.6
    assert result["graph"] > 0.99  # 32 bits there, 64 here: a spike may fall on another step
    assert result["fast"] > result["pytorch"] - 0.02
    # After three epochs many samples have equal or nearly equal outputs.
    assert result["agreement"] > 0.9
    bundle = read_bundle(run / "bundle")
    some = bundle.checks.inputs[:4]
    hashes = (run_target(bundle.spec, some, target).spike_hashes for target in ("fast", "emulator"))
    np.testing.assert_array_equal(*hashes)
