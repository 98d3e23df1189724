import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.data.splits import draw_check_samples, hold_out, random_split, writer_split


@given(
    n=st.integers(10, 500),
    seed=st.integers(0, 2**31 - 1),
    test=st.floats(0.1, 0.5),
    validation=st.floats(0, 0.5),
)
def test_the_parts_are_disjoint_and_together_everything(n, seed, test, validation):
    split = random_split(n, seed, test, validation)
    together = np.concatenate([split.train, split.validation, split.test])
    assert sorted(together.tolist()) == list(range(n))
    assert len(split.test) == round(n * test)
    assert (np.diff(split.train) > 0).all()
    again = random_split(n, seed, test, validation)
    for part, same in zip(vars(split).values(), vars(again).values(), strict=True):
        np.testing.assert_array_equal(part, same)


def test_a_tenth_of_the_training_samples_is_held_out():
    train = np.arange(5, 505, 5)
    learn, held = hold_out(train, seed=1)
    assert len(held) == 10
    np.testing.assert_array_equal(np.sort([*learn, *held]), train)
    np.testing.assert_array_equal(held, hold_out(train, seed=1)[1])
    assert held.tolist() != hold_out(train, seed=2)[1].tolist()
    assert len(hold_out(train[:3], seed=1)[1]) == 1


@pytest.mark.parametrize("kind", ["random", "writers"])
def test_what_is_shown_is_not_in_the_order_of_the_labels(kind):
    """A stream of one digit's samples would flatter a network that remembers the last one."""
    labels, writers = np.repeat(np.arange(10), 500), np.arange(5000) % 20
    for seed in range(5):
        if kind == "random":
            split = random_split(5000, seed, validation_fraction=0.2)
        else:
            split = writer_split(writers, seed)
        for part in (split.validation, split.test):
            if len(part):
                shown = labels[part]
                assert np.mean(shown[1:] == shown[:-1]) == pytest.approx(0.1, abs=0.04)


def test_a_validation_part_does_not_change_the_test_part():
    plain, watched = random_split(1000, 5), random_split(1000, 5, validation_fraction=0.1)
    np.testing.assert_array_equal(plain.test, watched.test)
    assert (len(plain.train), len(plain.test)) == (800, 200)
    assert len(watched.validation) == 80


def test_another_seed_gives_another_split_and_another_draw():
    assert (random_split(1000, 0).test != random_split(1000, 1).test).any()
    test = random_split(1000, 0).test
    assert (draw_check_samples(test, 50, 0) != draw_check_samples(test, 50, 1)).any()


def test_the_split_is_the_same_on_every_machine():
    # Written down once: results of the same seed must stay comparable between releases.
    assert random_split(20, 0).test.tolist() == [6, 12, 3, 7]
    assert draw_check_samples(np.arange(100), 5, 0).tolist() == [54, 14, 85, 23, 86]


@given(seed=st.integers(0, 1000), wanted=st.integers(1, 40))
def test_check_samples_are_different_ones_of_the_test_part(seed, wanted):
    test = random_split(200, 3).test
    drawn = draw_check_samples(test, wanted, seed)
    assert len(set(drawn.tolist())) == wanted
    assert set(drawn.tolist()) <= set(test.tolist())
    np.testing.assert_array_equal(drawn, draw_check_samples(test, wanted, seed))


def test_too_few_samples():
    with pytest.raises(ValueError, match=r"\b41\b.* 40\b"):
        draw_check_samples(random_split(200, 3).test, 41, 0)
    with pytest.raises(ValueError, match=r"^2 .* 0.2 "):
        random_split(2, 0)
    with pytest.raises(ValueError, match=r"^4 .* 0.99 "):
        random_split(4, 0, test_fraction=0.99)
