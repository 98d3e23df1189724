"""Export to NIR, the Neuromorphic Intermediate Representation (Pedersen et al. 2024).

NIR describes neurons by differential equations.  It has no time step, no amplitude of spikes, no
refractory period, no lower voltage bound and no 8-bit weights.  The graph is::

    input spikes -> Conv2d -> CubaLIF -> ... -> Flatten -> Affine -> output

with ``tau_syn dI/dt = -I + S`` and ``tau_mem dv/dt = -v + I`` where ``S`` is the output of the
convolution.  A spike is a pulse of height 1 that lasts one time step ``dt`` of 1 ms; the amplitude
of the spikes and 1 / dt are in the weights, so that a spike has the same area as on the chip.  The
bias current is the convolution's bias; it reaches the neuron through the synaptic filter and has
its full value after a few ``tau_syn``.  The leak voltage is zero, because readers of NIR interpret
other values differently.

The input neurons are not in the graph: its inputs are their spikes, which :func:`make_graph_input`
returns, or what these stand for: frames of events, or an image that is held.  Scores are the mean
of the output from the readout's start on.  The graph's metadata has, as text, the properties that
NIR cannot represent.
"""

from __future__ import annotations

import io

import numpy as np

from .. import __version__
from ..errors import UserError
from ..files import replacing
from .chip import DT
from .reference import make_input_spikes
from .spec import NetworkSpec, get_spec


def make_nir_graph(spec: NetworkSpec):
    """The network as a ``nir.NIRGraph``.

    Parameters
    ----------
    spec : NetworkSpec

    Raises
    ------
    UserError
        The package ``nir`` is not installed, or the readout has several sections: NIR does not
        know the step of a presentation.
    """
    nir = _import_nir()
    if spec.layers[-1].n_sections > 1:
        raise UserError(
            f"NIR cannot represent a readout with {spec.layers[-1].n_sections} sections of the "
            "presentation; train with --set events.parts=1 to export"
        )
    rows, columns, channels = spec.input_shape
    nodes = {"input": nir.Input({"input": np.array([channels, rows, columns])})}
    area = 1.0
    loops = {}
    for layer in spec.layers:
        if layer.pool > 1:
            size = np.array([layer.pool, layer.pool])
            nodes[f"{layer.name}_pool"] = nir.AvgPool2d(size, size, np.array([0, 0]))
        nodes.update(layer.operation.make_nir_nodes(layer, nir, area))
        for name, node in _make_neuron_nodes(nir, layer):
            nodes[name] = node
        if layer.neurons is None:
            continue
        area = layer.neurons.amplitude / DT
        if layer.recurrent is not None:
            loops[name] = nir.Linear(weight=layer.recurrent * area)
    nodes["output"] = nir.Output({"output": _put_channels_first(spec.layers[-1].shape)})
    names = list(nodes)
    edges = list(zip(names[:-1], names[1:]))
    for name, loop in loops.items():
        back = name.replace("_neurons", "_recurrent")
        nodes[back] = loop
        edges += [(name, back), (back, name)]
    return nir.NIRGraph(nodes, edges, metadata=_list_metadata(spec))


def write_nir(path, spec: NetworkSpec):
    """Write the network as a NIR file (HDF5), completely or not at all.

    Parameters
    ----------
    path : path-like
    spec : NetworkSpec or Bundle
    """
    spec = get_spec(spec)
    nir = _import_nir()
    buffer = io.BytesIO()
    nir.write(buffer, make_nir_graph(spec))
    with replacing(path) as file:
        file.write(buffer.getvalue())


def make_graph_input(spec: NetworkSpec, samples) -> np.ndarray:
    """The input of the graph for some samples, in the streams of the network's presentation.

    Parameters
    ----------
    spec : NetworkSpec
    samples : ndarray
        Images or frames, in the format of the network's stimulus.

    Returns
    -------
    ndarray, shape (n_samples, gap + steps, channels, rows, columns)
        Spikes of the input neurons with a height of their area over ``dt``; the mean of an image's
        spikes is the image.
    """
    flat = spec.stimulus.flatten(samples)
    streams = spec.presentation.list_streams(len(flat))
    spikes = [make_input_spikes(spec, flat[stream]) for stream in streams]
    rows, columns, channels = spec.input_shape
    images = np.concatenate(spikes).reshape(len(flat), -1, rows, columns, channels)
    return np.moveaxis(images, -1, 2).astype(np.float32) * np.float32(spec.stimulus.area / DT)


def _import_nir():
    try:
        import nir
    except ImportError:
        raise UserError("export to NIR needs the package nir: pip install nir") from None
    return nir


def _put_channels_first(shape):
    return np.array([shape[-1], *shape[:-1]])


def _make_neuron_nodes(nir, layer):
    """The nodes of a layer's neurons; filter and neuron are one node if NIR has it."""
    if layer.neurons is None:
        return
    shape = _put_channels_first(layer.shape)

    def fill(value):
        return np.full(shape, float(value))

    name = f"{layer.name}_neurons"
    neurons = layer.neurons
    common = {"r": fill(1), "v_threshold": fill(1)}
    if layer.synapse is not None:
        yield (
            name,
            nir.CubaLIF(
                tau_syn=fill(layer.synapse),
                tau_mem=fill(neurons.tau_rc),
                v_leak=fill(0),
                w_in=fill(1),
                **common,
            ),
        )
        return
    yield name, nir.LIF(tau=fill(neurons.tau_rc), v_leak=fill(0), **common)


def _list_metadata(spec):
    """Properties that NIR cannot represent, as text and numbers."""
    presentation = spec.presentation
    return {
        "made_by": f"stmnist-loihi {__version__}",
        "architecture": spec.architecture,
        "dt": DT,
        "spike": "a pulse of height 1 that lasts one time step dt",
        "steps": presentation.steps,
        "gap": presentation.gap,
        "readout_start": presentation.readout_start,
        "stream_length": presentation.stream_length,
        "refractory_steps": max(
            (round(layer.neurons.tau_ref / DT) for layer in spec.layers if layer.neurons), default=0
        ),
        "left_out": "input neurons, refractory period, lower bound of the voltage, 8-bit weights",
    }
