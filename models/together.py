"""Training several small networks of one shape at the same time.

A network of the paper's size keeps a core busy for a fraction of the time that Keras needs to start
each step.  Here the weights of n networks are stacked along a new first axis and one compiled step
does a batch of each of them.  Each network sees its own samples in its own order; nothing passes
between them, so that each ends as it would have alone, but for rounding.  (A network with fewer
samples than the largest has empty batches at the end of an epoch; they leave its weights as they
are, but RMSProp's memory of squared gradients fades a little in them.)
"""

from __future__ import annotations

import numpy as np
import tensorflow as tf


def fit_together(models, data, parts, seeds, epochs, batch_size, learning_rate, advance=None):
    """Train networks that put out logits: sparse categorical cross-entropy, RMSProp.

    Parameters
    ----------
    models : sequence of tf.keras.Model
        Of one shape, from :func:`models.cnn.build_cnn`; trained in place.
    data : (images, labels)
        Of all samples.
    parts : sequence of ndarray of int
        For each model the indices of its training samples; they may differ in number.
    seeds : sequence of int
        For each model, of the order of its samples.
    epochs, batch_size : int
    learning_rate : float
    advance : callable, optional
        ``advance(1, note)`` after each epoch.

    Returns
    -------
    list of list of dict
        For each model a history: ``epoch``, ``loss``, ``accuracy`` in each row.
    """
    layers = models[0].layers
    variables = [
        tf.Variable(tf.stack([v.numpy() for v in group]), name=f"stacked{i}")
        for i, group in enumerate(zip(*(m.trainable_variables for m in models), strict=True))
    ]
    optimizer = tf.keras.optimizers.RMSprop(learning_rate)
    optimizer.build(variables)
    images, labels = tf.constant(data[0], tf.float32), tf.constant(data[1], tf.int32)

    @tf.function(autograph=False, jit_compile=True)
    def step(images, labels, mask):
        with tf.GradientTape() as tape:
            logits = forward_together(layers, variables, images)
            losses = mask * tf.nn.sparse_softmax_cross_entropy_with_logits(labels, logits)
            # A mean over the samples of each network; the networks' losses only stand in one sum.
            total = tf.reduce_sum(
                tf.reduce_sum(losses, 1) / tf.maximum(tf.reduce_sum(mask, 1), 1.0)
            )
        optimizer.apply_gradients(
            zip(tape.gradient(total, variables), variables, strict=True),
            skip_gradients_aggregation=True,
        )
        right = mask * tf.cast(tf.argmax(logits, 2, tf.int32) == labels, tf.float32)
        return tf.stack([tf.reduce_sum(losses, 1), tf.reduce_sum(right, 1)])

    histories = [[] for _ in models]
    sizes = np.array([len(part) for part in parts])
    for epoch in range(epochs):
        order, mask = _orders(parts, seeds, epoch, batch_size)
        sums = np.zeros((2, len(models)))
        for start in range(0, order.shape[1], batch_size):
            batch = order[:, start : start + batch_size]
            sums += step(
                tf.gather(images, batch),
                tf.gather(labels, batch),
                tf.constant(mask[:, start : start + batch_size]),
            ).numpy()
        for history, (loss, right) in zip(histories, (sums / sizes).T, strict=True):
            history.append({"epoch": epoch + 1, "loss": float(loss), "accuracy": float(right)})
        if advance is not None:
            advance(1, f"accuracy {(sums[1] / sizes).mean():.3f}")
    for index, model in enumerate(models):
        for variable, stacked in zip(model.trainable_variables, variables, strict=True):
            variable.assign(stacked[index])
    return histories


def forward_together(layers, variables, images):
    """Logits of n networks, each on images of its own.

    Parameters
    ----------
    layers : list of tf.keras.layers.Layer
        Of one of them, in order.
    variables : list of tensors
        Kernels and biases in order, stacked along the first axis.
    images : tensor, shape (n, batch, rows, columns, channels)

    Returns
    -------
    tensor, shape (n, batch, outputs)

    Raises
    ------
    ValueError
        There is a layer of a kind that this does not know.
    """
    n, batch = images.shape[:2]
    signal, remaining = images, iter(variables)
    for layer in layers:
        # Exact types: a subclass may compute with something else than its kernel.
        if type(layer) is tf.keras.layers.Conv2D:
            signal = _convolve(signal, next(remaining), next(remaining))
        elif type(layer) is tf.keras.layers.Dense:
            signal = tf.matmul(signal, next(remaining)) + next(remaining)[:, None]
        elif isinstance(layer, tf.keras.layers.Flatten):
            signal = tf.reshape(signal, (n, batch, int(np.prod(signal.shape[2:]))))
        elif not layer.weights and not isinstance(layer, tf.keras.layers.InputLayer):
            signal = layer(signal)  # neurons, one by one
        elif layer.weights:
            raise ValueError(f"layer {layer.name!r}: {type(layer).__name__} cannot be stacked")
    return signal


def _convolve(signal, kernel, bias):
    """A convolution as a product of matrices, for which there is a batched form."""
    n, batch, rows, columns, channels = signal.shape
    k, filters = kernel.shape[1], kernel.shape[-1]
    rows, columns = rows - k + 1, columns - k + 1
    patches = tf.concat(
        [signal[:, :, i : i + rows, j : j + columns] for i in range(k) for j in range(k)], -1
    )
    product = tf.matmul(
        tf.reshape(patches, (n, batch * rows * columns, k * k * channels)),
        tf.reshape(kernel, (n, k * k * channels, filters)),
    )
    return tf.reshape(product + bias[:, None], (n, batch, rows, columns, filters))


def _orders(parts, seeds, epoch, batch_size):
    """Each network's samples in their order of this epoch, filled up to whole batches.

    Returns
    -------
    order : ndarray of int, shape (n_models, n)
    mask : ndarray of float32, same shape
        0 where a place was filled up.
    """
    longest = -(-max(len(part) for part in parts) // batch_size) * batch_size
    order = np.zeros((len(parts), longest), np.int64)
    mask = np.zeros((len(parts), longest), np.float32)
    for row, (part, seed) in enumerate(zip(parts, seeds, strict=True)):
        order[row, : len(part)] = np.random.default_rng([seed, epoch]).permutation(part)
        mask[row, : len(part)] = 1
    return order, mask
