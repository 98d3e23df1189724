"""Compatibility patches for NengoDL and NengoLoihi: each of them, and what fails without it."""

import os
import subprocess
import sys

import pytest

from tests.command import LEAVE_GARBAGE, ROOT

IMPORT_BOTH = """
import subprocess, sys
from models.keras.keras2 import tf
import keras as keras3
print("Keras", tf.keras.Model.__module__)
def refuse(*arguments, **options):
    raise AssertionError("NengoDL starts a process")
subprocess.Popen = refuse
def kerases():
    return {name: module for name, module in sys.modules.items() if name.split(".")[0] == "keras"}
before = kerases()
import pipeline.training.nengodl
assert kerases() == before and sys.modules["keras"] is keras3
print("NengoDL", "nengo_dl" in sys.modules)
"""


def run(code, *arguments, environment=os.environ):
    """Run it in a process that knows nothing of this one's choice of Keras."""
    env = {name: value for name, value in environment.items() if not name.startswith("TF_")}
    return subprocess.run(
        [sys.executable, "-c", LEAVE_GARBAGE + code, *map(str, arguments)],
        cwd=ROOT, env=env, capture_output=True, text=True, timeout=300,
    )  # fmt: skip


@pytest.fixture(scope="module")
def both():
    """Keras and NengoDL as we import them, one after the other: seconds."""
    return run(IMPORT_BOTH)


def test_keras_is_the_second_whoever_asks(both):
    assert "Keras tf_keras." in both.stdout, both.stderr


def test_nengodl_is_imported_without_a_second_python_and_leaves_keras_3_as_it_was(both):
    assert both.returncode == 0, both.stderr
    assert "NengoDL True" in both.stdout


def test_nengoloihi_brings_in_nothing_that_it_only_looks_for():
    code = """
import sys
from deploy.network.loihi_import import nengo_loihi
print({"tensorflow", "nengo_dl", "keras", "numba", "scipy.stats"} & set(sys.modules))
import numba, scipy.cluster.hierarchy
print(numba.njit(lambda: 1)())
"""
    done = run(code)
    assert done.stdout.split() == ["set()", "1"], done.stderr


def test_keras_3_is_refused_and_nengodl_finds_no_keras_of_its_time():
    code = """
import tensorflow
tensorflow.keras.Model  # takes Keras 3
try:
    import models.keras.keras2
except ImportError as error:
    print(error)
import subprocess
subprocess.call = lambda command: 1  # NengoDL asks a second Python for a GPU, which takes seconds
import nengo_dl
"""
    done = run(code)
    assert "set TF_USE_LEGACY_KERAS=1 before" in done.stdout
    assert "No module named 'keras.engine'" in done.stderr
