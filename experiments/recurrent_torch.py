"""Train a recurrent network in snnTorch and export it, in an environment with PyTorch.

``python recurrent_torch.py FRAMES.npz NETWORK.nir ANSWERS.npz SEED EPOCHS`` knows nothing of this
project but the file of frames, see :mod:`experiments.recurrent`.  The network has a dense layer of
current-based neurons that is connected to itself (``RSynaptic``), whose spikes a leaky layer reads.
It has no biases: on the chip a bias acts from the first step on.
"""

import sys

import nir
import numpy as np
import snntorch as snn
import torch
from snntorch import surrogate
from snntorch.export_nir import export_to_nir

UNITS = 100


def make_network(inputs, classes):
    grad = surrogate.fast_sigmoid(slope=10)

    def repeat_for_neurons(n, value):  # the exporter takes shapes from the parameters
        return torch.full((n,), value)

    recurrent = snn.RSynaptic(
        alpha=repeat_for_neurons(UNITS, 0.6), beta=repeat_for_neurons(UNITS, 0.9), all_to_all=True,
        linear_features=UNITS, reset_mechanism="none", spike_grad=grad, init_hidden=True,
    )  # fmt: skip
    recurrent.recurrent = torch.nn.Linear(UNITS, UNITS, bias=False)
    output = snn.Leaky(
        beta=repeat_for_neurons(classes, 0.95), threshold=repeat_for_neurons(classes, 1.0),
        reset_mechanism="zero", spike_grad=grad, init_hidden=True,
    )  # fmt: skip
    first = torch.nn.Linear(inputs, UNITS, bias=False)
    return torch.nn.Sequential(
        first, recurrent, torch.nn.Linear(UNITS, classes, bias=False), output
    )


def run(network, frames):
    """Output spikes at each step, shape (steps, samples, classes)."""
    first, recurrent, second, output = network
    signal = first(frames.transpose(0, 1).float())
    recurrent.spk = torch.zeros_like(signal[0])
    recurrent.syn = torch.zeros_like(signal[0])
    recurrent.mem = torch.zeros_like(signal[0])
    spikes = []
    for step in signal:
        spikes.append(recurrent(step))
        # NIR's reset; that of RSynaptic would also lose the input of the step after a spike
        recurrent.mem = recurrent.mem * (1 - spikes[-1].detach())
    hidden = second(torch.stack(spikes))
    output.mem = torch.zeros_like(hidden[0])
    return torch.stack([output(step) for step in hidden])


def train(network, frames, labels, epochs, classes):
    optimizer = torch.optim.Adam(network.parameters(), 5e-3)
    batches = -(-len(frames) // 64)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 5e-3, epochs * batches)
    for epoch in range(epochs):
        right = 0
        for batch in torch.randperm(len(frames)).split(64):
            score = run(network, frames[batch]).sum(0) * 0.3
            loss = torch.nn.functional.cross_entropy(score, labels[batch])
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            schedule.step()
            right += int((score.argmax(1) == labels[batch]).sum())
        if epoch % 10 == 9:
            print(f"epoch {epoch + 1}: accuracy {right / len(frames):.3f}", flush=True)


def main(frames, graph, predictions, seed, epochs):
    torch.set_num_threads(1)
    torch.manual_seed(int(seed))
    with np.load(frames, allow_pickle=False) as file:
        parts = {name: torch.from_numpy(file[name]) for name in file.files}
    classes = int(parts["labels"].max()) + 1
    network = make_network(parts["train"].shape[2], classes)
    with torch.no_grad():  # neurons spike before they are trained
        network[0].weight *= 3
        network[2].weight *= 2
    train(network, parts["train"], parts["labels"], int(epochs), classes)
    with torch.no_grad():
        outputs = run(network, parts["test"])
    nir.write(
        graph, export_to_nir(network, torch.zeros(1, parts["test"].shape[2]), ignore_dims=[0])
    )
    np.savez(predictions, predictions=outputs.sum(0).argmax(1).numpy(), outputs=outputs.numpy())


if __name__ == "__main__":
    main(*sys.argv[1:])
