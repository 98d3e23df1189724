"""The operations and targets of this package conform, and mistakes in new ones are found."""

import json
import math
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from deploy.conformance.operations import assert_deployed_operation_conforms
from deploy.conformance.targets import (
    assert_output_forms,
    assert_target_conforms,
    make_unfit_network,
)
from deploy.errors import UserError
from deploy.network.ops import DEPLOYED_OPERATIONS
from deploy.network.output import TargetOutput
from deploy.network.reference import run_reference
from deploy.targets.registry import REAL_NUMBERS, TARGETS, Target, run_target
from models.conformance import assert_operation_conforms
from models.ops import OPERATIONS, Convolution, Dense, NotatedLayer, register_operation
from tests.deploy.networks import bundle_at
from tests.test_extensions import DeployedOneToOne, FirstOptions, OneToOne, run_first_class


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


# A target without Nengo.
REFERENCE = Target("reference", run_reference, "The equations", tolerance=REAL_NUMBERS)

# Every registered target that needs no board.
SIMULATORS = [target for target in TARGETS.values() if not target.needs_board]


@pytest.mark.parametrize("target", [REFERENCE, *SIMULATORS], ids=lambda target: target.name)
def test_targets_conform(target):
    assert_target_conforms(target)


def test_a_target_that_runs_an_unfit_network_is_found():
    target = replace(REFERENCE, refuses_unfit_itself=True)
    with pytest.raises(AssertionError, match="leave out refuses_unfit_itself"):
        assert_target_conforms(target)


def test_a_target_refuses_an_unfit_network_by_default(monkeypatch):
    monkeypatch.setitem(TARGETS, "reference", REFERENCE)
    spec = make_unfit_network()
    images = np.zeros((1, *spec.input_shape))
    with pytest.raises(UserError, match="17 bits"):
        run_target(spec, images, "reference")


def round_weights(layer, n_bits):
    step = np.abs(layer.weights).max() / (2 ** (n_bits - 1) - 1)
    return replace(layer, weights=step * np.rint(layer.weights / step))


@pytest.mark.parametrize("n_bits", [8, 10, 12, 16])
def test_targets_with_rounded_weights_conform(n_bits):
    def run(spec, streams, seed, options):
        layers = tuple(round_weights(layer, n_bits) for layer in spec.layers)
        return run_reference(replace(spec, layers=layers), streams)

    assert_target_conforms(Target("coarse", run, "Rounded weights"))
    with pytest.raises(AssertionError, match="the tolerance 1e-06 of the target; most at sample"):
        assert_target_conforms(Target("coarse", run, "Rounded weights", tolerance=REAL_NUMBERS))


def test_a_target_without_the_network_conforms_in_its_form():
    target = Target("first", run_first_class, "The first", options=FirstOptions)
    assert_output_forms(target)
    with pytest.raises(AssertionError, match="differs"):
        assert_target_conforms(target)


WITHOUT_NENGO = """
import sys
from pathlib import Path


class Bar:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("nengo", "nengo_loihi", "nengo_dl", "tensorflow"):
            raise ImportError(name)


sys.meta_path.insert(0, Bar())
from deploy.check.bundle import read_bundle
from deploy.check.run import run_check
from deploy.network.reference import run_reference
from deploy.targets.registry import TARGETS, Target

TARGETS["reference"] = Target("reference", run_reference, "The equations in NumPy")
run_check(read_bundle(Path(sys.argv[1])), "reference", Path(sys.argv[2]))
"""


def test_a_check_on_a_target_without_nengo_needs_no_nengo(tmp_path):
    bundle_at(tmp_path / "bundle")
    command = [sys.executable, "-c", WITHOUT_NENGO, tmp_path / "bundle", tmp_path / "result.json"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert json.loads((tmp_path / "result.json").read_text())["target"] == "reference"
    assert "it was not tested whether the network fits" in done.stderr


def run_without_gaps(spec, streams, seed, options):
    """Yield the readout of the gaps, too."""
    for output in run_reference(spec, streams):
        readout = np.pad(output.readout, ((0, 0), (spec.presentation.gap, 0), (0, 0)))
        yield replace(output, readout=readout)


def run_in_one_stream(spec, streams, seed, options):
    """Present all streams to one network."""
    (together,) = run_reference(spec, [np.concatenate(streams)])
    begin = 0
    for stream in streams:
        end = begin + len(stream)
        yield TargetOutput(together.readout[begin:end])
        begin = end


def run_only_first(spec, streams, seed, options):
    return run_reference(spec, streams[:1])


def change_readout(change):
    """A target whose readout is that of the reference, changed."""

    def run(spec, streams, seed, options):
        for output in run_reference(spec, streams):
            yield replace(output, readout=change(output.readout))

    return run


def run_with_more_spikes(spec, streams, seed, options):
    for output in run_reference(spec, streams):
        more = {name: spikes + (name != "input") for name, spikes in output.spikes.items()}
        yield replace(output, spikes=more)


def run_ones_on_events(spec, streams, seed, options):
    for output in run_reference(spec, streams):
        is_static = spec.stimulus.is_static
        yield output if is_static else replace(output, readout=np.ones_like(output.readout))


def run_first_section(spec, streams, seed, options):
    """Compute the readout with the weights of the first section only."""
    for output in run_reference(spec, streams):
        yield replace(output, readout=output.readout[..., : spec.layers[-1].size])


def run_without_output_neurons(spec, streams, seed, options):
    for output in run_reference(spec, streams):
        is_on_chip = spec.layers[-1].neurons is not None
        yield TargetOutput(np.zeros_like(output.readout)) if is_on_chip else output


def run_without_recurrence(spec, streams, seed, options):
    layers = tuple(replace(layer, recurrent=None) for layer in spec.layers)
    for output in run_reference(replace(spec, layers=layers), streams):
        yield replace(output, spikes=None)


def run_with_exchanged_recurrence(spec, streams, seed, options):
    """Exchange the sending and the receiving neurons."""
    layers = tuple(
        layer if layer.recurrent is None else replace(layer, recurrent=layer.recurrent.T)
        for layer in spec.layers
    )
    return run_reference(replace(spec, layers=layers), streams)


def run_fresh_for_every_sample(spec, streams, seed, options):
    for samples in streams:
        alone = [next(run_reference(spec, [sample[None]])) for sample in samples]
        yield TargetOutput(np.concatenate([output.readout for output in alone]))


@pytest.mark.parametrize(
    ("run", "fact"),
    [
        (run_ones_on_events, "a network on events: the readout differs"),
        (run_first_section, "a readout in sections: the readout differs"),
        (run_without_output_neurons, "output neurons: the readout differs"),
        (run_without_recurrence, "recurrent neurons: the readout differs"),
        (run_with_exchanged_recurrence, "recurrent neurons: the readout differs"),
        (run_fresh_for_every_sample, "differs .* most at quarter of the steps 0"),
        (change_readout(np.zeros_like), "differs"),
        (change_readout(np.negative), "differs"),
        (change_readout(lambda readout: readout[:, ::-1]), "differs"),
        (change_readout(lambda readout: readout[:, :, ::-1]), "differs"),
        (run_with_more_spikes, "number of spikes of 'conv1' differs"),
        (run_without_gaps, "'mine': readout of shape"),
        (run_in_one_stream, "streams before it"),
        (run_only_first, "1 outputs of 2 streams"),
    ],
)
def test_mistakes_in_a_target_are_found(run, fact):
    with pytest.raises((AssertionError, ValueError), match=fact):
        assert_target_conforms(Target("mine", run, "Mistaken"))
