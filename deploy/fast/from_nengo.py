"""From a Nengo network to flat arrays: the one file that knows NengoLoihi's and Nengo's internals.

NengoLoihi builds, splits and discretises the network; what is read here are its blocks, axons and
synapses (by their own mapping methods, so that population axons, atoms and split blocks come out
as the emulator has them) and the operators of the two host models that it makes.
"""

from __future__ import annotations

import threading
from typing import NamedTuple

import nengo
import nengo.builder.operator as operators
import numpy as np
import scipy.sparse
from nengo.builder.neurons import SimNeurons
from nengo.builder.processes import SimProcess
from nengo.builder.transforms import ConvInc

from ..errors import UserError
from ..foreign import nengo_loihi
from ..network import EvenSpikes
from .arrays import Layer, Network, Segments
from .host import HostNeurons, HostOutput

# Their step functions work on arrays of any shape and draw no random numbers.
HOST_NEURONS = (
    nengo.LIF,
    nengo.SpikingRectifiedLinear,
    EvenSpikes,
    nengo_loihi.neurons.LoihiLIF,
    nengo_loihi.neurons.LoihiSpikingRectifiedLinear,
)
_WITHOUT_MEMORY = (
    operators.Reset,
    operators.Copy,
    operators.ElementwiseInc,
    operators.DotInc,
    operators.SparseDotInc,
    ConvInc,
)


class Program(NamedTuple):
    """A network ready to be run for many streams side by side.

    Attributes
    ----------
    dt : float
        Time step in seconds.
    drive : callable
        From frames, shape (n_frames, n_pixels), to what drives the host's input neurons, shape
        (n_frames, network.n_inputs).
    inputs : tuple of HostNeurons
        The populations whose spikes go to the chip, in the order of the network's inputs.
    network : Network
    output : HostOutput
    """

    dt: float
    drive: object
    inputs: tuple
    network: Network
    output: HostOutput


def compile_network(network, source, output, dt=0.001) -> Program:
    """Compile a feed-forward network of host input, chip and host output.

    Parameters
    ----------
    network : nengo.Network
        It is left as it was.
    source : nengo.Node
        The node that shows the frames; only its size is used.
    output : nengo.Probe
        On a node or neurons on the host, or on neurons on the chip.
    dt : float
        Time step in seconds.

    Returns
    -------
    Program

    Raises
    ------
    UserError
        The network holds something that this emulator cannot do, or NengoLoihi cannot build it.
    """
    showing = source.output
    frame = np.zeros(source.size_out)
    source.output = lambda t: frame
    try:
        model = nengo_loihi.builder.Model(dt=float(dt))
        # precompute=None: NengoLoihi finds out by itself whether the host waits for the chip.
        model.build(network, precompute=None, discretize=True)
    except (nengo.exceptions.NengoException, AssertionError, AttributeError) as error:
        # Some of its limits are assertions, one of whose messages is itself mistaken.
        problem = str(error) or "one of its internal limits is not met"
        raise UserError(f"NengoLoihi cannot build this network: {problem}") from error
    finally:
        source.output = showing
    _refuse_what_is_not_feed_forward(model)
    inputs = _host_inputs(model)
    chip, positions = _chip(network, model, inputs)
    return Program(
        dt=float(dt),
        drive=_Drive(model.host_pre, frame, [item.drive for item in inputs]),
        inputs=tuple(item.neurons for item in inputs),
        network=chip,
        output=_output(model, output, chip, positions),
    )


def _cannot(what, where=None):
    place = "" if where is None else f" ({where})"
    return UserError(f"the target 'fast' cannot do {what}{place}; use the target 'emulator'")


def _refuse_what_is_not_feed_forward(model):
    if model.host2chip_pes_senders:
        raise _cannot("learning on the chip")
    if not model.split.precompute:
        raise _cannot("feedback from the chip through the host to the chip")
    for item in model.inputs:
        if item.permanent:
            raise _cannot("spikes that are fixed when the network is built", item.label)
    for block in model.blocks:
        if np.any(block.compartment.enable_noise):
            raise _cannot("noise", block)
        for synapse in block.synapses:
            if synapse.learning:
                raise _cannot("learning on the chip", block)


# --- the chip ---------------------------------------------------------------------------------


