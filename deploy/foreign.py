"""NengoLoihi, imported without TensorFlow.

NengoLoihi imports TensorFlow and NengoDL wherever they are installed, only to teach NengoDL its
neuron types.  Nothing here needs that, and it costs some ten seconds at every start.
"""

import sys

_absent = "tensorflow" not in sys.modules
if _absent:
    sys.modules["tensorflow"] = None  # makes "import tensorflow" raise ImportError
try:
    import nengo_loihi
finally:
    if _absent:
        del sys.modules["tensorflow"]

__all__ = ["nengo_loihi"]
