"""The neurons of a spiking network in TensorFlow, with the surrogate gradient of their spikes.

The equations are in :mod:`models.spiking`.
"""

import functools

from deploy.network.chip import LOIHI
from models.keras.keras2 import tf

# Denominator of the shares that remain.
DECAY_UNIT = LOIHI.decay_unit

_NEURON_PARAMETERS = ("keep_u_4096ths", "keep_v_4096ths", "bias", "threshold", "floor")


def fire(current, parameters: dict, beta: float):
    """Simulate a layer of neurons, with the surrogate gradient of :mod:`models.spiking`.

    Parameters
    ----------
    current : tensor, shape (steps, samples, neurons)
        q of the equations.
    parameters : dict of str to tensor
        ``keep_u_4096ths``, ``keep_v_4096ths``, ``threshold``, ``floor``: scalars; ``bias``: shape
        (neurons,).  All are in the chip's integers; threshold and floor have no gradient.
    beta : float
        See :class:`models.spiking.network.Neuron`.

    Returns
    -------
    tensor, shape (steps, samples, neurons)
        Spikes, 0 or 1.
    """

    @tf.custom_gradient
    def with_gradient(current, keep_u_4096ths, keep_v_4096ths, bias, threshold, floor):
        constants = [
            tf.stop_gradient(x) for x in (keep_u_4096ths, keep_v_4096ths, bias, threshold, floor)
        ]
        spikes, u, v = _run(tf.stop_gradient(current), *constants)

        def gradient(error):
            grad_u, grad_v = _run_back(error, spikes, v, beta, *constants)
            v_after_reset = v * (1 - spikes)
            grad_keep_u = tf.reduce_sum(grad_u[1:] * u[:-1]) / DECAY_UNIT
            grad_keep_v = tf.reduce_sum(grad_v[1:] * v_after_reset[:-1]) / DECAY_UNIT
            return grad_u, grad_keep_u, grad_keep_v, tf.reduce_sum(grad_v, (0, 1)), None, None

        return spikes, gradient

    return with_gradient(current, *(parameters[name] for name in _NEURON_PARAMETERS))


_compiled = functools.partial(tf.function, jit_compile=True, autograph=False)


@_compiled
def _run(current, keep_u_4096ths, keep_v_4096ths, bias, threshold, floor):
    """Spikes, currents, and voltages before the reset, at every step; see :func:`fire`."""
    rest_voltage = tf.maximum(_compute_rest_voltage(keep_v_4096ths, bias), floor)

    def step(t, state):
        u, v = state
        u = _decay(u, keep_u_4096ths) + current[t]
        v = tf.maximum(_decay(v, keep_v_4096ths) + u + bias, floor)
        return (u, tf.where(v > threshold, tf.zeros_like(v), v)), (u, v)

    v = tf.zeros_like(current[0]) + rest_voltage
    u, v = scan(step, current, (tf.zeros_like(v), v), n_outputs=2)
    return tf.cast(v > threshold, current.dtype), u, v


@_compiled
def _run_back(  # noqa: PLR0913 - TensorFlow compiles a function of tensors
    error, spikes, v, beta, keep_u_4096ths, keep_v_4096ths, bias, threshold, floor
):
    """dE/du and dE/dv at every step."""
    slope = error / (threshold * tf.square(1 + beta * tf.abs(v / threshold - 1)))
    free = tf.cast(v > floor, error.dtype)
    a = keep_u_4096ths / DECAY_UNIT
    b = keep_v_4096ths / DECAY_UNIT

    def step(t, state):
        grad_u, grad_v = state
        # v(t) does not influence v(t + 1) after a spike or where the lower bound replaced it.
        grad_v = (slope[t] + b * (1 - spikes[t]) * grad_v) * free[t]
        grad_u = grad_v + a * grad_u
        return (grad_u, grad_v), (grad_u, grad_v)

    nothing = tf.zeros_like(error[0])
    return scan(step, error, (nothing, nothing), n_outputs=2, backwards=True)


def _compute_rest_voltage(keep_v_4096ths, bias):
    """The resting voltage: the first fixed point that a bias alone reaches from 0.

    With k = keep_v_4096ths, v = trunc(k v / 4096) + bias is true if ceil(v (4096 - k) / 4096) =
    bias, v > 0.
    """
    lower = tf.floor((tf.abs(bias) - 1) * DECAY_UNIT / (DECAY_UNIT - keep_v_4096ths))
    return tf.sign(bias) * (lower + 1)


def _decay(x, keep):
    """trunc(x keep / 4096)."""
    return tf.cast(tf.cast(x * (keep / DECAY_UNIT), tf.int32), x.dtype)


def find_length(tensor, axis):
    """The size of an axis: an int if it is static, else a tensor."""
    return tf.shape(tensor)[axis] if tensor.shape[axis] is None else tensor.shape[axis]


def scan(step, like, state, n_outputs: int, backwards: bool = False):
    """Call a step function at every time step and collect its values.

    Parameters
    ----------
    step : callable
        ``step(t, state) -> state, values``, with ``n_outputs`` values.
    like : tensor, shape (steps, ...)
        Defines the number of steps and the type of the values.
    state : tuple of tensor
        State before the first step.
    n_outputs : int
        Number of values per step.
    backwards : bool
        Run from the last step to the first.

    Returns
    -------
    tuple of tensor, each of shape (steps, ...)
        One tensor for each value.
    """
    steps = find_length(like, 0)
    arrays = tuple(tf.TensorArray(like.dtype, steps) for _ in range(n_outputs))

    def body(i, state, arrays):
        t = steps - 1 - i if backwards else i
        state, values = step(t, state)
        return i + 1, state, tuple(a.write(t, x) for a, x in zip(arrays, values, strict=True))

    loop = (tf.constant(0), state, arrays)
    *_, arrays = tf.while_loop(lambda i, *_: i < steps, body, loop, maximum_iterations=steps)
    return tuple(a.stack() for a in arrays)
