"""Round the neurons and weights of a network to Loihi's integers.

The links of a network whose neurons are given by :class:`models.chain.NeuronDecays` are rounded by
:func:`round_chain`: each of several roundings is simulated on training samples, and the one that
changes the numbers of spikes least is taken.  The rounding itself is that of NengoLoihi 1.1,
``builder/discretize.py``.
"""

import itertools
import math
from dataclasses import replace

import numpy as np

from deploy.errors import UserError
from deploy.network.blocks import choose_block
from deploy.network.chip import LOIHI, Chip
from deploy.network.geometry import sum_windows
from deploy.network.reference import NeuronEquations
from deploy.network.synapses import FINE_EXPONENT, count_weight_levels
from models.chain import Link, make_layer
from models.integers import Integers, derive_parameters

# Smallest shares of current and voltage that can remain after a step.
MIN_KEEP_U_4096THS = 1
MIN_KEEP_V_4096THS = 2

# Shares of a layer's largest weight that may become 127; larger weights are clipped.
CLIP_SHARES = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5)

# Interval in steps at which inputs are sampled for the rounding of weights.
MOMENT_INTERVAL_STEPS = 4

# Added to the diagonal of the moments, in units of its mean.
DAMPING = 0.01

# Maximum number of inputs of a neuron for which the rounding of weights is compensated.
MAX_COMPENSATED_INPUTS = 2000


def round_chain(
    chain, spikes, height: float = 1.0, synapses_per_weight: int = 1, chip: Chip = LOIHI
) -> tuple:
    """A chain whose neurons are given by their decays, with the chip's integers.

    Parameters
    ----------
    chain : sequence of Link
    spikes : ndarray, shape (n_samples, steps, inputs)
        Input on training samples, on which the scales of the weights are chosen.
    height : float
        Area of an input spike in units of the chip's time step.
    synapses_per_weight : int
        Number of synapses for a weight of recurrent links; 0: two where they fit on a core.
    chip : Chip

    Returns
    -------
    tuple of Link

    Raises
    ------
    UserError
        As :func:`round_to_integers`.
    """
    rounded = []
    for index, link in enumerate(chain):
        if link.neurons is None:
            rounded.append(link)
            continue
        factor = height if index == 0 else 1.0
        scaled = replace(link, kernel=link.kernel * factor)
        if link.recurrent_kernel is not None:
            synapses = synapses_per_weight or choose_synapses_per_weight(scaled, chip)
            link = replace(link, synapses_per_weight=synapses)
            scaled = replace(scaled, synapses_per_weight=synapses)
        integers = choose_integers(scaled, spikes, chip)
        rounded.append(derive_parameters(link, integers, factor, chip))
        spikes = simulate_spikes(scaled, spikes)
    return tuple(rounded)


def choose_synapses_per_weight(link: Link, chip: Chip = LOIHI) -> int:
    """Two, if the link is then still on one core and its neurons' integers are not too large.

    Several cores would have several scales of the weights, which takes from their accuracy.
    """
    several = replace(link, synapses_per_weight=2)
    try:
        integers = round_to_integers(several, chip=chip)
    except UserError:
        return 1
    layer = make_layer(derive_parameters(several, integers, chip=chip))
    return 2 if choose_block(layer, chip=chip) == layer.shape else 1


def choose_integers(link: Link, spikes, chip: Chip = LOIHI) -> Integers:
    """The link's integers, with the scale and rounding of weights that change the spikes least.

    Parameters
    ----------
    link : Link
    spikes : ndarray
        Input on training samples, as for :func:`simulate_spikes`.
    chip : Chip
    """
    spiked = simulate_spikes(link, spikes)
    real_counts = spiked.sum(1, dtype=float)
    candidates = []
    moment_choices: list[np.ndarray | None] = [None]
    if math.prod(link.kernel.shape[:-1]) <= MAX_COMPENSATED_INPUTS:
        inputs = spikes if link.recurrent_kernel is None else _append_own_spikes(spikes, spiked)
        moments = measure_moments(link, inputs)
        if moments is not None:
            moment_choices.append(moments)
    for clip, moments in itertools.product(CLIP_SHARES, moment_choices):
        integers = round_to_integers(link, clip, moments, chip)
        error = simulate_spikes(link, spikes, integers, chip).sum(1, dtype=float) - real_counts
        candidates.append((float(np.square(error).mean()), -clip, integers))
    return min(candidates, key=lambda entry: entry[:2])[2]


def _append_own_spikes(spikes, own_spikes):
    """Inputs of a recurrent link: those from before, then its own spikes of the step before."""
    return np.concatenate([spikes, np.pad(own_spikes[:, :-1], ((0, 0), (1, 0), (0, 0)))], 2)


