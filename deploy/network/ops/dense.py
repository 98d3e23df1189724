"""A dense layer: every neuron reads every value."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...loading import load_dataclass
from ..chip import Chip
from ..geometry import list_inputs_within
from .base import (
    POPULATION_SLOTS,
    DeployedOperation,
    Resources,
    count_axon_words,
    count_blocks,
    count_neurons,
    find_index_bits,
)

# Entries of every dense layer in a bundle, which are not read.
PLACEHOLDERS = {"kernel": 0, "stride": 1, "padding": "valid"}


@dataclass(frozen=True)
class DeployedDense(DeployedOperation):
    """A dense layer; its weights have the shape (sections * units, inputs).

    Attributes
    ----------
    units : int
    """

    units: int
    kind = "dense"
    can_read_out = True
    can_recur = True

    def to_file(self):
        return dict(PLACEHOLDERS)

    @classmethod
    def from_file(cls, numbers, shape):
        own = {name: value for name, value in numbers.items() if name not in PLACEHOLDERS}
        return load_dataclass(cls, {**own, "units": shape[-1]})

    def compute_shape(self, pooled_shape):
        return (self.units,)

    def compute_weight_shape(self, pooled_shape):
        return (self.units, math.prod(pooled_shape))

    def compute_sums(self, weights, values):
        return values.reshape(len(values), -1) @ weights.T

    def make_matrix(self, weights, pooled_shape):
        return weights

    def find_largest_weights(self, weights, pooled_shape):
        return np.abs(weights).max(1)

    def count_fan_out(self, pooled_shape):
        return np.full(pooled_shape, self.units, np.int64)

    def make_transform(self, layer, chip):
        if reads_populations(layer, chip):
            return _make_population_transform(layer)
        return super().make_transform(layer, chip)

    def make_resources(self, layer, chip):
        if reads_populations(layer, chip):
            return _PopulationResources(layer, chip)
        return super().make_resources(layer, chip)

    def make_nir_nodes(self, layer, nir, area):
        *sides, channels = layer.pooled_shape
        flatten = nir.Flatten({"input": np.array([channels, *sides])}, start_dim=0)
        yield f"{layer.name}_flatten", flatten
        by_position = layer.weights.reshape(layer.shape[0], *layer.pooled_shape)
        weights = np.moveaxis(by_position, -1, 1).reshape(layer.weights.shape)
        yield f"{layer.name}_weights", nir.Affine(weight=weights * area, bias=layer.bias.copy())

    def describe(self, layer):
        return "dense" if layer.n_sections == 1 else f"dense in {layer.n_sections} sections"


def reads_populations(layer, chip: Chip) -> bool:
    """True if a layer's input spikes name a pixel and, as the axon's atom, a channel.

    A core has fewer input axons than such a layer has inputs.  An axon for each pixel with all its
    channels, as a convolution has them, is sufficient then; its synapses take more memory, since
    each has an index.
    """
    if layer.placement != "chip" or len(layer.input_shape) != 3:
        return False
    limit = chip.limits["input axons"]
    return math.prod(layer.input_shape) > limit >= math.prod(_find_pooled_pixels(layer))


def _find_pooled_pixels(layer):
    """(rows, columns) of the input inside of complete pooling windows."""
    return tuple(n * layer.pool for n in layer.pooled_shape[:2])


def _make_population_transform(layer):
    """The layer as a convolution whose only window is the whole input."""
    import nengo

    kernel = np.moveaxis(layer.weights.reshape(layer.size, *layer.pooled_shape), 0, -1)
    kernel = kernel.repeat(layer.pool, axis=0).repeat(layer.pool, axis=1) / layer.pool**2
    input_shape = kernel.shape[:3]
    transform = nengo.Convolution(
        n_filters=layer.size,
        input_shape=input_shape,
        kernel_size=input_shape[:2],
        init=kernel,
    )
    return transform, list_inputs_within(layer.input_shape, input_shape)


class _PopulationResources(Resources):
    """An axon for each pixel, with the channels as its atoms."""

    def count_input_axons(self, block):
        return math.prod(_find_pooled_pixels(self.layer)) * count_blocks(self.layer.shape, block)

    def count_needs(self, ranges):
        units = count_neurons(ranges)
        pixels = math.prod(_find_pooled_pixels(self.layer))
        # In a divided layer, the pixels of a pooling window share their lists.
        is_divided = units < self.layer.size
        pixels_with_lists = math.prod(self.layer.pooled_shape[:2]) if is_divided else pixels
        bits = self.chip.weight_bits + find_index_bits(units)
        words = count_axon_words(self.layer.input_shape[2], units, bits, self.chip)
        return pixels, pixels_with_lists * words

    def make_output_axon_counter(self, block):
        blocks = count_blocks(self.layer.shape, block)
        rows, columns = _find_pooled_pixels(self.layer)

        def count_output_axons(ranges):
            sides = zip((rows, columns), ranges)
            pixels = (max(min(last, n) - first, 0) for n, (first, last) in sides)
            return math.prod(pixels) * blocks * POPULATION_SLOTS

        return count_output_axons
