"""A network on the fast emulator, for many streams at once.

NengoLoihi builds and discretises the network; the chip's part runs on the compiled steps of
`fastloihi`, the host's part (input neurons before it, linear readout after it) in NumPy on all
streams together.
"""

from __future__ import annotations

import threading
from collections import defaultdict
from typing import TYPE_CHECKING, NamedTuple

import nengo
import numpy as np

from ..errors import UserError
from ..network.build import build_nengo_network
from ..network.chip import DT
from ..network.loihi_import import BUILD_ERRORS, make_build_error, nengo_loihi
from ..network.reference import InputNeurons

from fastloihi.layout import Unsupported  # isort: skip  (NengoLoihi without TensorFlow comes first)

if TYPE_CHECKING:
    from fastloihi.streams import StreamState

# Maximum memory in bytes for the spikes of some steps of all streams that run together.
MAX_SPIKE_BYTES = 32 << 20


class StreamOutputs(NamedTuple):
    """Output, spike counts and overflows of a batch of streams.

    Attributes
    ----------
    output : (n_streams, n_samples, period, n_outputs) array
        Values of the readout at every step of every sample, including its gap.
    counts : dict of str to (n_streams, n_samples, n_neurons) int array
        Number of spikes of each neuron of each layer during each sample and its gap.
    overflows : dict of str to (3,) int array
        Number of overflows of each layer on the chip, see `deploy.targets.fast.OVERFLOWS`.
    """

    output: np.ndarray
    counts: dict
    overflows: dict


class EmulationState(NamedTuple):
    """State of a network on the fast emulator between two steps, for some streams.

    Attributes
    ----------
    chip : fastloihi.streams.StreamState
    readout : Readout
    """

    chip: StreamState
    readout: Readout


