"""Read Keras model files as data: a description of layers, and arrays.

Both formats of Keras 2 and 3 are supported: the archive ``.keras`` (``config.json`` and
``model.weights.h5`` in a zip) and the older ``.h5`` (the description is an attribute).  The format
is detected from the content, not from the name.  Nothing in a file is executed: Keras is not used,
custom layers are refused, and only plain HDF5 arrays of floating-point numbers in the file itself
are read (no links to other files, no external or virtual storage, no filters).

Files are opened in a process of their own (:mod:`models.apart`); run as a script, this module is
that process.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from models.apart import MAX_SECONDS, Crashed, TooSlow, answer_apart, content_of, read_apart
from models.hdf5 import h5py

MAX_FILE = 256 * 2**20
"""Maximum size in bytes of a model file and of the arrays in it."""

MAX_DESCRIPTION = 8 * 2**20
"""Maximum size in bytes of the description of the layers."""

MAX_LAYERS = 500
"""Maximum number of layers in a file, including layers that only act in training."""

MAX_NUMBERS = 30_000_000
"""Maximum number of array elements in a file."""

ARRAYS = {"Conv2D": "conv2d", "Dense": "dense", "BatchNormalization": "batch_normalization"}
"""Layers whose arrays are read, and the name of the first of each in a ``.keras`` file, which does
not depend on the user's names; later ones are numbered."""

REMEDY = "save it again with model.save('name.keras')"
_HDF5 = b"\x89HDF\r\n\x1a\n"
_KERAS = ("keras", "tf_keras", "tensorflow", "keras_core")


class ModelFileError(ValueError):
    """A file is not a Keras model, or the model is not supported; the message is one line."""


@dataclass(frozen=True)
class SavedLayer:
    """A layer as described in the file.

    Attributes
    ----------
    kind : str
        Keras's class name, such as ``"Conv2D"``.
    name : str
    config : dict
        The layer's arguments, as parsed from JSON; they are not validated.
    arrays : tuple of ndarray, float64
        The arrays of a layer in :data:`ARRAYS`, in Keras's order: kernel and bias; or gamma, beta,
        moving mean and moving variance, where gamma and beta are optional.
    """

    kind: str
    name: str
    config: dict
    arrays: tuple = field(default=(), compare=False)

    def __str__(self):
        return f"layer {shown(self.name)} ({shown(self.kind)[1:-1]})"


@dataclass(frozen=True)
class SavedModel:
    """A saved chain of layers.

    Attributes
    ----------
    input_shape : tuple of int
        Shape of one sample.
    layers : tuple of SavedLayer
        In the order of the data flow, without the input layer.
    """

    input_shape: tuple
    layers: tuple


def shown(text) -> str:
    """Text from a file for a message: quoted, on one line, and shortened."""
    text = repr(str(text)[:60])
    return text if len(text) <= 80 else text[:77] + "...'"


def read_model_file(path) -> SavedModel:
    """Read a sequential model, or a functional one without branches.

    Parameters
    ----------
    path : path-like
        A ``.keras`` or ``.h5`` file.

    Raises
    ------
    ModelFileError
        The file is missing, damaged, too large, not a Keras model, or contains weights only; or the
        model has branches, several inputs or outputs, shared layers, nested models, or custom
        layers.
    """
    path = Path(path)
    content = _content(path)
    try:
        answer, arrays = read_apart("models.keras_file", content)
    except TooSlow as error:
        problem = f"could not be read in {MAX_SECONDS} s and may be damaged"
        raise ModelFileError(f"{path}: {problem}; {REMEDY}") from error
    except Crashed as error:
        raise ModelFileError(f"{path}: damaged; {REMEDY}") from error
    if "problem" in answer:
        raise ModelFileError(f"{path}: {answer['problem']}")
    layers = tuple(
        SavedLayer(kind, name, config, tuple(arrays[array] for array in names))
        for kind, name, config, names in answer["layers"]
    )
    return SavedModel(tuple(answer["input_shape"]), layers)


def _answer(content):
    """The content of a file, as plain values and arrays."""
    arrays = {}
    try:
        model = read_content(content)
    except ModelFileError as error:
        return {"problem": str(error)}, {}
    layers = []
    for layer in model.layers:
        names = [f"{len(arrays) + n}" for n in range(len(layer.arrays))]
        arrays |= dict(zip(names, layer.arrays, strict=True))
        layers.append([layer.kind, layer.name, layer.config, names])
    return {"input_shape": model.input_shape, "layers": layers}, arrays


