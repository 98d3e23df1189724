"""All settings of an experiment, with the provenance of each value.

A run stores its settings in ``experiment.toml``.
"""

from __future__ import annotations

import copy
import functools
import os
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated

from deploy import limits
from deploy.errors import UserError
from deploy.loading import WrongValue, load_dataclass
from deploy.network.presentation import Presentation
from deploy.network.stimulus import EventFrames, ImageSpikes, Stimulus
from pipeline import paper
from pipeline.settings.base import SettingsGroup, UndeclaredSetting, list_entries, restrict_section
from pipeline.settings.choices import Provenance
from pipeline.settings.groups import (
    CNN,
    INPUTS,
    NIR,
    SEED,
    SIMULATED,
    SNN,
    Check,
    Data,
    Deployment,
    EventTraining,
    Image,
    Input,
    PresentationSettings,
    SkinSize,
    SplitShares,
)
from pipeline.settings.nested import find_value, merge_values, set_nested, suggest_name
from pipeline.settings.relations import IMPORTED, require_relations

# Settings with the path of a file. The origin of an artifact has a hash of the file's content
# instead of the path, so that every artifact may read these settings.
PATHS = ("data.source", "cnn.model", "nir.file")
# Settings that a trained network may change unless they are the user's: what is made from them
# depends on whose they are.
KEPT_SETTINGS = ("presentation.gap",)


class _DeclaredProvenance(dict):
    """The provenance of the settings in `KEPT_SETTINGS` that a view declares; no other is read."""

    def get(self, name, default=None):
        if name not in self:
            raise UndeclaredSetting(f"the provenance of {name} is read, which is not declared")
        return self[name]


