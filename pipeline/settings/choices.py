"""Where the value of a setting comes from, and the settings that rules choose for the recordings.

A value is the user's, chosen by a rule, or the default.  A rule returns a list of :class:`Choice`;
:func:`apply_choices` is the only function that applies it, :func:`list_reasons` makes the lines
for the user of it, and :func:`pipeline.settings.toml.write_settings` records it.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.settings.schema import Settings


class Provenance(enum.Enum):
    """Where the value of a setting comes from."""

    USER = "user"
    CHOSEN = "chosen"
    DEFAULT = "default"


@dataclass(frozen=True)
class Choice:
    """A setting that a rule has chosen for the recordings.

    Attributes
    ----------
    setting : str
        Dotted name of the setting.
    value
    reason : str
        A line for the user; empty if the line of another choice says it too.
    """

    setting: str
    value: Any
    reason: str = ""


def select_applicable(settings: Settings, choices: Iterable[Choice]) -> list[Choice]:
    """The choices of settings that the user has not set."""
    return [choice for choice in choices if not settings.is_set_by_user(choice.setting)]


def apply_choices(
    settings: Settings, choices: Iterable[Choice], origin: str = "choices"
) -> Settings:
    """Settings with what was chosen; a value of the user is never replaced.

    Parameters
    ----------
    settings : Settings
    choices : iterable of Choice
        Of two choices of one setting, the later one is applied.
    origin : str
        What was chosen for, for the error's line.

    Raises
    ------
    UserError
        The user's other settings do not fit what is chosen.
    """
    values = {choice.setting: choice.value for choice in select_applicable(settings, choices)}
    return settings.with_named_values(values, origin, Provenance.CHOSEN)


def list_reasons(settings: Settings, choices: Iterable[Choice]) -> list[str]:
    """The reasons of the choices that are applied, a line each."""
    return [choice.reason for choice in select_applicable(settings, choices) if choice.reason]
