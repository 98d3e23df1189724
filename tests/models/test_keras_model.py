"""A user's Keras model: the same function as an architecture and weights, or refused in a line."""

import json
import os
import shutil
import subprocess
import sys

import h5py
import numpy as np
import pytest

from deploy.errors import UserError
from models.architecture import parse_architecture
from models.cnn import build_cnn, compute_logits, set_weights
from models.keras.files import ModelFileError
from models.keras.keras2 import tf
from models.keras.layers import convert_layers
from models.keras.model import KerasLayer
from models.keras.reader import read_keras
from tests.command import missing
from tests.models import keras_models

# What each Keras writes by default.
SUFFIXES = {"keras2": "h5", "keras3": "keras"}
GOOD = {
    "paper": "10x10-6c4-24c3-10o",
    "strides_and_pooling": "11x9x2-5c4s2p-2a-7-3o",
    "folded_forward": "12x12x2-4c3s2-2a-6c2-8-5o",
    "rescaled_and_padded": "6x6-3c3p-3c2s2p-3a-4o",
    "dense_only": "5x4-9-2o",
    "functional": "8x9x2-4c3-8c3-8c2-6o",
    "trained": "10x10-3c5s3p-10o",
}
# Of models with layers that disappear in other ones.
EXACT = {
    "vector": "10x10-8-3o",
    "vector_reshaped": "4x5x2-3c2-3o",
    "channel_added": "6x7-3c3p-3o",
    "global_average": "7x9-4c3-3o",
    "convolutions_only": "8x8-4c3-5o",
    "average_read_out": "6x6x2-4c3-4a-4o",
    "overlapping": "8x8-4c3p-3o",
    "two_classes": "5x5-6-2o",
    "linear_pair": "5x5-6-3o",
    "separable": "8x8x2-4c3-5c2-3o",
    "normalised_rows": "6x6-3c3-3o",
    "channels_first": "8x7x2-3c3-2a-4c2-3o",
    "within": "6x6-3c3-3o",
    "keras_1": "8x8-4c3s2-3o",
    "other_windows": "9x12x2-4c3p-4c3-3c4s2p-3o",
    "means_before_convolution": "12x12x2-4c3-3c5s2-3o",
    "not_square": "6x6-60-3o",
    "uneven_strides": "6x6-54-9-3o",
    "overlapping_means": "8x8-3c3-12-3o",
    "relu_after_means": "8x8-27-12-3o",
    "cropped": "8x8-48-27-3o",
    "channels_moved": "6x7x2-330-3o",
    "normalised_zeros": "7x7-3c3-75-3o",
    "normalised_by_row": "8x8-108-3o",
    "linear_convolution": "30x30-8c3-5o",
    "pixels": "6x6-3c3-3o",
    "normalised_pixels": "6x6x2-3c3-3o",
}
# Of models of which something is replaced, since training goes on.
REPLACED = {
    "maxima_in_graph": "12x12-4c3-2a-3o",
    "maxima": "12x12-4c3-2a-5c2-2a-3o",
    "global_maximum": "12x12-4c3-10a-3o",
    "overlapping_maxima": "12x12-4c4-2a-3o",
    "maxima_before_dense": "12x12-4c4-5-3o",
    "maxima_cut_off": "12x12-4c2-125-3o",
    "overlapping_maxima_before_convolution": "12x12-4c3p-5c5s2-3o",
    "maxima_normalised": "12x12-4c3-2a-4c2-3o",
    "prelu": "12x12-4c3-4c3-3o",
    "lenet": "12x12-4c3-2a-5c2-3o",
    "leaky": "12x12-4c3-6-5-3o",
    "leaky_maxima": "12x12-4c3-2a-5c2-2a-3o",
    "offsets_and_padding": "12x12-4c3p-2a-5c3p-3o",
    "no_activation": "12x12-4c3-4c3-3o",
}
# Of these an average, a ReLU or a padding is at another place than in the file.
WITHOUT_TWIN = (
    *("maxima", "overlapping_maxima", "maxima_normalised", "offsets_and_padding"),
    *("no_activation", "leaky_maxima", "maxima_cut_off"),
)
BAD = {
    "operation": ("no layer of Keras", "Rescaling"),
    "large_matrix": ("'c'", "as a matrix", "square kernels"),
    "function": ("activation", "activation='relu'"),
    "lambda": ("'double' (Lambda)", "Keras's layers"),
    "relu_first": ("'early'", "Conv2D", "Dense"),
    "no_hidden_layer": ("layer of neurons",),
    "one_output": ("'out'", "one unit per class", "sigmoid"),
    "softmax_within": ("'early'", "softmax"),
    "softmax_of_an_image": ("'early'", "softmax", "after the Reshape or Flatten"),
    "no_dense_output": ("Dense",),
    "dense_on_images": ("'each'", "Flatten"),
    "offset_and_padding": ("'c'", "padding='valid'"),
    "unknown_rows": ("200 values", "skin.rows", "skin.columns"),
    "any_size": ("NonexNonex1", "keras.Input((rows, columns, channels))"),
    "recurrent": ("'loop' (SimpleRNN)", "Conv2D"),
    "own_layer": ("'mine' (Mine)", "custom layer"),
    "own_model": ("(Net)", "custom"),
    "branches": ("'sum' (Add)", "one chain"),
    "two_outputs": ("outputs", "one chain"),
    "shared": ("one chain", "called once"),
    "not_a_number": ("'c' (Conv2D)", "NaN"),
    "infinite_variance": ("'norm'", "infinite"),
}


