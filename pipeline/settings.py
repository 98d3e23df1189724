"""Every setting of an experiment: its default, its limits, and below it what it means.

A run keeps its own in ``experiment.toml``; ``stmnist settings`` lists them with their meanings.
"""

from __future__ import annotations

import ast
import functools
import inspect
import itertools
import json
import math
import textwrap
import tomllib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, NamedTuple, get_type_hints

from deploy.errors import UserError
from deploy.files import replacing
from deploy.network.spec import Presentation
from deploy.tables import aligned
from models.architecture import NotationError, parse
from pipeline import paper

AGGREGATIONS = ("count", "columns", "signed", "on", "off")
NORMALISATIONS = ("max", "sum", "sqrt-max", "none")


class Limit(NamedTuple):
    """What holds of a value, and how an error says so."""

    holds: Callable
    expected: str


def one_of(*values) -> Limit:
    """The limit of a setting that has only these values."""
    return Limit(lambda value: value in values, "one of " + ", ".join(values))


SEED = Limit(lambda value: 0 <= value < 2**31, f"from 0 to {2**31 - 1}")
AT_LEAST_0 = Limit(lambda value: value >= 0, "0 or more")
AT_LEAST_1 = Limit(lambda value: value >= 1, "1 or more")
ABOVE_0 = Limit(lambda value: value > 0, "above 0")
INSIDE_0_1 = Limit(lambda value: 0 < value < 1, "between 0 and 1")
FROM_0_BELOW_1 = Limit(lambda value: 0 <= value < 1, "from 0 to below 1")
RATE = Limit(lambda value: 0 < value <= 1000, "above 0, at most 1000")
POP_TYPE = Limit(lambda value: value in (16, 32), "16 or 32")


@dataclass(frozen=True)
class Data:
    """Which recordings."""

    source: str = "simulated"
    """``simulated``, or the path of an ST-MNIST zip or folder."""
    simulation_seed: Annotated[int, SEED] = 0
    """Seed of simulated recordings; the experiment's own seed does not change them."""
    samples_per_digit: Annotated[int, AT_LEAST_0] = 0
    """Simulated recordings of each digit; 0 for the published numbers, 6,953 in all."""
    skip_bad: bool = False
    """Leave out files that cannot be read instead of stopping."""


@dataclass(frozen=True)
class Image:
    """How events become a tactile image; see :mod:`pipeline.inputs.images`."""

    aggregation: Annotated[str, one_of(*AGGREGATIONS)] = "count"
    """What is summed up of a taxel: ``count``, physical events; ``columns``, columns of the file,
    as the paper's Table 1 counts; ``signed``, ON less OFF events; ``on``, ``off``, events of one
    polarity."""
    normalisation: Annotated[str, one_of(*NORMALISATIONS)] = "max"
    """What an image is divided by: ``max``, its largest magnitude; ``sum``, the sum of magnitudes;
    ``sqrt-max``, as ``max`` after the square root of each magnitude; ``none``."""


@dataclass(frozen=True)
class Split:
    """Which samples are for what."""

    test_fraction: Annotated[float, INSIDE_0_1] = paper.TEST_FRACTION
    """Share of all samples (paper: 80-20 splits)."""
    validation_fraction: Annotated[float, FROM_0_BELOW_1] = 0.0
    """Share of the training samples that is kept for choosing settings."""


@dataclass(frozen=True)
class CNN:
    """The convolutional network and its training (paper, Section 3.2.1)."""

    architecture: str = "10x10-6c4-24c3-10o"
    """Input, convolutions (``6c4``: six filters of 4x4) and outputs."""
    epochs: Annotated[int, AT_LEAST_1] = 20
    """Passes over the training samples."""
    batch_size: Annotated[int, AT_LEAST_1] = 32
    """Not given in the paper; Keras's default."""
    learning_rate: Annotated[float, ABOVE_0] = 0.001
    """Not given in the paper; Keras's default for RMSProp."""


