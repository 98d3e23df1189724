"""NengoDL: run the trained network with its neurons replaced by LIF, rate-based or spiking.

No other module imports NengoDL.  Its ``Converter`` sets the gain to its scale and the bias to 0,
with which a LIF neuron is silent up to an activation of 1; here both are set to the values used in
training (``J = 1 + gain * z``).
"""

import contextlib
import importlib
import logging
import math
import subprocess
import sys
import types
import warnings

import nengo
import numpy as np

import deploy.network.loihi_import  # noqa: F401 - puts back what Nengo needs of NumPy 1
from models.architecture import parse_architecture
from models.cnn import build_cnn, find_gain, set_weights
from models.keras.keras2 import tf
from models.keras.operation_layer import OperationLayer
from models.quantised import quantise_layer
from pipeline.settings import Settings


@contextlib.contextmanager
def emulate_keras_2_12():
    """Emulate the TensorFlow 2.12 environment that NengoDL 3.6 expects, while it is imported.

    - The name ``keras`` refers to Keras 2.  NengoDL imports names from ``keras.engine.functional``
      that moved to ``src``, and two names of batch normalisation from ``keras.layers``; it converts
      the second.
    - NengoDL imports TensorFlow in a separate process only to look for a GPU, which takes seconds;
      here the current process is asked instead.
    """
    functional = importlib.import_module("tf_keras.src.engine.functional")
    layers = types.ModuleType("keras.layers")
    layers.BatchNormalizationV1 = type("BatchNormalizationV1", (), {})
    layers.BatchNormalizationV2 = tf.keras.layers.BatchNormalization
    names = {
        "keras": tf.keras,
        "keras.engine": types.ModuleType("keras.engine"),
        "keras.engine.functional": functional,
        "keras.layers": layers,
    }
    kept = {name: sys.modules.get(name) for name in names}
    call = subprocess.call
    sys.modules.update(names)
    subprocess.call = lambda command: not tf.config.list_physical_devices("GPU")
    try:
        yield
    finally:
        subprocess.call = call
        for name, module in kept.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


with warnings.catch_warnings(), emulate_keras_2_12():
    warnings.simplefilter("ignore")
    import nengo_dl

_build_filters = nengo_dl.process_builders.LinearFilterBuilder.build_pre


def _build_filters_of_nengo_3(self, signals, config):
    """Nengo 4 gives a filter's matrix D as many dimensions as its state; NengoDL expects one."""
    make_step = nengo.LinearFilter.make_step

    def with_flat_d(*arguments, **options):
        step = make_step(*arguments, **options)
        step.D = step.D.ravel()
        return step

    nengo.LinearFilter.make_step = with_flat_d
    try:
        _build_filters(self, signals, config)
    finally:
        nengo.LinearFilter.make_step = make_step


nengo_dl.process_builders.LinearFilterBuilder.build_pre = _build_filters_of_nengo_3


@nengo_dl.Converter.register(OperationLayer)
class _ConvertOperation(nengo_dl.converter.LayerConverter):
    """Convert the layer of any operation to a connection with all its weights.

    Without it, NengoDL would run the layer in TensorFlow, and its connection would have no synapse.
    """

    has_weights = True

    def convert(self, node_id):
        operation = self.layer.operation
        kernel, bias = tf.keras.backend.batch_get_value((self.layer.kernel, self.layer.bias))
        matrix = operation.make_matrix(operation.to_deployed(kernel), self.input_shape(node_id))
        biases = np.resize(bias, math.prod(self.output_shape(node_id)))
        output = self.add_nengo_obj(node_id, biases=biases)
        self.add_connection(node_id, output, transform=matrix, trainable=True)
        return output


# Suppress messages about functions that are traced for each network.
for _name in ("nengo_dl", "tensorflow"):
    logging.getLogger(_name).setLevel(logging.ERROR)


