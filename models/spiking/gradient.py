"""Outputs, loss and gradients of a network on events, computed by Numba instead of TensorFlow.

These are the equations of :mod:`models.spiking`, and the loss of
:mod:`pipeline.training.events`, computed from spike to spike by :mod:`models.spiking.compiled`: a
third of the time of dense sums, since one input in fifty spikes in a step.  Samples are computed a
few at a time, so that their states stay in the cache of a core, and these groups by several
threads; the sums over the groups have a fixed order, so that the number of threads does not change
the result.
"""

from __future__ import annotations

import concurrent.futures
from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np

from deploy.network.chip import LOIHI
from models.architecture import Architecture
from models.spiking import compiled
from models.spiking.network import BIAS_CAP, MIN_KEEP_4096THS, OUTPUT_SCALE, Neuron

# Samples that are computed together.
SAMPLES_IN_GROUP = 4


class ChipLayer(NamedTuple):
    """A layer in the chip's integers, as float32.

    Attributes
    ----------
    kernel : ndarray, shape (rows, filters)
        Weights, multiplied by the chip's ``weight_unit``.
    bias, rest_voltage : ndarray, shape (neurons,)
    keep_u, keep_v : float
        Remaining share of current and voltage after a step.
    threshold, floor : float
    kernel_slope : float
        Derivative of ``kernel`` by the trained weights.
    """

    kernel: np.ndarray
    bias: np.ndarray
    rest_voltage: np.ndarray
    keep_u: np.float32
    keep_v: np.float32
    threshold: np.float32
    floor: np.float32
    kernel_slope: np.float32

    @classmethod
    def from_real_numbers(
        cls, kernel, bias, tau_u, tau_v, floor: float, n_neurons: int
    ) -> ChipLayer:
        """The integers of trained variables, as `SpikingNetwork.compute_integers`."""
        scale = max(float(np.abs(kernel).max()), 1e-12) / LOIHI.weight_levels
        unit = LOIHI.threshold_unit
        threshold = unit * np.round(LOIHI.weight_unit / unit / scale)
        threshold = float(np.clip(threshold, unit, LOIHI.max_threshold))
        keep_u, keep_v = (_round_share(_compute_sigmoid(tau)) for tau in (tau_u, tau_v))
        cap = BIAS_CAP * (1 - keep_v)
        bias = _round_to_twelve_bits(np.minimum(bias, cap) * threshold)
        lowest = 1 - 2.0 ** np.round(np.log2(1 - floor * threshold))
        below = np.floor((np.abs(bias) - 1) / (1 - keep_v))
        rest_voltage = np.maximum(np.sign(bias) * (below + 1), lowest)
        repeats = n_neurons // len(bias)
        weights = np.round(kernel / scale)
        return cls(
            kernel=(LOIHI.weight_unit * weights).astype(np.float32),
            bias=np.tile(bias, repeats).astype(np.float32),
            rest_voltage=np.tile(rest_voltage, repeats).astype(np.float32),
            keep_u=np.float32(keep_u),
            keep_v=np.float32(keep_v),
            threshold=np.float32(threshold),
            floor=np.float32(lowest),
            kernel_slope=np.float32(LOIHI.weight_unit / scale),
        )


@dataclass(frozen=True)
class Batch:
    """Samples of a training step.

    Attributes
    ----------
    frames : ndarray of uint8, shape (samples, steps, ...)
        1 where there is an event, 0 elsewhere.
    labels : ndarray of int, shape (samples,)
    last_step : ndarray of int, shape (samples,)
        Step of each sample's last event.
    dropout_factors : list of ndarray of float32, each of shape (samples, neurons)
        Dropout: for each layer the factors that multiply its spikes before the next layer.
    """

    frames: np.ndarray
    labels: np.ndarray
    last_step: np.ndarray
    dropout_factors: list


class Result(NamedTuple):
    """Loss and gradients of a batch, sums over its samples.

    Attributes
    ----------
    loss : float
    right : int
        Number of samples whose largest output at the end is that of their label.
    operations : float
        Number of synaptic operations.
    gradients : dict of str to ndarray
        By the names of the variables of a :class:`models.spiking.network.SpikingNetwork`.
    """

    loss: float
    right: int
    operations: float
    gradients: dict


