"""The deployed network as plain values: layers, neurons, presentation, and their JSON form.

The description has the network as it runs on the chip.  A layer of neurons receives the current

    J = W * s + bias        (in units of the threshold)

where ``s`` is the low-pass filtered spike train of the previous layer (each spike has the area
``amplitude``) and ``W`` the layer's weights.  A LIF neuron is silent up to J = 1.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Dict, Optional, Tuple

import numpy as np

from .. import limits
from ..errors import UserError
from ..loading import Limit, WrongValue, between, check, limited_field, load, one_of
from .chip import LOIHI
from .decision import Estimator
from .geometry import compute_pooled_shape, sum_squares
from .ops import DEPLOYED_OPERATIONS, DeployedOperation
from .stimulus import KINDS, Stimulus

TAU = between(1e-6, limits.SECONDS, " seconds")
AT_LEAST_1 = Limit(lambda value: value >= 1, "at least 1")
SHAPE = Limit(
    lambda shape: all(side >= 1 for side in shape) and math.prod(shape) <= limits.NEURONS,
    f"sides of at least 1, with a product of at most {limits.NEURONS}",
)
KIND = Limit(lambda kind: kind in DEPLOYED_OPERATIONS, f"one of {', '.join(DEPLOYED_OPERATIONS)}")
RISING = Limit(
    lambda starts: (
        starts[:1] == (0,)
        and all(a < b for a, b in zip(starts, starts[1:]))
        and starts[-1] <= limits.STEPS
    ),
    f"rising from 0, to {limits.STEPS} at most",
)

# Time step in seconds, on which NengoLoihi's decays and the firing rates of training depend.
DT = LOIHI.dt


@dataclass(frozen=True)
class Neurons:
    """LIF neurons.

    Attributes
    ----------
    amplitude : float
        Area of one spike, in units of the value that the layer represents times seconds.
    tau_rc, tau_ref : float
        Membrane time constant and refractory period in seconds.
    min_voltage : float
        Lower bound of the membrane voltage, in units of the threshold.
    """

    amplitude: float = limited_field(between(1e-9, limits.MAGNITUDE))
    tau_rc: float = limited_field(TAU, 0.02)
    tau_ref: float = limited_field(between(0, limits.REFRACTORY_S, " seconds"), 0.001)
    min_voltage: float = limited_field(between(-limits.MAGNITUDE, 0), 0.0)

    def __post_init__(self):
        check(self)


@dataclass(frozen=True)
class Layer:
    """A layer of the deployed network.

    Attributes
    ----------
    name : str
        ``"conv1"``, ``"conv2"``, ..., ``"dense1"``, ..., ``"output"``.
    operation : DeployedOperation
        The linear map from the input to the neurons, with its numbers, such as a convolution's
        stride; see :mod:`deploy.network.ops`.
    input_shape : tuple of int
        (rows, columns, channels), or (values,).
    neurons : Neurons or None
        None for a linear readout on the host.
    synapse : float or None
        Time constant in seconds of the low-pass filter on the layer's input; None for no filter.
    weights : ndarray
        Weights for the input, after pooling if ``pool`` is above 1, in the operation's
        `compute_weight_shape`; of a readout in sections, those of the first section come first.
    bias : ndarray, shape (channels,) or (units,)
        Bias current J of each channel's neurons, or the additive bias of a linear readout.
    block_shape : tuple of int or None
        (rows, columns, channels) of the layer's neurons on one core; None leaves it to
        :mod:`deploy.network.blocks`.
    pool : int
        Side length of the average pooling windows before the weights; 1 for no pooling.  Values
        outside of complete windows are not read.  The chip cannot average: pooling is folded into
        the weights when the network is built.
    starts : tuple of int
        Of a readout on the host: first step, in a sample, of each section of the presentation,
        which has weights of its own.  The host knows the step; all other layers have one section.
    recurrent : ndarray, shape (units, units), or None
        Weights of a dense layer's own spikes, by receiving and sending unit; a spike arrives one
        step later.
    """

    name: str
    operation: DeployedOperation
    input_shape: Tuple[int, ...] = limited_field(SHAPE)
    neurons: Optional[Neurons]
    synapse: Optional[float] = limited_field(TAU)
    weights: np.ndarray = field(repr=False, compare=False)
    bias: np.ndarray = field(repr=False, compare=False)
    block_shape: Optional[Tuple[int, ...]] = limited_field(SHAPE, None)
    pool: int = limited_field(AT_LEAST_1, 1)
    starts: Tuple[int, ...] = limited_field(RISING, (0,))
    recurrent: Optional[np.ndarray] = field(default=None, repr=False, compare=False)

    def __post_init__(self):
        for name in ("input_shape", "block_shape", "starts"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, tuple(int(n) for n in getattr(self, name)))
        try:
            check(self)
            check(self.operation)
        except WrongValue as error:
            raise UserError(f"network description: layer {self.name!r}: {error}") from error
        self._convert_arrays()
        self._check_place()
        self._check_shapes()

    def _require(self, condition, problem):
        _require(condition, f"layer {self.name!r}", problem)

    def _convert_arrays(self):
        """Convert the arrays to float64, and refuse values that are not finite numbers."""
        for name in self.arrays:
            array = np.asarray(getattr(self, name))
            self._require(array.dtype.kind in "fiu", f"{name} are not real numbers")
            array = np.asarray(array, float)
            self._require(np.isfinite(array).all(), f"{name} has NaN or infinite values")
            self._require(
                np.abs(array).max(initial=0) <= limits.MAGNITUDE,
                f"{name} has a value above {limits.MAGNITUDE:g}",
            )
            object.__setattr__(self, name, array)

    def _check_place(self):
        """Refuse neurons, sections and recurrent weights where a layer cannot have them."""
        has_neurons = self.neurons is not None
        self._require(
            self.sections == 1 or (self.operation.can_read_out and not has_neurons),
            "only a readout on the host has sections",
        )
        self._require(
            self.recurrent is None or (self.operation.can_recur and has_neurons),
            f"{self.kind!r} cannot be recurrent, or has no neurons",
        )
        taken = set(self.operation.to_file()) & LAYER_NAMES
        self._require(not taken, f"its operation has numbers with names of a layer's: {taken}")

    def _check_shapes(self):
        """Compare the shapes with those of the operation."""
        is_image = self.operation.is_spatial or self.pool > 1
        self._require(
            len(self.input_shape) in ((3,) if is_image else (1, 3)),
            f"input_shape {self.input_shape} has a wrong number of dimensions",
        )
        self._require(min(self.read_shape) >= 1, "its pooling is larger than its input")
        try:
            shape = self.shape
        except ValueError as error:
            raise UserError(f"network description: layer {self.name!r}: {error}") from error
        self._require(
            self.block_shape is None or len(self.block_shape) == len(shape),
            f"block_shape {self.block_shape} and shape differ in length",
        )
        weight_shape = self.operation.compute_weight_shape(self.read_shape)
        self._require(len(weight_shape) >= 1, f"the operation {self.kind!r} needs a weight")
        first, *rest = weight_shape
        expected = {
            "weights": (self.sections * first, *rest),
            "bias": shape[-1:],
            "recurrent": shape * 2,
        }
        for name in self.arrays:
            shape_found = getattr(self, name).shape
            self._require(
                shape_found == expected[name],
                f"{name} of shape {shape_found} should have {expected[name]}",
            )

    @property
    def kind(self) -> str:
        """The kind of its operation, such as ``"conv"``."""
        return self.operation.kind

    @property
    def shape(self) -> Tuple[int, ...]:
        """(rows, columns, channels) of the output, or (units,)."""
        return self.operation.compute_shape(self.read_shape)

    @property
    def placement(self) -> str:
        """``"chip"``, or ``"host"`` for a linear readout."""
        return "host" if self.neurons is None else "chip"

    def compute_sums(self, values) -> np.ndarray:
        """The weighted sums of a layer's input, with its pooling, without its bias.

        Parameters
        ----------
        values : ndarray, shape (n, inputs)
            Values or spikes of the previous layer in n samples or steps.

        Returns
        -------
        ndarray, shape (n, neurons) or (n, sections * units)
        """
        values = np.reshape(values, (-1, *self.input_shape))
        averages = sum_squares(values, self.pool) / self.pool**2
        return self.operation.compute_sums(self.weights, averages).reshape(len(values), -1)

    @property
    def arrays(self) -> Tuple[str, ...]:
        """Names of the attributes that are arrays."""
        return ("weights", "bias", *(() if self.recurrent is None else ("recurrent",)))

    @property
    def size(self) -> int:
        """Number of neurons or units."""
        return int(np.prod(self.shape))

    @property
    def sections(self) -> int:
        """Number of sections of the presentation, each of which has weights of its own."""
        return len(self.starts)

    def find_section(self, steps) -> np.ndarray:
        """The section, from 0, to which steps of a sample, also from 0, belong."""
        return np.searchsorted(self.starts, steps, side="right") - 1

    @property
    def weights_by_class(self) -> np.ndarray:
        """Weights of a readout for the inputs of all sections, shape (units, sections * inputs)."""
        weights = self.weights.reshape(self.sections, self.size, -1)
        return weights.swapaxes(0, 1).reshape(self.size, -1)

    def with_weights_by_class(self, weights) -> Layer:
        """The readout with other weights, in the shape of :attr:`weights_by_class`."""
        by_section = np.reshape(weights, (self.size, self.sections, -1)).swapaxes(0, 1)
        return replace(self, weights=by_section.reshape(self.weights.shape))

    @property
    def read_shape(self) -> Tuple[int, ...]:
        """Shape of the values that the weights read: of the input, after pooling."""
        if self.pool == 1:
            return self.input_shape
        return compute_pooled_shape(self.input_shape, self.pool)

    @property
    def read_fan_out(self) -> np.ndarray:
        """Number of synapses of each value that the weights read, of shape `read_shape`."""
        return self.operation.count_fan_out(self.read_shape)

    @property
    def fan_out(self) -> np.ndarray:
        """Number of synapses of each neuron of the previous layer onto this one, shape (n_inputs,).

        Neurons near the edge of a convolution reach fewer positions; those outside of complete
        pooling windows reach none.  Zeros that pad a kernel are not counted.
        """
        return self.operation.count_input_fan_out(self.input_shape, self.pool).ravel()

    @property
    def multiply_accumulates(self) -> int:
        """Multiply-accumulates of the same layer of a CNN, one inference.

        Pooling before the layer is included: one operation for each value that it reads.
        """
        pooling = int(np.prod(self.read_shape)) * self.pool**2 if self.pool > 1 else 0
        loop = 0 if self.recurrent is None else self.size**2
        return int(self.read_fan_out.sum()) + pooling + loop

    def to_json(self) -> dict:
        """The description without the arrays, for ``network.json``."""
        record = _LayerRecord(
            name=self.name,
            kind=self.kind,
            input_shape=self.input_shape,
            shape=self.shape,
            placement=self.placement,
            neurons=self.neurons,
            synapse=self.synapse,
            block_shape=self.block_shape,
            pool=self.pool,
            starts=self.starts,
        )
        return {**asdict(record), **self.operation.to_file()}

    @classmethod
    def from_json(cls, plain: dict, arrays: dict, where: str) -> Layer:
        """The inverse of :meth:`to_json`.

        Parameters
        ----------
        plain : dict
        arrays : dict of str to ndarray
            Those of all layers, ``<layer>.weights`` and so on.
        where : str
            Name of the layer in error messages, such as ``layers[0]``.

        Raises
        ------
        WrongValue
            A value is missing, unknown or of another type.
        UserError
            The values contradict each other.
        KeyError
            An array is missing.
        """
        record, operation = _LayerRecord.read(plain, where)
        layer = cls(
            name=record.name,
            operation=operation,
            input_shape=record.input_shape,
            neurons=record.neurons,
            synapse=record.synapse,
            weights=arrays[f"{record.name}.weights"],
            bias=arrays[f"{record.name}.bias"],
            block_shape=record.block_shape,
            pool=record.pool,
            starts=record.starts,
            recurrent=arrays.get(f"{record.name}.recurrent"),
        )
        layer._require(layer.shape == record.shape, f"shape should be {layer.shape}")
        layer._require(
            layer.placement == record.placement,
            "a layer on the chip has neurons, one on the host has none",
        )
        return layer


@dataclass(frozen=True)
class _LayerRecord:
    """A layer in ``network.json``, where each layer has the numbers of a convolution.

    Operations with other numbers have them beside these.
    """

    name: str
    kind: str = limited_field(KIND)
    input_shape: Tuple[int, ...] = limited_field(SHAPE)
    shape: Tuple[int, ...] = limited_field(SHAPE)
    placement: str = limited_field(one_of("chip", "host"))
    neurons: Optional[Neurons]
    synapse: Optional[float] = limited_field(TAU)
    kernel: int = 0
    block_shape: Optional[Tuple[int, ...]] = limited_field(SHAPE, None)
    stride: int = 1
    padding: str = "valid"
    pool: int = limited_field(AT_LEAST_1, 1)
    starts: Tuple[int, ...] = limited_field(RISING, (0,))

    @classmethod
    def read(cls, plain: dict, where: str) -> tuple:
        """The record and the operation of a layer's description.

        Raises
        ------
        WrongValue
            A value is missing, unknown, of another type or out of range.
        """
        names = {entry.name for entry in fields(cls)}
        if not isinstance(plain, dict):
            raise WrongValue(where, "must be a table of values")
        record = load(cls, {name: plain[name] for name in plain if name in names}, where)
        operation = DEPLOYED_OPERATIONS[record.kind]
        own = {entry.name for entry in fields(operation)}
        numbers = {name: plain[name] for name in plain if name in own or name not in names}
        try:
            return record, operation.from_file(numbers, record.shape)
        except WrongValue as error:
            raise WrongValue(f"{where}.{error.name}", error.problem) from error


# Names in a layer's description that no operation may have for its numbers.
LAYER_NAMES = {entry.name for entry in fields(_LayerRecord)} - {"kernel", "stride", "padding"}


@dataclass(frozen=True)
class Presentation:
    """The presentation and the readout of samples; every target follows it step by step.

    Samples are presented in streams.  A stream starts from a fresh network; each sample follows
    ``gap`` silent steps and is presented for ``steps`` steps.  The network is not reset between
    samples, because a board cannot be.  The gap comes first, so that the first sample of a stream,
    too, starts with a network at rest under its bias currents.

    Raises
    ------
    ValueError
        A number is out of range; the message names the setting.
    """

    # Steps for which a sample is presented.
    steps: int = limited_field(between(1, limits.STEPS), 100)
    # Silent steps before each sample.
    gap: int = limited_field(between(0, limits.STEPS), 20)
    # Steps at the start of each sample that the readout ignores.
    readout_start: int = limited_field(between(0, limits.STEPS), 20)
    # Samples per stream; 1 means that every sample starts from a fresh network.
    stream_length: int = limited_field(between(1, limits.SAMPLES), 10)
    # Confidence for an early decision, see :mod:`deploy.network.decision`; None for a decision at
    # the end.
    confidence: Optional[float] = limited_field(
        Limit(lambda value: 0 < value <= 1, "above 0, at most 1"), None
    )

    @property
    def threshold(self) -> float:
        """The confidence for an early decision; without one 1, which none reaches."""
        return 1.0 if self.confidence is None else self.confidence

    @property
    def period(self) -> int:
        """Steps from one sample to the next, including the gap."""
        return self.gap + self.steps

    def list_streams(self, n_samples: int) -> list:
        """Cut samples 0 to n_samples - 1 into streams, as slices in order."""
        return [
            slice(start, min(start + self.stream_length, n_samples))
            for start in range(0, n_samples, self.stream_length)
        ]

    def __post_init__(self):
        check(self)
        if self.readout_start >= self.steps:
            raise WrongValue(
                "readout_start", f"must be from 0 to below presentation.steps ({self.steps})"
            )


@dataclass(frozen=True)
class Rehearsal:
    """Responses to some training samples, so that a readout can be refitted without forgetting.

    The readout on the host is linear: its scores are ``weights @ x + bias``, where ``x`` is the
    mean of its input while a sample is read, the low-pass filtered spikes of the last layer of
    neurons.  For a readout in sections, ``x`` has the sums of each section, divided by the steps of
    all.

    Attributes
    ----------
    responses : ndarray of float32, shape (n_samples, inputs of the readout)
        ``x`` of each sample.
    labels : ndarray of uint16, shape (n_samples,)
    """

    responses: np.ndarray
    labels: np.ndarray

    def __len__(self):
        return len(self.labels)

    def to_arrays(self) -> dict:
        """The arrays by name, for a file; half precision is sufficient for the responses."""
        responses = self.responses.astype(np.float16)
        return {"rehearsal.responses": responses, "rehearsal.labels": self.labels}

    @classmethod
    def from_arrays(cls, arrays: dict, inputs: int, classes: int) -> Optional[Rehearsal]:
        """The inverse of :meth:`to_arrays`, for a readout's numbers of inputs and classes.

        Returns None if none of its arrays exists; other arrays are ignored.

        Raises
        ------
        UserError
            An array has another shape, or invalid values.
        KeyError
            An array is missing.
        """
        if not any(name.startswith("rehearsal.") for name in arrays):
            return None
        responses = arrays["rehearsal.responses"]
        labels = arrays["rehearsal.labels"]
        valid = (
            (responses.dtype.kind, labels.ndim) == ("f", 1)
            and labels.dtype.kind in "iu"
            and responses.shape == (len(labels), inputs)
            and 1 <= len(labels) <= limits.SAMPLES
            and np.isfinite(responses).all()
            and 0 <= labels.min() <= labels.max() < classes
        )
        _require(valid, "rehearsal", "its arrays do not fit the readout")
        return cls(responses.astype(np.float32), labels.astype(np.uint16))


@dataclass(frozen=True)
class NetworkSpec:
    """The deployed network.

    Attributes
    ----------
    architecture : str
        The paper's notation.
    input_shape : tuple of int
        (rows, columns, channels) of the image.
    stimulus : Stimulus
        The input of the network.
    layers : tuple of Layer
        In order; the last one is the readout.
    presentation : Presentation
    provenance : dict
        Source of the network: data set, seed, recipe, package version.
    estimator : Estimator or None
        Confidence estimator of the outputs; None for their softmax.
    rehearsal : Rehearsal or None
        Training responses for refitting the readout.
    """

    architecture: str
    input_shape: Tuple[int, ...]
    stimulus: Stimulus
    layers: Tuple[Layer, ...]
    presentation: Presentation
    provenance: dict = field(default_factory=dict)
    estimator: Optional[Estimator] = field(default=None, repr=False, compare=False)
    rehearsal: Optional[Rehearsal] = field(default=None, repr=False, compare=False)

    def __post_init__(self):
        object.__setattr__(self, "input_shape", tuple(int(n) for n in self.input_shape))
        object.__setattr__(self, "layers", tuple(self.layers))
        _require(SHAPE.holds(self.input_shape), "network", f"input_shape is not {SHAPE.expected}")
        _require(1 <= len(self.layers) <= limits.LAYERS, "network", "has no layers, or too many")
        names = [layer.name for layer in self.layers]
        _require(all(map(_is_name, names)), "network", "a layer's name is not a short text")
        _require(len(set(names)) == len(names), "network", "has two layers of the same name")
        _require(
            "input" not in names, "network", "'input' is the input neurons' name, not a layer's"
        )
        shape = self.input_shape
        for position, layer in enumerate(self.layers):
            where = f"layer {layer.name!r}"
            _require(layer.input_shape == shape, where, f"input_shape should be {shape}")
            last = position == len(self.layers) - 1
            if last:
                can_read_out = layer.operation.can_read_out
                _require(can_read_out, where, f"{layer.kind!r} cannot be the last layer")
            else:
                on_chip = layer.placement == "chip"
                _require(on_chip, where, "only the last layer can be on the host")
                _require(layer.sections == 1, where, "only the last layer has sections")
            shape = layer.shape

    @property
    def spiking_layers(self) -> tuple:
        """Names of the layers that spike, the input neurons (``"input"``) first."""
        return ("input", *(layer.name for layer in self.layers if layer.neurons))

    @property
    def multiply_accumulates(self) -> Dict[str, int]:
        """Multiply-accumulates of each layer of the CNN of the same architecture, one inference."""
        return {layer.name: layer.multiply_accumulates for layer in self.layers}

    def count_synaptic_operations(self, spikes: Dict[str, np.ndarray]) -> Dict[str, np.ndarray]:
        """Synaptic operations by the receiving layer.

        They are the spikes that arrive at a layer times their fan-out: each spike of a neuron of
        the previous layer (for the first layer, of the input) counts once for every synapse of that
        neuron, wherever the layer is computed.  An operation is the counterpart of a
        multiply-accumulate of the CNN (Davies et al. 2018).

        Parameters
        ----------
        spikes : dict of str to ndarray, shape (..., n_neurons)
            Spikes of each neuron of each spiking layer.

        Returns
        -------
        dict of str to ndarray, shape (...)
        """
        senders = ("input", *(layer.name for layer in self.layers))
        operations = {}
        for sender, layer in zip(senders, self.layers):
            operations[layer.name] = spikes[sender] @ layer.fan_out
            if layer.recurrent is not None:
                operations[layer.name] += np.sum(spikes[layer.name], axis=-1) * layer.size
        return operations

    def with_presentation(self, **changes) -> NetworkSpec:
        """The same network with changes of the presentation."""
        return replace(self, presentation=replace(self.presentation, **changes))

    def flatten_samples(self, samples) -> np.ndarray:
        """Samples in the network's input format; see `Stimulus.flatten`.

        Raises
        ------
        UserError
            The stimulus cannot present the samples.
        """
        samples = np.asarray(samples)
        problem = self.stimulus.find_problem(samples, self.input_shape, self.presentation.steps)
        if problem is not None:
            raise UserError(
                f"samples cannot be presented to this network: {problem}; reshape or scale them"
            )
        return self.stimulus.flatten(samples)

    def to_json(self) -> dict:
        """The description without the arrays, for ``network.json``."""
        return {
            "architecture": self.architecture,
            "dt": DT,
            "input_shape": list(self.input_shape),
            "stimulus": {"kind": self.stimulus.kind, **asdict(self.stimulus)},
            "layers": [layer.to_json() for layer in self.layers],
            "presentation": asdict(self.presentation),
            "provenance": self.provenance,
        }

    def to_arrays(self) -> dict:
        """The arrays, for ``weights.npz``: ``<layer>.weights``, ``<layer>.bias`` and the rest."""
        arrays = {
            f"{layer.name}.{name}": getattr(layer, name)
            for layer in self.layers
            for name in layer.arrays
        }
        for more in (self.estimator, self.rehearsal):
            if more is not None:
                arrays.update(more.to_arrays())
        return arrays

    @classmethod
    def from_json(cls, value: dict, arrays: dict) -> NetworkSpec:
        """Make a network from its description and arrays.

        Raises
        ------
        UserError
            A value is missing, unknown or of the wrong type, or the time step differs.
        """
        try:
            _require(value["dt"] == DT, "network",
                     f"time step is {value['dt']} s, this version runs {DT} s")  # fmt: skip
            layers = [
                Layer.from_json(plain, arrays, f"layers[{index}]")
                for index, plain in enumerate(value["layers"])
            ]
            spec = cls(
                architecture=str(value["architecture"]),
                input_shape=value["input_shape"],
                stimulus=_read_stimulus(value["stimulus"]),
                layers=tuple(layers),
                presentation=load(Presentation, value["presentation"], "presentation"),
                provenance=dict(value.get("provenance", {})),
                estimator=Estimator.from_arrays(arrays, layers[-1].size if layers else 0),
            )
            inputs = layers[-1].weights_by_class.shape[1]
            classes = layers[-1].size
            spec = replace(spec, rehearsal=Rehearsal.from_arrays(arrays, inputs, classes))
            _refuse_unknown(value, {"schema", *spec.to_json()}, "network")
            _refuse_unknown(arrays, spec.to_arrays(), "weights")
            return spec
        except KeyError as error:
            raise UserError(f"network description: {error} is missing") from error
        except (TypeError, AttributeError, ValueError, IndexError, OverflowError) as error:
            raise UserError(f"network description: {error}") from error


def _read_stimulus(value):
    values = dict(value)
    kind = values.pop("kind")
    _require(kind in KINDS, "stimulus", f"kind {kind!r} is not one of {', '.join(KINDS)}")
    return load(KINDS[kind], values, "stimulus")


def _refuse_unknown(values, known, where):
    unknown = [name[:40] for name in sorted(set(values) - set(known))]
    _require(not unknown, where, f"unknown entries {', '.join(unknown[:10])}")


def _is_name(name):
    return isinstance(name, str) and 1 <= len(name) <= 100 and name.isprintable()


def _require(condition, where, problem):
    if not condition:
        raise UserError(f"network description: {where}: {problem}")


def get_spec(network) -> NetworkSpec:
    """The description of a network that is given as such, or by its bundle.

    Parameters
    ----------
    network : NetworkSpec or deploy.check.bundle.Bundle

    Raises
    ------
    TypeError
        It is neither of them, such as a path.
    """
    spec = getattr(network, "spec", network)
    if not isinstance(spec, NetworkSpec):
        kind = type(network).__name__
        raise TypeError(f"network is a Bundle or its spec, not {kind}; read_bundle reads a bundle")
    return spec
