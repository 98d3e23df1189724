"""Settings of the simulated rig, read from ``parameters.toml`` and ``calibration.json``."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import tomllib
from dataclasses import dataclass
from pathlib import Path

from pipeline.skin import shape_model
from pipeline.skin.shape_model import ShapeModel


@dataclass(frozen=True)
class Writers:
    """Standard deviations between persons; see ``parameters.toml`` for units."""

    count: int
    size: float
    place: tuple
    force: float
    scrape: float
    sloppiness: float


@dataclass(frozen=True)
class Trials:
    """Standard deviations from one digit of a person to the next."""

    size: float
    place: tuple
    force: float
    scrape: float


@dataclass(frozen=True)
class Kinematics:
    """Parameters of the movement with which a digit is written."""

    speed: float
    lift_s: float
    lift_taxels: float
    isochrony: float
    landing_s: float
    settle_s: float
    onset_s: tuple
    waver: float
    waver_s: float
    end_s: float


@dataclass(frozen=True)
class Skin:
    """Parameters of the film and of the taxels under a force."""

    spread: float
    creep: float
    creep_s: float
    gain: float
    gain_drift: float
    scrape: float
    scrape_speed: float
    lean: tuple
    jolt: float
    jolt_spread: float
    jolt_s: float
    noise: float


@dataclass(frozen=True)
class Receptor:
    """Parameters of the receptors: when a taxel fires."""

    threshold: float
    refractory_s: float
    poll_s: float
    clock: float
    off_spread: float


@dataclass(frozen=True)
class Aces:
    """Parameters of the ACES signatures and of their decoder."""

    pulses: int
    signature_s: float
    most_shared: int
    on_ns: float
    off_ns: float
    level: float
    shortest: int
    noise: float


@dataclass(frozen=True)
class Form:
    """Parameters that were fitted for one digit.

    Attributes
    ----------
    height : float
        Usual height of the digit, in taxels.
    width : float
        Width in taxels of a shape that is as wide as high; if it is equal to the height, the digit
        keeps its proportions.
    down, right : float
        Usual centre of the digit's box, in taxels from the centre of the first taxel.
    force : float
        Logarithm of the usual force.
    spread : float
        Factor on the variation of force and tempo between samples.
    off : float
        Logarithm of the ratio of the OFF to the ON threshold.
    """

    height: float
    width: float
    down: float
    right: float
    force: float
    spread: float
    off: float


@dataclass(frozen=True)
class Parameters:
    """All parameters of the simulation except the seed and the sample counts.

    Attributes
    ----------
    writers, trials, kinematics, skin, receptor, aces
        Parameters that were set by hand.
    forms : tuple of Form
        Parameters of each digit that were fitted to Table 1.
    shapes : ShapeModel
        Model that was estimated from people's handwriting.
    """

    writers: Writers
    trials: Trials
    kinematics: Kinematics
    skin: Skin
    receptor: Receptor
    aces: Aces
    forms: tuple
    shapes: ShapeModel

    def fingerprint(self) -> str:
        """Hexadecimal SHA-256 over every value."""
        values = {name: value for name, value in vars(self).items() if name != "shapes"}
        plain = {name: _plain(value) for name, value in values.items()}
        text = json.dumps([plain, self.shapes.fingerprint()], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


# File of the fitted parameters; ``parameters.toml`` has those that were set by hand.
CALIBRATION = Path(__file__).with_name("calibration.json")


@functools.cache
def load() -> Parameters:
    """The built-in settings."""
    values = tomllib.loads(CALIBRATION.with_name("parameters.toml").read_text("utf-8"))
    fitted = json.loads(CALIBRATION.read_text("utf-8"))["forms"]
    sections = {name: section(**_tuples(values[name])) for name, section in _SECTIONS.items()}
    forms = tuple(Form(**fitted[str(digit)]) for digit in range(10))
    return Parameters(**sections, forms=forms, shapes=shape_model.load())


_SECTIONS = {
    "writers": Writers,
    "trials": Trials,
    "kinematics": Kinematics,
    "skin": Skin,
    "receptor": Receptor,
    "aces": Aces,
}


def _plain(value):
    """A section or the forms as plain values."""
    if isinstance(value, tuple):
        return [dataclasses.asdict(form) for form in value]
    return dataclasses.asdict(value)


def _tuples(values):
    return {name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}
