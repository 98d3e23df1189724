"""NengoLoihi, imported without TensorFlow and what else it only looks for.

NengoLoihi imports TensorFlow and NengoDL wherever they are installed, only to teach NengoDL its
neuron types, and nengo-extras imports Keras, Numba and parts of SciPy, only to know whether they
are there.  Nothing here needs that, and it costs some ten seconds and one at every start.
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
    """NumPy, with ``array(copy=False)`` as NumPy 1 has it: copy only what must be copied.

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

# The networks here have no decoders to keep, and processes side by side would fight for its lock.
nengo.rc["decoder_cache"]["enabled"] = "False"

# From gain and bias Nengo works out intercepts and maximum rates that nothing here asks for.
warnings.filterwarnings("ignore", "Non-finite values detected", module="nengo")
warnings.filterwarnings("ignore", "(invalid value|divide by zero) .* log1p", module="nengo")

# NengoLoihi's emulator fills integer arrays with NaN before it writes to them.
warnings.filterwarnings("ignore", "invalid value encountered in cast", module="numpy")

__all__ = ["nengo_loihi"]
