"""NengoDL's own tests, which its package ships, through this project's import of NengoDL.

A plugin of pytest.  The package lacks the ``conftest.py`` that its tests were written with; what
they need of that is here.
"""

import logging
import os
import random
import subprocess
import types

os.environ.setdefault("TF_USE_LEGACY_KERAS", "1")

import nengo
import pytest

from models.keras.keras2 import tf
from pipeline.training import nengodl  # noqa: F401  (the substitutions of NengoDL's world)
from tests.peers import old

pytest.warns = old.warns
nengo.networks.Oscillator = old.oscillator
logging.getLogger("nengo_dl").setLevel(logging.NOTSET)  # some tests read its messages

SETUP = "looks for setup.py, which the package does not ship"
# Tests that fail on current versions.
KNOWN = {
    "test_setup::test_setup_compat[feature_version0]": SETUP,
    "test_setup::test_setup_compat[feature_version1]": SETUP,
    "test_version::test_nengo_version_check": "NengoDL 3.6 knows no Nengo after 3.2",
}

OPTIONS = {"--dtype": "float32", "--unroll-simulation": 1, "--device": None}


def pytest_addoption(parser):
    for name, default in OPTIONS.items():
        parser.addoption(name, default=default)
    for name in ("--inference-only", "--simulator-only", "--performance"):
        parser.addoption(name, action="store_true", default=False)


def pytest_configure(config):
    for marker in ("training", "performance", "gpu", "slow"):
        config.addinivalue_line("markers", marker)


def pytest_collection_modifyitems(items):
    old.expect_failures(items, KNOWN)
    for item in items:
        if item.path.stem == "test_tensor_graph":
            item.module.subprocess = types.SimpleNamespace(run=_run, PIPE=subprocess.PIPE)
        if {"performance", "gpu"} & set(item.keywords):
            item.add_marker(pytest.mark.skip(reason="needs a certain machine"))


def _run(command, **options):
    """Start a script in a Python of its own that has this project's import of NengoDL."""
    code = "import runpy, sys, pipeline.training.nengodl; runpy.run_path(sys.argv[1])"
    return subprocess.run([command[0], "-c", code, *command[1:]], **options)


@pytest.fixture(scope="session")
def Simulator(request):
    from nengo_dl.tests import make_test_sim

    return make_test_sim(request)


@pytest.fixture(autouse=True)
def clear_session():
    tf.keras.backend.clear_session()


@pytest.fixture(autouse=True)
def same_weights_each_time():
    """Keras draws weights with seeds from `random`, whatever seed a test gives to TensorFlow.

    Some tests compare two trained networks to within 1e-8, which float32 holds for most weights
    only: ``test_sequential`` failed in one of two runs.
    """
    random.seed(0)
