"""An estimate of energy per inference, from published energies per operation.

For each layer, with the spikes counted in a check::

    E = synaptic operations * (23.6 + 3.5) pJ + neuron updates * 81 pJ

The energies are those of Davies et al. 2018 (IEEE Micro 38(1), Table 2), which come from
simulations of the circuits before the chip was made: 23.6 pJ is the least energy of a synaptic
operation, 3.5 pJ that of a spike to the next tile (the mean of 3.0 and 4.0 pJ in its two
directions), and 81 pJ that of an update of an active neuron (52 pJ of an inactive one, which is not
distinguished here).  keras-spiking uses them in the same way.  A neuron is updated
at every step, including the gap between samples.  For the CNN of the same architecture::

    E = (multiply-accumulates + neurons) * 8.6 nJ on a CPU, or 0.3 nJ on a GPU

after Degnan et al. 2016 (IEEE Trans. VLSI 24(1)): an Intel i7-4960X, and an Nvidia GTX Titan Black
with large batches.

Both sides have the same layers.  A readout on the host is counted as if it were a layer of neurons
on the chip, as the output layer of the CNN is part of the CNN.

These are estimates, not measurements.  They do not include idle power, the host with the input
neurons, spikes onto the chip and off it, and memory traffic.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import List, Union

from ..errors import UserError
from ..network.chip import LOIHI
from ..network.spec import NetworkSpec, get_spec
from ..tables import align_rows
from .results import CheckResult, to_result

# Joules (Davies et al. 2018).
CHIP_JOULES = {
    "synaptic operation": LOIHI.synaptic_operation_joules,
    "neuron update": LOIHI.neuron_update_joules,
}

# Joules per multiply-accumulate and per neuron (Degnan et al. 2016).
MAC_JOULES = {"cpu": 8.6e-9, "gpu": 0.3e-9}


@dataclass(frozen=True)
class LayerEstimate:
    """Estimate for one layer and one inference.

    Attributes
    ----------
    layer : str
    on_chip : bool
        False for a readout on the host, which is estimated as if it were on the chip.
    synaptic_operations, neuron_updates : float
        Mean over the check's samples; see ``NetworkSpec.count_synaptic_operations``.
    multiply_accumulates, neurons : int
        Numbers of the same layer of the CNN.
    """

    layer: str
    on_chip: bool
    synaptic_operations: float
    neuron_updates: float
    multiply_accumulates: int
    neurons: int

    @property
    def chip_joules(self) -> float:
        """Energy of the layer on the chip."""
        return (
            self.synaptic_operations * CHIP_JOULES["synaptic operation"]
            + self.neuron_updates * CHIP_JOULES["neuron update"]
        )

    def estimate_cnn_joules(self, device: str) -> float:
        """Energy of the CNN's layer on ``"cpu"`` or ``"gpu"``."""
        return (self.multiply_accumulates + self.neurons) * MAC_JOULES[device]


@dataclass(frozen=True)
class EnergyEstimate:
    """Estimated energy of one inference, of all layers, the output layer included.

    Attributes
    ----------
    layers : list of LayerEstimate
    presentation_seconds : float
        Duration of a sample's presentation.
    """

    layers: List[LayerEstimate]
    presentation_seconds: float

    @property
    def synaptic_operations(self) -> float:
        """Synaptic operations of all layers."""
        return sum(layer.synaptic_operations for layer in self.layers)

    @property
    def neuron_updates(self) -> float:
        """Neuron updates of all layers."""
        return sum(layer.neuron_updates for layer in self.layers)

    @property
    def chip_joules(self) -> float:
        """Energy of all layers on the chip."""
        return sum(layer.chip_joules for layer in self.layers)

    @property
    def share_of_updates(self) -> float:
        """Share of the chip's energy for neuron updates; the others are synaptic operations."""
        return self.neuron_updates * CHIP_JOULES["neuron update"] / self.chip_joules

    def estimate_cnn_joules(self, device: str) -> float:
        """Energy of the whole CNN."""
        return sum(layer.estimate_cnn_joules(device) for layer in self.layers)

    def to_json(self) -> dict:
        """The estimate as plain values."""
        return {
            "schema": "stmnist-energy-estimate/2",
            "estimate": True,
            "joules_per_inference": {
                "loihi": self.chip_joules,
                **{f"cnn_{device}": self.estimate_cnn_joules(device) for device in MAC_JOULES},
            },
            "joules_per_operation": {
                "loihi": CHIP_JOULES,
                **{f"cnn_{device}": value for device, value in MAC_JOULES.items()},
            },
            "operations_per_inference": {
                "synaptic operation": self.synaptic_operations,
                "neuron update": self.neuron_updates,
            },
            "shares": {
                "synaptic operation": 1 - self.share_of_updates,
                "neuron update": self.share_of_updates,
            },
            "presentation_seconds": self.presentation_seconds,
            "layers": [_make_layer_json(layer) for layer in self.layers],
        }


