"""What the peers' tests use of packages of their time, and which of them fail all the same."""

import nengo
import numpy as np
import pytest

_warns = pytest.warns


def warns(expected=Warning, *arguments, **options):
    """As `pytest.warns`; None, which pytest 8 refuses, records whatever warnings there are."""
    if expected is None:
        return pytest.WarningsRecorder(_ispytest=True)
    return _warns(expected, *arguments, **options)


def expect_failures(items, known):
    """Mark tests that must fail; ``known`` has the reason for each file's stem and test's name."""
    for item in items:
        reason = known.get(f"{item.path.stem}::{item.name}")
        if reason is not None:
            item.add_marker(pytest.mark.xfail(reason=reason, strict=True))


def oscillator(recurrent_tau, frequency, n_neurons):
    """``nengo.networks.Oscillator``, which Nengo 4 no longer has."""
    with nengo.Network() as network:
        network.input = nengo.Node(size_in=2)
        network.ensemble = nengo.Ensemble(n_neurons, 2)
        nengo.Connection(network.input, network.ensemble)
        turn = np.array([[0, -1], [1, 0]]) * recurrent_tau * frequency
        nengo.Connection(
            network.ensemble, network.ensemble, transform=np.eye(2) + turn, synapse=recurrent_tau
        )
    return network
