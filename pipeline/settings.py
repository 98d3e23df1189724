"""Every setting of an experiment, with its default, in one place; kept in ``experiment.toml``."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

from deploy.errors import UserError
from deploy.files import replacing
from models.architecture import NotationError, parse

AGGREGATIONS = ("count", "columns", "signed", "on", "off")
NORMALISATIONS = ("max", "sum", "sqrt-max", "none")


@dataclass(frozen=True)
class Data:
    """Which recordings."""

    source: str = "simulated"
    """``"simulated"``, or the path of an ST-MNIST zip or folder."""
    simulation_seed: int = 0
    """Seed of simulated recordings; the experiment's own seed does not change them."""
    samples_per_digit: int = 0
    """Simulated recordings of each digit; 0 for the published numbers, 6,953 in all."""
    skip_bad: bool = False
    """Leave out files that cannot be read instead of stopping."""


@dataclass(frozen=True)
class Image:
    """How events become a tactile image; see :mod:`pipeline.inputs.images`."""

    aggregation: str = "count"
    normalisation: str = "max"


@dataclass(frozen=True)
class Split:
    """Which samples are for what."""

    test_fraction: float = 0.2
    """Share of all samples (paper: 80-20 splits)."""
    validation_fraction: float = 0.0
    """Share of the training samples that is kept for choosing settings."""


@dataclass(frozen=True)
class CNN:
    """The convolutional network and its training (paper, Section 3.2.1)."""

    architecture: str = "10x10-6c4-24c3-10o"
    epochs: int = 20
    batch_size: int = 32
    """Not given in the paper; Keras's default."""
    learning_rate: float = 0.001
    """Not given in the paper; Keras's default for RMSProp."""


@dataclass(frozen=True)
class SNN:
    """Training with rate-based LIF neurons (paper, Section 3.2.2)."""

    recipe: str = "loihi"
    """``"loihi"``: the chip's rates and 8-bit weights in the forward pass, noise that stands for
    the ripple of spikes, starting from the CNN's weights; ``"paper"``: plain rate-based LIF, from
    new weights, trained as the CNN is."""
    epochs: int = 0
    """0 here and in the next two for the recipe's own; see pipeline/training/networks.py."""
    batch_size: int = 0
    learning_rate: float = 0.0
    noise: float = 0.1
    """Standard deviation of the noise on each neuron's input while training, relative to the
    activation at ``max_rates``; recipe ``"loihi"`` only."""
    spike_penalty: float = 0.05
    """Weight in the loss of the synaptic operations of 100 steps, in units of the CNN's
    multiply-accumulates; recipe ``"loihi"`` only."""
    max_rates: tuple = (150.0, 150.0)
    """Spikes a second of the neurons of each convolution and hidden dense layer at activation 1;
    the last entry holds for all layers after it."""
    tau_rc: float = 0.02
    """Membrane time constant in seconds."""
    tau_ref: float = 0.001
    """Refractory period in seconds."""

    def max_rate(self, index: int) -> float:
        """Of layer of neurons ``index``, from 0."""
        return self.max_rates[min(index, len(self.max_rates) - 1)]


@dataclass(frozen=True)
class Slayer:
    """Training on the events themselves (paper, Section 3.2.3)."""

    architecture: str = "10x10x2-6c2-24c3-10o"
    bins: int = 200
    """Time steps; of two seconds, so 10 ms each (paper)."""
    epochs: int = 100
    batch_size: int = 32
    """Not given in the paper."""
    learning_rate: float = 0.01
    """Not given in the paper; that of the SLAYER authors' own examples, as is the optimiser."""
    true_count: float = 60.0
    """Desired spikes of the right digit's output neuron (paper)."""
    false_count: float = 10.0
    """Desired spikes of each other output neuron (paper)."""
    tau_s: float = 0.1
    """Time constant in seconds of a neuron's response to a spike.  Not given in the paper; the
    SLAYER authors' own examples have 10 time steps, which are 0.1 s here."""
    tau_r: float = 0.01
    """Time constant in seconds of its refractory response; 1 time step in those examples."""
    conv_scale: float = 100.0
    """How far the first weights of a convolution reach, in units of 1/sqrt(inputs): that of the
    SLAYER authors' code, which the paper used unmodified.  10 does far better
    (results/README.md)."""
    dense_scale: float = 10.0
    """The same of the output layer's weights, from the same code."""


@dataclass(frozen=True)
class Deployment:
    """How the spiking network is laid out; see :mod:`deploy.network.spec`."""

    first_layer: str = "chip"
    """``"chip"``: the image becomes spikes in an input layer on the host, all convolutions are on
    the chip; ``"host"``: the first convolution's neurons are on the host, fed with currents."""
    readout: str = "host"
    """``"host"``: output decoded from the last convolution's spikes; ``"chip"``: ten neurons."""
    input_rate: float = 500.0
    """Spikes a second of a pixel of value 1."""
    input_phase: float = 0.5
    """Voltage of the input neurons at the start of a stream."""
    synapse: float = 0.008
    """Time constant in seconds of the low-pass on every spiking connection; 0 for none."""
    pop_type: int = 32


