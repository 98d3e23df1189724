"""Random models straight as blocks: what NengoLoihi's builder makes of networks, and what it never
does, such as overflows, scattered and repeated indices, and noise anywhere."""

from __future__ import annotations

import numpy as np
from nengo_loihi.block import Axon, LoihiBlock, Synapse
from nengo_loihi.builder import Model
from nengo_loihi.builder.discretize import discretize_model
from nengo_loihi.inputs import SpikeInput
from nengo_loihi.probe import LoihiProbe


def random_model(seed) -> Model:
    """A model of one to four blocks; the same for the same seed.

    Three of four are discretised.
    """
    rng = np.random.RandomState(seed)
    model, scale = Model(), 10 ** rng.uniform(-2, 1)
    kind = rng.randint(2**31)
    for _ in range(1 + rng.randint(4)):
        kind = kind if rng.rand() < 0.3 else rng.randint(2**31)  # or equal to the one before
        model.add_block(_block(np.random.RandomState(kind)))
    blocks = list(model.blocks)
    for _ in range(rng.randint(3)):
        model.add_input(SpikeInput(1 + rng.randint(20)))
    senders = [*model.inputs, *blocks]
    for block in blocks:
        for _ in range(rng.randint(4)):
            synapse = _synapse(rng, block, 1 + rng.randint(25), scale)
            for k in rng.choice(len(senders), size=1 + rng.randint(2)):
                senders[k].add_axon(_axon(rng, synapse, senders[k].n_neurons))
    for _ in range(1 + rng.randint(4)):
        model.add_probe(_probe(rng, blocks))
    if rng.randint(4):
        discretize_model(model)
        for block in blocks:
            _exaggerate(rng, block)
    for block in blocks:
        _divide(rng, block)
    return model


def _block(rng):
    block = LoihiBlock(1 + rng.randint(40))
    compartment, n = block.compartment, block.n_neurons
    threshold = {"tau_ref": 0.001 * rng.randint(4), "vth": 10 ** rng.uniform(-1, 1)}
    kind = rng.randint(3)
    if kind == 0:
        compartment.configure_relu(**threshold)
    elif kind == 1:
        lowest = -(10 ** rng.uniform(-1, 4)) * rng.randint(2)
        compartment.configure_lif(tau_rc=rng.uniform(0.005, 0.1), min_voltage=lowest, **threshold)
    else:
        compartment.configure_nonspiking(**threshold)
    compartment.configure_filter(rng.choice([0, 0.002, 0.01, 0.1]))
    compartment.bias[:] = rng.normal(size=n) * 10 ** rng.uniform(-2, 1)
    if rng.rand() < 0.3:
        compartment.enable_noise[:] = rng.rand(n) < 0.7
        compartment.noise_exp = rng.uniform(-2, 0.5)
        compartment.noise_offset = rng.randint(-3, 4)
        compartment.noise_at_membrane = rng.randint(2)
    return block


