import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from models.architecture import (
    MAX_LAYERS,
    Architecture,
    NotationError,
    parse_architecture,
)
from models.ops import Convolution, Dense, Pooling


def test_the_papers_networks():
    cnn = parse_architecture("10x10-6c4-24c3-10o")
    assert cnn == Architecture(
        (10, 10, 1), (Convolution(6, 4), Convolution(24, 3), Dense(10, is_output=True))
    )
    assert cnn.shapes == ((10, 10, 1), (7, 7, 6), (5, 5, 24), (10,))
    assert cnn.names == ("conv1", "conv2", "output")
    assert cnn.layers[:2] == (Convolution(6, 4), Convolution(24, 3))
    assert cnn.outputs == 10
    slayer = parse_architecture("10x10x2-6c2-24c3-10o")
    assert slayer.shapes == ((10, 10, 2), (9, 9, 6), (7, 7, 24), (10,))


def test_what_the_papers_network_costs_by_hand():
    cnn = parse_architecture("10x10-6c4-24c3-10o")
    assert cnn.n_values == {"conv1": 294, "conv2": 600, "output": 10}
    # 49 positions x 16 x 6, 25 positions x 9 x 6 x 24, 600 x 10
    assert cnn.multiply_accumulates == {"conv1": 4704, "conv2": 32400, "output": 6000}
    assert sum(cnn.multiply_accumulates.values()) == 43104
    assert cnn.parameters == 16 * 6 + 6 + 9 * 6 * 24 + 24 + 600 * 10 + 10


def test_a_notation_with_every_operation():
    network = parse_architecture("10x10x2-12c4s2p-2a-64-10o")
    assert network.layers == (
        Convolution(12, 4, 2, "same"),
        Pooling(2),
        Dense(64),
        Dense(10, is_output=True),
    )
    assert network.shapes == ((10, 10, 2), (5, 5, 12), (2, 2, 12), (64,), (10,))
    assert network.names == ("conv1", "pool1", "dense1", "output")


def test_layers_are_numbered_by_operation():
    assert parse_architecture("10x10-2c3-2a-2c2-2a-4-5-3o").names == (
        "conv1", "pool1", "conv2", "pool2", "dense1", "dense2", "output",
    )  # fmt: skip


def test_weights_by_hand():
    assert parse_architecture("10x10x2-12c4s2-64-10o").weight_shapes == {
        "conv1.kernel": (4, 4, 2, 12),
        "conv1.bias": (12,),
        "dense1.kernel": (192, 64),
        "dense1.bias": (64,),
        "output.kernel": (64, 10),
        "output.bias": (10,),
    }
    assert list(parse_architecture("10x10-2a-10o").weight_shapes) == [
        "output.kernel",
        "output.bias",
    ]


def test_same_padding_puts_what_is_odd_at_the_end():
    # 10 values, kernel 4, stride 2: 5 outputs take (5 - 1) 2 + 4 - 10 = 2 zeros
    assert Convolution(1, 4, 2, "same").compute_padding((10, 10, 1)) == ((1, 1), (1, 1))
    # kernel 4, stride 1: 3 zeros, one before; kernel 2, stride 2: none
    assert Convolution(1, 4, 1, "same").compute_padding((10, 7, 1)) == ((1, 2), (1, 2))
    assert Convolution(1, 2, 2, "same").compute_padding((10, 9, 1)) == ((0, 0), (0, 1))


def test_fan_out_by_hand():
    # Four windows of 3 at stride 2 on 9 values begin at 0, 2, 4, 6; two filters.
    line = np.array([1, 1, 2, 1, 2, 1, 2, 1, 1])
    fan_out = Convolution(2, 3, 2).count_fan_out((9, 9, 1))
    np.testing.assert_array_equal(fan_out[:, :, 0], 2 * np.outer(line, line))
    # Of 7 values pooled by 3 the last is not read.
    np.testing.assert_array_equal(Pooling(3).count_fan_out((7, 3, 1))[:, 0, 0], [1] * 6 + [0])
    np.testing.assert_array_equal(Dense(5).count_fan_out((2, 2)), np.full((2, 2), 5))


@pytest.mark.parametrize("padding", ["valid", "same"])
@pytest.mark.parametrize("stride", [1, 2, 3, 5])
@pytest.mark.parametrize("kernel", [1, 2, 3, 4])
def test_shape_and_fan_out_are_tensorflows(kernel, stride, padding):
    from models.keras.keras2 import tf

    layer, shape = Convolution(3, kernel, stride, padding), (7, 10, 2)
    frame = tf.Variable(tf.zeros((1, *shape)))
    with tf.GradientTape() as tape:
        ones = tf.ones(layer.compute_kernel_shape(shape))
        result = tf.nn.conv2d(frame, ones, stride, padding.upper())
    assert result.shape[1:] == layer.compute_shape(shape)
    gradient = tape.gradient(result, frame)[0]
    np.testing.assert_array_equal(layer.count_fan_out(shape), gradient.numpy())


@pytest.mark.parametrize("size", [1, 2, 3, 7])
def test_pooling_is_tensorflows(size):
    from models.keras.keras2 import tf

    layer, shape = Pooling(size), (7, 10, 2)
    frame = tf.Variable(tf.zeros((1, *shape)))
    with tf.GradientTape() as tape:
        result = tf.nn.avg_pool2d(frame, size, size, "VALID") * size**2
    assert result.shape[1:] == layer.compute_shape(shape)
    gradient = tape.gradient(result, frame)[0]
    np.testing.assert_allclose(layer.count_fan_out(shape), gradient.numpy())


