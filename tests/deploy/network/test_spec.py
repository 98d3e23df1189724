import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.conformance.networks import make_convolution, make_image_network, make_readout
from deploy.errors import UserError
from deploy.network.layer import Layer, Neurons
from deploy.network.presentation import Presentation
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import ImageSpikes
from tests.deploy.networks import make_paper_network


def assert_same(a, b):
    assert a == b
    for result, expected in zip(a.layers, b.layers, strict=True):
        np.testing.assert_array_equal(result.weights, expected.weights)
        np.testing.assert_array_equal(result.bias, expected.bias)


@st.composite
def specs(draw):
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    side = draw(st.integers(4, 9))
    shape, layers = (side, side, draw(st.integers(1, 2))), []
    for index in range(draw(st.integers(1, 3))):
        layer = make_convolution(
            f"conv{index + 1}", shape, draw(st.integers(1, 5)), draw(st.integers(1, 2)), rng
        )
        neurons = Neurons(
            draw(st.floats(1e-4, 1)),
            draw(st.floats(1e-3, 1)),
            draw(st.floats(0, 0.01)),
            -draw(st.floats(0, 2)),
        )
        synapse = draw(st.none() | st.floats(1e-4, 0.1))
        block = draw(st.none() | st.just((1, 1, layer.shape[2])))
        layer = replace(layer, neurons=neurons, synapse=synapse)
        layers.append(replace(layer, block_shape=block))
        shape = layer.shape
    layers.append(make_readout(shape, rng, draw(st.integers(2, 12)), draw(st.booleans())))
    steps = draw(st.integers(1, 300))
    return NetworkSpec(
        architecture=draw(st.text(max_size=9)),
        input_shape=layers[0].input_shape,
        stimulus=ImageSpikes(draw(st.floats(1, 1000)), draw(st.floats(0, 0.9))),
        layers=tuple(layers),
        presentation=Presentation(
            steps,
            draw(st.integers(0, 50)),
            draw(st.integers(0, steps - 1)),
            draw(st.integers(1, 9)),
        ),
        provenance={"seed": draw(st.integers(0, 5)), "simulated": draw(st.booleans())},
    )


@given(specs())
def test_round_trip_through_json_text(spec):
    text = json.dumps(spec.to_json(), allow_nan=False)
    assert_same(NetworkSpec.from_json(json.loads(text), spec.to_arrays()), spec)


@given(
    place=st.sampled_from(
        [(), ("layers", 0), ("layers", 0, "neurons"), ("stimulus",), ("presentation",)]
    ),
    junk=st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.lists(st.none()),
    pick=st.integers(0, 99),
)
def test_any_value_in_any_place_is_taken_or_refused_in_one_line(place, junk, pick):
    spec = make_image_network()
    value = json.loads(json.dumps(spec.to_json()))
    target = value
    for key in place:
        target = target[key]
    target[sorted(target)[pick % len(target)]] = junk
    try:
        NetworkSpec.from_json(value, spec.to_arrays())
    except UserError as error:
        assert "\n" not in str(error)  # noqa: PT017 - anything else is a crash


def changed(path, value):
    plain = json.loads(json.dumps(make_paper_network().to_json()))
    target = plain
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    return plain