def _chip(network, model, inputs):
    """The chip's arrays, and for each block where its compartments stand among them."""
    blocks = list(model.blocks)
    layers = _blocks_of_layers(network, model)
    columns = {name: [] for name in ("layer", "neuron", *_SCALARS, "bias", "threshold")}
    for block in blocks:
        compartment, n = block.compartment, block.n_neurons
        layer = next(i for i, (_, members) in enumerate(layers) if block in members)
        for name, value in (
            ("layer", layer),
            ("neuron", list(model.block_comp_map[block])),
            ("keep_u", 4096 - 1 - compartment.decay_u),
            ("keep_v", 4096 - compartment.decay_v),
            ("v_min", compartment.vmin),
            ("v_max", compartment.vmax),
            # The emulator counts one down in the step of the spike itself.
            ("refractory", np.maximum(compartment.refract_delay - 1, 0)),
            ("bias", compartment.bias),
            ("threshold", compartment.vth),
        ):
            columns[name].append(np.broadcast_to(np.asarray(value, np.int64), (n,)))
    table = {name: np.concatenate(parts) for name, parts in columns.items()}

    # By layer and segment, and in a segment by the population's own order: that makes the targets
    # of a spike long runs of neighbours.
    order = np.lexsort([table["neuron"], *(table[name] for name in _SCALARS), table["layer"]])
    position = np.empty_like(order)
    position[order] = np.arange(len(order))
    table = {name: column[order] for name, column in table.items()}
    offsets = np.cumsum([0] + [block.n_neurons for block in blocks])
    positions = {b: position[i:j] for b, i, j in zip(blocks, offsets[:-1], offsets[1:])}

    weights = _weights(model, inputs, positions, len(order))
    _refuse_loops(weights, table["layer"])
    segments, weights = _segments(table, weights)
    n_inputs = weights.shape[0] - len(order)
    chip = Network(
        n_inputs=n_inputs,
        weights=weights,
        segments=segments,
        bias=table["bias"].astype(np.int32),
        threshold=table["threshold"].astype(np.int32),
        layers=tuple(
            Layer(label, _in_own_order(table, index)) for index, (label, _) in enumerate(layers)
        ),
        emulator_order=position,
    )
    return chip, positions


_SCALARS = ("keep_u", "keep_v", "v_min", "v_max", "refractory")


def _blocks_of_layers(network, model):
    """(label, blocks) of each ensemble on the chip, then of each block that belongs to none."""
    layers = []
    for ensemble in network.all_ensembles:
        if ensemble in model.params and ensemble.neurons in model.objs:
            blocks = model.objs[ensemble.neurons]["in"]
            layers.append((ensemble.label or str(ensemble), list(blocks)))
    known = {block for _, blocks in layers for block in blocks}
    layers += [(str(block.label), [block]) for block in model.blocks if block not in known]
    return layers


def _in_own_order(table, layer):
    mine = np.flatnonzero(table["layer"] == layer)
    return mine[np.argsort(table["neuron"][mine], kind="stable")]


def _weights(model, inputs, positions, n):
    """Matrix from each source (inputs, then compartments) to each compartment, int64."""
    home = {synapse: block for block in model.blocks for synapse in block.synapses}
    n_inputs = sum(item.neurons.n for item in inputs)
    sources, targets, values = [], [], []

    def add(axon, source_of):
        into = positions[home[axon.target]]
        for index, (compartments, weights) in enumerate(_fan_out(axon, len(source_of))):
            sources.append(np.full(len(weights), source_of[index]))
            targets.append(into[compartments])
            values.append(weights)

    start = 0
    for item in inputs:
        for spike_input, neurons in item.senders:
            for axon in spike_input.axons:
                add(axon, start + neurons)
        start += item.neurons.n
    for block in model.blocks:
        for axon in block.axons:
            add(axon, n_inputs + positions[block])
    if not values:
        return scipy.sparse.csr_matrix((n_inputs + n, n), dtype=np.int64)
    return scipy.sparse.coo_matrix(
        (
            np.concatenate(values).astype(np.int64),
            (np.concatenate(sources), np.concatenate(targets)),
        ),
        shape=(n_inputs + n, n),
    ).tocsr()  # adds up what one source sends to one compartment along several axons


def _refuse_loops(weights, layer_of):
    """Layers are in the order in which the network was written: spikes only go forward in it."""
    n_inputs = weights.shape[0] - len(layer_of)
    entries = weights[n_inputs:].tocoo()
    if np.any(layer_of[entries.row] >= layer_of[entries.col]):
        raise _cannot("connections on the chip back to a layer or to an earlier one")


