"""The deployed network as plain values, as it runs on the chip, and its JSON form.

:mod:`deploy.network.layer` has its layers, :mod:`deploy.network.presentation` how samples are
presented to it, and :mod:`deploy.network.stimulus` its input.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Dict, Optional, Tuple

import numpy as np

from .. import limits
from ..errors import UserError
from ..loading import load_dataclass
from .chip import DT
from .decision import Estimator
from .layer import SHAPE, Layer, require
from .presentation import Presentation
from .provenance import NetworkProvenance
from .rehearsal import Rehearsal
from .stimulus import STIMULI, Stimulus


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
    provenance : NetworkProvenance
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
    provenance: NetworkProvenance = field(default_factory=NetworkProvenance)
    estimator: Optional[Estimator] = field(default=None, repr=False, compare=False)
    rehearsal: Optional[Rehearsal] = field(default=None, repr=False, compare=False)

    def __post_init__(self):
        object.__setattr__(self, "input_shape", tuple(int(n) for n in self.input_shape))
        object.__setattr__(self, "layers", tuple(self.layers))
        if not isinstance(self.provenance, NetworkProvenance):
            object.__setattr__(self, "provenance", NetworkProvenance(dict(self.provenance)))
        require(SHAPE.holds(self.input_shape), "network", f"input_shape is not {SHAPE.expected}")
        require(1 <= len(self.layers) <= limits.LAYERS, "network", "has no layers, or too many")
        names = [layer.name for layer in self.layers]
        require(all(map(_is_name, names)), "network", "a layer's name is not a short text")
        require(len(set(names)) == len(names), "network", "has two layers of the same name")
        require(
            "input" not in names, "network", "'input' is the input neurons' name, not a layer's"
        )
        shape = self.input_shape
        for position, layer in enumerate(self.layers):
            where = f"layer {layer.name!r}"
            require(layer.input_shape == shape, where, f"input_shape should be {shape}")
            last = position == len(self.layers) - 1
            if last:
                can_read_out = layer.operation.can_read_out
                require(can_read_out, where, f"{layer.kind!r} cannot be the last layer")
            else:
                on_chip = layer.placement == "chip"
                require(on_chip, where, "only the last layer can be on the host")
                require(layer.n_sections == 1, where, "only the last layer has sections")
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
                own_fan_out = layer.size * layer.synapses_per_weight
                operations[layer.name] += np.sum(spikes[layer.name], axis=-1) * own_fan_out
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
            "presentation": self.presentation.to_json(),
            "provenance": self.provenance.entries,
        }

    def to_arrays(self) -> dict:
        """The arrays, for ``weights.npz``: ``<layer>.weights``, ``<layer>.bias`` and the rest."""
        arrays = {
            f"{layer.name}.{name}": getattr(layer, name)
            for layer in self.layers
            for name in layer.arrays
        }
        for part in (self.estimator, self.rehearsal):
            if part is not None:
                arrays.update(part.to_arrays())
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
            require(value["dt"] == DT, "network",
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
                presentation=load_dataclass(Presentation, value["presentation"], "presentation"),
                provenance=NetworkProvenance(dict(value.get("provenance", {}))),
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
    require(kind in STIMULI, "stimulus", f"kind {kind!r} is not one of {', '.join(STIMULI)}")
    return load_dataclass(STIMULI[kind], values, "stimulus")


def _refuse_unknown(values, known, where):
    unknown = [name[:40] for name in sorted(set(values) - set(known))]
    require(not unknown, where, f"unknown entries {', '.join(unknown[:10])}")


def _is_name(name):
    return isinstance(name, str) and 1 <= len(name) <= 100 and name.isprintable()


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
