"""The speed of ``fast`` and of FastSimulator relative to NengoLoihi's emulator.

Both run in turns in one process, and each turn gives one ratio of processor time, because other
work on the machine slows down both.  Building and compiling are left out of the reference, and the
answers of both must be identical.
"""

import time
import warnings
from pathlib import Path
from typing import Annotated

import nengo
import numpy as np
import typer

from deploy.check.bundle import read_bundle
from deploy.errors import CheckFailed
from deploy.files import write_json
from deploy.network.build import build_nengo_network
from deploy.network.loihi_import import nengo_loihi
from deploy.network.responses import make_responses
from deploy.network.simulation import record_stream
from deploy.tables import align_rows
from deploy.targets.emulation import Emulation
from deploy.targets.registry import run_target
from experiments.results import RESULTS, Store, name_processor
from fastloihi import FastSimulator
from pipeline.commands import options
from pipeline.progress import progress

SEED = 5

# Parts into which the steps of a network are divided; ratios are medians over them.
N_TURNS = 4


def _time_call(function, *arguments):
    """The processor time that a call takes, and its result."""
    begun = time.process_time()
    result = function(*arguments)
    return time.process_time() - begun, result


def measure_on_bundle(bundle, samples: int | None = None) -> dict:
    """Run NengoLoihi's emulator and ``fast`` in turns, a stream of a bundle's samples in each.

    Parameters
    ----------
    bundle : Bundle
    samples : int, optional
        Number of samples to use, from the first on.

    Returns
    -------
    dict
        ``identical``, and the medians over turns of the ``ratio`` of processor times per sample and
        of the samples a second of both.  ``fast`` runs all streams of equal length at once.
    """
    spec = bundle.spec
    inputs = bundle.checks.inputs[:samples]
    stream_slices = spec.presentation.list_streams(len(inputs))
    fast_responses = run_target(spec, inputs, "fast", SEED)
    emulation = Emulation(spec, SEED)
    equal_parts = [
        stream for stream in stream_slices if stream.stop - stream.start == stream_slices[0].stop
    ]
    streams = np.stack([spec.flatten_samples(inputs[stream]) for stream in equal_parts])
    n_streamed = len(equal_parts) * stream_slices[0].stop
    paces = []
    identical = True
    with progress("speed", len(inputs)) as advance, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for stream in stream_slices:
            built = build_nengo_network(spec)
            samples_of_part = spec.flatten_samples(inputs[stream])
            with nengo_loihi.Simulator(built.network, target="sim", precompute=True) as sim:
                emulator_seconds, recorded = _time_call(
                    record_stream, spec, built, sim, samples_of_part
                )
            fast_seconds, _ = _time_call(emulation.run, streams)
            expected = make_responses(spec, recorded, len(samples_of_part), "emulator")
            identical &= np.array_equal(expected.decisions, fast_responses.decisions[stream])
            identical &= np.array_equal(expected.spike_hashes, fast_responses.spike_hashes[stream])
            paces.append([len(samples_of_part) / emulator_seconds, n_streamed / fast_seconds])
            advance(len(samples_of_part))
    reference, fast = np.array(paces).T
    return {
        "identical": bool(identical),
        "ratio": float(np.median(fast / reference)),
        "samples_per_second": [float(np.median(reference)), float(np.median(fast))],
        "n_samples": len(inputs),
        "turns": len(stream_slices),
        "simulated": spec.provenance.simulated,
    }


def build_channel(n=1000):
    """Two ensembles of n neurons; the first is connected to the second."""
    with nengo.Network(seed=1) as network:
        wave = nengo.Node(lambda t: np.sin(2 * np.pi * t))
        first = nengo.Ensemble(n, 1)
        second = nengo.Ensemble(n, 1)
        nengo.Connection(wave, first)
        nengo.Connection(first, second)
        return network, nengo.Probe(second, synapse=0.01)


