"""The signal between two layers with weights: a linear function of what was built before.

signal = map @ built + offset
"""

import math

import numpy as np
from scipy import sparse

from deploy.network.geometry import list_windows


class Signal:
    """A signal of a Keras model, as a function of the signal of the layers built so far.

    Attributes
    ----------
    built, shape : tuple of int
        Shapes of the built signal, and of the model's.
    map : scipy.sparse.csr_array, shape (values of the signal, values built)
    offset : ndarray, shape (values of the signal,)
    pads : ((int, int), (int, int))
        Zeros padded around the rows and columns of an image.
    """

    def __init__(self, built):
        self.begin(built)

    def begin(self, built, scale=1.0, offset=0.0):
        """Let the model's signal be the built one, but for an affine function of each channel."""
        self.built = self.shape = built
        self.map = sparse.diags_array(np.broadcast_to(scale, built).ravel().astype(float)).tocsr()
        self.offset = np.broadcast_to(offset, built).ravel().astype(float)
        self.pads = ((0, 0), (0, 0))

    @property
    def positions(self) -> np.ndarray:
        """Numbers of the signal's values, in its shape."""
        return np.arange(math.prod(self.shape)).reshape(self.shape)

    def arrange(self, positions):
        """Move values; -1 stands for a zero."""
        zero = sparse.csr_array((1, self.map.shape[1]))
        self.map = sparse.vstack([self.map, zero]).tocsr()[positions.ravel()]
        self.offset = np.append(self.offset, 0.0)[positions.ravel()]
        self.shape = positions.shape

    def flatten(self):
        """Move the values into one dimension."""
        self.arrange(self.positions.reshape(-1))

    def move_axis(self, before, after):
        """Move an axis of the shape."""
        self.arrange(np.moveaxis(self.positions, before, after))

    def pad(self, pads):
        """Pad zeros around the rows and columns of an image."""
        self.arrange(np.pad(self.positions, (*pads, (0, 0)), constant_values=-1))
        self.pads = tuple(
            (before[0] + added[0], before[1] + added[1])
            for before, added in zip(self.pads, pads, strict=True)
        )

    def find_channel_affine(self):
        """Scale and offset of each channel, or None if the signal is not the built image."""
        if not self.is_image:
            return None
        (top, bottom), (left, right) = self.pads
        rows, columns = self.shape[:2]
        inside = self.positions[top : rows - bottom, left : columns - right]
        if inside.shape != self.built:
            return None
        inside = inside.ravel()
        scales = self.map[inside].diagonal()
        is_diagonal = abs(self.map[inside] - sparse.diags_array(scales)).max() == 0
        scales, offsets = (a.reshape(-1, self.shape[2]) for a in (scales, self.offset[inside]))
        if not is_diagonal or (scales != scales[0]).any() or (offsets != offsets[0]).any():
            return None
        return scales[0], offsets[0]

    @property
    def is_unchanged(self) -> bool:
        """True if the signal is the built one."""
        if self.shape != self.built or self.offset.any():
            return False
        return abs(self.map - sparse.eye_array(len(self.offset))).max() == 0

    @property
    def is_moved(self) -> bool:
        """True if each value is one of the built ones, or 0."""
        return (self.map.data == 1).all() and not self.offset.any()

    @property
    def is_never_negative(self) -> bool:
        """True if no value is negative where the built ones are not."""
        return min(self.map.data.min(initial=0), self.offset.min()) >= 0

    def describe_obstacle(self) -> str:
        """Why a convolution cannot read the signal as the built image, and the remedy."""
        if (np.diff(self.map.indptr) > 1).any():
            return (
                "its input is averaged over windows that overlap or are cut off; use "
                "AveragePooling2D(2), or a Dense after it"
            )
        if self.shape == self.built and self.map.nnz == self.map.diagonal().astype(bool).sum():
            return (
                "its input is normalised in another way at each place; normalise each channel as a "
                "whole (axis=-1), or use a Dense after it"
            )
        return (
            "its input is not the whole image before it in the order of rows, columns and "
            "channels, because of a Permute, Reshape or Cropping2D; leave this out and train it "
            "on images as they are, or use a Dense after it"
        )

    @property
    def is_image(self) -> bool:
        """True if the signal has rows, columns and channels."""
        return len(self.shape) == 3

    @property
    def is_padded(self) -> bool:
        """True if zeros are padded around the image."""
        return any(map(any, self.pads))

    def scale(self, scale, offset):
        """Multiply each value of the signal, and add to it."""
        self.map = (sparse.diags_array(scale) @ self.map).tocsr()
        self.offset = scale * self.offset + offset

    def average(self, size, strides, padding):
        """Average over windows of rows and columns; padded positions do not count."""
        sides = zip(self.shape, size, strides, strict=False)
        rows, columns = (_make_means(*side, padding) for side in sides)
        over_channels = sparse.eye_array(self.shape[2])
        matrix = sparse.kron(sparse.kron(rows, columns), over_channels).tocsr()
        self.map = (matrix @ self.map).tocsr()
        self.offset = matrix @ self.offset
        self.shape = (rows.shape[0], columns.shape[0], self.shape[2])
        self.pads = ((0, 0), (0, 0))


def _make_means(n, size, stride, padding):
    """The matrix of means over windows along one side; padded positions do not count."""
    count, before, _ = list_windows(n, size, stride, padding)
    matrix = np.zeros((max(count, 0), n))
    for index, start in enumerate(range(-before, -before + count * stride, stride)):
        window = slice(max(start, 0), min(start + size, n))
        matrix[index, window] = 1 / (window.stop - window.start)
    return sparse.csr_array(matrix)
