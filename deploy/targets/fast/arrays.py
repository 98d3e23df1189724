"""Data structures of the kernels: a network as flat arrays of integers, and its state.

This module does not depend on Nengo.  `from_nengo` makes these arrays from a built network,
`kernel_numba` and `kernel_numpy` advance them, and `emulation` provides their input.

The equations are those of NengoLoihi's emulator (`nengo_loihi.emulator.interface`), which implement
the chip's (Davies et al., "Loihi", IEEE Micro 38(1), 2018, section "Neural computation") in
integers.  For every compartment and step, with ``q`` the sum of the weights of arriving spikes::

    q <- wrap(q, 21)                          the synaptic accumulator has 21 bits and a sign
    u <- wrap(decay(u, 4095 - delta_u) + q, 23)
    v <- decay(v, 4096 - delta_v) + wrap(u + bias, 23)
    v <- min(max(v, v_min), v_max), or 0 while refractory
    spike if v > threshold: then v <- 0 and the compartment is refractory

    decay(x, r) = sign(x) * floor(|x| * r / 4096)
    wrap(x, b)  = x in two's complement with b bits and a sign; it overflows if that changes x

A spike acts on its targets in the next step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Tuple

import numpy as np
import scipy.sparse

from ...network.chip import LOIHI

Q_BITS = LOIHI.input_bits  # synaptic accumulator, without sign
U_BITS = LOIHI.current_bits  # current and compartment input, without sign
OVERFLOWS = ("q0", "current", "u2")  # sums that can overflow, by the emulator's names


class Segments(NamedTuple):
    """Ranges of adjacent compartments with equal scalar parameters.

    Each field is int32 with one value per segment.
    """

    start: np.ndarray  # first compartment
    stop: np.ndarray  # one past the last
    layer: np.ndarray  # index into `Network.layers`
    keep_u: np.ndarray  # r of decay(u, r): 4095 - decay_u
    keep_v: np.ndarray  # r of decay(v, r): 4096 - decay_v
    v_min: np.ndarray
    v_max: np.ndarray
    refractory: np.ndarray  # refractory period in steps, during which the voltage is 0
    shift: np.ndarray  # weights into the segment must be multiplied by 2**shift


@dataclass(frozen=True)
class ChipLayer:
    """A population of neurons on the chip, possibly split into several blocks.

    Attributes
    ----------
    label : str
    position : (n_neurons,) int array
        Index among the compartments of each neuron of the population, in its own order.
    """

    label: str
    position: np.ndarray

    def of(self, values):
        """Select the population's values, in its own order, from those of all compartments."""
        first, n = int(self.position[0]), len(self.position)
        if np.array_equal(self.position, np.arange(first, first + n)):
            return values[..., first : first + n]
        return np.take(values, self.position, axis=-1)


@dataclass(frozen=True)
class Network:
    """The chip's part of a network.

    It is feed-forward: spikes go from inputs and layers to later layers.  Compartments are ordered
    by layer and segment, unlike in NengoLoihi; `layers` and `emulator_order` map to its orders.
    Sources of spikes are the inputs from the host followed by the compartments.

    Attributes
    ----------
    n_inputs : int
        Number of inputs from the host.
    weights : (n_inputs + n, n) csr_matrix of int32
        Weight of a source's spike in a compartment's ``q``, without the segment's power of two.
    segments : Segments
    bias, threshold : (n,) int32 array
    layers : tuple of ChipLayer
    emulator_order : (n,) int array
        Index here of each compartment of NengoLoihi's emulator, in the emulator's order.
    """

    n_inputs: int
    weights: scipy.sparse.csr_matrix
    segments: Segments
    bias: np.ndarray
    threshold: np.ndarray
    layers: Tuple[ChipLayer, ...]
    emulator_order: np.ndarray

    @property
    def n(self):
        """Number of compartments."""
        return len(self.bias)

    def slice_of(self, layer):
        """The compartments of the layer with some index."""
        mine = np.flatnonzero(self.segments.layer == layer)
        return slice(int(self.segments.start[mine[0]]), int(self.segments.stop[mine[-1]]))

    @property
    def largest_sums(self):
        """Upper bounds of the magnitude of each compartment's ``q``, without powers of two."""
        columns = self.weights.indices
        return np.bincount(columns, np.abs(self.weights.data), self.n).astype(np.int64)

    @property
    def largest_inputs(self):
        """Upper bounds of ``|u + bias|`` in each segment without overflow, int64.

        With ``|q| <= Q`` at every step, ``|u|`` stays below ``Q * 4096 / (4096 - keep_u)``.
        """
        segments = self.segments
        q = np.maximum.reduceat(self.largest_sums, segments.start) << segments.shift.astype(int)
        bias = np.maximum.reduceat(np.abs(self.bias.astype(int)), segments.start)
        return -(-q * 4096 // (4096 - segments.keep_u)) + bias

    @property
    def can_overflow(self):
        """True for each segment in which weights and biases allow an overflow."""
        segments = self.segments
        q = np.maximum.reduceat(self.largest_sums, segments.start) << segments.shift.astype(int)
        return (q >= 2**Q_BITS) | (self.largest_inputs >= 2**U_BITS)

    @property
    def is_plain(self):
        """True for each segment in which the chip's arithmetic can be simplified.

        Nothing can overflow, no voltage falls below 0 or reaches ``v_max``, and the products of
        currents and voltages with their loss per step, ``4096 - keep``, fit 32 bits.
        """
        segments, room = self.segments, 2**31 - 4096
        threshold = np.maximum.reduceat(self.threshold, segments.start).astype(np.int64)
        return (
            ~self.can_overflow
            & (segments.v_min >= 0)
            & (threshold + self.largest_inputs <= segments.v_max)
            & (threshold * (4096 - segments.keep_v) < room)
            & (self.largest_inputs * (4096 - segments.keep_u) < room)
        )

    @property
    def weight_type(self):
        """The smallest integer type that can represent every sum of weights."""
        return np.int16 if self.largest_sums.max() < 2**15 else np.int32


@dataclass
class State:
    """State between two steps, for several streams in parallel.

    Attributes
    ----------
    current, voltage : (n_streams, n) int32 array
    refractory : (n_streams, n) int32 array
        Remaining steps of the refractory period.
    inputs : (n_streams, n_inputs) uint8 array
        Spikes of the last step from the host, which arrive in the next step.
    spikes : (n_streams, n) uint8 array
        Spikes of the last step on the chip.
    """

    current: np.ndarray
    voltage: np.ndarray
    refractory: np.ndarray
    inputs: np.ndarray
    spikes: np.ndarray

    @classmethod
    def fresh(cls, network, n_streams):
        """The state at the start of a stream: all zero."""
        shape = (n_streams, network.n)
        return cls(
            current=np.zeros(shape, np.int32),
            voltage=np.zeros(shape, np.int32),
            refractory=np.zeros(shape, np.int32),
            inputs=np.zeros((n_streams, network.n_inputs), np.uint8),
            spikes=np.zeros(shape, np.uint8),
        )


@dataclass(frozen=True)
class Steps:
    """Results of a kernel for a number of steps.

    Attributes
    ----------
    spikes : (n_streams, n_steps, n) uint8 array
    decoded : (n_streams, n_steps, n_outputs) float64 array
        Sum of the decoders of each step's spikes.
    counts : (n_streams, n) int32 array
        Number of spikes of each compartment over all steps.
    overflows : (n_layers, 3) int64 array
        Number of overflows for each of `OVERFLOWS`.
    """

    spikes: np.ndarray
    decoded: np.ndarray
    counts: np.ndarray
    overflows: np.ndarray
