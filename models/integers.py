"""A layer in Loihi's integers, and parameters from which NengoLoihi derives exactly these integers.

The equations of the chip's step are in :mod:`models.spiking`; the rounding is that of NengoLoihi
1.1, ``builder/discretize.py``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deploy.network.chip import LOIHI

WEIGHT_LEVELS = LOIHI.weight_levels
"""Largest magnitude of an 8-bit weight that may have either sign."""

WEIGHT_UNIT = 128
"""Increase of q by a weight of 1: at exponent 0 NengoLoihi's weights are even, shifted by 6."""

THRESHOLD_UNIT = 64
MAX_THRESHOLD = (2**17 - 2) * THRESHOLD_UNIT
"""A unit below the chip's maximum: NengoLoihi may round that up, and then halves all values."""

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
    """

    weights: np.ndarray
    bias: np.ndarray
    threshold: int
    floor: int
    keep_u: int
    keep_v: int
    exponent: int = 0


@dataclass(frozen=True)
class OnLoihi:
    """Parameters of a layer in Nengo, from which NengoLoihi derives the original integers.

    Attributes
    ----------
    weights : ndarray of float
        In the kernel's shape; for neurons whose spikes have the area of one step (``amplitude`` of
        ``dt``) and a gain of 1.
    bias : ndarray of float, shape (filters,) or (units,)
    tau_s : float
        Time constant in seconds of the low-pass on the layer's input; 0 for none.
    tau_rc : float
        Membrane time constant in seconds; ``tau_ref`` is 0.
    min_voltage : float
        In units of the threshold, which is 1.
    """

    weights: np.ndarray
    bias: np.ndarray
    tau_s: float
    tau_rc: float
    min_voltage: float


def on_loihi(layer: Integers, dt: float) -> OnLoihi:
    """Parameters from which NengoLoihi derives these integers.

    NengoLoihi makes decays of 12 bits from the time constants.  It scales a block's weights so that
    the largest becomes 127.5, rounded to 127.  It multiplies threshold and bias such that their
    ratio to the weights is that with normalised filters, whose sum it estimates from the decays
    (``builder/discretize.py``: ``discretize_compartment``, ``decay_magnitude``).  This function
    inverts these steps.  NengoLoihi takes the largest exponent of the weights with which threshold
    and bias fit.

    Parameters
    ----------
    layer : Integers
        Its largest weight is 127 or -127, unless all are 0.  The same must hold in each block of a
        layer that is divided by its outputs; otherwise NengoLoihi rounds this block's weights and
        threshold again (:func:`deploy.network.blocks.scaled_by_block`).
    dt : float
        Time step in seconds of the Nengo model.
    """
    decay_u, decay_v = DECAY_UNIT - 1 - layer.keep_u, DECAY_UNIT - layer.keep_v
    sum_u, sum_v = _sum_of_decays(layer.keep_u), _sum_of_decays(layer.keep_v)
    share_u, share_v = (decay_u + 1) / (DECAY_UNIT - 1), decay_v / (DECAY_UNIT - 1)
    per_unit = 255 / WEIGHT_LEVELS * THRESHOLD_UNIT * sum_u * sum_v / layer.threshold
    return OnLoihi(
        weights=layer.weights * (per_unit * 2.0**layer.exponent),
        bias=layer.bias * (sum_v / layer.threshold),
        tau_s=0.0 if share_u == 1 else float(-dt / np.log1p(-share_u)),
        tau_rc=float(-dt / np.log1p(-share_v)),
        min_voltage=layer.floor / layer.threshold,
    )


def _sum_of_decays(keep):
    """NengoLoihi's estimate of the sum of a current of 2^21 while it decays to 0, divided by 2^21.

    x(k+1) = floor(r x(k)), where rounding down subtracts 0.494 per step on average.
    """
    start, lost, r = 2.0**21, 0.494, keep / DECAY_UNIT
    steps = -np.log1p(start * (1 - r) / lost) / np.log(r)
    geometric = (1 - r ** (steps + 1)) / (1 - r)
    return geometric - lost / ((1 - r) * start) * (steps + 1 - geometric)
