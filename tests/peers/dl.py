"""NengoDL's own tests, which its package ships, through this project's import of NengoDL.

A plugin of pytest.  The package lacks the ``conftest.py`` that its tests were written with; what
they need of that is here.
"""

import os

os.environ.setdefault("TF_USE_LEGACY_KERAS", "1")

import numpy as np
import pytest

from models.keras2 import tf
from pipeline.training import nengodl  # noqa: F401  (the substitutions of NengoDL's world)

if not hasattr(np, "in1d"):  # which NumPy 2.4 removed and some tests call
    setattr(np, "in1d", np.isin)  # noqa: B010

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
    for item in items:
        if {"performance", "gpu"} & set(item.keywords):
            item.add_marker(pytest.mark.skip(reason="needs a certain machine"))


@pytest.fixture(scope="session")
def Simulator(request):
    from nengo_dl.tests import make_test_sim

    return make_test_sim(request)


@pytest.fixture(autouse=True)
def clear_session():
    tf.keras.backend.clear_session()
