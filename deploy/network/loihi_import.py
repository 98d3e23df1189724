"""Import NengoLoihi without TensorFlow and other packages that it does not need here.

NengoLoihi imports TensorFlow and NengoDL if they are installed, only to register its neuron types
with NengoDL; nengo-extras imports Keras, Numba and parts of SciPy, only to test for them.  Neither
is needed here, and they take about ten seconds and one second at every start.
"""

import sys
import warnings

import nengo

# None in sys.modules makes an import of that name raise ImportError.
_PROBED = ("tensorflow", "nengo_dl", "keras", "numba", "scipy.cluster")
_hidden = [name for name in _PROBED if name not in sys.modules]
sys.modules.update(dict.fromkeys(_hidden))
try:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "This version of `nengo_loihi` has not been tested")
        import nengo_loihi
finally:
    for _name in _hidden:
        del sys.modules[_name]

import fastloihi  # noqa: E402, F401  (its import lets NengoLoihi run on NumPy 2)

# The networks here have no decoders to cache, and parallel processes would wait for its lock.
nengo.rc["decoder_cache"]["enabled"] = "False"

# Nengo computes intercepts and maximum rates from gain and bias, which are not used here.
warnings.filterwarnings("ignore", "Non-finite values detected", module="nengo")
warnings.filterwarnings("ignore", "(invalid value|divide by zero) .* log1p", module="nengo")

# NengoLoihi's emulator fills integer arrays with NaN before it writes to them.
warnings.filterwarnings("ignore", "invalid value encountered in cast", module="numpy")

__all__ = ["nengo_loihi"]
