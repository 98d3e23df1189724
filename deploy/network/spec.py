"""The deployed network as plain values: layers, neurons, presentation, and their JSON form.

What is described here is the network as the chip sees it.  A layer of neurons receives the current

    J = W * s + bias        (in units of the threshold)

where ``s`` is the low-pass filtered spike train of the layer before it (each spike has the area
``amplitude``) and ``W`` the layer's convolution.  A LIF neuron is silent up to J = 1.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, replace
from typing import Optional, Tuple

import numpy as np

from ..errors import UserError

DT = 0.001
"""Time step in seconds; NengoLoihi's decays and the firing rates of training are made for it."""


@dataclass(frozen=True)
class Neurons:
    """A type of spiking neuron.

    Attributes
    ----------
    kind : str
        ``"lif"`` or ``"relu"`` (integrate-and-fire without leak, rate rectified linear).
    amplitude : float
        Area of one spike, in units of the value that the layer represents times seconds.
    tau_rc, tau_ref : float
        Membrane time constant and refractory period in seconds; LIF only.
    min_voltage : float
        Lower bound of the membrane voltage, in units of the threshold; LIF only.
    """

    kind: str
    amplitude: float
    tau_rc: float = 0.02
    tau_ref: float = 0.001
    min_voltage: float = 0.0

    def __post_init__(self):
        _require(self.kind in ("lif", "relu"), "neurons", "kind is neither 'lif' nor 'relu'")
        _require(self.amplitude > 0, "neurons", "amplitude must be positive")
        _require(self.tau_rc > 0 and self.tau_ref >= 0, "neurons", "time constants are negative")
        _require(self.min_voltage <= 0, "neurons", "min_voltage must not be positive")


@dataclass(frozen=True)
class Encoder:
    """How the tactile image becomes spikes: host neurons without leak, one a pixel.

    A pixel of value v makes ``max_rate * v`` spikes a second, evenly spaced, each of area
    1 / ``max_rate``, so that the mean of the spike train is v again.  A pixel that turns blank
    forgets what it had summed up, so that a sample's spikes do not depend on the one before it.

    Attributes
    ----------
    max_rate : float
        Spikes a second of a pixel of value 1; at most 1 / dt, one spike a step.
    initial_phase : float
        Voltage of a blank pixel as a share of the threshold.  With 0.5 the number of spikes is the
        expected number rounded to the nearest, with 0 it is rounded down.
    """

    max_rate: float = 500.0
    initial_phase: float = 0.5

    def __post_init__(self):
        _require(0 < self.max_rate <= 1 / DT, "encoder", "max_rate must be above 0, at most 1000")
        _require(0 <= self.initial_phase < 1, "encoder", "initial_phase must be in [0, 1)")


