"""The target ``fast`` against NengoLoihi's emulator."""

from __future__ import annotations

import itertools
import os
import re
import subprocess
import sys
import tracemalloc
import warnings
from dataclasses import replace
from pathlib import Path

import nengo
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, event, given, reject, settings
from hypothesis import strategies as st

from deploy.check.results import read_result
from deploy.check.run import run_check
from deploy.errors import UserError
from deploy.network.build import Relay
from deploy.network.loihi_import import nengo_loihi
from deploy.network.responses import join
from deploy.network.spec import NetworkSpec, Presentation
from deploy.network.stimulus import EventFrames
from deploy.targets import fast
from deploy.targets.fast import kernel_numpy
from deploy.targets.fast.arrays import OVERFLOWS
from deploy.targets.fast.emulation import Emulation, compile_spec, run_fast
from deploy.targets.fast.from_nengo import compile_network
from deploy.targets.registry import run_emulator
from tests.deploy.fast_networks import Watching, images_for, loud_spec, random_spec, reference
from tests.deploy.networks import bundle_at, conv, paper_spec, readout, small_spec

pytest.importorskip("numba")
from deploy.targets.fast import kernel_numba


@pytest.mark.slow
@settings(
    max_examples=40,  # every compartment; of every spike 60 more follow
    deadline=None,
    phases=[Phase.explicit, Phase.reuse, Phase.generate],  # a seed's network has no simpler one
    suppress_health_check=[HealthCheck.too_slow],
)
@given(seed=st.integers(0, 2**32 - 1))
def test_identical_to_the_emulator_in_every_compartment_at_every_step(seed):
    spec = random_spec(seed)
    images = images_for(spec, spec.presentation.stream_length, seed)
    try:
        expected = reference(spec, images)
    except (nengo.exceptions.BuildError, AssertionError):  # NengoLoihi cannot build it
        with pytest.raises(UserError, match="NengoLoihi"):
            quietly(compile_spec, spec)
        reject()
    program = quietly(compile_spec, spec)
    for kernel in ("numba", "numpy"):
        assert_identical(spec, program, images, expected, kernel)
    event(f"overflows: {expected.overflows.any()}")
    event(f"plain: {program.network.is_plain.tolist()}")
    event(f"spikes on the chip: {expected.spiked.any()}")
    event(f"output: {spec.layers[-1].placement}")


@settings(
    max_examples=60,
    deadline=None,
    phases=[Phase.explicit, Phase.reuse, Phase.generate],
    suppress_health_check=[HealthCheck.too_slow],
)
@given(seed=st.integers(0, 2**32 - 1))
def test_every_spike_is_the_emulators_whatever_the_architecture(seed):
    """Strides, padding, averaging, dense layers, blocks, images and events."""
    spec = random_spec(seed)
    samples = images_for(spec, spec.presentation.stream_length, seed)
    try:
        (expected,) = quietly(lambda: list(run_emulator(spec, [samples])))
    except (UserError, AssertionError):  # NengoLoihi cannot build it
        reject()
    kernel = ("numba", "numpy")[seed % 2]
    (answer,) = quietly(lambda: list(run_fast(spec, [samples], kernel=kernel)))
    assert answer.spike_hashes.tolist() == expected.spike_hashes.tolist()
    np.testing.assert_allclose(answer.scores, expected.scores, rtol=1e-12, atol=1e-9)
    assert np.array_equal(answer.decisions, expected.decisions)
    for name, operations in expected.operations.items():
        assert np.array_equal(answer.operations[name], operations)
    event(f"layers: {[layer.kind for layer in spec.layers]}, {spec.stimulus.kind}")