def build_integrator(n=1000):
    """An ensemble of n neurons that is connected to itself."""
    with nengo.Network(seed=1) as network:
        pulse = nengo.Node(lambda t: float(t < 0.1))
        ensemble = nengo.Ensemble(n, 1)
        nengo.Connection(pulse, ensemble, transform=0.1, synapse=0.1)
        nengo.Connection(ensemble, ensemble, synapse=0.1)
        return network, nengo.Probe(ensemble, synapse=0.01)


def build_recurrent(n=1000):
    """n neurons with all-to-all connections."""
    weights = np.random.RandomState(3).normal(size=(n, n), scale=1e-3)
    with nengo.Network(seed=1) as network:
        neurons = nengo.Ensemble(
            n, 1, max_rates=nengo.dists.Uniform(50, 100), intercepts=nengo.dists.Uniform(-0.9, 0)
        ).neurons
        nengo.Connection(neurons, neurons, transform=weights, synapse=0.005)
        return network, nengo.Probe(neurons)


def build_learning(n=1000):
    """PES on the chip from n neurons; the host computes the error at every step."""
    with nengo.Network(seed=1) as network:
        wave = nengo.Node(lambda t: np.sin(2 * np.pi * t))
        error = nengo.Node(size_in=1)
        result = nengo.Node(size_in=1)
        ensemble = nengo.Ensemble(n, 1)
        nengo.Connection(wave, ensemble)
        learned = nengo.Connection(
            ensemble, result, function=lambda x: 0, learning_rule_type=nengo.PES(1e-3)
        )
        nengo.Connection(result, error)
        nengo.Connection(wave, error, transform=-1)
        nengo.Connection(error, learned.learning_rule)
        return network, nengo.Probe(result, synapse=0.02)


def build_convolutions(size=28):
    """Three convolutions on the chip, 3,488 compartments, after one on the host."""
    image = np.random.RandomState(0).uniform(-1, 1, size=size * size)
    with nengo.Network(seed=1) as network:
        nengo_loihi.add_params(network)
        ensembles = network.config[nengo.Ensemble]
        ensembles.neuron_type = nengo.SpikingRectifiedLinear(amplitude=1e-2)
        ensembles.max_rates = nengo.dists.Choice([100])
        ensembles.intercepts = nengo.dists.Choice([0])
        network.config[nengo.Connection].synapse = 0.005
        source = nengo.Node(image)
        shape = (size, size, 1)
        for filters, kernel_size, stride in ((4, 1, 1), (8, 3, 2), (16, 3, 1), (8, 3, 2)):
            transform = nengo.Convolution(
                filters, shape, kernel_size=(kernel_size, kernel_size), strides=(stride, stride),
                init=nengo.dists.Uniform(-1, 1),
            )  # fmt: skip
            layer = nengo.Ensemble(transform.output_shape.size, 1)
            if kernel_size == 1:
                network.config[layer].on_chip = False
            else:
                network.config[layer].block_shape = nengo_loihi.BlockShape(
                    (7, 7, 8), transform.output_shape.shape
                )
            nengo.Connection(source, layer.neurons, transform=transform)
            source = layer.neurons
            shape = transform.output_shape
        return network, nengo.Probe(source)


# Title, function that makes the network and its probe, and steps of each network to measure.
CASES = (
    ("channel, 2 ensembles of 1,000", build_channel, 4000),
    ("integrator of 1,000", build_integrator, 4000),
    ("recurrent, 1,000 x 1,000", build_recurrent, 1000),
    ("PES, 1,000 neurons", build_learning, 400),
    ("PES, 100 neurons", lambda: build_learning(100), 1000),
    ("3 convolutions, 3,488 neurons", build_convolutions, 400),
)