def run_network(
    settings: Settings, weights: dict, images, n_steps: int, batch: int = 200, advance=None
) -> np.ndarray:
    """Run the spiking network on images, each from a fresh state.

    Parameters
    ----------
    settings : Settings
    weights : dict
        Weights of the rate-based network.
    images : ndarray, shape (n_samples, rows, columns, channels)
        Presented as constant currents.
    n_steps : int
        Steps of 1 ms.
    batch : int
        Maximum number of samples per batch.
    advance : callable, optional
        Called with the number of samples done since the last call.

    Returns
    -------
    ndarray, shape (n_samples, steps, outputs)
        Logits at each step, including the readout's bias.
    """
    synapse = settings.deployment.synapse_s or None
    network = _convert(settings, weights, nengo.LIF, synapse)
    return _run_in_batches(network, images, n_steps, batch, advance)


def run_rates(settings: Settings, weights: dict, images, batch: int = 200) -> np.ndarray:
    """Run the network with rate-based neurons, whose outputs do not change over time.

    Parameters
    ----------
    settings, weights, images, batch
        As in :func:`run_network`.

    Returns
    -------
    ndarray, shape (n_samples, outputs)
    """
    network = _convert(settings, weights, nengo.LIFRate, None)
    return _run_in_batches(network, images, 1, batch)[:, 0]


def _run_in_batches(network, images, n_steps, batch, advance=None):
    converter, source, output = network
    images = np.asarray(images, np.float32).reshape(len(images), 1, -1)
    batch = min(batch, len(images))
    padding = -len(images) % batch  # NengoDL only runs full batches
    padded = np.concatenate([images, np.zeros((padding, *images.shape[1:]), np.float32)])
    with _make_simulator(converter.net, batch) as simulator:
        results = []
        for images_of_batch in np.split(padded, len(padded) // batch):
            results.append(
                simulator.predict_on_batch({source: np.repeat(images_of_batch, n_steps, 1)})[output]
            )
            if advance is not None:
                advance(min(batch, len(images) - (len(results) - 1) * batch))
    return np.concatenate(results)[: len(images)]


def _make_simulator(network, batch):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "No GPU support")
        return nengo_dl.Simulator(
            network, minibatch_size=batch, progress_bar=False, seed=network.seed
        )


def predict(settings: Settings, weights: dict, images, n_steps: int) -> np.ndarray:
    """Predictions of the spiking network: the largest mean logit in the readout window.

    Parameters
    ----------
    settings, weights, images, n_steps
        As in :func:`run_network`.

    Returns
    -------
    ndarray of int, shape (n_samples,)
    """
    outputs = run_network(settings, weights, images, n_steps)
    return outputs[:, settings.presentation.readout_start :].mean(axis=1).argmax(1)


def _convert(settings, weights, neuron_type, synapse):
    """Convert the network to a type of neurons; returns converter, input node and output probe."""
    snn = settings.snn
    architecture = parse_architecture(settings.cnn.architecture)
    gains = {
        name: find_gain(snn.get_max_rate(index), snn.tau_rc, snn.tau_ref)
        for index, name in enumerate(architecture.spiking)
    }
    model = build_cnn(architecture, activation=lambda index: tf.keras.layers.Activation(tf.nn.relu))
    if snn.is_on_chip:  # the network was trained with the chip's weights and biases
        weights = dict(weights)
        for name, gain in gains.items():
            names = f"{name}.kernel", f"{name}.bias"
            arrays = quantise_layer(*(tf.constant(weights[n], tf.float32) for n in names), gain)
            weights.update(zip(names, (array.numpy() for array in arrays), strict=True))
    set_weights(model, weights)
    swap = {tf.nn.relu: neuron_type()}
    converter = nengo_dl.Converter(
        model, swap_activations=swap, synapse=synapse, inference_only=True
    )
    # Spiking neurons start from random voltages.  Without its own seed the network would draw them
    # from NumPy's global state, which depends on what this process did before.
    converter.net.seed = settings.seed
    for index, (name, gain) in enumerate(gains.items()):
        ensemble = converter.layers[model.get_layer(f"{name}_neurons").output].ensemble
        ensemble.neuron_type = neuron_type(
            tau_rc=snn.tau_rc, tau_ref=snn.tau_ref, amplitude=1 / snn.get_max_rate(index)
        )
        ensemble.gain = np.full(ensemble.n_neurons, gain)
        ensemble.bias = np.ones(ensemble.n_neurons)
    output = converter.outputs[model.output]
    output.synapse = None
    return converter, converter.inputs[model.input], output