class Emulation:
    """A network on the fast emulator; several threads may use it.

    Parameters
    ----------
    spec : NetworkSpec
    seed : int

    Attributes
    ----------
    spec : NetworkSpec
    chip : fastloihi.streams.StreamEmulator
    positions : dict of str to int array
        Index of the compartment of each neuron of each layer on the chip.
    sent : int array
        The input neurons whose spikes the chip receives.
    decoders : (n, n_outputs) array
        Contribution of each compartment's spike to the readout in its step.

    Raises
    ------
    UserError
        NengoLoihi cannot build the network, or Numba is not installed.
    """

    def __init__(self, spec, seed=0):
        built = build_nengo_network(spec, seed)
        model = nengo_loihi.builder.Model(dt=DT)
        try:
            model.build(built.network, precompute=None, discretize=True)
        except BUILD_ERRORS as error:
            raise make_build_error(built.network, error) from error
        try:
            from fastloihi.streams import StreamEmulator, sum_rows

            self.chip = StreamEmulator(model)
            self._sum_rows = sum_rows
        except ImportError as error:
            raise UserError(f"the target 'fast' needs Numba ({error}): pip install numba") from None
        except Unsupported as reason:
            raise UserError(
                f"the target 'fast' does not support {reason}; use the target 'emulator'"
            ) from None
        self.spec = spec
        ensembles = {e.label: e for e in built.network.all_ensembles if e.neurons in model.objs}
        self._blocks = {
            name: list(model.objs[ensembles[name].neurons]["in"])
            for name in spec.spiking_layers
            if name != "input"
        }
        self.positions = {
            name: self._find_compartments(model, bs) for name, bs in self._blocks.items()
        }
        self.sent = np.concatenate([_find_senders(model, item) for item in model.inputs])
        on_host = spec.layers[-1].neurons is None
        probe = next(iter(model.chip2host_receivers)) if on_host else built.output
        self.decoders = self._find_decoders(model.objs[probe]["out"])
        # The spikes that are decoded, in the order in which their decoders are added.
        order = np.concatenate(list(self.positions.values()))
        self._decoded = order[self.decoders[order].any(axis=1)]
        self._decoded_weights = self.decoders[self._decoded]
        self._lock = threading.RLock()

    def _find_compartments(self, model, blocks):
        """Compartment of each neuron of a layer, which may be on several cores."""
        neurons = np.concatenate([list(model.block_comp_map[block]) for block in blocks])
        slices = (self.chip.blocks[block] for block in blocks)
        compartments = np.concatenate([np.arange(block.start, block.stop) for block in slices])
        return compartments[np.argsort(neurons, kind="stable")]

    def _find_decoders(self, probe):
        decoders = []
        for first in range(0, self.chip.n, 1024):  # all at once would take gigabytes
            unit = np.eye(min(1024, self.chip.n - first), self.chip.n, first, dtype=bool)
            spikes = [
                unit[:, self.chip.blocks[block]][:, neurons]
                for block, neurons in zip(probe.target, probe.slice)
            ]
            decoders.append(np.asarray(probe.weight_outputs(spikes), float))
        return np.concatenate(decoders)

    def start(self, n_streams=1) -> EmulationState:
        """The state of a fresh network, for some streams."""
        readout = Readout(self.spec.layers[-1], n_streams, self.decoders.shape[1])
        return EmulationState(self.chip.start(n_streams), readout)

    def advance(self, state, sent):
        """Advance all streams by some steps.

        Parameters
        ----------
        state : EmulationState
            Changed to the state after the last step.
        sent : (n_streams, n_steps, size) uint8 array
            1 where an input neuron spikes, else 0.

        Returns
        -------
        spikes : (n_streams, n_steps, chip.n) uint8 array
            Spikes of all compartments; see :attr:`positions`.
        output : (n_streams, n_steps, n_outputs) array
            Values of the readout.
        overflows : (n_blocks, 3) int64 array
            See `fastloihi.streams.StreamEmulator.advance`.
        """
        with self._lock:
            spikes, overflows = self.chip.advance(state.chip, _select_compartments(sent, self.sent))
        decoded = self._sum_rows(_select_compartments(spikes, self._decoded), self._decoded_weights)
        return spikes, state.readout.advance(decoded), overflows

    def run(self, samples, watch=None, max_spike_bytes=MAX_SPIKE_BYTES) -> StreamOutputs:
        """Present streams of samples, each to a fresh network, as the spec's presentation says.

        Parameters
        ----------
        samples : (n_streams, n_samples, size) or (n_streams, n_samples, steps, size) array
            One frame that is constant for all steps of its sample, or one frame per step.
        watch : callable, optional
            Called after each sample of the streams with every spike of each layer: a dict of
            str to uint8 arrays (n_streams, period, n_neurons / 8), packed by `numpy.packbits`.
        max_spike_bytes : int
            Maximum memory for the spikes of some steps; the result does not depend on it.

        Returns
        -------
        StreamOutputs
        """
        with self._lock:
            return self._run(np.asarray(samples), watch, max_spike_bytes)

    def _run(self, samples, watch, max_spike_bytes):
        n_streams, n_samples = samples.shape[:2]
        host = InputNeurons(self.spec.stimulus, n_streams, samples.shape[-1])
        state = self.start(n_streams)
        steps_at_once = max(1, max_spike_bytes // self.count_bytes_per_step(n_streams))
        by_sample = []
        for index in range(n_samples):
            host.set_samples(samples[:, index])
            by_sample.append(self._present_sample(state, host, steps_at_once, watch))
        counts = {}
        for name in by_sample[0].counts:
            counts[name] = np.stack([sample.counts[name] for sample in by_sample], axis=1)
        overflows = {}
        for name in self._blocks:
            overflows[name] = sum(sample.overflows[name] for sample in by_sample)
        outputs = np.stack([sample.output for sample in by_sample], axis=1)
        return StreamOutputs(outputs, counts, overflows)

    def _present_sample(self, state, host, steps_at_once, watch) -> StreamOutputs:
        """The outputs of the current sample of each stream, without an axis for samples."""
        presentation = self.spec.presentation
        counters_before = state.chip.counters[:, 1].copy()
        outputs = []
        input_counts = 0
        overflows = 0
        packed = defaultdict(list)
        for first in range(-presentation.gap, presentation.steps, steps_at_once):
            sent = host.make_spikes(first, min(first + steps_at_once, presentation.steps))
            spikes, output, overflows_of_steps = self.advance(state, sent)
            outputs.append(output)
            input_counts = input_counts + sent.sum(axis=1, dtype=int)
            overflows = overflows + overflows_of_steps
            if watch is not None:
                packed["input"].append(np.packbits(sent, axis=2))
                for name, of_layer in self._split_by_layer(spikes):
                    packed[name].append(np.packbits(of_layer, axis=2))
        if watch is not None:
            watch({name: np.concatenate(arrays, axis=1) for name, arrays in packed.items()})
        counts = dict(self._split_by_layer(state.chip.counters[:, 1] - counters_before))
        return StreamOutputs(
            output=np.concatenate(outputs, axis=1),
            counts={"input": input_counts, **counts},
            overflows=self._sum_by_layer(overflows),
        )

    def _split_by_layer(self, values):
        """(name, values of its compartments) of each layer on the chip."""
        for name, compartments in self.positions.items():
            yield name, _select_compartments(values, compartments)

    def _sum_by_layer(self, overflows):
        """The overflows of each layer, from those of each block."""
        by_block = dict(zip(self.chip.blocks, overflows))
        by_layer = {}
        for name, blocks in self._blocks.items():
            by_layer[name] = sum(by_block[block] for block in blocks)
        return by_layer

    def count_bytes_per_step(self, n_streams):
        """Approximate memory for one step of some streams."""
        return n_streams * (self.chip.n + len(self.sent))

    def count_bytes_kept(self):
        """Approximate memory for the results of a sample."""
        outputs = self.decoders.shape[1] * self.spec.presentation.period
        return 8 * outputs + 4 * (self.chip.n + len(self.sent))


def _find_senders(model, spike_input):
    """The input neurons whose spikes an input of the chip receives."""
    (sender,) = (
        sender
        for sender, receiver in model.host2chip_senders.items()
        if model.spike_targets[receiver] is spike_input
    )
    (connection,) = (
        item
        for item in model.host_pre.params
        if isinstance(item, nengo.Connection) and item.post_obj is sender
    )
    return np.arange(connection.pre_obj.size_out)[connection.pre_slice]


def _select_compartments(values, compartments):
    """The values of some compartments, from an array with all of them along its last axis."""
    first, n = (int(compartments[0]), len(compartments)) if len(compartments) else (0, 0)
    if np.array_equal(compartments, np.arange(first, first + n)):
        return values[..., first : first + n]
    return np.take(values, compartments, axis=-1)


class Readout:
    """The state of the readout for several streams.

    Parameters
    ----------
    layer : Layer
        On the host, or on the chip, where it is read in the chip's own step.
    n_streams, n_outputs : int
    """

    def __init__(self, layer, n_streams, n_outputs):
        self._on_host = layer.neurons is None
        self._last = None
        self._step = None
        self._filtered = np.zeros((n_streams, n_outputs))
        if self._on_host and layer.synapse is not None:
            shape = self._filtered.shape
            synapse = nengo.Lowpass(layer.synapse)
            state = synapse.make_state(shape, shape, DT, dtype=float)
            self._step = synapse.make_step(shape, shape, DT, rng=None, state=state)

    def advance(self, decoded):
        """Values of the readout in several steps, (n_streams, n_steps, n_outputs).

        Parameters
        ----------
        decoded : (n_streams, n_steps, n_outputs) array
            Sum of the decoders of the chip's spikes in these steps.
        """
        if not self._on_host:
            return decoded
        # The host receives the chip's step k - 1 in its own step k.  Only its first step, which has
        # no predecessor, receives the chip's first (nengo_loihi.builder.inputs.EmptyQueueStep).
        first = decoded[:, :1] if self._last is None else self._last
        self._last = decoded[:, -1:].copy()
        values = np.concatenate([first, decoded[:, :-1]], axis=1)
        if self._step is not None:
            for step in range(values.shape[1]):
                # A filter's output has Nengo's delay of one step.
                delayed = self._filtered
                self._filtered = np.array(self._step(None, np.ascontiguousarray(values[:, step])))
                values[:, step] = delayed
        return values