@dataclass(frozen=True)
class Layer:
    """A layer of the deployed network.

    Attributes
    ----------
    name : str
        ``"conv1"``, ``"conv2"``, ..., ``"output"``.
    kind : str
        ``"conv"`` or ``"dense"``.
    input_shape, shape : tuple of int
        (rows, columns, channels) before and after; a dense layer's shape is (units,).
    placement : str
        ``"chip"`` or ``"host"``.
    neurons : Neurons or None
        None for a linear readout on the host.
    synapse : float or None
        Time constant in seconds of the low-pass on the layer's input; None for no filter.
    kernel : int
        Side of the convolution's filters (0 for dense).
    block_shape : tuple of int or None
        (rows, columns, channels) of the part of the layer that shares a core; None for the whole.
    pop_type : int
        NengoLoihi's population axon type, 16 or 32.
    weights : ndarray, shape (kernel, kernel, channels_in, filters) or (units, inputs)
    bias : ndarray, shape (channels,) or (units,)
        Bias current J of each channel's neurons, or the additive bias of a linear readout.
    """

    name: str
    kind: str
    input_shape: Tuple[int, ...]
    shape: Tuple[int, ...]
    placement: str
    neurons: Optional[Neurons]
    synapse: Optional[float]
    kernel: int
    block_shape: Optional[Tuple[int, ...]]
    pop_type: int
    weights: np.ndarray = field(repr=False, compare=False)
    bias: np.ndarray = field(repr=False, compare=False)

    def __post_init__(self):
        where = f"layer {self.name!r}"
        for name in ("input_shape", "shape", "block_shape"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, tuple(int(n) for n in getattr(self, name)))
        for name in ("weights", "bias"):
            array = np.asarray(getattr(self, name), float)
            object.__setattr__(self, name, array)
            _require(np.isfinite(array).all(), where, f"{name} has NaN or infinite values")
        _require(self.kind in ("conv", "dense"), where, "kind is neither 'conv' nor 'dense'")
        _require(self.placement in ("chip", "host"), where, "placement is not 'chip' or 'host'")
        _require(self.neurons is not None or self.placement == "host", where,
                 "a layer on the chip needs neurons")  # fmt: skip
        _require(self.pop_type in (16, 32), where, "pop_type is neither 16 nor 32")
        _require(self.synapse is None or self.synapse > 0, where, "synapse must be above 0")
        if self.kind == "conv":
            rows, columns, channels = self.input_shape
            weights = (self.kernel, self.kernel, channels, self.shape[-1])
            expected = (rows - self.kernel + 1, columns - self.kernel + 1, self.shape[-1])
            _require(self.shape == expected, where, f"shape should be {expected}")
        else:
            weights = (self.shape[0], int(np.prod(self.input_shape)))
        _require(self.weights.shape == weights, where,
                 f"weights have shape {self.weights.shape}, not {weights}")  # fmt: skip
        _require(self.bias.shape == self.shape[-1:], where,
                 f"bias has shape {self.bias.shape}, not {self.shape[-1:]}")  # fmt: skip

    @property
    def size(self) -> int:
        """Number of neurons or units."""
        return int(np.prod(self.shape))


@dataclass(frozen=True)
class Presentation:
    """How samples are shown and read; every target follows it step by step.

    Samples come in streams.  A stream starts from a fresh network; in it each sample follows
    ``gap`` steps of a blank image and is shown for ``steps`` steps.  The network goes on from the
    state that it is in, because a board cannot be reset between samples.  The gap comes first, so
    that every sample, the first of a stream too, meets a network at rest under its bias currents.

    Attributes
    ----------
    steps : int
        Steps (of 1 ms) that a sample is shown for.
    gap : int
        Blank steps before each sample.
    readout_start : int
        Steps at the start of each sample that the readout leaves out.
    stream_length : int
        Samples a stream; 1 means that every sample starts from a fresh network.
    """

    steps: int = 100
    gap: int = 20
    readout_start: int = 15
    stream_length: int = 10

    @property
    def period(self) -> int:
        """Steps from one sample to the next, the gap included."""
        return self.gap + self.steps

    def __post_init__(self):
        whole = all(type(getattr(self, entry.name)) is int for entry in fields(self))
        _require(whole, "presentation", "its entries must be whole numbers")
        _require(self.steps >= 1, "presentation", "steps must be at least 1")
        _require(self.gap >= 0, "presentation", "gap must not be negative")
        _require(0 <= self.readout_start < self.steps, "presentation",
                 f"readout_start must be from 0 to steps - 1 = {self.steps - 1}")  # fmt: skip
        _require(self.stream_length >= 1, "presentation", "stream_length must be at least 1")


