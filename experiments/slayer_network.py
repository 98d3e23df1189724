"""SLAYER: spike response neurons trained directly on events (Shrestha and Orchard 2018).

The equations and their sections in "SLAYER: Spike Layer Error Reassignment in Time" (NeurIPS 2018)
are below.  Time t counts steps of ``dt``; ``*`` is convolution and ``(x)`` correlation in time; l
is the layer, W its weights (here a convolution or a dense layer, without bias).

=========================  =====================================================  ===============
spike response             a = eps * s,  eps(t) = t/tau_s exp(1 - t/tau_s)        Section 2.1
refractory response        nu(t) = -scale_ref theta t/tau_r exp(1 - t/tau_r)      Section 2.1
membrane potential         u_l = W_l a_(l-1) + nu * s_l                           Section 2.1
spikes                     s_l(t) = 1 where u_l(t) >= theta                       Section 2.1
spike escape rate          rho(t) = scale_rho/tau exp(-abs(u(t) - theta)/tau),    Section 3.2
                           tau = tau_rho theta
error of the layer         e_l = W_(l+1)^T delta_(l+1)                            Section 3.3
credit over time           delta_l = rho_l . (eps (x) e_l)                        Section 3.3
gradient                   dE/dW_l = sum over t of delta_l(t) a_(l-1)(t)^T        Section 3.3
error of the output        e(t) = (count - desired count)/T                       Section 3.1
=========================  =====================================================  ===============

rho replaces the derivative of a spike with respect to the potential (the stochastic neuron of
Section 3.2); the correlation distributes an error at time t over the earlier inputs that caused it.
As in the paper, the refractory response influences rho through u but is not differentiated.

Both kernels are impulse responses of a second-order linear filter, so that a convolution over time
costs a few operations per step for any time constant: with d = exp(-1/tau),

    p(t) = d p(t-1) + s(t),    q(t) = d (q(t-1) + p(t-1)),    (eps * s)(t) = e/tau q(t).

The filter and the weights are linear, and few neurons spike in a time step.  Weights are therefore
applied to spikes rather than to responses, and to credit that is already correlated:

    W (eps * s) = eps * (W s),    c_l = eps (x) delta_l = eps (x) (rho_l . (W_(l+1)^T c_(l+1))),
    dE/dW_l = sum over t of c_l(t) s_(l-1)(t)^T.

A convolution adds the weights of the spikes, and adds the credit at the spikes to its gradient; the
error passes it backwards as a matrix product (:mod:`experiments.slayer_kernels`).  Samples are
processed one after the other, and in each sample `PART` time steps, whose arrays fit into a cache.
"""

from dataclasses import dataclass

import numpy as np

from deploy.network.geometry import unpooled
from experiments import slayer_kernels as kernels
from models.architecture import Architecture, Convolution, Dense

# Time steps that all layers process in turn; their arrays then stay in a core's cache.
PART = 100

# Values of 4 bytes in a line of the cache.
LINE = 16

# Channels of a group whose spikes a convolution adds together, at most.
BITS = 6

# Time steps of a matrix product in :func:`experiments.slayer_kernels.propagate`.
TOGETHER = 10


