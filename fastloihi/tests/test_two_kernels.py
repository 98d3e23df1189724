"""The kernel of `FastSimulator` and that of the target ``fast`` have the same rules of the chip."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from deploy.network.build import build
from deploy.network.chip import LOIHI
from deploy.network.loihi_import import nengo_loihi
from deploy.network.stream import show
from deploy.targets.fast.arrays import OVERFLOWS
from tests.deploy.fast_networks import loud_spec, reference

pytest.importorskip("numba")
from deploy.targets.fast import kernel_numba as of_bundles
from fastloihi import FastEmulator, accelerate
from fastloihi import kernel_numba as general


def test_both_have_the_chips_limits():
    bits = 31 - LOIHI.input_bits, 31 - LOIHI.current_bits
    assert (general._Q, general._U) == (of_bundles._Q, of_bundles._U) == bits


@pytest.mark.parametrize("keep", [0, 1, 2048, 4095, 4096])
def test_both_decay_alike(keep):
    edges = [0, 1, 4095, 4096, 4097, 2**21, 2**23 - 1, 2**23, 2**31 - 1]
    for value in (*edges, *(-edge for edge in edges)):
        decayed = int(np.sign(value)) * (abs(value) * keep // 4096)
        for rule in (general._decayed, of_bundles._decay):
            assert rule.py_func(np.int32(value), np.int32(keep)) == decayed


@pytest.mark.parametrize("spare", [general._Q, general._U])
def test_both_wrap_alike(spare):
    limit = 2 ** (31 - int(spare))
    for value in (0, limit - 1, limit, -limit, -limit - 1, 2**30, -(2**31)):
        wrapped = (value + limit) % (2 * limit) - limit
        for rule in (general._wrapped, of_bundles._wrap):
            with np.errstate(all="ignore"):
                assert rule.py_func(np.int32(value), spare) == wrapped


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("filters", [3, 8])
def test_overflows_that_fast_counts_are_told_by_the_simulator_too(filters, sign):
    spec, images = loud_spec(filters, sign), np.ones((1, 36))
    counted = reference(spec, images).overflows.sum(axis=0)  # `fast` is compared with it elsewhere
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        built = build(spec)
        with nengo_loihi.Simulator(built.network, target="sim", precompute=True) as simulator:
            emulator = accelerate(simulator).sims["emulator"]
            list(show(built, simulator, images))
    assert type(emulator) is FastEmulator
    messages = {str(warning.message) for warning in said}
    told = {place for place in OVERFLOWS if f"Overflow in {place}" in messages}
    assert told == {place for place, n in zip(OVERFLOWS, counted, strict=True) if n}
    assert told