def read_content(content: bytes) -> SavedModel:
    """Read a file's content in this process, which a damaged file may crash.

    Raises
    ------
    ModelFileError
        As :func:`read_model_file`, except for errors of opening the file.
    """
    try:
        if content.startswith(_HDF5):
            with h5py.File(io.BytesIO(content), "r") as file:
                return _from_h5(file)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            description = _json(_member(archive, "config.json", MAX_DESCRIPTION))
            weights = _member(archive, "model.weights.h5", MAX_FILE)
        if not weights.startswith(_HDF5):
            raise ModelFileError(f"its weights are not HDF5; {REMEDY}")
        with h5py.File(io.BytesIO(weights), "r") as file:
            return _from_archive(description, file)
    except ModelFileError:
        raise
    except zipfile.BadZipFile as error:
        raise ModelFileError(
            "not a Keras model file, or damaged; give a .keras or .h5 file that Keras saved"
        ) from error
    except MemoryError as error:
        raise ModelFileError(f"needs too much memory and may be damaged; {REMEDY}") from error
    except Exception as error:  # zipfile, zlib and h5py fail in many ways on damaged files
        raise ModelFileError(f"damaged ({type(error).__name__}); {REMEDY}") from error


def _content(path):
    if path.is_dir():
        raise ModelFileError(f"{path}: a folder, not a Keras model file; {REMEDY}")
    try:
        content = content_of(path, MAX_FILE)
    except ValueError as error:
        raise ModelFileError(str(error)) from error
    if len(content) > MAX_FILE:
        raise ModelFileError(
            f"{path}: larger than {MAX_FILE >> 20} MiB, which no network for the chip needs"
        )
    return content


def _member(archive, name, limit):
    """Content of a file in the archive; the size that the archive declares is not trusted."""
    try:
        with archive.open(name) as member:
            content = member.read(limit + 1)
    except KeyError:
        names = archive.namelist()
        if name == "model.weights.h5" and any("weights" in other for other in names):
            raise ModelFileError("its weights are split into several files; " + REMEDY) from None
        raise ModelFileError(f"not a Keras model: contains no {name}; {REMEDY}") from None
    except RuntimeError as error:
        raise ModelFileError("is encrypted; save it without a password") from error
    if len(content) > limit:
        raise ModelFileError(f"its {name} is larger than {limit >> 20} MiB")
    return content


def _json(text):
    if len(text) > MAX_DESCRIPTION:
        raise ModelFileError(f"its description is larger than {MAX_DESCRIPTION >> 20} MiB")
    try:
        description = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ModelFileError(f"its description is damaged; {REMEDY}") from error
    if not isinstance(description, dict):
        raise ModelFileError(f"its description is damaged; {REMEDY}")
    return description


# --- the description ------------------------------------------------------------------------------


def _chain(description):
    """(input shape, layers without arrays) of a model's description."""
    kind = description.get("class_name")
    if not _is_kerass(description) or kind not in ("Sequential", "Functional", "Model"):
        raise ModelFileError(
            f"the model class {shown(kind)} is custom code, which the file does not contain; "
            "build it as keras.Sequential or keras.Model(inputs, outputs) and " + REMEDY
        )
    config = description.get("config")
    entries = config if isinstance(config, list) else _of(config, "layers", list)
    if not 1 <= len(entries) <= MAX_LAYERS:
        raise ModelFileError(f"has {len(entries)} layers, not 1 to {MAX_LAYERS}")
    if any(not isinstance(entry, dict) for entry in entries):
        raise _damaged("its layers")
    if kind != "Sequential":
        entries = _in_order(config, entries)
    layers = [_layer(entry) for entry in entries]
    shape = _input_shape(description, config, layers)
    if layers[0].kind == "InputLayer":
        layers = layers[1:]
    return shape, layers


def _layer(entry):
    config = _of(entry, "config", dict)
    layer = SavedLayer(_of(entry, "class_name", str), _of(config, "name", str), config)
    if not _is_kerass(entry) or ">" in layer.kind:
        raise ModelFileError(
            f"{layer}: custom layers are not supported; "
            "use Keras's Conv2D, AveragePooling2D, Dense, ReLU"
        )
    if layer.kind in ("Sequential", "Functional", "Model"):
        raise ModelFileError(
            f"{layer}: nested models are not supported; build one model of all layers"
        )
    return layer


def _is_kerass(entry):
    """True unless the entry declares a class that is not Keras's own."""
    module, name = entry.get("module"), entry.get("registered_name")
    known = module is None or (isinstance(module, str) and module.split(".")[0] in _KERAS)
    return known and name in (None, entry.get("class_name"))