def assert_identical(spec, program, images, expected, kernel):
    presentation, network = spec.presentation, program.network

    # One step a call, to see the state after each.
    emulation = Emulation(program, kernel)
    emulation.kernel = watching = Watching(emulation.kernel)
    by_step = emulation.run(images[None], presentation.steps, presentation.gap, memory=1)
    assert len(watching.log) == len(expected.current)
    for step, state in enumerate(watching.log):
        for name, mine, theirs in (
            ("current", state.current, expected.current),
            ("voltage", state.voltage, expected.voltage),
            ("refractory", state.refractory, expected.refractory),
            ("spikes", state.spikes, expected.spiked),
        ):
            same = np.array_equal(mine[0][network.emulator_order], theirs[step])
            assert same, f"{kernel}: {name} differs after step {step + 1}"

    # All steps of a sample in a call, as the target does.
    watched = []
    whole = Emulation(program, kernel).run(
        images[None], presentation.steps, presentation.gap, watched.append
    )
    np.testing.assert_allclose(whole.output[0], expected.output, rtol=1e-12, atol=1e-9)
    assert set(watched[0]) == set(expected.spikes)
    for name, spikes in expected.spikes.items():
        mine = np.concatenate([packed[name][0] for packed in watched])
        mine = np.unpackbits(mine, axis=1, count=spikes.shape[1])
        assert np.array_equal(mine, spikes), f"{kernel}: spikes of {name} differ"
        per_sample = spikes.reshape(len(images), -1, spikes.shape[1]).sum(axis=1)
        assert np.array_equal(whole.counts[name][0], per_sample)
        if spec.layers[-1].neurons is None or name != "output":
            assert np.array_equal(by_step.counts[name][0], per_sample)
    layer_of = np.empty(network.n, int)
    for index, layer in enumerate(network.layers):
        layer_of[layer.position] = index
    overflows = np.zeros_like(whole.overflows)
    np.add.at(overflows, layer_of[network.emulator_order], expected.overflows)
    assert np.array_equal(whole.overflows, overflows)
    assert np.array_equal(by_step.overflows, overflows)


