"""Export of the chip's part of a network to Lava, for its integer models of Loihi.

The file contains the chip's integers as compiled by :mod:`deploy.targets.fast`, in Lava's units,
and the spikes from the host to the chip; nothing here imports Lava.  The integers correspond as
follows (Lava 0.10, ``lava.proc.lif`` and ``lava.proc.sparse``, fixed-point models)::

    du = 4095 - keep_u, dv = 4096 - keep_v      decays, 12 bits
    vth = threshold / 64                        Lava multiplies it by 64 again
    bias = bias_mant * 2**bias_exp              for each neuron
    q = weight * 2**(6 + weight_exp)            one exponent per connection

On both sides a spike acts on its targets in the next step.  Lava's LIF has neither a refractory
period nor a lower voltage bound: ``refractory`` and ``v_min`` are for readers that implement them.
Its synaptic accumulator does not wrap at 21 bits.

Lava has one threshold, decay and bound per population, so a layer whose blocks differ in these is
written as several populations.  The file is an ``.npz`` of plain arrays:

===========================  ====================================================================
``description``              JSON: ``inputs``, ``layers``, ``populations``, see `lava_arrays`
``spikes.<input>``           uint8, shape (n_samples, period, n / 8): eight neurons per byte
``<population>.places``      int32, shape (n,): indices of these neurons in the layer
``<population>.bias_mant``,  int32, shape (n,)
``<population>.bias_exp``
``<population>.<k>.data``,   weights of the k-th connection into it, compressed sparse rows
``.indices``, ``.indptr``
===========================  ====================================================================
"""

from __future__ import annotations

import json

import numpy as np
import scipy.sparse

from ..errors import UserError
from ..files import write_arrays
from ..network.chip import LOIHI
from ..network.spec import NetworkSpec
from .fast import Emulation

# Limit at which Lava and the chip clip voltages.
LARGEST = 2**LOIHI.current_bits - 1

_BIAS_EXPONENTS = 8


def write_lava(path, spec: NetworkSpec, images):
    """Write the chip's part of a network and its input spikes for some samples, atomically.

    Parameters
    ----------
    path : path-like
    spec : NetworkSpec
    images : ndarray, shape (n_samples, ...)
        The presented samples, in streams as defined by the network's presentation.

    Raises
    ------
    UserError
        The network has integers that Lava cannot represent.
    """
    write_arrays(path, **lava_arrays(spec, images))


def lava_arrays(spec: NetworkSpec, images) -> dict:
    """Compute the arrays that :func:`write_lava` writes.

    ``description`` has ``period`` (steps per sample including the gap), ``stream_length`` (samples
    after which the network starts from rest), ``inputs`` and ``layers`` (each ``name`` and ``n``),
    and ``populations`` in order (each ``name``, ``layer``, ``n``, ``du``, ``dv``, ``vth``,
    ``refractory``, ``v_min`` and ``connections``, each with the name of its ``source``, an input or
    an earlier population, and ``weight_exp``).
    """
    emulation = Emulation(spec)
    n_inputs, constants = int(np.prod(spec.input_shape)), emulation.chip.constants()
    weights = weights_of(emulation)
    arrays, populations, sources = {}, [], {"input": np.arange(n_inputs)}
    for layer, name, places, common in _populations(emulation.positions, constants):
        columns, connections = emulation.positions[layer][places], []
        for source, part, exponent in _connections(weights[:, columns], sources, layer):
            key = f"{name}.{len(connections)}"
            arrays[f"{key}.data"] = part.data.astype(np.int16)
            arrays[f"{key}.indices"], arrays[f"{key}.indptr"] = part.indices, part.indptr
            connections.append({"source": source, "weight_exp": exponent})
        mantissas, exponents = _bias(constants["bias"][columns], layer)
        arrays[f"{name}.bias_mant"], arrays[f"{name}.bias_exp"] = mantissas, exponents
        arrays[f"{name}.places"] = places.astype(np.int32)
        populations.append({"name": name, **common, "connections": connections})
        sources[name] = n_inputs + columns
    arrays["spikes.input"] = spikes_of(emulation, images)["input"]
    description = {
        "period": spec.presentation.period,
        "stream_length": spec.presentation.stream_length,
        "inputs": [{"name": "input", "n": n_inputs}],
        "layers": [{"name": name, "n": len(at)} for name, at in emulation.positions.items()],
        "populations": populations,
    }
    return {"description": np.array(json.dumps(description)), **arrays}