def _synapse(rng, block, n_axons, scale):
    synapse, n = Synapse(n_axons), block.n_neurons
    kind = rng.choice(["dense", "population", "learning"], p=[0.4, 0.3, 0.3])
    if kind == "population":
        atoms, n_rows = 1 + rng.randint(3), 1 + rng.randint(n_axons)
        widths = rng.randint(0, n // 2 + 1, size=n_rows)
        widths[0] = max(widths[0], 1)
        weights = [rng.normal(size=(atoms, w)) * scale for w in widths]
        indices = []
        for w in widths:  # neighbours, or scattered and some equal
            one = np.arange(w) if rng.rand() < 0.5 else rng.randint(0, n // 2 + 1, size=w)
            indices.append(np.tile(np.minimum(one, n - 1), (atoms, 1)))
        rows = rng.randint(n_rows, size=n_axons)
        of = rows if rng.randint(2) else dict(enumerate(rows.tolist()))
        bases = rng.randint(-1, max(1, n // 2), size=n_axons)
        synapse.set_population_weights(weights, indices, of, bases, pop_type=16)
    else:
        synapse.set_weights(rng.normal(size=(n_axons, n)) * scale)
    if kind == "learning" and n > 1 and n % 2 == 0:
        synapse.set_learning(
            tracing_tau=2 + rng.randint(9),
            tracing_mag=rng.uniform(0, 200),
            learning_rate=rng.uniform(0.01, 3) if rng.randint(2) else float(rng.uniform(0.01, 3)),
            wgt_exp=rng.randint(1, 6),
        )
    block.add_synapse(synapse)
    return synapse


def _axon(rng, synapse, n_sources):
    axon = Axon(n_sources)
    axon.target = synapse
    atoms = synapse.weights[0].shape[0]
    if synapse.pop_type or n_sources != synapse.n_axons or rng.rand() < 0.5:
        axon.set_compartment_axon_map(
            rng.randint(-1, synapse.n_axons, size=n_sources),
            atoms=rng.randint(0, atoms, size=n_sources) if atoms > 1 else None,
        )
    return axon


def _probe(rng, blocks):
    chosen = rng.permutation(len(blocks))[: 1 + rng.randint(len(blocks))]
    targets = [blocks[k] for k in chosen]
    parts = [
        slice(None)
        if rng.randint(2)
        else list(rng.permutation(b.n_neurons)[: 1 + rng.randint(b.n_neurons)])
        for b in targets
    ]
    key = str(rng.choice(["current", "voltage", "spiked"]))
    return LoihiProbe(target=targets, key=key, slice=parts)


def _exaggerate(rng, block):
    """What discretising alone never gives: overflow, weights of more than 16 bits, and so on."""
    compartment = block.compartment
    for synapse in block.synapses:
        if not synapse.learning and rng.rand() < 0.3:
            up = 1 + rng.randint(12)
            for weights in synapse.weights:
                weights <<= up
        if synapse.learning and rng.rand() < 0.5:
            synapse.format(weight_bits=rng.randint(3, 8))
            synapse._lr_int, synapse._lr_exp = 1 + rng.randint(7), rng.randint(-7, 5)
            synapse.train_epoch, synapse.learn_epoch = 1 + rng.randint(3), 1 + rng.randint(4)
    if rng.rand() < 0.2:
        compartment.vmin = -(2 ** rng.randint(8, 32)) + 1
    if rng.rand() < 0.2:
        compartment.bias <<= 8


def _divide(rng, block):
    """Give the first compartments of a block other constants than the rest."""
    compartment, n = block.compartment, block.n_neurons
    for name in ("refract_delay", "vmin", "vmax", "decay_u", "decay_v"):
        if rng.rand() < 0.2:
            value = getattr(compartment, name)
            values = np.array(np.broadcast_to(value, (n,)))
            first = slice(rng.randint(n + 1))
            lower = np.minimum(values[first] / 2, 2**22 if compartment.discretize_info else 5)
            values[first] = values[first] + 1 if name == "refract_delay" else lower
            setattr(compartment, name, values)


def random_calls(emulator, seed, n_calls=3, longest=30):
    """Spikes, errors and steps for some calls: ``(spikes, errors, steps)`` of each.

    Spikes name inputs by their number and errors synapses by theirs, so that they fit every
    emulator of the same model.
    """
    rng, t = np.random.RandomState(seed), 1
    sizes = [len(errors) for errors in emulator.synapses.pes_errors.values()]
    for _ in range(n_calls):
        steps = 1 + rng.randint(longest)
        spikes = []
        for number, item in enumerate(emulator.inputs):
            for step in range(steps):
                n = rng.randint(2 * item.n_neurons + 1)  # of some neurons more than one
                spikes.append((number, t + step, rng.randint(0, item.n_neurons, size=n)))
        yield spikes, [rng.normal(size=n) * 60 for n in sizes], steps
        t += steps


def feed(emulator, spikes, errors, t):
    """Give an emulator what `random_calls` gives."""
    learning = emulator.synapses.pes_errors
    emulator.host2chip(
        [(emulator.inputs[number], time, chosen) for number, time, chosen in spikes],
        [(synapse, t, error) for synapse, error in zip(learning, errors)],
    )
    for number, time, _ in spikes:
        if time % 5 == 0:  # as those that NengoLoihi's builder adds, from a file of events
            emulator.inputs[number].permanent.add(time)
