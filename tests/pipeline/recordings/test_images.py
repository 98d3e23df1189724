from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pipeline.recordings import faulty_taxels
from pipeline.recordings.augmentation import AUGMENTATIONS
from pipeline.recordings.images import AlteredImages, make_tactile_images, normalise_images
from pipeline.recordings.sensor import TaxelMap
from pipeline.settings import Image
from tests.pipeline.handmade import recordings

# Taxel 37 (row 7, column 3): two ON of 4 and 5 columns, one OFF of 2; taxel 90: one OFF of 3.
ROWS = [(0, 37, 1, 4), (1_000, 90, -1, 3), (5_000, 37, 1, 5), (9_000, 37, -1, 2)]


@pytest.mark.parametrize(
    ("aggregation", "at_37", "at_90"),
    [("count", 3, 1), ("columns", 11, 3), ("signed", 1, -1), ("on", 2, 0), ("off", 1, 1)],
)
def test_aggregations_by_hand(aggregation, at_37, at_90):
    settings = Image(aggregation, normalisation="none")
    image = make_tactile_images(recordings([], ROWS), settings)[..., 0]
    assert image.shape == (2, 10, 10)
    assert not image[0].any()
    expected = np.zeros((10, 10))
    expected[7, 3], expected[0, 9] = at_37, at_90
    np.testing.assert_array_equal(image[1], expected)


