"""What the tests of fastloihi share; none of them needs another package of this repository."""

import sys
import warnings

import pytest

# NengoLoihi imports these if they are installed, which takes ten seconds.
hidden = [name for name in ("tensorflow", "nengo_dl", "keras") if name not in sys.modules]
sys.modules.update(dict.fromkeys(hidden))
import nengo_loihi  # noqa: E402, F401

for name in hidden:
    del sys.modules[name]

from nengo_loihi.emulator.interface import EmulatorInterface  # noqa: E402

from fastloihi import NotAccelerated, emulator  # noqa: E402


@pytest.fixture(autouse=True)
def permissive(monkeypatch):
    """Overflows are warnings, and what is warned of once is warned of again in each test."""
    monkeypatch.setattr(EmulatorInterface, "strict", False)
    monkeypatch.setattr(emulator, "_warned", set())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", NotAccelerated)
        yield
