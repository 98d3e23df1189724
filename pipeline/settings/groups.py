"""The groups of settings: the default of each setting, its limits, and above it its meaning.

A default that stands for a value that the program chooses is made by :func:`declare_automatic`.

``stmnist settings`` prints the meanings.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from deploy import limits
from deploy.loading import KeyOf, Limit, between, one_of
from deploy.network.presentation import Presentation
from pipeline import paper
from pipeline.settings.base import SettingsGroup

AGGREGATIONS = ("count", "columns", "signed", "on", "off", "polarities")
AUGMENTATIONS = ("auto", "time", "slight", "space", "none")
NIR_METHODS = ("auto", "exact", "euler", "norse", "rockpool", "spyx")
NIR_RESETS = ("auto", "value", "subtract", "subtract-late", "subtract-all")
SNN_RECIPES = ("loihi", "paper", "as-is")
# The name of the built-in recordings.
SIMULATED = "simulated"
# Values of ``input.kind``, each with the sort of samples that networks get: images, or frames of
# events.  :func:`pipeline.kinds.registry.register_kind` adds those of another kind of network.
INPUTS = {"image": "images", "slices": "images", "events": "frames"}
NORMALISATIONS = ("max", "sum", "sqrt-max", "sqrt-clip", "none")

SEED = between(0, 2**31 - 1)
EPOCHS_OR_AUTOMATIC = between(0, limits.EPOCHS)
BATCH = between(1, limits.BATCH)
BATCH_OR_AUTOMATIC = between(0, limits.BATCH)
STEPS_OR_0 = between(0, limits.STEPS)
MAX_DOWNSAMPLING = 64
MAX_SECTIONS = 64
SAMPLES = between(1, limits.SAMPLES)
SAMPLES_OR_ALL = between(0, limits.SAMPLES)
TAU_S = between(1e-6, limits.SECONDS, " seconds")
TAU_S_OR_NONE = between(0, limits.SECONDS, " seconds")
REFRACTORY_S = between(1e-9, limits.REFRACTORY_S, " seconds")
AT_LEAST_0 = between(0, 1000)
ABOVE_0 = Limit(lambda value: 0 < value <= 1000, "above 0, at most 1000")
INSIDE_0_1 = Limit(lambda value: 0 < value < 1, "between 0 and 1")
FROM_0_BELOW_1 = Limit(lambda value: 0 <= value < 1, "from 0 to below 1")
RATE_HZ = Limit(lambda value: 0 < value <= 1000, "above 0, at most 1000")
STEP_MS = between(1e-3, 1000, " milliseconds")
STEP_MS_OR_AUTOMATIC = Limit(
    lambda value: value == 0 or 1e-3 <= value <= 1e6, "0, or from 0.001 to 1000000 milliseconds"
)
MAX_TAU_MS = 1e6
SIDE = between(0, 256)


def declare_automatic(default):
    """A setting whose default stands for a value that the program chooses.

    To state the default is to ask for the choice: such a value is never the user's, see
    :meth:`pipeline.settings.schema.Settings.find_provenance`.
    """
    return field(default=default, metadata={"automatic": True})


@dataclass(frozen=True)
class Data(SettingsGroup):
    """The recordings."""

    #: ``simulated``, or the path of a zip or folder of recordings, such as ST-MNIST's.
    source: str = "simulated"
    #: Seed of simulated recordings; the experiment's own seed does not change them.
    simulation_seed: Annotated[int, SEED] = 0
    #: Simulated recordings of each digit; 0 for the published numbers, 6,953 in all.
    samples_per_digit: Annotated[int, SAMPLES_OR_ALL] = declare_automatic(0)
    #: Simulated people.  ST-MNIST has 23; with more of them a network learns less of single ones.
    writers: Annotated[int, between(1, limits.SAMPLES)] = 1000
    #: Share of the simulated recordings that keep the order of events and not their time, as the
    #: published arrays of ST-MNIST do: events in one hundred chunks.
    chunked: Annotated[float, between(0, 1)] = 0.0
    #: Share of the simulated digits that are written as people write on a tablet, with more forms
    #: of each digit; the others are written as the people of ST-MNIST wrote on the sensor.
    tablet: Annotated[float, between(0, 1)] = 0.15
    #: Share of the simulated people who draw a 0 or an 8 from its end to its beginning.
    reversed: Annotated[float, between(0, 1)] = 0.1
    #: Share of the simulated recordings that have the place, size, force and contact width of any
    #: digit; the others have those that the recordings of ST-MNIST have for their digit.
    mixed_forms: Annotated[float, between(0, 1)] = 0.0
    #: Leave out files that cannot be read instead of stopping.
    skip_bad: bool = False
    #: Unit of the times in files of events (not .mat): s, ms, us or ns; empty: inferred from the
    #: duration of the recordings.
    time_unit: Annotated[str, one_of("", "s", "ms", "us", "ns")] = declare_automatic("")
    #: Arrays of counts (.npy of three dimensions): width of a bin in milliseconds.
    bin: Annotated[float, between(0.001, 60_000, " milliseconds")] = 20.0
    #: Arrays of counts: channel of rising pressure, 0 or 1; -1: 1 on ST-MNIST's grid of a hundred
    #: taxels, otherwise 0.
    rise: Annotated[int, between(-1, 1)] = declare_automatic(-1)
    #: Files of events: side of the square of pixels that becomes one taxel; 1 for all pixels.
    downsample: Annotated[int, between(1, MAX_DOWNSAMPLING)] = 1

    @property
    def bin_ms(self) -> float:
        """``bin``, the width of a bin of counts."""
        return self.bin


@dataclass(frozen=True)
class Input(SettingsGroup):
    """The input of the network on the chip."""

    #: ``image``: a recording's tactile image as evenly spaced spikes, as in the paper; ``slices``:
    #: the same with an image for each of several slices of time and each polarity, all at once,
    #: which tells the order of events; ``events``: the sensor's events.
    kind: Annotated[str, KeyOf(INPUTS)] = "image"
    #: Recording time in milliseconds that one step of the chip represents; for ``events`` only.
    step: Annotated[float, STEP_MS] = 10.0
    #: Refractory period of a taxel and polarity after a spike, in milliseconds, rounded down to
    #: whole steps, as of an event camera's pixel: events in it are ignored.  For ``events`` only.
    refractory: Annotated[float, AT_LEAST_0] = 10.0
    #: Maximum number of spikes of a taxel and polarity in a sample; later events of it are ignored,
    #: so that a taxel that fires all the time has little weight.  0: no limit.  For ``events``
    #: only.
    max_spikes: Annotated[int, STEPS_OR_0] = 0

    @property
    def step_ms(self) -> float:
        """``step``, the recording time of a step."""
        return self.step

    @property
    def refractory_ms(self) -> float:
        """``refractory``, the refractory period of a taxel and polarity."""
        return self.refractory

    @property
    def refractory_steps(self) -> int:
        """The refractory period in steps."""
        return int(self.refractory_ms / self.step_ms + 1e-9)


@dataclass(frozen=True)
class SkinSize(SettingsGroup):
    """The array of taxels."""

    #: Rows of taxels; 0: ten for the simulated sensor, and for recordings the number in their
    #: look-up table or their largest coordinate.
    rows: Annotated[int, SIDE] = declare_automatic(0)
    #: Columns of taxels; 0 has the same meaning as for the rows.
    columns: Annotated[int, SIDE] = declare_automatic(0)


@dataclass(frozen=True)
class Image(SettingsGroup):
    """Conversion of events to a tactile image; see :mod:`pipeline.recordings.images`."""

    #: Quantity for each taxel: ``count``, physical events; ``columns``, columns of the file, as in
    #: the paper's Table 1; ``signed``, ON minus OFF events; ``on`` or ``off``, one polarity only;
    #: ``polarities``, ON and OFF events as two channels.
    aggregation: Annotated[str, one_of(*AGGREGATIONS)] = "count"
    #: Number of equal slices of time whose events are counted separately, each as channels of the
    #: image.
    slices: Annotated[int, between(1, 64)] = 1
    #: Time from the first event that is divided into slices, in milliseconds; later events are
    #: counted in the last slice.  0 for two seconds.
    duration: Annotated[float, between(0, 1e7, " milliseconds")] = declare_automatic(0.0)
    #: Divisor of an image: ``max``, its largest magnitude; ``sum``, the sum of magnitudes;
    #: ``sqrt-max``, as ``max`` after the square root of each magnitude; ``sqrt-clip``, as
    #: ``sqrt-max`` without regard to the 2 % of the taxels with the largest magnitudes, which are
    #: clipped at 1; ``none``, undivided counts, which need a low ``deployment.input_rate``.
    #: ``sqrt-clip`` is chosen for networks that are trained here.
    normalisation: Annotated[str, one_of(*NORMALISATIONS)] = "max"

    @property
    def channels(self) -> int:
        """Channels of an image."""
        return self.slices * (2 if self.aggregation == "polarities" else 1)

    @property
    def duration_ms(self) -> float:
        """Time that is divided into slices, also if ``duration`` is 0."""
        return self.duration or 1000 * paper.DURATION_S


@dataclass(frozen=True)
class SplitShares(SettingsGroup):
    """The test and validation samples."""

    #: ``published``, the split of a source with the folders ``train`` and ``test``; ``random``,
    #: over all samples, as in the paper; ``writers``, people with test samples have no training
    #: samples; ``auto``, the published one if there is one, otherwise random.
    kind: Annotated[str, one_of("auto", "random", "published", "writers")] = declare_automatic(
        "auto"
    )

    #: Share of all samples that is used for testing (paper: 80-20 splits); not of a published
    #: split, which has its own.
    test_fraction: Annotated[float, INSIDE_0_1] = paper.TEST_FRACTION
    #: Share of the training samples that is held out for choosing settings.
    validation_fraction: Annotated[float, FROM_0_BELOW_1] = 0.0


@dataclass(frozen=True)
class CNN(SettingsGroup):
    """The convolutional network and its training (paper, Section 3.2.1)."""

    #: Input, convolutions (``6c4``: six filters of 4x4) and outputs.
    architecture: str = "10x10-6c4-24c3-10o"
    #: Passes over the training samples; 0 for the paper's 20, or more on few samples.
    epochs: Annotated[int, EPOCHS_OR_AUTOMATIC] = declare_automatic(0)
    #: Samples per training step.  Not given in the paper; 20 epochs with Keras's default, 32, are
    #: too few updates for an accuracy as high as the paper's.
    batch_size: Annotated[int, BATCH] = 8
    #: Learning rate of RMSProp.  Not given in the paper; Keras's default.
    learning_rate: Annotated[float, ABOVE_0] = 0.001
    #: Alterations of the events of training samples, before the image is made: ``time``, dropped
    #: events, and hot and dead taxels; ``space``, also rotated, shifted, scaled and sheared on the
    #: grid of taxels; ``slight``, the same half as much; ``none``; ``auto``, ``none`` for the
    #: paper's CNN, and in the training of the spiking network ``slight`` for digits on a grid of
    #: taxels and ``time`` for other recordings.
    augment: Annotated[str, one_of(*AUGMENTATIONS)] = declare_automatic("auto")
    #: A Keras model file whose weights replace trained ones; ``convert --model`` sets it.
    model: str = ""
    #: SHA-256 of that file's content.
    model_sha256: str = ""


@dataclass(frozen=True)
class SNN(SettingsGroup):
    """Training with rate-LIF neurons (paper, Section 3.2.2)."""

    #: ``loihi``: the chip's rates and 8-bit weights in the forward pass, noise that models the
    #: fluctuation caused by spikes, starting from the CNN's weights.  ``paper``: plain rate-LIF,
    #: from new initial weights, trained like the CNN.  ``as-is``: the CNN's weights, scaled
    #: to the neurons' range and response curve without further training.
    recipe: Annotated[str, one_of(*SNN_RECIPES)] = "loihi"
    #: Passes over the training samples; 0 for the default of the recipe, or more on few samples.
    epochs: Annotated[int, EPOCHS_OR_AUTOMATIC] = declare_automatic(0)
    #: Samples per training step; 0 for the default of the recipe.
    batch_size: Annotated[int, BATCH_OR_AUTOMATIC] = declare_automatic(0)
    #: Initial learning rate; 0 for the default of the recipe.
    learning_rate: Annotated[float, AT_LEAST_0] = declare_automatic(0.0)
    #: Standard deviation of the noise on each neuron's input while training, relative to the
    #: activation at ``max_rates``; recipe ``loihi`` only.
    noise: Annotated[float, AT_LEAST_0] = 0.05
    #: Share of the neurons that are left out at random while training; recipe ``loihi`` only.
    dropout: Annotated[float, FROM_0_BELOW_1] = 0.0
    #: Weight of the penalty on synaptic operations in the loss; they are counted over 100 steps,
    #: in multiples of the CNN's multiply-accumulates.  Recipe ``loihi`` only.
    spike_penalty: Annotated[float, AT_LEAST_0] = 0.01
    #: Spikes per second of the neurons of each convolution and hidden dense layer at activation 1;
    #: the last entry also applies to all layers after it.
    max_rates: tuple[float, ...] = (150.0,)
    #: Membrane time constant in seconds.
    tau_rc: Annotated[float, TAU_S] = 0.02
    #: Refractory period in seconds.
    tau_ref: Annotated[float, REFRACTORY_S] = 0.001

    @property
    def is_on_chip(self) -> bool:
        """True if the rate-based network has the chip's rates and 8-bit weights."""
        return self.recipe != "paper"

    def get_max_rate(self, index: int) -> float:
        """The maximum rate of layer of neurons ``index``, counted from 0."""
        return self.max_rates[min(index, len(self.max_rates) - 1)]


