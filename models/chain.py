"""A chain of links: what every trained or imported network becomes before it is deployed.

A link is one linear map and the neurons after it, which the chip computes as one layer; averaging
before the map belongs to the link.  These functions make chains, and :func:`build_network_spec`
makes the deployed network of any of them:

=======================================  =========================================================
:func:`from_rates`                       a network trained on images with rate-based neurons
:func:`models.integers.from_integers`    a network trained on events in the chip's integers
:func:`models.nir.chain.from_nir`        a NIR graph; :func:`models.rounding.round_chain` rounds it
=======================================  =========================================================

A user's Keras model becomes an architecture and weights (:mod:`models.keras.reader`), from which
rate-based neurons are made.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from deploy.network.geometry import compute_pooled_shape
from deploy.network.layer import Layer, Neurons
from deploy.network.presentation import Presentation
from deploy.network.provenance import NetworkProvenance
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import Stimulus
from models.architecture import Architecture
from models.ops import NotatedLayer, Operation, Pooling


@dataclass(frozen=True)
class NeuronDecays:
    """Neurons described by their decay factors: u <- keep_u u + W s, v <- keep_v v + u + bias.

    A neuron spikes where v exceeds 1, and v is 0 there.

    Attributes
    ----------
    keep_u, keep_v : float
        Shares of the current u and of the voltage v, from 0 to 1.
    """

    keep_u: float
    keep_v: float


@dataclass(frozen=True)
class Link:
    """A linear map and the neurons after it, or the readout.

    Attributes
    ----------
    name : str
        ``"conv1"``, ``"dense1"``, ..., ``"output"``.
    operation : Operation
        The linear map.
    input_shape : tuple of int
        (rows, columns, channels), or (values,), before pooling.
    kernel : ndarray
        Weights of the values after average pooling, for neurons in units of their threshold.  The
        shape is the operation's `compute_kernel_shape`; that of a dense link in sections is
        (sections * inputs, units).
    bias : ndarray
        Input of each unit, or of each channel of the output, in every step.
    neurons : Neurons, NeuronDecays or None
        Neurons as they are deployed, in seconds; neurons by their decay factors, before they
        are rounded to integers; None for a linear readout on the host.
    synapse : float or None
        Time constant in seconds of the low-pass on the input; None for none.
    pool : int
        Side length of the windows of the average pooling before the weights; 1 for none.
    recurrent_kernel : ndarray, shape (units, units), or None
        Weights of a dense link's own spikes, by sending and receiving unit; they arrive with the
        input of the next step.
    sources : tuple of str
        Names of the nodes of an imported graph that the link represents, for messages.
    section_starts : tuple of int
    synapses_per_weight : int
        See :class:`deploy.network.layer.Layer`.
    """

    name: str
    operation: Operation
    input_shape: tuple
    kernel: np.ndarray = field(repr=False)
    bias: np.ndarray = field(repr=False)
    neurons: Neurons | NeuronDecays | None = None
    synapse: float | None = None
    pool: int = 1
    recurrent_kernel: np.ndarray | None = field(default=None, repr=False)
    sources: tuple = ()
    section_starts: tuple = (0,)
    synapses_per_weight: int = 1

    def __str__(self):
        nodes = f" (nodes {', '.join(self.sources)})" if self.sources else ""
        return f"layer {self.name}{nodes}"

    @property
    def decays(self) -> NeuronDecays:
        """Its neurons, of a link whose neurons are not rounded to integers yet."""
        assert isinstance(self.neurons, NeuronDecays), f"{self}: has no decays"
        return self.neurons

    @property
    def kind(self) -> str:
        """The kind of its operation, such as ``"conv"``."""
        return self.operation.kind

    @property
    def shape(self) -> tuple:
        """Shape of its outputs, (rows, columns, channels) or (values,)."""
        return self.operation.compute_shape(self.pooled_shape)

    @property
    def size(self) -> int:
        """Number of neurons or outputs."""
        return math.prod(self.shape)

    @property
    def fan_out(self) -> np.ndarray:
        """Synapses that leave each input position, int64, of shape ``input_shape``."""
        return self.operation.count_input_fan_out(self.input_shape, self.pool)

    @property
    def pooled_shape(self) -> tuple:
        """Shape of the input after pooling, which is what the weights multiply."""
        if self.pool == 1:
            return self.input_shape
        return compute_pooled_shape(self.input_shape, self.pool)


def make_links(architecture: Architecture, weights: dict | None = None) -> tuple:
    """The links of an architecture, still without neurons.

    Parameters
    ----------
    architecture : Architecture
    weights : dict of str to ndarray, optional
        ``"conv1.kernel"``, ``"conv1.bias"``, ...; without it, and for missing biases, zeros.

    Returns
    -------
    tuple of Link
        One for each operation, with the averaging before it.

    Raises
    ------
    ValueError
        A layer's array other than its bias is missing.
    """
    links = []
    before = architecture.input_shape
    pool = 1
    layers = zip(architecture.names, architecture.layers, architecture.shapes, strict=False)
    for name, layer, pooled_shape in layers:
        if isinstance(layer, Pooling):
            pool *= layer.size
            continue
        arrays = {
            array: _take_array(weights, f"{name}.{array}", shape)
            for array, shape in layer.list_array_shapes(pooled_shape).items()
        }
        link = Link(name, layer, before, arrays["kernel"], arrays["bias"], pool=pool)
        links.append(link)
        before = link.shape
        pool = 1
    return tuple(links)


def _take_array(weights: dict | None, name: str, shape) -> np.ndarray:
    """An array of the weights; zeros without weights, and for a bias that is missing."""
    if weights is not None and name in weights:
        return weights[name].astype(float)
    if weights is not None and not name.endswith(".bias"):
        raise ValueError(f"the weights have no array {name!r} of shape {tuple(shape)}")
    return np.broadcast_to(0.0, shape)


# An output neuron's full rate, as a share of the rate that its refractory period allows, and the
# percentile of the largest wrong logit that maps to its threshold: chosen on validation samples, on
# which the readout on the chip is then as accurate as on the host with 100 steps.
OUTPUT_RATE_SHARE = 0.5
OUTPUT_THRESHOLD_PERCENTILE = 20


def from_rates(
    architecture: Architecture, weights: dict, snn, synapse: float | None, training_logits=None
) -> tuple:
    """The chain of a network trained with rate-LIF neurons.

    With an activation ``z`` at which the trained network's neurons receive ``J = 1 + gain * z``,
    a link has the kernel ``gain * W`` and bias currents ``1 + gain * b``, and a spike has the area
    ``1 / max_rate``.

    Parameters
    ----------
    architecture : Architecture
    weights : dict
        Weights of the rate-based network.
    snn : pipeline.settings.groups.SNN
        Rates and time constants of the neurons, and whether weights are rounded as on the chip.
    synapse : float or None
        Time constant in seconds of the low-pass on spikes between layers; None for none.
    training_logits : (logits, labels), optional
        Arrays of shapes (n_samples, outputs) and (n_samples,) of training samples, for an output of
        neurons whose range covers them.  Default: a linear readout on the host.

    Returns
    -------
    tuple of Link
    """
    from models.cnn import find_gain  # imports TensorFlow
    from models.quantised import quantise_bias, quantise_weights

    def add_neurons(link, rate, kernel, bias):
        neurons = Neurons(1 / rate, snn.tau_rc, snn.tau_ref)
        return replace(link, kernel=kernel, bias=bias, neurons=neurons, synapse=synapse or None)

    *hidden, output = make_links(architecture, weights)
    chain = []
    for index, link in enumerate(hidden):
        rate = snn.get_max_rate(index)
        gain = find_gain(rate, snn.tau_rc, snn.tau_ref)
        kernel = gain * link.kernel
        bias = 1 + gain * link.bias
        if snn.is_on_chip:
            kernel = quantise_weights(kernel).numpy()
            bias = quantise_bias(bias).numpy()
        chain.append(add_neurons(link, rate, kernel, bias))
    if training_logits is not None:
        threshold, full = _find_output_range(*training_logits)
        rate = OUTPUT_RATE_SHARE / snn.tau_ref
        gain = find_gain(rate, snn.tau_rc, snn.tau_ref) / max(full - threshold, 1e-6)
        bias = 1 + gain * (output.bias - threshold)
        output = add_neurons(output, rate, gain * output.kernel, bias)
    return (*chain, output)


def _find_output_range(logits, labels) -> tuple:
    """The logits at the threshold and at the full rate of output neurons, one for each class.

    What the largest wrong logit usually exceeds maps to the threshold, and the largest right logits
    to the full rate, so that the range covers what decides.
    """
    logits = np.array(logits, float)
    labels = np.asarray(labels)
    right = logits[np.arange(len(labels)), labels]
    logits[np.arange(len(labels)), labels] = -np.inf
    threshold = np.percentile(logits.max(axis=1), OUTPUT_THRESHOLD_PERCENTILE)
    return threshold, np.percentile(right, 99)


def build_network_spec(
    chain: tuple,
    stimulus: Stimulus,
    presentation: Presentation,
    provenance: dict | None = None,
    estimator=None,
) -> NetworkSpec:
    """The deployed network of a chain.

    Parameters
    ----------
    chain : sequence of Link
        Neurons are in seconds; see :func:`models.rounding.round_chain` for others.
    stimulus : Stimulus
    presentation : Presentation
    provenance : dict, optional
        Stored in the bundle.
    estimator : deploy.network.decision.Estimator, optional
        Confidence estimator of the outputs.
    """
    return NetworkSpec(
        architecture=write_notation(chain),
        input_shape=chain[0].input_shape,
        stimulus=stimulus,
        layers=tuple(make_layer(link) for link in chain),
        presentation=presentation,
        provenance=NetworkProvenance(dict(provenance or {})),
        estimator=estimator,
    )


def make_layer(link: Link) -> Layer:
    """The layer of a link.

    The kernels of a link have the axes of training in TensorFlow, and become the weights of the
    layer, which have the axes of Nengo; a link's operation has its training, too.
    """
    assert not isinstance(link.neurons, NeuronDecays), f"{link}: its neurons are not integers yet"
    return Layer(
        name=link.name,
        operation=link.operation.to_layer_operation(link.shape),
        input_shape=link.input_shape,
        neurons=link.neurons,
        synapse=link.synapse,
        weights=link.operation.to_deployed(link.kernel, len(link.section_starts)),
        bias=link.bias,
        pool=link.pool,
        section_starts=link.section_starts,
        recurrent=None if link.recurrent_kernel is None else link.recurrent_kernel.T,
        synapses_per_weight=link.synapses_per_weight,
    )


def write_notation(chain) -> str:
    """A chain in the notation of architectures, such as ``10x10x2-12c4s2-64-10o``."""
    return str(Architecture(chain[0].input_shape, tuple(_list_notated_layers(chain))))


def _list_notated_layers(chain) -> Iterator[NotatedLayer]:
    for link in chain:
        if link.pool > 1:
            yield Pooling(link.pool)
        yield link.operation
