"""Groups of settings, whose values are read only where they are declared."""

from __future__ import annotations

import enum
from collections.abc import Iterator
from dataclasses import fields


class UndeclaredSetting(Exception):
    """Code read a setting that the artifact it is making does not declare.

    This is a programming error: the setting belongs in the ``reads`` of that artifact's origin, see
    :mod:`pipeline.storage.artifacts`.
    """


class _Access(enum.Enum):
    """Stands for a setting that may not be read; the same object after pickling."""

    DENIED = 0


class SettingsGroup:
    """Base of a group of settings; see :meth:`pipeline.settings.schema.Settings.select`."""

    def __getattribute__(self, name):
        value = object.__getattribute__(self, name)
        if value is _Access.DENIED:
            raise UndeclaredSetting(
                f"{type(self).__name__}.{name} is read, but the artifact that is being made does "
                "not declare it; add it to the reads of the artifact's origin"
            )
        return value


def restrict_section(section: SettingsGroup, kept: set, prefix: str = "") -> SettingsGroup:
    """A copy of a group in which only the values in ``kept`` may be read.

    Parameters
    ----------
    section : SettingsGroup
    kept : set of str
        Dotted names of the settings that are kept.
    prefix : str
        What stands before the names in this group, such as ``"cnn."``.
    """
    view = object.__new__(type(section))
    for name, value in object.__getattribute__(section, "__dict__").items():
        if isinstance(value, SettingsGroup):
            value = restrict_section(value, kept, f"{prefix}{name}.")
        elif prefix + name not in kept:
            value = _Access.DENIED
        object.__setattr__(view, name, value)
    return view


def list_entries(settings: SettingsGroup, prefix: str = "") -> Iterator[tuple]:
    """Yield the dotted name of every setting, the group that has it, and its name there."""
    for entry in (entry for entry in fields(settings) if entry.init):  # type: ignore[arg-type]
        value = getattr(settings, entry.name)
        if hasattr(value, "__dataclass_fields__"):
            yield from list_entries(value, f"{prefix}{entry.name}.")
        else:
            yield prefix + entry.name, settings, entry.name
