"""Models in files, made by either Keras: with its predictions next to them.

    python keras_models.py FOLDER OTHER_FOLDER

Keras 2 writes into the first folder and Keras 3 into the other.  They live side by side in one
process, since neither is asked of TensorFlow (there `tensorflow.keras` is one of them, for good).
"""

import atexit
import functools
import gc
import os
import sys
import warnings
from pathlib import Path

import numpy as np

# The two make a million objects and hardly any garbage, through which Python would look as it ends.
gc.disable()
atexit.register(gc.freeze)
os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
os.environ["KERAS_BACKEND"] = "tensorflow"


def good(keras):
    """Models that can be used, by name."""
    layers, models = keras.layers, {}
    make = keras.Sequential

    models["paper"] = make([
        keras.Input((10, 10, 1)),
        layers.Conv2D(6, 4, activation="relu"),
        layers.Conv2D(24, 3, activation="relu"),
        layers.Flatten(),
        layers.Dense(10, activation="softmax"),
    ])  # fmt: skip
    models["strides_and_pooling"] = make([
        keras.Input((11, 9, 2)),
        layers.Conv2D(5, 4, strides=2, padding="same", use_bias=False, name="first"),
        layers.BatchNormalization(),
        layers.Activation("relu"),
        layers.AveragePooling2D(2),
        layers.Dropout(0.2),
        layers.Flatten(),
        layers.Dense(7),
        layers.ReLU(),
        layers.Dense(3),
        layers.Softmax(),
    ])  # fmt: skip
    # Normalisation after the ReLU, through a pooling and a Flatten, and in front of everything.
    models["folded_forward"] = make([
        keras.Input((12, 12, 2)),
        layers.Rescaling(1 / 3, offset=-0.4),
        layers.Conv2D(4, 3, strides=2),
        layers.ReLU(),
        layers.BatchNormalization(scale=False),
        layers.AveragePooling2D((2, 2), padding="valid"),
        layers.Conv2D(6, 2, padding="valid", activation="relu"),
        layers.BatchNormalization(center=False),
        layers.Flatten(),
        layers.BatchNormalization(),
        layers.Rescaling(2.0),
        layers.Dense(8, use_bias=False),
        layers.BatchNormalization(epsilon=0.1),
        layers.ReLU(),
        layers.Dense(5),
        layers.BatchNormalization(),
    ])  # fmt: skip
    models["rescaled_and_padded"] = make([
        keras.Input((6, 6, 1)),
        layers.Rescaling(0.25),
        layers.Conv2D(3, 3, padding="same", activation="relu"),
        layers.BatchNormalization(trainable=False),
        layers.Conv2D(3, 2, strides=2, padding="same", activation="relu"),  # which pads nothing
        layers.AveragePooling2D(3, padding="same"),  # nor does this
        layers.Flatten(),
        layers.Dense(4, activation="linear"),
        layers.Activation("softmax"),
    ])  # fmt: skip
    models["dense_only"] = make([
        keras.Input((5, 4)),
        layers.Flatten(),
        layers.Dense(9, activation="relu"),
        layers.Dense(2, activation="softmax"),
    ])  # fmt: skip

    inputs = keras.Input((8, 9, 2), name="taxels")
    signal = layers.Conv2D(4, (3, 3), activation="relu")(inputs)
    signal = layers.Conv2D(8, 3)(signal)
    signal = layers.BatchNormalization()(signal)
    signal = layers.ReLU()(signal)
    signal = layers.Dropout(0.5)(signal)
    signal = layers.Conv2D(8, 2, name="conv2d_77")(signal)
    signal = layers.BatchNormalization()(signal)
    signal = layers.Flatten()(signal)
    signal = layers.ReLU()(signal)
    outputs = layers.Softmax()(layers.Dense(6)(signal))
    models["functional"] = keras.Model(inputs, outputs)

    # Built by its first input, and compiled and trained: with the optimiser's arrays in the file.
    model = make([
        layers.Conv2D(3, 5, strides=3, padding="same", activation="relu"),
        layers.Flatten(),
        layers.Dense(10, activation="softmax"),
    ])  # fmt: skip
    model.compile("adam", "sparse_categorical_crossentropy", run_eagerly=True)  # no graph for this
    images = np.random.default_rng(1).uniform(size=(64, 10, 10, 1))
    model.fit(images, np.arange(64) % 10, verbose=0)
    models["trained"] = model
    return models


