"""A layer of the deployed network, as plain values and in the JSON of a bundle.

A layer of neurons receives the current

    J = W * s + bias        (in units of the threshold)

where ``s`` is the low-pass filtered spike train of the previous layer (each spike has the area
``amplitude``) and ``W`` the layer's weights.  A LIF neuron is silent up to J = 1.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Optional, Tuple

import numpy as np

from .. import limits
from ..errors import UserError
from ..loading import (
    AT_LEAST_1,
    KeyOf,
    Limit,
    WrongValue,
    between,
    limited_field,
    load_dataclass,
    one_of,
    require_valid,
)
from ..plugins import describe_left_out
from .geometry import compute_pooled_shape, sum_windows
from .ops import DEPLOYED_OPERATIONS, DeployedOperation

TAU = between(1e-6, limits.SECONDS, " seconds")
SYNAPSES = between(1, limits.SYNAPSES_PER_WEIGHT)
SHAPE = Limit(
    lambda shape: all(side >= 1 for side in shape) and math.prod(shape) <= limits.NEURONS,
    f"sides of at least 1, with a product of at most {limits.NEURONS}",
)
RISING = Limit(
    lambda starts: (
        starts[:1] == (0,)
        and all(a < b for a, b in zip(starts, starts[1:]))
        and starts[-1] <= limits.STEPS
    ),
    f"rising from 0, to {limits.STEPS} at most",
)


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
        require_valid(self)


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
    section_starts : tuple of int
        Of a readout on the host: first step, in a sample, of each section of the presentation,
        which has weights of its own.  The host knows the step; all other layers have one section.
    recurrent : ndarray, shape (units, units), or None
        Weights of a dense layer's own spikes, by receiving and sending unit; a spike arrives one
        step later.
    synapses_per_weight : int
        Of a layer on the chip: number of synapses between the same two neurons whose sum is a
        weight, recurrent or not; see :mod:`deploy.network.synapses`.
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
    section_starts: Tuple[int, ...] = limited_field(RISING, (0,))
    recurrent: Optional[np.ndarray] = field(default=None, repr=False, compare=False)
    synapses_per_weight: int = limited_field(SYNAPSES, 1)

    def __post_init__(self):
        for name in ("input_shape", "block_shape", "section_starts"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, tuple(int(n) for n in getattr(self, name)))
        try:
            require_valid(self)
            require_valid(self.operation)
        except WrongValue as error:
            raise UserError(f"network description: layer {self.name!r}: {error}") from error
        self._convert_arrays()
        self._require_abilities()
        self._require_shapes()

    def _require(self, condition, problem):
        require(condition, f"layer {self.name!r}", problem)

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

    def _require_abilities(self):
        """Refuse neurons, sections and recurrent weights where a layer cannot have them."""
        has_neurons = self.neurons is not None
        self._require(
            self.n_sections == 1 or (self.operation.can_read_out and not has_neurons),
            "only a readout on the host has sections",
        )
        self._require(
            self.recurrent is None or (self.operation.can_recur and has_neurons),
            f"{self.kind!r} cannot be recurrent, or has no neurons",
        )
        self._require(
            self.synapses_per_weight == 1 or has_neurons,
            "only a layer on the chip has several synapses for a weight",
        )
        common = set(self.operation.to_file()) & LAYER_NAMES
        self._require(
            not common, f"its operation has numbers with the names of a layer's values: {common}"
        )

    def _require_shapes(self):
        """Compare the shapes with those of the operation."""
        is_image = self.operation.is_spatial or self.pool > 1
        self._require(
            len(self.input_shape) in ((3,) if is_image else (1, 3)),
            f"input_shape {self.input_shape} has {len(self.input_shape)} dimensions; a layer has "
            "one, or three for an image",
        )
        self._require(min(self.pooled_shape) >= 1, "its pooling is larger than its input")
        try:
            shape = self.shape
        except ValueError as error:
            raise UserError(f"network description: layer {self.name!r}: {error}") from error
        self._require(
            self.block_shape is None or len(self.block_shape) == len(shape),
            f"block_shape {self.block_shape} and shape differ in length",
        )
        weight_shape = self.operation.compute_weight_shape(self.pooled_shape)
        self._require(len(weight_shape) >= 1, f"the operation {self.kind!r} needs a weight")
        first, *others = weight_shape
        expected = {
            "weights": (self.n_sections * first, *others),
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
        return self.operation.compute_shape(self.pooled_shape)

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
        averages = sum_windows(values, self.pool) / self.pool**2
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
    def n_sections(self) -> int:
        """Number of sections of the presentation, each of which has weights of its own."""
        return len(self.section_starts)

    def find_section(self, steps) -> np.ndarray:
        """The section, from 0, to which steps of a sample, also from 0, belong."""
        return np.searchsorted(self.section_starts, steps, side="right") - 1

    @property
    def weights_by_class(self) -> np.ndarray:
        """Weights of a readout for the inputs of all sections, shape (units, sections * inputs)."""
        weights = self.weights.reshape(self.n_sections, self.size, -1)
        return weights.swapaxes(0, 1).reshape(self.size, -1)

    def with_weights_by_class(self, weights) -> Layer:
        """The readout with other weights, in the shape of :attr:`weights_by_class`."""
        by_section = np.reshape(weights, (self.size, self.n_sections, -1)).swapaxes(0, 1)
        return replace(self, weights=by_section.reshape(self.weights.shape))

    @property
    def pooled_shape(self) -> Tuple[int, ...]:
        """Shape of the input after pooling, which is what the weights multiply."""
        if self.pool == 1:
            return self.input_shape
        return compute_pooled_shape(self.input_shape, self.pool)

    @property
    def pooled_fan_out(self) -> np.ndarray:
        """Number of synapses of each value after pooling, of shape `pooled_shape`."""
        return self.operation.count_fan_out(self.pooled_shape)

    @property
    def fan_out(self) -> np.ndarray:
        """Number of synapses of each neuron of the previous layer onto this one, shape (n_inputs,).

        Neurons near the edge of a convolution reach fewer positions; those outside of complete
        pooling windows reach none.  Zeros that pad a kernel are not counted.
        """
        one = self.operation.count_input_fan_out(self.input_shape, self.pool).ravel()
        return one * self.synapses_per_weight

    @property
    def multiply_accumulates(self) -> int:
        """Multiply-accumulates of the same layer of a CNN, one inference.

        Pooling before the layer is included: one operation for each value that is averaged.
        """
        pooling = int(np.prod(self.pooled_shape)) * self.pool**2 if self.pool > 1 else 0
        loop = 0 if self.recurrent is None else self.size**2
        return int(self.pooled_fan_out.sum()) + pooling + loop

    def to_json(self) -> dict:
        """The description without the arrays, for ``network.json``."""
        several = self.synapses_per_weight > 1
        values = {
            "name": self.name,
            "kind": self.kind,
            "input_shape": self.input_shape,
            "shape": self.shape,
            "placement": self.placement,
            "neurons": None if self.neurons is None else asdict(self.neurons),
            "synapse": self.synapse,
            "block_shape": self.block_shape,
            "pool": self.pool,
            "starts": self.section_starts,
            **({"synapses_per_weight": self.synapses_per_weight} if several else {}),
            **self.operation.to_file(),
        }
        order = [*(name for name in ORDER_IN_FILE if name in values), *values]
        return {name: values[name] for name in dict.fromkeys(order)}

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
        record = LayerRecord.read(plain, where)
        operation = read_operation(plain, record, where)
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
            section_starts=record.starts,
            recurrent=arrays.get(f"{record.name}.recurrent"),
            synapses_per_weight=record.synapses_per_weight,
        )
        layer._require(layer.shape == record.shape, f"shape should be {layer.shape}")
        layer._require(
            layer.placement == record.placement,
            "a layer on the chip has neurons, one on the host has none",
        )
        return layer


@dataclass(frozen=True)
class LayerRecord:
    """A layer in ``network.json``, without the numbers of its operation.

    Attributes
    ----------
    kind, shape, placement
        Those of the layer, with which the values below must agree.
    name, input_shape, neurons, synapse, block_shape, pool, starts, synapses_per_weight
        See `Layer`.
    """

    name: str
    kind: str = limited_field(KeyOf(DEPLOYED_OPERATIONS))
    input_shape: Tuple[int, ...] = limited_field(SHAPE)
    shape: Tuple[int, ...] = limited_field(SHAPE)
    placement: str = limited_field(one_of("chip", "host"))
    neurons: Optional[Neurons]
    synapse: Optional[float] = limited_field(TAU)
    block_shape: Optional[Tuple[int, ...]] = limited_field(SHAPE, None)
    pool: int = limited_field(AT_LEAST_1, 1)
    starts: Tuple[int, ...] = limited_field(RISING, (0,))
    synapses_per_weight: int = limited_field(SYNAPSES, 1)

    @classmethod
    def read(cls, plain: dict, where: str) -> LayerRecord:
        """The record of a layer's description.

        Raises
        ------
        WrongValue
            A value is missing, of another type or out of range.  If the operation is not known,
            the message names the plugins that this host has left out.
        """
        if not isinstance(plain, dict):
            raise WrongValue(where, "must be a table of values")
        try:
            return load_dataclass(
                cls, {name: plain[name] for name in plain if name in LAYER_NAMES}, where
            )
        except WrongValue as error:
            left_out = describe_left_out()
            if error.name != f"{where}.kind" or not left_out:
                raise
            raise WrongValue(error.name, f"{error.problem}; {left_out}") from error


# Names in a layer's description that no operation may have for its numbers.
LAYER_NAMES = {entry.name for entry in fields(LayerRecord)}

# Order of a layer's entries in a bundle; those of further operations follow.  A change of the order
# would change the bundle's id.
ORDER_IN_FILE = (
    "name",
    "kind",
    "input_shape",
    "shape",
    "placement",
    "neurons",
    "synapse",
    "kernel",
    "block_shape",
    "stride",
    "padding",
    "pool",
    "starts",
    "synapses_per_weight",
)


def read_operation(plain: dict, record: LayerRecord, where: str) -> DeployedOperation:
    """The operation of a layer's description.

    Raises
    ------
    WrongValue
        A number is missing, unknown, of another type or out of range.
    """
    operation = DEPLOYED_OPERATIONS[record.kind]
    numbers = {name: value for name, value in plain.items() if name not in LAYER_NAMES}
    try:
        return operation.from_file(numbers, record.shape)
    except WrongValue as error:
        raise WrongValue(f"{where}.{error.name}", error.problem) from error


def require(condition, where: str, problem: str):
    """Refuse a description unless a condition holds.

    Raises
    ------
    UserError
        It does not hold; the message names the part of the description and the problem.
    """
    if not condition:
        raise UserError(f"network description: {where}: {problem}")
