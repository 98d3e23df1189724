"""Each target on small networks: the presentation to the letter, and near what was meant."""

import re
from dataclasses import replace

import nengo
import numpy as np
import pytest

from deploy.check.bundle import write_bundle
from deploy.check.run import run_check
from deploy.conformance.networks import make_convolution, make_image_network, make_readout
from deploy.errors import UserError
from deploy.network.build import build_nengo_network
from deploy.network.layer import Layer, Neurons
from deploy.network.ops.conv import DeployedConvolution
from deploy.network.ops.dense import DeployedDense
from deploy.network.presentation import Presentation
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import ImageSpikes
from deploy.preflight.plan import make_plan, require_fit_on_chips
from deploy.targets.registry import TARGETS, find_target, run_target
from deploy.targets.simulators import _make_simulator
from tests.deploy.fast_networks import loud_spec, random_spec
from tests.deploy.networks import draw_checks

EQUAL_TARGETS = ("nengo", "simreal", "emulator")


def assert_same(a, b, part=slice(None)):
    np.testing.assert_array_equal(a.scores[part], b.scores)
    np.testing.assert_array_equal(a.decisions[part], b.decisions)
    assert a.spikes.keys() == b.spikes.keys()
    for name in a.spikes:
        np.testing.assert_array_equal(a.spikes[name][part], b.spikes[name])


@pytest.fixture(scope="module")
def images():
    return draw_checks(make_image_network(), 6).inputs


@pytest.mark.parametrize("target", EQUAL_TARGETS)
def test_in_a_stream_of_one_every_sample_is_fresh(target, images):
    fresh = make_image_network(stream_length=1)
    together = run_target(fresh, images[:3], target)
    backwards = run_target(fresh, images[2::-1], target)
    assert_same(together, backwards, slice(None, None, -1))


@pytest.mark.parametrize("target", EQUAL_TARGETS)
def test_a_stream_goes_on_from_the_state_that_it_is_in(target, images):
    fresh = run_target(make_image_network(stream_length=1), images[:3], target)
    stream = run_target(make_image_network(), images[:3], target)
    np.testing.assert_array_equal(stream.scores[0], fresh.scores[0])
    assert (stream.scores[1:] != fresh.scores[1:]).any()


@pytest.mark.parametrize("target", EQUAL_TARGETS)
def test_sample_by_sample_is_the_same_as_in_one_run(target, images):
    spec = make_image_network(gap=4)
    built = build_nengo_network(spec)
    built.feed.samples = images[:3].reshape(3, -1)
    if target == "nengo":
        simulator = nengo.Simulator(built.network, progress_bar=False, optimize=False)
    else:
        simulator = _make_simulator(
            built.network, {"simreal": "simreal", "emulator": "sim"}[target]
        )
    with simulator as sim:
        sim.run_steps(3 * built.feed.period)
        whole = np.array(sim.data[built.output]).reshape(3, built.feed.period, 10)
        counts = {name: np.array(sim.data[p]) for name, p in built.spikes.items()}
    start = spec.presentation.gap + spec.presentation.readout_start
    scores = whole[:, start:].mean(1) + spec.layers[-1].bias
    responses = run_target(spec, images[:3], target)
    np.testing.assert_allclose(responses.scores, scores, atol=1e-12)
    for name, data in counts.items():
        expected = np.count_nonzero(data, axis=1).reshape(3, -1).sum(1)
        np.testing.assert_array_equal(responses.spikes[name], expected)


def test_the_encoder_makes_the_rounded_number_of_spikes():
    spec = make_image_network(steps=50, gap=0, readout_start=0)
    image = np.zeros((1, 6, 6, 1))
    image[0, 0, :5, 0] = [1.0, 0.5, 0.25, 0.1, 0.01]
    counts = run_target(spec, image, "nengo").spikes["input"]
    # 500 Hz for 50 ms: 25, 12.5, 6.25, 2.5 and 0.25 spikes; rounded (a half up or down)
    assert 25 + 12 + 6 + 2 <= counts[0] <= 25 + 13 + 6 + 3


@pytest.mark.parametrize("target", EQUAL_TARGETS)
def test_more_than_a_spike_a_step_is_refused_and_no_less(target):
    spec = make_image_network(steps=30)  # 500 Hz: a pixel of 2 spikes in each of the 30 steps
    image = np.zeros((1, 6, 6, 1))
    image[0, 0, 0, 0] = 2
    assert run_target(spec, image, target).spikes["input"][0] == 30
    image[0, 0, 0, 0] = 63  # a count of events
    with pytest.raises(UserError, match=r"pixel.* 63\b.* 500 "):
        run_target(spec, image, target)


