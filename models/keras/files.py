"""Read Keras's files: find out what a file is, and load the model in the Keras that wrote it.

=========  =====================================================================================
Keras 1    ``.h5``; its configuration is brought to the names of Keras 2
Keras 2    ``.h5``, ``.hdf5``, ``.keras``, also of TensorFlow 1 and 2; loaded by tf-keras
Keras 3    ``.keras``, ``.h5``; loaded by Keras 3
=========  =====================================================================================

Classes that are not Keras's, and functions (``Lambda``), are code outside of the file or Python
bytecode in it; both are refused before anything is loaded.
"""

import contextlib
import io
import json
import os
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

from deploy.errors import UserError, shorten_error
from deploy.files import POINTER_PROBLEM, POINTER_START, is_pointer

REMEDY = "give a .keras or .h5 file that model.save() wrote"

# Largest configuration of a model, and largest weights in an archive.
MAX_CONFIG_BYTES = 50_000_000
MAX_WEIGHTS_BYTES = 2_000_000_000

# Layers around functions: Python code, which is not run, or operations of TensorFlow.
FUNCTIONS = ("Lambda", "TFOpLambda", "SlicingOpLambda", "TensorFlowOpLayer")

# Module of operations that Keras 3 writes as layers.
OPERATIONS = "keras.src.ops"


class ModelFileError(UserError):
    """A file is not a Keras model, or the model is not supported; the message is one line."""


def load_keras_model(path: Path):
    """Load the model in a file without its optimiser.

    Returns
    -------
    keras.Model or tf_keras.Model

    Raises
    ------
    ModelFileError
        The file is no model, has only weights, or has classes or functions of the user's.
    """
    from models.keras.keras2 import tf  # noqa: F401 - before Keras 3 imports TensorFlow

    try:
        config, version, has_archive = _read_config(path)
        keras = _find_keras(version)
        if version.startswith("1."):
            from models.keras.keras1 import convert_config

            config = convert_config(config)
        _require_known_layers(config, keras)
        with _link_with_ending(path, ".keras" if has_archive else ".h5") as named:
            if version.startswith("1."):
                model = keras.models.model_from_json(json.dumps(config))
                model.load_weights(named)
            else:
                model = keras.models.load_model(named, compile=False, safe_mode=True)
        model.inputs[0].shape  # noqa: B018 - refuses a model that was never built
        return model
    except ModelFileError:
        raise
    except Exception as error:  # Keras fails in many ways on other files and on custom classes
        reason = shorten_error(error, 200)
        raise ModelFileError(f"Keras cannot load it ({reason}); {REMEDY}") from error


def _find_keras(version):
    """The Keras that loads a version's files."""
    if version.startswith(("1.", "2.")):
        import tf_keras as keras
    else:
        import keras
    return keras


def _read_config(path):
    """(configuration of the model, version of Keras, True for a .keras archive)."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            names = set(archive.namelist())
            if "config.json" not in names:
                raise ModelFileError(f"is a zip without a Keras model; {REMEDY}")
            limits = {
                "config.json": MAX_CONFIG_BYTES,
                "metadata.json": MAX_CONFIG_BYTES,
                "model.weights.h5": MAX_WEIGHTS_BYTES,
            }
            for name in names & set(limits):
                if archive.getinfo(name).file_size > limits[name]:
                    raise ModelFileError(f"its {name} has more than {limits[name]} bytes")
            config = json.loads(archive.read("config.json"))
            version = json.loads(archive.read("metadata.json"))["keras_version"]
            if "model.weights.h5" in names:
                _refuse_links(io.BytesIO(archive.read("model.weights.h5")))
        return config, version, True
    import h5py

    with path.open("rb") as file:
        if is_pointer(file.read(len(POINTER_START))):
            raise ModelFileError(POINTER_PROBLEM)
    if not h5py.is_hdf5(path):
        raise ModelFileError(f"is neither a zip nor an HDF5 file: no Keras model; {REMEDY}")
    _refuse_links(path)
    with h5py.File(path, "r") as file:
        attributes = {name: _decode(value) for name, value in file.attrs.items()}
        has_weights = {"layer_names", "layers", "_layer_checkpoint_dependencies"} & {
            *attributes,
            *file,
        }
    if "model_config" not in attributes:
        if has_weights:
            raise ModelFileError(f"has weights only, and no model; {REMEDY}, not save_weights()")
        raise ModelFileError(f"is an HDF5 file without a Keras model; {REMEDY}")
    # Keras has written its version since 1.0.3.
    version = attributes.get("keras_version", "1.0")
    return json.loads(attributes["model_config"]), version, False


def _decode(value):
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _refuse_links(source):
    """Refuse an HDF5 file that takes data from other files."""
    import h5py

    def require_own(name, entry):
        is_elsewhere = isinstance(entry, h5py.Dataset) and (entry.external or entry.is_virtual)
        links = []
        if isinstance(entry, h5py.Group):
            links = [entry.get(below, getlink=True) for below in entry]
        if is_elsewhere or any(isinstance(link, h5py.ExternalLink) for link in links):
            raise ModelFileError(f"{name!r} refers to another file; {REMEDY}")

    with h5py.File(source, "r") as file:
        require_own("/", file)
        file.visititems(require_own)


def _require_known_layers(config, keras):
    """Refuse layers whose code is not Keras's."""
    for layer in _list_layer_configs(config):
        kind = layer.get("class_name")
        if kind in ("Functional", "Model", "Sequential"):  # a model, or one inside of another
            continue
        inside = layer.get("config", {})
        name = layer.get("name") or inside.get("name")
        which = f"layer {name!r} ({kind})"
        has_function = isinstance(inside.get("activation"), dict)
        if has_function:
            raise ModelFileError(
                f"{which}: its activation is a function of Python, which is not run; use one of "
                "Keras's by its name: activation='relu'"
            )
        is_operation = str(layer.get("module")).startswith(OPERATIONS)
        if kind in FUNCTIONS or is_operation:
            raise ModelFileError(
                f"{which}: is a function and no layer of Keras; use one of Keras's layers for it, "
                "such as Rescaling for x / 255"
            )
        # Keras 2 has old layers such as BatchNormalizationV1 in its files.
        known = hasattr(keras.layers, str(kind).removesuffix("V1"))
        if not known or str(layer.get("registered_name") or "").startswith("Custom>"):
            raise ModelFileError(
                f"{which}: is a custom layer, whose code is not in the file; "
                "build the model of Keras's own layers"
            )


def _list_layer_configs(config):
    """The descriptions of a model and of its layers, nested ones included."""
    yield config
    inside = config.get("config", {})
    layers = inside if isinstance(inside, list) else inside.get("layers", [])
    for layer in layers if isinstance(layers, list) else []:
        yield from _list_layer_configs(layer)


@contextlib.contextmanager
def _link_with_ending(path: Path, ending: str) -> Iterator[str]:
    """A path to the file with the ending by which Keras recognises the format."""
    if path.suffix == ending:
        yield str(path)
        return
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / f"model{ending}"
        os.symlink(path.absolute(), link)
        yield str(link)
