"""NengoLoihi, imported without TensorFlow.

NengoLoihi imports TensorFlow and NengoDL wherever they are installed, only to teach NengoDL its
neuron types.  Nothing here needs that, and it costs some ten seconds at every start.
"""

import sys
import warnings

import nengo

# None in sys.modules makes an import of that name raise ImportError.
_hidden = [name for name in ("tensorflow", "nengo_dl") if name not in sys.modules]
sys.modules.update(dict.fromkeys(_hidden))
try:
    import nengo_loihi
finally:
    for _name in _hidden:
        del sys.modules[_name]

# The networks here have no decoders to keep, and processes side by side would fight for its lock.
nengo.rc["decoder_cache"]["enabled"] = "False"

# From gain and bias Nengo works out intercepts and maximum rates that nothing here asks for.
warnings.filterwarnings("ignore", "Non-finite values detected", module="nengo")
warnings.filterwarnings("ignore", "invalid value encountered in log1p", module="nengo")

__all__ = ["nengo_loihi"]
