"""Layers of neurons in Loihi's integers.

The equations of the chip's step are in :mod:`deploy.network.reference`.  Networks on events are
trained in integers; other networks are rounded to them by :mod:`models.rounding`.
"""

from dataclasses import dataclass, replace

import numpy as np

from deploy.network.chip import LOIHI, Chip
from deploy.network.layer import Neurons
from models.architecture import Architecture
from models.chain import Link, make_links


@dataclass(frozen=True)
class Integers:
    """The integers of a layer on the chip.

    Attributes
    ----------
    kernel : ndarray of int32
        The weights of the layer, in the shape of :attr:`models.chain.Link.kernel`.
    bias : ndarray of int32
        The bias of the layer, in the shape of :attr:`models.chain.Link.bias`.
    threshold, floor : int
    keep_u_4096ths, keep_v_4096ths : int
        Remaining share of current and voltage after a step, in the chip's ``decay_unit``.
    exponent : int
        0 or less: a weight of 1 adds the chip's ``weight_unit`` times 2 to this power.
    recurrent_kernel : ndarray of int32, shape (units, units), or None
        Weights of the layer's own spikes of the step before, by sending and receiving unit.
    """

    kernel: np.ndarray
    bias: np.ndarray
    threshold: int
    floor: int
    keep_u_4096ths: int
    keep_v_4096ths: int
    exponent: int = 0
    recurrent_kernel: np.ndarray | None = None


def derive_parameters(link: Link, layer: Integers, height: float = 1.0, chip: Chip = LOIHI) -> Link:
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
        Its largest weight is 127 or -127, unless all are 0; if its weights are sums of several
        synapses, :func:`deploy.network.synapses.count_weight_levels`.  The same must hold in each
        block of a layer that is divided by its outputs; otherwise NengoLoihi rounds this block's
        weights and threshold again (:func:`deploy.network.blocks.find_rescaled_layers`).
    height : float
        Area of an input spike in units of the chip's time step.
    chip : Chip

    Returns
    -------
    Link
        Its neurons' spikes have the area of one step.
    """
    decay_u = chip.decay_levels - layer.keep_u_4096ths
    decay_v = chip.decay_unit - layer.keep_v_4096ths
    sum_u = _sum_of_decays(layer.keep_u_4096ths / chip.decay_unit)
    sum_v = _sum_of_decays(layer.keep_v_4096ths / chip.decay_unit)
    share_u = (decay_u + 1) / chip.decay_levels
    share_v = decay_v / chip.decay_levels
    real_per_integer = (
        255 / chip.weight_levels * chip.threshold_unit * sum_u * sum_v / layer.threshold
    )
    real_per_integer *= 2.0**layer.exponent
    tau_rc = float(-chip.dt / np.log1p(-share_v))
    recurrent_kernel = layer.recurrent_kernel
    if recurrent_kernel is not None:
        recurrent_kernel = recurrent_kernel * real_per_integer
    return replace(
        link,
        kernel=layer.kernel * real_per_integer * (link.pool**2 / height),
        recurrent_kernel=recurrent_kernel,
        bias=layer.bias * (sum_v / layer.threshold),
        neurons=Neurons(chip.dt, tau_rc, 0.0, layer.floor / layer.threshold),
        synapse=None if share_u == 1 else float(-chip.dt / np.log1p(-share_u)),
    )


def _sum_of_decays(kept_share):
    """NengoLoihi's estimate of the sum of a current of 2^21 while it decays to 0, divided by 2^21.

    x(k+1) = floor(r x(k)), where rounding down subtracts 0.494 per step on average.
    """
    start = 2.0**21
    lost_per_step = 0.494
    r = kept_share
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
    output = replace(output, kernel=weights["output.kernel"].astype(float), section_starts=arrive)
    return (*(derive_parameters(link, integers[link.name]) for link in hidden), output)
