"""Training several small networks of one shape at the same time.

A network of the paper's size keeps a core busy for a fraction of the time that Keras needs to start
each step.  Here the weights of n networks are stacked along a new first axis and one compiled step
does a batch of each of them.  Each network sees its own samples in its own order, and noise of its
own; nothing passes between them, so that each ends as it would have alone, but for rounding.  A
network with fewer samples than the largest waits while the others finish their epoch; the optimiser
counts its steps on, which shifts its schedule, and Adam's start, by as much.
"""

from __future__ import annotations

import numpy as np

from deploy.network.geometry import windows
from models.keras2 import quiet_compiler, tf
from models.lif import RateLIF
from models.quantised import OnChipConv2D, OnChipDense, on_chip

MOST_BATCHES = 1 << 16
"""Of an epoch; numbers the noise of each."""


def fit_together(models, data, parts, seeds, epochs, batch_size, optimizer, advance=None):
    """Train networks that put out logits: sparse categorical cross-entropy, price of spikes.

    Parameters
    ----------
    models : sequence of tf.keras.Model
        Of one shape, from :func:`models.cnn.build_cnn`; trained in place.
    data : (images, labels)
        Of all samples.
    parts : sequence of ndarray of int
        For each model the indices of its training samples; they may differ in number.
    seeds : sequence of int
        For each model, of the order of its samples and of its noise.
    epochs, batch_size : int
    optimizer : tf.keras.optimizers.Optimizer
        A new one; its learning rate may be a schedule of the largest network's batches.
    advance : callable, optional
        ``advance(1, note)`` after each epoch.

    Returns
    -------
    list of list of dict
        For each model a history: ``epoch``, ``loss``, ``accuracy`` in each row.
    """
    stack = Stack(models, data, optimizer)
    histories = [[] for _ in models]
    for epoch in range(epochs):
        losses, shares = stack.train_epoch(parts, seeds, epoch, batch_size)
        for history, loss, share in zip(histories, losses, shares, strict=True):
            history.append({"epoch": epoch + 1, "loss": float(loss), "accuracy": float(share)})
        if advance is not None:
            advance(1, f"accuracy {shares.mean():.3f}")
    stack.unstack()
    return histories


class Stack:
    """Networks in training; see :func:`fit_together` for the arguments.

    Attributes
    ----------
    models : sequence of tf.keras.Model
        Their weights are those of the start until :meth:`unstack`.
    """

    def __init__(self, models, data, optimizer):
        self.models = models
        self._variables = variables = [
            tf.Variable(tf.stack([v.numpy() for v in group]), name=f"stacked{i}")
            for i, group in enumerate(zip(*(m.trainable_variables for m in models), strict=True))
        ]
        self._images = tf.constant(data[0], tf.float32)
        self._labels = tf.constant(data[1], tf.int32)
        layers = models[0].layers
        optimizer.build(variables)
        quiet_compiler()
        # Everything that a step changes and that has a part for each network.
        stacked = variables + [v for v in optimizer.variables if v.shape.rank]

        @tf.function(autograph=False, jit_compile=True)
        def step(images, labels, mask, noise_seeds):
            counts = tf.reduce_sum(mask, 1)
            with tf.GradientTape() as tape:
                logits, costs = forward_together(layers, variables, images, noise_seeds)
                losses = tf.nn.sparse_softmax_cross_entropy_with_logits(labels, logits) + costs
                # Each network's mean over its samples; the means only stand in one sum.
                means = tf.reduce_sum(mask * losses, 1) / tf.maximum(counts, 1.0)
                total = tf.reduce_sum(means)
            before = [tf.identity(v) for v in stacked]
            optimizer.apply_gradients(
                zip(tape.gradient(total, variables), variables, strict=True),
                skip_gradients_aggregation=True,
            )
            for variable, old in zip(stacked, before, strict=True):
                waits = tf.reshape(counts == 0, (-1, *[1] * (len(old.shape) - 1)))
                variable.assign(tf.where(waits, old, variable))
            right = mask * tf.cast(tf.argmax(logits, 2, tf.int32) == labels, tf.float32)
            return tf.stack([means * counts, tf.reduce_sum(right, 1)])

        self._step = step

    def train_epoch(self, parts, seeds, epoch, batch_size):
        """Show each network its samples once.

        Returns
        -------
        losses, shares : ndarrays, shape (n_models,)
            Mean loss, and share that was right, of each network's samples as they were trained on.
        """
        order, mask = _orders(parts, seeds, epoch, batch_size)
        sums = np.zeros((2, len(self.models)))
        for number, start in enumerate(range(0, order.shape[1], batch_size)):
            batch = order[:, start : start + batch_size]
            noise = epoch * MOST_BATCHES + number  # the same whatever the other networks' sizes
            sums += self._step(
                tf.gather(self._images, batch),
                tf.gather(self._labels, batch),
                tf.constant(mask[:, start : start + batch_size]),
                tf.constant([[seed, noise] for seed in seeds]),
            ).numpy()
        return sums / np.array([len(part) for part in parts])

    def unstack(self):
        """Give each model its trained weights."""
        for index, model in enumerate(self.models):
            for variable, stacked in zip(model.trainable_variables, self._variables, strict=True):
                variable.assign(stacked[index])


