"""Training samples and held-out samples of networks on events."""

import numpy as np
import pytest

from deploy.network.decision import Threshold
from pipeline.kinds.events import kind as events
from pipeline.kinds.events.kind import choose_early_threshold, hold_out_event_samples
from pipeline.settings import Settings
from pipeline.sources import load_dataset
from pipeline.training.events import TrainedOnEvents

EVENTS = {"input": {"kind": "events", "step": 125.0}, "data": {"samples_per_digit": 6}}


@pytest.fixture
def choice(monkeypatch):
    """The arguments of the choice of the threshold, which is replaced."""
    given = {}

    def threshold(self, table, labels, held_out, steps, seed, loss):
        given.update(held_out=held_out, steps=steps, loss=loss)
        return Threshold(0.9, 1.0, 0.5)

    monkeypatch.setattr(TrainedOnEvents, "choose_threshold", threshold)
    return given


def chosen_on(changes):
    settings = Settings().with_values({**EVENTS, **changes}, "here")
    dataset = load_dataset(settings)
    samples = hold_out_event_samples(dataset, 3)
    chosen = choose_early_threshold(
        settings, samples, TrainedOnEvents.from_weights(settings, {}), 3
    )
    return dataset.split, samples, chosen


def test_few_samples_are_all_trained_on(choice):
    split, samples, chosen = chosen_on({})
    assert len(split.validation) == len(samples.held_out) == 0
    assert choice == {}
    assert (chosen.value, chosen.share) == (1, 1)  # waits for the end
    np.testing.assert_array_equal(samples.train, split.train)


def test_without_validation_some_training_samples_are_held_out(choice, monkeypatch):
    monkeypatch.setattr(events, "MIN_HELD_OUT", 3)
    split, samples, chosen = chosen_on({})
    assert choice["steps"] == 16
    np.testing.assert_array_equal(choice["held_out"], samples.held_out)
    assert 3 <= len(samples.held_out) < 10
    assert chosen.value == 0.9
    both = np.concatenate([samples.train, samples.held_out])
    np.testing.assert_array_equal(np.sort(both), split.train)


def test_validation_samples_are_the_held_out_samples(choice):
    enough = {"samples_per_digit": 30}
    changes = {"split": {"validation_fraction": 0.5}, "data": enough}
    split, samples, chosen = chosen_on(changes)
    assert len(choice["held_out"]) == len(split.validation) == 120
    assert chosen.value == 0.9
    np.testing.assert_array_equal(samples.train, split.train)
    np.testing.assert_array_equal(choice["held_out"], split.validation)