def _fan_out(axon, n_sources):
    """For each source, the compartments of the target block and weights that its spike reaches."""
    synapse = axon.target
    compartments = np.arange(n_sources)
    for index, atom in zip(axon.map_axon(compartments), axon.map_atoms(compartments)):
        base = synapse.axon_compartment_base(index) if index >= 0 else None
        if base is None:
            yield np.empty(0, int), np.empty(0, np.int32)
            continue
        weights, indices = synapse.axon_weights_indices(index, atom=atom)
        # As in the emulator's `q[indices] += weights`, the last of equal indices counts.
        row = dict(zip((base + indices).tolist(), weights.tolist()))
        yield np.fromiter(row.keys(), int, len(row)), np.fromiter(row.values(), np.int64, len(row))


def _segments(table, weights):
    """Group equal compartments, and divide each group's weights by their common power of two."""
    key = np.stack([table[name] for name in ("layer", *_SCALARS)])
    edges = np.flatnonzero(np.any(key[:, 1:] != key[:, :-1], axis=0)) + 1
    start = np.concatenate([[0], edges]).astype(np.int32)
    stop = np.concatenate([edges, [key.shape[1]]]).astype(np.int32)
    used = np.zeros(key.shape[1], np.int64)
    np.bitwise_or.at(used, weights.indices, weights.data)
    bits = np.bitwise_or.reduceat(used, start)
    shift = np.array([_trailing_zeros(int(b)) for b in bits], np.int32)
    weights = weights.copy()
    weights.data >>= np.repeat(shift, stop - start)[weights.indices]
    scalars = {name: table[name][start].astype(np.int32) for name in ("layer", *_SCALARS)}
    weights.eliminate_zeros()
    weights.sort_indices()
    segments = Segments(start=start, stop=stop, shift=shift, **scalars)
    return segments, weights.astype(np.int32)


def _trailing_zeros(bits):
    return (bits & -bits).bit_length() - 1 if bits else 0


# --- the host before the chip -----------------------------------------------------------------


class _Input(NamedTuple):
    neurons: HostNeurons
    drive: object  # the signal that the frame alone decides
    senders: list  # (SpikeInput, indices of the neurons that feed it)


def _host_inputs(model):
    """The populations on the host that spike into the chip."""
    host = model.host_pre
    senders = {}
    for sender, receiver in model.host2chip_senders.items():
        feeding = [c for c in _connections(host) if c.post_obj is sender]
        connection = feeding[0] if len(feeding) == 1 else None
        if connection is None or not isinstance(connection.pre_obj, nengo.ensemble.Neurons):
            raise _cannot("this way from the host to the chip", sender)
        population = connection.pre_obj
        indices = np.arange(population.size_out)[connection.pre_slice]
        senders.setdefault(population, []).append((model.spike_targets[receiver], indices))
    return [_host_input(host, population, to_chip) for population, to_chip in senders.items()]


def _connections(host):
    return [item for item in host.params if isinstance(item, nengo.Connection)]


def _host_input(host, population, senders):
    current = host.sig[population]["in"]
    upstream = _upstream(host, current)
    filters = [op for op in upstream if isinstance(op, SimProcess)]
    drive, synapse = current, None
    if filters:
        if len(filters) > 1 or not isinstance(filters[0].process, nengo.Lowpass):
            raise _cannot("anything but one low-pass before the input neurons", population)
        drive, synapse = filters[0].input, filters[0].process
        upstream = _upstream(host, drive)
        _check_filtered_current(host, current, filters[0].output, population)
    for op in upstream:
        if isinstance(op, operators.SimPyFunc) and op.t is None:
            raise _cannot("functions on the way to the input neurons", population)
        if not isinstance(op, (*_WITHOUT_MEMORY, operators.SimPyFunc, operators.TimeUpdate)):
            raise _cannot("input neurons that depend on more than the frame", population)
    neurons = _neurons(host, population)._replace(synapse=synapse)
    return _Input(neurons, drive, senders)


def _neurons(host, population):
    """A population on the host, without a filter on its input."""
    operator = next(
        op
        for op in host.operators
        if isinstance(op, SimNeurons) and op.output is host.sig[population]["out"]
    )
    if type(operator.neurons) not in HOST_NEURONS:
        raise _cannot(f"{type(operator.neurons).__name__} neurons on the host", population)
    built = host.params[population.ensemble]
    return HostNeurons(
        label=population.ensemble.label or str(population.ensemble),
        neuron_type=operator.neurons,
        initial={
            name: np.array(operator.sets[index].initial_value)
            for name, index in operator.state_idxs.items()
        },
        synapse=None,
        gain=np.array(built.gain),
        bias=np.array(built.bias),
    )