@dataclass(frozen=True)
class SpikeResponse:
    """Parameters of a spike response neuron; times in seconds.

    The defaults are those of the authors' published example on N-MNIST, a similar data set: time
    constants of 10 and 1 steps, theta = 10, refractory scale 2.  The ST-MNIST paper does not state
    its values.

    Attributes
    ----------
    dt : float
        Length of a time step; ST-MNIST paper, Section 3.2.3: bins of 0.01 s.
    tau_s : float
        Time constant of the spike response kernel.
    tau_r : float
        Time constant of the refractory kernel.
    scale_ref : float
        Depth of the refractory response in units of the threshold.
    theta : float
        Threshold.
    tau_rho : float
        Width of the escape rate in units of the threshold.
    scale_rho : float
        Integral of the escape rate on either side of the threshold.
    """

    dt: float = 0.01
    tau_s: float = 0.1
    tau_r: float = 0.01
    scale_ref: float = 2.0
    theta: float = 10.0
    tau_rho: float = 1.0
    scale_rho: float = 1.0

    def __post_init__(self):
        for name in ("dt", "tau_s", "tau_r", "theta", "tau_rho"):
            if getattr(self, name) <= 0:
                raise ValueError(f"SpikeResponse: {name} must be above zero")

    def decay(self, tau: float) -> float:
        """Decay factor per step of a trace with time constant ``tau``."""
        return float(np.exp(-self.dt / tau))

    def gain(self, tau: float) -> float:
        """Factor that scales q to a kernel of unit peak: e/tau with tau in steps."""
        return float(np.e * self.dt / tau)

    @property
    def firing(self) -> np.ndarray:
        """The constants of :func:`experiments.slayer_kernels.fire_from_spikes`."""
        refractory = self.decay(self.tau_r), -self.scale_ref * self.theta * self.gain(self.tau_r)
        response = self.decay(self.tau_s), self.gain(self.tau_s)
        return np.array([*response, *refractory, self.theta], np.float32)

    @property
    def credit(self) -> np.ndarray:
        """The constants of :func:`experiments.slayer_kernels.assign_credit`."""
        tau = self.tau_rho * self.theta
        rho = self.theta, self.scale_rho / tau, 1 / (tau * np.log(2))
        return np.array([self.decay(self.tau_s), self.gain(self.tau_s), *rho], np.float32)

    def response_to_constant(self, steps: int) -> np.ndarray:
        """The correlation eps (x) 1 with a constant error: float32, shape (steps,)."""
        t = np.arange(steps)
        kernel = self.gain(self.tau_s) * t * self.decay(self.tau_s) ** t
        return np.cumsum(kernel)[::-1].astype(np.float32)


@dataclass(frozen=True)
class Folded:
    """A layer with weights and the pooling before it.

    Attributes
    ----------
    layer : Convolution or Dense
    input_shape : tuple of int
        Output shape of the previous layer with weights, before pooling.
    pool : int
        Side length of the pooling windows; 1 without pooling.
    pooled_shape, shape : tuple of int
        Input shape (after pooling) and output shape of ``layer``.
    """

    layer: Convolution | Dense
    input_shape: tuple
    pool: int
    pooled_shape: tuple
    shape: tuple


def folded_layers(architecture: Architecture) -> tuple:
    """The layers with weights, each with the pooling before it, as :class:`Folded`."""
    layers, before, pool = [], architecture.input_shape, 1
    for layer, read, shape in zip(
        architecture.layers, architecture.shapes[:-1], architecture.shapes[1:], strict=True
    ):
        if layer.kind == "pool":
            pool *= layer.size
        else:
            layers.append(Folded(layer, before, pool, read, shape))
            before, pool = shape, 1
    return tuple(layers)