@dataclass(frozen=True)
class NIR(SettingsGroup):
    """A NIR graph that replaces the trained network; see :mod:`pipeline.kinds.nir.kind`."""

    #: A NIR graph, such as one exported from PyTorch; ``convert --nir`` sets it; empty for
    #: networks that are trained here.
    file: str = ""
    #: SHA-256 of that file's content.
    sha256: str = ""
    #: Milliseconds of the graph's time in a step of the chip; 0: that of the framework that wrote
    #: the graph, if it is recognised, otherwise the value of ``input.step``, or 1 with images.
    step: Annotated[float, STEP_MS_OR_AUTOMATIC] = declare_automatic(0.0)
    #: Step of the graph's equations: ``exact``, their exact solution; ``euler``, forward Euler
    #: steps; ``norse``, ``rockpool``, ``spyx``, those of these frameworks; ``auto``, that of the
    #: framework that wrote the graph, ``exact`` if none is recognised.
    method: Annotated[str, one_of(*NIR_METHODS)] = declare_automatic("auto")
    #: The reset with which the graph was trained, which NIR does not record: ``value``, to
    #: ``v_reset``, as on the chip; ``subtract``, by the threshold; ``subtract-late``, in the next
    #: step, as snnTorch does unless ``reset_delay=False``; ``subtract-all``, as often as it fits,
    #: with a spike each, as sinabs and Rockpool do by default; ``auto``, ``subtract`` or
    #: ``subtract-late`` if Rockpool or Spyx wrote the graph, otherwise ``value``.
    reset: Annotated[str, one_of(*NIR_RESETS)] = declare_automatic("auto")
    #: Synapses that add up to a weight of a recurrent layer, which is finer with two than the 8
    #: bits of one; 0: two if the layer then fits on a core, otherwise one.
    synapses_per_weight: Annotated[int, between(0, limits.SYNAPSES_PER_WEIGHT)] = declare_automatic(
        0
    )

    @property
    def step_ms(self) -> float:
        """``step``, the graph's time in a step; 0 for that of its framework."""
        return self.step


