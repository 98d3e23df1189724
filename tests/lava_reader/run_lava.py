"""Run the chip's part of a bundle in Lava: ``run_lava.py NETWORK.npz OUTPUT.npz [--stock]``.

It knows nothing of this project but the file that ``stmnist deploy export --format lava`` wrote
(see ``lava`` in this project's package ``deploy.targets``).  Out go ``spikes.<layer>``, uint8 of
shape (n_samples, period, n / 8), and ``seconds``.  With ``--stock`` the neurons are Lava's own LIF,
which knows no refractory steps and no lower bound of the voltage.

Lava looks for models by executing every module in the folder of a process: those of ours are in a
folder of their own, and what runs here is guarded.
"""

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from lava.magma.core.run_conditions import RunSteps
from lava.magma.core.run_configs import Loihi2SimCfg
from lava.proc.io.source import RingBuffer
from lava.proc.lif.process import LIF
from lava.proc.sparse.process import Sparse
from scipy.sparse import csr_matrix

sys.path.insert(0, str(Path(__file__).parent / "processes"))
from loihi_lif import LoihiLIF
from recorder import Recorder


def main(network, wanted, stock=False):
    with np.load(network, allow_pickle=False) as archive:
        given = {name: archive[name] for name in archive.files}
    description = json.loads(str(given["description"]))
    period, at_once = description["period"], description["stream_length"]
    n_samples = len(given[f"spikes.{description['inputs'][0]['name']}"])
    spikes = {layer["name"]: [] for layer in description["layers"]}
    begun = time.perf_counter()
    for first in range(0, n_samples, at_once):
        count = min(at_once, n_samples - first)
        for name, packed in stream(description, given, first, count, stock).items():
            spikes[name].append(packed.reshape(count, period, -1))
        if sys.stderr.isatty():
            print(f"\rLava: {first + count} of {n_samples} samples", end="", file=sys.stderr)
    if sys.stderr.isatty():
        print(file=sys.stderr)
    found = {f"spikes.{name}": np.concatenate(parts) for name, parts in spikes.items()}
    np.savez_compressed(wanted, seconds=time.perf_counter() - begun, **found)


def stream(description, given, first, count, stock):
    """Some samples, one after the other, through a fresh network."""
    steps = count * description["period"]
    outputs, lifs = {}, []
    for item in description["inputs"]:
        packed = given[f"spikes.{item['name']}"][first : first + count]
        rows = np.unpackbits(packed.reshape(steps, -1), axis=1)[:, : item["n"]]
        outputs[item["name"]] = RingBuffer(data=rows.T.astype(np.int32)).s_out
    for population in description["populations"]:
        name, lif = population["name"], neurons(population, given, stock)
        for k, connection in enumerate(population["connections"]):
            source = outputs[connection["source"]]
            parts = tuple(given[f"{name}.{k}.{part}"] for part in ("data", "indices", "indptr"))
            weights = csr_matrix(parts, shape=(population["n"], source.shape[0]))
            sparse = Sparse(
                weights=weights.astype(np.int32),
                weight_exp=connection["weight_exp"],
                num_weight_bits=8,
            )
            source.connect(sparse.s_in)
            sparse.a_out.connect(lif.a_in)
        outputs[name] = lif.s_out
        lifs.append(lif)
    spikes = {
        layer["name"]: np.zeros((steps, layer["n"]), np.uint8) for layer in description["layers"]
    }
    with tempfile.TemporaryDirectory() as folder:
        paths = [str(Path(folder) / f"{k}.npy") for k in range(len(lifs))]
        for lif, path in zip(lifs, paths, strict=True):
            lif.s_out.connect(Recorder(shape=lif.s_out.shape, steps=steps, path=path).a_in)
        lifs[-1].run(RunSteps(num_steps=steps), Loihi2SimCfg(select_tag="fixed_pt"))
        lifs[-1].stop()
        for population, path in zip(description["populations"], paths, strict=True):
            bits = np.unpackbits(np.load(path), axis=1)[:, : population["n"]]
            spikes[population["layer"]][:, given[f"{population['name']}.places"]] = bits
    return {name: np.packbits(bits, axis=1) for name, bits in spikes.items()}


def neurons(population, given, stock):
    """A population's neurons."""
    common = {name: population[name] for name in ("du", "dv", "vth")}
    common["shape"] = (population["n"],)
    for part in ("bias_mant", "bias_exp"):
        common[part] = given[f"{population['name']}.{part}"]
    if stock:
        return LIF(**common)
    return LoihiLIF(refractory=population["refractory"], v_min=population["v_min"], **common)


if __name__ == "__main__":
    arguments = [a for a in sys.argv[1:] if a != "--stock"]
    main(*arguments, stock="--stock" in sys.argv)
