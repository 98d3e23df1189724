"""The layer of Keras that computes any operation, with the chip's quantised weights if wanted."""

from models.keras.keras2 import tf
from models.quantised import quantise_layer


class OperationLayer(tf.keras.layers.Layer):
    """Weighted sums of an operation, with a bias for each channel or unit.

    Parameters
    ----------
    operation : models.ops.base.Operation
    gain : float, optional
        Gain of the layer's neurons: weights and bias currents are then quantised as on the chip,
        see :func:`models.quantised.quantise_layer`.  Default: weights in floating point.

    Notes
    -----
    Its variables have the names and shapes of :meth:`models.ops.base.Operation.list_array_shapes`.
    """

    def __init__(self, operation, gain=None, **kwargs):
        super().__init__(**kwargs)
        self.operation = operation
        self.gain = gain

    def build(self, input_shape):
        """Make the variables, with Keras's initial values of dense layers and convolutions."""
        shapes = self.operation.list_array_shapes(tuple(input_shape[1:]))
        self.kernel = self.add_weight("kernel", shapes["kernel"], initializer="glorot_uniform")
        self.bias = self.add_weight("bias", shapes["bias"], initializer="zeros")
        super().build(input_shape)

    def call(self, inputs):
        """Compute the sums; input and output have the operation's shapes."""
        kernel = self.kernel
        bias = self.bias
        if self.gain is not None:
            kernel, bias = quantise_layer(kernel, bias, self.gain)
        return tf.nn.bias_add(self.operation.compute_tensor_sums(kernel, inputs), bias)

    def get_config(self):
        """The arguments, from which Keras makes an equal layer."""
        return {**super().get_config(), "operation": self.operation, "gain": self.gain}
