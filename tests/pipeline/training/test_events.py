from dataclasses import replace

import numpy as np
import pytest

from deploy.errors import UserError
from deploy.network.decision import Estimator, choose_threshold
from models.architecture import parse_architecture
from models.spiking.network import SpikingNetwork
from pipeline.paper import CNN_MACS
from pipeline.recordings.augmentation import AUGMENTATIONS, Alteration
from pipeline.training.event_samples import EventSamples
from pipeline.training.event_updates import TAIL_STEPS
from pipeline.training.events import (
    Checkpoint,
    EventDesign,
    delay_as_on_chip,
    network,
    run_on_frames,
    train_events,
    trainer,
)
from tests.models import spiking_in_numpy
from tests.pipeline.handmade import event_table

DESIGN = EventDesign(
    architecture="10x10x2-6c4s3-16-3o", epochs=6, batch_size=8, learning_rate=0.02, average=0.9,
    dropout=0.0, budget=0.5,
    alteration=Alteration(turn=0.02, shift=0.1, scale=0.02, shear=0.02),
)  # fmt: skip


@pytest.fixture(scope="module")
def data():
    """Bars at the left, in the middle and at the right, in noise: 72 samples of 3 classes."""
    rng = np.random.default_rng(0)
    labels, n = np.arange(72) % 3, 90
    offsets = np.arange(73) * n
    time = np.sort(rng.uniform(0, 600, (72, n)), 1)
    time -= time[:, :1]
    column = rng.integers(0, 10, (72, n))
    bar = rng.random((72, n)) < 0.7
    column[bar] = (labels[:, None] * 3 + rng.integers(1, 3, (72, n)))[bar]
    row, polarity = rng.integers(0, 10, (72, n)), rng.integers(0, 2, (72, n))
    columns = (values.ravel().astype(np.uint8) for values in (row, column, polarity))
    table = event_table((time.ravel().astype(np.float32), *columns), offsets)
    return table, labels, np.arange(54)


VALIDATION = np.arange(54, 72)


@pytest.fixture(scope="module")
def told():
    """Inputs of the confidence estimator of `trained`, by name."""
    return {}


@pytest.fixture(scope="module")
def trained(data, told):
    def train_estimator(outputs, right, seed):
        told.update(outputs=outputs, right=right)
        return learn(outputs, right, seed)

    learn = trainer.train_estimator
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer, "train_estimator", train_estimator)
        return train_events(DESIGN, EventSamples(*data, VALIDATION), seed=3)


def test_of_whatever_length_samples_are_a_network_is_traced_once(trained):
    for steps, samples in ((32, 100), (48, 100), (32, 7)):
        trained.run_on_frames(np.zeros((samples, steps, 10, 10, 2), np.uint8))
    assert network._compile(DESIGN).experimental_get_tracing_count() == 1


def answers_to(weights, table, indices, steps):
    """What the trained network answers to samples, each from rest."""
    frames = table.make_frames(indices, DESIGN.step_ms, steps, DESIGN.limits)
    return run_on_frames(DESIGN, weights, np.moveaxis(frames, 0, 1))


def test_it_learns(trained):
    assert [row["epoch"] for row in trained.history] == [1, 2, 3, 4, 5, 6]
    assert trained.history[-1]["loss"] < trained.history[0]["loss"] / 2
    assert trained.history[-1]["val_accuracy"] >= 15 / 18


def test_the_estimator_learns_from_samples_as_they_are_and_altered(trained, told, data):
    table, labels, train = data
    order = train[np.argsort(table.duration_ms[train], kind="stable")]
    assert len(told["outputs"]) == len(told["right"]) == 2 * len(train)
    steps = int(table.duration_ms.max() / DESIGN.step_ms) + 1 + TAIL_STEPS
    answers = answers_to(trained.weights, table, order, steps)
    arrived, differ = delay_as_on_chip(answers.outputs, DESIGN), 0
    for sample, seen, changed, right, label in zip(
        arrived, told["outputs"], told["outputs"][len(train) :], told["right"], labels[order],
        strict=False,
    ):  # fmt: skip
        np.testing.assert_allclose(seen, sample[: len(seen)], atol=1e-3)
        np.testing.assert_array_equal(right, seen.argmax(-1) == label)
        differ += changed.shape != seen.shape or not np.allclose(changed, seen)
    assert differ == len(train)


def test_weights_have_the_names_and_shapes_of_the_architecture(trained):
    architecture = parse_architecture(DESIGN.architecture)
    arrays = {k: np.shape(v) for k, v in trained.weights.items() if np.ndim(v)}
    expected = dict(architecture.weight_shapes)
    del expected["output.bias"]  # the readout is a sum of spikes' weights and nothing else
    assert arrays == {**expected, **Estimator.list_shapes(3)}
    assert trained.weights["conv1.tau_u"] > 0
    assert trained.estimator(np.zeros((5, 3))).shape == (5,)