class _TimedSimulator:
    """A simulator, and the processor time of its emulator."""

    def __init__(self, kind, make):
        network, self.probe = make()
        self.simulator = kind(network, target="sim", seed=SEED)
        self.seconds = 0.0
        self.emulator = self.simulator.sims["emulator"]
        # As NengoLoihi calls it: one step after the other if the chip needs the host.
        alone = self.simulator.precompute or set(self.simulator.sims) == {"emulator"}
        method = "run_steps" if alone else "step"
        setattr(self.emulator, method, self._count_calls(getattr(self.emulator, method)))
        simulator = self.simulator
        simulator._runner = type(simulator._runner)(
            simulator.model, simulator.sims, simulator.precompute, simulator.timers
        )

    def _count_calls(self, method):
        def call(*arguments):
            begun = time.thread_time()
            method(*arguments)
            self.seconds += time.thread_time() - begun

        return call

    def run(self, steps):
        """Processor time of the emulator, and the probed values."""
        self.seconds = 0.0
        self.simulator.run_steps(steps)
        return self.seconds, self.simulator.data[self.probe]

    def find_state(self):
        """Voltages, currents and spike counts of all compartments."""
        compartments = self.emulator.compartment
        return [compartments.voltage, compartments.current, compartments.spike_count]


def measure_on_network(title, make, steps) -> dict:
    """Run NengoLoihi's simulator and FastSimulator on a network in turns."""
    pair = [_TimedSimulator(kind, make) for kind in (nengo_loihi.Simulator, FastSimulator)]
    ratios = []
    identical = True
    for timed in pair:
        timed.run(20)  # compiles, and fills caches
    for _ in range(N_TURNS):
        (slow, expected), (quick, values) = (timed.run(steps // N_TURNS) for timed in pair)
        identical &= np.array_equal(expected, values)
        ratios.append(slow / quick)
    identical &= all(map(np.array_equal, *(timed.find_state() for timed in pair)))
    for timed in pair:
        timed.simulator.close()
    return {
        "network": title,
        "identical": bool(identical),
        "ratio_emulator": float(np.median(ratios)),
    }


def make_cells(result: dict) -> list:
    """The rows of a result as lists of text, the heads first."""
    lines = [["", "times as fast", "identical", "samples a second"]]
    for name, row in result["bundles"].items():
        slow, fast = row["samples_per_second"]
        identical = "yes" if row["identical"] else "NO"
        paces = f"{slow:.0f}, {fast:.0f}"
        lines.append([f"fast, {name}", f"{row['ratio']:.0f}x", identical, paces])
    for row in result["networks"]:
        identical = "yes" if row["identical"] else "NO"
        ratio = f"{row['ratio_emulator']:.0f}x"
        lines.append([f"FastSimulator, {row['network']}", ratio, identical, ""])
    return lines


def main(
    bundles: Annotated[
        list[Path] | None,
        typer.Argument(help="Folders of bundles or runs (default: only networks)."),
    ] = None,
    samples: Annotated[
        int | None, typer.Option(help="Use only the first samples of each bundle's check.", min=1)
    ] = None,
    store: Store = "",
    as_json: options.Json = False,
):
    """Measure how many times as fast as NengoLoihi's emulator fast and FastSimulator are."""
    result = {"experiment": "speed", "bundles": {}, "measured": {"processor": name_processor()}}
    for path in bundles or ():
        bundle = read_bundle(options.find_bundle(path))
        kind = "image" if bundle.spec.stimulus.is_static else "events"
        result["bundles"][kind] = measure_on_bundle(bundle, samples)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result["networks"] = [measure_on_network(*case) for case in CASES]
    if store:
        write_json(RESULTS / f"{store}.json", result)
    title = "Processor time relative to NengoLoihi's emulator, medians of turns"
    options.print_result(
        result, lambda value: "\n".join([title, *align_rows(make_cells(value))]), as_json
    )
    if not all(row["identical"] for row in (*result["bundles"].values(), *result["networks"])):
        raise CheckFailed("the predictions differ from those of NengoLoihi's emulator")