def exact(keras):
    """Further models that compute the same: what users' files have between the usual layers."""
    return {**means(keras), **rare_layers(keras), **windows(keras), **moved_values(keras)}


def make_chain(keras, shape, *middle):
    return keras.Sequential([keras.Input(shape), *middle])


def make_read_out_chain(keras, shape, *middle):
    """A chain that ends with a dense readout of three classes."""
    return make_chain(keras, shape, *middle, keras.layers.Flatten(), keras.layers.Dense(3))


def means(keras):
    """Networks without images, and those that read out means."""
    layers = keras.layers
    chain = functools.partial(make_chain, keras)
    return {
        "vector": chain(
            (100,),
            layers.Dense(8, activation="relu"),
            layers.GaussianNoise(0.1),
            layers.Dense(3, activation="sigmoid"),
        ),
        "vector_reshaped": chain(
            (40,),
            layers.Reshape((4, 5, 2)),
            layers.Conv2D(3, 2, activation="relu"),
            layers.Reshape((-1,)),
            layers.Dense(3, activation="tanh"),
        ),
        "channel_added": chain(
            (6, 7),
            layers.Reshape((6, 7, 1)),
            layers.ZeroPadding2D(1),
            layers.Conv2D(3, 3),
            layers.BatchNormalization(),
            layers.ReLU(),
            layers.Permute((2, 1, 3)),
            layers.Flatten(),
            layers.Dense(3, activation="softplus"),
        ),
        "global_average": chain(
            (7, 9, 1),
            layers.Conv2D(4, 3, activation="relu"),
            layers.BatchNormalization(),
            layers.GlobalAveragePooling2D(),
            layers.Dense(3, activation="softmax"),
        ),
        "convolutions_only": chain(
            (8, 8, 1),
            layers.Conv2D(4, 3, activation="relu"),
            layers.Conv2D(5, 2, strides=2, padding="same"),
            layers.GlobalAveragePooling2D(),
            layers.Softmax(),
        ),
        "average_read_out": chain(
            (6, 6, 2),
            layers.Conv2D(4, 3, activation="relu"),
            layers.GlobalAveragePooling2D(),
            layers.Activation("softmax"),
        ),
    }


def rare_layers(keras):
    """Layers and orders of layers that are rare in files."""
    layers = keras.layers
    chain = functools.partial(make_chain, keras)
    read_out_chain = functools.partial(make_read_out_chain, keras)
    inner = keras.Sequential(
        [keras.Input((6, 6, 1)), layers.RandomFlip(), layers.Conv2D(3, 3, activation="relu")],
        name="inner",
    )
    return {
        "overlapping": read_out_chain(
            (8, 8, 1),
            layers.Conv2D(4, 3, padding="same", activation="relu"),
            layers.AveragePooling2D(3, strides=2, padding="same"),
        ),
        "two_classes": chain(
            (5, 5, 1),
            layers.Flatten(),
            layers.Dense(6, activation="relu"),
            layers.Dense(1, activation="sigmoid"),
        ),
        "linear_pair": chain(
            (5, 5, 1),
            layers.Flatten(),
            layers.Dense(6, activation="relu"),
            layers.Dense(4),
            layers.Dense(3, activation="softmax"),
        ),
        "separable": chain(
            (8, 8, 2),
            layers.DepthwiseConv2D(3, depth_multiplier=2, activation="relu"),
            layers.SeparableConv2D(5, 2, activation="relu"),
            layers.Flatten(),
            layers.Dense(3, activation="relu"),
        ),
        "normalised_rows": read_out_chain(
            (6, 6, 1),
            layers.Conv2D(3, 3, activation="relu"),
            layers.BatchNormalization(axis=1),
        ),
        "channels_first": read_out_chain(
            (2, 8, 7),
            layers.Conv2D(3, 3, data_format="channels_first"),
            layers.BatchNormalization(axis=1),
            layers.ReLU(),
            layers.AveragePooling2D(2, data_format="channels_first"),
            layers.Conv2D(4, 2, data_format="channels_first", activation="relu"),
        ),
        "keras_1": chain(
            (8, 8, 1),
            layers.Conv2D(4, 3, strides=2, activation="relu", name="c"),
            layers.Flatten(),
            layers.Dense(3, activation="softmax", name="out"),
        ),
        "within": read_out_chain(
            (6, 6, 1),
            inner,
        ),
    }