class SpikingGradient:
    """Outputs, loss and gradients for any values of a network's variables.

    Parameters
    ----------
    architecture : Architecture
    neuron : Neuron
    section_starts : tuple of int
        See :class:`models.spiking.network.SpikingNetwork`.
    """

    def __init__(self, architecture: Architecture, neuron: Neuron, section_starts: tuple = (0,)):
        self.architecture = architecture
        self.neuron = neuron
        self.section_starts = section_starts
        self.names = architecture.names[:-1]
        self.neurons = [architecture.n_values[name] for name in self.names]
        hidden = zip(architecture.layers[:-1], architecture.shapes, strict=False)
        self.synapses = [layer.make_synapses(before) for layer, before in hidden]
        self.fan_out = [fan_out.ravel() for fan_out in architecture.fan_out.values()]

    def make_chip_layers(self, values: dict) -> list:
        """The :class:`ChipLayer` of each layer for values of the variables, by their names."""
        layers = []
        for name, neurons, synapses in zip(self.names, self.neurons, self.synapses, strict=True):
            layers.append(
                ChipLayer.from_real_numbers(
                    kernel=np.reshape(values[f"{name}.kernel"], (-1, synapses.width)),
                    bias=values[f"{name}.bias"],
                    tau_u=values[f"{name}.tau_u"],
                    tau_v=values[f"{name}.tau_v"],
                    floor=self.neuron.floor,
                    n_neurons=neurons,
                )
            )
        return layers

    def compute_outputs(self, values: dict, frames) -> tuple:
        """Run the network from its resting state.

        Parameters
        ----------
        values : dict of str to ndarray
            Values of the variables.
        frames : ndarray of uint8, shape (samples, steps, ...)

        Returns
        -------
        outputs : ndarray of float32, shape (samples, steps, classes)
            The outputs after every step.
        operations : ndarray of float, shape (samples,)
            Number of synaptic operations of each sample.
        rates : list of ndarray, each of shape (samples, neurons)
            Number of spikes of each neuron of each layer.
        """
        layers = self.make_chip_layers(values)
        kernel = self._scale_output_kernel(values)

        def run(group):
            factors = self._make_ones(len(group))
            forward = self._forward(layers, kernel, group, factors)
            counts = [spikes.sum(1, dtype=np.int64) for spikes in forward.spikes]
            return forward.outputs, self._count_operations(counts), counts[1:]

        outputs, operations, counts = zip(*_run_in_groups(run, np.asarray(frames)), strict=True)
        rates = [np.concatenate(layer) for layer in zip(*counts, strict=True)]
        return np.concatenate(outputs), np.concatenate(operations), rates

    def compute_gradients(self, values: dict, batch: Batch, early: float, price: float) -> Result:
        """Loss and gradients of a batch.

        Parameters
        ----------
        values : dict of str to ndarray
            Values of the variables.
        batch : Batch
        early : float
            Weight of the mean loss up to a sample's last event.
        price : float
            Added to the gradients for each synaptic operation of the batch; not in the loss.
        """
        layers = self.make_chip_layers(values)
        kernel = self._scale_output_kernel(values)

        def run(samples_of_group):
            return self._compute_gradients(layers, kernel, batch, samples_of_group, early, price)

        results = _run_in_groups(run, np.arange(len(batch.labels)))
        sums: dict[str, Any] = {}  # arrays, and zeros where sum() begins
        for name in results[0].gradients:
            sums[name] = sum(result.gradients[name] for result in results)
        for name, layer in zip(self.names, layers, strict=True):
            kernel_shape = np.shape(values[f"{name}.kernel"])
            grad_kernel = sums[f"{name}.kernel"] * layer.kernel_slope
            sums[f"{name}.kernel"] = grad_kernel.reshape(kernel_shape)
            grad_bias = sums[f"{name}.bias"].reshape(-1, len(values[f"{name}.bias"])).sum(0)
            sums[f"{name}.bias"] = grad_bias * layer.threshold
            for tau in ("tau_u", "tau_v"):
                share = _compute_sigmoid(values[f"{name}.{tau}"])
                sums[f"{name}.{tau}"] = sums[f"{name}.{tau}"] * share * (1 - share)
        grad_output = sums["output.kernel"] * OUTPUT_SCALE
        sums["output.kernel"] = grad_output.reshape(np.shape(values["output.kernel"]))
        return Result(
            sum(result.loss for result in results),
            sum(result.right for result in results),
            sum(result.operations for result in results),
            sums,
        )

    def _compute_gradients(self, layers, kernel, batch, samples_of_group, early, price):
        """The result for some samples, with gradients by the chip's values."""
        factors = [of_layer[samples_of_group] for of_layer in batch.dropout_factors]
        forward = self._forward(layers, kernel, batch.frames[samples_of_group], factors)
        labels = batch.labels[samples_of_group]
        last_step = batch.last_step[samples_of_group]
        loss, grad_outputs = _compute_loss_gradient(forward.outputs, labels, last_step, early)
        error = np.empty(forward.spikes[-1].shape, np.float32)
        grad_kernel = np.zeros_like(kernel)
        section = self._find_section(error.shape[1])
        compiled.read_out_back(
            forward.spikes[-1], factors[-1], kernel, section, grad_outputs, grad_kernel, error
        )
        gradients = {"output.kernel": grad_kernel}
        for index in reversed(range(len(layers))):
            layer = layers[index]
            name = self.names[index]
            if price:
                error += np.float32(price) * self.fan_out[index + 1].astype(np.float32)
            grad_bias, grad_keep_u, grad_keep_v = compiled.integrate_back(
                error, forward.spikes[index + 1], forward.currents[index], forward.voltages[index],
                layer.keep_u, layer.keep_v, layer.threshold, layer.floor,
                np.float32(self.neuron.beta),
            )  # fmt: skip
            factor = factors[index - 1] if index else self._make_ones_like(error, forward.spikes[0])
            grad_kernel = np.zeros_like(layer.kernel)
            compiled.add_kernel_gradient(
                forward.spikes[index], factor, *self.synapses[index].arrays, error, grad_kernel
            )
            gradients |= {
                f"{name}.kernel": grad_kernel,
                f"{name}.bias": grad_bias,
                f"{name}.tau_u": grad_keep_u,
                f"{name}.tau_v": grad_keep_v,
            }
            if index:
                error = self._compute_input_gradients(index, layer, error) * factor[:, None, :]
        counts = [spikes.sum(1, dtype=np.int64) for spikes in forward.spikes]
        right = int(np.sum(forward.outputs[:, -1].argmax(1) == labels))
        return Result(loss, right, float(self._count_operations(counts).sum()), gradients)

    def _forward(self, layers, kernel, frames, factors):
        spikes = [np.ascontiguousarray(frames.reshape(*frames.shape[:2], -1))]
        currents = []
        voltages = []
        factor = np.ones((len(frames), spikes[0].shape[2]), np.float32)
        for index, layer in enumerate(layers):
            shape = (*frames.shape[:2], self.neurons[index])
            current = np.empty(shape, np.float32)
            voltage = np.empty(shape, np.float32)
            spiked = np.empty(shape, np.uint8)
            compiled.sum_inputs(
                spikes[-1], factor, *self.synapses[index].arrays, layer.kernel, current
            )
            compiled.integrate(
                current, layer.bias, layer.rest_voltage, layer.keep_u, layer.keep_v,
                layer.threshold, layer.floor, voltage, spiked,
            )  # fmt: skip
            currents.append(current)
            voltages.append(voltage)
            spikes.append(spiked)
            factor = factors[index]
        outputs = np.empty((*frames.shape[:2], kernel.shape[2]), np.float32)
        compiled.read_out(spikes[-1], factor, kernel, self._find_section(frames.shape[1]), outputs)
        return _ForwardPass(spikes, currents, voltages, outputs)

    def _compute_input_gradients(self, index, layer, error):
        """Gradients of a layer's sums to the spikes of its inputs."""
        samples, steps, _ = error.shape
        filters = layer.kernel.shape[1]
        by_row = error.reshape(-1, filters) @ layer.kernel.T
        inputs = self.neurons[index - 1]
        if self.synapses[index].is_matrix:
            return by_row.reshape(samples, steps, inputs)
        grad_inputs = np.empty((samples * steps, inputs), np.float32)
        by_row = by_row.reshape(samples * steps, -1, layer.kernel.shape[0])
        compiled.sum_over_synapses(by_row, *self.synapses[index].arrays, grad_inputs)
        return grad_inputs.reshape(samples, steps, inputs)

    def _count_operations(self, counts):
        """Synaptic operations of each sample, from the numbers of spikes of input and layers."""
        pairs = zip(counts, self.fan_out, strict=True)
        return sum(count @ fan_out for count, fan_out in pairs).astype(float)

    def _scale_output_kernel(self, values):
        kernel = np.asarray(values["output.kernel"], np.float32) * np.float32(OUTPUT_SCALE)
        return np.ascontiguousarray(kernel.reshape(len(self.section_starts), self.neurons[-1], -1))

    def _find_section(self, steps):
        """The section of the readout that each step belongs to."""
        return np.searchsorted(self.section_starts, np.arange(steps), side="right") - 1

    def _make_ones(self, samples):
        return [np.ones((samples, neurons), np.float32) for neurons in self.neurons]

    @staticmethod
    def _make_ones_like(error, spikes):
        return np.ones((len(error), spikes.shape[2]), np.float32)


