"""Adam with a warm-up, a falling learning rate and a running mean of the weights, in NumPy."""

from __future__ import annotations

import math

import numpy as np

# Updates in which the learning rate rises from 0.
WARM_UP_UPDATES = 50

# Maximum norm of all gradients together; longer ones are shortened.
MAX_GRADIENT_NORM = 5.0

# Decays of the running means of gradients and of their squares, and what is added to the root of
# the latter (Kingma and Ba 2015).
BETA_1 = 0.9
BETA_2 = 0.999
EPSILON = 1e-7


class Adam:
    """The state of an optimisation.

    Parameters
    ----------
    values : dict of str to ndarray
        Initial values of the variables.
    learning_rate : float
        After the warm-up; it then falls to 0 along a half cosine.
    updates : int
        Number of updates of the whole optimisation.
    average : float
        Decay per update of the running mean of the values; it is shorter at first.

    Attributes
    ----------
    values, means : dict of str to ndarray
        The variables, and their running means; :meth:`update` changes them in place.
    """

    def __init__(self, values: dict, learning_rate: float, updates: int, average: float):
        self.values = {name: np.array(value, np.float32) for name, value in values.items()}
        self.means = {name: value.copy() for name, value in self.values.items()}
        self.learning_rate = learning_rate
        self.updates = updates
        self.average = average
        self._first = {name: np.zeros_like(value) for name, value in self.values.items()}
        self._second = {name: np.zeros_like(value) for name, value in self.values.items()}

    @property
    def state(self) -> dict:
        """All arrays that the next update depends on, by name."""
        arrays = {}
        for name in self.values:
            arrays[f"weight.{name}"] = self.values[name]
            arrays[f"mean.{name}"] = self.means[name]
            arrays[f"first.{name}"] = self._first[name]
            arrays[f"second.{name}"] = self._second[name]
        return arrays

    def update(self, gradients: dict, number: int):
        """Change the values by the gradients of update ``number``, counted from 0."""
        squares = sum(float(np.sum(np.square(each, dtype=float))) for each in gradients.values())
        clip = min(1.0, MAX_GRADIENT_NORM / max(math.sqrt(squares), 1e-12))
        n_updates = number + 1
        rate = (
            self._compute_rate(number) * math.sqrt(1 - BETA_2**n_updates) / (1 - BETA_1**n_updates)
        )
        share = min(self.average, n_updates / (9 + n_updates))
        for name, value in self.values.items():
            gradient = clip * np.asarray(gradients[name], np.float32)
            first = self._first[name]
            second = self._second[name]
            mean = self.means[name]
            first += (1 - BETA_1) * (gradient - first)
            second += (1 - BETA_2) * (gradient * gradient - second)
            value -= (rate * first / (np.sqrt(second) + EPSILON)).astype(np.float32)
            mean += (1 - share) * (value - mean)

    def _compute_rate(self, number):
        if number < WARM_UP_UPDATES:
            return self.learning_rate * number / WARM_UP_UPDATES
        share = min((number - WARM_UP_UPDATES) / self.updates, 1.0)
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * share))