@dataclass(frozen=True)
class EventTraining(SettingsGroup):
    """The spiking network that is trained on events; see :mod:`pipeline.training.events`."""

    #: Capacity of a network whose architecture and budget follow from the recordings: ``small``,
    #: ``standard`` with about three times as many operations, or ``large`` with five times as many,
    #: which is trained three times as long; ``auto``, ``small`` for simulated handwriting and
    #: ``standard`` for other recordings.
    size: Annotated[str, one_of("auto", "small", "standard", "large")] = declare_automatic("auto")
    #: Notation as for the CNN, with a channel for each polarity, a hidden layer and no pooling.
    architecture: str = "10x10x2-24c4s3-64-10o"
    #: Consecutive sections of a recording, which have readout weights of their own; 0: as the
    #: recordings need, one for handwriting.
    parts: Annotated[int, between(0, MAX_SECTIONS)] = declare_automatic(0)
    #: Length of each section in milliseconds, the last one is open; 0: the presentation, divided
    #: among the sections; for handwriting two seconds.
    part: Annotated[float, between(0, 1e6, " milliseconds")] = declare_automatic(0.0)
    #: Passes over the training samples; 0: as many as a suitable number of updates needs.
    epochs: Annotated[int, EPOCHS_OR_AUTOMATIC] = declare_automatic(0)
    #: Samples per training step.
    batch_size: Annotated[int, BATCH] = 32
    #: Share of a layer's neurons whose spikes are left out of a training sample.
    dropout: Annotated[float, FROM_0_BELOW_1] = 0.1
    #: Initial learning rate of Adam; it falls to 0 along a half cosine.
    learning_rate: Annotated[float, ABOVE_0] = 0.003
    #: Initial time constants of the neurons' current in milliseconds of recording time, one per
    #: layer; the last one also applies to all later layers.  Shorter, if it is not set, for
    #: presentations below half a second.
    tau_u_ms: tuple[float, ...] = (30.0,)
    #: Initial time constants of the neurons' voltage; otherwise as for the current.
    tau_v_ms: tuple[float, ...] = (80.0,)
    #: Weight of the loss term for early decisions, before the recording ends.
    early: Annotated[float, AT_LEAST_0] = 1.0
    #: Alterations of training samples: ``time``, stretched times, dropped events, and hot and dead
    #: taxels; ``space``, also rotated, shifted, scaled and sheared on the grid of taxels;
    #: ``slight``, the same half as much; ``none``; ``auto``, ``space`` for handwriting on the
    #: simulated sensor or in ST-MNIST's files, ``slight`` for other grids of taxels, and ``time``
    #: for other recordings.
    augment: Annotated[str, one_of(*AUGMENTATIONS)] = declare_automatic("auto")
    #: Synaptic operations per inference above which the loss has a penalty, in multiples of the
    #: multiply-accumulates of the paper's CNN.
    budget: Annotated[float, ABOVE_0] = 0.8

    @property
    def section_ms(self) -> float:
        """``part``, the length of a section of the readout; 0 for the presentation's share."""
        return self.part

    def find_section_starts(self, step_ms: float) -> tuple:
        """First step of each section of a presentation, in steps of a length in milliseconds."""
        n_sections = self.parts or 1
        section_ms = self.section_ms or 1000 * paper.DURATION_S / n_sections
        section_steps = section_ms / step_ms
        return tuple(sorted({round(k * section_steps) for k in range(n_sections)}))