def _in_order(config, entries):
    """The entries of a functional model from input to output."""
    by_name = {}
    for entry in entries:
        name = entry.get("name", (entry.get("config") or {}).get("name"))
        if not isinstance(name, str) or name in by_name:
            raise _damaged("its layers' names")
        by_name[name] = entry
    first, last = (_ends(config, key) for key in ("input_layers", "output_layers"))
    order, name = [], last
    while len(order) <= len(entries):
        entry = by_name.get(name)
        if entry is None:
            raise _damaged("the order of its layers")
        order.append(entry)
        if name == first:
            break
        name = _before(name, _of(entry, "inbound_nodes", list))
    if len(order) > len(entries):
        raise _damaged("the order of its layers")
    if len(order) < len(entries):
        on_the_way = [id(entry) for entry in order]
        aside = next(name for name, e in by_name.items() if id(e) not in on_the_way)
        raise ModelFileError(
            f"layer {shown(aside)} is on a branch; "
            "use one chain of layers from one input to one output"
        )
    return order[::-1]


def _ends(config, key):
    """The one input or output layer: [["name", 0, 0]], or ["name", 0, 0] of Keras 3."""
    ends = _of(config, key, (list, dict))
    ends = list(ends.values()) if isinstance(ends, dict) else ends
    if ends and isinstance(ends[0], str):
        ends = [ends]
    if len(ends) != 1:
        what = key.split("_")[0]
        raise ModelFileError(f"has {len(ends)} {what}s; use one {what}")
    if not isinstance(ends[0], list) or not ends[0] or not isinstance(ends[0][0], str):
        raise _damaged(f"its {key}")
    return ends[0][0]


def _before(name, nodes):
    """Name of the layer whose output is the input of a layer."""
    if len(nodes) != 1:
        raise ModelFileError(
            f"layer {shown(name)} is called {len(nodes)} times; "
            "use a chain in which each layer occurs once"
        )
    node = nodes[0]
    if isinstance(node, dict):  # Keras 3
        tensors, options = _of(node, "args", list), _of(node, "kwargs", dict)
        if len(tensors) == 1 and isinstance(tensors[0], list):
            tensors = tensors[0]
        tensors = [
            _of(_of(t, "config", dict), "keras_history", list) if isinstance(t, dict) else t
            for t in tensors
        ]
    elif isinstance(node, list) and all(isinstance(tensor, list) for tensor in node):
        tensors, options = node, {}
        for tensor in tensors:
            if len(tensor) > 3 and isinstance(tensor[3], dict):
                options |= tensor[3]
    else:
        raise _damaged(f"the input of layer {shown(name)}")
    if any(value not in (None, False) for value in options.values()):
        options = ", ".join(shown(key) for key in sorted(options))
        raise ModelFileError(
            f"layer {shown(name)} is called with options ({options}); call it with its input only"
        )
    if len(tensors) != 1:
        raise ModelFileError(
            f"layer {shown(name)} has {len(tensors)} inputs; "
            "use one chain of layers without branches"
        )
    tensor = tensors[0]
    if not isinstance(tensor, list) or not tensor or not isinstance(tensor[0], str):
        raise _damaged(f"the input of layer {shown(name)}")
    return tensor[0]


def _input_shape(description, config, layers):
    places = [layers[0].config, config, description.get("build_config")]
    keys = ("batch_shape", "batch_input_shape", "build_input_shape", "input_shape")
    for place in places:
        for key in keys:
            shape = place.get(key) if isinstance(place, dict) else None
            if isinstance(shape, list) and len(shape) > 1:
                if all(_is_count(n) for n in shape[1:]):
                    return tuple(shape[1:])
                raise ModelFileError(
                    f"the input shape {shown(shape[1:])[1:-1]} is not fixed; "
                    "use a fixed one, such as keras.Input((10, 10, 1))"
                )
    raise ModelFileError("has no input shape; begin the model with keras.Input((10, 10, 1))")


def _is_count(n):
    return isinstance(n, int) and not isinstance(n, bool) and n >= 1


def _of(place, key, kind):
    value = place.get(key) if isinstance(place, dict) else None
    if not isinstance(value, kind):
        raise _damaged(f"its {key}")
    return value


def _damaged(what):
    return ModelFileError(f"its description is damaged ({what}); {REMEDY}")


# --- the arrays -----------------------------------------------------------------------------------


