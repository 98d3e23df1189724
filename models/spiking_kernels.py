"""The loops over time of a network on events and of its gradients, compiled by Numba.

The equations are those of :mod:`models.spiking`.  Events are rare, so that the sums over synapses
go from spike to spike.  Arrays of one layer have the shape (samples, steps, neurons), in float32;
spikes are uint8.  The synapses of a layer are in three arrays, see
:class:`models.ops.base.Synapses`: those of input i are ``first[i]`` to ``first[i + 1]``;
synapse k connects it with all filters at the place ``place[k]`` of the layer, through row
``row[k]`` of the kernel.
"""

import numba
import numpy as np

_ZERO = np.float32(0)
_ONE = np.float32(1)

_OPTIONS = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz"}}


def _compile(function):
    """`numba.njit`, cached on disk if there is a folder for it."""
    try:
        return numba.njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # in a zip archive there is no place for Numba's cache
        return numba.njit(**_OPTIONS)(function)


@_compile
def sum_inputs(spikes, gains, first, place, row, kernel, sums):
    """Set ``sums`` to the weighted sums of spikes, each multiplied by its input's gain."""
    samples, steps, inputs = spikes.shape
    filters = kernel.shape[1]
    sums[:] = _ZERO
    for n in range(samples):
        for t in range(steps):
            for i in range(inputs):
                if spikes[n, t, i]:
                    gain = gains[n, i]
                    for k in range(first[i], first[i + 1]):
                        start = place[k] * filters
                        weights = kernel[row[k]]
                        for f in range(filters):
                            sums[n, t, start + f] += gain * weights[f]


@_compile
def integrate(  # noqa: PLR0913 - Numba takes each array as an argument
    current, bias, rest, keep_u, keep_v, threshold, floor, voltage, spikes
):
    """Integrate the neurons of a layer.

    ``current`` has the synaptic inputs q and is replaced by the currents u; ``voltage`` is set to
    the voltages before the reset, and ``spikes`` to the spikes.  ``bias`` and ``rest``, the voltage
    at the beginning, have an entry for each neuron.
    """
    samples, steps, neurons = current.shape
    for n in range(samples):
        u = np.zeros(neurons, np.float32)
        v = rest.copy()
        for t in range(steps):
            for i in range(neurons):
                u[i] = np.trunc(u[i] * keep_u) + current[n, t, i]
                value = max(np.trunc(v[i] * keep_v) + u[i] + bias[i], floor)
                current[n, t, i] = u[i]
                voltage[n, t, i] = value
                v[i] = _ZERO if value > threshold else value
            for i in range(neurons):
                spikes[n, t, i] = voltage[n, t, i] > threshold


@_compile
def integrate_back(  # noqa: PLR0913 - Numba takes each array as an argument
    error, spikes, current, voltage, keep_u, keep_v, threshold, floor, beta
):
    """Gradients of a layer's neurons.

    ``error`` has dE/ds and is replaced by dE/dq.

    Returns
    -------
    to_bias : ndarray, shape (neurons,)
    to_keep_u, to_keep_v : float
        dE/da and dE/db.
    """
    samples, steps, neurons = error.shape
    to_bias = np.zeros(neurons, np.float32)
    to_a = np.zeros(neurons, np.float32)
    to_b = np.zeros(neurons, np.float32)
    scale = _ONE / threshold
    for n in range(samples):
        to_u = np.zeros(neurons, np.float32)
        to_v = np.zeros(neurons, np.float32)
        for t in range(steps - 1, -1, -1):
            for i in range(neurons):
                v = voltage[n, t, i]
                stays = _ZERO if v > threshold else _ONE
                to_a[i] += to_u[i] * current[n, t, i]
                to_b[i] += to_v[i] * v * stays
                distance = _ONE + beta * abs(v * scale - _ONE)
                slope = error[n, t, i] * scale / (distance * distance)
                value = slope + keep_v * stays * to_v[i]
                value = value if v > floor else _ZERO
                to_v[i] = value
                to_bias[i] += value
                to_u[i] = value + keep_u * to_u[i]
                error[n, t, i] = to_u[i]
    return to_bias, to_a.astype(np.float64).sum(), to_b.astype(np.float64).sum()


@_compile
def add_kernel_gradient(spikes, gains, first, place, row, to_sums, gradient):
    """Add the gradient of the sums of :func:`sum_inputs` to the kernel to ``gradient``."""
    samples, steps, inputs = spikes.shape
    filters = gradient.shape[1]
    for n in range(samples):
        for t in range(steps):
            for i in range(inputs):
                if spikes[n, t, i]:
                    gain = gains[n, i]
                    for k in range(first[i], first[i + 1]):
                        start = place[k] * filters
                        weights = gradient[row[k]]
                        for f in range(filters):
                            weights[f] += gain * to_sums[n, t, start + f]


@_compile
def gather(by_row, first, place, row, to_inputs):
    """Set ``to_inputs`` to the sums over each input's synapses of ``by_row[..., place, row]``."""
    moments, inputs = to_inputs.shape
    for m in range(moments):
        for i in range(inputs):
            total = _ZERO
            for k in range(first[i], first[i + 1]):
                total += by_row[m, place[k], row[k]]
            to_inputs[m, i] = total


@_compile
def read_out(spikes, gains, kernel, section, outputs):
    """Set ``outputs`` to the sums of the output weights of all spikes so far."""
    samples, steps, inputs = spikes.shape
    classes = kernel.shape[2]
    for n in range(samples):
        total = np.zeros(classes, np.float32)
        for t in range(steps):
            weights = kernel[section[t]]
            for i in range(inputs):
                if spikes[n, t, i]:
                    for c in range(classes):
                        total[c] += gains[n, i] * weights[i, c]
            for c in range(classes):
                outputs[n, t, c] = total[c]


@_compile
def read_out_back(spikes, gains, kernel, section, to_outputs, gradient, to_spikes):
    """Gradients of :func:`read_out`: add that of the kernel, and set that of the spikes."""
    samples, steps, inputs = spikes.shape
    classes = kernel.shape[2]
    for n in range(samples):
        total = np.zeros(classes, np.float32)
        for t in range(steps - 1, -1, -1):
            weights = kernel[section[t]]
            for c in range(classes):
                total[c] += to_outputs[n, t, c]
            for i in range(inputs):
                value = _ZERO
                for c in range(classes):
                    value += total[c] * weights[i, c]
                to_spikes[n, t, i] = gains[n, i] * value
                if spikes[n, t, i]:
                    for c in range(classes):
                        gradient[section[t], i, c] += gains[n, i] * total[c]