@dataclass(frozen=True)
class Deployment(SettingsGroup):
    """Placement of the spiking network on chip and host; see :mod:`deploy.network.spec`."""

    #: ``host``: output decoded from the spikes of the last layer of neurons; ``chip``: a neuron
    #: for each class, of networks on images only.
    readout: Annotated[str, one_of("chip", "host")] = "host"
    #: Spikes per second of a pixel of value 1.
    input_rate: Annotated[float, RATE_HZ] = 500.0
    #: Initial voltage of an input neuron in a sample, as a share of its threshold.  Its number of
    #: spikes is the expected number, rounded to the nearest with 0.5 and down with 0.
    input_phase: Annotated[float, FROM_0_BELOW_1] = 0.5
    #: Time constant in seconds of the low-pass on every spiking connection; 0 for none.
    synapse: Annotated[float, TAU_S_OR_NONE] = 0.008

    @property
    def input_rate_hz(self) -> float:
        """``input_rate``, the spike rate of a pixel of value 1."""
        return self.input_rate

    @property
    def synapse_s(self) -> float:
        """``synapse``, the time constant of every spiking connection; 0 for none."""
        return self.synapse


@dataclass(frozen=True)
class PresentationSettings(SettingsGroup):
    """Presentation of the samples; see :class:`deploy.network.presentation.Presentation`."""

    #: Number of steps for which a sample is presented: steps of 1 ms, or with events of
    #: ``input.step``.  0 for 100 steps, or with events for as many as the
    #: longest recording needs, from 50 to 400.
    steps: Annotated[int, STEPS_OR_0] = declare_automatic(0)
    #: Silent steps before each sample.  More, if it is not set, where the neurons' currents last
    #: longer.
    gap: Annotated[int, STEPS_OR_0] = Presentation.gap
    #: First step of the readout window, over which the output is averaged for the decision; with
    #: events always the first step of the presentation.
    readout_start: Annotated[int, STEPS_OR_0] = Presentation.readout_start
    #: Number of samples that are presented before the network is reset.
    stream_length: Annotated[int, SAMPLES] = Presentation.stream_length
    #: Largest loss of accuracy by early decisions, on held-out samples; a smaller one makes fewer
    #: mistakes and later decisions.  Events only.
    early_loss: Annotated[float, FROM_0_BELOW_1] = 0.005


@dataclass(frozen=True)
class Check(SettingsGroup):
    """The check that is run on every target."""

    #: Number of samples, drawn at random from the test set, as in the paper; 0 for all. If it
    #: is not set, all too if there are fewer.
    samples: Annotated[int, SAMPLES_OR_ALL] = paper.CHECK_SAMPLES

    def count_samples(self, available: int) -> int:
        """Number of samples to draw.

        Parameters
        ----------
        available : int
            Size of the test set.
        """
        if self.samples in (0, paper.CHECK_SAMPLES):
            return min(self.samples or available, max(available, 1))
        return self.samples