@dataclass(frozen=True)
class SNN:
    """Training with rate-based LIF neurons (paper, Section 3.2.2)."""

    recipe: Annotated[str, one_of("loihi", "paper")] = "loihi"
    """``loihi``: the chip's rates and 8-bit weights in the forward pass, noise that stands for
    the ripple of spikes, starting from the CNN's weights; ``paper``: plain rate-based LIF, from
    new weights, trained as the CNN is."""
    epochs: Annotated[int, AT_LEAST_0] = 0
    """Passes over the training samples; 0 for the recipe's own."""
    batch_size: Annotated[int, AT_LEAST_0] = 0
    """Samples a step; 0 for the recipe's own."""
    learning_rate: Annotated[float, AT_LEAST_0] = 0.0
    """At the start; 0 for the recipe's own."""
    noise: Annotated[float, AT_LEAST_0] = 0.1
    """Standard deviation of the noise on each neuron's input while training, relative to the
    activation at ``max_rates``; recipe ``loihi`` only."""
    spike_penalty: Annotated[float, AT_LEAST_0] = 0.05
    """Weight in the loss of the synaptic operations of 100 steps, in units of the CNN's
    multiply-accumulates; recipe ``loihi`` only."""
    max_rates: tuple = (150.0, 150.0)
    """Spikes a second of the neurons of each convolution and hidden dense layer at activation 1;
    the last entry holds for all layers after it."""
    tau_rc: Annotated[float, ABOVE_0] = 0.02
    """Membrane time constant in seconds."""
    tau_ref: Annotated[float, ABOVE_0] = 0.001
    """Refractory period in seconds."""

    def max_rate(self, index: int) -> float:
        """Of layer of neurons ``index``, from 0."""
        return self.max_rates[min(index, len(self.max_rates) - 1)]


@dataclass(frozen=True)
class Slayer:
    """Training on the events themselves (paper, Section 3.2.3)."""

    architecture: str = "10x10x2-6c2-24c3-10o"
    """As the CNN's, with a channel for each polarity."""
    bins: Annotated[int, AT_LEAST_1] = 200
    """Time steps; of two seconds, so 10 ms each (paper)."""
    epochs: Annotated[int, AT_LEAST_1] = 100
    """Passes over the training samples."""
    batch_size: Annotated[int, AT_LEAST_1] = 32
    """Not given in the paper."""
    learning_rate: Annotated[float, ABOVE_0] = 0.01
    """Not given in the paper; that of the SLAYER authors' own examples, as is the optimiser."""
    true_count: float = 60.0
    """Desired spikes of the right digit's output neuron (paper)."""
    false_count: float = 10.0
    """Desired spikes of each other output neuron (paper)."""
    tau_s: Annotated[float, ABOVE_0] = 0.1
    """Time constant in seconds of a neuron's response to a spike.  Not given in the paper; the
    SLAYER authors' own examples have 10 time steps, which are 0.1 s here."""
    tau_r: Annotated[float, ABOVE_0] = 0.01
    """Time constant in seconds of its refractory response; 1 time step in those examples."""
    conv_scale: Annotated[float, ABOVE_0] = 100.0
    """How far the first weights of a convolution reach, in units of 1/sqrt(inputs): that of the
    SLAYER authors' code, which the paper used unmodified.  10 does far better
    (results/README.md)."""
    dense_scale: Annotated[float, ABOVE_0] = 10.0
    """The same of the output layer's weights, from the same code."""


@dataclass(frozen=True)
class Deployment:
    """How the spiking network is laid out; see :mod:`deploy.network.spec`."""

    first_layer: Annotated[str, one_of("chip", "host")] = "chip"
    """``chip``: the image becomes spikes in an input layer on the host, all convolutions are on
    the chip; ``host``: the first convolution's neurons are on the host, fed with currents."""
    readout: Annotated[str, one_of("chip", "host")] = "host"
    """``host``: output decoded from the last convolution's spikes; ``chip``: ten neurons."""
    input_rate: Annotated[float, RATE] = 500.0
    """Spikes a second of a pixel of value 1."""
    input_phase: Annotated[float, FROM_0_BELOW_1] = 0.5
    """Voltage of the input neurons at the start of a stream."""
    synapse: Annotated[float, AT_LEAST_0] = 0.008
    """Time constant in seconds of the low-pass on every spiking connection; 0 for none."""
    pop_type: Annotated[int, POP_TYPE] = 32
    """How convolutions' axons are laid out on the chip; 16 halves them, and wants filters in
    multiples of 4."""


@dataclass(frozen=True)
class Showing:
    """How samples are shown; see :class:`deploy.network.spec.Presentation`."""

    steps: Annotated[int, AT_LEAST_1] = Presentation.steps
    """Steps of 1 ms that a sample is shown."""
    gap: Annotated[int, AT_LEAST_0] = Presentation.gap
    """Blank steps before each sample."""
    readout_start: int = Presentation.readout_start
    """Step from which on the mean of the outputs decides."""
    stream_length: Annotated[int, AT_LEAST_1] = Presentation.stream_length
    """Samples that are shown one after the other before the network starts afresh."""


