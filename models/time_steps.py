"""Operations shared by networks in discrete time: loops over time steps, and weighted sums."""

from __future__ import annotations

from models.keras2 import tf


def scan(step, like, state, outputs: int, backwards: bool = False):
    """Call a step function at every time step and collect its values.

    Parameters
    ----------
    step : callable
        ``step(t, state) -> state, values``, with ``outputs`` values.
    like : tensor, shape (steps, ...)
        Defines the number of steps and the type of the values.
    state : tuple of tensor
        State before the first step.
    outputs : int
        Number of values per step.
    backwards : bool
        Run from the last step to the first.

    Returns
    -------
    tuple of tensor, each of shape (steps, ...)
        One tensor for each value.
    """
    steps = _size(like, 0)
    arrays = tuple(tf.TensorArray(like.dtype, steps) for _ in range(outputs))

    def body(i, state, arrays):
        t = steps - 1 - i if backwards else i
        state, values = step(t, state)
        return i + 1, state, tuple(a.write(t, x) for a, x in zip(arrays, values, strict=True))

    loop = (tf.constant(0), state, arrays)
    *_, arrays = tf.while_loop(lambda i, *_: i < steps, body, loop, maximum_iterations=steps)
    return tuple(a.stack() for a in arrays)


def weighted_sums(layer, kernel, signal):
    """Weighted sums of a layer's inputs, for all steps of all samples at once.

    Parameters
    ----------
    layer : layer of a :class:`models.architecture.Architecture`
        A convolution, or a dense or output layer.
    kernel : tensor
        Shape (rows, columns, channels in, filters), or (inputs, units).
    signal : tensor, shape (steps, samples, ...)
        For a convolution: (steps, samples, rows, columns, channels).

    Returns
    -------
    tensor, shape (steps, samples, ...)
    """
    steps, samples = _size(signal, 0), _size(signal, 1)
    if layer.kind == "conv":
        frames = tf.reshape(signal, (-1, *signal.shape[2:]))
        sums = tf.nn.conv2d(frames, kernel, layer.stride, layer.padding.upper())
    else:
        sums = tf.matmul(tf.reshape(signal, (-1, kernel.shape[0])), kernel)
    return tf.reshape(sums, (steps, samples, *sums.shape[1:]))


def _size(tensor, axis):
    """The size of an axis: an int if it is static, else a tensor."""
    return tf.shape(tensor)[axis] if tensor.shape[axis] is None else tensor.shape[axis]
