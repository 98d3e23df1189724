"""Settings of the simulated rig, read from ``parameters.toml`` and ``calibration.json``."""

import dataclasses
import functools
import hashlib
import json
import tomllib
from dataclasses import dataclass
from math import fsum
from pathlib import Path
from typing import Any

from pipeline.simulation import shape_model
from pipeline.simulation.shape_model import ShapeModel


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
    writers, trials, kinematics, skin, receptor, aces : dataclass
        Parameters that were set by hand: the sections of ``parameters.toml``, where each has its
        meaning and unit.
    forms : tuple of Form
        Parameters of each digit that were fitted to Table 1.
    shapes : ShapeModel
        Model that was estimated from people's handwriting.
    """

    writers: Any
    trials: Any
    kinematics: Any
    skin: Any
    receptor: Any
    aces: Any
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


# People in general: their spread of size and place, and size and place of each digit.
PEOPLE = {"size": 0.12, "place": [0.4, 0.4]}
ANY_DIGIT = {"height": 8.2, "width": 8.2, "down": 4.5, "right": 4.5}


@functools.cache
def load(writers: int = 0) -> Parameters:
    """The built-in settings; with a number of people, those of people in general.

    In the paper's recordings, digits differ in place, size and force (Table 1).  People in general
    write all digits alike in these, around the middle of the skin, and differ more; some of them
    write a 1 as a straight line, and half a 5 and a 7 in one stroke.
    """
    values = tomllib.loads(CALIBRATION.with_name("parameters.toml").read_text("utf-8"))
    fitted = json.loads(CALIBRATION.read_text("utf-8"))["forms"]
    forms = tuple(Form(**fitted[str(digit)]) for digit in range(10))
    shapes = shape_model.load()
    if writers:
        # fsum rounds alike on every Python; sum does not since 3.12.
        means = {n: fsum(getattr(form, n) for form in forms) / len(forms) for n in vars(forms[0])}
        forms = (Form(**{**means, **ANY_DIGIT}),) * 10
        values["writers"] |= {"count": writers, **PEOPLE}
        shapes = shape_model.in_general(shapes)
    sections = {name: _section(name, entries) for name, entries in values.items()}
    return Parameters(**sections, forms=forms, shapes=shapes)


def _section(name, values):
    """A section of the file as a dataclass."""
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    return dataclasses.make_dataclass(name, values, frozen=True)(**values)


def _plain(value):
    """A section or the forms as plain values."""
    if isinstance(value, tuple):
        return [dataclasses.asdict(form) for form in value]
    return dataclasses.asdict(value)