def test_answers_are_the_chips_integers(trained, data):
    table, labels, _ = data
    answers = answers_to(trained.weights, table, VALIDATION, steps=64)
    network = SpikingNetwork(parse_architecture(DESIGN.architecture))
    network.set_weights(trained.weights)
    frames = table.make_frames(VALIDATION, DESIGN.step_ms, 64, DESIGN.limits)
    for index in (0, 7):
        conv, dense = spiking_in_numpy.network(
            network.architecture, network.compute_integers(), frames[:, index]
        )
        np.testing.assert_array_equal(answers.spikes["conv1"][index], conv.sum(0))
        np.testing.assert_array_equal(answers.spikes["dense1"][index], dense.sum(0))
        expected = np.cumsum(dense @ trained.weights["output.kernel"], 0)
        np.testing.assert_allclose(answers.outputs[index], expected, atol=1e-4)
        assert answers.operations[index, -1] == 3 * dense.sum()
    right = answers.outputs[:, -1].argmax(-1) == labels[VALIDATION]
    assert right.mean() == trained.history[-1]["val_accuracy"]
    cost = answers.operations.sum(1).mean() / CNN_MACS
    assert cost == pytest.approx(trained.history[-1]["val_operations"], rel=0.02)
    last = np.floor(table.duration_ms[VALIDATION] / DESIGN.step_ms)
    np.testing.assert_array_equal(answers.last_step, last)


def test_outputs_arrive_a_step_later_for_the_relay_and_each_layer():
    # conv1 and dense1 on the chip: the relay's step, and one for each of the two.
    outputs = np.arange(2 * 5 * 3.0).reshape(2, 5, 3) + 1
    found = delay_as_on_chip(outputs, DESIGN)
    assert found[:, :3].tolist() == np.zeros((2, 3, 3)).tolist()
    np.testing.assert_array_equal(found[:, 3:], outputs[:, :2])
    np.testing.assert_array_equal(delay_as_on_chip(outputs[0, :2], DESIGN), np.zeros((2, 3)))


def without_alteration(trained):
    return replace(trained, design=replace(DESIGN, alteration=AUGMENTATIONS["none"]))


def test_the_threshold_is_that_of_what_arrives(trained, data):
    table, labels, _ = data
    none = without_alteration(trained)
    # Not altered but for where in its first step a sample begins.
    step_ns = int(1e6 * DESIGN.step_ms)
    whole_ns = table.events.time_ns // step_ns * step_ns
    whole = replace(table, events=replace(table.events, time_ns=whole_ns))
    plain = answers_to(trained.weights, whole, VALIDATION, 40)
    expected = choose_threshold(
        delay_as_on_chip(plain.outputs, DESIGN),
        labels[VALIDATION],
        plain.last_step,
        estimator=trained.estimator,
    )
    assert none.choose_threshold(whole, labels, VALIDATION, 40, 0, 0.005) == pytest.approx(expected)


def test_altered_samples_have_a_part_in_the_threshold(trained, data):
    table, labels, _ = data
    none = without_alteration(trained)
    altered = trained.choose_threshold(table, labels, VALIDATION, 40, 0, 0.005)
    assert altered == trained.choose_threshold(table, labels, VALIDATION, 40, 0, 0.005)
    assert altered.share != none.choose_threshold(table, labels, VALIDATION, 40, 0, 0.005).share
    assert 0 < altered.share <= 1


def test_a_budget_is_kept(trained, data):
    assert trained.history[-1]["operations"] < DESIGN.budget  # it costs nothing there
    tight = train_events(
        replace(DESIGN, budget=0.0, price=50.0), EventSamples(*data, VALIDATION[:0]), seed=3
    )
    assert tight.history[-1]["operations"] < 0.8 * trained.history[-1]["operations"]


def test_an_interrupted_training_ends_as_it_would_have(trained, data, tmp_path):
    def interrupt(n, note):
        seen.append(n)
        if len(seen) == 3:
            raise KeyboardInterrupt

    seen, path = [], Checkpoint(tmp_path / "state.npz", "this one")
    with pytest.raises(KeyboardInterrupt):
        train_events(DESIGN, EventSamples(*data, VALIDATION), 3, path, interrupt)
    seen = [0, 0, 0]
    resumed = train_events(DESIGN, EventSamples(*data, VALIDATION), 3, path, interrupt)
    assert seen[3:] == [3, 1, 1, 1]
    for name, value in resumed.weights.items():
        np.testing.assert_allclose(value, trained.weights[name], rtol=1e-4, atol=1e-6)
    for got, expected in zip(resumed.history, trained.history, strict=True):
        assert got["loss"] == pytest.approx(expected["loss"], rel=1e-5)


def test_samples_without_events_are_left_out(data):
    table, labels, _ = data
    empty = replace(table, offsets=np.zeros_like(table.offsets))
    with pytest.raises(UserError, match="event"):
        train_events(DESIGN, EventSamples(empty, labels, np.arange(10), np.arange(0)), 0)
