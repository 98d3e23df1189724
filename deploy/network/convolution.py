"""A convolution with any number of zeros around its input, in Nengo and NengoLoihi."""

from __future__ import annotations

import nengo
import numpy as np
from nengo.builder import Builder, Signal
from nengo.builder.operator import Reset
from nengo.builder.transforms import ConvInc
from nengo.transforms import ChannelShape


class PaddedConvolution(nengo.Convolution):
    """A convolution of two dimensions with the same number of zeros on each side of its input.

    Nengo has "valid" and "same" only.  Unless the padding is "valid", NengoLoihi pads by half of
    the values by which all windows together exceed the input, so that this transform declares
    "same".

    Parameters
    ----------
    zeros : int
    **options
        As for :class:`nengo.Convolution`.  The last window must end with the padded input.
    """

    zeros = nengo.params.IntParam("zeros", low=0)

    def __init__(self, zeros, **options):
        super().__init__(padding="same", **options)
        self.zeros = zeros

    @property
    def output_shape(self):
        """Output shape after applying convolution to input."""
        sizes = zip(self.input_shape.spatial_shape, self.kernel_size, self.strides)
        counts = [(n + 2 * self.zeros - size) // stride + 1 for n, size, stride in sizes]
        return ChannelShape((*counts, self.n_filters), channels_last=True)


class PaddedConvInc(ConvInc):
    """The operator of a padded convolution in Nengo's simulator."""

    def make_step(self, signals, dt, rng):
        """The function of one step."""
        weights = signals[self.W]
        values = signals[self.X]
        values = values.reshape(self.conv.input_shape.shape)
        output = signals[self.Y].reshape(self.conv.output_shape.shape)
        edge = (self.conv.zeros, self.conv.zeros)
        down, right = self.conv.strides
        rows = down * (output.shape[0] - 1) + 1
        columns = right * (output.shape[1] - 1) + 1

        def step_padded_convolution():
            padded = np.pad(values, (edge, edge, (0, 0)))
            for row, column in np.ndindex(*weights.shape[:2]):
                window = padded[row : row + rows : down, column : column + columns : right]
                output[...] += window @ weights[row, column]

        return step_padded_convolution


@Builder.register(PaddedConvolution)
def build_padded_convolution(model, transform, sig_in, decoders=None, encoders=None, rng=np.random):
    """Build the transform in Nengo; it is used between neurons, without decoders."""
    assert decoders is None
    assert encoders is None
    weights = Signal(transform.sample(rng=rng), readonly=True, name=f"{transform}.weights")
    weighted = Signal(shape=transform.size_out, name=f"{transform}.weighted")
    model.add_op(Reset(weighted))
    model.add_op(PaddedConvInc(weights, sig_in, weighted, transform))
    return weighted, weights
