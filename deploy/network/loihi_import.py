"""Import NengoLoihi without TensorFlow and other packages that it does not need here.

NengoLoihi imports TensorFlow and NengoDL if they are installed, only to register its neuron types
with NengoDL; nengo-extras imports Keras, Numba and parts of SciPy, only to test for them.  Neither
is needed here, and they take about ten seconds and one second at every start.
"""

import sys
import warnings

import nengo
import numpy

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


class NumPy1:
    """NumPy with ``array(copy=False)`` as in NumPy 1: copy only if necessary.

    NumPy 2 refuses where a copy is needed.  NengoLoihi 1.1 needs one where it discretises a block's
    weights and where it works out rates.  NumPy 2.3 has no binary ``fromstring`` any more, with
    which NengoLoihi reads a DVS camera's files.
    """

    def __getattr__(self, name):
        return getattr(numpy, name)

    @staticmethod
    def array(*values, copy=True, **options):
        return numpy.array(*values, copy=copy or None, **options)

    @staticmethod
    def fromstring(data, dtype):
        return numpy.frombuffer(data, dtype).copy()


if int(numpy.__version__.split(".")[0]) >= 2:  # NumPy 1, of older hosts, refuses copy=None
    nengo_loihi.block.np = nengo_loihi.neurons.np = nengo_loihi.dvs.np = NumPy1()

# The networks here have no decoders to cache, and parallel processes would wait for its lock.
nengo.rc["decoder_cache"]["enabled"] = "False"

# Nengo computes intercepts and maximum rates from gain and bias, which are not used here.
warnings.filterwarnings("ignore", "Non-finite values detected", module="nengo")
warnings.filterwarnings("ignore", "(invalid value|divide by zero) .* log1p", module="nengo")

# NengoLoihi's emulator fills integer arrays with NaN before it writes to them.
warnings.filterwarnings("ignore", "invalid value encountered in cast", module="numpy")

__all__ = ["nengo_loihi"]
