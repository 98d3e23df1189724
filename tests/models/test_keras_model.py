"""A user's Keras model: the same function as an architecture and weights, or refused in a line."""

import os
import subprocess
import sys

import numpy as np
import pytest

from deploy.errors import UserError
from models.architecture import parse
from models.cnn import build_cnn, predict, set_weights
from models.keras.reader import ModelFileError, _Layer, from_layers, read_keras
from tests.command import missing
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
    "function": ("cannot load", "model.save()"),
    "lambda": ("Lambda",),
    "dilated": ("'c'", "dilation_rate=1"),
    "groups": ("'c'", "groups=1"),
    "not_square": ("'c'", "3x2"),
    "uneven_strides": ("'c'", "strides"),
    "channels_first": ("'flat'", "data_format='channels_last'"),
    "no_relu": ("'c'", "activation='relu'"),
    "relu_after_pooling": ("'c'", "ReLU"),
    "relu_first": ("'early'", "Conv2D", "Dense"),
    "relu_at_the_end": ("'out'", "'softmax'"),
    "no_hidden_layer": ("layer of neurons",),
    "one_output": ("'out'", "2"),
    "sigmoid_output": ("'out'", "'softmax'"),
    "softmax_within": ("'early'", "softmax"),
    "no_dense_output": ("4c3", "Dense"),
    "dense_on_images": ("'each'", "Flatten"),
    "offset_and_padding": ("'c'", "padding='valid'"),
    "normalised_rows": ("'rows'", "axis=-1"),
    "normalised_flat": ("'flat'", "Flatten"),
    "one_dimension": ("100 values", "keras.Input((rows, columns, channels))"),
    "any_size": ("NonexNonex1", "keras.Input((rows, columns, channels))"),
    "recurrent": ("'loop' (SimpleRNN)", "Conv2D"),
    "within": ("(Sequential)", "one model"),
    "own_layer": ("cannot load", "model.save()"),
    "own_model": ("cannot load", "Net"),
    "branches": ("'two'", "one chain"),
    "two_outputs": ("outputs", "one chain"),
    "shared": ("one chain", "called once"),
    "not_a_number": ("'c' (Conv2D)", "NaN"),
    "infinite_variance": ("'norm'", "infinite"),
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


@pytest.mark.parametrize("which", KERAS)
@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("name", GOOD)
def test_the_same_function(files, which, suffix, name):
    own = read_keras(files[which] / f"{name}.{suffix}")
    assert own.architecture == parse(GOOD[name])
    network = build_cnn(own.architecture)
    set_weights(network, own.weights)
    with np.load(files[which] / f"{name}.npz") as kept:
        inputs = kept["inputs"].reshape(-1, *own.architecture.input_shape)
        outputs = predict(network, inputs)
        if any("softmax" in note for note in own.notes):
            outputs = np.exp(outputs) / np.exp(outputs).sum(1, keepdims=True)
        np.testing.assert_allclose(outputs, kept["outputs"], rtol=1e-4, atol=1e-5)


def test_what_was_folded_or_left_out_is_said(files):
    notes = read_keras(files["keras3"] / "strides_and_pooling.keras").notes
    kinds = ("BatchNormalization", "Dropout", "Softmax")
    assert len(notes) == len(kinds)
    assert all(kind in note for kind, note in zip(kinds, notes, strict=True))
    assert "'first'" in notes[0]


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_used_is_refused_by_name(files, name):
    for which in KERAS:
        for suffix in FORMATS:
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


def test_no_file_and_a_folder_and_weights_alone(tmp_path, files):
    with pytest.raises(UserError, match=r"model\.keras: .*No such file"):
        read_keras(tmp_path / "model.keras")
    with pytest.raises(UserError, match=f"^{tmp_path}: "):
        read_keras(tmp_path)
    with pytest.raises(ModelFileError, match=r"only\.weights\.h5: .*model.save"):
        read_keras(files["keras3"] / "only.weights.h5")


def test_batch_normalisation_by_hand():
    """scale 2 / sqrt(3 + 1) = 1, offset 5 - 1 * 1 = 4 before the ReLU: bias -7 + 4 = -3."""
    arguments = {"epsilon": 1.0, "axis": -1, "scale": True, "center": True}
    values = tuple(np.array([value]) for value in (2.0, 5.0, 1.0, 3.0))
    norm = _Layer("BatchNormalization", "n", arguments, values)
    arguments = {"filters": 1, "kernel_size": 1, "strides": 1, "padding": "same", "groups": 1}
    arrays = np.full((1, 1, 1, 1), 3.0), np.array([-7.0])
    conv = _Layer("Conv2D", "c", {**arguments, "dilation_rate": 1}, arrays)
    relu, flat = _Layer("ReLU", "r", {}, ()), _Layer("Flatten", "f", {}, ())
    end = _Layer("Dense", "o", {"units": 2}, (np.eye(2),))
    own = from_layers((1, 2), (conv, norm, relu, flat, end))
    assert own.architecture == parse("1x2-1c1p-2o")
    assert own.weights["conv1.kernel"].ravel().tolist() == [3.0]
    assert own.weights["conv1.bias"].tolist() == [-3.0]
    assert own.weights["output.bias"].tolist() == [0.0, 0.0]
    # After the ReLU it is the next layer's: its kernel stays, its bias becomes 4 of each input.
    own = from_layers((1, 2), (conv, relu, norm, flat, end))
    assert own.weights["conv1.bias"].tolist() == [-7.0]
    assert own.weights["output.bias"].tolist() == [4.0, 4.0]
