"""The operations of this package conform, and mistakes in new ones are found."""

import math
import re

import numpy as np
import pytest

from deploy.conformance.operations import assert_deployed_operation_conforms
from deploy.errors import UserError
from deploy.network.ops import DEPLOYED_OPERATIONS, register_deployed_operation
from models.conformance import assert_operation_conforms
from models.ops import OPERATIONS, Convolution, Dense, NotatedLayer, register_operation
from tests.extensions.test_from_outside import (
    DeployedOneToOne,
    OneToOne,
    delete_at_the_end,
)


@pytest.fixture
def one_to_one(monkeypatch):
    monkeypatch.setitem(OPERATIONS, "own", OneToOne)
    monkeypatch.setitem(DEPLOYED_OPERATIONS, "own", DeployedOneToOne)


@pytest.mark.parametrize(
    ("operation", "input_shape"),
    [
        (Convolution(4, 3), (6, 5, 2)),
        (Convolution(3, 2, 2, "same"), (5, 5, 1)),
        (Dense(7), (4, 3, 2)),
        (Dense(7), (9,)),
        (OneToOne(), (4, 4, 2)),
    ],
    ids=str,
)
def test_operations_conform(operation, input_shape, one_to_one):
    assert_operation_conforms(operation, input_shape)


class Squared(DeployedOneToOne):
    def compute_sums(self, weights, values):
        return weights**2 * values.reshape(len(values), -1)


class Affine(DeployedOneToOne):
    def compute_sums(self, weights, values):
        return weights * values.reshape(len(values), -1) + 1


class TooFew(DeployedOneToOne):
    def count_fan_out(self, pooled_shape):
        return np.zeros(pooled_shape, int)


class OtherTransform(DeployedOneToOne):
    def make_transform(self, layer, chip):
        import nengo

        return nengo.Dense((layer.size, layer.size), init=np.ones((layer.size,) * 2)), None


class NameOfALayer(DeployedOneToOne):
    def to_file(self):
        return {"pool": 3}

    @classmethod
    def from_file(cls, numbers, shape):
        return cls()


class OtherLargest(DeployedOneToOne):
    def find_largest_weights(self, weights, pooled_shape):
        return np.abs(weights).max() * np.ones(len(weights))


class TransformWithoutPooling(DeployedOneToOne):
    def make_transform(self, layer, chip):
        import nengo

        matrix = np.zeros((layer.size, math.prod(layer.input_shape)))
        matrix[:, : layer.size] = np.diag(layer.weights)
        return nengo.Dense(matrix.shape, init=matrix), None


class NumberOutsideOfTheFields(DeployedOneToOne):
    def __init__(self, repeats=1):
        object.__setattr__(self, "repeats", repeats)

    def compute_sums(self, weights, values):
        return np.roll(super().compute_sums(weights, values), self.repeats, axis=1)

    @classmethod
    def from_file(cls, numbers, shape):
        return cls()


@pytest.mark.parametrize(
    ("mistaken", "fact"),
    [
        (TransformWithoutPooling, "make_transform"),
        (lambda: NumberOutsideOfTheFields(2), "loses a number"),
        (Squared, "one weight"),
        (Affine, "not linear"),
        (TooFew, "count_fan_out"),
        (OtherTransform, "make_transform"),
        (NameOfALayer, "the names of a layer"),
        (OtherLargest, "find_largest_weights"),
    ],
)
def test_mistakes_in_an_operation_are_found(mistaken, fact, one_to_one, monkeypatch):
    operation = mistaken()
    monkeypatch.setitem(DEPLOYED_OPERATIONS, "own", type(operation))
    with pytest.raises((AssertionError, ValueError, UserError), match=fact):
        assert_deployed_operation_conforms(operation, (4, 4, 1))


def test_an_operation_that_is_not_registered_is_found(monkeypatch):
    with pytest.raises(AssertionError, match="not entered in OPERATIONS"):
        assert_operation_conforms(OneToOne(), (4, 4, 1))
    monkeypatch.setitem(OPERATIONS, "own", OneToOne)
    with pytest.raises(AssertionError, match="not entered in DEPLOYED_OPERATIONS"):
        assert_operation_conforms(OneToOne(), (4, 4, 1))


@pytest.mark.parametrize(
    ("name", "value", "fact"),
    [
        ("noun", NotatedLayer.noun, "has no 'noun'"),
        ("examples", (), "has no 'examples'"),
        ("examples", ("own", "wrong"), "the example 'wrong' is not in its own notation"),
    ],
)
def test_an_operation_without_words_for_messages_is_found(name, value, fact, one_to_one):
    incomplete = type("Incomplete", (OneToOne,), {name: value})
    with pytest.raises(AssertionError, match=fact):
        assert_operation_conforms(incomplete(), (4, 4, 1))


class Misspelt(OneToOne):
    """Its notation is that of a dense layer."""

    def __str__(self):
        return "9"


@pytest.mark.parametrize("input_shape", [(3, 3, 1), (9,)])
def test_a_notation_that_is_read_differently_is_found(input_shape, one_to_one):
    with pytest.raises(AssertionError, match="read differently"):
        assert_operation_conforms(Misspelt(), input_shape)


@pytest.mark.parametrize("token", ["[0-9]+a", "[0-9]+c[0-9]+", "[0-9]+", "[0-9]+o", "2a|own"])
def test_a_notation_of_other_layers_is_refused(token):
    class Shadow(OneToOne):
        """An operation whose notation is that of another layer."""

    Shadow.token = re.compile(token)
    with pytest.raises(ValueError, match="already"):
        register_operation(Shadow, DeployedOneToOne)
    assert "own" not in OPERATIONS


@pytest.fixture
def unregistered(monkeypatch):
    """Delete at the end what a test registers."""
    for table in (OPERATIONS, DEPLOYED_OPERATIONS):
        delete_at_the_end(monkeypatch, table, "own")


def register_both():
    register_operation(OneToOne, DeployedOneToOne)


def register_deployed():
    register_deployed_operation(DeployedOneToOne)


@pytest.mark.parametrize(
    "registrations",
    [(register_both, register_deployed), (register_deployed, register_both)],
    ids=("both first", "deployed first"),
)
def test_the_halves_of_an_operation_are_registered_in_any_order(registrations, unregistered):
    for register in registrations:
        register()
    assert OPERATIONS["own"] is OneToOne
    assert DEPLOYED_OPERATIONS["own"] is DeployedOneToOne


def test_another_deployed_operation_of_the_same_kind_is_refused(unregistered):
    register_deployed()
    with pytest.raises(ValueError, match="'own': there is one already"):
        register_deployed_operation(Squared)
    with pytest.raises(ValueError, match="'own': there is one already"):
        register_operation(OneToOne, Squared)
    assert "own" not in OPERATIONS
