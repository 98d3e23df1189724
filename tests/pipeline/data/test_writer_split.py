import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.data.splits import writer_split


@given(
    writers=st.lists(st.integers(0, 12), min_size=2, max_size=300).filter(
        lambda w: len(set(w)) > 1
    ),
    seed=st.integers(0, 2**32),
)
def test_nobody_is_on_both_sides(writers, seed):
    writers = np.array(writers)
    split = writer_split(writers, seed)
    assert not set(writers[split.train]) & set(writers[split.test])
    assert len(split.train)
    assert len(split.test)
    everything = np.concatenate([split.train, split.validation, split.test])
    np.testing.assert_array_equal(np.sort(everything), np.arange(len(writers)))


@pytest.mark.parametrize("seed", range(20))
def test_the_test_part_is_about_a_fifth(seed):
    """23 writers of about the same size, as in ST-MNIST."""
    writers = np.random.default_rng(seed).integers(0, 23, 6953)
    assert len(writer_split(writers, seed).test) / 6953 == pytest.approx(0.2, abs=0.03)


def test_by_hand():
    """Four writers of 10 samples: one of them is 0.25, nearest to 0.2."""
    writers = np.repeat([3, 5, 7, 9], 10)
    chosen = {int(writers[writer_split(writers, seed).test[0]]) for seed in range(30)}
    assert chosen == {3, 5, 7, 9}
    assert {len(writer_split(writers, seed).test) for seed in range(30)} == {10}


@pytest.mark.parametrize("writers", [[-1, 0, 1], [], [4, 4, 4]])
def test_writers_must_be_known_and_several(writers):
    with pytest.raises(ValueError, match="writer"):
        writer_split(np.array(writers), 0)


def test_the_same_seed_gives_the_same_split():
    writers = np.arange(100) % 10
    one, two = (writer_split(writers, 5).test for _ in range(2))
    np.testing.assert_array_equal(one, two)