class _ForwardPass(NamedTuple):
    """The results of a forward pass.

    Attributes
    ----------
    spikes : list of ndarray
        Spikes of the input, and of each layer.
    currents, voltages : list of ndarray
        Currents and voltages of each layer.
    outputs : ndarray, shape (samples, steps, classes)
    """

    spikes: list
    currents: list
    voltages: list
    outputs: np.ndarray


def _run_in_groups(run, values):
    """``run`` for groups of values, in several threads; the results in order."""
    groups = [values[k : k + SAMPLES_IN_GROUP] for k in range(0, len(values), SAMPLES_IN_GROUP)]
    threads = min(numba.config.NUMBA_NUM_THREADS, len(groups))
    if threads <= 1:
        return [run(group) for group in groups]
    with concurrent.futures.ThreadPoolExecutor(threads) as pool:
        return list(pool.map(run, groups))


def _compute_loss_gradient(outputs, labels, last_step, early):
    """The sum of the losses, and its gradient to the outputs; see the module of the training."""
    samples, steps, _ = outputs.shape
    weights = (np.arange(steps) <= last_step[:, None]) * np.float32(early)
    weights = weights / (np.minimum(last_step, steps - 1) + 1)[:, None]
    weights[:, -1] += 1
    logits = outputs - outputs.max(2, keepdims=True)
    exponentials = np.exp(logits)
    sums = exponentials.sum(2, keepdims=True)
    index = np.arange(samples)
    loss = np.sum(weights * (np.log(sums[:, :, 0]) - logits[index, :, labels]))
    gradient = exponentials / sums
    gradient[index, :, labels] -= 1
    return float(loss), (gradient * weights[:, :, None]).astype(np.float32)


def _compute_sigmoid(values):
    return 1 / (1 + np.exp(-np.asarray(values, np.float64)))


def _round_share(share):
    """A share that remains after a step, rounded to a multiple of 1/4096 that the chip can have."""
    unit = LOIHI.decay_unit
    return float(np.clip(np.round(unit * share), MIN_KEEP_4096THS, LOIHI.decay_levels)) / unit


def _round_to_twelve_bits(bias):
    """Round to 12 bits times the smallest sufficient power of two, at most 2^7."""
    mantissa = LOIHI.max_bias_mantissa
    size = np.abs(bias)[:, None] / mantissa
    unit = 2.0 ** np.sum(size > 2.0 ** np.arange(LOIHI.bias_exponents - 1), 1)
    return np.round(np.clip(bias / unit, -mantissa, mantissa)) * unit
