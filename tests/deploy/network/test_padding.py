"""Nengo's convolutions are padded only where they need it, and convolve as before."""

import numpy as np
import pytest
from nengo.builder import transforms

from deploy.conformance.networks import make_image_network
from deploy.network.build import pad_array, pad_only_where_needed
from deploy.targets.registry import run_target
from tests.deploy.networks import draw_checks, make_mixed_network


def test_what_is_padded_is_numpys():
    array = np.arange(12.0).reshape(1, 2, 3, 2)
    widths = ((0, 0), (1, 0), (0, 2), (0, 0))
    np.testing.assert_array_equal(pad_array(array, widths, mode="constant"), np.pad(array, widths))
    nothing = pad_array(array[:, :, 1:], ((0, 0),) * 4, mode="constant")
    np.testing.assert_array_equal(nothing, array[:, :, 1:])
    assert nothing.base is None  # not a view, of whose memory Nengo would take the wrong part


@pytest.mark.parametrize(
    "spec", [make_image_network(), make_mixed_network()], ids=["valid", "same"]
)
def test_every_spike_is_that_of_nengo_as_it_is(spec, monkeypatch):
    images = draw_checks(spec, 3).inputs
    result = run_target(spec, images, "nengo")
    monkeypatch.setattr(transforms, "np", np)
    expected = run_target(spec, images, "nengo")
    assert result.spikes["conv1"].sum() > 0
    np.testing.assert_array_equal(result.spike_hashes, expected.spike_hashes)
    np.testing.assert_array_equal(result.scores, expected.scores)


def test_numpy_pads_nothing_where_there_is_nothing_to_pad(monkeypatch):
    def boom(*given, **more):
        raise AssertionError("padded")

    spec, unpadded = make_image_network(), transforms.np
    images = draw_checks(spec, 1).inputs
    monkeypatch.setattr(np, "pad", boom)
    run_target(spec, images, "nengo")
    monkeypatch.setattr(transforms, "np", np)
    with pytest.raises(AssertionError, match="padded"):
        run_target(spec, images, "nengo")
    pad_only_where_needed()
    assert transforms.np is not unpadded
    run_target(spec, images, "nengo")
