"""Scale the weights of a CNN for the range and the response of LIF neurons."""

import numpy as np

from deploy.arithmetic import select_evenly
from models.architecture import Architecture, parse_architecture
from models.cnn import RateLIF
from pipeline.settings import Settings
from pipeline.training.images.networks import TrainedCNN

# Quantile of a layer's activations that is scaled to 1 when a CNN's weights are reused.
PERCENTILE = 99.9

# Candidate threshold shifts for weights that are reused without training.
THRESHOLD_SHIFTS = tuple(np.arange(0, 1.01, 0.02).tolist())

# Maximum number of training samples on which the activations of the layers are measured.
MAX_MEASURED_SAMPLES = 1 << 14

# Maximum number of these activations, of 4 bytes each: large networks are measured on fewer
# samples. Networks such as the paper's, of some thousand neurons, have fewer on all samples.
MAX_MEASURED_ACTIVATIONS = 1 << 26


def select_measured(images, architecture: Architecture) -> np.ndarray:
    """Images on which activations are measured: all, or some at equal distances of many.

    Parameters
    ----------
    images : ndarray, shape (n_samples, ...)
    architecture : Architecture
        Architecture of the network, which has an activation for each of its neurons and each image.
    """
    neurons = max(sum(architecture.n_values.values()), 1)
    return select_evenly(
        images, min(MAX_MEASURED_SAMPLES, max(MAX_MEASURED_ACTIVATIONS // neurons, 1))
    )


def scale_to_unit(settings: Settings, weights: dict, images) -> dict:
    """Scale a ReLU network's weights so that each layer's activations reach 1.

    The function of the network does not change: the weights of a layer are divided by a factor,
    and those of the next layer are multiplied by it.

    Parameters
    ----------
    settings : Settings
    weights : dict
        Weights of the CNN.
    images : ndarray
        Training images, for measuring the activations.
    """
    scaled = dict(weights)
    previous_scale = 1.0
    measured = select_measured(images, parse_architecture(settings.cnn.architecture))
    for name, output in TrainedCNN(settings, weights).compute_activations(measured).items():
        scale = _find_reach(output)
        scaled[f"{name}.kernel"] = weights[f"{name}.kernel"] * (previous_scale / scale)
        scaled[f"{name}.bias"] = weights[f"{name}.bias"] / scale
        previous_scale = scale
    scaled["output.kernel"] = weights["output.kernel"] * previous_scale
    return scaled


def _find_reach(activations) -> float:
    """The value that a layer's activations reach; 1 for a silent layer.

    If nearly all activations are 0, it is the largest one.
    """
    reach = float(np.percentile(activations, PERCENTILE)) or float(np.max(activations, initial=0))
    return reach or 1.0


def fit_to_rates(settings: Settings, weights: dict, images) -> dict:
    """Adapt a ReLU network's weights to LIF neurons without training.

    A LIF neuron's rate ``f`` rises steeply at its threshold and then flattens, unlike a ReLU.  With
    activations y that reach 1 (:func:`scale_to_unit`), ``c f(a z - b)`` approximates
    ``y = max(z, 0)`` if the threshold is raised by a small b; a = 1 + b keeps ``max_rate`` at 1.
    For each layer, b is the value of `THRESHOLD_SHIFTS` with the least squared error over the
    activations above 0 on the images, and c is its best factor; a and b are applied to the
    layer's weights and bias, c to the next layer's weights.

    Parameters
    ----------
    settings, weights, images
        As in :func:`scale_to_unit`.

    Returns
    -------
    dict
        Weights of the rate-based network, whose logits approximate the CNN's.
    """
    snn = settings.snn
    fitted = dict(weights)
    previous_scale = 1.0
    measured = select_measured(images, parse_architecture(settings.cnn.architecture))
    outputs = TrainedCNN(settings, weights).compute_activations(measured)
    for index, (name, output) in enumerate(outputs.items()):
        scale = _find_reach(output)
        neurons = RateLIF(snn.get_max_rate(index), snn.tau_rc, snn.tau_ref, on_chip=snn.is_on_chip)
        shift, factor = _find_best_shift(neurons, output[output > 0] / scale)
        kernel = weights[f"{name}.kernel"]
        bias = weights[f"{name}.bias"]
        fitted[f"{name}.kernel"] = kernel * (previous_scale / scale * (1 + shift))
        fitted[f"{name}.bias"] = bias / scale * (1 + shift) - shift
        previous_scale = scale * factor
    fitted["output.kernel"] = weights["output.kernel"] * previous_scale
    return fitted


def _find_best_shift(neurons, activations):
    """(b, c) of :func:`fit_to_rates` for one layer."""
    if len(activations) == 0:
        return 0.0, 1.0
    # A thousand values are a sufficient sample of the distribution.
    typical = np.quantile(activations, (np.arange(1000) + 0.5) / 1000)
    errors = []
    for shift in THRESHOLD_SHIFTS:
        rates = neurons.compute_rates(((1 + shift) * typical - shift).astype(np.float32)).numpy()
        factor = float(rates @ typical / max(rates @ rates, 1e-9))
        errors.append((float(np.square(factor * rates - typical).sum()), shift, factor))
    return min(errors)[1:]