def windows(keras):
    """Windows of other shapes, strides and orders."""
    layers = keras.layers
    chain = functools.partial(make_chain, keras)
    read_out_chain = functools.partial(make_read_out_chain, keras)
    return {
        "other_windows": read_out_chain(
            (9, 12, 2),
            layers.Conv2D(4, (3, 2), padding="same", activation="relu"),
            layers.Conv2D(4, 2, dilation_rate=2, groups=2, activation="relu"),
            layers.ZeroPadding2D(1),
            layers.Conv2D(3, 3, strides=2, activation="relu"),
        ),
        "means_before_convolution": read_out_chain(
            (12, 12, 2),
            layers.Conv2D(4, 3, activation="relu"),
            layers.AveragePooling2D(3, strides=2),
            layers.Dropout(0.1),
            layers.BatchNormalization(),
            layers.Conv2D(3, 2, activation="relu"),
        ),
        "not_square": read_out_chain(
            (6, 6, 1),
            layers.Conv2D(3, (3, 2), activation="relu"),
        ),
        "uneven_strides": read_out_chain(
            (6, 6, 1),
            layers.Conv2D(3, 3, strides=(1, 2), padding="same"),
            layers.BatchNormalization(),
            layers.ReLU(),
            layers.AveragePooling2D(2),
            layers.Conv2D(3, 1, activation="relu"),
        ),
        "overlapping_means": chain(
            (8, 8, 1),
            layers.Conv2D(3, 3, activation="relu"),
            layers.AveragePooling2D(3, strides=2),
            layers.Conv2D(3, 2, padding="same", activation="relu"),
            layers.GlobalAveragePooling2D(),
            layers.Dense(3),
        ),
        "relu_after_means": chain(
            (8, 8, 1),
            layers.Conv2D(3, 3),
            layers.AveragePooling2D(2),
            layers.ReLU(),
            layers.Conv2D(3, 2),
            layers.Flatten(),
            layers.BatchNormalization(),
            layers.ReLU(),
            layers.Dense(3),
        ),
    }


def moved_values(keras):
    """Layers that move or normalise values."""
    layers = keras.layers
    chain = functools.partial(make_chain, keras)
    read_out_chain = functools.partial(make_read_out_chain, keras)
    return {
        "cropped": read_out_chain(
            (8, 8, 1),
            layers.Cropping2D(1),
            layers.Conv2D(3, 3, activation="relu"),
            layers.Permute((2, 1, 3)),
            layers.Conv2D(3, 2, activation="relu"),
        ),
        "channels_moved": read_out_chain(
            (2, 6, 7),
            layers.Permute((2, 3, 1)),
            layers.ZeroPadding2D(3),
            layers.Conv2D(3, 3, activation="relu"),
        ),
        "normalised_zeros": read_out_chain(
            (7, 7, 1),
            layers.Conv2D(3, 3, activation="relu"),
            layers.ZeroPadding2D(1),
            layers.BatchNormalization(),
            layers.Conv2D(3, 3, activation="relu"),
        ),
        "normalised_by_row": read_out_chain(
            (8, 8, 1),
            layers.Normalization(axis=1, mean=np.arange(8.0) / 8, variance=np.ones(8)),
            layers.Conv2D(3, 3, activation="relu"),
        ),
        "linear_convolution": chain(
            (30, 30, 1),
            layers.Conv2D(8, 3, activation="relu"),
            layers.Conv2D(5, 1),
            layers.GlobalAveragePooling2D(),
            layers.Softmax(),
        ),
        "pixels": read_out_chain(
            (6, 6, 1),
            layers.Rescaling(1 / 255),
            layers.Conv2D(3, 3, activation="relu"),
        ),
        "normalised_pixels": read_out_chain(
            (6, 6, 2),
            layers.Normalization(mean=[33.0, 41.0], variance=[900.0, 100.0]),
            layers.Conv2D(3, 3, activation="relu"),
        ),
    }


