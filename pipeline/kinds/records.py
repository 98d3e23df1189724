"""Write and read the files of a trained network: weights, learning curve, record of accuracies."""

import csv
import importlib.metadata
import io
import math
import time
from pathlib import Path

import numpy as np

from deploy import limits
from deploy.arithmetic import select_evenly
from deploy.check.intervals import compute_wilson_interval
from deploy.errors import UserError
from deploy.files import open_regular, read_arrays, replacing, reporting_os_errors, write_arrays
from pipeline.progress import progress
from pipeline.recordings.dataset import Dataset
from pipeline.recordings.splits import PARTS
from pipeline.storage.run_folder import DELETE_ITS_FOLDER

# Maximum number of test samples for the learning curve.
MAX_CURVE_SAMPLES = 500

# Samples whose outputs are in memory at a time.
SAMPLES_AT_ONCE = 2000


def time_training(name: str, epochs: int, train) -> tuple:
    """Run a training with a progress bar; return the network and the seconds that it took.

    Parameters
    ----------
    name : str
        Name of the network.
    epochs : int
    train : callable
        ``train(advance)`` returns the network, and calls ``advance(1, note)`` after each epoch.
    """
    with progress(f"train {name}", epochs, "epochs") as advance:
        begun = time.perf_counter()
        trained = train(advance)
        return trained, time.perf_counter() - begun


def select_curve_samples(dataset: Dataset):
    """Samples for the learning curve: validation samples or, without these, some test samples.

    No result depends on them.
    """
    if (validation := dataset.subset("validation")) is not None:
        return validation
    index = select_evenly(dataset.split.test, MAX_CURVE_SAMPLES)
    return (dataset.inputs[index], dataset.labels[index]) if len(index) else None


def write_network(folder: Path, trained, on_test: bool):
    """Write weights and history; delete the records first, because they mark them as complete.

    Parameters
    ----------
    folder : Path
    trained : TrainedNetwork or TrainedOnEvents
        A network on images or on events.
    on_test : bool
        True if the learning curve is that of test samples, not of held-out training samples.
    """
    for record in ("metrics.json", "training.json"):
        (folder / record).unlink(missing_ok=True)
    write_arrays(folder / "weights.npz", **trained.weights)
    history = trained.history
    if on_test:
        history = [_name_test_columns(row) for row in history]
    write_history(folder / "history.csv", history)


def _name_test_columns(row):
    """A row of a history whose validation samples are those of the test set."""
    return {name.replace("val_", "test_"): value for name, value in row.items()}


def write_history(path, history: list):
    """Write the history of a training.

    Parameters
    ----------
    path : path-like
    history : list of dict
        One dict per epoch, all with the same keys.  If it is empty, as for a network that was not
        trained here, an existing file is deleted.
    """
    if not history:
        Path(path).unlink(missing_ok=True)
        return
    with replacing(path, "w") as file:
        writer = csv.DictWriter(file, fieldnames=list(history[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(history)


def read_history(path) -> list:
    """Read the file of :func:`write_history`; all values are floats.

    Raises
    ------
    UserError
        The file cannot be read, or is not a table of numbers with an accuracy and at least one row.
    """
    try:
        with (
            reporting_os_errors(path, "cannot read", DELETE_ITS_FOLDER),
            open_regular(path, "r", newline="", encoding="utf-8") as file,
        ):
            text = file.read(limits.SETTINGS_BYTES * 16)
        table = csv.DictReader(io.StringIO(text, newline=""), strict=True)
        rows = [dict(zip(row, map(float, row.values()), strict=True)) for row in table]
    except (ValueError, TypeError, csv.Error) as error:
        raise UserError(f"{path}: not a learning curve ({error}); {DELETE_ITS_FOLDER}") from error
    finite = all(math.isfinite(value) for row in rows for value in row.values())
    if not (rows and finite and {"epoch", "accuracy"} <= set(rows[0])):
        raise UserError(f"{path}: not a learning curve, or one with gaps; {DELETE_ITS_FOLDER}")
    return rows


def read_weights(folder: Path, shapes: dict) -> dict:
    """The trained arrays in a network's folder.

    Parameters
    ----------
    folder : Path
    shapes : dict of str to tuple of int
        The shape of each array.

    Raises
    ------
    UserError
        The arrays are missing, damaged, or of other shapes.
    """
    path = folder / "weights.npz"
    weights = read_arrays(path, DELETE_ITS_FOLDER)
    if {name: array.shape for name, array in weights.items()} != shapes:
        raise UserError(
            f"{path}: not the weights of the architecture in the settings; {DELETE_ITS_FOLDER}"
        )
    return weights


def list_training_versions() -> dict:
    """Versions of the packages that trained networks need."""
    names = ("tensorflow", "nengo-dl")
    return {name.replace("-", "_"): importlib.metadata.version(name) for name in names}


def make_training_record(trained, dataset: Dataset, seconds: float, versions: dict) -> dict:
    """The record of a network: its accuracy on each part of the split.

    Parameters
    ----------
    trained
        With ``compute_logits`` and ``history``.
    dataset : Dataset
    seconds : float
        Time of the training.
    versions : dict
    """
    inputs = dataset.inputs
    predicted = []
    for start in range(0, len(inputs), SAMPLES_AT_ONCE):
        logits = trained.compute_logits(inputs[start : start + SAMPLES_AT_ONCE])
        predicted.append(np.argmax(logits, axis=1))
    right = np.concatenate(predicted) == dataset.labels
    return {
        **measure_accuracies(right, dataset),
        "epochs": len(trained.history),
        "seconds": seconds,
        "versions": versions,
    }


def measure_accuracies(right, dataset: Dataset) -> dict:
    """Accuracy on each set of the split, and the interval of the last one.

    Parameters
    ----------
    right : ndarray of bool, shape (n_samples,)
        Whether the prediction of each sample of the dataset is right.
    dataset : Dataset
    """
    of_parts = {part: right[dataset.split.get_indices(part)] for part in PARTS}
    of_parts = {part: values for part, values in of_parts.items() if len(values)}
    last = list(of_parts)[-1]  # the validation samples if there is no test set, as in a sweep
    n_samples = len(of_parts[last])
    n_right = int(of_parts[last].sum())
    return {
        "simulated": dataset.recordings.source.simulated,
        "accuracy": {part: float(values.mean()) for part, values in of_parts.items()},
        f"{last}_accuracy_ci95": list(compute_wilson_interval(n_right, n_samples)),
        f"n_{last}": n_samples,
    }


def describe_accuracy(name: str, metrics: dict) -> str:
    """A line about the accuracy of a network."""
    part = list(metrics["accuracy"])[-1]
    return (
        f"{name}: {part} accuracy {metrics['accuracy'][part]:.3f} on {metrics[f'n_{part}']} "
        f"samples, {metrics['seconds']:.0f} s"
    )
