"""The maintainers' tools run; that their figures are good is for a quiet machine to say."""

import pytest

from tests.untraced import untraced
from tools.training_speed import WAYS, measure_simulated, speed_text


@pytest.mark.slow
def test_the_training_speed_is_measured():
    with untraced():
        result = measure_simulated(samples=12, networks=1, rounds=1)
    assert result["ratio_to_nengodl"]["nengodl"] == 1
    assert set(result["seconds_per_epoch"]) == set(WAYS)
    assert all(seconds > 0 for seconds in result["seconds_per_epoch"].values())
    assert result["samples"] == 96
    assert len(speed_text(result).splitlines()) == 2 + len(WAYS)
