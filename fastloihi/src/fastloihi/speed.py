"""The speed of `FastSimulator` relative to NengoLoihi's `Simulator`: ``python -m fastloihi.speed``.

Both run alternately in one process, and each turn gives one ratio of processor time, because other
work on the machine slows down both.  Building and compiling are not included.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings

import nengo
import nengo_loihi
import numpy as np

from .simulator import FastSimulator

TURNS = 4
SEED = 5


def channel(n=1000):
    """Two ensembles of n neurons; the first is connected to the second."""
    with nengo.Network(seed=1) as network:
        wave = nengo.Node(lambda t: np.sin(2 * np.pi * t))
        first, second = nengo.Ensemble(n, 1), nengo.Ensemble(n, 1)
        nengo.Connection(wave, first)
        nengo.Connection(first, second)
        return network, nengo.Probe(second, synapse=0.01)


def integrator(n=1000):
    """An ensemble of n neurons that is connected to itself."""
    with nengo.Network(seed=1) as network:
        pulse = nengo.Node(lambda t: float(t < 0.1))
        ensemble = nengo.Ensemble(n, 1)
        nengo.Connection(pulse, ensemble, transform=0.1, synapse=0.1)
        nengo.Connection(ensemble, ensemble, synapse=0.1)
        return network, nengo.Probe(ensemble, synapse=0.01)


def recurrent(n=1000):
    """n neurons with all-to-all connections."""
    weights = np.random.RandomState(3).normal(size=(n, n), scale=1e-3)
    with nengo.Network(seed=1) as network:
        neurons = nengo.Ensemble(
            n,
            1,
            max_rates=nengo.dists.Uniform(50, 100),
            intercepts=nengo.dists.Uniform(-0.9, 0),
        ).neurons
        nengo.Connection(neurons, neurons, transform=weights, synapse=0.005)
        return network, nengo.Probe(neurons)


def learning(n=1000):
    """PES on the chip from n neurons; the host computes the error at every step."""
    with nengo.Network(seed=1) as network:
        wave = nengo.Node(lambda t: np.sin(2 * np.pi * t))
        error, result = nengo.Node(size_in=1), nengo.Node(size_in=1)
        ensemble = nengo.Ensemble(n, 1)
        nengo.Connection(wave, ensemble)
        learned = nengo.Connection(
            ensemble, result, function=lambda x: 0, learning_rule_type=nengo.PES(1e-3)
        )
        nengo.Connection(result, error)
        nengo.Connection(wave, error, transform=-1)
        nengo.Connection(error, learned.learning_rule)
        return network, nengo.Probe(result, synapse=0.02)


def convolutions(size=28):
    """Three convolutions on the chip, 3,488 compartments, after one on the host."""
    image = np.random.RandomState(0).uniform(-1, 1, size=size * size)
    with nengo.Network(seed=1) as network:
        nengo_loihi.add_params(network)
        ensembles = network.config[nengo.Ensemble]
        ensembles.neuron_type = nengo.SpikingRectifiedLinear(amplitude=1e-2)
        ensembles.max_rates = nengo.dists.Choice([100])
        ensembles.intercepts = nengo.dists.Choice([0])
        network.config[nengo.Connection].synapse = 0.005
        source, shape = nengo.Node(image), (size, size, 1)
        for filters, kernel, stride in ((4, 1, 1), (8, 3, 2), (16, 3, 1), (8, 3, 2)):
            transform = nengo.Convolution(
                filters, shape, kernel_size=(kernel, kernel), strides=(stride, stride),
                init=nengo.dists.Uniform(-1, 1),
            )  # fmt: skip
            layer = nengo.Ensemble(transform.output_shape.size, 1)
            if kernel == 1:
                network.config[layer].on_chip = False
            else:
                network.config[layer].block_shape = nengo_loihi.BlockShape(
                    (7, 7, 8), transform.output_shape.shape
                )
            nengo.Connection(source, layer.neurons, transform=transform)
            source, shape = layer.neurons, transform.output_shape
        return network, nengo.Probe(source)


# Title, function that makes the network and its probe, and steps of each network to measure.
CASES = (
    ("channel, 2 ensembles of 1,000", channel, 4000),
    ("integrator of 1,000", integrator, 4000),
    ("recurrent, 1,000 x 1,000", recurrent, 1000),
    ("PES, 1,000 neurons", learning, 400),
    ("PES, 100 neurons", lambda: learning(100), 1000),
    ("3 convolutions, 3,488 neurons", convolutions, 400),
)


class _Timed:
    """A simulator, and the processor time of its emulator and of Nengo's simulators of the host."""

    def __init__(self, kind, make):
        network, self.probe = make()
        self.simulator = kind(network, target="sim", seed=SEED)
        self.emulator = self.host = 0.0
        for name, part in self.simulator.sims.items():
            # As NengoLoihi calls them: one step after the other if the chip needs the host.
            alone = self.simulator.precompute or set(self.simulator.sims) == {"emulator"}
            method = "run_steps" if alone else "step"
            setattr(part, method, self._counted(getattr(part, method), name))
        self.simulator._runner = type(self.simulator._runner)(
            self.simulator.model,
            self.simulator.sims,
            self.simulator.precompute,
            self.simulator.timers,
        )

    def _counted(self, method, name):
        field = "emulator" if name == "emulator" else "host"

        def call(*arguments):
            begun = time.thread_time()
            method(*arguments)
            setattr(self, field, getattr(self, field) + time.thread_time() - begun)

        return call

    def run(self, steps):
        """Seconds of the emulator, of the host and in total; and the probed values."""
        self.emulator = self.host = 0.0
        begun = time.thread_time()
        self.simulator.run_steps(steps)
        whole = time.thread_time() - begun
        return np.array([self.emulator, self.host, whole]), self.simulator.data[self.probe]

    def state(self):
        compartments = self.simulator.sims["emulator"].compartment
        return [compartments.voltage, compartments.current, compartments.spike_count]