def linear_network(steps, readout_start=0, synapse=None):
    """One convolution of one neuron with a known current, decoded on the host."""
    neurons = Neurons(amplitude=0.01)
    first = Layer(
        name="conv1", operation=DeployedConvolution(2, 2), input_shape=(2, 2, 1),
        neurons=neurons, synapse=0.005,
        weights=np.zeros((2, 2, 1, 2)), bias=np.array([1.6, 0.9]),
    )  # fmt: skip
    output = Layer(
        name="output", operation=DeployedDense(2), input_shape=(1, 1, 2),
        neurons=None, synapse=synapse,
        weights=np.eye(2), bias=np.array([0.25, -0.5]),
    )  # fmt: skip
    presentation = Presentation(steps, 0, readout_start, 1)
    return NetworkSpec("test", (2, 2, 1), ImageSpikes(), (first, output), presentation)


@pytest.mark.parametrize("target", EQUAL_TARGETS)
def test_a_neuron_fires_at_the_rate_of_its_bias_current(target):
    responses = run_target(linear_network(2000), np.zeros((1, 2, 2, 1)), target)
    rate = 1 / (0.001 * np.ceil((0.001 + 0.02 * np.log1p(1 / 0.6)) / 0.001))
    assert responses.spikes["conv1"][0] == pytest.approx(2 * rate, abs=3)
    assert responses.scores[0] == pytest.approx([0.25 + 0.01 * rate, -0.5], rel=0.05)


def test_a_readout_on_the_chip(images):
    spec = make_image_network(on_chip_output=True)
    for target in EQUAL_TARGETS:
        responses = run_target(spec, images[:2], target)
        assert responses.spikes["output"].sum() > 0
        assert np.isfinite(responses.scores).all()


def test_what_nengo_loihi_cannot_build_is_one_error():
    rng = np.random.default_rng(0)
    wide = make_convolution("conv1", (6, 6, 1), 64, 3, rng)
    wider = replace(make_convolution("conv2", wide.shape, 256, 2, rng), block_shape=(3, 3, 256))
    layers = (wide, wider, make_readout(wider.shape, rng))
    spec = NetworkSpec("6x6-64c3-256c2-10o", (6, 6, 1), ImageSpikes(), layers, Presentation())
    with pytest.raises(UserError, match=r"NengoLoihi.* exceeded max"):
        run_target(spec, np.zeros((1, 6, 6, 1)), "emulator")


# The targets that need no board.
ANYWHERE = tuple(name for name, target in TARGETS.items() if not target.needs_board)


# Networks that the chip's integers cannot hold.  A spike of 1,000 makes weights with which the
# threshold rounds to 0: an AssertionError of NengoLoihi.
UNFIT = {
    "max_rate": replace(make_image_network(), stimulus=ImageSpikes(max_rate=1e-3)),
    **{str(seed): random_spec(seed) for seed in (77000, 77017, 77105)},
}


@pytest.mark.parametrize("name", UNFIT)
def test_the_plan_refuses_what_no_integers_can_hold(name):
    with pytest.raises(UserError, match=r"layer (conv|dense|output)\d?: .*\b17 bits") as planned:
        make_plan(UNFIT[name])
    with pytest.raises(UserError, match=re.escape(str(planned.value))):
        require_fit_on_chips(UNFIT[name])  # asked before a board is looked for


@pytest.mark.parametrize("target", ANYWHERE)
@pytest.mark.parametrize("name", UNFIT)
def test_a_target_refuses_what_no_integers_can_hold(name, target):
    spec = UNFIT[name]
    shape = spec.stimulus.find_sample_shape(spec.input_shape, spec.presentation.steps)
    with pytest.raises(UserError) as planned:
        make_plan(spec)
    with pytest.raises(UserError, match=re.escape(str(planned.value))):
        run_target(spec, np.zeros((1, *shape)), target)


def test_an_unknown_target_is_named_with_the_known_ones():
    with pytest.raises(UserError, match="'gpu'.* " + ", ".join(TARGETS)):
        find_target("gpu")


@pytest.mark.parametrize("target", ["emulator", "fast"])
def test_overflows_are_one_line_with_the_remedy(target, tmp_path, capsys, recwarn):
    spec = loud_spec(3, 1)
    checks = draw_checks(spec, 2)
    checks = replace(checks, inputs=np.ones_like(checks.inputs), labels=checks.labels % 3)
    bundle = write_bundle(tmp_path / "bundle", spec, checks)
    run_check(bundle, target, tmp_path / "result.json")
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "wrapped" in line]
    assert target in line
    assert "deployment.input_rate" in line
    assert not [one for one in recwarn if "verflow" in str(one.message)]