def compute_currents(link: Link, kernel, spikes) -> np.ndarray:
    """Input currents W s at each step.

    Parameters
    ----------
    link : Link
    kernel : ndarray
        Weights in the shape of the link's, for sums over the squares that it averages.
    spikes : ndarray, shape (n_samples, steps, inputs)

    Returns
    -------
    ndarray, shape (n_samples, steps, neurons)
    """
    operation = link.operation
    sums = sum_windows(np.reshape(spikes, (-1, *link.input_shape)), link.pool)
    sums = operation.compute_sums(operation.to_deployed(kernel), sums)
    return sums.reshape(*spikes.shape[:2], -1)


def simulate_spikes(
    link: Link, spikes, integers: Integers | None = None, chip: Chip = LOIHI
) -> np.ndarray:
    """Spikes of a link's neurons, from rest.

    Parameters
    ----------
    link : Link
        Neurons are given by their `NeuronDecays`, unless there are integers.
    spikes : ndarray, shape (n_samples, steps, inputs)
        In the chip's order.
    integers : Integers, optional
        The chip's integers; default: the link's real numbers.
    chip : Chip

    Returns
    -------
    ndarray of bool, shape (n_samples, steps, neurons)
        In the same step as the input; on the chip, one step later for each layer.
    """
    spikes = np.asarray(spikes, float)
    bias = link.bias if integers is None else integers.bias
    bias = np.tile(bias, link.size // len(bias))
    if integers is None:
        sums = compute_currents(link, link.kernel / link.pool**2, spikes)
        equations = NeuronEquations(link.decays.keep_u, link.decays.keep_v, bias)
        recurrent_kernel = link.recurrent_kernel
    else:
        sums = compute_currents(link, integers.kernel.astype(float), spikes)
        equations = NeuronEquations(
            keep_u=integers.keep_u_4096ths / chip.decay_unit,
            keep_v=integers.keep_v_4096ths / chip.decay_unit,
            bias=bias,
            threshold=integers.threshold,
            floor=integers.floor,
            input_scale=chip.weight_unit * 2.0**integers.exponent,
            is_integer=True,
        )
        recurrent_kernel = integers.recurrent_kernel
    spiked = equations.compute_spikes(np.moveaxis(sums, 1, 0), recurrent_kernel)
    return np.ascontiguousarray(np.moveaxis(spiked, 0, 1))


def round_to_integers(link: Link, clip: float = 1.0, moments=None, chip: Chip = LOIHI) -> Integers:
    """Round a link of neurons to the chip's integers.

    Parameters
    ----------
    link : Link
    clip : float
        Share of the largest weight that becomes the chip's largest, 127 on Loihi, or 380 as the
        sum of two synapses.
    moments : ndarray, shape (inputs, inputs), optional
        From :func:`measure_moments`: the rounding error of a weight is then compensated by the
        following weights, if their inputs are active together.  The inputs of a recurrent link
        include its own spikes, last.
    chip : Chip

    Returns
    -------
    Integers

    Raises
    ------
    UserError
        Threshold and bias do not fit with any exponent of the weights.
    """
    levels = count_weight_levels(link.synapses_per_weight, chip)
    exponents = _list_exponents(link, chip)
    real = _spread_weights(link)
    unit = chip.weight_unit * 2.0 ** exponents[0]
    scale = _choose_scale(link, float(np.abs(real).max()) * clip, levels, unit, chip)
    if moments is None:
        weights = np.clip(np.rint(real / scale), -levels, levels)
    else:
        weights = _round_with_compensation(real / scale, moments, levels)
    threshold, exponent = _choose_threshold(link, scale, exponents, chip)
    kernel, recurrent_kernel = np.split(weights.astype(np.int32), [len(link.kernel)])
    return Integers(
        kernel=kernel,
        bias=_round_bias(link.bias * threshold, chip),
        threshold=threshold,
        floor=-chip.voltage_limit,
        keep_u_4096ths=_round_decay(link.decays.keep_u, MIN_KEEP_U_4096THS, chip),
        keep_v_4096ths=_round_decay(link.decays.keep_v, MIN_KEEP_V_4096THS, chip),
        exponent=exponent,
        recurrent_kernel=None if link.recurrent_kernel is None else recurrent_kernel,
    )


def _spread_weights(link):
    """The link's weights for sums over the squares that it averages, its own spikes' last.

    Raises
    ------
    UserError
        A weight, bias or decay is infinite.
    """
    real = link.kernel / link.pool**2
    if link.recurrent_kernel is not None:
        real = np.concatenate([real, link.recurrent_kernel])
    parameters = (real, link.bias, link.decays.keep_u, link.decays.keep_v)
    if not all(np.isfinite(values).all() for values in parameters):
        raise UserError(
            f"{link}: its weights or biases become infinite when divided by its threshold; "
            "scale the threshold to about 1 in training"
        )
    return real


def _list_exponents(link, chip) -> tuple:
    """Possible exponents of the link's weights, the largest first.

    The sum of several synapses is in steps of the fine one, and lower exponents lose their bits.
    """
    if link.synapses_per_weight > 1:
        return (FINE_EXPONENT,)
    return tuple(range(0, -chip.weight_exponents, -1))


def _choose_scale(link, largest, levels, unit, chip):
    """The real weight of one level, which adds a unit, for a largest weight.

    Raises
    ------
    UserError
        The largest weight is 0, or too large in comparison with the threshold.
    """
    if largest == 0:
        raise UserError(f"{link}: all its weights are 0; train it, or leave it out")
    # The threshold, a whole number of units, is rounded up: only the largest weights are clipped.
    units_per_weight = unit / chip.threshold_unit
    with np.errstate(over="ignore"):
        units = np.ceil(units_per_weight * levels / largest - 1e-9)
    units = min(units, 2.0**1000)  # weights of 1e-310 are too small, as `_choose_threshold` finds
    scale = units_per_weight / max(units, 1)
    if largest > 1.5 * levels * scale:
        raise UserError(
            f"{link}: its weights are too large relative to its threshold for the chip's integers, "
            f"{largest:.3g} of it; scale the weights or the threshold in training"
        )
    return scale


def _choose_threshold(link, scale, exponents, chip) -> tuple:
    """The threshold, and the largest exponent of the weights with which it and the biases fit.

    Raises
    ------
    UserError
        They fit with no exponent.
    """
    threshold_unit = chip.threshold_unit
    for exponent in exponents:
        per_threshold = chip.weight_unit * 2.0**exponent / scale
        threshold = threshold_unit * round(per_threshold / threshold_unit)
        bias = link.bias * threshold
        if 0 < threshold <= chip.max_threshold and np.abs(bias).max() <= chip.max_bias:
            return threshold, exponent
    raise UserError(
        f"{link}: its weights are too small relative to its threshold for the chip's integers, or "
        "its biases too large; scale weights and threshold in training, or use shorter time "
        "constants"
    )


def _round_decay(keep, least, chip):
    """The share that remains after a step, in the chip's units."""
    return int(np.clip(np.rint(chip.decay_unit * keep), least, chip.decay_levels))


def _round_with_compensation(real, moments, levels) -> np.ndarray:
    """Whole numbers near ``real``, such that the error of weighted sums is small.

    The inputs are rounded one after the other, and the remaining ones compensate the error by least
    squares (Frantar et al., "GPTQ", ICLR 2023, with the Cholesky factor of the inverse).  The input
    with the largest weight is the first, so that this weight does not change.
    """
    flat = real.reshape(len(moments), -1)
    order = np.argsort(-np.abs(flat).max(1), kind="stable")
    remaining = flat[order]
    moments = moments[np.ix_(order, order)]
    upper = np.linalg.cholesky(np.linalg.inv(moments)).T
    for i in range(len(remaining)):
        rounded = np.clip(np.rint(remaining[i]), -levels, levels)
        error = (remaining[i] - rounded) / upper[i, i]
        remaining[i] = rounded
        remaining[i + 1 :] -= np.outer(upper[i, i + 1 :], error)
    return remaining[np.argsort(order)].reshape(real.shape)


def measure_moments(link: Link, spikes) -> np.ndarray | None:
    """Second moments of the inputs' contributions to the voltage, with a small diagonal added.

    Parameters
    ----------
    link : Link
    spikes : ndarray, shape (n_samples, steps, inputs)

    Returns
    -------
    ndarray, shape (inputs of a neuron,) twice, or None
        In the order of the weights; None if the operation's rounding is not compensated.
    """
    voltages = []
    u = 0.0
    v = 0.0
    for t in range(spikes.shape[1]):
        u = link.decays.keep_u * u + spikes[:, t]
        v = link.decays.keep_v * v + u
        if t % MOMENT_INTERVAL_STEPS == 0:
            voltages.append(v)
    values = np.stack(voltages, 1)
    values = values.reshape(-1, values.shape[-1])
    is_recurrent = link.recurrent_kernel is not None
    # The inputs of a recurrent link have its own spikes at their end.
    if not is_recurrent:
        values = sum_windows(values.reshape(-1, *link.input_shape), link.pool)
    inputs_of_neuron = link.operation.gather_inputs(values)
    if inputs_of_neuron is None:
        return None
    inputs = inputs_of_neuron.shape[-1]
    inputs_of_neuron = inputs_of_neuron.reshape(-1, inputs)
    moments = inputs_of_neuron.T @ inputs_of_neuron / len(inputs_of_neuron)
    return moments + np.eye(inputs) * max(DAMPING * np.trace(moments) / inputs, 1e-12)


def _round_bias(bias, chip):
    """Round to the bits of a mantissa times a power of two, as NengoLoihi does."""
    share = np.maximum(np.abs(np.rint(bias)) / chip.max_bias_mantissa, 1)
    unit = 2.0 ** np.ceil(np.log2(share))
    return (np.rint(np.rint(bias) / unit) * unit).astype(np.int32)
