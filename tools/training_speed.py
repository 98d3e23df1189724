"""Speed of three ways to train the rate-based network of the paper's recipe, in one process.

``python -m tools.training_speed``; with ``--slayer`` the time of an epoch of SLAYER.
"""

import contextlib
import resource
import time
from dataclasses import replace
from typing import Annotated

import nengo
import numpy as np
import typer

from deploy.tables import aligned
from models.cnn import get_weights
from models.keras2 import tf
from pipeline.commands.main import run_tool
from pipeline.data.dataset import Dataset
from pipeline.data.frames import bin_events
from pipeline.progress import progress
from pipeline.settings import Settings
from pipeline.training import nengodl
from pipeline.training.networks import build_rate_network, epochs_of, make_deterministic, snn_recipe
from pipeline.training.slayer import Trainer

WAYS = ("nengodl", "keras", "ours")
WHOLE = 5562
"""Training samples of a split."""


def measure_simulated(samples: int, networks: int, rounds: int, jobs: int = 1) -> dict:
    """:func:`measure` with the default settings on simulated recordings.

    Parameters
    ----------
    samples : int
        Recordings of each digit; 0 for 6,953 in all.
    networks, rounds
        As in :func:`measure`.
    jobs : int
        Processes for recordings that are not in the cache.
    """
    settings = Settings().with_values({"data": {"samples_per_digit": samples}}, "--samples")
    data = Dataset.of(settings, jobs).part("train")
    with progress("training speed", len(WAYS) * (rounds + 1)) as advance:
        return measure(settings, data, networks, rounds, advance)


def measure(settings: Settings, data, networks: int = 5, rounds: int = 3, advance=None) -> dict:
    """Time epochs of NengoDL's fit, of Keras's fit, and of this project's.

    The three ways are run alternately, so that other work of the machine affects all of them.  The
    time for building and compiling (the first epoch) is reported separately.

    Parameters
    ----------
    settings : Settings
    data : (images, labels)
        Training samples, the same for every network.
    networks : int
        Number of networks that are trained one after the other.
    rounds : int
        Number of timed epochs.
    advance : callable, optional
        ``advance(1, note)`` after each turn.

    Returns
    -------
    dict
        ``seconds_per_epoch`` (median, of all networks), ``first_epoch_seconds`` and
        ``ratio_to_nengodl`` (median of the rounds) by way; ``samples``, ``networks``, ``rounds``.
    """
    settings = replace(settings, snn=replace(settings.snn, recipe="paper"))
    recipe = snn_recipe(settings.snn)
    times = {way: [] for way in WAYS}
    with contextlib.ExitStack() as simulators:
        turns = {
            "nengodl": _nengodl_turn(settings, data, networks, recipe, simulators),
            "keras": _keras_turn(settings, data, networks, recipe),
            "ours": _our_turn(settings, data, networks, recipe, rounds),
        }
        for number in range(rounds + 1):
            for way in WAYS:
                begun = time.perf_counter()
                turns[way]()
                times[way].append(time.perf_counter() - begun)
                if advance is not None:
                    advance(1, f"{way}, round {number}")
    yardstick = np.array(times["nengodl"][1:])
    return {
        "samples": len(data[0]),
        "networks": networks,
        "rounds": rounds,
        "first_epoch_seconds": {way: times[way][0] for way in WAYS},
        "seconds_per_epoch": {way: float(np.median(times[way][1:])) for way in WAYS},
        "ratio_to_nengodl": {
            way: float(np.median(yardstick / np.array(times[way][1:]))) for way in WAYS
        },
    }


def speed_text(result: dict) -> str:
    """The measurement as a table."""
    titles = {
        "nengodl": "NengoDL's fit, one by one",
        "keras": "Keras's fit, one by one",
        "ours": "ours, one by one",
    }
    rows = [["way", "seconds", "times as fast"]]
    for way in WAYS:
        seconds, ratio = result["seconds_per_epoch"][way], result["ratio_to_nengodl"][way]
        rows.append([titles[way], f"{seconds:.2f}", f"{ratio:.1f}"])
    heading = (
        f"Training {result['networks']} networks on {result['samples']} samples, one epoch; "
        f"medians of {result['rounds']} rounds in which the ways took turns"
    )
    return "\n".join([heading, *aligned(rows)])