def forward_together(layers, variables, images, noise_seeds=None):
    """Logits of n networks, each on images of its own.

    Parameters
    ----------
    layers : list of tf.keras.layers.Layer
        Of one of them, in order.
    variables : list of tensors
        Kernels and biases in order, stacked along the first axis.
    images : tensor, shape (n, batch, rows, columns, channels)
    noise_seeds : tensor of int, shape (n, 2), optional
        Of the noise on each network's neurons, as in training; without, there is none.

    Returns
    -------
    logits : tensor, shape (n, batch, outputs)
    costs : tensor, shape (n, batch), or 0.0
        Price of the spikes of each sample.

    Raises
    ------
    ValueError
        There is a layer of a kind, or with options, that this does not know.
    """
    n, batch = images.shape[:2]
    signal, costs, remaining = images, 0.0, iter(variables)
    for number, layer in enumerate(layers):
        _check_plain(layer)
        # Exact types: a subclass may compute with something else than its kernel.
        if type(layer) in (tf.keras.layers.Conv2D, OnChipConv2D):
            kernel, bias = _weights(layer, remaining)
            signal = _convolve(signal, kernel, bias, layer.strides[0], layer.padding)
        elif type(layer) in (tf.keras.layers.Dense, OnChipDense):
            kernel, bias = _weights(layer, remaining)
            signal = tf.matmul(signal, kernel) + bias[:, None]
        elif type(layer) is RateLIF:
            if layer.noise and noise_seeds is not None:
                signal += layer.noise * _normal(signal.shape, noise_seeds, number)
            signal = layer.rates(signal)
            if layer.spike_costs is not None:
                costs += layer.cost(signal)
        elif isinstance(layer, tf.keras.layers.Flatten):
            signal = tf.reshape(signal, (n, batch, int(np.prod(signal.shape[2:]))))
        elif type(layer) is tf.keras.layers.AveragePooling2D:
            pooled = layer(tf.reshape(signal, (n * batch, *signal.shape[2:])))
            signal = tf.reshape(pooled, (n, batch, *pooled.shape[1:]))
        elif not layer.weights and not isinstance(layer, tf.keras.layers.InputLayer):
            signal = layer(signal)  # neurons, one by one
        elif layer.weights:
            raise ValueError(f"layer {layer.name!r}: {type(layer).__name__} cannot be stacked")
    return signal, costs


def _weights(layer, remaining):
    """A layer's stacked kernel and bias, as the chip has them where the layer is for it."""
    kernel, bias = next(remaining), next(remaining)
    if isinstance(layer, (OnChipConv2D, OnChipDense)):
        return on_chip(kernel, bias, layer.gain, stacked=True)
    return kernel, bias


def _check_plain(layer):
    """Refuse what a layer may do to its sums that is not done here."""
    for name, value in {"use_bias": True, "dilation_rate": (1, 1)}.items():
        if getattr(layer, name, value) != value:
            raise ValueError(f"layer {layer.name!r}: {name} must be {value} to be stacked")
    strides = getattr(layer, "strides", (1, 1))
    if strides[0] != strides[1]:
        raise ValueError(f"layer {layer.name!r}: strides must be equal to be stacked")
    sums = isinstance(layer, (tf.keras.layers.Conv2D, tf.keras.layers.Dense))
    if sums and layer.activation is not tf.keras.activations.linear:
        raise ValueError(f"layer {layer.name!r}: its neurons must be a layer of their own")


def _normal(shape, seeds, number):
    """Standard normal numbers, those of each network from its own seed, for a layer."""
    fold_in = tf.random.experimental.stateless_fold_in
    return tf.stack(
        [tf.random.stateless_normal(shape[1:], fold_in(seed, number)) for seed in tf.unstack(seeds)]
    )


def _convolve(signal, kernel, bias, stride, padding):
    """A convolution as a product of matrices, for which there is a batched form."""
    n, batch, *shape, channels = signal.shape
    k, filters = kernel.shape[1], kernel.shape[-1]
    (rows, top, bottom), (columns, left, right) = (windows(m, k, stride, padding) for m in shape)
    if top + bottom + left + right:
        signal = tf.pad(signal, ((0, 0), (0, 0), (top, bottom), (left, right), (0, 0)))
    down, across = stride * (rows - 1) + 1, stride * (columns - 1) + 1
    patches = tf.concat(
        [
            signal[:, :, i : i + down : stride, j : j + across : stride]
            for i in range(k)
            for j in range(k)
        ],
        -1,
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
