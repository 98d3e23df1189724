"""Hold a converted network against what it answered in PyTorch.

``python -m tests.nir_networks.compare NETWORK.nir ANSWERS.npz RUN [OPTION ...]`` converts the graph
with ``stmnist convert RUN --nir`` and the options, asks ``fast`` on the whole test set of seed 0,
and prints the figures as JSON.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from deploy.check.bundle import read_bundle
from deploy.files import read_arrays
from deploy.targets.registry import run_target
from models.nir.graph import read_nir
from models.nir.simulator import simulate
from pipeline.kinds.nir.importing import Stepping
from pipeline.kinds.nir.simulation import make_graph_inputs
from pipeline.settings import read_settings
from pipeline.sources import load_dataset


def convert(graph, run, *options):
    """Make the graph a run's network, by the command."""
    command = ["-m", "pipeline", "convert", run, "--nir", graph, "--jobs", "1", *options]
    subprocess.run([sys.executable, *map(str, command)], check=True, timeout=1800)


def figures(graph, answers, run, target="fast"):
    """What became of the network in the run.

    Parameters
    ----------
    graph, answers : path-like
        As ``train.py`` writes them.
    run : path-like
        After :func:`convert`.
    target : str

    Returns
    -------
    dict
        Accuracies and ``agreement`` on the whole test set; ``graph``, the share of values of the
        outputs that the reference simulator has as PyTorch has them, within 1e-3 of the largest.
    """
    expected = read_arrays(answers, "train again")
    settings = read_settings(Path(run) / "experiment.toml")
    dataset, network = load_dataset(settings), read_nir(graph)
    np.testing.assert_array_equal(dataset.split.test, expected["test"])
    labels, frames = dataset.labels[expected["test"]], dataset.inputs[expected["test"]]
    stepping, n = Stepping.from_settings(settings, network), len(expected["outputs"])
    shown = make_graph_inputs(network, frames[:n], settings.steps)
    outputs = simulate(network, shown, stepping.step_s, stepping.method).outputs
    outputs = outputs.reshape(expected["outputs"].shape)
    near = np.abs(outputs - expected["outputs"]) <= 1e-3 * np.abs(expected["outputs"]).max()
    bundle = read_bundle(Path(run) / "bundle")
    result = run_target(bundle.spec, frames, target).predictions
    return {
        "samples": len(labels),
        "pytorch": float((expected["predictions"] == labels).mean()),
        target: float((result == labels).mean()),
        "agreement": float((result == expected["predictions"]).mean()),
        "graph": float(near.mean()),
    }


def main(graph, answers, run, *options):
    convert(graph, run, *options)
    print(json.dumps(figures(graph, answers, run)))


if __name__ == "__main__":
    main(*sys.argv[1:])
