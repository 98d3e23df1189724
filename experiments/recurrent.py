"""A recurrent network trained in snnTorch, imported from NIR, on NengoLoihi's emulator.

The network is trained on the published training set of a data set of events and compared on the
published test set.  PyTorch is in an environment of its own (``make setup-nir``).
"""

import subprocess
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from deploy.files import read_arrays, write_arrays
from deploy.tables import align_rows
from deploy.targets.registry import run_target
from deploy.terminal import show
from models.nir.graph import read_nir
from models.nir.simulator import simulate
from pipeline.kinds.nir.conversion import make_nir_spec
from pipeline.kinds.nir.importing import Stepping
from pipeline.kinds.nir.simulation import make_graph_inputs
from pipeline.settings import Settings
from pipeline.sources import load_dataset

ROOT = Path(__file__).resolve().parents[1]


def main(
    data: Annotated[Path, typer.Argument(help="Recordings with a published split.")],
    seeds: Annotated[int, typer.Option(help="Number of networks.")] = 3,
    epochs: Annotated[int, typer.Option(help="Epochs of each training.")] = 60,
    step: Annotated[float, typer.Option(help="Milliseconds of a step.")] = 20.0,
    target: Annotated[str, typer.Option(help="Target on which the networks are run.")] = "emulator",
    python: Annotated[Path, typer.Option(help="Python with snnTorch.")] = ROOT
    / ".venv-nir/bin/python",
):
    """Train a recurrent network in snnTorch, import it and compare it on the test set."""
    changes = {
        "data": {"source": str(data)},
        "input": {"kind": "events", "step": step, "refractory": 0.0},
        "presentation": {"gap": 0, "stream_length": 1},  # as PyTorch trains it
    }
    settings = Settings().with_values(changes, "recurrent")
    dataset = load_dataset(settings)
    rows = [("seed", "snnTorch", "graph", target, "points lost", "same predictions", "same spikes")]
    with tempfile.TemporaryDirectory() as folder:
        frames = Path(folder) / "frames.npz"
        images = np.moveaxis(dataset.inputs, -1, 2).reshape(*dataset.inputs.shape[:2], -1)
        parts = {name: images[getattr(dataset.split, name)] for name in ("train", "test")}
        write_arrays(frames, labels=dataset.labels[dataset.split.train], **parts)
        for seed in range(seeds):
            graph = Path(folder) / f"{seed}.nir"
            predictions = Path(folder) / f"{seed}.npz"
            script = ROOT / "experiments" / "recurrent_torch.py"
            arguments = python, script, frames, graph, predictions, seed, epochs
            subprocess.run([str(argument) for argument in arguments], check=True)
            rows.append(
                (str(seed), *compare_with_torch(graph, predictions, settings, dataset, target))
            )
    show("\n".join(align_rows(rows)))


def compare_with_torch(graph, predictions_file, settings, dataset, target) -> tuple:
    """The columns of a network: accuracies, and what snnTorch, graph and chip have in common."""
    network = read_nir(graph)
    of_torch = read_arrays(predictions_file, "train again")
    stepping = Stepping.from_settings(settings, network)
    presentation = settings.make_presentation()
    samples = dataset.inputs[np.sort(dataset.split.train)[:: len(dataset.split.train) // 48]]
    spec = make_nir_spec(network, stepping, settings.stimulus, presentation, samples)
    inputs, labels = (x[dataset.split.test] for x in (dataset.inputs, dataset.labels))
    graph_inputs = make_graph_inputs(network, inputs, settings.steps)
    outputs = simulate(network, graph_inputs, stepping.step_s, stepping.method).outputs
    share_equal = (outputs == np.moveaxis(of_torch["outputs"], 0, 1)).mean()
    chip = run_target(spec, inputs, target).predictions
    torch = of_torch["predictions"]
    accuracies = [(p == labels).mean() for p in (torch, outputs.sum(1).argmax(1), chip)]
    points_lost = 100 * (accuracies[0] - accuracies[2])
    return (
        *(f"{accuracy:.3f}" for accuracy in accuracies),
        f"{points_lost:.1f}",
        f"{(chip == torch).mean():.1%}",
        f"{share_equal:.2%}",
    )
