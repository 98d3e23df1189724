"""The network of `models.spiking` in plain NumPy, whole numbers, one step after the other."""

import numpy as np


def convolve(frame, layer, weights):
    """W s of one frame, in int64."""
    if layer.kind == "dense":
        return frame.reshape(-1) @ weights
    (top, bottom), (left, right) = layer.compute_padding(frame.shape)
    padded = np.pad(frame, ((top, bottom), (left, right), (0, 0)))
    rows, columns, filters = layer.compute_shape(frame.shape)
    result = np.zeros((rows, columns, filters), np.int64)
    for r in range(rows):
        for c in range(columns):
            y, x = r * layer.stride, c * layer.stride
            window = padded[y : y + layer.kernel_size, x : x + layer.kernel_size]
            result[r, c] = np.tensordot(window, weights, 3)
    return result


def decay(x, keep):
    return np.sign(x) * (np.abs(x) * keep // 4096)


def run(layer, integers, frames):
    """Spikes, currents and voltages (before the reset) of a layer, each (steps, neurons)."""
    weights = integers.kernel.astype(np.int64)
    n = int(np.prod(layer.compute_shape(frames.shape[1:])))
    bias = np.tile(integers.bias.astype(np.int64), n // len(integers.bias))
    u = v = np.zeros(n, np.int64)
    while True:  # to where the bias alone leads
        settled = np.maximum(decay(v, integers.keep_v_4096ths) + bias, integers.floor)
        if np.array_equal(settled, v):
            break
        v = settled
    spikes, currents, voltages = [], [], []
    for frame in frames.astype(np.int64):
        u = decay(u, integers.keep_u_4096ths) + 128 * convolve(frame, layer, weights).reshape(-1)
        v = np.maximum(decay(v, integers.keep_v_4096ths) + u + bias, integers.floor)
        s = v > integers.threshold
        spikes.append(s.astype(np.int64))
        currents.append(u)
        voltages.append(v)
        v = np.where(s, 0, v)
    return np.array(spikes), np.array(currents), np.array(voltages)


def network(architecture, integers, frames):
    """Spikes of every layer, for one sample's frames (steps, rows, columns, channels)."""
    spikes, signal = [], frames
    for name, layer in zip(architecture.names, architecture.layers[:-1], strict=False):
        s, _, _ = run(layer, integers[name], signal)
        spikes.append(s)
        signal = s.reshape(len(frames), *layer.compute_shape(signal.shape[1:]))
    return spikes


def gradients(error, current, spikes, voltages, layer, beta):
    """Of sum(error * spikes) by the equations of `models.spiking`, in float64.

    Parameters
    ----------
    error, current, spikes, voltages : ndarray, shape (steps, neurons)
        As `run` gives them; ``current`` is u.
    layer : Integers

    Returns
    -------
    q : ndarray, shape (steps, neurons)
    keep_u, keep_v : float
    bias : ndarray, shape (neurons,)
    """
    a, b = layer.keep_u_4096ths / 4096, layer.keep_v_4096ths / 4096
    to_q, by_a, by_b, by_bias = np.zeros(error.shape), 0.0, 0.0, 0.0
    to_u = to_v = np.zeros(error.shape[1])
    for t in reversed(range(len(error))):
        distance = np.abs(voltages[t] / layer.threshold - 1)
        slope = 1 / (layer.threshold * (1 + beta * distance) ** 2)
        to_v = error[t] * slope + b * (1 - spikes[t]) * to_v
        to_v = np.where(voltages[t] > layer.floor, to_v, 0)
        to_u = to_v + a * to_u
        to_q[t] = to_u
        by_bias = by_bias + to_v
        if t:
            by_a += np.sum(to_u * current[t - 1])
            by_b += np.sum(to_v * voltages[t - 1] * (1 - spikes[t - 1]))
    return to_q, by_a / 4096, by_b / 4096, by_bias
