"""NengoLoihi: its import without packages that it does not need here, and its builder's errors.

NengoLoihi imports TensorFlow and NengoDL if they are installed, only to register its neuron types
with NengoDL; nengo-extras imports Keras, Numba and parts of SciPy, only to test for them.  Neither
is needed here, and they take about ten seconds and one second at every start.

NengoLoihi gives each block one scale, with which its largest weight becomes 255.  It asserts,
mostly without a message, that threshold and bias fit with this scale; :func:`make_build_error`
gives the reason.
"""

import sys
import warnings

import nengo

from ..errors import UserError
from .chip import LOIHI

# None in sys.modules makes an import of that name raise ImportError.
_PROBED = ("tensorflow", "nengo_dl", "keras", "numba", "scipy.cluster")
_hidden = [name for name in _PROBED if name not in sys.modules]
sys.modules.update(dict.fromkeys(_hidden))  # type: ignore[arg-type]
try:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "This version of `nengo_loihi` has not been tested")
        import nengo_loihi
finally:
    for _name in _hidden:
        del sys.modules[_name]

import fastloihi  # noqa: E402, F401 - its import lets NengoLoihi run on NumPy 2

# The networks here have no decoders to cache, and parallel processes would wait for its lock.
nengo.rc["decoder_cache"]["enabled"] = "False"

# Nengo computes intercepts and maximum rates from gain and bias, which are not used here.
warnings.filterwarnings("ignore", "Non-finite values detected", module="nengo")
warnings.filterwarnings("ignore", "(invalid value|divide by zero) .* log1p", module="nengo")

# NengoLoihi's emulator fills integer arrays with NaN before it writes to them.
warnings.filterwarnings("ignore", "invalid value encountered in cast", module="numpy")

# Errors that NengoLoihi raises for a network that it cannot build: some of its limits are
# assertions, and one of their messages is itself mistaken (an AttributeError).
BUILD_ERRORS = (nengo.exceptions.NengoException, AssertionError, AttributeError, OverflowError)

INTEGER_FORMATS = (
    "weights of 8 bits, a threshold of 17 bits times 64, a bias of 12 bits times up to 128"
)


def require_integers(network: nengo.Network):
    """Refuse a network that the chip cannot run before any target, even a simulator, runs it.

    Raises
    ------
    UserError
        From :func:`make_build_error`: the same for every target.
    """
    try:
        nengo_loihi.builder.Model(dt=LOIHI.dt).build(network, precompute=True, discretize=True)
    except BUILD_ERRORS as error:
        raise make_build_error(network, error) from error


def make_build_error(network: nengo.Network, error: Exception) -> UserError:
    """The error of every target for a network that NengoLoihi cannot build.

    Parameters
    ----------
    network : nengo.Network
    error : Exception
        Error that NengoLoihi raised, one of `BUILD_ERRORS`.

    Returns
    -------
    UserError
        It names the layer and the limit if the chip's integers are the reason.
    """
    problem = _find_unfit_value(network) or str(error)
    if not problem or isinstance(error, AttributeError):
        problem = f"{problem or 'one of its internal limits is not met'}; the command "
        problem += "'plan' says what does not fit a core"
    return UserError(f"NengoLoihi cannot build this network: {problem}")


def _find_unfit_value(network):
    """The value that does not fit the integers, or None if that is not the reason."""
    model = nengo_loihi.builder.Model(dt=LOIHI.dt)
    model.validation_level = nengo_loihi.builder.builder.ValidationLevel.NONE
    try:
        model.build(network, precompute=None, discretize=False)
    except BUILD_ERRORS:
        return None
    labels = {
        block: ensemble.label
        for ensemble in network.all_ensembles
        if ensemble in model.params and ensemble.neurons in model.objs
        for block in model.objs[ensemble.neurons]["in"]
    }
    for block in model.blocks:
        compartment = block.compartment
        weight = max((float(synapse.max_abs_weight()) for synapse in block.synapses), default=0.0)
        threshold = float(compartment.vth.min())
        bias = float(abs(compartment.bias).max())
        try:
            nengo_loihi.builder.discretize.discretize_block(block)
        except BUILD_ERRORS:
            return (
                f"layer {labels.get(block, block.label)}: no scale puts its numbers into the "
                f"chip's integers ({INTEGER_FORMATS}): its largest weight, times the size of the "
                f"spikes that arrive, is {weight:.3g}, its threshold {threshold:.3g}, its largest "
                f"bias {bias:.3g}; bring them closer together"
            )
    return None
