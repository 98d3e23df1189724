"""Export to Lava: the integers in its units, and every spike in Lava itself."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse

from deploy.errors import UserError
from deploy.files import read_arrays
from deploy.targets.fast import Emulation
from deploy.targets.lava import lava_arrays, spikes_of, write_lava
from deploy.targets.registry import answer
from tests.lava_reader.result import without_refractory_and_floor

from ...lava_reader.result import differing_bits, responses_of
from ..networks import events_spec, paper_spec, random_checks, random_frames, small_spec

ROOT = Path(__file__).parent.parent.parent.parent
READER = ROOT / ".venv-lava" / "bin" / "python"
SKIPPED = "no environment with Lava: 'make setup-lava', which needs Python 3.10"


def decay(x, keep):
    """As Lava writes it: sign(x) * (|x| * keep >> 12)."""
    return np.sign(x) * (np.abs(x) * keep >> 12)


def advanced(arrays):
    """Spikes of each layer from what the file says, step by step in plain integers."""
    description = json.loads(str(arrays["description"]))
    outputs = {}
    for item in description["inputs"]:
        bits = np.unpackbits(arrays[f"spikes.{item['name']}"], axis=2)[:, :, : item["n"]]
        outputs[item["name"]] = bits.astype(np.int64)
    n_samples, period, _ = next(iter(outputs.values())).shape
    found = {
        layer["name"]: np.zeros((n_samples, period, layer["n"]), bool)
        for layer in description["layers"]
    }
    for population in description["populations"]:
        name, n = population["name"], population["n"]
        bias = arrays[f"{name}.bias_mant"].astype(np.int64) << arrays[f"{name}.bias_exp"]
        arriving = np.zeros((n_samples * period, n), np.int64)
        for k, connection in enumerate(population["connections"]):
            source = outputs[connection["source"]].reshape(n_samples * period, -1)
            parts = tuple(arrays[f"{name}.{k}.{part}"] for part in ("data", "indices", "indptr"))
            weights = scipy.sparse.csr_matrix(parts, shape=(n, source.shape[1])).astype(np.int64)
            arriving += (weights @ source.T).T << (6 + connection["weight_exp"])
        spikes = np.zeros((n_samples * period, n), np.int64)
        for step in range(n_samples * period):
            q = arriving[step - 1]
            if step % (period * description["stream_length"]) == 0:
                u = v = waiting = q = np.zeros(n, np.int64)
            u = decay(u, 4095 - population["du"]) + q
            v = decay(v, 4096 - population["dv"]) + u + bias
            v = np.where(waiting > 0, 0, np.maximum(v, population["v_min"]))
            fired = v > population["vth"] * 64
            waiting = np.where(fired, population["refractory"], np.maximum(waiting - 1, 0))
            v = np.where(fired, 0, v)
            spikes[step] = fired
        outputs[name] = spikes.reshape(n_samples, period, n)
        found[population["layer"]][:, :, arrays[f"{name}.places"]] = outputs[name]
    return {name: np.packbits(values, axis=2) for name, values in found.items()}


def samples_for(spec, count):
    """Random images, or frames of events, as the network is shown them."""
    if spec.stimulus.static:
        return random_checks(spec, count).inputs
    return random_frames(spec, count)


@pytest.mark.parametrize("make", [small_spec, lambda: paper_spec(steps=40, gap=5), events_spec])
def test_plain_integers_of_the_file_give_every_spike_of_fast(make):
    spec = make()
    samples = samples_for(spec, 4)
    emulation = Emulation(spec)
    found = advanced(lava_arrays(spec, samples))
    ours = spikes_of(emulation, samples)
    bits = differing_bits(emulation, ours, found)
    on_chip = [layer.name for layer in spec.layers if layer.placement == "chip"]
    assert {name: wrong for name, (wrong, _) in bits.items()} == dict.fromkeys(on_chip, 0)
    assert all(ours[name].any() for name in on_chip)


def blocks_apart():
    """The small network with two blocks of its second layer whose scales are far apart."""
    spec = small_spec()
    weights = spec.layers[1].weights.copy()
    weights[..., 4:] *= 30
    conv2 = replace(spec.layers[1], weights=weights, block_shape=(3, 3, 4))
    return replace(spec, layers=(spec.layers[0], conv2, spec.layers[2]))


def test_blocks_of_different_thresholds_become_populations_of_their_own():
    spec = blocks_apart()
    images = random_checks(spec, 3).inputs
    arrays = lava_arrays(spec, images)
    populations = json.loads(str(arrays["description"]))["populations"]
    assert [p["name"] for p in populations] == ["conv1", "conv2#1", "conv2#2"]
    assert len({p["vth"] for p in populations[1:]}) == 2
    emulation = Emulation(spec)
    found = differing_bits(emulation, spikes_of(emulation, images), advanced(arrays))
    assert found["conv2"][0] == 0


@pytest.mark.parametrize("make", [small_spec, lambda: small_spec(on_chip_output=True), events_spec])
def test_spikes_give_the_answers_of_fast(make):
    spec = make()
    images = samples_for(spec, 7)
    emulation = Emulation(spec)
    ours = responses_of(emulation, spikes_of(emulation, images))
    theirs = answer(spec, images, "fast")
    np.testing.assert_array_equal(ours.spike_hashes, theirs.spike_hashes)
    np.testing.assert_array_equal(ours.decisions, theirs.decisions)
    np.testing.assert_allclose(ours.scores, theirs.scores, rtol=1e-12)


def test_weights_that_do_not_fit_are_refused(monkeypatch):
    import deploy.targets.lava as export

    odd = export.weights_of(Emulation(small_spec()))
    odd.data = odd.data | 1 << 6
    monkeypatch.setattr(export, "weights_of", lambda emulation: odd)
    with pytest.raises(UserError, match=r"layer conv1.* weight"):
        lava_arrays(small_spec(), random_checks(small_spec(), 1).inputs)


def run_lava(network, wanted, *options):
    subprocess.run(
        [str(READER), str(ROOT / "tests" / "lava_reader" / "run_lava.py"), str(network),
         str(wanted), *options],
        check=True, timeout=600,
    )  # fmt: skip
    return {
        name[len("spikes.") :]: array
        for name, array in read_arrays(wanted, "run the test again").items()
        if name.startswith("spikes.")
    }


@pytest.mark.slow
@pytest.mark.skipif(not READER.exists(), reason=SKIPPED)
def test_ten_samples_in_lava(tmp_path):
    spec, sizes = paper_spec(stream_length=5), {"conv1": 294, "conv2": 600}
    compare_with_lava(tmp_path, spec, 10, sizes)


@pytest.mark.slow
@pytest.mark.skipif(not READER.exists(), reason=SKIPPED)
@pytest.mark.parametrize(
    ("make", "sizes"),
    [
        (blocks_apart, {"conv1": 64, "conv2": 72}),
        (lambda: small_spec(on_chip_output=True), {"conv1": 64, "conv2": 72, "output": 10}),
        (events_spec, {x.name: x.size for x in events_spec().layers if x.placement == "chip"}),
    ],
)
def test_other_networks_in_lava(tmp_path, make, sizes):
    compare_with_lava(tmp_path, make(), 3, sizes)


def compare_with_lava(tmp_path, spec, count, sizes):
    images = samples_for(spec, count)
    emulation = Emulation(spec)
    write_lava(tmp_path / "network.npz", spec, images)
    for options, ours in (((), emulation), (("--stock",), without_refractory_and_floor(spec))):
        theirs = run_lava(tmp_path / "network.npz", tmp_path / "out.npz", *options)
        found = differing_bits(emulation, spikes_of(ours, images), theirs)
        bits = count * spec.presentation.period
        assert found == {name: (0, bits * size) for name, size in sizes.items()}
