"""Train a network in PyTorch and export it with its package's own exporter.

``python train.py snntorch|norse FRAMES.npz NETWORK.nir ANSWERS.npz SEED EPOCHS [RESET]``, in an
environment with the packages of ``tests/nir_reader/requirements.txt``; it knows nothing of this
project but the file of frames, see ``frames.py``.  Into the answers go the test samples'
``predictions`` and, of the first 20 of them, the network's ``outputs`` at each step, shape
(20, steps, 10).

The networks are small and plain.  That of snnTorch is like the one of its tutorial on ST-MNIST,
two convolutions and a dense layer of leaky neurons whose output spikes are counted, with averaging
in the place of maxima, which NIR does not have.  They have no biases: on the chip a bias acts from
the first step on, and the first spikes reach a layer only later.
"""

import sys

import nir
import numpy as np
import torch

# Of Norse's time: a frame of events.
STEP_S = 0.02


def snntorch_network(reset):
    import snntorch as snn
    from snntorch import surrogate

    def leaky(*shape, **options):
        # With parameters of the layer's shape, since the exporter takes shapes from them.
        return snn.Leaky(
            beta=torch.full(shape, 0.9), threshold=torch.ones(shape), init_hidden=True,
            reset_mechanism=reset, spike_grad=surrogate.fast_sigmoid(slope=10), **options,
        )  # fmt: skip

    return torch.nn.Sequential(
        torch.nn.Conv2d(2, 16, 4, bias=False),
        leaky(16, 7, 7),
        torch.nn.AvgPool2d(2),
        torch.nn.Conv2d(16, 48, 3, bias=False),
        leaky(48, 1, 1),
        torch.nn.Flatten(),
        torch.nn.Linear(48, 10, bias=False),
        leaky(10),
    )


def norse_network():
    import norse.torch as norse

    # With parameters of the layers' shapes, since NIR's writer takes no scalars.
    def neurons(*shape):
        times = torch.full(shape, 1 / 0.15)
        # a spike's weight reaches the voltage times h / tau: a low threshold makes up for that
        # and "super", the default, ignores alpha: its gradient is as wide as voltages of 1 are
        parameters = norse.LIFBoxParameters(
            times, v_th=torch.full(shape, 0.1), v_leak=torch.zeros(shape),
            method="tanh", alpha=torch.tensor(20.0),
        )  # fmt: skip
        return norse.LIFBoxCell(parameters, dt=STEP_S)

    readout = norse.LIBoxParameters(torch.full((10, 1, 1), 1 / 0.2), torch.zeros(10, 1, 1))
    return norse.SequentialState(
        torch.nn.Conv2d(2, 24, 4, stride=3),
        neurons(24, 3, 3),
        torch.nn.Conv2d(24, 64, 3),
        neurons(64, 1, 1),
        torch.nn.Conv2d(64, 10, 1),
        norse.LIBoxCell(readout, dt=STEP_S),
    )


def begin(network):
    """Weights with which neurons spike before they are trained."""
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, (torch.nn.Linear, torch.nn.Conv2d)):
                module.weight *= 2.0
                if module.bias is not None:  # Norse's exporter needs one
                    module.bias.zero_().requires_grad_(False)


def run(package, network, frames):
    """Outputs at each step, (steps, samples, 10), layer by layer, each over all steps."""
    signal = frames.transpose(0, 1).float()
    for layer in network:
        if isinstance(layer, (torch.nn.Linear, torch.nn.Conv2d, torch.nn.AvgPool2d)):
            flat = layer(signal.flatten(0, 1))
            signal = flat.reshape(*signal.shape[:2], *flat.shape[1:])
        elif isinstance(layer, torch.nn.Flatten):
            signal = signal.flatten(2)
        elif package == "norse":
            state, outputs = None, []
            for step in signal:
                output, state = layer(step, state)
                outputs.append(output)
            signal = torch.stack(outputs)
        else:
            layer.mem = torch.zeros_like(signal[0])
            signal = torch.stack([layer(step) for step in signal])
    return signal.flatten(2)


def train(package, network, frames, labels, seed, epochs):
    torch.manual_seed(seed)
    optimizer = torch.optim.Adam([p for p in network.parameters() if p.requires_grad], 1e-2)
    batches = -(-len(frames) // 64)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-2, epochs * batches)
    for epoch in range(epochs):
        right = 0
        for batch in torch.randperm(len(frames)).split(64):
            outputs = run(package, network, frames[batch])
            # spikes are counted, voltages averaged; both over the whole recording
            score = outputs.sum(0) * 0.1
            loss = torch.nn.functional.cross_entropy(score, labels[batch])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            right += int((score.argmax(1) == labels[batch]).sum())
        print(f"epoch {epoch + 1}: accuracy {right / len(frames):.3f}", flush=True)


def export(package, network):
    if package == "snntorch":
        from snntorch.export_nir import export_to_nir

        return export_to_nir(network, torch.zeros(1, 2, 10, 10), ignore_dims=[0])
    from norse.torch.utils.export_nir import to_nir

    # The exporter writes dt / tau_mem_inv: with 1 the time constants are in seconds.
    graph = to_nir(network, torch.zeros(2, 10, 10), dt=1.0)
    graph.infer_types()  # the exporter leaves the convolutions' shapes open
    return graph


def main(package, given, graph, answers, seed, epochs, reset="zero"):
    torch.set_num_threads(1)
    torch.manual_seed(int(seed))
    with np.load(given, allow_pickle=False) as file:
        shape = tuple(file["shape"])
        size = int(np.prod(shape[1:]))
        flat = np.unpackbits(file["frames"], axis=1, count=size)
        frames = torch.from_numpy(flat.reshape(shape))
        labels = torch.from_numpy(file["labels"])
        parts = {name: torch.from_numpy(file[name]) for name in ("train", "test")}
    network = snntorch_network(reset) if package == "snntorch" else norse_network()
    begin(network)
    learn, test = parts["train"], parts["test"]
    train(package, network, frames[learn], labels[learn], int(seed), int(epochs))
    with torch.no_grad():
        outputs = torch.cat([run(package, network, frames[part]) for part in test.split(100)], 1)
    predictions = outputs.sum(0).argmax(1)
    print(f"test accuracy {float((predictions == labels[test]).float().mean()):.4f}", flush=True)
    nir.write(graph, export(package, network))
    np.savez(
        answers,
        predictions=predictions.numpy(),
        test=test.numpy(),
        outputs=outputs[:, :20].transpose(0, 1).numpy(),
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
