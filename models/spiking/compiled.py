"""The loops over time of a network on events and of its gradients, compiled by Numba.

The equations are those of :mod:`models.spiking`.  Events are rare, so that the sums over synapses
go from spike to spike.  Arrays of one layer have the shape (samples, steps, neurons), in float32;
spikes are uint8.  The synapses of a layer are in three arrays, see
:class:`models.ops.base.Synapses`: those of input i are ``first[i]`` to ``first[i + 1]``;
synapse k connects it with all filters at the position ``position[k]`` of the layer, through row
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
def sum_inputs(spikes, factors, first, position, row, kernel, sums):
    """Set ``sums`` to the weighted sums of spikes, each multiplied by its input's factor."""
    samples, steps, inputs = spikes.shape
    filters = kernel.shape[1]
    sums[:] = _ZERO
    for n in range(samples):
        for t in range(steps):
            for i in range(inputs):
                if spikes[n, t, i]:
                    factor = factors[n, i]
                    for k in range(first[i], first[i + 1]):
                        start = position[k] * filters
                        weights = kernel[row[k]]
                        for f in range(filters):
                            sums[n, t, start + f] += factor * weights[f]


@_compile
def integrate(current, bias, rest_voltage, keep_u, keep_v, threshold, floor, voltage, spikes):
    """Integrate the neurons of a layer.

    ``current`` has the synaptic inputs q and is replaced by the currents u; ``voltage`` is set to
    the voltages before the reset, and ``spikes`` to the spikes.  ``bias`` and ``rest_voltage``, the
    voltage at the beginning, have an entry for each neuron.
    """
    samples, steps, neurons = current.shape
    for n in range(samples):
        u = np.zeros(neurons, np.float32)
        v = rest_voltage.copy()
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
def integrate_back(error, spikes, current, voltage, keep_u, keep_v, threshold, floor, beta):
    """Gradients of a layer's neurons.

    ``error`` has dE/ds and is replaced by dE/dq.

    Returns
    -------
    grad_bias : ndarray, shape (neurons,)
    grad_keep_u, grad_keep_v : float
        dE/da and dE/db.
    """
    samples, steps, neurons = error.shape
    grad_bias = np.zeros(neurons, np.float32)
    grad_a = np.zeros(neurons, np.float32)
    grad_b = np.zeros(neurons, np.float32)
    scale = _ONE / threshold
    for n in range(samples):
        grad_u = np.zeros(neurons, np.float32)
        grad_v = np.zeros(neurons, np.float32)
        for t in range(steps - 1, -1, -1):
            for i in range(neurons):
                v = voltage[n, t, i]
                stays = _ZERO if v > threshold else _ONE
                grad_a[i] += grad_u[i] * current[n, t, i]
                grad_b[i] += grad_v[i] * v * stays
                distance = _ONE + beta * abs(v * scale - _ONE)
                slope = error[n, t, i] * scale / (distance * distance)
                value = slope + keep_v * stays * grad_v[i]
                value = value if v > floor else _ZERO
                grad_v[i] = value
                grad_bias[i] += value
                grad_u[i] = value + keep_u * grad_u[i]
                error[n, t, i] = grad_u[i]
    return grad_bias, grad_a.astype(np.float64).sum(), grad_b.astype(np.float64).sum()


@_compile
def add_kernel_gradient(spikes, factors, first, position, row, grad_sums, gradient):
    """Add the gradient of the sums of :func:`sum_inputs` to the kernel to ``gradient``."""
    samples, steps, inputs = spikes.shape
    filters = gradient.shape[1]
    for n in range(samples):
        for t in range(steps):
            for i in range(inputs):
                if spikes[n, t, i]:
                    factor = factors[n, i]
                    for k in range(first[i], first[i + 1]):
                        start = position[k] * filters
                        weights = gradient[row[k]]
                        for f in range(filters):
                            weights[f] += factor * grad_sums[n, t, start + f]


@_compile
def sum_over_synapses(by_row, first, position, row, grad_inputs):
    """Set ``grad_inputs`` to sums of ``by_row[..., position, row]`` over each input's synapses."""
    moments, inputs = grad_inputs.shape
    for m in range(moments):
        for i in range(inputs):
            total = _ZERO
            for k in range(first[i], first[i + 1]):
                total += by_row[m, position[k], row[k]]
            grad_inputs[m, i] = total


@_compile
def read_out(spikes, factors, kernel, section, outputs):
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
                        total[c] += factors[n, i] * weights[i, c]
            for c in range(classes):
                outputs[n, t, c] = total[c]


@_compile
def read_out_back(spikes, factors, kernel, section, grad_outputs, gradient, grad_spikes):
    """Gradients of :func:`read_out`: add that of the kernel, and set that of the spikes."""
    samples, steps, inputs = spikes.shape
    classes = kernel.shape[2]
    for n in range(samples):
        total = np.zeros(classes, np.float32)
        for t in range(steps - 1, -1, -1):
            weights = kernel[section[t]]
            for c in range(classes):
                total[c] += grad_outputs[n, t, c]
            for i in range(inputs):
                value = _ZERO
                for c in range(classes):
                    value += total[c] * weights[i, c]
                grad_spikes[n, t, i] = factors[n, i] * value
                if spikes[n, t, i]:
                    for c in range(classes):
                        gradient[section[t], i, c] += factors[n, i] * total[c]