@dataclass(frozen=True)
class Presentation:
    """How samples are shown; see :class:`deploy.network.spec.Presentation`."""

    steps: int = 100
    gap: int = 20
    readout_start: int = 20
    stream_length: int = 10


@dataclass(frozen=True)
class Check:
    """The check that every target answers."""

    samples: int = 200
    """Drawn from the test split (paper: 200 random test samples)."""


@dataclass(frozen=True)
class Settings:
    """All settings of an experiment."""

    seed: int = 0
    """Of the split, the training and the choice of the check's samples."""
    data: Data = field(default_factory=Data)
    image: Image = field(default_factory=Image)
    split: Split = field(default_factory=Split)
    cnn: CNN = field(default_factory=CNN)
    snn: SNN = field(default_factory=SNN)
    slayer: Slayer = field(default_factory=Slayer)
    deployment: Deployment = field(default_factory=Deployment)
    presentation: Presentation = field(default_factory=Presentation)
    check: Check = field(default_factory=Check)

    def with_values(self, changes: dict, origin: str) -> Settings:
        """These settings with some changed.

        Parameters
        ----------
        changes : dict
            As read from TOML: ``{"seed": 1, "cnn": {"epochs": 5}}``.
        origin : str
            Where they come from, for the error's line.

        Raises
        ------
        UserError
            An unknown setting, or a value of the wrong kind or out of range.
        """
        settings = _changed(self, changes, origin, "")
        _validate(settings, origin)
        return settings

    def to_json(self) -> dict:
        """As plain values."""
        return asdict(self)


def read_settings(path) -> Settings:
    """Read ``experiment.toml``.

    Raises
    ------
    UserError
        It cannot be read, is not TOML, or has an unknown or wrong setting.
    """
    try:
        values = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: cannot read ({error.strerror}); check the path") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: not valid TOML ({error}); mend or delete it") from error
    return Settings().with_values(values, str(path))


def write_settings(path, settings: Settings):
    """Write every setting, resolved; inverse of :func:`read_settings`."""
    sections = settings.to_json()
    lines = ["# Every setting of this experiment; what each means is in pipeline/settings.py."]
    lines += [f"{k} = {_toml(v)}" for k, v in sections.items() if not isinstance(v, dict)]
    for name, section in sections.items():
        if isinstance(section, dict):
            lines += ["", f"[{name}]", *(f"{k} = {_toml(v)}" for k, v in section.items())]
    with replacing(path, "w") as file:
        file.write("\n".join(lines) + "\n")


def parse_assignments(assignments) -> dict:
    """Turn ``["cnn.epochs=5", "seed=1"]`` into nested values.

    Values are read as TOML, and as plain text where that fails.

    Raises
    ------
    UserError
        An entry is not of the form ``name=value``.
    """
    values: dict = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or not name.strip():
            raise UserError(f"--set {assignment!r}: expected section.name=value")
        try:
            value = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            value = text.strip()
        *sections, last = name.strip().split(".")
        place = values
        for section in sections:
            place = place.setdefault(section, {})
            if not isinstance(place, dict):
                raise UserError(f"--set {assignment!r}: {section!r} has a value of its own too")
        place[last] = value
    return values


def _toml(value):
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_toml, value)) + "]"
    # The same for text, numbers and booleans, but for one character that only TOML escapes.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _changed(settings, changes, origin, prefix):
    known = {entry.name: getattr(settings, entry.name) for entry in fields(settings)}
    values = {}
    for name, value in changes.items():
        full = prefix + name
        if name not in known:
            raise UserError(
                f"{origin}: unknown setting {full!r}; known here: {', '.join(sorted(known))}"
            )
        default = known[name]
        if hasattr(default, "__dataclass_fields__"):
            if not isinstance(value, dict):
                raise UserError(f"{origin}: {full!r} is a section, write it as [{full}]")
            values[name] = _changed(default, value, origin, full + ".")
        else:
            values[name] = _coerced(value, default, origin, full)
    return replace(settings, **values)


def _coerced(value, default, origin, name):
    def fail(kind):
        raise UserError(f"{origin}: {name!r} must be {kind}, not {value!r}")

    if isinstance(default, bool):
        return value if isinstance(value, bool) else fail("true or false")
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if isinstance(default, int):
        return value if number and isinstance(value, int) else fail("a whole number")
    if isinstance(default, float):
        return float(value) if number and math.isfinite(value) else fail("a number")
    if isinstance(default, tuple):
        if not isinstance(value, (list, tuple)):
            fail("a list")
        return tuple(_coerced(entry, default[0], origin, name) for entry in value)
    try:
        value.encode()
    except (AttributeError, UnicodeEncodeError):
        fail("text (in UTF-8)")
    return value


