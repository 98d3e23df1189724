"""Run a compiled network on streams of samples, several streams in parallel."""

from __future__ import annotations

import collections
import concurrent.futures
import warnings
from dataclasses import replace
from typing import Iterator, NamedTuple

import numpy as np

from ...errors import UserError
from ...network.build import build
from ...network.responses import Responses, decoded, read_output, spike_hash
from ...network.spec import DT
from . import kernel_numpy
from .arrays import OVERFLOWS, State
from .from_nengo import Program, compile_network
from .host_stage import HostSide, OutputStage

KERNELS = ("numba", "numpy")
MEMORY = 32 << 20
"""Maximum memory in bytes for the spikes of one call of a kernel, about a tenth of a thread's."""


class StreamOutputs(NamedTuple):
    """Output, spike counts and overflows of a batch of streams.

    Attributes
    ----------
    output : (n_streams, n_samples, period, n_outputs) array
        Values of the output probe at every step of every sample, including its gap.
    counts : dict of str to (n_streams, n_samples, n_neurons) int array
        Number of spikes of each neuron of each layer during each sample and its gap.
    overflows : (n_layers, 3) int array
        See `arrays.Steps`.
    """

    output: np.ndarray
    counts: dict
    overflows: np.ndarray


class Emulation:
    """A program and the kernel that runs it.

    Parameters
    ----------
    program : Program
    kernel : str, optional
        ``"numba"`` or ``"numpy"``; default: Numba where it is installed.

    Raises
    ------
    UserError
        The kernel does not exist or is not installed.
    """

    def __init__(self, program: Program, kernel=None):
        self.program = program
        self.kernel = _kernel(kernel)(program.network, program.output.decoders)

    def run(self, samples, steps, gap, watch=None, memory=MEMORY) -> StreamOutputs:
        """Present streams of samples, each to a fresh network.

        Parameters
        ----------
        samples : (n_streams, n_samples, size) or (n_streams, n_samples, steps, size) array
            One frame that is constant for all steps of its sample, or one frame per step.
        steps, gap : int
            Number of steps of each sample, and of the blank frame before it.
        watch : callable, optional
            Called after each sample of the streams with every spike of each layer: a dict of
            str to uint8 arrays (n_streams, period, n_neurons / 8), packed by `numpy.packbits`.
        memory : int
            Maximum memory in bytes for the spikes of one call of the kernel; the result does not
            depend on it.

        Returns
        -------
        StreamOutputs
        """
        program, network = self.program, self.program.network
        samples = np.asarray(samples)
        n_streams, n_samples, size = samples.shape[0], samples.shape[1], samples.shape[-1]
        state = State.fresh(network, n_streams)
        host = HostSide(program, n_streams, size)
        stage = OutputStage(program.output, n_streams, program.dt)
        at_once = max(1, memory // self.bytes_per_step(n_streams))
        overflows, shown = 0, []
        for index in range(n_samples):
            host.take(samples[:, index])
            outputs, counts, packed = [], collections.Counter(), collections.defaultdict(list)
            for first in range(0, steps + gap, at_once):
                last = min(first + at_once, steps + gap)
                inputs = host.spikes(first - gap, last - gap)
                done = self.kernel.advance(state, inputs)
                outputs.append(stage.advance(done.spikes, done.decoded))
                overflows = overflows + done.overflows
                for label, n in self._counts(inputs, done, outputs[-1]):
                    counts[label] = counts[label] + n
                if watch is not None:
                    for label, spikes in self._spikes(inputs, done, outputs[-1]):
                        packed[label].append(np.packbits(spikes, axis=2))
            shown.append((np.concatenate(outputs, axis=1), counts))
            if watch is not None:
                watch({label: np.concatenate(parts, axis=1) for label, parts in packed.items()})
        return StreamOutputs(
            output=np.stack([output for output, _ in shown], axis=1),
            counts={k: np.stack([c[k] for _, c in shown], axis=1) for k in shown[0][1]},
            overflows=overflows,
        )

    def bytes_kept(self, period):
        """Approximate memory for the results of a sample."""
        network, outputs = self.program.network, self.program.output.decoders.shape[1]
        return 8 * outputs * period + 4 * (network.n + network.n_inputs)

    def bytes_per_step(self, n_streams):
        """Approximate memory for one step of some streams in a call of the kernel."""
        network = self.program.network
        return n_streams * (network.n + network.n_inputs) * self.kernel.bytes_per_spike

    def _counts(self, inputs, done, output):
        """(label, spikes of each stream's neurons) of every layer in these steps."""
        for label, part in self._inputs():
            yield label, inputs[:, :, part].sum(axis=1, dtype=np.int32)
        for layer in self.program.network.layers:
            yield layer.label, layer.of(done.counts)
        if self.program.output.neurons is not None:
            yield self.program.output.neurons.label, np.count_nonzero(output, axis=1)

    def _spikes(self, inputs, done, output):
        """(label, spikes of each stream, step and neuron) of every layer in these steps."""
        for label, part in self._inputs():
            yield label, inputs[:, :, part]
        for layer in self.program.network.layers:
            yield layer.label, layer.of(done.spikes)
        if self.program.output.neurons is not None:
            yield self.program.output.neurons.label, output != 0

    def _inputs(self):
        start = 0
        for neurons in self.program.inputs:
            yield neurons.label, slice(start, start + neurons.n)
            start += neurons.n


def _kernel(name):
    if name not in (None, *KERNELS):
        raise UserError(f"no kernel {name!r}; the kernels are {', '.join(KERNELS)}")
    if name == "numpy":
        return kernel_numpy.Kernel
    try:
        from . import kernel_numba
    except ImportError as error:
        if name == "numba":
            raise UserError(
                f"the kernel 'numba' needs Numba ({error}): pip install numba"
            ) from None
        return kernel_numpy.Kernel
    return kernel_numba.Kernel


def compile_spec(spec, seed=0) -> Program:
    """Compile the network of a bundle."""
    built = build(spec, seed)
    source = next(node for node in built.network.all_nodes if node.output is built.feed)
    return compile_network(built.network, source, built.output, DT)


def run_fast(spec, streams, seed=0, kernel=None, threads=1, memory=MEMORY) -> Iterator[Responses]:
    """Run NengoLoihi's emulator, with identical integers and spikes, on many streams at once.

    Parameters
    ----------
    spec : NetworkSpec
    streams : iterable of array
        Each as returned by `Stimulus.flat`.
    seed : int
    kernel : str, optional
        See `Emulation`.
    threads : int
        Number of batches of streams to run in parallel.
    memory : int
        Maximum memory in bytes for the spikes of a batch.

    Yields
    ------
    Responses
        The responses to each stream, in order.  They do not depend on the batches.
    """
    emulation = Emulation(compile_spec(spec, seed), kernel)
    shown, gap = spec.presentation.steps, spec.presentation.gap
    network = emulation.program.network
    overflows = np.zeros((len(network.layers), len(OVERFLOWS)), np.int64)

    def fitting(n_samples):
        """Number of streams of some length that fit into the memory."""
        held = (
            emulation.bytes_per_step(1) * (shown + gap)
            + emulation.bytes_kept(shown + gap) * n_samples
        )
        return max(1, memory // held)

    def run(batch):
        hashes = []

        def watch(packed):
            rows = [packed[name] for name in spec.spiking_layers]
            hashes.append([spike_hash(layers) for layers in zip(*rows)])

        return emulation.run(np.stack(batch), shown, gap, watch, memory), np.transpose(hashes)

    try:
        for recording, hashes in _in_order(run, _batches(streams, fitting), threads):
            overflows += recording.overflows
            for index, output in enumerate(recording.output):
                counts = {name: recording.counts[name][index] for name in spec.spiking_layers}
                answer = read_output(spec, decoded(spec, output[:, gap:]), counts)
                yield replace(answer, spike_hashes=hashes[index])
    finally:
        _warn_of(overflows, network.layers)


def _batches(streams, fitting):
    """Lists of consecutive streams of equal length, at most ``fitting`` of that length."""
    batch = []
    for stream in streams:
        if batch and (len(batch) == fitting(len(stream)) or len(stream) != len(batch[0])):
            yield batch
            batch = []
        batch.append(stream)
    if batch:
        yield batch


def _in_order(function, items, threads):
    """``map`` in several threads, which only runs ahead as far as the threads need."""
    if threads == 1:
        yield from map(function, items)
        return
    with concurrent.futures.ThreadPoolExecutor(threads) as pool:
        waiting = collections.deque()
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _warn_of(overflows, layers):
    for layer, counts in zip(layers, overflows):
        if counts.any():
            found = ", ".join(f"{n} in {name}" for n, name in zip(counts, OVERFLOWS) if n)
            message = f"layer {layer.label!r}: overflows of the chip's integers: {found}"
            warnings.warn(message, RuntimeWarning, stacklevel=3)
