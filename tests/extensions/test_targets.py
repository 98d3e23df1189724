"""The targets of this package conform, and mistakes in new ones are found."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from deploy.conformance.targets import (
    assert_output_forms,
    assert_target_conforms,
    make_unfit_network,
)
from deploy.errors import UserError
from deploy.network.output import TargetOutput
from deploy.network.reference import run_reference
from deploy.targets.registry import REAL_NUMBERS, TARGETS, Target, run_target
from tests.deploy.networks import bundle_at
from tests.extensions.test_from_outside import (
    FirstOptions,
    run_first_class,
)

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


@pytest.mark.parametrize("n_bits", [8, 16])
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
