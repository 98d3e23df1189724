"""A user's Keras model in place of the CNN."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from deploy.arithmetic import select_evenly
from deploy.check.intervals import compute_wilson_interval
from deploy.errors import UserError
from deploy.files import hash_file
from models.architecture import parse_architecture
from models.keras.model import KerasModel
from models.keras.reader import read_keras
from pipeline.kinds.imported import find_imported_file
from pipeline.kinds.normalisation import require_images_of_network
from pipeline.recordings.dataset import Dataset
from pipeline.settings import Settings

# Minimum accuracy of a user's model, as a share of the range from chance to 1. The best of 30
# networks of three layers with Keras's initial weights reached 0.06 by chance, on ten classes.
MIN_KNOWN_SHARE = 0.15

# Maximum number of training samples on which normalisations of images are compared.
MAX_COMPARED_SAMPLES = 500

# The remedy for a model that has changed since it was imported.
GIVE_MODEL_AGAIN = "give it again with 'stmnist convert RUN --model FILE' (and --retrain if used)"


def make_model_settings(path: Path, retrain: bool = False, before: Settings | None = None) -> dict:
    """Changes of the settings with which a user's Keras model replaces the CNN.

    Parameters
    ----------
    path : path-like
    retrain : bool
        Train the model further with rate-LIF neurons.
    before : Settings, optional
        Settings before these changes, whose rows, columns and channels are those of a model whose
        input is a vector.

    Raises
    ------
    UserError
        The file cannot be read, is not a Keras model, or does not fit any chip.
    """
    path = Path(path)
    before = before or Settings()
    skin = before.skin
    grid = (skin.rows, skin.columns, before.image.channels) if skin.rows and skin.columns else None
    model = read_keras(path, retrain, grid)
    sha256 = hash_file(path)
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


def name_copied_model(folder: Path, settings: Settings) -> Path:
    """The run's copy of the user's model, in the folder of the CNN."""
    return folder / f"model{Path(settings.cnn.model).suffix.lower()}"


def read_model(folder: Path, settings: Settings, dataset: Dataset) -> tuple:
    """Read the user's model, with the scale of images that suits the training samples.

    The run's copy is used if the user's file has changed or cannot be read, for example on another
    machine.

    Parameters
    ----------
    folder : Path
        Folder of the CNN.
    settings : Settings
        Settings from :func:`make_model_settings`.
    dataset : Dataset

    Returns
    -------
    Path, models.keras.model.KerasModel
        The file that was read, and the model.

    Raises
    ------
    UserError
        The model cannot be read or has changed, and the run has no copy.
    """
    copy = name_copied_model(folder, settings)
    path = find_imported_file(settings.cnn.model, settings.cnn.model_sha256, copy)
    retrain = settings.snn.recipe == "loihi"
    shape = parse_architecture(settings.cnn.architecture).input_shape
    model = read_keras(path, retrain, shape)
    if model.input_scale != 1:
        without = read_keras(path, retrain, shape, pixels=False)
        model = _choose_scale(model, without, dataset)
    imported = settings.cnn.model_sha256, settings.cnn.architecture
    if (hash_file(path), str(model.architecture)) != imported:
        raise UserError(f"{path}: has changed; {GIVE_MODEL_AGAIN}")
    return path, model


def _choose_scale(of_pixels, without, dataset):
    """A model that begins with the scaling of pixels, for the images that it was trained on.

    Nothing in a file says whether their values went up to 255, or to 1 as in this project, so that
    the training samples decide.

    Parameters
    ----------
    of_pixels, without : KerasModel
        The model that multiplies images, and the one that takes them as they are.
    dataset : Dataset
    """
    images, labels = dataset.subset("train")
    images = select_evenly(images, MAX_COMPARED_SAMPLES)
    labels = select_evenly(labels, MAX_COMPARED_SAMPLES)
    accuracies = [
        float((model.compute_outputs(images).argmax(1) == labels).mean())
        for model in (of_pixels, without)
    ]
    if accuracies[1] <= accuracies[0]:
        return of_pixels
    note = (
        f"its first layer scales pixels, but it was trained on images that end at 1: accuracy "
        f"{accuracies[1]:.3f} on {len(labels)} training samples, and {accuracies[0]:.3f} if they "
        "are multiplied by 255"
    )
    return replace(without, notes=(*without.notes, note))


def read_usable_model(folder: Path, settings: Settings, dataset: Dataset) -> tuple:
    """As :func:`read_model`, for a model that is better than chance.

    Raises
    ------
    UserError
        As :func:`read_model`; or the model is not better than chance.
    """
    path, model = read_model(folder, settings, dataset)
    require_better_than_chance(path, model, dataset)
    return path, model


def require_better_than_chance(path, model: KerasModel, dataset: Dataset):
    """Refuse a model that is not better than chance on the training samples.

    Parameters
    ----------
    path : path-like
        The file of the model.
    model : KerasModel
    dataset : Dataset

    Raises
    ------
    UserError
    """
    images, labels = dataset.subset("train")
    logits = model.compute_outputs(images)
    right = int((logits.argmax(1) == labels).sum())
    likeliest = np.bincount(labels).max() / len(labels)
    least_accuracy = compute_wilson_interval(right, len(labels))[0]
    if least_accuracy <= likeliest + MIN_KNOWN_SHARE * (1 - likeliest):
        raise UserError(
            f"{path}: hardly better than chance on this run's training samples (accuracy "
            f"{right / len(labels):.3f}, {likeliest:.3f} by always predicting the same class); "
            "train it on images as [image] in the settings makes them, with classes in this order"
        )


def require_images_of_model(path, model: KerasModel, settings: Settings, dataset: Dataset):
    """Refuse images that are normalised in another way than those that the model was trained on.

    Parameters
    ----------
    path : path-like
        File of the model.
    model : KerasModel
    settings : Settings
    dataset : Dataset

    Raises
    ------
    UserError
    """

    def classify(images):
        return model.compute_outputs(images).argmax(1)

    require_images_of_network(path, settings, dataset, classify, MAX_COMPARED_SAMPLES)
