"""What the kernels know: a network as flat arrays of integers, and its state.

Nothing here knows of Nengo.  `from_nengo` makes these arrays from a built network, `kernel_numba`
and `kernel_numpy` advance them, `emulation` feeds them.

The equations are those of NengoLoihi's emulator (`nengo_loihi.emulator.interface`), which are the
chip's (Davies et al., "Loihi", IEEE Micro 38(1), 2018, section "Neural computation") in integers.
For every compartment and every step, with ``q`` the sum of the weights of the spikes that arrive::

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
OVERFLOWS = ("q0", "current", "u2")  # where one can occur; the emulator's names


class Segments(NamedTuple):
    """Runs of neighbouring compartments that share every scalar parameter.

    Each field is int32 with one value a segment.
    """

    start: np.ndarray  # first compartment
    stop: np.ndarray  # one past the last
    layer: np.ndarray  # index into `Network.layers`
    keep_u: np.ndarray  # r of decay(u, r): 4095 - decay_u
    keep_v: np.ndarray  # r of decay(v, r): 4096 - decay_v
    v_min: np.ndarray
    v_max: np.ndarray
    refractory: np.ndarray  # steps in which the voltage is held at 0 after a spike
    shift: np.ndarray  # weights into the segment are to be multiplied by 2**shift


@dataclass(frozen=True)
class ChipLayer:
    """A population of neurons on the chip, possibly split into several blocks.

    Attributes
    ----------
    label : str
    position : (n_neurons,) int array
        Where each neuron of the population, in its own order, stands among the compartments.
    """

    label: str
    position: np.ndarray

    def of(self, values):
        """The population's own, in its own order, of what is given for all compartments last."""
        first, n = int(self.position[0]), len(self.position)
        if np.array_equal(self.position, np.arange(first, first + n)):
            return values[..., first : first + n]
        return np.take(values, self.position, axis=-1)


@dataclass(frozen=True)
class Network:
    """The chip's part of a network.

    It is feed-forward: spikes go from inputs and layers to later layers.  Compartments are ordered
    by layer and segment, not as NengoLoihi orders its blocks; `layers`
    and `emulator_order` lead back.  Sources of spikes are the inputs from the host followed by
    the compartments.

    Attributes
    ----------
    n_inputs : int
        Inputs from the host.
    weights : (n_inputs + n, n) csr_matrix of int32
        From a source's spike to a compartment's ``q``, without the segment's power of two.
    segments : Segments
    bias, threshold : (n,) int32 array
    layers : tuple of ChipLayer
    emulator_order : (n,) int array
        Where each compartment of NengoLoihi's emulator, in its order, stands here.
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
        """The compartments of a layer, by its index."""
        mine = np.flatnonzero(self.segments.layer == layer)
        return slice(int(self.segments.start[mine[0]]), int(self.segments.stop[mine[-1]]))

    @property
    def largest_sums(self):
        """Bound of the magnitude of each compartment's ``q``, without its power of two, int64."""
        columns = self.weights.indices
        return np.bincount(columns, np.abs(self.weights.data), self.n).astype(np.int64)

    @property
    def largest_inputs(self):
        """Bound of ``|u + bias|`` in each segment if nothing overflows, int64.

        With ``|q| <= Q`` at every step, ``|u|`` stays below ``Q * 4096 / (4096 - keep_u)``.
        """
        segments = self.segments
        q = np.maximum.reduceat(self.largest_sums, segments.start) << segments.shift.astype(int)
        bias = np.maximum.reduceat(np.abs(self.bias.astype(int)), segments.start)
        return -(-q * 4096 // (4096 - segments.keep_u)) + bias

    @property
    def can_overflow(self):
        """For each segment, whether its weights and biases leave room for any overflow at all."""
        segments = self.segments
        q = np.maximum.reduceat(self.largest_sums, segments.start) << segments.shift.astype(int)
        return (q >= 2**Q_BITS) | (self.largest_inputs >= 2**U_BITS)

    @property
    def is_plain(self):
        """For each segment, whether the chip's arithmetic comes down to fewer operations there.

        Nothing can overflow, no voltage falls below 0 or reaches ``v_max``, and products of
        currents and voltages with what they lose in a step, ``4096 - keep``, fit 32 bits.
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
        """The smallest type of integer that holds every sum of weights."""
        return np.int16 if self.largest_sums.max() < 2**15 else np.int32


@dataclass
class State:
    """Everything that goes from one step to the next, for several streams side by side.

    Attributes
    ----------
    current, voltage : (n_streams, n) int32 array
    refractory : (n_streams, n) int32 array
        Steps in which the voltage is still held at zero.
    inputs : (n_streams, n_inputs) uint8 array
        Spikes of the last step from the host, in flight to the chip.
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
        """State at the start of a stream: all zero."""
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
    """What some steps of a kernel gave.

    Attributes
    ----------
    spikes : (n_streams, n_steps, n) uint8 array
    decoded : (n_streams, n_steps, n_outputs) float64 array
        Sum of the decoders of the step's spikes.
    counts : (n_streams, n) int32 array
        Spikes of each compartment in all the steps.
    overflows : (n_layers, 3) int64 array
        How often a compartment overflowed in a step, for each of `OVERFLOWS`.
    """

    spikes: np.ndarray
    decoded: np.ndarray
    counts: np.ndarray
    overflows: np.ndarray
