"""Convert trained rate-based weights to the deployed network."""

from __future__ import annotations

import numpy as np

from deploy.network.spec import Layer, NetworkSpec, Neurons
from models.architecture import parse
from models.lif import gain_for
from models.quantised import eight_bits, twelve_bits
from pipeline.data.dataset import require_images_fit
from pipeline.roads.layers import host_readout
from pipeline.settings import Settings
from pipeline.training.networks import TrainedRates


def deployed(settings: Settings, weights: dict, provenance: dict, data) -> NetworkSpec:
    """Describe the spiking network with the given weights; see :func:`to_spec`.

    Parameters
    ----------
    settings, weights, provenance
        As in :func:`to_spec`.
    data : (images, labels)
        Training samples, which determine the range of a readout on the chip.

    Raises
    ------
    UserError
        The images cannot be presented to this network.
    """
    on_chip = settings.deployment.readout == "chip"
    images, labels = data
    require_images_fit(images, settings)
    range_of = (TrainedRates(settings, weights).logits(images), labels) if on_chip else None
    return to_spec(settings, weights, provenance, range_of)


def to_spec(settings: Settings, weights: dict, provenance: dict, range_of=None) -> NetworkSpec:
    """Describe the spiking network with the given weights.

    With an activation ``z`` at which the trained network's neurons receive ``J = 1 + gain * z``,
    the deployed convolution has weights ``gain * W`` and bias currents ``1 + gain * b``, and a
    spike has the area ``1 / max_rate``.

    Parameters
    ----------
    settings : Settings
    weights : dict
        Weights of the rate-based network.
    provenance : dict
        Stored in the bundle.
    range_of : (logits, labels), optional
        Arrays of shapes (n_samples, outputs) and (n_samples,) of training samples, which determine
        the range of a readout on the chip; not used otherwise.

    Returns
    -------
    NetworkSpec
    """
    snn, deployment = settings.snn, settings.deployment
    architecture = parse(settings.cnn.architecture)
    layers = []
    *hidden, output = architecture.folded
    for index, folded in enumerate(hidden):
        name = folded.name
        gain = gain_for(snn.max_rate(index), snn.tau_rc, snn.tau_ref)
        kernel = gain * weights[f"{name}.kernel"].astype(float)
        bias = 1 + gain * weights[f"{name}.bias"].astype(float)
        if snn.is_on_chip:
            kernel, bias = eight_bits(kernel).numpy(), twelve_bits(bias).numpy()
        layers.append(
            Layer(
                placement="chip",
                neurons=Neurons(1 / snn.max_rate(index), snn.tau_rc, snn.tau_ref),
                synapse=deployment.synapse or None,
                weights=folded.layer.deployed_weights(kernel),
                bias=bias,
                **folded.geometry(),
            )
        )
    layers.append(_readout(settings, output, weights, range_of))
    return NetworkSpec(
        architecture=str(architecture),
        input_shape=architecture.input_shape,
        stimulus=settings.stimulus,
        layers=tuple(layers),
        presentation=settings.presented(),
        provenance=provenance,
    )


def _readout(settings, folded, weights, range_of):
    common = folded.geometry()
    kernel = weights["output.kernel"].T.astype(float)
    bias = weights["output.bias"].astype(float)
    if settings.deployment.readout == "host":
        return host_readout(kernel, bias, common)
    # One LIF neuron per class: the median of the largest wrong logit maps to the threshold, and the
    # largest right logits to the full rate, so that the neurons' range covers what decides.
    snn = settings.snn
    logits, labels = np.array(range_of[0], float), np.asarray(range_of[1])
    right = logits[np.arange(len(labels)), labels]
    logits[np.arange(len(labels)), labels] = -np.inf
    threshold, full = np.median(logits.max(axis=1)), np.percentile(right, 99)
    rate = snn.max_rates[-1]
    gain = gain_for(rate, snn.tau_rc, snn.tau_ref) / max(full - threshold, 1e-6)
    return Layer(
        placement="chip",
        neurons=Neurons(1 / rate, snn.tau_rc, snn.tau_ref),
        synapse=settings.deployment.synapse or None,
        weights=gain * kernel,
        bias=1 + gain * (bias - threshold),
        **common,
    )
