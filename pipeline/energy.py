"""Energy from published constants: an estimate, never a measurement.

Davies et al. 2018 (IEEE Micro 38(1), Table 2) give for Loihi 23.6 pJ for a synaptic operation and
81 pJ for the update of an active neuron, and keras-spiking adds 3.5 pJ for a spike within a tile;
for a multiply-accumulate on a CPU it takes 8.6 nJ, on a GPU 0.3 nJ (Degnan et al. 2016).  What is
left out: the host, communication between cores, and the power that a chip draws at rest.
"""

from __future__ import annotations

from deploy.network_spec import NetworkSpec

JOULES = {
    "synaptic operation": 27.1e-12,
    "neuron update": 81e-12,
    "multiply-accumulate on a CPU": 8.6e-9,
    "multiply-accumulate on a GPU": 0.3e-9,
}


def estimate_energy(spec: NetworkSpec, result: dict) -> list:
    """Energy of one inference.

    Parameters
    ----------
    spec : NetworkSpec
    result : dict
        Of a check whose target counts spikes.

    Returns
    -------
    list of (where, count of operations, joules)
        Loihi's synapses, its neurons, and a CPU and a GPU that run the CNN.
    """
    steps = spec.presentation.steps + spec.presentation.gap
    operations = sum(result["synaptic_operations"].values()) / result["n_samples"]
    updates = steps * sum(
        layer.size for layer in spec.layers if layer.neurons and layer.placement == "chip"
    )
    products = sum(result["multiply_accumulates"].values())
    counted = (
        ("Loihi, synaptic operations", operations, "synaptic operation"),
        ("Loihi, neuron updates", updates, "neuron update"),
        ("CNN on a CPU, multiply-accumulates", products, "multiply-accumulate on a CPU"),
        ("CNN on a GPU, multiply-accumulates", products, "multiply-accumulate on a GPU"),
    )
    return [(where, count, count * JOULES[kind]) for where, count, kind in counted]
