"""Layers of the deployed network that images, events and NIR graphs have in common."""

from __future__ import annotations

from deploy.network.chip import LOIHI
from deploy.network.spec import Layer, Neurons
from models.integers import OnLoihi


def chip_layer(chip: OnLoihi, weights, geometry: dict) -> Layer:
    """A layer of neurons with given integers.

    Parameters
    ----------
    chip : OnLoihi
        From :func:`models.integers.on_loihi` with the chip's time step.
    weights : ndarray
        Those of ``chip`` with their axes in the order of a bundle.
    geometry : dict
        See :meth:`models.architecture.Folded.geometry`.
    """
    return Layer(
        placement="chip",
        neurons=Neurons(LOIHI.dt, chip.tau_rc, 0.0, chip.min_voltage),
        synapse=chip.tau_s or None,
        weights=weights,
        bias=chip.bias,
        **geometry,
    )


def host_readout(weights, bias, geometry: dict, synapse: float | None = None) -> Layer:
    """A linear readout on the host, with the parameters of a :class:`deploy.network.spec.Layer`."""
    return Layer(
        placement="host", neurons=None, synapse=synapse, weights=weights, bias=bias, **geometry
    )
