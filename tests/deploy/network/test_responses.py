from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.conformance.networks import make_event_network, make_image_network
from deploy.network.presentation import Presentation
from deploy.network.readout import select_readout
from deploy.network.responses import Responses, compute_responses, compute_seconds_per_sample
from deploy.network.stimulus import Feed


@given(st.integers(0, 300), st.integers(1, 50))
def test_streams_cut_the_samples_in_order(n, length):
    streams = Presentation(stream_length=length).list_streams(n)
    assert [i for s in streams for i in range(n)[s]] == list(range(n))
    assert all(s.stop - s.start == length for s in streams[:-1])


def spikes_of(spec, n):
    layers = [("input", int(np.prod(spec.input_shape)))]
    layers += [(layer.name, layer.size) for layer in spec.layers if layer.neurons is not None]
    return {name: np.zeros((n, size), int) for name, size in layers}


def test_scores_and_decisions_by_hand():
    spec = make_image_network(steps=4, readout_start=1)
    output = np.zeros((1, 4, 10))
    output[0, 0, 9] = 100  # before the readout starts
    output[0, 1, 3] = 3
    output[0, 2, 5] = 8
    output[0, 3, 5] = 1
    responses = compute_responses(spec, output, spikes_of(spec, 1))
    bias = spec.layers[-1].bias
    expected = bias + np.eye(10)[3] * 1 + np.eye(10)[5] * 3
    np.testing.assert_allclose(responses.scores[0], expected)
    means = [np.eye(10)[3] * 3, np.eye(10)[3] * 1.5 + np.eye(10)[5] * 4, expected - bias]
    assert responses.decisions[0].tolist() == [-1, *(int(np.argmax(m + bias)) for m in means)]
    assert responses.predictions.tolist() == responses.decisions[:, -1].tolist()


def test_each_step_is_read_with_the_weights_of_its_part():
    spec = make_image_network(steps=5, readout_start=0)
    readout = spec.layers[-1]
    weights = np.concatenate([readout.weights, 10 * readout.weights, 100 * readout.weights])
    in_parts = replace(readout, weights=weights, section_starts=(0, 1, 3))
    assert in_parts.find_section(np.arange(5)).tolist() == [0, 1, 1, 2, 2]
    spec = replace(spec, layers=(*spec.layers[:-1], in_parts))
    spikes = np.random.default_rng(0).normal(size=(2, 5, weights.shape[1]))
    shown = select_readout(spec, spikes @ weights.T)
    scale = np.array([1, 10, 10, 100, 100])[:, None]
    np.testing.assert_allclose(shown, scale * (spikes @ readout.weights.T))
    # A readout is as linear in sections: the sums of each section times its weights.
    sums = np.concatenate([spikes[:, a:b].sum(1) for a, b in ((0, 1), (1, 3), (3, 5))], axis=1)
    np.testing.assert_allclose(sums @ in_parts.weights_by_class.T, shown.sum(1))
    np.testing.assert_array_equal(
        in_parts.with_weights_by_class(in_parts.weights_by_class).weights, weights
    )


def test_the_readout_on_the_chip_has_no_bias_to_add():
    spec = make_image_network(on_chip_output=True, steps=3, readout_start=0)
    responses = compute_responses(spec, np.ones((2, 3, 10)), spikes_of(spec, 2))
    np.testing.assert_array_equal(responses.scores, 1)


@pytest.mark.parametrize(
    ("decisions", "answer"), [([-1, 3, 4], 4), ([-1, 4, 3], 3), ([-1, -1, -1], 7)]
)
def test_an_answer_is_the_last_decision_or_without_any_the_highest_score(decisions, answer):
    responses = Responses(np.eye(10)[[7]], np.array([decisions]), {}, {})
    assert responses.predictions.tolist() == [answer]


def unbiased(spec):
    readout = spec.layers[-1]
    return replace(spec, layers=(*spec.layers[:-1], replace(readout, bias=0 * readout.bias)))


def test_an_empty_output_is_not_the_answer_class_0():
    """The first spike reaches the readout in step 3, for class 0; in the second sample, none."""
    spec = unbiased(make_event_network(steps=4))
    output = np.zeros((3, 4, 3))
    output[0, 2] = [1, 0, 0]
    output[2, 0] = [0, 0, 2]
    responses = compute_responses(spec, output, spikes_of(spec, 3))
    assert responses.decisions.tolist() == [[-1, -1, 0, 0], [-1] * 4, [2] * 4]


def test_no_early_decision_on_an_empty_output():
    """A softmax of three zeros is 1/3, which is above a threshold of 0.3."""
    spec = unbiased(make_event_network(steps=4, threshold=0.3))
    output = np.zeros((1, 4, 3))
    output[0, 2] = [9, 0, 0]
    assert compute_responses(spec, output, spikes_of(spec, 1)).stopped_at.tolist() == [3]


def test_equal_scores_tie_alike_whatever_the_order_of_adding():
    spec = make_image_network(steps=30, readout_start=0)
    rng = np.random.default_rng(0)
    steps = rng.uniform(size=30)
    output = np.zeros((1, 30, 10))
    output[0, :, 4] = steps * (1 + 1e-14)
    output[0, :, 2] = steps
    output += 10  # far above the biases' differences
    output[:, :, [0, 1, 3, 5, 6, 7, 8, 9]] = -100
    output[0, :, 4] -= spec.layers[-1].bias[4]
    output[0, :, 2] -= spec.layers[-1].bias[2]
    assert compute_responses(spec, output, spikes_of(spec, 1)).predictions.tolist() == [2]


@pytest.mark.parametrize("factor", [1e-25, 1e-9, 1e6])
def test_a_readout_of_another_scale_decides_alike(factor):
    """Scores that were rounded to 9 decimals tied at 0."""
    spec = make_image_network(steps=30, readout_start=0)
    output = np.random.default_rng(0).normal(size=(20, 30, 10))
    readout = spec.layers[-1]
    scaled = replace(readout, weights=readout.weights * factor, bias=readout.bias * factor)
    result = compute_responses(
        replace(spec, layers=(*spec.layers[:-1], scaled)), output * factor, spikes_of(spec, 20)
    )
    expected = compute_responses(spec, output, spikes_of(spec, 20))
    np.testing.assert_array_equal(result.decisions, expected.decisions)
    assert len(set(result.predictions)) > 1


def test_what_is_shown_at_each_step():
    spec = make_image_network(steps=3, gap=2, readout_start=0)
    feed = Feed(spec.presentation, 36)
    feed.samples = np.stack([np.full(36, 0.1), np.full(36, 0.2)])
    shown = [float(feed(step * 0.001)[0]) for step in range(1, 11)]
    assert shown == [0, 0, 0.1, 0.1, 0.1, 0, 0, 0.2, 0.2, 0.2]
    assert compute_seconds_per_sample(spec) == pytest.approx(0.005)
