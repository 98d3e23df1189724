"""An estimate of energy per inference, from published energies per operation.

For a layer on the chip, with the spikes counted in a check::

    E = synaptic operations * (23.6 + 3.5) pJ + neuron updates * 81 pJ

The energies are from Davies et al. 2018 (IEEE Micro 38(1), Table 2): 23.6 pJ per synaptic
operation, 3.5 pJ per hop between tiles (the mean of 3.0 and 4.0 pJ in its two directions) and 81 pJ
per update of an active neuron; keras-spiking's ``ModelEnergy`` uses them in the same way.  A neuron
is updated at every step, including the gap between samples.  For the CNN of the same architecture::

    E = (multiply-accumulates + neurons) * 8.6 nJ on a CPU, or 0.3 nJ on a GPU

after Degnan et al. 2016 (IEEE Trans. VLSI 24(1)): an Intel i7-4960X, and an Nvidia GTX Titan Black
with large batches.

These are estimates, not measurements.  They do not include idle power, the host (with the encoder
and a linear readout), spikes onto the chip and off it, and memory traffic.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import List

from ..errors import UserError
from ..network.chip import LOIHI
from ..network.operations import multiply_accumulates
from ..network.spec import NetworkSpec
from ..tables import aligned

CHIP = {
    "synaptic operation": LOIHI.synaptic_operation_joules,
    "neuron update": LOIHI.neuron_update_joules,
}
"""Joules (Davies et al. 2018)."""

MAC = {"cpu": 8.6e-9, "gpu": 0.3e-9}
"""Joules per multiply-accumulate and per neuron (Degnan et al. 2016)."""


@dataclass(frozen=True)
class LayerEstimate:
    """Estimate for one layer and one inference.

    Attributes
    ----------
    layer : str
    on_chip : bool
        A layer on the host is not part of the chip's estimate.
    synaptic_operations, neuron_updates : float
        Mean over the check's samples.
    chip_joules : float
        0 for a layer on the host.
    multiply_accumulates, neurons : int
        Numbers of the same layer of the CNN.
    """

    layer: str
    on_chip: bool
    synaptic_operations: float
    neuron_updates: float
    chip_joules: float
    multiply_accumulates: int
    neurons: int

    def cnn_joules(self, device: str) -> float:
        """Energy of the CNN's layer on ``"cpu"`` or ``"gpu"``."""
        return (self.multiply_accumulates + self.neurons) * MAC[device]


@dataclass(frozen=True)
class EnergyEstimate:
    """Estimated energy and latency of one inference.

    Attributes
    ----------
    layers : list of LayerEstimate
    latency_seconds : float
        Duration of a sample's presentation.
    decided_seconds : float
        Median time after which the decision does not change.
    step_seconds : float
        Duration of one time step.
    """

    layers: List[LayerEstimate]
    latency_seconds: float
    decided_seconds: float
    step_seconds: float

    @property
    def chip_joules(self) -> float:
        """Energy of all layers on the chip."""
        return sum(layer.chip_joules for layer in self.layers)

    def cnn_joules(self, device: str) -> float:
        """Energy of the whole CNN."""
        return sum(layer.cnn_joules(device) for layer in self.layers)

    def to_json(self) -> dict:
        """The estimate as plain values."""
        return {
            "schema": "stmnist-energy-estimate/1",
            "estimate": True,
            "joules_per_inference": {
                "loihi": self.chip_joules,
                **{f"cnn_{device}": self.cnn_joules(device) for device in MAC},
            },
            "joules_per_operation": {
                "loihi": CHIP,
                **{f"cnn_{device}": value for device, value in MAC.items()},
            },
            "latency_seconds": self.latency_seconds,
            "decided_seconds": self.decided_seconds,
            "layers": [
                {
                    **asdict(layer),
                    **{f"cnn_{device}_joules": layer.cnn_joules(device) for device in MAC},
                }
                for layer in self.layers
            ],
        }


def estimate_energy(spec: NetworkSpec, result: dict) -> EnergyEstimate:
    """Estimate the energy of an inference from a check's counts.

    Parameters
    ----------
    spec : NetworkSpec
    result : dict
        A check result of the bundle, of any target.

    Raises
    ------
    UserError
        The result has no counts of this network's layers, or no decision times.
    """
    counted = result.get("synaptic_operations")
    receiving = {layer.name for layer in spec.layers if layer.placement == "chip"}
    if not isinstance(counted, dict) or not receiving <= set(counted):
        raise UserError(
            "the result has no synaptic operations of this network; run the check again"
        )
    if "decided_at_median" not in result:  # it is optional for comparisons
        raise UserError("the result has no decision times; run the check again")
    samples, shown = result["n_samples"], spec.presentation
    macs = multiply_accumulates(spec)
    layers = []
    for layer in spec.layers:
        on_chip = layer.placement == "chip"
        operations = counted.get(layer.name, 0) / samples
        updates = layer.size * shown.period if layer.neurons is not None else 0
        layers.append(
            LayerEstimate(
                layer=layer.name,
                on_chip=on_chip,
                synaptic_operations=operations,
                neuron_updates=updates,
                chip_joules=on_chip
                * (operations * CHIP["synaptic operation"] + updates * CHIP["neuron update"]),
                multiply_accumulates=macs[layer.name],
                neurons=layer.size,
            )
        )
    step = spec.stimulus.step_seconds
    times = shown.steps * step, result["decided_at_median"] * step
    return EnergyEstimate(layers, *times, step)


def estimate_text(value: EnergyEstimate) -> str:
    """Format an estimate as a table and a few lines."""
    heads = [
        "layer",
        "where",
        "synaptic operations",
        "neuron updates",
        "Loihi",
        "CNN CPU",
        "CNN GPU",
    ]
    rows = [heads]
    for layer in value.layers:
        rows.append(
            [
                layer.layer,
                "chip" if layer.on_chip else "host",
                f"{layer.synaptic_operations:.0f}",
                f"{layer.neuron_updates:.0f}",
                _joules(layer.chip_joules) if layer.on_chip else "-",
                *(_joules(layer.cnn_joules(device)) for device in MAC),
            ]
        )
    total = [_joules(value.chip_joules), *(_joules(value.cnn_joules(device)) for device in MAC)]
    rows.append(["total", "", "", "", *total])
    return "\n".join(
        [
            "ESTIMATE of the energy of one inference, from published energies per operation",
            *aligned(rows, left=2),
            "Loihi: synaptic operations x 27.1 pJ + neuron updates x 81 pJ",
            "  (Davies et al. 2018)",
            "CNN: (multiply-accumulates + neurons) x 8.6 nJ on a CPU, 0.3 nJ on a GPU",
            "  (Degnan et al. 2016)",
            "left out: idle power, host, spikes to and from the chip, memory traffic",
            f"latency: presented for {value.latency_seconds * 1000:.0f} ms, decided after "
            f"{value.decided_seconds * 1000:.0f} ms (median), "
            f"at {value.step_seconds * 1000:g} ms a step",
        ]
    )


def _joules(value):
    for unit, size in (("mJ", 1e-3), ("uJ", 1e-6), ("nJ", 1e-9)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value / 1e-12:.3g} pJ"
