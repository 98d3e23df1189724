"""Parameters of the simulation: those that were assumed, and those that were fitted.

``parameters.toml`` has the assumed ones, with the reason for each.  ``fitted.json`` and
``fitted.npz`` have those that ``python -m experiments calibrate`` estimated from real recordings,
with their source: the latter is a model of how people write on the sensor
(:mod:`pipeline.simulation.shape_model`).  ``handwriting.npz`` is the model of people who write on a
tablet.
"""

import dataclasses
import functools
import hashlib
import json
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.simulation import shape_model
from pipeline.simulation.shape_model import ShapeModel

ASSUMED = Path(__file__).with_name("parameters.toml")
FITTED = Path(__file__).with_name("fitted.json")
FITTED_SHAPES = FITTED.with_suffix(".npz")

# Digits that are closed lines, which can be drawn in both directions.
CLOSED_DIGITS = (0, 8)


@dataclass(frozen=True)
class Population:
    """The simulated people, and how they write.

    Attributes
    ----------
    people : int
        Number of people.  The default is so large that a network does not learn single ones.
    chunked_share : float
        Share of the recordings that keep the order of events and not their time
        (:mod:`pipeline.recordings.chunks`).
    tablet_share : float
        Share of the digits that are written as people write on a tablet (``handwriting.npz``); the
        others are written as on the sensor (``fitted.npz``).
    reversed_share : float
        Share of the people who draw a 0 or an 8 from its end to its beginning, in addition to those
        who are known to do so.
    mixed_form_share : float
        Share of the recordings that have the place, size, force and contact of any digit.  On the
        sensor these differ between digits, and a network that learns it expects them.
    """

    people: int = 1000
    chunked_share: float = 0.0
    tablet_share: float = 0.15
    reversed_share: float = 0.1
    mixed_form_share: float = 0.0


DEFAULT_POPULATION = Population()


@dataclass(frozen=True)
class Form:
    """How one digit is usually written on the sensor.

    Attributes
    ----------
    down, right : float
        Usual centre of the digit's box, in taxels from the centre of the first taxel.
    height : float
        Usual height of the digit, in taxels.
    variation : tuple of tuple of float, shape (3, 3)
        Square root of the covariance of centre and logarithm of the height.
    force : float
        Logarithm of the usual force.
    contact : float
        Logarithm of the factor on the width of the contact.
    """

    down: float
    right: float
    height: float
    variation: tuple
    force: float
    contact: float


@dataclass(frozen=True)
class Parameters:
    """All parameters of the simulation except the seed and the sample counts.

    Attributes
    ----------
    writers, trials, kinematics, skin, receptor, aces, faults : dataclass
        The sections of ``parameters.toml`` and ``fitted.json``; their comments and
        :data:`experiments.calibration` have the meanings and units.
    forms : tuple of Form
        One for each digit.
    shapes : ShapeModel
        Model of handwriting.
    population : Population
        ``writers`` and ``shapes`` are already those of its shares.
    """

    writers: Any
    trials: Any
    kinematics: Any
    skin: Any
    receptor: Any
    aces: Any
    faults: Any
    forms: tuple
    shapes: ShapeModel
    population: Population = DEFAULT_POPULATION

    def compute_hash(self) -> str:
        """Hexadecimal SHA-256 over every value."""
        values = {
            field.name: _make_plain(getattr(self, field.name))
            for field in dataclasses.fields(self)
            if field.name not in ("shapes", "population")
        }
        values["people"] = self.population.people
        values["chunked"] = self.population.chunked_share
        # With a share of 0 the recordings do not depend on this parameter.
        if self.population.mixed_form_share:
            values["mixed_forms"] = self.population.mixed_form_share
        text = json.dumps([values, self.shapes.compute_hash()], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


@functools.cache
def read_parameters(population: Population = DEFAULT_POPULATION) -> Parameters:
    """The built-in parameters, for some simulated people."""
    fit = json.loads(FITTED.read_text("utf-8"))
    return from_fit(fit, shape_model.read_shape_model(FITTED_SHAPES), population)


def from_fit(
    fit: dict, shapes: ShapeModel, population: Population = DEFAULT_POPULATION
) -> Parameters:
    """The assumed parameters together with fitted ones.

    Parameters
    ----------
    fit : dict
        Content of ``fitted.json``: the sections, each with its fitted parameters, and ``digits``,
        for each digit its :class:`Form`.
    shapes : ShapeModel
        How people write on the sensor; a share of the digits is written as on a tablet.
    population : Population
    """
    assumed = tomllib.loads(ASSUMED.read_text("utf-8"))
    assumed["writers"]["tablet"] = population.tablet_share
    assumed["writers"]["backwards"] = [
        population.reversed_share if digit in CLOSED_DIGITS else 0 for digit in range(10)
    ]
    sections = {
        name: _read_group(name, {**entries, **fit["sections"].get(name, {})})
        for name, entries in assumed.items()
    }
    return Parameters(
        **sections,
        forms=tuple(map(_make_form, fit["digits"])),
        shapes=shape_model.read_tablet_model().join(shapes, 1 - population.tablet_share),
        population=population,
    )


def _make_form(values):
    return Form(**{key: _freeze(value) for key, value in values.items()})


def _read_group(name, values):
    """A section as a dataclass."""
    values = {key: _freeze(value) for key, value in values.items()}
    return dataclasses.make_dataclass(name, values, frozen=True)(**values)


def _freeze(value):
    return tuple(map(_freeze, value)) if isinstance(value, list) else value


def _make_plain(value):
    """A section or the forms as plain values."""
    if isinstance(value, tuple):
        return [dataclasses.asdict(form) for form in value]
    return dataclasses.asdict(value)