def weights_of(emulation: Emulation) -> scipy.sparse.csr_matrix:
    """Weights on the chip, shape (inputs + compartments, compartments)."""
    n_inputs, n = int(np.prod(emulation.spec.input_shape)), emulation.chip.n
    source, target, value = emulation.chip.weights()
    sent = np.concatenate([emulation.sent, n_inputs + np.arange(n)])
    return scipy.sparse.coo_matrix((value, (sent[source], target)), (n_inputs + n, n)).tocsr()


def spikes_of(emulation: Emulation, images) -> dict:
    """Every spike of every population, in the network's presentation.

    Parameters
    ----------
    emulation : Emulation
        Of the network or of a variant.
    images : ndarray, shape (n_samples, ...)

    Returns
    -------
    dict of str to uint8 ndarray, shape (n_samples, period, n / 8)
        Eight neurons per byte, see `numpy.packbits`; includes the inputs from the host.
    """
    spec, samples = emulation.spec, []
    images = spec.stimulus.flat(images)
    for part in spec.presentation.streams(len(images)):
        emulation.run(images[part][None], samples.append)
    return {name: np.concatenate([sample[name] for sample in samples]) for name in samples[0]}


def _populations(positions, constants):
    """(layer, name, indices in the layer, shared parameters) of every population."""
    names = ("keep_u", "keep_v", "v_min", "v_max", "refractory", "threshold")
    alike = np.stack([constants[name] for name in names])
    for layer, position in positions.items():
        values, group = np.unique(alike[:, position], axis=1, return_inverse=True)
        for index, column in enumerate(values.T.tolist()):
            keep_u, keep_v, v_min, v_max, refractory, threshold = column
            if threshold % 64 or v_max != LARGEST:
                raise UserError(f"layer {layer}: Lava cannot hold its threshold or upper bound")
            places = np.flatnonzero(group.ravel() == index)
            yield (
                layer,
                layer if values.shape[1] == 1 else f"{layer}#{index + 1}",
                places,
                {
                    "layer": layer,
                    "n": len(places),
                    "du": LOIHI.decay_levels - keep_u,
                    "dv": LOIHI.decay_unit - keep_v,
                    "vth": threshold // 64,
                    "refractory": refractory,
                    "v_min": max(v_min, -LARGEST),
                },
            )


def _bias(bias, label):
    """Signed mantissas with the chip's bits, and exponents, of each neuron's bias."""
    bias, beyond = np.asarray(bias, np.int64), 2**LOIHI.bias_bits
    exponents = np.zeros(len(bias), np.int64)
    for _ in range(_BIAS_EXPONENTS - 1):
        exponents += np.abs(bias >> exponents) >= beyond
    mantissas = bias >> exponents
    if np.any(mantissas << exponents != bias) or np.any(np.abs(mantissas) >= beyond):
        raise UserError(f"layer {label}: bias does not fit {LOIHI.bias_bits} bits and an exponent")
    return mantissas.astype(np.int32), exponents.astype(np.int32)


def _connections(into, sources, label):
    """(source, weights (n, n_source) in Lava's units, exponent) of the inputs of a population.

    Lava has one exponent per connection and signed 8-bit mantissas, which are even.
    """
    last = list(sources)[-1]
    for name, rows in sources.items():
        weights, exponent = into[rows].T.tocsr(), 0  # one row per target
        while weights.nnz and np.abs(weights.data).max() >> (6 + exponent) > 256:
            exponent += 1
        mantissas = weights.data >> (6 + exponent)
        exact = np.all(mantissas << (6 + exponent) == weights.data) and not np.any(mantissas % 2)
        if not exact or exponent > 7 or np.any(mantissas > 254):
            raise UserError(f"layer {label}: a weight does not fit 8 bits and an exponent")
        weights.data = mantissas
        if weights.nnz or name == last:  # Lava only runs connected processes
            yield name, weights, exponent