class Replacements:
    """Keras's layers, but averages for maxima and ReLUs for other activations."""

    def __init__(self, keras):
        self.keras = keras

    def __getattr__(self, name):
        layers = self.keras.layers
        if name in ("LeakyReLU", "PReLU", "ELU", "ReLU"):
            return lambda *arguments, **options: layers.ReLU()
        layer = getattr(layers, name.replace("Max", "Average"))
        if name == "MaxPooling2D":
            return lambda size=2, **options: layer(size, **options)
        if name in ("Conv2D", "Dense"):
            return lambda *arguments, activation=None, **options: layer(
                *arguments,
                activation=activation if activation in (None, "softmax") else "relu",
                **options,
            )
        return layer


def inexact(keras, layers=None):
    """Models that are used if training goes on; without, they are refused with that reason."""
    layers = layers or keras.layers

    def chain(*middle, shape=(12, 12, 1)):
        end = [layers.Flatten(), layers.Dense(3, activation="softmax")]
        return keras.Sequential([keras.Input(shape), *middle, *end])

    image = keras.Input((12, 12, 1))
    maxima = layers.MaxPooling2D(2, name="cause")(layers.Conv2D(4, 3, activation="relu")(image))
    end = keras.Sequential([keras.Input((5, 5, 4)), layers.Flatten(), layers.Dense(3)])
    return {
        "maxima_in_graph": keras.Model(image, end(maxima)),
        "maxima": chain(
            layers.Conv2D(4, 3, activation="relu"),
            layers.BatchNormalization(),
            layers.MaxPooling2D(name="cause"),
            layers.Conv2D(5, 2),
            layers.MaxPooling2D(2),
            layers.ReLU(),
        ),
        "global_maximum": chain(
            layers.Conv2D(4, 3, activation="relu"), layers.GlobalMaxPooling2D(name="cause")
        ),
        "overlapping_maxima": chain(
            layers.Conv2D(4, 4, activation="relu"),
            layers.MaxPooling2D(3, strides=2, name="cause"),
        ),
        "maxima_before_dense": chain(
            layers.Conv2D(4, 4, activation="relu"),
            layers.BatchNormalization(),
            layers.MaxPooling2D(2, padding="same", name="cause"),
            layers.Dropout(0.1),
            layers.Flatten(),
            layers.Dense(5),
            layers.BatchNormalization(),
            layers.ReLU(),
        ),
        "maxima_cut_off": chain(
            layers.Conv2D(4, 2, activation="relu"),
            layers.MaxPooling2D(2, padding="same", name="cause"),
            layers.Conv2D(5, 2),
            layers.MaxPooling2D(3, strides=2, padding="same"),
            layers.BatchNormalization(),
            layers.ReLU(),
        ),
        "overlapping_maxima_before_convolution": chain(
            layers.Conv2D(4, 3, padding="same", activation="relu"),
            layers.MaxPooling2D(3, strides=2, name="cause"),
            layers.BatchNormalization(),
            layers.Conv2D(5, 2),
            layers.BatchNormalization(),
            layers.ReLU(),
            layers.MaxPooling2D(3, strides=1),
            layers.Conv2D(3, 1),
            layers.GlobalAveragePooling2D(),
        ),
        "maxima_normalised": chain(
            layers.Conv2D(4, 3),
            layers.MaxPooling2D(2, name="cause"),
            layers.BatchNormalization(),
            layers.ReLU(),
            layers.Conv2D(4, 2),
            layers.MaxPooling2D(2, strides=1),
            layers.BatchNormalization(),
            layers.ReLU(),
        ),
        "maximum_of_maxima": chain(
            layers.Conv2D(4, 4, activation="relu"),
            layers.MaxPooling2D(4, strides=2, name="cause"),
            layers.MaxPooling2D(2, strides=1),
            layers.Conv2D(3, 1, activation="relu"),
        ),
        "prelu": chain(
            layers.Conv2D(4, 3),
            layers.PReLU(name="cause"),
            layers.Conv2D(4, 3, activation="hard_sigmoid"),
        ),
        "lenet": chain(
            layers.Conv2D(4, 3, activation="tanh", name="cause"),
            layers.AveragePooling2D(2),
            layers.Conv2D(5, 2, activation="sigmoid"),
        ),
        "leaky": chain(
            layers.Conv2D(4, 3),
            layers.LeakyReLU(0.1, name="cause"),
            layers.Flatten(),
            layers.Dense(6),
            layers.ELU(0.5),
            layers.Dense(5),
            layers.ReLU(max_value=6),
        ),
        "leaky_maxima": chain(
            layers.Conv2D(4, 3),
            layers.LeakyReLU(0.1, name="cause"),
            layers.MaxPooling2D(2),
            layers.Conv2D(5, 2),
            layers.ReLU(max_value=6),
            layers.MaxPooling2D(2),
        ),
        "offsets_and_padding": chain(
            layers.Rescaling(0.5, offset=-1.0),
            layers.Conv2D(4, 3, padding="same", activation="relu", name="cause"),
            layers.BatchNormalization(),
            layers.MaxPooling2D(2),
            layers.ZeroPadding2D(1),
            layers.Conv2D(5, 3, activation="relu"),
        ),
        "no_activation": chain(
            layers.Conv2D(4, 3, name="cause"), layers.Conv2D(4, 3, activation="relu")
        ),
    }