def _make_layer_json(layer) -> dict:
    return {
        **asdict(layer),
        "chip_joules": layer.chip_joules,
        **{f"cnn_{device}_joules": layer.estimate_cnn_joules(device) for device in MAC_JOULES},
    }


def estimate_energy(spec: NetworkSpec, result: Union[CheckResult, dict]) -> EnergyEstimate:
    """Estimate the energy of an inference from a check's counts.

    Parameters
    ----------
    spec : NetworkSpec or Bundle
    result : CheckResult or dict
        A check result of the bundle, of any target, or its plain values.

    Raises
    ------
    UserError
        The result has no counts of this network's layers.
    TypeError
        The network is neither a NetworkSpec nor a Bundle.
    """
    spec = get_spec(spec)
    result = to_result(result)
    counted = result.synaptic_operations
    presentation = spec.presentation
    if not {layer.name for layer in spec.layers} <= set(counted):
        raise UserError(
            "the result has no synaptic operations of this network; "
            "run 'stmnist check run' with --target emulator or fast"
        )
    layers = [
        LayerEstimate(
            layer=layer.name,
            on_chip=layer.placement == "chip",
            synaptic_operations=counted[layer.name] / result.n_samples,
            neuron_updates=layer.size * presentation.period,
            multiply_accumulates=layer.multiply_accumulates,
            neurons=layer.size,
        )
        for layer in spec.layers
    ]
    return EnergyEstimate(layers, presentation.steps * spec.stimulus.step_seconds)


def _list_values(estimate: Union[LayerEstimate, EnergyEstimate]) -> List[str]:
    """The values of a row in the table of a layer's or the network's estimate."""
    return [
        f"{estimate.synaptic_operations:.0f}",
        f"{estimate.neuron_updates:.0f}",
        format_joules(estimate.chip_joules),
        *(format_joules(estimate.estimate_cnn_joules(device)) for device in MAC_JOULES),
    ]


def format_estimate(value: EnergyEstimate) -> str:
    """Format an estimate as a table and a few lines."""
    heads = ["layer", "where", "synaptic operations", "neuron updates", "Loihi"]
    rows = [[*heads, "dense CPU", "dense GPU"]]
    for layer in value.layers:
        rows.append([layer.layer, "chip" if layer.on_chip else "host*", *_list_values(layer)])
    rows.append(["total", "", *_list_values(value)])
    lines = [
        "ESTIMATE of the energy of one inference, from published energies per operation",
        *align_rows(rows, left=2),
        f"of Loihi's energy {value.share_of_updates:.0%} are neuron updates, "
        f"{1 - value.share_of_updates:.0%} synaptic operations",
        "Loihi: synaptic operations x 27.1 pJ + neuron updates x 81 pJ",
        "  (Davies et al. 2018: simulations of the circuits before the chip was made)",
        "dense: one pass of this network without spikes, (multiply-accumulates + neurons) x 8.6 nJ",
        "  on a CPU, 0.3 nJ on a GPU (Degnan et al. 2016)",
    ]
    if not all(layer.on_chip for layer in value.layers):
        lines.append("*: computed on the host, estimated as if it were on the chip")
    return "\n".join(
        [
            *lines,
            "left out: idle power, host, spikes to and from the chip, memory traffic",
            f"a sample is presented for {value.presentation_seconds * 1000:.0f} ms",
        ]
    )


def format_joules(value: float) -> str:
    """Format an energy in joules, with three digits and its unit."""
    for unit, size in (("mJ", 1e-3), ("uJ", 1e-6), ("nJ", 1e-9)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value / 1e-12:.3g} pJ"
