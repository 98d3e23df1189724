"""Nested values, such as those of a TOML file, by dotted names."""

import difflib
from typing import Any

from deploy.errors import UserError


def set_nested(values: dict, name: str, value, origin: str):
    """Put a value into nested ones; it replaces an existing one.

    Parameters
    ----------
    values : dict
        As :meth:`pipeline.settings.schema.Settings.with_values` takes them.
    name : str
        The dotted name.
    value
    origin : str
        For the error's line.

    Raises
    ------
    UserError
        A name is used both as a section and as a value.
    """
    *sections, last = name.split(".")
    for section in sections:
        values = values.setdefault(section, {})
        if not isinstance(values, dict):
            raise UserError(
                f"{origin}: {section!r} has a value of its own too; give it or {name!r}, not both"
            )
    if isinstance(values.get(last), dict) and not isinstance(value, dict):
        raise UserError(f"{origin}: {name!r} has a value in it too; give one of them")
    values[last] = value


def find_value(values: dict, name: str):
    """A value of nested ones by its dotted name, or None."""
    value: Any = values
    for key in name.split("."):
        value = value.get(key) if isinstance(value, dict) else None
    return value


def suggest_name(name: str, known) -> str:
    """The words that suggest known names instead of an unknown one.

    They are the dotted names that end with it, or else the most similar one; empty without any.
    """
    near = [entry for entry in known if entry.endswith(f".{name}")]
    near = near or difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean {' or '.join(map(repr, near))}?)" if near else ""


def merge_values(old: dict, changes: dict) -> dict:
    """Nested values with some changed."""
    return old | {
        name: merge_values(old[name], value)
        if isinstance(value, dict) and isinstance(old.get(name), dict)
        else value
        for name, value in changes.items()
    }
