"""NengoLoihi's own tests, which its package ships, on NengoLoihi's emulator or on ours.

A plugin of pytest: ``pytest -p tests.peers.loihi --emulator fast --pyargs nengo_loihi``.  The
package lacks the ``conftest.py`` that its tests were written with; what they need of that is here.
"""

import sys
import types

import nengo
import pytest

from deploy.network.loihi_import import nengo_loihi  # the substitutions come first

import nengo_loihi.builder.builder  # isort: skip
import nengo_loihi.emulator  # isort: skip
import nengo_loihi.simulator  # isort: skip

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
    emulator = nengo_loihi.emulator.EmulatorInterface
    emulator.strict = True  # overflows are errors
    nengo_loihi.set_defaults()
    full = nengo_loihi.builder.builder.ValidationLevel.FULL
    nengo_loihi.builder.builder.Model.default_validation_level = full
    chosen = {"fast": _fast, "both": _both}.get(config.getoption("--emulator"))
    if chosen is not None:
        nengo_loihi.emulator.EmulatorInterface = chosen(config)
        nengo_loihi.simulator.EmulatorInterface = nengo_loihi.emulator.EmulatorInterface


def _put_back_convolutions():
    """Nengo 4 has its convolutions elsewhere than Nengo 3, where these tests look for them."""
    package = types.ModuleType("nengo._vendor.npconv2d")
    package.conv2d = types.ModuleType(package.__name__ + ".conv2d")
    for name in ("conv2d", "conv2d_gradx"):
        setattr(package.conv2d, name, getattr(nengo.builder.transforms, name))
    sys.modules[package.__name__] = nengo._vendor.npconv2d = package
    sys.modules[package.conv2d.__name__] = package.conv2d


def _fast(config):
    from deploy.fastloihi import FastEmulator

    return FastEmulator


def _both(config):
    from tests.deploy.fastloihi.comparison import Both

    Both.each_step = config.getoption("--each-step")
    return Both


def pytest_collection_modifyitems(items):
    for item in items:
        if "target_loihi" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="runs on a board only"))


@pytest.fixture(scope="session")
def Simulator(request):
    from nengo_loihi.tests import make_test_sim

    return make_test_sim(request)


def pytest_terminal_summary(terminalreporter, config):
    if config.getoption("--emulator") == "both":
        from tests.deploy.fastloihi.comparison import Both

        terminalreporter.write_line(f"compared: {dict(Both.tally)}")