class SlayerNetwork:
    """A network of convolutions and dense layers with spike response neurons.

    Parameters
    ----------
    architecture : Architecture
        For example ``architecture.parse("10x10x2-6c2-24c3-10o")``.  Average pooling acts on the
        responses and has no neurons.
    neuron : SpikeResponse
    seed : int
        Seed of the initial weights, which are uniform in +-scale/sqrt(fan-in).
    conv_scale, dense_scale : float
        Scales of the initial weights.  They must be large enough for spikes to reach the output;
        without spikes there is no gradient.  The defaults are those of the authors' code.

    Attributes
    ----------
    kernels : list of ndarray
        The kernel of each convolution, shape (k, k, input channels, filters), and of each dense
        layer, shape (inputs, units), the output last; float32, may be changed in place.
    """

    def __init__(
        self,
        architecture: Architecture,
        neuron: SpikeResponse | None = None,
        seed: int = 0,
        conv_scale: float = 100.0,
        dense_scale: float = 10.0,
    ):
        self.architecture, self.neuron = architecture, neuron or SpikeResponse()
        rng = np.random.default_rng(seed)
        self.kernels, self._layers = [], []
        for folded in folded_layers(architecture):
            is_conv = folded.layer.kind == "conv"
            shape = folded.layer.weight_shapes(folded.pooled_shape)["kernel"]
            reach = (conv_scale if is_conv else dense_scale) / np.sqrt(np.prod(shape[:-1]))
            self.kernels.append(rng.uniform(-reach, reach, shape).astype(np.float32))
            self._layers.append((_Convolution if is_conv else _Dense)(folded, self.neuron))

    def layers(self, sample) -> list:
        """Potentials and spikes of every layer with weights, in order.

        Parameters
        ----------
        sample : ndarray, shape (steps, rows, columns, channels)
            1 where there is an event in the step, 0 elsewhere; any type.

        Returns
        -------
        list of (potential, spikes)
            Each of shape (steps, rows, columns, filters) or (steps, units): u in float32, including
            the refractory response, and 1 or 0 in uint8.

        Raises
        ------
        ValueError
            The sample does not have the architecture's rows, columns and channels.
        """
        self._load()
        self._run(sample)
        shapes = [(len(sample), *folded.shape) for folded in folded_layers(self.architecture)]
        return [
            (layer.potential.reshape(shape).copy(), layer.spikes.reshape(shape).copy())
            for layer, shape in zip(self._layers, shapes, strict=True)
        ]

    def counts(self, samples) -> np.ndarray:
        """Spike counts of the outputs.

        Parameters
        ----------
        samples : iterable of ndarray, shape (steps, rows, columns, channels) each
            As in :meth:`layers`.

        Returns
        -------
        ndarray of int64, shape (n, outputs)
        """
        self._load()
        return np.array([self._run(sample) for sample in samples])

    def gradients(self, samples, desired) -> tuple:
        """The spike count loss E = 1/2 sum over all t of e(t)^2, e(t) = (count - desired)/T.

        Parameters
        ----------
        samples : ndarray, shape (n, steps, rows, columns, channels)
            As in :meth:`layers`.
        desired : ndarray, shape (n, outputs)
            Desired spike counts.

        Returns
        -------
        loss : float
            Mean over the samples.
        counts : ndarray of int64, shape (n, outputs)
        gradients : list of ndarray of float32
            Of the loss with respect to each of `kernels`.
        """
        self._load()
        counts, loss, steps = [], 0.0, samples.shape[1]
        constant = self.neuron.response_to_constant(steps)[:, None]
        for sample, wanted in zip(samples, desired, strict=True):
            counts.append(self._run(sample))
            error = ((counts[-1] - wanted) / steps).astype(np.float32)
            loss += 0.5 * steps * float(error @ error)
            self._assign(constant * (error / np.float32(len(samples))))
        return loss / len(samples), np.array(counts), [layer.gradient() for layer in self._layers]

    def _load(self):
        """Bring the weights into the order of the compiled loops, and set gradients to zero."""
        for layer, kernel in zip(self._layers, self.kernels, strict=True):
            layer.load(kernel)

    def _run(self, sample):
        """Simulate all layers; returns the spike counts of the outputs."""
        if sample.shape[1:] != self.architecture.input_shape:  # the compiled loops do not check it
            raise ValueError(
                f"a sample of {sample.shape[1:]} for a network of {self.architecture.input_shape}"
            )
        sample = np.ascontiguousarray(sample, np.uint8).reshape(len(sample), -1)
        for layer in self._layers:
            layer.begin(len(sample))
        for part in _parts(len(sample)):
            spikes = sample[part]
            for layer in self._layers:
                spikes = layer.fire(spikes, part)
        return self._layers[-1].spikes.sum(0, dtype=np.int64)

    def _assign(self, error):
        """Add the gradients of the sample of `_run`; ``error`` is eps (x) e of the output."""
        for part in reversed(_parts(len(error))):
            passed = error[part]
            for number in range(len(self._layers) - 1, -1, -1):
                layer = self._layers[number]
                credit = layer.assign(passed, part)
                layer.add_gradient(credit, part)
                if number:
                    passed = layer.propagate(credit)


def _parts(steps):
    """Consecutive time steps that all layers process in turn."""
    return [slice(start, min(start + PART, steps)) for start in range(0, steps, PART)]