@pytest.mark.parametrize(
    ("text", "token", "fact"),
    [
        ("", "token 1 ('')", "10x10x2"),
        ("6c4-10o", "token 1 ('6c4')", "10x10x2"),
        ("10-6c4-10o", "token 1 ('10')", "10x10x2"),
        ("10x10x2x2-10o", "token 1 ('10x10x2x2')", "10x10x2"),
        ("0x10-10o", "token 1 ('0x10')", "zero"),
        ("10x10x0-10o", "token 1 ('10x10x0')", "zero"),
        ("10x10", "token 1 ('10x10')", "10o"),
        ("10x10-6c4", "token 2 ('6c4')", "10o"),
        ("10x10-10o-6c4", "token 3 ('6c4')", "10o"),
        ("10x10-10o-", "token 3 ('')", "10o"),
        ("10x10-6c4-1o", "token 3 ('1o')", "at least 2"),
        ("10x10-6c4-0o", "token 3 ('0o')", "zero"),
        ("10x10-6p2-10o", "token 2 ('6p2')", "6c4s2"),
        ("10x10--10o", "token 2 ('')", "6c4s2"),
        ("10x10-6C4-10o", "token 2 ('6C4')", "6c4s2"),
        ("10x10-6c4ps2-10o", "token 2 ('6c4ps2')", "6c4s2"),
        ("10x10-6c4s-10o", "token 2 ('6c4s')", "6c4s2"),
        ("10x10-6c٤-10o", "token 2 ('6c٤')", "6c4s2"),
        ("10x10-10o-10o", "token 2 ('10o')", "output"),
        ("10x10-0c4-10o", "token 2 ('0c4')", "zero"),
        ("10x10-6c0-10o", "token 2 ('6c0')", "zero"),
        ("10x10-6c2s0-10o", "token 2 ('6c2s0')", "zero"),
        ("10x10-0a-10o", "token 2 ('0a')", "zero"),
        ("10x10-0-10o", "token 2 ('0')", "zero"),
        ("10x10-6c11-10o", "token 2 ('6c11')", "10x10 input"),
        ("10x10-6c8-6c4-10o", "token 3 ('6c4')", "3x3 input"),
        ("10x3-6c4-10o", "token 2 ('6c4')", "10x3 input"),
        ("10x10-6c4-8a-10o", "token 3 ('8a')", "7x7 input"),
        ("10x10-64-6c4-10o", "token 3 ('6c4')", "rows and columns"),
        ("10x10-64-2a-10o", "token 3 ('2a')", "rows and columns"),
        ("1001x1000-10o", "token 1 ('1001x1000')", " 1000000 values"),
        ("10x10-1000001-10o", "token 2 ('1000001')", " 1000000 values"),
        ("10x10-20001c1-10o", "token 2 ('20001c1')", " 1000000 values"),
        ("10x10-20000-20000-10o", "token 3 ('20000')", " 100000000 weights"),
        ("10x10-1c99999p-10o", "token 2 ('1c99999p')", " 100000000 weights"),
        ("-".join(["10x10", *["8"] * MAX_LAYERS, "10o"]), "token 66 ('10o')", f" {MAX_LAYERS}"),
        ("10x10-" + "9" * 5000 + "-10o", "token 2 ('9999", "6c4s2"),
    ],
)
def test_an_error_names_its_token(text, token, fact):
    with pytest.raises(NotationError) as caught:
        parse_architecture(text)
    assert token in str(caught.value)
    assert fact in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("shape", "layers", "fact"),
    [
        ((10, 10), (Dense(2, is_output=True),), r"\(10, 10\).*\(rows, columns, channels\)"),
        ((10, 10, 1), (), "output"),
        ((10, 10, 1), (Dense(4),), "output"),
        ((10, 10, 1), (Dense(4), Pooling(2), Dense(2, is_output=True)), "rows and columns"),
        ((10, 10, 1), (Dense(4, is_output=True), Dense(2, is_output=True)), "output"),
        ((2, 2, 1), (Convolution(1, 3), Dense(2, is_output=True)), "2x2"),
    ],
)
def test_an_impossible_architecture_is_refused(shape, layers, fact):
    with pytest.raises(ValueError, match=fact):
        Architecture(shape, layers)


convolutions = st.builds(
    Convolution,
    filters=st.integers(1, 8),
    kernel_size=st.integers(1, 5),
    stride=st.integers(1, 4),
    padding=st.sampled_from(["valid", "same"]),
)


@given(
    size=st.tuples(st.integers(4, 40), st.integers(4, 40), st.integers(1, 3)),
    spatial=st.lists(convolutions | st.builds(Pooling, st.integers(1, 4)), max_size=4),
    dense=st.lists(st.builds(Dense, st.integers(1, 100)), max_size=2),
    outputs=st.integers(2, 100),
)
def test_writing_and_reading_gives_the_same(size, spatial, dense, outputs):
    try:
        architecture = Architecture(size, (*spatial, *dense, Dense(outputs, is_output=True)))
    except ValueError:
        assume(False)
    assert parse_architecture(str(architecture)) == architecture
    assert len(architecture.names) == len(set(architecture.names)) == len(architecture.layers)
    for shape in architecture.shapes:
        assert min(shape) >= 1
    for name, shape in zip(architecture.names, architecture.shapes, strict=False):
        assert architecture.fan_out[name].shape == shape
