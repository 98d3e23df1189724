"""A user's Keras model instead of the CNN."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from deploy.check.intervals import wilson_interval
from deploy.errors import UserError
from deploy.files import sha256_of
from models.keras_model import read_keras
from pipeline.data.dataset import Dataset
from pipeline.roads.road import imported_file
from pipeline.settings import Settings

# Minimum accuracy of a user's model, as a share of the range from chance to 1. The best of 30
# networks of three layers with Keras's initial weights had 0.06 by chance, on ten classes.
LEAST_KNOWN = 0.15


# The remedy for a model that has changed since it was imported.
GIVE_MODEL_AGAIN = (
    "give it again with 'stmnist convert RUN --model FILE' (--retrain too if you gave it)"
)

# Limits of the difference between the largest and smallest logit of a sample.
SPREAD = (1e-3, 1e4)


def settings_of_model(path: Path, retrain: bool = False) -> dict:
    """Changes of the settings with which a user's Keras model replaces the CNN.

    Parameters
    ----------
    path : path-like
    retrain : bool
        Train the model further with rate-based LIF neurons.

    Raises
    ------
    UserError
        The file cannot be read, is not a Keras model, or does not fit any chip.
    """
    path = Path(path)
    model, sha256 = read_keras(path), sha256_of(path)
    rates = Settings().snn.max_rates[: max(len(model.architecture.spiking), 1)]
    return {
        "input": {"kind": "image"},
        "nir": {"file": "", "sha256": ""},
        "cnn": {
            "model": str(path.absolute()),
            "model_sha256": sha256,
            "architecture": str(model.architecture),
        },
        "snn": {"recipe": "loihi" if retrain else "as-is", "max_rates": rates},
    }


def copy_of_model(folder: Path, settings: Settings) -> Path:
    """The run's copy of the user's model, in the folder of the CNN."""
    return folder / f"model{Path(settings.cnn.model).suffix.lower()}"


def take_over(folder: Path, settings: Settings, dataset: Dataset) -> tuple:
    """Use the user's model instead of the CNN; it must be better than chance.

    The run's copy is used if the user's file has changed or cannot be read, for example on another
    machine.

    Parameters
    ----------
    folder : Path
        Folder of the CNN.
    settings : Settings
        Settings from :func:`settings_of_model`.
    dataset : Dataset

    Returns
    -------
    Path, TrainedCNN, sequence of str
        The file that was read, the network, and messages about it.

    Raises
    ------
    UserError
        The model cannot be read or has changed, and the run has no copy; or it is not better than
        chance.
    """
    copy = copy_of_model(folder, settings)
    path = imported_file(settings.cnn.model, settings.cnn.model_sha256, copy)
    model = read_keras(path)
    imported = settings.cnn.model_sha256, settings.cnn.architecture
    if (sha256_of(path), str(model.architecture)) != imported:
        raise UserError(f"{path}: has changed; {GIVE_MODEL_AGAIN}")
    from pipeline.training.networks import TrainedCNN, one_thread_each

    one_thread_each()
    images, labels = dataset.part("train")
    weights, scale = _usual_scale(settings, model.weights, images)
    taken = TrainedCNN(settings, weights)
    right = int((taken.logits(images).argmax(1) == labels).sum())
    likeliest = np.bincount(labels).max() / len(labels)
    if wilson_interval(right, len(labels))[0] <= likeliest + LEAST_KNOWN * (1 - likeliest):
        raise UserError(
            f"{path}: hardly better than chance on this run's training samples (accuracy "
            f"{right / len(labels):.3f}, {likeliest:.3f} by always answering the same); "
            "train it on tactile images as [image] in the settings makes them, with the classes in "
            "the same order"
        )
    notes = model.notes if scale == 1 else (*model.notes, _scale_note(scale))
    return path, taken, notes


def _usual_scale(settings, weights, images) -> tuple:
    """Weights with logits of a usual size, and the factor that was applied to the output layer.

    The largest logit remains the largest.  The factor is a power of two, which does not round.
    """
    from pipeline.training.networks import TrainedCNN

    logits = TrainedCNN(settings, weights).logits(images).astype(float)
    spread = float(np.median(logits.max(axis=1) - logits.min(axis=1)))
    if not np.isfinite(spread) or spread == 0 or SPREAD[0] <= spread <= SPREAD[1]:
        return weights, 1.0
    scale = 2.0 ** float(-np.round(np.log2(spread)))
    output = {name: weights[name] * np.float64(scale) for name in ("output.kernel", "output.bias")}
    return weights | {name: array.astype(np.float32) for name, array in output.items()}, scale


def _scale_note(scale):
    return (
        f"its output layer is multiplied by {scale:.3g}: its logits are far from the "
        "usual size of a softmax's inputs; the predictions do not change"
    )