@dataclass(frozen=True)
class Check:
    """The check that every target answers."""

    samples: Annotated[int, AT_LEAST_1] = paper.CHECK_SAMPLES
    """Drawn at random from the test split, as in the paper."""


@dataclass(frozen=True)
class Settings:
    """All settings of an experiment."""

    seed: Annotated[int, SEED] = 0
    """Of the split, the training and the choice of the check's samples."""
    data: Data = field(default_factory=Data)
    image: Image = field(default_factory=Image)
    split: Split = field(default_factory=Split)
    cnn: CNN = field(default_factory=CNN)
    snn: SNN = field(default_factory=SNN)
    slayer: Slayer = field(default_factory=Slayer)
    deployment: Deployment = field(default_factory=Deployment)
    presentation: Showing = field(default_factory=Showing)
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

    def flat(self) -> dict:
        """Values by their dotted names, as ``--set`` takes them."""
        return {name: getattr(section, entry) for name, section, entry in _entries(self)}


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
    lines = ["# Every setting of this experiment; 'stmnist settings' says what each means."]
    lines += [f"{k} = {_toml(v)}" for k, v in sections.items() if not isinstance(v, dict)]
    for name, section in sections.items():
        if isinstance(section, dict):
            lines += ["", f"[{name}]", *(f"{k} = {_toml(v)}" for k, v in section.items())]
    with replacing(path, "w") as file:
        file.write("\n".join(lines) + "\n")


def describe(settings: Settings) -> list:
    """Every setting: a dict of its ``name``, ``value``, ``default`` and ``meaning``."""
    defaults = Settings().flat()
    return [
        {
            "name": name,
            "value": getattr(section, entry),
            "default": defaults[name],
            "meaning": _meanings(type(section))[entry],
        }
        for name, section, entry in _entries(settings)
    ]


def settings_text(described: list, width: int = 96) -> str:
    """What :func:`describe` gives, as a table; a star marks what is not the default."""
    rows = [["", "setting", "value", "default"]]
    for row in described:
        star = "" if row["value"] == row["default"] else "*"
        rows.append([star, row["name"], _toml(row["value"]), _toml(row["default"])])
    heads, *lines = aligned(rows, left=4)
    text = [heads]
    for line, row in zip(lines, described, strict=True):
        text += [
            line,
            *(
                f"      {part}"
                for part in textwrap.wrap(row["meaning"], width - 6, break_on_hyphens=False)
            ),
        ]
    return "\n".join(text)


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
    try:
        return replace(settings, **values)
    except ValueError as error:
        raise UserError(f"{origin}: {error}") from error


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


def _entries(settings, prefix=""):
    """(dotted name, section that has it, name there) of every setting."""
    for entry in fields(settings):
        value = getattr(settings, entry.name)
        if hasattr(value, "__dataclass_fields__"):
            yield from _entries(value, f"{prefix}{entry.name}.")
        else:
            yield prefix + entry.name, settings, entry.name


@functools.cache
def _limits(section):
    """The limit of each entry of a section that has one."""
    hints = get_type_hints(section, include_extras=True)
    return {n: hint.__metadata__[0] for n, hint in hints.items() if hasattr(hint, "__metadata__")}


@functools.cache
def _meanings(section):
    """The text below each entry of a section, in one line and without its markup."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(section))).body
    return {
        entry.target.id: inspect.cleandoc(text.value.value).replace("\n", " ").replace("``", "")
        for entry, text in itertools.pairwise(body.body)
        if isinstance(entry, ast.AnnAssign) and isinstance(text, ast.Expr)
    }


def _validate(s: Settings, origin):
    def need(condition, name, expected):
        if not condition:
            raise UserError(f"{origin}: {name!r} must be {expected}")

    for name, section, entry in _entries(s):
        limit = _limits(type(section)).get(entry)
        if limit is not None:
            need(limit.holds(getattr(section, entry)), name, limit.expected)
    need(0 <= s.presentation.readout_start < s.presentation.steps, "presentation.readout_start",
         f"from 0 to below presentation.steps ({s.presentation.steps})")  # fmt: skip
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