def quietly(function, *arguments):
    """NengoLoihi warns of weights that lose bits; random networks do little else."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return function(*arguments)


def test_the_papers_network_is_identical_in_all_compartments():
    spec = paper_spec(steps=40, gap=10)
    conv1, conv2, output = spec.layers
    spec = replace(spec, layers=(conv1, replace(conv2, block_shape=(3, 5, 24)), output))
    images = images_for(spec, 2)
    expected = reference(spec, images)
    program = compile_spec(spec)
    assert program.network.is_plain.all()
    for kernel in ("numba", "numpy"):
        assert_identical(spec, program, images, expected, kernel)
    assert all(spikes.any() for spikes in expected.spikes.values())


@pytest.mark.parametrize("kernel", ["numba", "numpy"])
def test_target_answers_like_the_emulator(kernel):
    spec = paper_spec(steps=30, gap=5, readout_start=5, stream_length=2)
    images = images_for(spec, 5)
    streams = [images[:2], images[2:4], images[4:]]
    expected = join(run_emulator(spec, streams))
    answer = join(run_fast(spec, streams, kernel=kernel))
    np.testing.assert_allclose(answer.scores, expected.scores, atol=1e-9, rtol=0)
    assert np.array_equal(answer.decisions, expected.decisions)
    assert answer.spike_hashes.tolist() == expected.spike_hashes.tolist()
    assert list(answer.spikes) == list(expected.spikes)
    for name in expected.spikes:
        assert np.array_equal(answer.spikes[name], expected.spikes[name])
    for name in expected.operations:
        assert np.array_equal(answer.operations[name], expected.operations[name])


@pytest.mark.parametrize("kernel", ["numba", "numpy"])
def test_a_streams_answer_does_not_depend_on_batch_chunk_or_threads(kernel):
    spec = paper_spec(steps=20, gap=5, readout_start=0, stream_length=2)
    images = images_for(spec, 14)
    streams = [images[i : i + 2] for i in range(0, 14, 2)]
    alone = [next(iter(run_fast(spec, [stream], kernel=kernel))) for stream in streams]
    for options in ({}, {"threads": 3}, {"memory": 60_000}, {"memory": 1, "threads": 2}):
        together = list(run_fast(spec, streams, kernel=kernel, **options))
        assert len(together) == len(streams)
        for a, b in zip(alone, together, strict=True):
            assert np.array_equal(a.scores, b.scores)
            assert np.array_equal(a.decisions, b.decisions)
            assert all(np.array_equal(a.spikes[name], b.spikes[name]) for name in a.spikes)


def test_both_kernels_decode_to_the_last_bit():
    program = compile_spec(paper_spec())
    images = images_for(paper_spec(), 3)[None]
    numba, numpy = (Emulation(program, k).run(images, 30, 5).output for k in ("numba", "numpy"))
    assert np.array_equal(numba, numpy)


def test_streams_of_unlike_length_come_back_in_order():
    spec = paper_spec(steps=10, gap=0, readout_start=0)
    images = images_for(spec, 9)
    streams = [images[:1], images[1:4], images[4:7], images[7:]]
    answers = list(run_fast(spec, iter(streams)))
    assert [len(answer.scores) for answer in answers] == [1, 3, 3, 2]
    for stream, answer in zip(streams, answers, strict=True):
        assert np.array_equal(answer.scores, next(run_fast(spec, [stream])).scores)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("filters", "kinds"), [(8, ["q0"]), (3, ["current", "u2"])])
def test_overflows_are_identical_counted_and_warned_of_by_layer(filters, kinds, sign):
    spec = loud_spec(filters, sign)
    images = np.ones((1, 36))
    expected = reference(spec, images)
    totals = dict(zip(OVERFLOWS, expected.overflows.sum(axis=0), strict=True))
    assert set(kinds) <= {kind for kind, n in totals.items() if n}
    told = ", ".join(f"{n} in {kind}" for kind, n in totals.items() if n)
    program = quietly(compile_spec, spec)
    for kernel in ("numba", "numpy"):
        assert_identical(spec, program, images, expected, kernel)
        with pytest.warns(RuntimeWarning, match=f"layer 'output': .*: {told}"):
            list(run_fast(spec, [images], kernel=kernel))


def test_streams_are_taken_as_memory_allows():
    spec = paper_spec(steps=10, gap=0, readout_start=0)
    images, taken = images_for(spec, 1), []
    endless = (taken.append(i) or images for i in itertools.count())
    memory = 3 * 10 * 1300  # three streams of ten steps and their answers
    answers = run_fast(spec, endless, kernel="numba", memory=memory)
    for _ in range(4):
        next(answers)
    answers.close()
    assert 4 <= len(taken) <= 12


def test_a_copied_bundle_runs_it_without_numba(tmp_path):
    bundle = bundle_at(tmp_path / "bundle", small_spec(), 4)
    (tmp_path / "without").mkdir()
    (tmp_path / "without" / "numba.py").write_text("raise ImportError('not here')")
    subprocess.run(
        [sys.executable, "deploy.pyz", "check", ".", "--target", "fast"],
        cwd=bundle.path, check=True, capture_output=True, timeout=300,
        env={**os.environ, "PYTHONPATH": str(tmp_path / "without")},
    )  # fmt: skip
    fast = read_result(bundle.path / "checks" / "fast.json")
    emulator = run_check(bundle, "emulator", tmp_path / "emulator.json")
    assert set(fast) == set(emulator)
    assert fast["spikes"] == emulator["spikes"]
    for mine, theirs in zip(fast["samples"], emulator["samples"], strict=True):
        assert set(mine) == set(theirs)
        assert mine["spike_hash"] == theirs["spike_hash"]
        assert mine["prediction"] == theirs["prediction"]


def test_no_warning_without_overflows(recwarn):
    list(run_fast(paper_spec(steps=5, gap=0, readout_start=0), [images_for(paper_spec(), 1)]))
    assert not [w for w in recwarn if issubclass(w.category, RuntimeWarning)]


def test_silence_gives_zeros():
    spec = paper_spec(steps=5, gap=0, readout_start=0)
    silent = [replace(layer, bias=np.zeros_like(layer.bias)) for layer in spec.layers]
    (answer,) = run_fast(replace(spec, layers=silent), [np.zeros((2, 100))])
    assert not answer.scores.any()
    assert not any(spikes.any() for spikes in answer.spikes.values())


def test_decay_by_hand():
    x = np.array([0, 1, -1, 4095, -4095, 4096, -4097, 2**23 - 1, -(2**23)])
    decayed = x.astype(float)
    kernel_numpy._decay(decayed, 3354 / 4096)
    assert decayed.tolist() == [int(np.sign(v)) * (abs(int(v)) * 3354 // 4096) for v in x]


@pytest.mark.parametrize("lose", [1, 200, 481, 4000])
def test_plain_arithmetic_up_to_where_it_is_exact(lose):
    largest = (2**31 - 4096) // lose - 1
    x = np.array([0, 1, 4095, 4096, 4097, largest - 1, largest], np.int32)
    u, v = np.concatenate([-x, x]), x.copy()
    kernel_numba._plain_currents(np.int32(lose), np.int32(2), np.ones(14, np.int16), u)
    kept = [a * (4096 - lose) // 4096 for a in x.tolist()]
    assert u.tolist() == [2 - a for a in kept] + [2 + a for a in kept]
    zero = np.zeros(7, np.int32)
    kernel_numba._plain_voltages(np.int32(lose), np.int32(0), zero, zero, v)
    assert v.tolist() == kept


def test_a_segment_is_plain_only_where_that_gives_the_same():
    network = compile_spec(paper_spec()).network
    bounds = network.segments
    assert network.is_plain.all()
    for changed in (
        {"v_min": np.full_like(bounds.v_min, -1)},
        {"v_max": network.largest_inputs.astype(np.int32)},
        {"keep_u": np.ones_like(bounds.keep_u), "shift": bounds.shift + 3},
        {"keep_v": np.ones_like(bounds.keep_v), "shift": bounds.shift},
    ):
        segments = bounds._replace(**changed)
        threshold = np.maximum(network.threshold, 2**20)
        other = replace(network, segments=segments, threshold=threshold)
        assert not other.is_plain.any(), changed
    loud = replace(network, bias=np.full_like(network.bias, 2**23))
    assert not loud.is_plain.any()


def test_wrap_by_hand():
    x = np.array([0, 7, 8, -8, -9, 23, 24.0])
    assert kernel_numpy._wrap(x, 3) == 4
    assert x.tolist() == [0, 7, -8, -8, 7, 7, -8]


def test_unknown_kernel():
    with pytest.raises(UserError, match=r"'cuda'.* numba, numpy"):
        next(run_fast(paper_spec(), [np.zeros((1, 100))], kernel="cuda"))


# --- what it refuses --------------------------------------------------------------------------


def small_network(**changes):
    """Node -> host spikes -> chip -> node, and what a test changes in it."""
    with nengo.Network(seed=0) as network:
        nengo_loihi.add_params(network)
        source = nengo.Node(np.zeros(4), label="pixels")
        encoder = nengo.Ensemble(
            4, 1, neuron_type=changes.get("encoder", nengo.SpikingRectifiedLinear()),
            gain=np.ones(4), bias=changes.get("bias", np.zeros(4)), label="input",
        )  # fmt: skip
        network.config[encoder].on_chip = False
        nengo.Connection(source, encoder.neurons, transform=changes.get("drive", 1), synapse=None)
        chip = nengo.Ensemble(
            4, 1, neuron_type=nengo.LIF(), gain=np.ones(4), bias=np.ones(4), label="chip"
        )
        nengo.Connection(encoder.neurons, chip.neurons, transform=np.eye(4), synapse=0.005)
        sink = nengo.Node(changes.get("sink"), size_in=2, label="sink")
        nengo.Connection(
            chip.neurons, sink, transform=np.ones((2, 4)), synapse=changes.get("synapse", 0.005)
        )
        output = nengo.Probe(sink, synapse=changes.get("probe"))
    return network, source, encoder, chip, sink, output


def refusal(parts):
    with pytest.raises(UserError, match=r"'fast'.*'emulator'") as raised:
        compile_network(parts[0], parts[1], parts[-1])
    return str(raised.value)


def test_compiles_a_network_of_ones_own():
    network, source, *_, output = small_network()
    before = source.output
    program = compile_network(network, source, output)
    assert program.network.n == 4
    assert np.array_equal(source.output, before)


@pytest.mark.parametrize(
    ("drive", "bias", "relays"),
    [
        (np.diag([0.1, 1.0, 2.0, 3e9]), 0, True),
        (np.diag([1.0, 1.0, 1.0, 0.0]), 0, False),
        (np.diag([1.0, 1.0, 1.0, -1.0]), 0, False),
        (np.eye(4)[[1, 0, 2, 3]], 0, False),
        (np.eye(4) + np.eye(4, k=3) * 1e-12, 0, False),
        (np.eye(4) + [[0, 1, 0, -1], [0] * 4, [0] * 4, [0] * 4], 0, False),
        (np.eye(4), 1e-12, False),
        (np.eye(4), -0.5, False),
    ],
)
def test_an_input_relays_only_what_its_own_pixel_alone_decides(drive, bias, relays):
    network, source, *_, output = small_network(
        encoder=Relay(), drive=drive, bias=np.array([0, 0, bias, 0])
    )
    assert compile_network(network, source, output).relays is relays


def test_memory_grows_with_the_sensor_not_with_its_square():
    rng = np.random.default_rng(0)
    first = conv("conv1", (40, 40, 2), 1, 8, rng, stride=8)
    layers = (first, readout(first.shape, rng))
    shape = Presentation(steps=10, readout_start=0)
    spec = NetworkSpec("40x40x2-1c8s8-10o", (40, 40, 2), EventFrames(), layers, shape)
    tracemalloc.start()
    try:
        assert compile_spec(spec).relays
        assert tracemalloc.get_traced_memory()[1] < 8 * (40 * 40 * 2) ** 2 / 2
    finally:
        tracemalloc.stop()


def learn(encoder, chip, sink):
    ensemble = nengo.Ensemble(20, 1, neuron_type=nengo.LIF(), label="learner")
    target = nengo.Node(size_in=1)
    error = nengo.Node(size_in=1)
    nengo.Connection(target, error)
    connection = nengo.Connection(ensemble, target, learning_rule_type=nengo.PES())
    nengo.Connection(error, connection.learning_rule)


# By a fact that the refusal names.
REFUSED = {
    "learning": learn,
    "feedback": lambda encoder, chip, sink: nengo.Connection(
        sink, encoder.neurons, transform=np.ones((4, 2)), synapse=0.01
    ),
    "connections": lambda encoder, chip, sink: nengo.Connection(
        chip.neurons, chip.neurons, transform=0.1 * np.eye(4), synapse=0.005
    ),
    "input neurons": lambda encoder, chip, sink: nengo.Connection(
        encoder.neurons, encoder.neurons, transform=0.1, synapse=None
    ),
    # Voltages that the emulator would wrap.
    "32 bits": lambda encoder, chip, sink: setattr(
        chip, "neuron_type", nengo.LIF(tau_rc=3.0, min_voltage=-1e9)
    ),
}


@pytest.mark.parametrize("named", REFUSED)
def test_refuses_what_is_added(named):
    network, source, *parts, output = small_network()
    with network:
        REFUSED[named](*parts)
    assert named in refusal((network, source, output))


def test_refuses_noise():
    network, source, _, chip, _, output = small_network()
    build = nengo_loihi.builder.Model.build

    def noisy(model, obj, *args, **kwargs):
        built = build(model, obj, *args, **kwargs)
        if obj is chip:
            model.objs[chip]["in"].compartment.enable_noise[:] = True
        return built

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nengo_loihi.builder.Model, "build", noisy)
        assert "noise" in refusal((network, source, output))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"encoder": nengo.PoissonSpiking(nengo.LIFRate())}, "PoissonSpiking"),
        ({"synapse": nengo.Alpha(0.005)}, "Alpha"),
        ({"sink": lambda t, x: x**2}, "function"),
        ({"probe": 0.01}, "filter"),
    ],
)
def test_refuses_by_name(changes, named):
    parts = small_network(**changes)
    assert named in refusal((parts[0], parts[1], parts[-1]))


def test_refuses_an_output_decoded_on_the_chip():
    network, source, _, chip, *_ = small_network()
    with network:
        output = nengo.Probe(chip)
    assert "output" in refusal((network, source, output))


def test_says_what_nengo_loihi_cannot_build():
    with nengo.Network(seed=0) as network:
        nengo_loihi.add_params(network)
        source = nengo.Node(np.zeros(2))
        sink = nengo.Node(size_in=2)
        nengo.Connection(source, sink)
        output = nengo.Probe(sink)
    with pytest.raises(UserError, match=r"NengoLoihi.*No neurons"):
        compile_network(network, source, output)


def test_the_packages_description_names_its_modules():
    described = set(re.findall(r"``(\w+)``", fast.__doc__)) - {"fast"}
    there = {path.stem for path in Path(fast.__file__).parent.glob("*.py")}
    assert described == there - {"__init__", "wiring"}  # which is of one kernel
