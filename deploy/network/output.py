"""The output of a target for a stream of samples."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from typing import Dict, Optional

import numpy as np

from .spec import NetworkSpec


@dataclass(frozen=True)
class TargetOutput:
    """The output of a target for the samples of a stream.

    Attributes
    ----------
    readout : ndarray, shape (n_samples, steps, outputs)
        The readout at each step of a sample's presentation, without the gap before it.  On the
        host: decoded values, without the bias, of the classes, or of the classes in all sections
        (``sections * n_classes`` outputs), from which the section of each step is selected; see
        :func:`deploy.network.reference.read_out`.  On the chip: the output neurons' spikes,
        ``amplitude / dt`` in a step with a spike.
    spikes : dict of str to ndarray of int, shape (n_samples, n_neurons), or None
        Number of spikes of each neuron of each spiking layer (``spec.spiking_layers``), including
        the gap before the sample; None if the target does not count them.
    spike_hashes : ndarray of str, shape (n_samples,), or None
        See `Responses`.
    notes : dict
        See `Responses`.
    """

    readout: np.ndarray
    spikes: Optional[Dict[str, np.ndarray]] = None
    spike_hashes: Optional[np.ndarray] = None
    notes: dict = field(default_factory=dict)

    @classmethod
    def from_stream(cls, spec: NetworkSpec, output, spikes) -> TargetOutput:
        """The output for a stream of which every step was recorded.

        Parameters
        ----------
        spec : NetworkSpec
        output : ndarray, shape (n_samples * period, outputs)
            The readout at each step, the gaps included.
        spikes : dict of str to ndarray, shape (n_samples * period, n_neurons)
            Spikes of each spiking layer, in order.
        """
        presentation = spec.presentation
        period = presentation.period

        def split_by_sample(values):
            return values.reshape(-1, period, values.shape[-1])

        by_layer = {name: split_by_sample(rows) != 0 for name, rows in spikes.items()}
        packed = [np.packbits(rows, axis=2) for rows in by_layer.values()]
        hashes = [hash_spikes(of_sample) for of_sample in zip(*packed)]
        return cls(
            readout=split_by_sample(output)[:, presentation.gap :],
            spikes={name: np.count_nonzero(rows, axis=1) for name, rows in by_layer.items()},
            spike_hashes=np.array(hashes),
        )

    def require_shapes(self, spec: NetworkSpec, n_samples: int, target: str):
        """Refuse what cannot be the output of a network for some samples.

        Raises
        ------
        ValueError
            A shape or a type is wrong; the message names the target.
        """
        outputs = _count_outputs(spec, self.readout)
        shape = (n_samples, spec.presentation.steps, outputs)
        _require_array(target, "readout", self.readout, shape, "biuf")
        if not np.isfinite(self.readout).all():
            raise ValueError(f"target {target!r}: its readout has NaN or infinite values")
        if self.spikes is not None:
            sizes = {"input": math.prod(spec.input_shape)}
            sizes.update((layer.name, layer.size) for layer in spec.layers if layer.neurons)
            if self.spikes.keys() != sizes.keys():
                raise ValueError(
                    f"target {target!r}: it gives the spikes of {', '.join(self.spikes)}; the "
                    f"spiking layers are {', '.join(sizes)}"
                )
            for name, size in sizes.items():
                counts = self.spikes[name]
                _require_array(target, f"spikes of {name!r}", counts, (n_samples, size), "iu")
        if self.spike_hashes is not None:
            _require_array(target, "spike_hashes", self.spike_hashes, (n_samples,), "U")


def _count_outputs(spec, readout) -> int:
    """The number of outputs of a step that a readout should have."""
    last = spec.layers[-1]
    has_only_classes = np.shape(readout)[-1:] == (last.size,)
    return last.size if has_only_classes else last.n_sections * last.size


def _require_array(target, name, array, shape, kinds):
    array = np.asarray(array)
    if array.shape != shape:
        raise ValueError(f"target {target!r}: {name} of shape {array.shape} should have {shape}")
    if array.dtype.kind not in kinds:
        raise ValueError(f"target {target!r}: {name} must not have the type {array.dtype}")


def hash_spikes(packed) -> str:
    """Hash of every spike of a sample.

    Parameters
    ----------
    packed : iterable of uint8 ndarray, shape (period, n_neurons / 8)
        Spikes of each layer, in order, eight neurons per byte (`numpy.packbits`).
    """
    every_spike = hashlib.sha256()
    for rows in packed:
        every_spike.update(rows.tobytes())
    return every_spike.hexdigest()[:16]