@pytest.fixture(scope="session")
def files(made_once):
    """Folders of files that Keras 2 and Keras 3 wrote, in a process of their own."""
    folder = made_once("keras-models", write_models)
    return {which: folder / which for which in SUFFIXES}


def write_models(folder):
    folders = [folder / which for which in SUFFIXES]
    for each in folders:
        each.mkdir()
    clean = {k: v for k, v in os.environ.items() if k != "TF_USE_LEGACY_KERAS"}
    done = subprocess.run(
        [sys.executable, keras_models.__file__, *map(str, folders)],
        env=clean,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert done.returncode == 0, done.stderr


def read_images(path, own):
    """The inputs of a file's model as images, and its outputs."""
    with np.load(path.with_suffix(".npz")) as kept:
        inputs, outputs = kept["inputs"], kept["outputs"]
    images = np.zeros((len(inputs), np.prod(own.architecture.input_shape)))
    images[:, own.input_order.ravel()] = inputs.reshape(len(inputs), -1) / own.input_scale
    return images.reshape(-1, *own.architecture.input_shape), outputs


@pytest.mark.parametrize("which", SUFFIXES)
@pytest.mark.parametrize("name", {**GOOD, **EXACT, **REPLACED})
def test_the_same_function(files, which, name):
    own = read_keras(files[which] / f"{name}.{SUFFIXES[which]}", retrain=name in REPLACED)
    assert own.architecture == parse_architecture({**GOOD, **EXACT, **REPLACED}[name])
    assert bool(own.replaced) == (name in REPLACED)
    images, outputs = read_images(files[which] / name, own)
    of_file = own.compute_outputs(images)
    np.testing.assert_allclose(of_file[:, -outputs.shape[1] :], outputs, rtol=1e-4, atol=1e-5)
    if name in REPLACED:
        of_file = np.load(files[which] / f"{name}.npy")
    network = build_cnn(own.architecture)
    set_weights(network, own.weights)
    logits = compute_logits(network, images)
    if outputs.shape[1] == 1:
        logits = np.stack([logits[:, 0] - logits[:, 1], logits[:, 1] - logits[:, 0]], 1)
    computed = np.asarray(own.end.function(tf.constant(logits)))
    if name not in WITHOUT_TWIN:
        np.testing.assert_allclose(computed, of_file, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("file", ["keras2/paper.keras", "keras3/functional.h5"])
def test_the_other_format_of_each_keras(files, file):
    which, name = file.split("/")
    own = read_keras(files[which] / name)
    assert own.architecture == parse_architecture(GOOD[name.partition(".")[0]])


@pytest.mark.parametrize("which", SUFFIXES)
@pytest.mark.parametrize("name", REPLACED)
def test_what_needs_training_is_refused_without_it(files, which, name):
    with pytest.raises(ModelFileError) as refusal:
        read_keras(files[which] / f"{name}.{SUFFIXES[which]}")
    assert missing(str(refusal.value), "'cause'", "--retrain") == []


def test_a_sequence_as_a_list(tmp_path, files):
    """Keras before 2.2.3 wrote the layers of a sequential model without a name around them."""
    path = tmp_path / "old.h5"
    shutil.copy(files["keras2"] / "paper.h5", path)
    with h5py.File(path, "a") as file:
        config = json.loads(file.attrs["model_config"])
        before, *layers = config["config"]["layers"]
        layers[0]["config"]["batch_input_shape"] = before["config"]["batch_input_shape"]
        config["config"] = layers
        file.attrs["model_config"] = np.bytes_(json.dumps(config))
        file.attrs["keras_version"] = np.bytes_("2.1.6")
    assert read_keras(path).architecture == parse_architecture(GOOD["paper"])


def test_what_was_folded_or_left_out_is_said(files):
    notes = read_keras(files["keras3"] / "strides_and_pooling.keras").notes
    kinds = ("BatchNormalization", "Dropout", "Softmax")
    assert len(notes) == len(kinds)
    assert all(kind in note for kind, note in zip(kinds, notes, strict=True))
    assert "'first'" in notes[0]


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_used_is_refused_by_name(files, name):
    for which, suffix in SUFFIXES.items():
        path = files[which] / f"{name}.{suffix}"
        with pytest.raises(ModelFileError) as refusal:
            read_keras(path)
        line = str(refusal.value)
        assert line.startswith(f"{path}: ")
        assert "\n" not in line
        assert missing(line, *BAD[name]) == []


@pytest.mark.parametrize(
    "content", [b"", b"GIF89a", b"PK\x03\x04 and no more", b"\x89HDF\r\n\x1a\n and no more"]
)
def test_other_files(tmp_path, content):
    path = tmp_path / "model.keras"
    path.write_bytes(content)
    with pytest.raises(ModelFileError, match=f"^{path}: .*model.save"):
        read_keras(path)


def test_a_pointer_of_git_lfs(tmp_path):
    path = tmp_path / "model.h5"
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
    with pytest.raises(ModelFileError, match=f"^{path}: .*git lfs pull"):
        read_keras(path)


def test_no_file_and_a_folder_and_weights_alone(tmp_path, files):
    with pytest.raises(UserError, match=r"model\.keras: .*No such file"):
        read_keras(tmp_path / "model.keras")
    with pytest.raises(UserError, match=f"^{tmp_path}: "):
        read_keras(tmp_path)
    with pytest.raises(ModelFileError, match=r"only\.weights\.h5: has weights only"):
        read_keras(files["keras3"] / "only.weights.h5")


def test_a_file_of_keras_1(tmp_path, files):
    """A configuration with the names of Keras 1, and the weights of a model of Keras 2."""
    with h5py.File(files["keras2"] / "keras_1.h5") as file:
        groups = [file["model_weights"][name] for name in ("c", "out")]
        arrays = [[group[name][()] for name in group.attrs["weight_names"]] for group in groups]
    layers = [
        ("Convolution2D", {"name": "c", "nb_filter": 4, "nb_row": 3, "nb_col": 3, "bias": True,
                           "subsample": [2, 2], "border_mode": "valid", "dim_ordering": "tf",
                           "init": "glorot_uniform", "activation": "relu",
                           "W_regularizer": None, "batch_input_shape": [None, 8, 8, 1]}),
        ("Dropout", {"name": "d", "p": 0.5}),
        ("Flatten", {"name": "f"}),
        ("Dense", {"name": "out", "output_dim": 3, "activation": "softmax", "init": "normal"}),
    ]  # fmt: skip
    config = [{"class_name": kind, "config": arguments} for kind, arguments in layers]
    path = tmp_path / "old.hdf5"
    with h5py.File(path, "w") as file:
        file.attrs["keras_version"] = np.bytes_("1.2.2")
        file.attrs["model_config"] = np.bytes_(
            json.dumps({"class_name": "Sequential", "config": config})
        )
        weights = file.create_group("model_weights")
        names = [arguments["name"] for _, arguments in layers]
        weights.attrs["layer_names"] = np.array(names, "S")
        weights.attrs["keras_version"] = np.bytes_("1.2.2")
        weights.attrs["backend"] = np.bytes_("tensorflow")
        for name in names:
            weights.create_group(name).attrs["weight_names"] = np.array([], "S1")
        for name, (kernel, bias) in zip(("c", "out"), arrays, strict=True):
            weights[name].attrs["weight_names"] = np.array([f"{name}_W", f"{name}_b"], "S")
            weights[name][f"{name}_W"], weights[name][f"{name}_b"] = kernel, bias
    own, same = read_keras(path), read_keras(files["keras2"] / "keras_1.h5")
    assert own.architecture == same.architecture == parse_architecture("8x8-4c3s2-3o")
    for name, array in same.weights.items():
        np.testing.assert_array_equal(own.weights[name], array)


def test_a_file_that_refers_to_others(tmp_path, files):
    path = tmp_path / "model.h5"
    shutil.copy(files["keras2"] / "paper.h5", path)
    with h5py.File(path, "a") as file:
        file["model_weights"]["more"] = h5py.ExternalLink("/etc/passwd", "/")
    with pytest.raises(ModelFileError, match=r"model\.h5: .*another file"):
        read_keras(path)


def test_batch_normalisation_by_hand():
    """scale 2 / sqrt(3 + 1) = 1, offset 5 - 1 * 1 = 4 before the ReLU: bias -7 + 4 = -3."""
    arguments = {"epsilon": 1.0, "axis": -1, "scale": True, "center": True}
    norm = KerasLayer("BatchNormalization", "n", arguments, (), lambda values: values + 4)
    arguments = {"filters": 1, "kernel_size": 1, "strides": 1, "padding": "same", "groups": 1}
    arrays = np.full((1, 1, 1, 1), 3.0), np.array([-7.0])
    conv = KerasLayer("Conv2D", "c", {**arguments, "dilation_rate": 1}, arrays)
    relu = KerasLayer("ReLU", "r", {}, ())
    flat = KerasLayer("Flatten", "f", {}, (), lambda values: values.reshape(1, -1))
    end = KerasLayer("Dense", "o", {"units": 2}, (np.eye(2),))
    own = convert_layers((1, 2, 1), (conv, norm, relu, flat, end))
    assert own.architecture == parse_architecture("1x2-1c1p-2o")
    assert own.weights["conv1.kernel"].ravel().tolist() == [3.0]
    assert own.weights["conv1.bias"].tolist() == [-3.0]
    assert own.weights["output.bias"].tolist() == [0.0, 0.0]
    # After the ReLU it is the next layer's: its kernel stays, its bias becomes 4 of each input.
    own = convert_layers((1, 2, 1), (conv, relu, norm, flat, end))
    assert own.weights["conv1.bias"].tolist() == [-7.0]
    assert own.weights["output.bias"].tolist() == [4.0, 4.0]