@pytest.mark.parametrize(
    ("path", "value", "fact"),
    [
        (("dt",), 0.002, "0.002 s.* 0.001 s"),
        (("layers",), [], "layers"),
        (("layers", 0, "kind"), "pool", r"'layers\[0\].kind' .*conv, dense"),
        (("layers", 0, "placement"), "gpu", r"'layers\[0\].placement' .*chip, host"),
        (("layers", 0, "neurons"), None, "layer 'conv1': .*neurons"),
        (("layers", 0, "neurons", "amplitude"), 0, "amplitude"),
        (("layers", 0, "neurons", "tau_rc"), 0, r"'layers\[0\].neurons.tau_rc'.* 1e-06"),
        (("layers", 0, "neurons", "min_voltage"), 1, "min_voltage"),
        (("layers", 0, "neurons", "extra"), 1, "extra"),
        (("layers", 0, "synapse"), 0, "synapse.* 1e-06"),
        (("layers", 0, "shape"), [7, 7, 5], r"weights.*\(4, 4, 1, 6\).*\(4, 4, 1, 5\)"),
        (("layers", 0, "shape"), [8, 7, 6], r"shape.*\(7, 7, 6\)"),
        (("layers", 0, "shape"), "abc", "shape.*'abc'"),
        (("layers", 0, "input_shape"), [10, 10], r"input_shape \(10, 10\)"),
        (("layers", 1, "input_shape"), [7, 7, 5], "layer 'conv2'"),
        (("layers", 1, "name"), "conv1", "'conv1': weights"),  # reads the arrays of the other
        (("layers", 2, "shape"), [9], r"weights.*\(10, 600\).*\(9, 600\)"),
        (("input_shape",), [10, 10, 2], r"layer 'conv1': input_shape.*\(10, 10, 2\)"),
        (("stimulus", "max_rate"), 2000, "max_rate.* 1000"),
        (("stimulus", "initial_phase"), 1, "initial_phase"),
        (("stimulus", "kind"), "film", "'film'.*image-spikes"),
        (("presentation", "steps"), 0, "'presentation.steps'.* 1 to 10000"),
        (("presentation", "steps"), 10**5, r"'presentation.steps'.* 1 to 10000\b"),
        (("presentation", "steps"), 40.5, "'presentation.steps'"),
        (("presentation", "gap"), -1, "'presentation.gap'.* 0 to 10000"),
        (("presentation", "gap"), 10**22, r"'presentation.gap'.* 0 to 10000\b"),
        (("presentation", "readout_start"), 100, r"'presentation.readout_start'.*\(100\)"),
        (("presentation", "stream_length"), 0, "'presentation.stream_length'.* 1 to"),
        (("presentation", "stream_length"), True, "'presentation.stream_length'"),
    ],
)
def test_what_does_not_fit_is_named(path, value, fact):
    with pytest.raises(UserError, match=fact):
        NetworkSpec.from_json(changed(path, value), make_paper_network().to_arrays())


def test_weights_must_be_finite():
    spec = make_paper_network()
    broken = {**spec.to_arrays(), "conv2.weights": spec.layers[1].weights * np.nan}
    with pytest.raises(UserError, match=r"'conv2': weights.*NaN"):
        NetworkSpec.from_json(spec.to_json(), broken)


def test_weights_must_be_numbers():
    spec = make_paper_network()
    broken = {**spec.to_arrays(), "conv2.weights": np.array([["a"]])}
    with pytest.raises(UserError, match="'conv2': weights"):
        NetworkSpec.from_json(spec.to_json(), broken)


def test_the_order_of_the_layers():
    conv1, conv2, output = make_image_network().layers
    common = dict(architecture="", input_shape=(6, 6, 1), presentation=Presentation())
    with pytest.raises(UserError, match="'conv2': 'conv' cannot be the last"):
        NetworkSpec(stimulus=ImageSpikes(), layers=(conv1, conv2), **common)
    with pytest.raises(UserError, match=r"'conv2': input_shape.*\(6, 6, 1\)"):
        NetworkSpec(stimulus=ImageSpikes(), layers=(conv2, output), **common)
    with pytest.raises(UserError, match="'input'"):
        NetworkSpec(
            stimulus=ImageSpikes(), layers=(replace(conv1, name="input"), conv2, output), **common
        )
    for name, fact in (("conv1", "two .* name"), ("x" * 200, "short"), ("", "short")):
        with pytest.raises(UserError, match=f"network: .*{fact}"):
            NetworkSpec(
                stimulus=ImageSpikes(), layers=(conv1, replace(conv2, name=name), output), **common
            )
    assert isinstance(conv1, Layer)
    assert conv1.size == 64