def test_the_lookup_table_decides_where_a_taxel_is():
    transposed = TaxelMap(row=np.arange(100) // 10, column=np.arange(100) % 10)
    found = make_tactile_images(recordings(ROWS, taxels=transposed), Image(normalisation="none"))
    image = found[0, ..., 0]
    assert (image[3, 7], image[9, 0]) == (3, 1)
    assert image.sum() == 4


@pytest.mark.parametrize(
    ("normalisation", "expected"),
    [
        ("max", [1, -0.25, 0, 0.5625]),
        ("sum", [16 / 29, -4 / 29, 0, 9 / 29]),
        ("sqrt-max", [1, -0.5, 0, 0.75]),
        ("none", [16, -4, 0, 9]),
    ],
)
def test_normalisations_by_hand(normalisation, expected):
    image = np.array([16, -4, 0, 9.0]).reshape(1, 2, 2)
    np.testing.assert_allclose(normalise_images(image, normalisation).ravel(), expected)
    assert not normalise_images(np.zeros((1, 2, 2)), normalisation).any()


def test_a_hot_taxel_does_not_darken_the_image():
    image = np.zeros((1, 10, 10))
    image[0, 2, :5] = [4, 9, 16, 16, 1]
    alone = normalise_images(image, "sqrt-clip")
    np.testing.assert_allclose(alone[0, 2, :5], [2 / 3, 1, 1, 1, 1 / 3])
    hot = image.copy()
    hot[0, 9, 9] = 1000
    seen = normalise_images(hot, "sqrt-clip")
    assert seen[0, 9, 9] == 1
    np.testing.assert_allclose(seen[0, 2, :5], [0.5, 0.75, 1, 1, 0.25])
    assert normalise_images(hot, "sqrt-max")[0, 2, 3] < 0.2


def test_few_active_taxels_are_normalised_by_the_largest():
    image = np.zeros((1, 10, 10, 2))
    image[0, 2, 3] = [9, 36]
    found = normalise_images(image, "sqrt-clip")
    np.testing.assert_allclose(found[0, 2, 3], [0.5, 1])


def test_channels_of_a_taxel_count_once():
    image = np.zeros((1, 10, 10, 16))
    image[0, :4, 0, 3] = [100, 64, 16, 4]
    image[0, 0, 0] = 100
    found = normalise_images(image, "sqrt-clip")
    np.testing.assert_allclose(found[0, :4, 0, 3], [1, 1, 1, 0.5])


@given(
    images=hnp.arrays(float, (3, 4, 4), elements=st.integers(-50, 50).map(float)),
    normalisation=st.sampled_from(["max", "sum", "sqrt-max", "sqrt-clip"]),
)
def test_each_image_is_normalised_by_itself(images, normalisation):
    result = normalise_images(images, normalisation)
    assert np.abs(result).max() <= 1 + 1e-12
    assert (np.sign(result) == np.sign(images)).all()
    np.testing.assert_array_equal(result[1:2], normalise_images(images[1:2], normalisation))
    np.testing.assert_allclose(result, normalise_images(4 * images, normalisation), atol=1e-12)


def test_what_the_networks_see():
    images = make_tactile_images(recordings(ROWS, []))
    assert images.shape == (2, 10, 10, 1)
    assert images.dtype == np.float32
    assert images[0, 7, 3, 0] == 1
    assert images[0, 0, 9, 0] == pytest.approx(1 / 3)


def test_channels_are_slices_of_time_and_polarities():
    """Two slices of 5 us: an event at 5 us is in the second, as is one after the end."""
    rows = [(0, 37, 1, 4), (1_000, 90, -1, 3), (5_000, 37, 1, 5), (90_000, 37, -1, 2)]
    image = Image("polarities", 2, 0.01, "none")
    (found,) = make_tactile_images(recordings(rows), image)
    expected = np.zeros((10, 10, 4))
    expected[7, 3], expected[0, 9] = [1, 0, 1, 1], [0, 1, 0, 0]
    np.testing.assert_array_equal(found, expected)
    both = make_tactile_images(recordings(rows), Image("count", 2, 0.01, "none"))[0]
    np.testing.assert_array_equal(both, expected.reshape(10, 10, 2, 2).sum(3))


@pytest.fixture
def no_faults(monkeypatch):
    """Alterations without hot and dead taxels."""
    for name in ("time", "space"):
        monkeypatch.setitem(AUGMENTATIONS, name, replace(AUGMENTATIONS[name], hot=0, dead=0))


def test_altered_images_have_a_share_of_the_events(no_faults):
    rows = [(1_000 * i, 37, 1, 1) for i in range(1000)]
    image = Image(normalisation="none")
    altered = AlteredImages(recordings(rows, ROWS), image, "time")
    rng = np.random.default_rng(0)
    left = np.array([altered(rng, [0])[0] for _ in range(50)])
    assert set(np.argwhere(left)[:, 1:].ravel()) == {7, 3, 0}  # nothing moves
    counts = left[:, 7, 3, 0]
    assert 790 < counts.min() < 850 < 950 < counts.max() <= 1000  # up to a fifth is dropped
    assert altered(rng, [1, 0, 0]).shape == (3, 10, 10, 1)


def alter_often(monkeypatch, **shares):
    """Images of a taxel that sends 100 events, in four slices, with faulty taxels only."""
    rows = [(10_000_000 * i, 37, 1, 1) for i in range(100)]
    how = replace(AUGMENTATIONS["none"], **shares)
    monkeypatch.setitem(AUGMENTATIONS, "time", how)
    image = Image("on", 4, 1000.0, "none")
    altered, rng = AlteredImages(recordings(rows), image, "time"), np.random.default_rng(0)
    return np.concatenate([altered(rng, [0]) for _ in range(300)])


def test_altered_images_have_hot_taxels(monkeypatch):
    some = alter_often(monkeypatch, hot=1.0)
    np.testing.assert_array_less(24, some[:, 7, 3])
    others = np.count_nonzero(some.any(3).reshape(300, -1), axis=1) - 1
    assert (others.min(), others.max()) == (0, 3)  # one that sends OFF events only is not seen


def test_a_dead_taxel_has_a_share_of_a_slice_and_none_of_those_after_it(monkeypatch):
    monkeypatch.setattr(faulty_taxels, "MAX_DEAD_SHARE", 1.0)
    at_37 = alter_often(monkeypatch, dead=1.0)[:, 7, 3]
    assert {0, 25} < set(at_37[:, 0].tolist())
    assert (np.diff(at_37, axis=1) <= 0).all()


def test_altered_images_move_the_events_of_a_taxel_together(no_faults):
    rows = [(1_000 * i, 37, 1, 1) for i in range(100)]
    altered = AlteredImages(recordings(rows), Image(normalisation="none"), "space")
    rng = np.random.default_rng(0)
    places = []
    for _ in range(60):
        (image,) = altered(rng, [0])
        assert np.count_nonzero(image) == 1
        places.append(tuple(np.argwhere(image)[0][:2]))
    assert (7, 3) in places
    assert len(set(places)) > 3
    assert np.abs(np.array(places) - (7, 3)).max() <= 3
    same = AlteredImages(recordings(rows), Image(normalisation="none"), "space")
    np.testing.assert_array_equal(
        same(np.random.default_rng(4), [0]), altered(np.random.default_rng(4), [0])
    )
