"""The target ``fast`` against NengoLoihi's emulator."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, event, given, reject, settings
from hypothesis import strategies as st

from deploy.conformance.networks import make_image_network
from deploy.errors import UserError
from deploy.network.responses import join_responses, make_responses
from deploy.targets.emulation import Emulation
from deploy.targets.fast import OVERFLOWS, run_fast, run_in_batches
from deploy.targets.simulators import run_emulator
from tests.deploy.fast_networks import images_for, loud_spec, overflows_of, random_spec
from tests.deploy.networks import bundle_at, make_paper_network


def answers(spec, outputs, streams):
    """The responses to each stream, of the outputs of a target."""
    pairs = zip(outputs, streams, strict=True)
    return [make_responses(spec, output, len(stream), "tried") for output, stream in pairs]


def assert_same(found, expected, atol=1e-9):
    """Equal spikes, counts, operations and decisions; scores to the last digits."""
    assert found.spike_hashes.tolist() == expected.spike_hashes.tolist()
    np.testing.assert_allclose(found.scores, expected.scores, rtol=1e-12, atol=atol)
    assert np.array_equal(found.decisions, expected.decisions)
    for result, reference in (
        (found.spikes, expected.spikes),
        (found.operations, expected.operations),
    ):
        assert list(result) == list(reference)
        for name, values in reference.items():
            assert np.array_equal(result[name], values), name


@settings(
    max_examples=30,
    deadline=None,
    phases=[Phase.explicit, Phase.reuse, Phase.generate],  # a seed's network has no simpler one
    suppress_health_check=[HealthCheck.too_slow],
)
@given(seed=st.integers(0, 2**32 - 1))
def test_answers_are_identical_to_the_emulators_on_random_networks(seed):
    """Strides, padding, averaging, blocks, images and events, gaps, readout on host and chip."""
    spec = random_spec(seed)
    samples = images_for(spec, 3, seed)
    streams = [samples[:2], samples[2:]] if seed % 2 else [samples[:1], samples[1:2]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NengoLoihi warns of weights that lose bits
        try:
            expected = answers(spec, run_emulator(spec, streams), streams)
        except (UserError, AssertionError):  # NengoLoihi cannot build it
            with pytest.raises(UserError, match="NengoLoihi"):
                Emulation(spec)
            reject()
        outputs = run_in_batches(spec, streams, 0, (1, 32 << 20)[seed % 2])
        result = answers(spec, outputs, streams)
    for actual, reference in zip(result, expected, strict=True):
        assert_same(actual, reference)
    event(f"layers: {[layer.kind for layer in spec.layers]}, {spec.stimulus.kind}")
    event(f"readout: {spec.layers[-1].placement}")


def test_the_papers_network_answers_like_the_emulator():
    spec = make_paper_network(steps=30, gap=5, readout_start=5, stream_length=2)
    conv1, conv2, output = spec.layers
    spec = replace(spec, layers=(conv1, replace(conv2, block_shape=(3, 5, 24)), output))
    images = images_for(spec, 5)
    streams = [images[:2], images[2:4], images[4:]]
    result = join_responses(answers(spec, run_fast(spec, streams), streams))
    assert_same(result, join_responses(answers(spec, run_emulator(spec, streams), streams)))
    assert all(spikes.all() for spikes in result.spikes.values())


def test_a_streams_answer_does_not_depend_on_others_or_on_memory():
    spec = make_paper_network(steps=20, gap=5, readout_start=0)
    images = images_for(spec, 9)
    streams = [images[:2], images[2:4], images[4:7], images[7:8], images[8:]]
    alone = [answers(spec, run_fast(spec, [stream]), [stream])[0] for stream in streams]
    for memory in (1, 60_000, 32 << 20):
        together = answers(spec, run_in_batches(spec, iter(streams), 0, memory), streams)
        assert [len(answer.scores) for answer in together] == [2, 2, 3, 1, 1]
        for result, expected in zip(together, alone, strict=True):
            assert_same(result, expected, atol=0)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("filters", "kinds"), [(8, ["q0"]), (3, ["current", "u2"])])
def test_overflows_are_counted_and_warned_of_by_layer(filters, kinds, sign):
    spec = loud_spec(filters, sign)
    images = np.ones((1, 36))
    counts = dict(zip(OVERFLOWS, overflows_of(spec, images).tolist(), strict=True))
    assert set(kinds) <= {kind for kind, n in counts.items() if n}
    told = ", ".join(f"{n} in {kind}" for kind, n in counts.items() if n)
    with pytest.warns(RuntimeWarning, match=f"layer 'output': .*: {told}"):
        list(run_fast(spec, [images]))


def test_silence_gives_zeros():
    spec = make_paper_network(steps=5, gap=0, readout_start=0)
    silent = [replace(layer, bias=np.zeros_like(layer.bias)) for layer in spec.layers]
    (answer,) = run_fast(replace(spec, layers=silent), [np.zeros((2, 100))])
    assert not answer.readout.any()
    assert not any(spikes.any() for spikes in answer.spikes.values())


def test_a_copied_bundle_says_how_to_install_numba(tmp_path):
    bundle = bundle_at(tmp_path / "bundle", make_image_network(), 4)
    (tmp_path / "without").mkdir()
    (tmp_path / "without" / "numba.py").write_text("raise ImportError('not here')")
    done = subprocess.run(
        [sys.executable, "deploy.pyz", "check", ".", "--target", "fast"],
        cwd=bundle.path, capture_output=True, text=True, timeout=300,
        env={**os.environ, "PYTHONPATH": str(tmp_path / "without")},
    )  # fmt: skip
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert "pip install numba" in line