def measure(cases=CASES, turns=TURNS) -> dict:
    """Run NengoLoihi's simulator and the fast one alternately on some networks.

    Parameters
    ----------
    cases : sequence of (str, callable, int)
        As `CASES`.
    turns : int
        Number of parts into which the steps of a case are divided; ratios are medians over them.

    Returns
    -------
    dict
        Ready for JSON: ``identical``, ``turns``, and a row for each network.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rows = [_measure(*case, turns) for case in cases]
    return {"identical": all(row["identical"] for row in rows), "turns": turns, "rows": rows}


def _measure(title, make, steps, turns):
    pair = [_Timed(kind, make) for kind in (nengo_loihi.Simulator, FastSimulator)]
    seconds, identical = [], True
    for simulator in pair:
        simulator.run(20)  # compiles, and fills caches
    for _ in range(turns):
        (plain, expected), (fast, found) = (one.run(steps // turns) for one in pair)
        identical &= np.array_equal(expected, found)
        seconds.append((plain, fast))
    states = [one.state() for one in pair]
    identical &= all(np.array_equal(a, b) for a, b in zip(*states))
    for one in pair:
        one.simulator.close()
    plain, fast = np.moveaxis(np.array(seconds), 1, 0)
    emulator, host, whole = np.median(fast, axis=0)
    return {
        "network": title,
        "compartments": len(states[0][0]),
        "steps": steps // turns * turns,
        "identical": bool(identical),
        "ratio_emulator": float(np.median(plain[:, 0] / fast[:, 0])),
        "ratio_whole": float(np.median(plain[:, 2] / fast[:, 2])),
        "microseconds_a_step": float(1e6 * emulator * turns / steps),
        "share_of_host": float(host / whole),
        "share_of_emulator": float(emulator / whole),
    }


def text_of(result: dict) -> str:
    """The result of `measure` as a table."""
    lines = [
        "FastSimulator beside NengoLoihi's Simulator: how many times as fast, in",
        f"processor time of one thread, medians of {result['turns']} turns",
        "identical: "
        + ("every voltage, current and spike" if result["identical"] else "NO: they differ"),
        f"{'network':30}{'steps':>6}{'emulator':>10}{'run':>8}{'us/step':>9}{'host':>6}"
        f"{'emulator':>10}",
    ]
    lines += [
        f"{row['network']:30}{row['steps']:6}{row['ratio_emulator']:9.0f}x"
        f"{row['ratio_whole']:7.1f}x{row['microseconds_a_step']:9.1f}"
        f"{row['share_of_host']:6.0%}{row['share_of_emulator']:10.0%}"
        for row in result["rows"]
    ]
    return "\n".join([*lines, "host is Nengo's; the last two: shares of the whole run"])


def main():
    """Measure, print, and exit with status 1 if a result differs from NengoLoihi's."""
    parser = argparse.ArgumentParser(prog="python -m fastloihi.speed", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    options = parser.parse_args()
    result = measure()
    print(json.dumps(result, indent=2) if options.json else text_of(result))
    sys.exit(not result["identical"])


if __name__ == "__main__":
    main()