@contextlib.contextmanager
def open_trainer(settings: Settings, weights: dict, data, batch: int):
    """Open NengoDL's own training of the rate-based network, for comparison.

    Parameters
    ----------
    settings : Settings
    weights : dict
        Initial weights.
    data : (images, labels)
        Samples beyond the last full batch are not used.
    batch : int

    Yields
    ------
    callable
        ``train_epoch() -> loss``; the simulator stays open between calls.
    """
    converter, source, output = nengodl._convert(settings, weights, nengo.LIFRate, None, False)
    count = len(data[0]) // batch * batch
    images = np.asarray(data[0][:count], np.float32).reshape(count, 1, -1)
    labels = np.asarray(data[1][:count]).reshape(count, 1, 1)
    with nengodl.nengo_dl.Simulator(
        converter.net, minibatch_size=batch, progress_bar=False, seed=settings.seed
    ) as simulator:
        simulator.compile(
            tf.keras.optimizers.RMSprop(settings.cnn.learning_rate),
            loss={output: tf.keras.losses.SparseCategoricalCrossentropy(from_logits=True)},
        )

        def train_epoch():
            history = simulator.fit({source: images}, {output: labels}, verbose=0).history
            return history["loss"][-1]

        yield train_epoch


def measure_slayer(samples: int = 320, conv_scale: float = 100.0, rounds: int = 3) -> dict:
    """Time epochs of SLAYER with the default settings, with the initial weights at first.

    Parameters
    ----------
    samples : int
        Training samples; the time is stated for 5,562.
    conv_scale : float
        Scale of the initial weights of convolutions.
    rounds : int
        Number of timed epochs, after one batch that compiles.

    Returns
    -------
    dict
        ``processor_seconds`` of an epoch of 5,562 samples (all rounds), ``compile_seconds``,
        ``peak_mb`` (of this process, the recordings included).
    """
    settings = Settings()
    data = Dataset.of(settings)
    train = data.split.train[:samples]
    chosen = replace(settings.slayer, conv_scale=conv_scale)
    frames = bin_events(data.recordings, chosen.bins)[train]
    trainer = Trainer(chosen, frames, data.labels[train], 0, data.recordings.sensor.duration_s)
    begun = time.process_time()
    trainer.count(range(1))
    trainer.network.gradients(frames[:1], trainer.desired[:1])
    compiling, seconds = time.process_time() - begun, []
    for number in range(rounds):
        begun = time.process_time()
        trainer.epoch(np.arange(len(train)), number)
        seconds.append((time.process_time() - begun) * WHOLE / len(train))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"processor_seconds": seconds, "compile_seconds": compiling, "peak_mb": peak}


def _models(settings, networks):
    make_deterministic(settings.seed)
    return [build_rate_network(settings) for _ in range(networks)]


def _nengodl_turn(settings, data, networks, recipe, simulators):
    trainers = [
        simulators.enter_context(
            open_trainer(settings, get_weights(model), data, recipe.batch_size)
        )
        for model in _models(settings, networks)
    ]
    return lambda: [train_epoch() for train_epoch in trainers]


def _keras_turn(settings, data, networks, recipe):
    models = _models(settings, networks)
    for model in models:
        model.compile(
            tf.keras.optimizers.RMSprop(recipe.learning_rate),
            tf.keras.losses.SparseCategoricalCrossentropy(from_logits=True),
        )
    return lambda: [
        model.fit(*data, batch_size=recipe.batch_size, epochs=1, verbose=0) for model in models
    ]


def _our_turn(settings, data, networks, recipe, rounds):
    recipe = replace(recipe, epochs=rounds + 1)
    trainings = [
        epochs_of(model, recipe, data, seed)
        for seed, model in enumerate(_models(settings, networks))
    ]
    return lambda: [next(training) for training in trainings]


def main(
    networks: Annotated[int, typer.Option(help="Number of networks to train.", min=1)] = 5,
    rounds: Annotated[int, typer.Option(help="Number of timed epochs.", min=1)] = 3,
    samples: Annotated[
        int, typer.Option(help="Simulated recordings of each digit; 0 for 6,953 in all.", min=0)
    ] = 0,
    slayer: Annotated[bool, typer.Option(help="Time an epoch of SLAYER instead.")] = False,
):
    """Time the training of the rate-based network: NengoDL's fit, Keras's, and this project's."""
    if slayer:
        for name, value in measure_slayer(rounds=rounds).items():
            print(name, np.round(value, 2))
        return
    print(speed_text(measure_simulated(samples, networks, rounds)))


if __name__ == "__main__":
    run_tool(main)