def _from_h5(file):
    description = file.attrs.get("model_config")
    if description is None:
        if (
            "layers" in file
            or "layer_names" in file.attrs
            or "_layer_checkpoint_dependencies" in (file)
        ):
            raise ModelFileError("contains weights without the network; " + REMEDY)
        raise ModelFileError("HDF5, but not a Keras model; give a file that model.save() wrote")
    if not isinstance(description, (str, bytes)):
        raise _damaged("its text")
    shape, layers = _chain(_json(description))
    weights = _group(file, ("model_weights",))
    budget = _Budget()

    def arrays(layer):
        group = _group(weights, (layer.name,))
        names = [n.decode() if isinstance(n, bytes) else n for n in group.attrs["weight_names"]]
        return [budget.array(_dataset(group, name.split("/"))) for name in names]

    return _with_arrays(shape, layers, arrays)


def _from_archive(description, file):
    shape, layers = _chain(description)
    root = "layers" if "layers" in file else "_layer_checkpoint_dependencies"  # Keras 2.12
    folder, budget = _group(file, (root,)), _Budget()
    groups = {kind: _numbered(folder, name) for kind, name in ARRAYS.items()}

    def arrays(layer):
        if not groups[layer.kind]:
            raise ModelFileError(f"contains no arrays of {layer}; {REMEDY}")
        group = _group(folder, (groups[layer.kind].pop(0), "vars"))
        said = group.attrs.get("name", layer.name)  # written by newer versions of Keras 3
        if said != layer.name:
            raise ModelFileError(f"the arrays of {layer} are named {shown(said)}; {REMEDY}")
        return [budget.array(_dataset(group, (str(n),))) for n in range(len(group))]

    return _with_arrays(shape, layers, arrays)


def _numbered(folder, name):
    """The names ``dense``, ``dense_1``, ... in order; Keras 2.12 skips some numbers."""
    found = [re.fullmatch(f"{name}(?:_([0-9]{{1,9}}))?", entry) for entry in folder]
    return [m[0] for m in sorted(filter(None, found), key=lambda m: int(m[1] or 0))]


def _with_arrays(shape, layers, arrays):
    """The model, with the arrays that ``arrays(layer)`` reads for each layer in `ARRAYS`."""
    filled = []
    for layer in layers:
        found = ()
        if layer.kind in ARRAYS:
            try:
                found = tuple(arrays(layer))
            except ModelFileError:
                raise
            except Exception as error:  # h5py fails in many ways on damaged files
                raise ModelFileError(f"{layer}: its arrays are damaged; {REMEDY}") from error
        filled.append(SavedLayer(layer.kind, layer.name, layer.config, found))
    return SavedModel(shape, tuple(filled))


def _group(group, names):
    for name in names:
        group = _inside(group, name)
        if not isinstance(group, h5py.Group):
            raise ModelFileError(f"its arrays are not where Keras puts them; {REMEDY}")
    return group


def _dataset(group, names):
    dataset = _inside(_group(group, names[:-1]), names[-1])
    if not isinstance(dataset, h5py.Dataset):
        raise ModelFileError(f"its arrays are not where Keras puts them; {REMEDY}")
    return dataset


def _inside(group, name):
    """A member of a group; links to other places are refused."""
    link = group.get(name, getlink=True)
    if link is None:
        raise ModelFileError(f"contains no arrays named {shown(name)}; {REMEDY}")
    if not isinstance(link, h5py.HardLink):
        raise ModelFileError(f"{shown(name)} is a link, which is not followed; {REMEDY}")
    return group[name]


class _Budget:
    """A reader of arrays that enforces :data:`MAX_NUMBERS`."""

    def __init__(self):
        self.left = MAX_NUMBERS

    def array(self, dataset):
        if dataset.dtype.kind != "f" or dataset.dtype.itemsize > 8:
            raise ModelFileError(
                f"has an array of type {dataset.dtype}, not of floating-point numbers; "
                "save the model before it is quantised"
            )
        size = 1
        for n in dataset.shape:
            size *= n
        self.left -= size
        if self.left < 0:
            raise ModelFileError(
                f"has more than {MAX_NUMBERS} weights, which no network for the chip needs"
            )
        # A plain array needs its own size in the file, unlike virtual, external or compressed ones.
        plain = dataset.chunks is None and not dataset.is_virtual and not dataset.external
        if not plain or dataset.id.get_storage_size() != size * dataset.dtype.itemsize:
            raise ModelFileError(f"an array is not stored in Keras's way; {REMEDY}")
        return np.asarray(dataset[()], np.float64)


if __name__ == "__main__":
    answer_apart(_answer)
