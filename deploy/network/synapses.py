"""Weights that are the sum of several synapses between the same two neurons.

A synapse has a weight of 8 bits.  NengoLoihi gives each connection of a block an exponent of its
own, but no finer steps than half of those of the block's largest weight: with smaller exponents the
chip's weights lose as many bits (``builder/discretize.py``: ``discretize_weights``).  So one of the
synapses, the fine one, has half steps, and the others add to the largest weight.  Two synapses have
weights of -380 to 380 half steps, instead of -127 to 127 steps.
"""

from __future__ import annotations

from dataclasses import replace
from typing import List

import numpy as np

from .chip import LOIHI, Chip

# Exponent of the fine synapse; that of the others is 0.
FINE_EXPONENT = -1


def count_weight_levels(synapses: int, chip: Chip = LOIHI) -> int:
    """Largest magnitude of a weight that is the sum of some synapses, in the finest one's steps."""
    if synapses == 1:
        return chip.weight_levels
    return 2 * chip.weight_levels * (synapses - 1) + _count_fine_levels(chip)


def _count_fine_levels(chip):
    """Largest magnitude of the fine synapse's weight.

    It is one level less than possible: NengoLoihi gives the synapse a smaller exponent only if its
    weights are, in single precision, less than half of the largest weight of the block.
    """
    return chip.weight_levels - 1


def split_layer(layer, area: float, chip: Chip = LOIHI) -> tuple:
    """Layers with one synapse for each weight, whose weights add up to those of a layer.

    Parameters
    ----------
    layer : deploy.network.layer.Layer
    area : float
        Area of a spike that arrives: the stimulus's, or the amplitude of the layer before.
    chip : Chip

    Returns
    -------
    tuple of Layer
        As many as the layer has synapses for each weight; the layer itself if it is one.
    """
    synapses = layer.synapses_per_weight
    if synapses == 1:
        return (layer,)
    input_factor = area / layer.pool**2
    own_factor = layer.neurons.amplitude
    sizes = [np.abs(layer.weights).max() * input_factor]
    if layer.recurrent is not None:
        sizes.append(np.abs(layer.recurrent).max() * own_factor)
    step = max(sizes) / count_weight_levels(synapses, chip) or 1.0
    weights = split_weights(layer.weights, step / input_factor, synapses, chip)
    recurrent: list = [None] * synapses
    if layer.recurrent is not None:
        recurrent = split_weights(layer.recurrent, step / own_factor, synapses, chip)
    return tuple(
        replace(layer, weights=share, recurrent=own, synapses_per_weight=1)
        for share, own in zip(weights, recurrent)
    )


def split_weights(
    weights: np.ndarray, step: float, synapses: int, chip: Chip = LOIHI
) -> List[np.ndarray]:
    """Weights of each of several synapses, whose sum is a weight; the fine synapse is the last.

    The fine synapse has as much of a weight as it can, and the others have the rest in double
    steps.  The largest weight has large parts in both, because NengoLoihi takes each connection's
    exponent from its largest weight: with exponents below those above it warns of lost bits, and
    makes weights with the lowest one too large.

    Parameters
    ----------
    weights : ndarray
    step : float
        Step of the fine synapse.
    synapses : int
        Number of synapses for a weight, 2 or more.
    chip : Chip
    """
    in_steps = weights / step
    sizes = np.abs(in_steps)
    rest = _round_up(np.maximum(sizes - _count_fine_levels(chip), 0) / 2)
    largest = np.unravel_index(sizes.argmax(), sizes.shape)
    rest[largest] = _choose_rest_of_largest(sizes[largest], rest[largest], chip)
    rest *= np.where(in_steps < 0, -1, 1)
    fine = in_steps - 2 * rest
    shares = []
    for remaining in range(synapses - 1, 0, -1):
        share = np.rint(rest / remaining)
        rest = rest - share
        shares.append(2 * step * share)
    return [*shares, step * fine]


def _choose_rest_of_largest(size, rest, chip):
    """The double steps of the largest weight; neither part is below a quarter of its range.

    The fine synapse's part is negative if the weight is small.  A weight of 0 has no parts.
    """
    if size == 0:
        return 0
    quarter = (chip.weight_levels + 1) / 4
    if size >= 4 * quarter:
        return max(rest, quarter)
    return _round_up(size / 2 + quarter)


def _round_up(values):
    """The next whole number, or the nearest one where only a rounding error exceeds it."""
    return np.ceil(values - 1e-6)
