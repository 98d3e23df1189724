"""Small computations that NumPy and the standard library do not name."""

from __future__ import annotations


def divide_up(number, divisor):
    """The quotient, rounded up; of integers, or of an array of integers."""
    return -(-number // divisor)


def select_evenly(values, at_most: int):
    """Every n-th of some values, with the smallest n that leaves at most a number of them.

    Parameters
    ----------
    values : sequence or ndarray
    at_most : int
    """
    return values[:: max(divide_up(len(values), at_most), 1)]
