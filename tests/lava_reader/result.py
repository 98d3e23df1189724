"""Compare every spike of Lava's with ``fast``, and make a check result of what Lava answered.

``python -m tests.lava_reader.result BUNDLE OUTPUT.npz RESULT.json [STOCK.npz]``

OUTPUT holds the network's spikes as deployed, STOCK those of Lava's own LIF, which are compared
with ``fast`` without refractory steps and without a lower bound of the voltage.  One spike that is
not the same ends in status 1.
"""

import sys
from dataclasses import replace

import numpy as np

from deploy.check.bundle import read_bundle
from deploy.check.results import result_of
from deploy.check.run import records_of
from deploy.errors import CheckFailed, UserError
from deploy.files import read_arrays, write_json
from deploy.network.responses import join, read_output, spike_hash
from deploy.targets.fast import Emulation, Readout
from deploy.targets.lava import LARGEST, spikes_of

REMEDY = "run 'make check-lava' again"


def without_refractory_and_floor(spec) -> Emulation:
    """The network with Lava's standard neurons, without refractory period and lower bound."""
    emulation = Emulation(spec)
    emulation.chip.set_constants(refractory=0, v_min=-LARGEST)
    return emulation


def differing_bits(emulation, ours, theirs) -> dict:
    """How many spikes of each layer on the chip are not the same.

    Parameters
    ----------
    emulation : Emulation
    ours, theirs : dict of str to uint8 ndarray, shape (n_samples, period, n / 8)
        Spikes, eight neurons a byte.

    Returns
    -------
    dict of str to (int, int)
        Bits that differ, and all bits.
    """
    found = {}
    for name, position in emulation.positions.items():
        n, a, b = len(position), ours[name], theirs[name]
        if a.shape != b.shape:
            raise UserError(f"layer {name}: {b.shape} spikes, not {a.shape}; {REMEDY}")
        differ = np.unpackbits(a ^ b, axis=2)[:, :, :n]
        found[name] = int(differ.sum()), differ.size
    return found


def responses_of(emulation, spikes):
    """A target's responses from the spikes of its populations.

    Parameters
    ----------
    emulation : Emulation
    spikes : dict of str to uint8 ndarray, shape (n_samples, period, n / 8)
    """
    spec, parts = emulation.spec, []
    sizes = {"input": int(np.prod(spec.input_shape))}
    sizes.update({name: len(position) for name, position in emulation.positions.items()})
    plain = {n: np.unpackbits(spikes[n], axis=2)[:, :, :size] for n, size in sizes.items()}
    for part in spec.presentation.streams(len(next(iter(plain.values())))):
        readout = Readout(spec.layers[-1], 1, emulation.decoders.shape[1])
        rows, output = {name: values[part] for name, values in plain.items()}, []
        for index in range(part.stop - part.start):
            chip = np.zeros((1, spec.presentation.period, emulation.chip.n), np.uint8)
            for name, position in emulation.positions.items():
                chip[0][:, position] = rows[name][index]
            output.append(readout.advance(chip @ emulation.decoders)[0])
        counts = {name: rows[name].sum(axis=1, dtype=int) for name in spec.spiking_layers}
        hashes = [
            spike_hash(np.packbits(rows[name][i], axis=1) for name in spec.spiking_layers)
            for i in range(part.stop - part.start)
        ]
        answered = read_output(spec, np.array(output)[:, spec.presentation.gap :], counts)
        parts.append(replace(answered, spike_hashes=np.array(hashes)))
    return join(parts)


def _spikes(given):
    return {name[len("spikes.") :]: a for name, a in given.items() if name.startswith("spikes.")}


def compared(title, opened, emulation, theirs):
    """Say how many bits differ, layer by layer, and give the responses to Lava's spikes."""
    labels = opened.checks.labels
    ours = spikes_of(emulation, opened.checks.inputs)
    found = differing_bits(emulation, ours, theirs)
    answers = responses_of(emulation, {**ours, **theirs})
    wrong, total = (sum(column) for column in zip(*found.values(), strict=True))
    layers = ", ".join(
        f"{name} {answers.spikes[name].sum()} spikes, {bits} bits differ"
        for name, (bits, _) in found.items()
    )
    print(
        f"{title}: {wrong} of {total} spike bits differ from fast ({layers}); accuracy "
        f"{np.mean(answers.predictions == labels):.3f} on {len(labels)} samples"
    )
    return wrong, answers


def main(bundle, output, out, stock=None):
    opened = read_bundle(bundle)
    emulation = Emulation(opened.spec)
    given = read_arrays(output, REMEDY)
    wrong, answers = compared("Lava as deployed", opened, emulation, _spikes(given))
    samples = records_of(opened.checks, answers)
    write_json(out, result_of(opened, "lava", 0, samples, float(given["seconds"])))
    if stock is not None:
        free = without_refractory_and_floor(opened.spec)
        title = "Lava's own LIF, no refractory time, no floor"
        wrong += compared(title, opened, free, _spikes(read_arrays(stock, REMEDY)))[0]
    if wrong:
        raise CheckFailed(f"{wrong} spikes of Lava's are not those of fast")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except CheckFailed as error:
        sys.exit(f"check-lava: {error}")
