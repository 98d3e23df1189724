"""NengoLoihi's own tests, which its package ships, on NengoLoihi's emulator or on ours.

A plugin of pytest: ``python -m tests.peers loihi --emulator fast``.  The
package lacks the ``conftest.py`` that its tests were written with; what they need of that is here.
"""

import contextlib
import sys
import types
from pathlib import Path

import nengo
import numpy as np
import pytest

from deploy.network.loihi_import import nengo_loihi  # the substitutions come first
from tests.peers import old

import nengo_loihi.builder.builder  # isort: skip
import nengo_loihi.emulator  # isort: skip
import nengo_loihi.simulator  # isort: skip

FILT = "Lowpass.filt of Nengo 4.1 on data of one dimension, which NumPy 2.4 refuses"
IMAGE = "bounds that were chosen for an image of MNIST, which the package does not ship"
# Tests that fail here on NengoLoihi's own emulator too.
KNOWN = {
    "test_conv::test_conv2d_weights[valid-True]": IMAGE,
    "test_conv::test_conv2d_weights[valid-False]": IMAGE,
    "test_conv::test_conv2d_weights[same-True]": IMAGE,
    "test_conv::test_conv2d_weights[same-False]": IMAGE,
    "test_connection::test_neurons_to_ensemble_transform[True-True]": FILT,
    "test_connection::test_neurons_to_ensemble_transform[True-False]": FILT,
    "test_connection::test_neurons_to_ensemble_transform[False-True]": FILT,
}

EMULATORS = ("nengo-loihi", "fast", "both")


def pytest_addoption(parser):
    parser.addoption("--emulator", choices=EMULATORS, default="nengo-loihi")
    parser.addoption("--each-step", action="store_true", help="compare both after every step")
    parser.addoption("--target", default="sim")  # which NengoLoihi's `make_test_sim` asks for


def pytest_configure(config):
    import matplotlib

    matplotlib.use("Agg")
    for marker in ("target_sim", "target_loihi", "hang", "requires_multichip_snips"):
        config.addinivalue_line("markers", marker)
    config.addinivalue_line("markers", "slow")
    _put_back_convolutions()
    pytest.warns = old.warns
    emulator = nengo_loihi.emulator.EmulatorInterface
    emulator.strict = True  # overflows are errors
    nengo_loihi.set_defaults()
    full = nengo_loihi.builder.builder.ValidationLevel.FULL
    nengo_loihi.builder.builder.Model.default_validation_level = full
    chosen = {"fast": _fast, "both": _both}.get(config.getoption("--emulator"))
    if chosen is not None:
        nengo_loihi.emulator.EmulatorInterface = chosen(config)
        nengo_loihi.simulator.EmulatorInterface = nengo_loihi.emulator.EmulatorInterface


sys.path.append(str(Path(__file__).resolve().parents[2] / "fastloihi" / "tests"))  # comparison


def _put_back_convolutions():
    """Nengo 4 has its convolutions elsewhere than Nengo 3, where these tests look for them."""
    package = types.ModuleType("nengo._vendor.npconv2d")
    package.conv2d = types.ModuleType(package.__name__ + ".conv2d")
    for name in ("conv2d", "conv2d_gradx"):
        setattr(package.conv2d, name, getattr(nengo.builder.transforms, name))
    sys.modules[package.__name__] = nengo._vendor.npconv2d = package
    sys.modules[package.conv2d.__name__] = package.conv2d


def _fast(config):
    from fastloihi import FastEmulator

    return FastEmulator


def _both(config):
    from comparison import Both

    Both.each_step = config.getoption("--each-step")
    return Both


def pytest_collection_modifyitems(items):
    old.expect_failures(items, KNOWN)
    for item in items:
        if "target_loihi" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="runs on a board only"))
        if item.path.stem == "test_conv" and hasattr(item, "module"):
            item.module.pickle = types.SimpleNamespace(load=_drawn_images)
            item.module.open = lambda *arguments: contextlib.nullcontext()


def _drawn_images(file):
    """The package lacks the file with ten images of MNIST that its tests read: a 7 stands in."""
    row, column = np.mgrid[:28, :28]
    bar = np.maximum(np.abs(row - 8), np.abs(column - 13) - 7)
    slant = np.maximum(np.abs(column - 20 + 0.55 * (row - 8)), np.abs(row - 16) - 9)
    seven = np.clip(2.2 - np.minimum(bar, slant), 0, 1)
    return np.tile(seven.ravel(), (10, 1)), np.full(10, 7)


@pytest.fixture(scope="session")
def Simulator(request):
    from nengo_loihi.tests import make_test_sim

    return make_test_sim(request)


def pytest_sessionfinish(session):
    if session.config.getoption("--emulator") == "both" and hasattr(session.config, "workeroutput"):
        from comparison import Both

        session.config.workeroutput["compared"] = dict(Both.tally)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    """What a process of pytest-xdist has compared."""
    if "compared" in getattr(node, "workeroutput", {}):
        from comparison import Both

        Both.tally.update(node.workeroutput["compared"])


def pytest_terminal_summary(terminalreporter, config):
    if config.getoption("--emulator") == "both":
        from comparison import Both

        terminalreporter.write_line(f"compared: {dict(Both.tally)}")