def _upstream(host, signal):
    """The operators that a signal depends on within a step."""
    found, waiting = [], [signal]
    seen = set()
    while waiting:
        base = waiting.pop().base
        if base in seen:
            continue
        seen.add(base)
        for op in host.operators:
            if op not in found and any(s.base is base for s in (*op.sets, *op.incs, *op.updates)):
                found.append(op)
                waiting.extend(op.reads)
    return found


def _check_filtered_current(host, current, filtered, population):
    """J must be bias + gain * filtered: `HostNeurons` computes just that."""
    writers = [op for op in host.operators if current.base in {s.base for s in op.incs}]
    mine = [op for op in writers if filtered in op.reads]
    rest = [op for op in writers if op not in mine]
    silent = all(isinstance(op, operators.DotInc) and op.tag.endswith("encoding") for op in rest)
    if len(mine) != 1 or not isinstance(mine[0], operators.ElementwiseInc) or not silent:
        raise _cannot("more than one current into the input neurons", population)


class _Drive:
    """Runs those of the host's operators that lie between the frame and the input neurons.

    They are Nengo's own step functions on one frame after the other: a product with a matrix gives
    other last bits for many frames at once than for one.
    """

    def __init__(self, host, frame, drives):
        self.frame = frame
        self.lock = threading.Lock()  # one frame, one set of signals, maybe several threads
        self.steps, self.signals = [], []
        if not drives:
            return
        simulator = nengo.Simulator(
            None, dt=host.dt, model=host, progress_bar=False, optimize=False, seed=0
        )
        needed = {op for drive in drives for op in _upstream(host, drive)}
        self.signals = [simulator.signals[drive] for drive in drives]
        self.steps = [
            step
            for op, step in zip(simulator.step_order, simulator._steps)
            if op in needed and not isinstance(op, operators.TimeUpdate)
        ]
        simulator.close()

    def __call__(self, frames):
        frames = np.asarray(frames, float)
        drive = np.empty((len(frames), sum(signal.size for signal in self.signals)))
        with self.lock:
            for row, frame in zip(drive, frames):
                self.frame[:] = frame
                for step in self.steps:
                    step()
                row[:] = np.concatenate(self.signals) if self.signals else 0.0
        return drive


# --- from the chip to the result ----------------------------------------------------------------


def _output(model, probe, chip, positions):
    """How the probe's values come from the chip's spikes."""
    target = probe.target
    if not isinstance(target, (nengo.Node, nengo.ensemble.Neurons)):
        raise _cannot("an output that is neither a node nor neurons", probe)
    if probe.synapse is not None or probe.sample_every is not None or probe.attr != "output":
        raise _cannot("an output probe with a filter, a sampling interval or an attribute", probe)
    if probe in model.params and probe in model.objs:
        decoders = _decoders(model.objs[probe]["out"], chip, positions)
        return HostOutput(decoders=decoders, on_chip=True)

    host = model.host
    if isinstance(target, nengo.Node) and target.output is not None:
        raise _cannot("a function on the output node", target)
    feeding = [c for c in _connections(host) if c.post_obj is target]
    receivers = {receiver: p for p, receiver in model.chip2host_receivers.items()}
    connection = feeding[0] if len(feeding) == 1 else None
    if connection is None or connection.pre_obj not in receivers:
        raise _cannot("an output that is not fed by one connection from the chip", target)
    if connection.post_slice != slice(None) or connection.pre_slice != slice(None):
        raise _cannot("an output that is fed in part", target)
    synapse = connection.synapse
    if synapse is not None and not isinstance(synapse, nengo.Lowpass):
        raise _cannot(f"a synapse {synapse} on the output", target)
    loihi_probe = model.objs[receivers[connection.pre_obj]]["out"]
    neurons = None
    if isinstance(target, nengo.ensemble.Neurons):
        neurons = _neurons(host, target)
    return HostOutput(
        decoders=_decoders(loihi_probe, chip, positions),
        on_chip=False,
        parts=tuple(
            (positions[block][part], weights)
            for block, part, weights in zip(
                loihi_probe.target, loihi_probe.slice, loihi_probe.weights
            )
        ),
        synapse=synapse,
        neurons=neurons,
    )


def _decoders(probe, chip, positions):
    """What a spike of each compartment adds to a probe of NengoLoihi, shape (n, n_outputs)."""
    if probe.key != "spiked":
        raise _cannot("an output decoded from the chip's voltages")
    unit = np.eye(chip.n, dtype=bool)
    spikes = [unit[:, positions[block][part]] for block, part in zip(probe.target, probe.slice)]
    return np.asarray(probe.weight_outputs(spikes), float)
