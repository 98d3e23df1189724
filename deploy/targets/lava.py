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

from ..errors import UserError
from ..files import write_arrays
from ..network.chip import LOIHI
from ..network.spec import NetworkSpec
from ..network.stream import streams_of
from .fast.arrays import U_BITS
from .fast.emulation import Emulation, compile_spec
from .fast.from_nengo import Program

LARGEST = 2**U_BITS - 1
"""Limit at which Lava and the chip clip voltages."""

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
    program = compile_spec(spec)
    network = program.network
    arrays, populations = {}, []
    sources, first = {}, 0
    for item in program.inputs:
        sources[item.label] = np.arange(first, first + item.n)
        first += item.n
    for layer, name, places, common in _populations(network):
        columns, connections = layer.position[places], []
        for source, weights, exponent in _connections(network, columns, sources, layer.label):
            key = f"{name}.{len(connections)}"
            arrays[f"{key}.data"] = weights.data.astype(np.int16)
            arrays[f"{key}.indices"], arrays[f"{key}.indptr"] = weights.indices, weights.indptr
            connections.append({"source": source, "weight_exp": exponent})
        mantissas, exponents = _bias(network.bias[columns], layer.label)
        arrays[f"{name}.bias_mant"], arrays[f"{name}.bias_exp"] = mantissas, exponents
        arrays[f"{name}.places"] = places.astype(np.int32)
        populations.append({"name": name, **common, "connections": connections})
        sources[name] = network.n_inputs + columns
    spikes = spikes_of(program, spec, images)
    arrays.update({f"spikes.{item.label}": spikes[item.label] for item in program.inputs})
    description = {
        "period": spec.presentation.period,
        "stream_length": spec.presentation.stream_length,
        "inputs": [{"name": item.label, "n": item.n} for item in program.inputs],
        "layers": [{"name": x.label, "n": len(x.position)} for x in network.layers],
        "populations": populations,
    }
    return {"description": np.array(json.dumps(description)), **arrays}


def without_refractory_and_floor(program: Program) -> Program:
    """The network with Lava's standard neurons, without refractory period and lower bound."""
    segments = program.network.segments
    free = segments._replace(
        refractory=np.zeros_like(segments.refractory),
        v_min=np.full_like(segments.v_min, -LARGEST),
    )
    return program._replace(network=_replaced(program.network, segments=free))


def spikes_of(program: Program, spec: NetworkSpec, images) -> dict:
    """Every spike of every population, in the network's presentation.

    Parameters
    ----------
    program : Program
        The program of this network or of a variant.
    spec : NetworkSpec
    images : ndarray, shape (n_samples, ...)

    Returns
    -------
    dict of str to uint8 ndarray, shape (n_samples, period, n / 8)
        Eight neurons per byte, see `numpy.packbits`; includes the inputs from the host.
    """
    images = spec.stimulus.flat(images)
    shown, emulation, samples = spec.presentation, Emulation(program), []
    for part in streams_of(len(images), shown.stream_length):
        emulation.run(images[part][None], shown.steps, shown.gap, samples.append)
    return {name: np.concatenate([sample[name] for sample in samples]) for name in samples[0]}


def _replaced(network, **changes):
    values = {name: getattr(network, name) for name in network.__dataclass_fields__}
    return type(network)(**{**values, **changes})


def _populations(network):
    """(layer, name, indices in the layer, shared parameters) of every population."""
    segments = network.segments
    of_compartment = np.repeat(np.arange(len(segments.start)), segments.stop - segments.start)
    alike = np.stack(
        [getattr(segments, name)[of_compartment] for name in ("keep_u", "keep_v", "v_min", "v_max")]
        + [segments.refractory[of_compartment], segments.shift[of_compartment], network.threshold]
    )
    for layer in network.layers:
        values, group = np.unique(alike[:, layer.position], axis=1, return_inverse=True)
        for index, column in enumerate(values.T.tolist()):
            keep_u, keep_v, v_min, v_max, refractory, _, threshold = column
            if threshold % 64 or v_max != LARGEST:
                raise UserError(
                    f"layer {layer.label}: Lava cannot represent its threshold or upper bound"
                )
            places = np.flatnonzero(group.ravel() == index)
            name = layer.label if values.shape[1] == 1 else f"{layer.label}#{index + 1}"
            yield (
                layer,
                name,
                places,
                {
                    "layer": layer.label,
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
        raise UserError(
            f"layer {label}: a bias does not fit {LOIHI.bias_bits} bits and an exponent"
        )
    return mantissas.astype(np.int32), exponents.astype(np.int32)


def _connections(network, columns, sources, label):
    """(source, weights (n, n_source) in Lava's units, exponent) of the inputs of a population.

    Lava has one exponent per connection and signed 8-bit mantissas, which are even.
    """
    segments = network.segments
    shift = int(np.repeat(segments.shift, segments.stop - segments.start)[columns[0]])
    into, last = network.weights[:, columns].tocsr(), list(sources)[-1]
    for name, rows in sources.items():
        weights = into[rows].T.tocsr().astype(np.int64)  # one row per target
        whole, exponent = weights.data << shift, 0
        while len(whole) and np.abs(whole).max() >> (6 + exponent) > 256:
            exponent += 1
        mantissas = whole >> (6 + exponent)
        exact = np.all(mantissas << (6 + exponent) == whole) and not np.any(mantissas % 2)
        if not exact or exponent > 7 or np.any(mantissas > 254):
            raise UserError(f"layer {label}: a weight does not fit 8 bits and an exponent")
        weights.data = mantissas
        if weights.nnz or name == last:  # Lava only runs connected processes
            yield name, weights, exponent
