"""Splits of samples: at random, by writers, and as published."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.recordings.splits import (
    Split,
    draw_check_samples,
    find_classes_without_test,
    find_copies,
    find_split_problem,
    hold_out_samples,
    make_split,
    split_as_published,
    split_at_random,
    split_by_writers,
)
from tests.pipeline.handmade import recordings


def published(parts="rrrrtt", labels=(0, 0, 1, 1, 0, 1), **more):
    """Recordings of one event each, at another time for each; r is training, t test."""
    samples = [[(0, i, 1, 1), (1000 * (i + 1), 1, 1, 1)] for i in range(len(parts))]
    names = {"r": "train", "t": "test", " ": ""}
    return recordings(*samples, labels=list(labels), parts=[names[p] for p in parts], **more)


@given(st.integers(10, 300), st.integers(0, 2**31 - 1), st.floats(0, 0.5))
def test_a_random_split_is_a_partition(n, seed, fraction):
    split = split_at_random(n, seed, 0.2, fraction)
    together = np.concatenate([split.train, split.validation, split.test])
    np.testing.assert_array_equal(np.sort(together), np.arange(n))
    assert len(split.test) == round(0.2 * n)
    np.testing.assert_array_equal(split.test, split_at_random(n, seed).test)


@given(st.integers(0, 200), st.integers(2, 40), st.sampled_from([0.0, 0.2]))
def test_every_class_is_in_training_and_test(seed, classes, fraction):
    labels = np.concatenate([np.arange(classes), np.arange(classes), [0] * seed])
    made = recordings(*[[(0, i, 1, 1)] for i in range(len(labels))], labels=labels.tolist())
    split = make_split(made, seed, 0.2, fraction)
    assert find_classes_without_test(made, split) == []
    assert set(labels[split.train]) == set(range(classes))
    together = np.concatenate([split.train, split.validation, split.test])
    np.testing.assert_array_equal(np.sort(together), np.arange(len(labels)))
    plain = split_at_random(len(labels), seed, 0.2, fraction)
    if set(labels[plain.test]) == set(labels[plain.train]) == set(range(classes)):
        for part in ("train", "validation", "test"):  # nothing changes where nothing is missing
            np.testing.assert_array_equal(getattr(split, part), getattr(plain, part))


def test_classes_without_test_recordings_are_named():
    made = recordings(*[[(0, i, 1, 1)] for i in range(6)], labels=[0, 0, 1, 1, 2, 2])
    split = Split(np.array([0, 2, 4, 5]), np.array([], int), np.array([1, 3]))
    assert find_classes_without_test(made, split) == ["2"]


@given(st.integers(0, 200), st.sampled_from([0.1, 0.2, 0.6, 0.9]))
def test_every_class_is_in_the_training_part(seed, fraction):
    split = make_split(
        published(" " * 12, [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]), seed, fraction, 0.2
    )
    together = np.concatenate([split.train, split.validation, split.test])
    np.testing.assert_array_equal(np.sort(together), np.arange(12))
    assert set(np.asarray(split.train) // 2) == set(range(6))
    assert len(split.test)


@given(st.lists(st.integers(1, 40), min_size=2, max_size=25), st.integers(0, 1000))
def test_no_writer_is_in_both_parts(sizes, seed):
    writers = np.repeat(np.arange(len(sizes)), sizes)
    split = split_by_writers(writers, seed, 0.2)
    assert not set(writers[split.train]) & set(writers[split.test])
    assert len(split.train)
    assert len(split.test)
    assert len(split.train) + len(split.test) == len(writers)


def test_validation_samples_are_of_own_writers():
    many = replace(published(" " * 40, [0, 1] * 20), writers=np.repeat(np.arange(8), 5))
    split = make_split(many, 0, 0.2, 0.2, "writers")
    parts = (split.train, split.validation, split.test)
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(40))
    groups = [set(many.writers[part]) for part in parts]
    assert all(groups)
    assert sum(map(len, groups)) == 8


def test_a_split_by_writers_needs_their_names():
    for writers in ([-1, 0, 1], [3, 3]):
        with pytest.raises(ValueError, match="writer"):
            split_by_writers(np.array(writers), 0)


def test_a_published_split_is_used():
    """Every seed has the same test set and check; validation samples are of the training."""
    read = published("rrrrrrtt", (0, 0, 0, 1, 1, 1, 0, 1))
    splits = [make_split(read, seed, 0.5, 0.5, "auto") for seed in range(5)]
    for split in splits:
        assert split.kind == "published"
        assert sorted(split.test) == [6, 7]
        assert sorted([*split.train, *split.validation]) == [0, 1, 2, 3, 4, 5]
        assert len(split.validation) == 3
        np.testing.assert_array_equal(
            split.draw_check_samples(2, 9), splits[0].draw_check_samples(2, 1)
        )
    assert len({tuple(split.train) for split in splits}) > 1
    assert make_split(read, 0, 0.5, requested="random").kind == "random"
    assert make_split(published("      "), 0, 0.5, requested="auto").kind == "random"
    with pytest.raises(ValueError, match="train and test"):
        make_split(published("      "), 0, 0.5, requested="published")


@pytest.mark.parametrize(
    ("parts", "labels", "fact"),
    [
        ("rrrrtt", (0, 0, 1, 1, 0, 1), None),
        ("rrrrrt", (0, 0, 0, 1, 1, 0), None),  # its test set has no 1, which is said
        ("rrrrtt", (0, 0, 0, 1, 0, 1), "fewer than two recordings of '1' in its folder train"),
        ("rrrrtt", (0, 0, 1, 1, 0, 2), "'2' in its folder train"),
        ("rrrrtt", (0, 0, 0, 0, 0, 0), "one class"),
        ("      ", (0, 0, 0, 1, 1, 2), "only one recording of '2'"),
    ],
)
def test_too_few_recordings_of_a_class(parts, labels, fact):
    problem = find_split_problem(published(parts, labels))
    assert problem is None if fact is None else fact in problem


def test_the_same_recording_in_both_parts():
    read = published()
    assert find_copies(read, split_as_published(read.parts, 0)) == ([], [])
    again = [(5_000, 0, 1, 3), (6_000, 1, 1, 1)]  # the first one, later and in other columns
    doubled = recordings(
        *([(0, 0, 1, 1), (1000, 1, 1, 1)], [(0, 0, -1, 1), (1000, 1, 1, 1)], again),
        parts=["train", "train", "test"],
    )
    assert find_copies(doubled, split_as_published(doubled.parts, 0)) == ([("0/0", "0/2")], [])
    elsewhere = replace(doubled, labels=np.array([0, 1, 1]), parts=())  # one in two classes
    in_training, in_classes = find_copies(elsewhere, split_at_random(3, 0, 0.34))
    assert in_classes == [("0/0", "0/2")]
    assert len(in_training) == (1 in split_at_random(3, 0, 0.34).train)
    empty = recordings([], [], labels=[0, 1])
    assert find_copies(empty, split_at_random(2, 0, 0.5)) == ([], [])


@given(st.permutations(range(6)))
def test_the_hash_of_a_recording_is_that_of_its_events(order):
    """The order of events at the same time does not count, all else does."""
    rows = [(0, 3, 1, 1), (0, 4, -1, 2), (0, 5, 1, 1), (7, 3, 1, 1), (7, 4, 1, 1), (7, 5, 1, 1)]
    mixed = sorted([rows[i] for i in order], key=lambda row: row[0])
    (content,) = recordings(rows).hashes
    assert recordings(mixed).hashes == (content,)
    changed = [(0, 3, 1, 1), (0, 4, 1, 2), *rows[2:]]
    assert recordings(changed).hashes != (content,)
    assert recordings([]).hashes != (content,)


def test_hold_out():
    train, held_out = hold_out_samples(np.arange(50), 3)
    assert len(held_out) == 5
    np.testing.assert_array_equal(np.sort([*train, *held_out]), np.arange(50))
    assert len(hold_out_samples(np.arange(2), 0)[1]) == 1


def test_samples_of_the_check():
    chosen = draw_check_samples(np.arange(100, 140), 20, 1)
    assert len(set(chosen)) == 20
    assert set(chosen) <= set(range(100, 140))
    with pytest.raises(ValueError, match=r"41 .* 40"):
        draw_check_samples(np.arange(40), 41, 1)
