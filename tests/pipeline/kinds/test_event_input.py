"""Rules by which a network on events reads and learns recordings."""

import numpy as np
import pytest

from pipeline.kinds.events import input_choice
from pipeline.training.event_updates import MIN_EPOCHS, MIN_UPDATES, choose_epochs
from tests.pipeline.handmade import event_table


def table_of(counts_of, samples=120, taxels=6, classes=3, length=1000.0):
    """Recordings whose events a function of (rng, class) draws as (times in ms, taxels)."""
    rng = np.random.default_rng(0)
    labels = np.arange(samples) % classes
    events = [counts_of(rng, label) for label in labels]
    events = [(np.sort(t), x[np.argsort(t)]) for t, x in events]
    offsets = np.cumsum([0, *(len(t) for t, _ in events)])
    time, taxel = (np.concatenate(column) for column in zip(*events, strict=True))
    nothing = np.zeros(len(time), np.uint8)
    table = event_table((time.astype("f4"), nothing, taxel, nothing), offsets, (1, taxels))
    return table, labels


def test_what_only_time_tells_is_read_in_parts():
    def events(rng, label):
        when = {0: (0, 200), 1: (300, 480), 2: (770, 990)}[int(label)]
        return np.append(rng.uniform(*when, 8), 0.0), rng.integers(0, 6, 9)

    table, labels = table_of(events)
    train = np.arange(len(labels))
    reading = input_choice.choose_input(table, labels, train, 10.0, 100)
    assert reading.n_sections > 1
    assert reading.accuracy > 0.7
    again = input_choice.choose_input(table, labels, train, 10.0, 100)
    assert again == reading
    assert input_choice.choose_input(table, labels, train[:1], 10.0, 100).n_sections == 1


def test_what_place_tells_needs_no_parts_and_the_longest_period():
    def events(rng, label):
        return rng.uniform(0, 990, 15), np.full(15, int(label))

    reading = input_choice.choose_input(*table_of(events), np.arange(120), 10.0, 100)
    assert (reading.n_sections, reading.refractory_steps) == (1, max(input_choice.REFRACTORY_STEPS))
    assert 0.3 < reading.lost < 0.95
    assert "sections" not in reading.describe(10.0, reading.n_sections)


def test_a_period_that_loses_most_events_is_not_chosen():
    def events(rng, label):
        return rng.uniform(0, 990, 60), np.full(60, int(label))

    table, labels = table_of(events)
    reading = input_choice.choose_input(table, labels, np.arange(120), 10.0, 100)
    longest = max(input_choice.REFRACTORY_STEPS)
    assert table.measure_loss(10.0, longest) > input_choice.MAX_LOST_EVENT_SHARE
    assert reading.lost <= input_choice.MAX_LOST_EVENT_SHARE


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        ([0.0, 40.0, 100.0], 20.0),
        ([0.0, 40.0, 100.013], None),
        ([0.0, 300.0], None),  # longer than any bin
        ([0.0], None),
        ([], None),
    ],
)
def test_the_bin_of_counted_events_is_found(times, expected):
    n = len(times)
    nothing = np.zeros(n, np.uint8)
    table = event_table((times, nothing, nothing, nothing), np.array([0, n]))
    assert input_choice.compute_bin_ms(table) == expected


def test_left_out_accuracy_is_that_of_fits_without_the_sample():
    rng = np.random.default_rng(0)
    labels = np.arange(24) % 3
    inputs = rng.normal(size=(24, 4)) + 0.8 * np.eye(4)[labels]
    centred = inputs - inputs.mean(0)
    kernel = centred @ centred.T
    kernel = kernel / (np.trace(kernel) / 24) + 1
    classes = np.eye(3)[labels]
    best = 0.0
    for ridge in input_choice.RIDGES:
        right = 0
        for out in range(24):
            rest = np.delete(np.arange(24), out)
            inner = kernel[np.ix_(rest, rest)] + ridge * np.eye(23)
            scores = kernel[out, rest] @ np.linalg.solve(inner, classes[rest])
            right += scores.argmax() == labels[out]
        best = max(best, right / 24)
    assert input_choice.measure_left_out_accuracy(inputs, labels) == pytest.approx(best)


@pytest.mark.parametrize(("samples", "expected"), [(576, 80), (1079, 58), (5271, MIN_EPOCHS)])
def test_the_number_of_updates_is_fixed(samples, expected):
    assert choose_epochs(samples, 32) == expected


def test_few_samples_have_as_many_updates():
    assert choose_epochs(200, 32) * 7 == pytest.approx(MIN_UPDATES, rel=0.01)