@dataclass(frozen=True)
class NetworkSpec:
    """The deployed network.

    Attributes
    ----------
    architecture : str
        The paper's notation.
    input_shape : tuple of int
        (rows, columns, channels) of the image.
    encoder : Encoder or None
        None if the image goes as a current into a first layer on the host.
    layers : tuple of Layer
        In order; the last one is the readout.
    presentation : Presentation
    provenance : dict
        Where the network comes from: data set, seed, recipe, package version.
    """

    architecture: str
    input_shape: Tuple[int, ...]
    encoder: Optional[Encoder]
    layers: Tuple[Layer, ...]
    presentation: Presentation
    provenance: dict = field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "input_shape", tuple(int(n) for n in self.input_shape))
        object.__setattr__(self, "layers", tuple(self.layers))
        _require(len(self.layers) >= 1, "network", "has no layers")
        names = [layer.name for layer in self.layers]
        _require(len(set(names)) == len(names), "network", "has two layers of one name")
        _require("input" not in names, "network", "'input' is the encoder's name, not a layer's")
        shape = self.input_shape
        for position, layer in enumerate(self.layers):
            where = f"layer {layer.name!r}"
            _require(layer.input_shape == shape, where, f"input_shape should be {shape}")
            last = position == len(self.layers) - 1
            _require((layer.kind == "dense") == last, where,
                     "the last layer is dense, all others are convolutions")  # fmt: skip
            _require(last or layer.neurons is not None, where, "needs neurons")
            _require(position == 0 or last or layer.placement == "chip", where,
                     "only the first and the last layer can be on the host")  # fmt: skip
            shape = layer.shape
        current_input = self.layers[0].placement == "host" and self.layers[0].kind == "conv"
        _require((self.encoder is None) == current_input, "network",
                 "an encoder is needed exactly when the first layer is on the chip")  # fmt: skip

    @property
    def spiking_layers(self) -> tuple:
        """Names of the layers that spike, the encoder's (``"input"``) first."""
        names = ["input"] if self.encoder else []
        return (*names, *(layer.name for layer in self.layers if layer.neurons))

    def with_presentation(self, **changes) -> NetworkSpec:
        """The same network shown in another way."""
        return replace(self, presentation=replace(self.presentation, **changes))

    def to_json(self) -> dict:
        """The description without the arrays, for ``network.json``."""
        layers = []
        for layer in self.layers:
            plain = asdict(replace(layer, weights=layer.weights, bias=layer.bias))
            layers.append({k: v for k, v in plain.items() if k not in ("weights", "bias")})
        return {
            "architecture": self.architecture,
            "dt": DT,
            "input_shape": list(self.input_shape),
            "encoder": None if self.encoder is None else asdict(self.encoder),
            "layers": layers,
            "presentation": asdict(self.presentation),
            "provenance": self.provenance,
        }

    def arrays(self) -> dict:
        """The arrays, for ``weights.npz``: ``<layer>.weights`` and ``<layer>.bias``."""
        return {
            f"{layer.name}.{name}": getattr(layer, name)
            for layer in self.layers
            for name in ("weights", "bias")
        }

    @classmethod
    def from_json(cls, value: dict, arrays: dict) -> NetworkSpec:
        """The inverse of :meth:`to_json` and :meth:`arrays`.

        Raises
        ------
        UserError
            A value is missing, unknown, of the wrong kind, or the time step is another.
        """
        try:
            _require(value["dt"] == DT, "network",
                     f"time step is {value['dt']} s, this version runs {DT} s")  # fmt: skip
            layers = []
            for plain in value["layers"]:
                name = plain["name"]
                neurons = plain["neurons"]
                own = dict(
                    plain,
                    neurons=None if neurons is None else _build(Neurons, neurons),
                    weights=arrays[f"{name}.weights"],
                    bias=arrays[f"{name}.bias"],
                )
                layers.append(_build(Layer, own))
            encoder = value["encoder"]
            return cls(
                architecture=str(value["architecture"]),
                input_shape=value["input_shape"],
                encoder=None if encoder is None else _build(Encoder, encoder),
                layers=tuple(layers),
                presentation=_build(Presentation, value["presentation"]),
                provenance=dict(value.get("provenance", {})),
            )
        except KeyError as error:
            raise UserError(f"network description: {error} is missing") from error
        except (TypeError, AttributeError, ValueError, IndexError, OverflowError) as error:
            raise UserError(f"network description: a value of the wrong kind ({error})") from error


def _build(kind, values):
    known = {f.name for f in fields(kind)}
    unknown = sorted(set(values) - known)
    _require(not unknown, kind.__name__.lower(), f"unknown entries {', '.join(unknown)}")
    return kind(**values)


def _require(condition, where, problem):
    if not condition:
        raise UserError(f"network description: {where}: {problem}")