class _Layer:
    """Weights, gradient and the activity of one sample of a layer, and of the pooling before it.

    Pooling is linear: a neuron before it has the weights of its window, divided by its area.
    """

    def __init__(self, folded, neuron):
        self.folded = folded
        self.firing, self.credit = neuron.firing, neuron.credit
        self.n, self.n_pooled = int(np.prod(folded.shape)), int(np.prod(folded.pooled_shape))
        windows_from_1 = np.arange(1, self.n_pooled + 1).reshape(folded.pooled_shape)
        if folded.pool > 1:
            windows_from_1 = unpooled(windows_from_1, folded.input_shape, folded.pool)
        # The pooling window of each neuron before it, or -1 where it is in none.
        self.window = windows_from_1.ravel() - 1
        self.share = np.float32(1 / folded.pool**2)
        lines = -(-self.n // LINE) * LINE
        self.traces, self.credit_traces = _aligned((4, lines)), _aligned((2, lines))
        self.error = _aligned((PART, self.n_pooled))
        self.potential = np.empty((0, self.n), np.float32)

    def begin(self, steps):
        """Start a sample."""
        self.traces[:] = 0
        self.credit_traces[:] = 0
        if len(self.potential) != steps:
            self.potential = _aligned((steps, self.n))
            self.spikes = np.empty((steps, self.n), np.uint8)

    def assign(self, error, part):
        """Replace an error by its credit, and return it."""
        kernels.assign_credit(error, self.potential[part], self.credit_traces, self.credit)
        return error

    def before_pooling(self, values):
        """Values of the windows, shape (steps, windows), for the neurons before the pooling."""
        if self.folded.pool == 1:
            return values
        return np.where(self.window >= 0, values[:, self.window], np.float32(0))


class _Convolution(_Layer):
    """A convolution, which adds the weights of all spikes of a site (row, column) together.

    Up to `BITS` channels of a site are a group; there is a sum of weights, and of gradients, for
    each pattern of spikes in a group.  These are in the order (row, column, filter) of the kernel
    with the columns reversed: with stride 1 a site reaches consecutive neurons of a row with
    consecutive weights.
    """

    def __init__(self, folded, neuron):
        super().__init__(folded, neuron)
        channels = folded.input_shape[2]
        start, runs = _runs(folded)
        window = self.window.reshape(-1, channels)[:, 0] // channels
        inside = window >= 0
        self.bits = min(BITS, channels)
        self.groups = -(-channels // self.bits)
        spans = (np.where(inside, start[window + end], 0) for end in (0, 1))
        self.table = (*(np.repeat(x.astype(np.int32), self.groups) for x in spans), runs)
        self.taps = _taps(folded)
        site, channel = np.divmod(np.arange(len(self.window)), channels)
        group, bit = np.divmod(channel, self.bits)
        # Column by column: successive sites then reach the same neurons or distant ones, and a sum
        # need not wait until the one before it is stored.
        order = np.arange(len(self.window)).reshape(folded.input_shape).swapaxes(0, 1).ravel()
        numbers = order, site * self.groups + group, group << self.bits, 1 << bit
        self.inputs = tuple(each.astype(np.uint32) for each in numbers)
        self.which = np.empty(len(self.window) + 1, np.int32)
        patterns = np.arange(2**self.bits)
        self.members = (patterns[:, None] >> np.arange(self.bits) & 1).astype(np.float32)
        self.ends = np.empty(0, np.int32)
        positions = self.n // folded.layer.filters
        width = folded.layer.kernel**2 * channels
        self.products = _aligned((TOGETHER * positions, width))

    def begin(self, steps):
        super().begin(steps)
        if len(self.ends) != steps + 1:
            n = steps * len(self.table[0]) + 1
            self.ends = np.zeros(steps + 1, np.int32)
            self.sites, self.patterns = np.empty(n, np.int32), np.empty(n, np.int32)

    def load(self, kernel):
        side, _, channels, filters = self.shape = kernel.shape
        kernel = kernel * self.share
        self.columns = np.ascontiguousarray(kernel.reshape(-1, filters).T)
        by_channel = np.zeros((self.groups * self.bits, side, side, filters), np.float32)
        by_channel[:channels] = kernel.transpose(2, 0, 1, 3)[:, :, ::-1]
        by_channel = by_channel.reshape(self.groups, self.bits, -1)
        shape = (self.groups, len(self.members), by_channel.shape[-1])
        weights = _aligned(shape)
        np.matmul(self.members, by_channel, out=weights)
        self.weights = weights.reshape(-1, shape[-1])
        self.sums = _aligned(self.weights.shape)

    def fire(self, arriving, part):
        potential, spikes = self.potential[part], self.spikes[part]
        lists = self._lists(part)
        kernels.find_patterns(arriving, self.inputs, self.which, *lists)
        kernels.fire_from_patterns(
            lists, self.table, self.weights, self.traces, self.firing, potential, spikes
        )
        return spikes

    def add_gradient(self, credit, part):
        kernels.add_gradient(self._lists(part), self.table, credit, self.sums)

    def gradient(self):
        side, _, channels, filters = self.shape
        sums = self.members.T @ self.sums.reshape(self.groups, len(self.members), -1)
        sums = sums.reshape(-1, side, side, filters)[:channels, :, ::-1]
        return sums.transpose(1, 2, 0, 3) * self.share

    def _lists(self, part):
        return self.ends[part.start : part.stop + 1], self.sites, self.patterns

    def propagate(self, credit):
        error = self.error[: len(credit)]
        kernels.propagate(credit, self.columns, self.taps, self.products, error)
        return self.before_pooling(error)


class _Dense(_Layer):
    """A dense layer, with weights of the neurons before the pooling: (units, inputs)."""

    def __init__(self, folded, neuron):
        super().__init__(folded, neuron)
        self.error = _aligned((PART, len(self.window)))
        self.arriving = np.empty((0, 0), np.uint8)

    def begin(self, steps):
        super().begin(steps)
        if len(self.arriving) != steps:
            self.arriving = np.empty((steps, len(self.window)), np.uint8)

    def load(self, kernel):
        kernel = np.where(self.window[:, None] >= 0, kernel[self.window] * self.share, 0)
        self.weights, self.sums = _aligned(kernel.T.shape), _aligned(kernel.T.shape)
        self.weights[:] = kernel.T

    def fire(self, arriving, part):
        self.arriving[part] = arriving
        potential, spikes = self.potential[part], self.spikes[part]
        kernels.fire_from_spikes(
            arriving, self.weights, self.traces, self.firing, potential, spikes
        )
        return spikes

    def add_gradient(self, credit, part):
        kernels.add_dense_gradient(self.arriving[part], credit, self.sums)

    def gradient(self):
        if self.folded.pool == 1:
            return self.sums.T
        gradient, inside = np.zeros((self.n_pooled, self.n), np.float32), self.window >= 0
        np.add.at(gradient, self.window[inside], self.sums.T[inside] * self.share)
        return gradient

    def propagate(self, credit):
        error = self.error[: len(credit)]
        return np.dot(credit, self.weights, out=error)


def _aligned(shape):
    """Zeros in float32 that begin where a line of the cache does: some loops take half the time."""
    raw = np.zeros(int(np.prod(shape)) + LINE, np.float32)
    start = -raw.ctypes.data % (4 * LINE) // 4
    return raw[start : start + int(np.prod(shape))].reshape(shape)


def _runs(folded):
    """Targets of the spikes of each site of a convolution's input.

    Returns
    -------
    start : ndarray of int64, shape (sites + 1,)
        First run of each site, and the number of runs.
    runs : ndarray of int32, shape (n, 3)
        First neuron, first weight, number of consecutive neurons and weights.
    """
    layer, (rows, columns, _) = folded.layer, folded.pooled_shape
    side, filters, width = layer.kernel, layer.filters, folded.shape[1]
    start, runs = [0], []
    for row, column in np.ndindex(rows, columns):
        for y, i in _reached(layer, folded, 0, row):
            reached = list(_reached(layer, folded, 1, column))
            if layer.stride == 1 and reached:
                (x, j), length = reached[0], len(reached) * filters
                reached = [(x, j)]
            else:
                length = filters
            for x, j in reached:
                neuron, weight = (y * width + x) * filters, (i * side + side - 1 - j) * filters
                runs.append((neuron, weight, length))
        start.append(len(runs))
    return np.array(start), np.array(runs, np.int32).reshape(-1, 3)


def _reached(layer, folded, axis, at):
    """Output positions along an axis that see an input position, and the kernel's index there."""
    before = layer.pads(folded.pooled_shape)[axis][0]
    for position in range(folded.shape[axis]):
        index = at + before - position * layer.stride
        if 0 <= index < layer.kernel:
            yield position, index


def _taps(folded):
    """Additions of :func:`experiments.slayer_kernels.propagate`, int32, shape (n, 4)."""
    layer, (rows, columns, channels) = folded.layer, folded.pooled_shape
    side, taps = layer.kernel, []
    (above, _), (left, _) = layer.pads(folded.pooled_shape)
    # Column by column: successive taps then have the same inputs or distant ones.
    for x, y, i in np.ndindex(folded.shape[1], folded.shape[0], side):
        row, column = y * layer.stride - above + i, x * layer.stride - left
        begin, end = max(column, 0), min(column + side, columns)
        if 0 <= row < rows and begin < end:
            position, source = y * folded.shape[1] + x, (row * columns + begin) * channels
            tap = (i * side + begin - column) * channels
            taps.append((position, source, tap, (end - begin) * channels))
    return np.array(taps, np.int32).reshape(-1, 4)
