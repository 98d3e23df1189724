"""Layers of neurons in Loihi's integers.

The equations of the chip's step are in :mod:`deploy.network.reference`.  Networks on events are
trained in integers; other networks are rounded to them by :mod:`models.rounding`.
"""

from dataclasses import dataclass, replace

import numpy as np

from deploy.network.chip import LOIHI
from deploy.network.layer import Neurons
from models.architecture import Architecture
from models.chain import Link, make_links

# Increase of q by a weight of 1: at exponent 0 NengoLoihi's weights are even, shifted by 6.
WEIGHT_UNIT = 128

THRESHOLD_UNIT = 64

# A unit below the chip's maximum: NengoLoihi may round that up, and then halves all values.
MAX_THRESHOLD = (2**17 - 2) * THRESHOLD_UNIT

DECAY_UNIT = LOIHI.decay_unit

BIAS_MANTISSA = 2**LOIHI.bias_bits - 1


@dataclass(frozen=True)
class Integers:
    """The integers of a layer on the chip.

    Attributes
    ----------
    weights : ndarray of int32
        Shape of the kernel: (rows, columns, channels in, filters) or (inputs, units).
    bias : ndarray of int32, shape (filters,) or (units,)
    threshold, floor : int
    keep_u, keep_v : int
        Remaining share of current and voltage after a step, in 4096ths.
    exponent : int
        0 or less: a weight of 1 adds ``WEIGHT_UNIT`` times 2 to this power.
    recurrent : ndarray of int32, shape (units, units), or None
        Weights of the layer's own spikes of the step before.
    """

    weights: np.ndarray
    bias: np.ndarray
    threshold: int
    floor: int
    keep_u: int
    keep_v: int
    exponent: int = 0
    recurrent: np.ndarray | None = None


def derive_parameters(link: Link, layer: Integers, height: float = 1.0) -> Link:
    """The link with parameters from which NengoLoihi derives these integers.

    NengoLoihi makes decays of 12 bits from the time constants.  It scales a block's weights so that
    the largest becomes 127.5, rounded to 127.  It multiplies threshold and bias such that their
    ratio to the weights is that with normalised filters, whose sum it estimates from the decays
    (``builder/discretize.py``: ``discretize_compartment``, ``decay_magnitude``).  This function
    inverts these steps.  NengoLoihi takes the largest exponent of the weights with which threshold
    and bias fit.

    Parameters
    ----------
    link : Link
    layer : Integers
        Its largest weight is 127 or -127, unless all are 0.  The same must hold in each block of a
        layer that is divided by its outputs; otherwise NengoLoihi rounds this block's weights and
        threshold again (:func:`deploy.network.blocks.find_rescaled_layers`).
    height : float
        Area of an input spike in units of the chip's time step.

    Returns
    -------
    Link
        Its neurons' spikes have the area of one step.
    """
    dt = LOIHI.dt
    decay_u = DECAY_UNIT - 1 - layer.keep_u
    decay_v = DECAY_UNIT - layer.keep_v
    sum_u = _sum_of_decays(layer.keep_u)
    sum_v = _sum_of_decays(layer.keep_v)
    share_u = (decay_u + 1) / (DECAY_UNIT - 1)
    share_v = decay_v / (DECAY_UNIT - 1)
    real_per_integer = 255 / LOIHI.weight_levels * THRESHOLD_UNIT * sum_u * sum_v / layer.threshold
    tau_rc = float(-dt / np.log1p(-share_v))
    real_per_integer *= 2.0**layer.exponent
    return replace(
        link,
        weights=layer.weights * real_per_integer * (link.pool**2 / height),
        recurrent=None if layer.recurrent is None else layer.recurrent * real_per_integer,
        bias=layer.bias * (sum_v / layer.threshold),
        neurons=Neurons(dt, tau_rc, 0.0, layer.floor / layer.threshold),
        synapse=None if share_u == 1 else float(-dt / np.log1p(-share_u)),
    )


def _sum_of_decays(keep):
    """NengoLoihi's estimate of the sum of a current of 2^21 while it decays to 0, divided by 2^21.

    x(k+1) = floor(r x(k)), where rounding down subtracts 0.494 per step on average.
    """
    start = 2.0**21
    lost_per_step = 0.494
    r = keep / DECAY_UNIT
    steps = -np.log1p(start * (1 - r) / lost_per_step) / np.log(r)
    geometric = (1 - r ** (steps + 1)) / (1 - r)
    return geometric - lost_per_step / ((1 - r) * start) * (steps + 1 - geometric)


def from_integers(
    architecture: Architecture, weights: dict, integers: dict, section_starts: tuple = (0,)
) -> tuple:
    """The chain of a network trained in the chip's integers, with a linear readout.

    Parameters
    ----------
    architecture : Architecture
    weights : dict
        With ``"output.kernel"``; the output has no bias.
    integers : dict of str to Integers
        The integers of each layer of neurons, by its name.
    section_starts : tuple of int
        First step of each section of a sample, which has readout weights of its own, in the trained
        network, where spikes reach the readout at once.

    Returns
    -------
    tuple of Link
    """
    *hidden, output = make_links(architecture)
    # On the chip, the relay and each layer of neurons take a step.
    arrive = (0, *(first + len(hidden) + 1 for first in section_starts[1:]))
    output = replace(output, weights=weights["output.kernel"].astype(float), section_starts=arrive)
    return (*(derive_parameters(link, integers[link.name]) for link in hidden), output)
