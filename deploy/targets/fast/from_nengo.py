"""Compile a Nengo network to a program of arrays and step functions.

NengoLoihi builds, splits and discretises the network and makes a model of the host before the chip
and one of the host after it.  This module reads Nengo's operators in these two models; the chip's
blocks are read in `from_loihi`.
"""

from __future__ import annotations

import threading
from typing import NamedTuple

import nengo
import nengo.builder.operator as operators
import numpy as np
from nengo.builder.neurons import SimNeurons
from nengo.builder.processes import SimProcess
from nengo.builder.transforms import ConvInc

from ...network.build import EvenSpikes, Relay
from ...network.chip import LOIHI
from ...network.discretisation import BUILD_ERRORS, cannot_build
from ...network.loihi_import import nengo_loihi
from .arrays import Network
from .from_loihi import cannot, chip_arrays
from .host_stage import HostNeurons, HostOutput

# Their step functions work on arrays of any shape and do not use random numbers.
HOST_NEURONS = (
    nengo.LIF,
    nengo.SpikingRectifiedLinear,
    EvenSpikes,
    Relay,
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
    """A compiled network that can be run for many streams in parallel.

    Attributes
    ----------
    dt : float
        Time step in seconds.
    drive : callable
        Function from frames, shape (n_frames, n_pixels), to the input of the host's input neurons,
        shape (n_frames, network.n_inputs).
    inputs : tuple of HostNeurons
        The populations whose spikes go to the chip, in the order of the network's inputs.
    network : Network
    output : HostOutput
    relays : bool
        True if the inputs spike exactly where a frame is above 0, so that ``drive`` is not needed.
    """

    dt: float
    drive: object
    inputs: tuple
    network: Network
    output: HostOutput
    relays: bool = False


def compile_network(network, source, output, dt=LOIHI.dt) -> Program:
    """Compile a feed-forward network of host input, chip and host output.

    Parameters
    ----------
    network : nengo.Network
        It is not changed.
    source : nengo.Node
        The node that presents the frames; only its size is used.
    output : nengo.Probe
        The probe of a node or neurons on the host, or of neurons on the chip.
    dt : float
        Time step in seconds.

    Returns
    -------
    Program

    Raises
    ------
    UserError
        The network has a feature that is not supported here, or NengoLoihi cannot build it.
    """
    showing = source.output
    frame = np.zeros(source.size_out)
    source.output = lambda t: frame
    try:
        model = nengo_loihi.builder.Model(dt=float(dt))
        # precompute=None: NengoLoihi detects whether the host depends on the chip.
        model.build(network, precompute=None, discretize=True)
    except BUILD_ERRORS as error:
        raise cannot_build(network, error) from error
    finally:
        source.output = showing
    _refuse_what_is_not_feed_forward(model)
    inputs = _host_inputs(model)
    chip, positions = chip_arrays(network, model, inputs)
    drive = _Drive(model.host_pre, frame, [item.drive for item in inputs])
    neurons = tuple(item.neurons for item in inputs)
    return Program(
        dt=float(dt),
        drive=drive,
        inputs=neurons,
        network=chip,
        output=_output(model, output, chip, positions),
        relays=_relays(drive, neurons, frame.size),
    )


def _refuse_what_is_not_feed_forward(model):
    if model.host2chip_pes_senders:
        raise cannot("learning on the chip")
    if not model.split.precompute:
        raise cannot("feedback from the chip through the host to the chip")
    for item in model.inputs:
        if item.permanent:
            raise cannot("spikes that are fixed when the network is built", item.label)
    for block in model.blocks:
        if np.any(block.compartment.enable_noise):
            raise cannot("noise", block)
        for synapse in block.synapses:
            if synapse.learning:
                raise cannot("learning on the chip", block)


# --- the host before the chip -----------------------------------------------------------------


class _Input(NamedTuple):
    neurons: HostNeurons
    drive: object  # the signal that depends on the frame only
    senders: list  # (SpikeInput, indices of the neurons that feed it)


def _host_inputs(model):
    """The populations on the host that send spikes to the chip."""
    host = model.host_pre
    senders = {}
    for sender, receiver in model.host2chip_senders.items():
        feeding = [c for c in _connections(host) if c.post_obj is sender]
        connection = feeding[0] if len(feeding) == 1 else None
        if connection is None or not isinstance(connection.pre_obj, nengo.ensemble.Neurons):
            raise cannot("this way from the host to the chip", sender)
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
            raise cannot("anything but one low-pass before the input neurons", population)
        drive, synapse = filters[0].input, filters[0].process
        upstream = _upstream(host, drive)
        _check_filtered_current(host, current, filters[0].output, population)
    for op in upstream:
        if isinstance(op, operators.SimPyFunc) and op.t is None:
            raise cannot("functions on the way to the input neurons", population)
        if not isinstance(op, (*_WITHOUT_MEMORY, operators.SimPyFunc, operators.TimeUpdate)):
            raise cannot("input neurons that depend on more than the frame", population)
    neurons = _neurons(host, population)._replace(synapse=synapse)
    return _Input(neurons, drive, senders)


def _neurons(host, population):
    """A population on the host without a filter on its input."""
    operator = next(
        op
        for op in host.operators
        if isinstance(op, SimNeurons) and op.output is host.sig[population]["out"]
    )
    if type(operator.neurons) not in HOST_NEURONS:
        raise cannot(f"{type(operator.neurons).__name__} neurons on the host", population)
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
    """The operators on which a signal depends within a step."""
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
    """Check that J is bias + gain * filtered, which is what `HostNeurons` computes."""
    writers = [op for op in host.operators if current.base in {s.base for s in op.incs}]
    mine = [op for op in writers if filtered in op.reads]
    rest = [op for op in writers if op not in mine]
    silent = all(isinstance(op, operators.DotInc) and op.tag.endswith("encoding") for op in rest)
    if len(mine) != 1 or not isinstance(mine[0], operators.ElementwiseInc) or not silent:
        raise cannot("more than one current into the input neurons", population)


class _Drive:
    """The host's operators between the frame and the input neurons.

    They are Nengo's own step functions, applied to one frame at a time: the product of a matrix
    with many frames at once differs in the last bits.
    """

    def __init__(self, host, frame, drives):
        self.frame = frame
        self.lock = threading.Lock()  # the signals exist once, but there may be several threads
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


def _relays(drive, neurons, size):
    """True if each input is a relay that is excited by one value of the frame at its own index."""
    if any(type(one.neuron_type) is not Relay or one.synapse is not None for one in neurons):
        return False
    if sum(one.n for one in neurons) != size:
        return False
    # The function from a frame to the drive is affine: `_host_input` refuses all others.  For each
    # pair of values, one of these frames has the first and not the second.  A drive that depends
    # on another value than its own is therefore not 0 where its own is 0, because random values do
    # not cancel.
    bits = max(1, (size - 1).bit_length())
    ones = np.arange(size) >> np.arange(bits)[:, None] & 1
    shown = np.concatenate([ones, 1 - ones])
    frames = shown * np.random.default_rng(0).uniform(1, 2, shown.shape)
    return np.array_equal(np.sign(drive(frames)), shown)


# --- from the chip to the result ----------------------------------------------------------------


def _output(model, probe, chip, positions):
    """The output stage, which computes the probe's values from the chip's spikes."""
    target = probe.target
    if not isinstance(target, (nengo.Node, nengo.ensemble.Neurons)):
        raise cannot("an output that is neither a node nor neurons", probe)
    if probe.synapse is not None or probe.sample_every is not None or probe.attr != "output":
        raise cannot("an output probe with a filter, a sampling interval or an attribute", probe)
    if probe in model.params and probe in model.objs:
        decoders = _decoders(model.objs[probe]["out"], chip, positions)
        return HostOutput(decoders=decoders, on_chip=True)

    host = model.host
    if isinstance(target, nengo.Node) and target.output is not None:
        raise cannot("a function on the output node", target)
    feeding = [c for c in _connections(host) if c.post_obj is target]
    receivers = {receiver: p for p, receiver in model.chip2host_receivers.items()}
    connection = feeding[0] if len(feeding) == 1 else None
    if connection is None or connection.pre_obj not in receivers:
        raise cannot("an output that is not fed by one connection from the chip", target)
    if connection.post_slice != slice(None) or connection.pre_slice != slice(None):
        raise cannot("an output that is fed in part", target)
    synapse = connection.synapse
    if synapse is not None and not isinstance(synapse, nengo.Lowpass):
        raise cannot(f"a synapse {synapse} on the output", target)
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
    """Contribution of each compartment's spike to a probe of NengoLoihi, shape (n, n_outputs)."""
    if probe.key != "spiked":
        raise cannot("an output decoded from the chip's voltages")
    decoders = []
    for first in range(0, chip.n, 1024):  # all at once, a large network would take gigabytes
        unit = np.eye(min(1024, chip.n - first), chip.n, first, dtype=bool)
        spikes = [unit[:, positions[block][part]] for block, part in zip(probe.target, probe.slice)]
        decoders.append(np.asarray(probe.weight_outputs(spikes), float))
    return np.concatenate(decoders)