def bad(keras):
    """Models that cannot, by name."""
    layers, models = keras.layers, {}

    def chain(*middle, shape=(8, 8, 1), end=None):
        end = [layers.Flatten(), layers.Dense(3, name="out")] if end is None else end
        return keras.Sequential([keras.Input(shape), *middle, *end])

    def conv(**options):
        return layers.Conv2D(4, **{"kernel_size": 3, "activation": "relu", "name": "c", **options})

    models["function"] = chain(conv(activation=lambda x: x * x))
    models["lambda"] = chain(conv(), layers.Lambda(lambda x: 2 * x, name="double"))
    models["large_matrix"] = chain(conv(kernel_size=(3, 2)), shape=(60, 60, 1))
    models["relu_first"] = chain(layers.ReLU(name="early"))
    models["no_hidden_layer"] = keras.Sequential(
        [keras.Input((5, 4)), layers.Flatten(), layers.Dense(2, activation="softmax")]
    )
    models["one_output"] = chain(end=[layers.Flatten(), layers.Dense(1, name="out")])
    models["softmax_within"] = chain(
        end=[layers.Flatten(), layers.Dense(3, "softmax", name="early"), layers.Dense(3)]
    )
    models["softmax_of_an_image"] = chain(
        *(conv(), layers.AveragePooling2D(6)),
        end=[layers.Conv2D(3, 1, activation="softmax", name="early"), layers.Reshape((3,))],
    )
    models["no_dense_output"] = chain(conv(), end=[])
    image = keras.Input((8, 8, 1))
    models["operation"] = keras.Model(image, layers.Dense(3)(layers.Flatten()(conv()(image / 2.0))))
    models["unknown_rows"] = chain(shape=(200,), end=[layers.Dense(3)])
    models["dense_on_images"] = chain(layers.Dense(3, "relu", name="each"))
    models["offset_and_padding"] = chain(layers.Rescaling(1.0, offset=0.5), conv(padding="same"))
    models["any_size"] = chain(
        conv(), layers.GlobalAveragePooling2D(), shape=(None, None, 1), end=[layers.Dense(3)]
    )
    models["recurrent"] = chain(
        layers.SimpleRNN(4, name="loop"), shape=(10, 10), end=[layers.Dense(3)]
    )

    class Mine(layers.Dense):
        pass

    models["own_layer"] = chain(end=[layers.Flatten(), Mine(3, name="mine")])

    class Net(keras.Model):
        pass

    inputs = keras.Input((4, 4, 1))
    models["own_model"] = Net(inputs, layers.Dense(3)(layers.Flatten()(inputs)))
    inputs = keras.Input((4, 4, 1))
    flat = layers.Flatten()(inputs)
    one, two = (layers.Dense(3, "relu", name=name)(flat) for name in ("one", "two"))
    models["branches"] = keras.Model(inputs, layers.Add(name="sum")([one, two]))
    models["two_outputs"] = keras.Model(inputs, [one, two])
    inputs = keras.Input((4, 4, 1))
    shared = layers.Dense(16, "relu", name="twice")
    signal = shared(shared(layers.Flatten()(inputs)))
    models["shared"] = keras.Model(inputs, layers.Dense(3)(signal))
    models["not_a_number"] = chain(conv())
    models["infinite_variance"] = chain(conv(), layers.BatchNormalization(name="norm"))
    return models


