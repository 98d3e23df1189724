"""The loops over time steps of :mod:`experiments.slayer_network`, compiled by Numba.

Each function handles one layer and one sample.  Arrays over time have the shape (steps, neurons) in
float32; spikes are uint8, 1 or 0.  The innermost loops are functions of their own where Numba's
compiler would not use vector instructions otherwise (five times slower, measured).
"""

import numba
import numpy as np

# Arrays that :func:`_dot` and :func:`_add` read together.
BLOCK = 4


def _compiled(function):
    """Compile with Numba; the machine code is stored on disk if there is a folder for it.

    Sums may be reordered, such that several neurons are computed with one instruction.
    """
    options = {"fastmath": {"contract", "reassoc", "nsz"}, "error_model": "numpy"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder that can be written to
        return numba.njit(**options)(function)


@_compiled
def fire_from_spikes(arriving, weights, traces, constants, potential, spikes):
    """Simulate the neurons of a dense layer.

    Parameters
    ----------
    arriving : ndarray of uint8, shape (steps, inputs)
        Spikes of the previous layer.
    weights : ndarray of float32, shape (neurons, inputs)
    traces : ndarray of float32, shape (4, neurons)
        State of the filters: p and q of the spike response, then of the refractory response.
    constants : ndarray of float32
        Decay and gain of the spike response, decay and gain of the refractory response, threshold.
    potential, spikes : ndarray
        Overwritten with the potentials u and the spikes.
    """
    values = np.zeros((BLOCK, arriving.shape[1]), np.float32)
    drive = np.empty((BLOCK, len(weights)), np.float32)
    for start in range(0, len(arriving), BLOCK):
        steps = min(BLOCK, len(arriving) - start)
        for t in range(steps):
            _convert(arriving[start + t], values[t])
        for k in range(len(weights)):
            _dot(weights[k], values[0], values[1], values[2], values[3], drive[:, k])
        for t in range(start, start + steps):
            _advance(traces[0], traces[1], traces[2], traces[3], constants, potential[t], spikes[t])
            for k in range(len(weights)):
                traces[0, k] += drive[t - start, k]


@_compiled
def add_dense_gradient(arriving, credit, gradient):
    """Add the gradient of a dense layer's weights: the sum of the credit where spikes arrived.

    Parameters
    ----------
    arriving : ndarray of uint8, shape (steps, inputs)
    credit : ndarray of float32, shape (steps, neurons)
        From :func:`assign_credit`.
    gradient : ndarray of float32, shape (neurons, inputs)
        Added to.
    """
    values = np.zeros((BLOCK, arriving.shape[1]), np.float32)
    factors = np.zeros((BLOCK, len(gradient)), np.float32)
    for start in range(0, len(arriving), BLOCK):
        factors[:] = 0
        for t in range(min(BLOCK, len(arriving) - start)):
            _convert(arriving[start + t], values[t])
            factors[t] = credit[start + t]
        for k in range(len(gradient)):
            _add(gradient[k], values[0], values[1], values[2], values[3], factors[:, k])


@_compiled
def find_patterns(arriving, inputs, which, ends, sites, patterns):
    """List where a convolution's input has spikes, and in which channels.

    Parameters
    ----------
    arriving : ndarray of uint8, shape (steps, inputs)
        Spikes of the previous layer.
    inputs : tuple of ndarray of uint32, each of shape (inputs,)
        The inputs as they are listed; and for each input its group of channels of a site, counted
        over all sites, the number of the group's first pattern, and what a spike adds to it.
    which : ndarray of int32, shape (inputs + 1,)
        Overwritten.
    ends : ndarray of int32, shape (steps + 1,)
        Overwritten with the end of each step's list; the first entry is where the lists begin.
    sites, patterns : ndarray of int32, one-dimensional
        Overwritten with each group that has a spike, and the number of its pattern.
    """
    order, site_of, first_of, bit_of = inputs
    n = ends[0]
    for t in range(len(arriving)):
        spikes = arriving[t]
        count = 0
        for k in range(len(spikes)):
            which[count] = order[k]
            count += spikes[order[k]]
        n -= 1
        previous = np.uint32(0xFFFFFFFF)
        for k in range(count):
            i = which[k]
            site = site_of[i]
            n += site != previous
            patterns[n] = bit_of[i] + (patterns[n] if site == previous else first_of[i])
            sites[n] = previous = site
        n += 1
        ends[t + 1] = n


@_compiled
def fire_from_patterns(lists, table, weights, traces, constants, potential, spikes):
    """Simulate the neurons of a layer, adding the weights of each pattern of spikes that arrives.

    Parameters
    ----------
    lists : tuple of ndarray
        ``ends``, ``sites`` and ``patterns`` of :func:`find_patterns`.
    table : tuple of ndarray of int32
        First and last run of each of the ``sites``, and the runs, shape (n, 3): first neuron, first
        weight, and number of consecutive neurons and weights.
    weights : ndarray of float32, shape (patterns, weights)
        Sums of the weights of the channels in each pattern.
    traces, constants, potential, spikes
        As of :func:`fire_from_spikes`.
    """
    ends, sites, patterns = lists
    first, last, runs = table
    drive = traces[0]
    for t in range(len(potential)):
        _advance(traces[0], traces[1], traces[2], traces[3], constants, potential[t], spikes[t])
        for k in range(ends[t], ends[t + 1]):
            site, added = np.uint64(sites[k]), weights[patterns[k]]
            for r in range(first[site], last[site]):
                # Unsigned, since a check for negative indices would prevent vector instructions.
                neuron, weight = np.uint64(runs[r, 0]), np.uint64(runs[r, 1])
                for m in range(np.uint64(runs[r, 2])):
                    drive[neuron + m] += added[weight + m]


@_compiled
def add_gradient(lists, table, credit, gradient):
    """Add the gradient of a layer's weights: the sum of the credit where spikes arrived.

    Parameters
    ----------
    lists, table
        As of :func:`fire_from_patterns`.
    credit : ndarray of float32, shape (steps, neurons)
        From :func:`assign_credit`.
    gradient : ndarray of float32, shape (patterns, weights)
        Added to.
    """
    ends, sites, patterns = lists
    first, last, runs = table
    for t in range(len(credit)):
        now = credit[t]
        for k in range(ends[t], ends[t + 1]):
            site, sums = np.uint64(sites[k]), gradient[patterns[k]]
            for r in range(first[site], last[site]):
                neuron, weight = np.uint64(runs[r, 0]), np.uint64(runs[r, 1])
                for m in range(np.uint64(runs[r, 2])):
                    sums[weight + m] += now[neuron + m]


@_compiled
def assign_credit(error, potential, traces, constants):
    """Replace the correlated error eps (x) e of a layer by its credit eps (x) delta.

    Parameters
    ----------
    error : ndarray of float32, shape (steps, neurons)
        Overwritten.
    potential : ndarray of float32, shape (steps, neurons)
    traces : ndarray of float32, shape (2, neurons)
        State of the filter, p and q.
    constants : ndarray of float32
        Decay and gain of the spike response, threshold, escape rate at the threshold, and the
        factor k of the escape rate 2^(-k abs(u - threshold)) relative to it.
    """
    bits = np.empty(error.shape[1], np.int32)
    for t in range(len(potential) - 1, -1, -1):
        _multiply_by_rho(error[t], potential[t], bits, bits.view(np.float32), constants)
        _correlate(error[t], traces[0], traces[1], constants)


@_compiled
def propagate(credit, columns, taps, products, error):
    """The correlated error W^T credit of the layer before a convolution.

    Parameters
    ----------
    credit : ndarray of float32, shape (steps, positions * filters)
    columns : ndarray of float32, shape (filters, kernel rows * kernel columns * channels)
        Weights.
    taps : ndarray of int32, shape (n, 4)
        Position of the filters, first input, first of the ``columns``, and number of consecutive
        inputs and columns.
    products : ndarray of float32, shape (steps' * positions, columns)
        Overwritten; as many steps are multiplied at a time as there is room for.
    error : ndarray of float32, shape (steps, inputs)
        Overwritten.
    """
    filters = len(columns)
    positions = credit.shape[1] // filters
    together = len(products) // positions
    error[:] = 0
    for start in range(0, len(credit), together):
        part = credit[start : start + together]
        frames = part.reshape(len(part) * positions, filters)
        np.dot(frames, columns, products[: len(frames)])
        for t in range(len(part)):
            now = error[start + t]
            for r in range(len(taps)):
                product = products[t * positions + taps[r, 0]]
                source, column = np.uint64(taps[r, 1]), np.uint64(taps[r, 2])
                for m in range(np.uint64(taps[r, 3])):
                    now[source + m] += product[column + m]


@_compiled
def _advance(p, q, refractory_p, refractory_q, constants, potential, spikes):
    """Advance all traces by one step; the spikes that arrive in it are added to p afterwards."""
    decay, gain, theta = constants[0], constants[1], constants[4]
    refractory_decay, refractory_gain = constants[2], constants[3]
    for i in range(len(potential)):
        q[i] = decay * (q[i] + p[i])
        p[i] = decay * p[i]
        refractory_q[i] = refractory_decay * (refractory_q[i] + refractory_p[i])
        u = gain * q[i] + refractory_gain * refractory_q[i]
        fires = u >= theta
        refractory_p[i] = refractory_decay * refractory_p[i] + np.float32(fires)
        potential[i] = u
        spikes[i] = fires


@_compiled
def _multiply_by_rho(values, potential, bits, powers, constants):
    """Multiply by the escape rate; ``bits`` is the memory of ``powers`` as int32."""
    theta, rho, factor = constants[2], constants[3], constants[4]
    for i in range(len(values)):
        # 2^x is 2^whole times a polynomial for 2^part (relative error 2e-9), part in (-1, 0].
        # Not below 2^-64 (tau ln 2^64 = 44 tau from the threshold): tiny numbers are slow.
        x = max(-factor * abs(potential[i] - theta), np.float32(-64))
        whole = np.int32(x)
        part = x - np.float32(whole)
        y = np.float32(1.08453046e-04)
        y = y * part + np.float32(1.27287235e-03)
        y = y * part + np.float32(9.57680234e-03)
        y = y * part + np.float32(5.54893091e-02)
        y = y * part + np.float32(2.40223939e-01)
        y = y * part + np.float32(6.93147010e-01)
        y = y * part + np.float32(1)
        bits[i] = (whole + np.int32(127)) << np.int32(23)  # the exponent of a float32
        values[i] *= rho * y
    for i in range(len(values)):
        values[i] *= powers[i]


@_compiled
def _correlate(values, p, q, constants):
    """Advance the correlation with the kernel by one step towards the start."""
    decay, gain = constants[0], constants[1]
    for i in range(len(values)):
        q[i] = decay * (q[i] + p[i])
        p[i] = decay * p[i] + values[i]
        values[i] = gain * q[i]


@_compiled
def _convert(spikes, values):
    for i in range(len(spikes)):
        values[i] = spikes[i]


@_compiled
def _dot(weights, a, b, c, d, products):
    """Scalar products of weights with four arrays."""
    in_a = in_b = in_c = in_d = np.float32(0)
    for i in range(len(weights)):
        in_a += weights[i] * a[i]
        in_b += weights[i] * b[i]
        in_c += weights[i] * c[i]
        in_d += weights[i] * d[i]
    products[0], products[1], products[2], products[3] = in_a, in_b, in_c, in_d


@_compiled
def _add(sums, a, b, c, d, factors):
    """Add four arrays, each times a factor."""
    of_a, of_b, of_c, of_d = factors[0], factors[1], factors[2], factors[3]
    for i in range(len(sums)):
        sums[i] += of_a * a[i] + of_b * b[i] + of_c * c[i] + of_d * d[i]
