"""Targets that Nengo and NengoLoihi simulate: in floating point, and in the chip's integers.

Each function is the ``run`` of a :class:`~.registry.Target` without options.
"""

from __future__ import annotations

from typing import Iterable, Iterator

import nengo

from ..network.build import build_nengo_network
from ..network.loihi_import import BUILD_ERRORS, make_build_error, nengo_loihi
from ..network.output import TargetOutput
from ..network.simulation import record_stream
from ..network.spec import NetworkSpec


def run_nengo(spec, streams, seed=0, options=None) -> Iterator[TargetOutput]:
    """Run NengoCore's reference simulator, with Loihi's neurons in floating point."""
    settings = {"progress_bar": False, "optimize": False}
    return _run_on(spec, streams, seed, lambda network: nengo.Simulator(network, **settings))


def run_simreal(spec, streams, seed=0, options=None) -> Iterator[TargetOutput]:
    """Run NengoLoihi's model of the chip before discretisation."""
    return _run_on(spec, streams, seed, lambda network: _make_simulator(network, "simreal"))


def run_emulator(spec, streams, seed=0, options=None) -> Iterator[TargetOutput]:
    """Run NengoLoihi's emulator, with the chip's integers."""
    return _run_on(spec, streams, seed, lambda network: _make_simulator(network, "sim"))


def _make_simulator(network, target):
    try:
        # Without an explicit target NengoLoihi uses hardware wherever NxSDK is installed.
        return nengo_loihi.Simulator(network, target=target, precompute=True)
    except BUILD_ERRORS as error:
        raise make_build_error(network, error) from error


def _run_on(spec: NetworkSpec, streams: Iterable, seed, simulator) -> Iterator[TargetOutput]:
    built = build_nengo_network(spec, seed)
    for samples in streams:
        with simulator(built.network) as sim:
            yield record_stream(spec, built, sim, samples)