@dataclass(frozen=True)
class Settings(SettingsGroup):
    """All settings of an experiment."""

    #: Seed of the split, the training and the choice of the check's samples.
    seed: Annotated[int, SEED] = 0
    data: Data = field(default_factory=Data)
    input: Input = field(default_factory=Input)
    skin: SkinSize = field(default_factory=SkinSize)
    image: Image = field(default_factory=Image)
    split: SplitShares = field(default_factory=SplitShares)
    cnn: CNN = field(default_factory=CNN)
    snn: SNN = field(default_factory=SNN)
    nir: NIR = field(default_factory=NIR)
    events: EventTraining = field(default_factory=EventTraining)
    deployment: Deployment = field(default_factory=Deployment)
    presentation: PresentationSettings = field(default_factory=PresentationSettings)
    check: Check = field(default_factory=Check)
    # The Provenance of each value that was set or chosen, also if it is the default, by its name.
    provenance: dict = field(default_factory=dict, init=False, compare=False, repr=False)

    def with_values(
        self, changes: dict, origin: str = "settings", provenance: Provenance = Provenance.USER
    ) -> Settings:
        """These settings with some changed.

        Parameters
        ----------
        changes : dict
            As read from TOML: ``{"seed": 1, "cnn": {"epochs": 5}}``.
        origin : str
            Source of the values, for the error's line.
        provenance : Provenance
            Whether the values are the user's, chosen, or defaults again.

        Raises
        ------
        UserError
            An unknown setting, or a value of the wrong kind or out of range.
        """
        try:
            settings = load_dataclass(Settings, merge_values(self.to_json(), changes))
            if settings.data.source != SIMULATED:  # a run can be repeated from any folder
                source = os.path.abspath(settings.data.source)
                settings = replace(settings, data=replace(settings.data, source=source))
            require_relations(settings)
            for file, content in IMPORTED.items():
                if (
                    self.get_value(file)
                    and settings.get_value(content)
                    and not settings.get_value(file)
                ):
                    raise WrongValue(file, "must be kept; train others in a new RUN")
        except WrongValue as error:
            raise UserError(f"{origin}: {error}{_suggest_setting(error)}") from None
        named = [name for name in self.flatten() if find_value(changes, name) is not None]
        return settings.with_provenance(self.provenance | dict.fromkeys(named, provenance))

    def with_named_values(
        self, values: dict, origin: str = "settings", provenance: Provenance = Provenance.USER
    ) -> Settings:
        """As :meth:`with_values`, with the values by their dotted names."""
        changes: dict = {}
        for name, value in values.items():
            set_nested(changes, name, value, origin)
        return self.with_values(changes, origin, provenance)

    def with_provenance(self, provenance: dict) -> Settings:
        """The same values with the :class:`Provenance` of each by its dotted name."""
        settings = copy.copy(self)
        object.__setattr__(settings, "provenance", provenance)
        return settings

    def find_provenance(self, name: str) -> Provenance:
        """Where the value of a setting comes from.

        A value that is not the default is the user's unless it was chosen: the user may have
        edited the file of the settings.  A default that asks for a choice is never the user's.
        """
        value = self.get_value(name)
        if is_automatic(name, value):
            return Provenance.DEFAULT
        is_default = value == find_default(name)
        return self.provenance.get(name, Provenance.DEFAULT if is_default else Provenance.USER)

    def list_names(self, provenance: Provenance) -> tuple:
        """Dotted names of the settings whose values have this provenance."""
        return tuple(name for name in self.flatten() if self.find_provenance(name) is provenance)

    def is_set_by_user(self, name: str) -> bool:
        """True if the value of a setting is the user's, so that no rule may replace it."""
        return self.find_provenance(name) is Provenance.USER

    def is_open(self, name: str) -> bool:
        """True if a setting was neither set nor chosen, so that it may be chosen."""
        return self.find_provenance(name) is Provenance.DEFAULT

    def without_choices(self) -> Settings:
        """What the user has set: values that were chosen for recordings have their defaults."""
        names = self.list_names(Provenance.CHOSEN)
        defaults = {name: find_default(name) for name in names}
        return self.with_named_values(defaults, provenance=Provenance.DEFAULT)

    def make_presentation(self, threshold: float | None = None) -> Presentation:
        """The presentation of samples; events are read from the first step on.

        Parameters
        ----------
        threshold : float, optional
            See :class:`deploy.network.presentation.Presentation`.
        """
        values = {**asdict(self.presentation), "steps": self.steps, "threshold": threshold}
        del values["early_loss"]  # by which the threshold was chosen
        return Presentation(**(values | {"readout_start": 0} if self.on_events else values))

    @property
    def stimulus(self) -> Stimulus:
        """The input of the chip."""
        if self.on_events:
            inputs = self.input
            return EventFrames(inputs.step_ms / 1000, inputs.refractory_steps, inputs.max_spikes)
        return ImageSpikes(self.deployment.input_rate_hz, self.deployment.input_phase)

    @property
    def steps(self) -> int:
        """Steps for which a sample is presented, also if ``presentation.steps`` is 0."""
        if self.presentation.steps:
            return self.presentation.steps
        if not self.on_events:
            return Presentation.steps
        return min(round(1000 * paper.DURATION_S / self.input.step_ms), limits.STEPS)

    @property
    def on_events(self) -> bool:
        """True if the input of the chip is events, not images."""
        return INPUTS[self.input.kind] == "frames"

    def get_value(self, name: str):
        """The value of a setting by its dotted name, such as ``"cnn.epochs"``."""
        return functools.reduce(getattr, name.split("."), self)

    def select(self, names) -> Settings:
        """Only the named settings; reading any other raises `UndeclaredSetting`.

        Parameters
        ----------
        names : iterable of str
            Dotted names.  :data:`PATHS` remain readable too.
        """
        names = {*names, *PATHS}
        declared = {name: self.find_provenance(name) for name in KEPT_SETTINGS if name in names}
        view = restrict_section(self, names)
        return view.with_provenance(_DeclaredProvenance(declared))

    def to_json(self) -> dict:
        """The settings as plain values."""
        return {name: value for name, value in asdict(self).items() if name != "provenance"}

    def flatten(self) -> dict:
        """Values by their dotted names, as ``--set`` takes them."""
        return {name: getattr(section, entry) for name, section, entry in list_entries(self)}


@functools.cache
def find_default(name: str):
    """The default of a setting by its dotted name."""
    return Settings().get_value(name)


@functools.cache
def list_automatic_names() -> frozenset:
    """Dotted names of the settings whose defaults stand for values that the program chooses."""
    return frozenset(
        name
        for name, section, entry in list_entries(Settings())
        if section.__dataclass_fields__[entry].metadata.get("automatic")  # type: ignore[attr-defined]
    )


def is_automatic(name: str, value) -> bool:
    """True if a setting's value stands for one that the program chooses."""
    return name in list_automatic_names() and value == find_default(name)


def _suggest_setting(error):
    """The words that help with an unknown setting; empty for other errors."""
    if error.problem != "is unknown":
        return ""
    return suggest_name(error.name, Settings().flatten()) or "; 'stmnist settings' lists all"


def list_names_in(section: str) -> tuple:
    """Dotted names of the settings of a section, or the name itself if it is a setting's."""
    value = functools.reduce(getattr, section.split("."), Settings())
    if not isinstance(value, SettingsGroup):
        return (section,)
    return tuple(name for name, _, _ in list_entries(value, f"{section}."))
