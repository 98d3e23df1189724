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

    def find_channel_affine(self, same_shape: bool = True):
        """Scale and offset of each channel, or None if the values are not the built ones in order.

        Zeros padded around the image do not count.

        Parameters
        ----------
        same_shape : bool
            The built signal must also be an image, of the same shape.
        """
        if not self.is_image:
            return None
        (top, bottom), (left, right) = self.pads
        rows, columns = self.shape[:2]
        inside = self.positions[top : rows - bottom, left : columns - right]
        if inside.size != math.prod(self.built) or (same_shape and inside.shape != self.built):
            return None
        inside = inside.ravel()
        if np.delete(self.offset, inside).any():  # what was padded has been shifted
            return None
        scales = self.map[inside].diagonal()
        is_diagonal = abs(self.map[inside] - sparse.diags_array(scales)).max() == 0
        scales, offsets = (a.reshape(-1, self.shape[2]) for a in (scales, self.offset[inside]))
        if not (is_diagonal and are_alike(scales) and are_alike(offsets)):
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
        rows, columns, channels = self.shape
        window = np.ones((1, 1, *size))
        sums = make_matrix(window, (rows, columns, 1), strides, padding)
        means = sparse.diags_array(1 / sums.sum(1)) @ sums
        self.map = (sparse.kron(means, sparse.eye_array(channels)) @ self.map).tocsr()
        self.offset = (means @ self.offset.reshape(-1, channels)).ravel()
        self.shape = (*compute_counts(self.shape, size, strides, padding), channels)
        self.pads = ((0, 0), (0, 0))


def are_alike(rows) -> bool:
    """True if rows of numbers that Keras computed are the same, but for the rounding of 32 bits."""
    return np.allclose(rows, rows[0], rtol=1e-5, atol=1e-6 * np.abs(rows).max(initial=0))


def compute_counts(sides, size, strides, padding) -> list:
    """Numbers of windows along rows and columns; 0 or less if none fits."""
    along = zip(sides, size, strides, strict=False)
    return [list_windows(*side, padding)[0] for side in along]


def make_matrix(kernel, shape, strides, padding):
    """A convolution as a matrix (outputs, inputs), channels last on both sides.

    Parameters
    ----------
    kernel : ndarray, shape (filters, channels, rows, columns)
    shape : tuple of int
        (rows, columns, channels) of the input.
    strides : (int, int)
    padding : str

    Returns
    -------
    scipy.sparse.csr_array
    """
    rows, columns = (
        [_select_values(n, size, stride, padding, place) for place in range(size)]
        for n, size, stride in zip(shape, kernel.shape[2:], strides, strict=False)
    )
    return sum(
        sparse.kron(sparse.kron(rows[i], columns[j]), kernel[:, :, i, j], "csr")
        for i, j in np.ndindex(kernel.shape[2:])
    )


def _select_values(n, size, stride, padding, place):
    """A matrix (windows, n) that selects the value at a place of each window."""
    count, before, _ = list_windows(n, size, stride, padding)
    chosen = np.arange(count) * stride - before + place
    return sparse.csr_array((chosen[:, None] == np.arange(n)).astype(float))
