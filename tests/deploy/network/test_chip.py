"""What the chip has is said in one place."""

from deploy.network.chip import LOIHI
from deploy.network.ops.base import count_list_words


def test_levels_by_hand():
    """8 bits with a sign reach 127; decays are parts of 4096, so at most 4095 of them."""
    assert (LOIHI.weight_levels, LOIHI.decay_unit, LOIHI.decay_levels) == (127, 4096, 4095)
    assert LOIHI.limits["compartments"] == 1024


def test_words_of_a_list_by_hand():
    # 10 bits of header: 54 are left of the first word, six synapses of 9 bits
    assert [count_list_words(n, 9, LOIHI) for n in (1, 6, 7, 13, 14)] == [1, 1, 2, 2, 3]