def randomise(model, seed):
    """Weights as if trained."""
    rng = np.random.default_rng(seed)
    for layer in model.layers:
        arrays = [rng.normal(0, 0.5, array.shape) for array in layer.get_weights()]
        if type(layer).__name__ == "BatchNormalization":
            arrays[-1] = rng.uniform(0.5, 2, arrays[-1].shape)
        layer.set_weights(arrays)


def write(keras, folder, suffix):
    """Write NAME.suffix and, of the good ones, NAME.npz with inputs and predictions."""
    import tensorflow as tf

    keras.utils.set_random_seed(0)
    models = {**good(keras), **exact(keras), **inexact(keras)}
    for seed, (name, model) in enumerate(models.items()):
        if name != "trained":
            randomise(model, seed)
        inputs = np.random.default_rng(seed).uniform(0, 1, (20, *model.input_shape[1:]))
        compute = tf.function(model, jit_compile=True) if name == "channels_first" else model
        outputs = np.asarray(compute(inputs.astype(np.float32), training=False))
        np.savez(folder / f"{name}.npz", inputs=inputs, outputs=outputs)
        save(model, folder / name, suffix)
    for name, twin in inexact(keras, Replacements(keras)).items():
        used = [layer for layer in models[name].layers if type(layer).__name__ != "PReLU"]
        twin.set_weights([array for layer in used for array in layer.get_weights()])
        inputs = np.load(folder / f"{name}.npz")["inputs"].astype(np.float32)
        np.save(folder / f"{name}.npy", np.asarray(twin(inputs, training=False)))
    for name, model in bad(keras).items():
        if name in ("not_a_number", "infinite_variance"):
            randomise(model, 0)
        if name == "not_a_number":
            kernel, bias = model.layers[0].get_weights()
            kernel[0, 0, 0, 0] = np.nan
            model.layers[0].set_weights([kernel, bias])
        if name == "infinite_variance":
            *others, variance = model.layers[1].get_weights()
            model.layers[1].set_weights([*others, np.full_like(variance, np.inf)])
        save(model, folder / name, suffix)
    model.save_weights(folder / "only.weights.h5")


def save(model, path, suffix):
    """In the format of this ending; of two networks in both formats."""
    suffixes = (".keras", ".h5") if path.name in ("paper", "functional") else (suffix,)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for suffix in suffixes:
            model.save(path.with_suffix(suffix))


if __name__ == "__main__":
    import keras
    import tf_keras

    # Each Keras in the format that it writes by default.
    versions = (tf_keras, ".h5"), (keras, ".keras")
    for (version, suffix), folder in zip(versions, sys.argv[1:], strict=True):
        write(version, Path(folder), suffix)
