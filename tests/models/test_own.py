"""A user's Keras model: the same function as an architecture and weights, or refused in a line."""

import copy
import io
import json
import os
import subprocess
import sys
import zipfile

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import apart, keras_file
from models.architecture import parse
from models.keras_file import SavedLayer, SavedModel
from models.own import ModelFileError, as_architecture, read_own_model
from tests.command import ROOT, missing
from tests.models import keras_models

KERAS = ("keras2", "keras3")
FORMATS = ("keras", "h5")
GOOD = {
    "paper": "10x10-6c4-24c3-10o",
    "strides_and_pooling": "11x9x2-5c4s2p-2a-7-3o",
    "folded_forward": "12x12x2-4c3s2-2a-6c2-8-5o",
    "rescaled_and_padded": "6x6-3c3p-3c2s2p-3a-4o",
    "dense_only": "5x4-9-2o",
    "functional": "8x9x2-4c3-8c3-8c2-6o",
    "trained": "10x10-3c5s3p-10o",
}
BAD = {
    "max_pooling": ("'pool' (MaxPooling2D)", " AveragePooling2D", "stride"),
    "global_pooling": ("'pool' (GlobalAveragePooling2D)", " AveragePooling2D"),
    "overlapping": ("'pool'", "AveragePooling2D(2)"),
    "padded_pooling": ("'pool'", "AveragePooling2D(2)"),
    "sigmoid": ("'c' (Conv2D)", "'sigmoid'", "activation='relu'"),
    "leaky": ("'leak' (LeakyReLU)", "activation='relu'"),
    "relu6": ("'six' (ReLU)", "max_value"),
    "function": ("'c' (Conv2D)", "activation='relu'"),
    "lambda": ("'double' (Lambda)", "executed"),
    "dilated": ("'c'", "dilation_rate=1"),
    "groups": ("'c'", "groups=1"),
    "not_square": ("'c'", "3x2"),
    "uneven_strides": ("'c'", "strides"),
    "channels_first": ("'flat'", "data_format='channels_last'"),
    "no_relu": ("'c'", "activation='relu'"),
    "relu_after_pooling": ("'c'", "ReLU"),
    "relu_first": ("'early'", "Conv2D", "Dense"),
    "relu_at_the_end": ("'out'", "'softmax'"),
    "one_output": ("'out'", "2"),
    "sigmoid_output": ("'out'", "'softmax'"),
    "softmax_within": ("'early'", "softmax"),
    "no_dense_output": ("4c3", "Dense"),
    "dense_on_images": ("'each'", "Flatten"),
    "offset_and_padding": ("'c'", "padding='valid'"),
    "normalised_rows": ("'rows'", "axis=-1"),
    "normalised_flat": ("'flat'", "Flatten"),
    "one_dimension": ("100 values", "keras.Input((rows, columns, channels))"),
    "any_size": ("[None, None, 1]", "keras.Input((10, 10, 1))"),
    "recurrent": ("'loop' (SimpleRNN)", "Conv2D"),
    "within": ("layer '", "model"),
    "own_layer": ("'mine' (Mine)", "Dense"),
    "own_model": ("'Net'", "keras.Sequential"),
    "branches": ("'sum'", "2 inputs"),
    "two_outputs": ("2 outputs",),
    "shared": ("'twice'", "2 times"),
    "dropout_always": ("'always'", "'training'"),
    "never_trained": ("biases", "zero"),
    "not_a_number": ("'c' (Conv2D)", "kernel", "NaN"),
    "infinite_variance": ("'norm'", "moving_variance"),
}


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    """Folders of files that Keras 2 and Keras 3 wrote, in a process of their own."""
    folders = {which: tmp_path_factory.mktemp(which) for which in KERAS}
    clean = {k: v for k, v in os.environ.items() if k != "TF_USE_LEGACY_KERAS"}
    done = subprocess.run(
        [sys.executable, keras_models.__file__, *map(str, folders.values())],
        env=clean,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return folders


def read_here(path):
    """As `read_own_model`, but without a process of its own: for files that are not damaged."""
    return as_architecture(keras_file.read_content(path.read_bytes()))


def forward(architecture, weights, images):
    """Logits in plain loops over positions: the architecture's own meaning, not Keras's."""
    signal = np.asarray(images, float).reshape(-1, *architecture.input_shape)
    for name, layer, before in zip(
        architecture.names, architecture.layers, architecture.shapes, strict=False
    ):
        after = layer.shape(before)
        if layer.kind == "pool":
            size, (rows, columns, channels) = layer.size, after
            windows = signal[:, : rows * size, : columns * size]
            windows = windows.reshape(-1, rows, size, columns, size, channels)
            signal = windows.mean((2, 4))
            continue
        kernel, bias = (weights[f"{name}.{array}"].astype(float) for array in ("kernel", "bias"))
        if layer.kind == "conv":
            padded = np.pad(signal, ((0, 0), *layer.pads(before), (0, 0)))
            signal = np.empty((len(signal), *after))
            for row, column in np.ndindex(after[:2]):
                top, left = row * layer.stride, column * layer.stride
                patch = padded[:, top : top + layer.kernel, left : left + layer.kernel]
                signal[:, row, column] = np.tensordot(patch, kernel, 3) + bias
        else:
            signal = signal.reshape(len(signal), -1) @ kernel + bias
        if layer.kind != "output":
            signal = np.maximum(signal, 0)
    return signal


def softmax(logits):
    scores = np.exp(logits - logits.max(1, keepdims=True))
    return scores / scores.sum(1, keepdims=True)


@pytest.mark.parametrize("which", KERAS)
@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("name", GOOD)
def test_the_same_function(files, which, suffix, name):
    own = read_here(files[which] / f"{name}.{suffix}")
    assert str(own.architecture) == GOOD[name]
    shapes = {array: own.weights[array].shape for array in own.weights}
    assert shapes == own.architecture.weight_shapes
    assert all(array.dtype == np.float32 for array in own.weights.values())
    with np.load(files[which] / f"{name}.npz") as kept:
        logits = forward(own.architecture, own.weights, kept["inputs"])
        ours = softmax(logits) if any("softmax" in note for note in own.notes) else logits
        np.testing.assert_allclose(ours, kept["outputs"], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("which", KERAS)
@pytest.mark.parametrize("suffix", FORMATS)
def test_what_was_folded_or_left_out_is_said(files, which, suffix):
    notes = read_own_model(files[which] / f"strides_and_pooling.{suffix}").notes
    kinds = ("BatchNormalization", "Dropout", "Softmax")
    assert len(notes) == len(kinds)
    assert all(kind in note for kind, note in zip(kinds, notes, strict=True))
    assert "'first'" in notes[0]


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_used_is_refused_by_name(files, name):
    for which in KERAS:
        for suffix in FORMATS:
            with pytest.raises(ModelFileError) as refusal:
                read_here(files[which] / f"{name}.{suffix}")
            line = str(refusal.value)
            assert "\n" not in line
            assert missing(line, *BAD[name]) == []


def test_the_line_begins_with_the_file(files):
    for name in ("lambda", "never_trained"):
        path = files["keras3"] / f"{name}.keras"
        with pytest.raises(ModelFileError) as refusal:
            read_own_model(path)
        assert str(refusal.value).startswith(f"{path}: ")


def test_nothing_of_keras_or_tensorflow_is_imported(files):
    path = files["keras3"] / "lambda.keras"
    code = (
        "import sys\nfrom models.own import read_own_model\n"
        f"try: read_own_model({str(path)!r})\nexcept ValueError: pass\n"
        "sys.exit(any('keras' == m or 'tensorflow' == m for m in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


# --- files that are no models ---------------------------------------------------------------------


@pytest.mark.parametrize(
    "content",
    [b"", b"GIF89a", b"PK\x03\x04 and no more", b"\x89HDF\r\n\x1a\n and no more"],
)
def test_other_files(tmp_path, content):
    path = tmp_path / "model.keras"
    path.write_bytes(content)
    with pytest.raises(ModelFileError, match=f"^{path}: .*(Keras|OSError)"):
        read_own_model(path)


def test_no_file_and_a_folder(tmp_path):
    with pytest.raises(ModelFileError, match=r"model\.keras: .*No such file"):
        read_own_model(tmp_path / "model.keras")
    with pytest.raises(ModelFileError, match=f"^{tmp_path}: "):
        read_own_model(tmp_path)


def test_weights_alone(files):
    for which in KERAS:
        with pytest.raises(ModelFileError, match=r"only\.weights\.h5: .*weights"):
            read_own_model(files[which] / "only.weights.h5")


def test_the_content_tells_the_format_not_the_name(files, tmp_path):
    path = tmp_path / "model.keras"  # as Keras 2.12 did
    path.write_bytes((files["keras2"] / "paper.h5").read_bytes())
    assert str(read_own_model(path).architecture) == GOOD["paper"]


def test_a_file_of_keras_2_12(files, tmp_path):
    """It counts layers with weights twice, in a group of another name (seen in its files)."""

    with zipfile.ZipFile(files["keras2"] / "paper.keras") as archive:
        config, weights = (archive.read(n) for n in ("config.json", "model.weights.h5"))
    buffer = io.BytesIO()
    with h5py.File(io.BytesIO(weights)) as old, h5py.File(buffer, "w") as new:
        for name in old["layers"]:
            number = {"conv2d_1": "conv2d_2"}.get(name, name)
            old.copy(f"layers/{name}", new, f"_layer_checkpoint_dependencies/{number}")
    path = tmp_path / "model.keras"
    write_archive(path, config, buffer.getvalue())
    expected = read_own_model(files["keras2"] / "paper.keras").weights
    for name, array in read_own_model(path).weights.items():
        np.testing.assert_array_equal(array, expected[name])


def write_archive(path, config, weights):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("config.json", config)
        archive.writestr("model.weights.h5", weights)


def changed_archive(files, path, change):
    """A copy of the paper's model whose arrays' file was changed by ``change(h5py.File)``."""
    with zipfile.ZipFile(files["keras3"] / "paper.keras") as archive:
        config, weights = (archive.read(n) for n in ("config.json", "model.weights.h5"))
    buffer = io.BytesIO(weights)
    with h5py.File(buffer, "r+") as file:
        change(file)
    write_archive(path, config, buffer.getvalue())
    return path


KERNEL = "layers/conv2d/vars/0"


def external_link(file):
    del file[KERNEL]
    file[KERNEL] = h5py.ExternalLink("/etc/hosts", "/")


def soft_link(file):
    del file[KERNEL]
    file[KERNEL] = h5py.SoftLink("/layers/conv2d_1/vars/0")


def external_storage(file):
    del file[KERNEL]
    file.create_dataset(KERNEL, (4, 4, 1, 6), "f4", external=[("/etc/hosts", 0, 384)])


def virtual(file):
    del file[KERNEL]
    layout = h5py.VirtualLayout((4, 4, 1, 6), "f4")
    file.create_virtual_dataset(KERNEL, layout)


def compressed(file):
    kernel = file[KERNEL][()]
    del file[KERNEL]
    file.create_dataset(KERNEL, data=kernel, compression="gzip")


def never_written(file):
    del file[KERNEL]
    file.create_dataset(KERNEL, (4, 4, 1, 6), "f4")


def huge(file):
    del file[KERNEL]
    file.create_dataset(KERNEL, (10**6, 10**6), "f4")


def of_objects(file):
    del file[KERNEL]
    file.create_dataset(KERNEL, (3,), h5py.string_dtype())


def quantised(file):
    kernel = file[KERNEL][()]
    del file[KERNEL]
    file[KERNEL] = kernel.astype(np.int8)


def other_shape(file):
    del file[KERNEL]
    file[KERNEL] = np.ones((4, 4, 2, 6), np.float32)


def without_a_layer(file):
    del file["layers/dense"]


def other_name(file):
    file["layers/conv2d/vars"].attrs["name"] = "another"


@pytest.mark.parametrize(
    ("change", "fact"),
    [
        (external_link, "link"),
        (soft_link, "link"),
        (external_storage, "Keras"),
        (virtual, "Keras"),
        (compressed, "Keras"),
        (never_written, "Keras"),
        (huge, "30000000 weights"),
        (of_objects, "object"),
        (quantised, "int8"),
        (other_shape, r"'conv2d'.*\(4, 4, 2, 6\), \(6,\).*\(4, 4, 1, 6\), \(6,\)"),
        (without_a_layer, "'dense'"),
        (other_name, "'another'"),
    ],
)
def test_arrays_that_are_not_plain(files, tmp_path, change, fact):
    path = changed_archive(files, tmp_path / "model.keras", change)
    with pytest.raises(ModelFileError, match=fact):
        read_own_model(path)


def test_an_archive_that_unpacks_to_more_than_it_should(tmp_path, monkeypatch):
    path = tmp_path / "model.keras"
    write_archive(path, b" " * (keras_file.MAX_DESCRIPTION + 1), b"")
    assert path.stat().st_size < 20_000
    with pytest.raises(ModelFileError, match=r"config\.json.* 8 MiB"):
        read_own_model(path)
    monkeypatch.setattr(keras_file, "MAX_FILE", 1000)
    with pytest.raises(ModelFileError, match="MiB"):
        read_own_model(path)


# --- descriptions made by hand: fast, in this process ---------------------------------------------


def description(*layers, shape=(4, 4, 1)):
    """Of a sequential model."""
    first = {"class_name": "InputLayer", "config": {"name": "in", "batch_shape": [None, *shape]}}
    entries = [first] + [
        {"class_name": kind, "config": {"name": f"l{n}", **config}}
        for n, (kind, config) in enumerate(layers)
    ]
    return {"class_name": "Sequential", "config": {"name": "m", "layers": entries}}


def test_too_many_layers_nesting_and_sizes():
    with pytest.raises(ModelFileError, match=r"502 layers.* 500"):
        keras_file._chain(description(*[("Flatten", {})] * 501))
    with pytest.raises(ModelFileError):
        keras_file._json("[" * 100_000)
    with pytest.raises(ModelFileError, match=r"\b1000000000x1000000000x1000000000\b"):
        as_architecture(SavedModel((10**9, 10**9, 10**9), ()))
    wide = SavedLayer("Dense", "wide", {"units": 10**15, "activation": "relu"})
    with pytest.raises(ModelFileError, match=r"'wide'.*units.* 1 to 1000000"):
        as_architecture(SavedModel((4, 4, 1), (SavedLayer("Flatten", "f", {}), wide)))


def test_a_layer_that_calls_itself():
    entry = {
        "class_name": "Dense",
        "name": "d",
        "config": {"name": "d", "units": 2},
        "inbound_nodes": [[["d", 0, 0, {}]]],
    }
    first = {"class_name": "InputLayer", "name": "in", "config": {"name": "in"}}
    config = {"layers": [first, entry], "input_layers": ["in", 0, 0], "output_layers": ["d", 0, 0]}
    with pytest.raises(ModelFileError, match="order"):
        keras_file._chain({"class_name": "Functional", "config": config})


def trained_layers(rng):
    """A small network's layers with arrays."""
    return (
        SavedLayer("Conv2D", "c", {"filters": 2, "kernel_size": [3, 3], "strides": [1, 1],
                                   "padding": "valid", "activation": "relu"},
                   (rng.normal(size=(3, 3, 1, 2)), rng.normal(size=2))),
        SavedLayer("Flatten", "f", {}),
        SavedLayer("Dense", "o", {"units": 3}, (rng.normal(size=(8, 3)), rng.normal(size=3))),
    )  # fmt: skip


def test_batch_normalisation_by_hand():
    """scale 2 / sqrt(3 + 1) = 1, offset 5 - 1 * 1 = 4 before the ReLU: bias -7 + 4 = -3."""
    norm = SavedLayer("BatchNormalization", "n", {"epsilon": 1.0},
                      tuple(np.array([value]) for value in (2.0, 5.0, 1.0, 3.0)))  # fmt: skip
    conv = SavedLayer("Conv2D", "c", {"filters": 1, "kernel_size": 1, "strides": 1,
                                      "padding": "same"},
                      (np.full((1, 1, 1, 1), 3.0), np.array([-7.0])))  # fmt: skip
    relu, flat = SavedLayer("ReLU", "r", {}), SavedLayer("Flatten", "f", {})
    end = SavedLayer("Dense", "o", {"units": 2, "use_bias": False}, (np.eye(2),))
    own = as_architecture(SavedModel((1, 2), (conv, norm, relu, flat, end)))
    assert own.architecture == parse("1x2-1c1p-2o")
    assert own.weights["conv1.kernel"].ravel().tolist() == [3.0]
    assert own.weights["conv1.bias"].tolist() == [-3.0]
    assert own.weights["output.bias"].tolist() == [0.0, 0.0]
    # After the ReLU it is the next layer's: its kernel stays, its bias becomes 4 of each input.
    own = as_architecture(SavedModel((1, 2), (conv, relu, norm, flat, end)))
    assert own.weights["conv1.bias"].tolist() == [-7.0]
    assert own.weights["output.bias"].tolist() == [4.0, 4.0]


def is_read_or_refused(read):
    """A whole network, or one line."""
    try:
        own = read()
    except ModelFileError as error:
        line = str(error)
    else:
        line = ""
        shapes = {name: array.shape for name, array in own.weights.items()}
        assert shapes == own.architecture.weight_shapes
        assert all(np.isfinite(array).all() for array in own.weights.values())
    assert "\n" not in line
    assert len(line) < 500


@settings(max_examples=100)
@given(st.data())
def test_a_damaged_description_is_refused_or_read(data):
    """Any value of it replaced by any other."""
    layers = (
        ("Rescaling", {"scale": 0.5, "offset": 0.0}),
        ("Conv2D", {"filters": 2, "kernel_size": [3, 3], "strides": [1, 1], "padding": "valid",
                    "activation": "linear", "dilation_rate": [1, 1], "groups": 1,
                    "use_bias": True}),
        ("BatchNormalization", {"axis": [3], "epsilon": 0.001, "scale": True, "center": True}),
        ("ReLU", {"max_value": None, "negative_slope": 0.0, "threshold": 0.0}),
        ("AveragePooling2D", {"pool_size": [2, 2], "strides": [2, 2], "padding": "valid"}),
        ("Flatten", {"data_format": "channels_last"}),
        ("Dense", {"units": 3, "activation": "softmax"}),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    arrays = {
        "Conv2D": (rng.normal(size=(3, 3, 1, 2)), rng.normal(size=2)),
        "BatchNormalization": tuple(rng.uniform(1, 2, (4, 2))),
        "Dense": (rng.normal(size=(2, 3)), rng.normal(size=3)),
    }
    text = copy.deepcopy(description(*layers))
    place = text
    while True:
        keys = list(place) if isinstance(place, dict) else range(len(place))
        key = data.draw(st.sampled_from(list(keys)))
        deeper = isinstance(place[key], (dict, list)) and len(place[key])
        if not deeper or data.draw(st.integers(0, 4)) == 0:
            break
        place = place[key]
    anything = st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
        | st.sampled_from(["relu", "same", "softmax", "Dense", "Sequential", 10**30]),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
        max_leaves=4,
    )  # fmt: skip
    place[key] = data.draw(anything)

    def read():
        shape, chain = keras_file._chain(text)
        filled = [SavedLayer(c.kind, c.name, c.config, arrays.get(c.kind, ())) for c in chain]
        return as_architecture(SavedModel(shape, tuple(filled)))

    is_read_or_refused(read)


@settings(max_examples=12)
@given(st.data())
def test_damaged_files_are_refused_or_read(files, tmp_path_factory, data):
    """Bytes changed or cut off; HDF5 itself crashes on some of them."""
    which = data.draw(st.sampled_from(KERAS))
    name = data.draw(st.sampled_from(["functional.h5", "functional.keras", "trained.h5"]))
    content = bytearray((files[which] / name).read_bytes())
    for _ in range(data.draw(st.integers(1, 20))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    content = content[: data.draw(st.just(len(content)) | st.integers(0, len(content)))]
    path = tmp_path_factory.mktemp("damaged") / "model"
    path.write_bytes(content)
    is_read_or_refused(lambda: read_own_model(path))


def test_a_crash_of_the_reading_process_is_a_line(files, monkeypatch, tmp_path):
    package = tmp_path / "models"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "keras_file.py").write_text("import os\nos.abort()\n")
    monkeypatch.setattr(apart, "__file__", str(package / "apart.py"))
    path = files["keras3"] / "paper.keras"
    with pytest.raises(ModelFileError, match=f"^{path}: "):
        read_own_model(path)


def test_layers_without_biases_say_nothing_of_training():
    rng = np.random.default_rng(0)
    conv, flat, end = trained_layers(rng)
    zero = [
        SavedLayer(layer.kind, layer.name, layer.config, (layer.arrays[0], 0 * layer.arrays[1]))
        for layer in (conv, end)
    ]
    with pytest.raises(ModelFileError, match="zero"):
        as_architecture(SavedModel((4, 4), (zero[0], flat, zero[1])))
    as_architecture(SavedModel((4, 4), (zero[0], flat, end)))
    bare = [
        SavedLayer(layer.kind, layer.name, {**layer.config, "use_bias": False}, layer.arrays[:1])
        for layer in (conv, end)
    ]
    as_architecture(SavedModel((4, 4), (bare[0], flat, bare[1])))


def test_the_description_survives_the_way_between_the_processes(files):
    content = (files["keras3"] / "paper.keras").read_bytes()
    here = keras_file.read_content(content)
    there = keras_file.read_model_file(files["keras3"] / "paper.keras")
    assert here == there
    assert json.dumps([layer.config for layer in here.layers])
    for one, other in zip(here.layers, there.layers, strict=True):
        for array, same in zip(one.arrays, other.arrays, strict=True):
            np.testing.assert_array_equal(array, same)