def _validate(s: Settings, origin):
    def need(condition, name, expected):
        if not condition:
            raise UserError(f"{origin}: {name!r} must be {expected}")

    need(0 <= s.seed < 2**31, "seed", f"from 0 to {2**31 - 1}")
    need(0 <= s.data.simulation_seed < 2**31, "data.simulation_seed", f"from 0 to {2**31 - 1}")
    need(s.data.samples_per_digit >= 0, "data.samples_per_digit", "0 or more")
    need(s.image.aggregation in AGGREGATIONS, "image.aggregation", _one_of(AGGREGATIONS))
    need(s.image.normalisation in NORMALISATIONS, "image.normalisation", _one_of(NORMALISATIONS))
    need(0 < s.split.test_fraction < 1, "split.test_fraction", "between 0 and 1")
    need(0 <= s.split.validation_fraction < 1, "split.validation_fraction", "from 0 to below 1")
    for name, training in (("cnn", s.cnn), ("slayer", s.slayer)):
        need(training.epochs >= 1, f"{name}.epochs", "1 or more")
        need(training.batch_size >= 1, f"{name}.batch_size", "1 or more")
        need(training.learning_rate > 0, f"{name}.learning_rate", "above 0")
    for name in ("epochs", "batch_size", "learning_rate", "noise", "spike_penalty"):
        need(getattr(s.snn, name) >= 0, f"snn.{name}", "0 or more")
    need(s.snn.recipe in ("loihi", "paper"), "snn.recipe", _one_of(("loihi", "paper")))
    need(s.snn.tau_rc > 0, "snn.tau_rc", "above 0")
    need(s.snn.tau_ref > 0, "snn.tau_ref", "above 0")
    for name in ("first_layer", "readout"):
        need(getattr(s.deployment, name) in ("chip", "host"), f"deployment.{name}",
             _one_of(("chip", "host")))  # fmt: skip
    need(0 < s.deployment.input_rate <= 1000, "deployment.input_rate", "above 0, at most 1000")
    need(0 <= s.deployment.input_phase < 1, "deployment.input_phase", "from 0 to below 1")
    need(s.deployment.synapse >= 0, "deployment.synapse", "0 or more")
    need(s.deployment.pop_type in (16, 32), "deployment.pop_type", "16 or 32")
    need(s.presentation.steps >= 1, "presentation.steps", "1 or more")
    need(s.presentation.gap >= 0, "presentation.gap", "0 or more")
    need(0 <= s.presentation.readout_start < s.presentation.steps, "presentation.readout_start",
         f"from 0 to below presentation.steps ({s.presentation.steps})")  # fmt: skip
    need(s.presentation.stream_length >= 1, "presentation.stream_length", "1 or more")
    need(s.check.samples >= 1, "check.samples", "1 or more")
    need(s.slayer.bins >= 1, "slayer.bins", "1 or more")
    for name in ("tau_s", "tau_r", "conv_scale", "dense_scale"):
        need(getattr(s.slayer, name) > 0, f"slayer.{name}", "above 0")
    need(_parsed(s.slayer.architecture, "slayer.architecture", origin).input_shape == (10, 10, 2),
         "slayer.architecture", "for 10x10x2, a channel for each polarity")  # fmt: skip
    architecture = _parsed(s.cnn.architecture, "cnn.architecture", origin)
    need(architecture.input_shape == (10, 10, 1), "cnn.architecture",
         "for a tactile image of 10x10")  # fmt: skip
    n_spiking = len(architecture.spiking)
    need(n_spiking >= 1, "cnn.architecture", "a network with a layer of neurons before its output")
    need(architecture.outputs == 10, "cnn.architecture", "a network with an output for each digit")
    on_chip = architecture.convs[1:] if s.deployment.first_layer == "host" else architecture.convs
    need(s.deployment.pop_type == 32 or not any(conv.filters % 4 for conv in on_chip),
         "deployment.pop_type", "32 unless filters on the chip come in multiples of 4")  # fmt: skip
    need(1 <= len(s.snn.max_rates) <= n_spiking and min(s.snn.max_rates) > 0, "snn.max_rates",
         f"1 to {n_spiking} rates above 0, one a layer of neurons")  # fmt: skip
    need(max(s.snn.max_rates) * s.snn.tau_ref < 1, "snn.max_rates",
         f"below 1 / snn.tau_ref = {1 / s.snn.tau_ref:g} spikes a second")  # fmt: skip


def _parsed(architecture, name, origin):
    try:
        return parse(architecture)
    except NotationError as error:
        raise UserError(f"{origin}: {name!r}: {error}") from error


def _one_of(values):
    return "one of " + ", ".join(values)
