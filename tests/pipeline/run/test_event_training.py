"""What is learnt from and what is held back, when a network on events is trained."""

import numpy as np
import pytest

from deploy.network.decision import Threshold
from pipeline.inputs.dataset import Dataset
from pipeline.run import event_training
from pipeline.settings import Settings
from pipeline.training.events import TrainedOnEvents

EVENTS = {"input": {"kind": "events", "step": 125.0}, "data": {"samples_per_digit": 6}}


@pytest.fixture
def told(monkeypatch):
    """What training and the choice of the threshold are given, in the place of both."""
    told = {}

    def train_events(recipe, table, labels, train, seed, checkpoint, advance, start):
        told.update(recipe=recipe, learn=train, seed=seed, checkpoint=checkpoint)
        return TrainedOnEvents(recipe, {})

    def threshold(self, table, labels, held, steps, seed):
        told.update(held=held, steps=steps)
        return Threshold(0.9, 1.0, 0.5)

    monkeypatch.setattr(event_training, "train_events", train_events)
    monkeypatch.setattr(TrainedOnEvents, "threshold", threshold)
    return told


def trained(changes):
    settings = Settings().with_values({**EVENTS, **changes}, "here")
    dataset = Dataset.of(settings)
    samples = event_training.set_apart(dataset, 3)
    network = event_training.train(settings, samples, 3, "state.npz")
    chosen = event_training.choose(settings, samples, network, 3)
    return dataset.split, chosen, len(samples.held)


def test_without_validation_some_training_samples_are_held_back(told):
    split, chosen, samples = trained({})
    assert not len(split.validation)
    assert (told["seed"], told["checkpoint"], told["steps"]) == (3, "state.npz", 16)
    assert told["recipe"].step_ms == 125.0
    assert samples == len(told["held"]) > 0
    assert samples < event_training.FEWEST_HELD
    assert (chosen.confidence, chosen.share) == (1, 1)  # waits for the end
    both = np.concatenate([told["learn"], told["held"]])
    np.testing.assert_array_equal(np.sort(both), split.train)


def test_with_validation_samples_they_are_what_is_held_back(told):
    enough = {"samples_per_digit": 30}
    split, chosen, samples = trained({"split": {"validation_fraction": 0.5}, "data": enough})
    assert samples == len(split.validation) == 120
    assert chosen.confidence == 0.9
    np.testing.assert_array_equal(told["learn"], split.train)
    np.testing.assert_array_equal(told["held"], split.validation)
