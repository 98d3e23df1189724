"""What all tests share: a cache of their own, the data of development, one small run."""

import fcntl
import gc
import os
import shutil
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:
    # Every core has a worker already; what the worker starts inherits this.
    for library in ("OMP_NUM", "OPENBLAS_NUM", "TF_NUM_INTEROP"):
        os.environ.setdefault(f"{library}_THREADS", "1")
# Otherwise each process that a test starts would compile all modules of this repository again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# A training takes less time with oneDNN, but to look into each new graph for what oneDNN could do
# takes TensorFlow a fifth of the time of the tests that make one.
os.environ["TF_ENABLE_ONEDNN_OPTS"] = "0"

# Without a terminal nothing is drawn or coloured, whatever the shell or a CI system has set.
os.environ.pop("FORCE_COLOR", None)
os.environ.pop("NO_COLOR", None)
os.environ.pop("COLUMNS", None)
os.environ.pop("TTY_COMPATIBLE", None)

import pytest
from hypothesis import settings

from tests.command import call, hurry_emulator

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT.parent / "shared" / "data"
# Options of the small run: trained badly, but through every stage.
TINY = (
    *("--set", "data.samples_per_digit=60", "--set", "cnn.epochs=3", "--set", "snn.epochs=2"),
    *("--samples", "20", "--steps", "40"),
)


def pytest_collection_modifyitems(items):
    """Begin with the slow tests, so that no core waits for the longest ones at the end."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


# Artifacts that a command may report as current before it refuses something else.
NOTHING_TO_DO = ("counts", "cnn", "rate-lif", "events", "bundle")

# TensorFlow's graphs are a million objects: looking through them for garbage every few hundred new
# ones takes an eighth of the time of the tests that make them.
gc.set_threshold(50_000, 20, 50)
gc.disable()  # until all is imported


def pytest_collection_finish():
    """Exclude all imported objects from the search for garbage."""
    gc.freeze()
    gc.enable()


def pytest_sessionfinish():
    """Exclude all remaining objects, since pytest and Python search for garbage as they end."""
    gc.freeze()


# Properties are tried on the same examples in every run, so that a change is blamed for what it
# breaks and chance never is; `pytest --hypothesis-profile=search` draws new ones.
settings.register_profile("stmnist", deadline=None, derandomize=True)
settings.register_profile("search", deadline=None, derandomize=False)
settings.load_profile("stmnist")


def pytest_make_parametrize_id(val, argname):
    """Name bytes after their parameter.

    All processes that run a part of the tests must give a test the same name, but the bytes of a
    file contain the time of day.
    """
    return argname if isinstance(val, bytes) else None


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory):
    """A folder that all processes of this run of the tests have in common."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session", autouse=True)
def own_cache(shared_folder):
    """Neither read nor fill the user's cache; what one process has simulated, no other does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STMNIST_CACHE", str(shared_folder / "cache"))
        yield


@pytest.fixture(scope="session")
def shared_data():
    """Folder with the data of development, which is no part of the repository."""
    if not DATA.is_dir():
        pytest.skip("the development data (shared/data next to the repository) is not here")
    return DATA


@pytest.fixture(scope="session")
def real_recording(shared_data):
    """A recording of the published data set."""
    return shared_data / "sample_stmnist.mat"


@pytest.fixture(scope="session")
def made_once(tmp_path_factory, shared_folder):
    """``made_once(name, make)``: a folder that ``make(folder)`` fills, once for all processes.

    Each process has a copy of its own.
    """

    def copy_of(name, make):
        made, is_complete = shared_folder / name, shared_folder / f"{name}.complete"
        with open(shared_folder / f"{name}.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not is_complete.exists():
                shutil.rmtree(made, ignore_errors=True)
                made.mkdir()
                make(made)
                is_complete.touch()
        return shutil.copytree(made, tmp_path_factory.mktemp("copy") / name)

    return copy_of


@pytest.fixture(scope="session")
def tiny_run(made_once):
    """A finished run; tests copy it before they change it."""

    def make(folder):
        with hurry_emulator():
            made = call("ladder", folder / "run", *TINY)
        assert made == 0, "the small run of the main job failed"

    return made_once("tiny", make) / "run"


@pytest.fixture
def run(tiny_run, tmp_path):
    """A copy of the small run, to be changed or broken."""
    return shutil.copytree(tiny_run, tmp_path / "run")


@pytest.fixture
def refused(capsys):
    """Call a command that must be refused; its one line is returned."""

    def refuse(*arguments):
        capsys.readouterr()
        assert call(*arguments) == 2
        out, err = capsys.readouterr()
        *states, line = err.splitlines()
        # What is chosen for the recordings is said by each command.
        states = [state for state in states if not state.startswith("image of ")]
        assert all(state.partition(": ")[0] in NOTHING_TO_DO for state in states), err
        assert line.startswith("stmnist: ")
        assert len(line) < 3000
        assert "Traceback" not in out + err
        return line

    return refuse
