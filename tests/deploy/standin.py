"""NengoLoihi with the NxSDK stand-in, inside the process of a test.

NengoLoihi looks for NxSDK once, when it is imported.  Tests that only need a board for a moment
put the stand-in's names where NengoLoihi would have put NxSDK's; that it also works when the
stand-in is found at import is tested through the command line, in a process of its own.
"""

import importlib.util
import sys
from pathlib import Path

STANDIN = Path(__file__).parent.parent / "nxsdk_standin"

PLACES = {
    "nengo_loihi.hardware": ["HAS_NXSDK"],
    "nengo_loihi.simulator": ["HAS_NXSDK"],
    "nengo_loihi.hardware.builder": ["NxsdkBoard", "SpikeGen", "TraceConfigGenerator", "micro_gen"],
    "nengo_loihi.hardware.interface": ["SnipPhase", "SpikeProbe", "assert_nxsdk", "nxsdk"],
}


def install(monkeypatch):
    """Make NengoLoihi believe that NxSDK is there until ``monkeypatch`` is undone.

    Returns
    -------
    module
        The stand-in's package ``nxsdk``; its faults are ``nxsdk.faults.FAULTS``.
    """
    import nengo_loihi.hardware.nxsdk_shim as original

    monkeypatch.syspath_prepend(str(STANDIN))
    for name in [name for name in sys.modules if name.split(".")[0] == "nxsdk"]:
        monkeypatch.delitem(sys.modules, name)
    spec = importlib.util.spec_from_file_location("shim_with_standin", original.__file__)
    shim = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(shim)
    for module, names in PLACES.items():
        for name in names:
            monkeypatch.setattr(f"{module}.{name}", getattr(shim, name))
    return shim.nxsdk


def uninstall():
    """Forget the stand-in's modules; the names in NengoLoihi are restored by ``monkeypatch``."""
    for name in [name for name in sys.modules if name.split(".")[0] == "nxsdk"]:
        del sys.modules[name]
