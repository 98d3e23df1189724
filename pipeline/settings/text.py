"""Settings on the command line: their meanings as text, and ``--set`` options."""

from __future__ import annotations

import inspect
import itertools
import re
import textwrap
import tomllib

from deploy.errors import UserError
from pipeline.settings.base import list_entries
from pipeline.settings.nested import set_nested
from pipeline.settings.schema import Settings, is_automatic
from pipeline.settings.toml import format_toml


def describe_settings(settings: Settings) -> list:
    """Every setting: a dict of ``name``, ``value``, ``default``, ``meaning`` and ``section``."""
    defaults = Settings().flatten()
    entries = list(list_entries(settings))
    meanings = {type(section): _read_meanings(type(section)) for _, section, _ in entries}
    return [
        {
            "name": name,
            "value": getattr(section, entry),
            "default": defaults[name],
            "meaning": meanings[type(section)][entry],
            "section": re.split(r";|\.\n|\.$", inspect.getdoc(type(section)) or "")[0],
        }
        for name, section, entry in entries
    ]


def format_settings(rows: list, width: int = 80) -> str:
    """The result of :func:`describe_settings` as text, with a star at each value that was set."""
    lines = []
    section = None
    for row in rows:
        if row["section"] != section:
            section = row["section"]
            lines += ["", f"# {section}"]
        value = format_toml(row["value"])
        default = format_toml(row["default"])
        star, otherwise = ("*", f"  (default {default})") if value != default else (" ", "")
        lines.append(f"{star} {row['name']} = {value}{otherwise}")
        text = textwrap.fill(row["meaning"], width - 6, break_on_hyphens=False)
        lines.append(textwrap.indent(text, 6 * " "))
    return "\n".join(lines[1:])


def format_automatic(name: str, value) -> str:
    """``automatic`` if a setting's value stands for one that the program chooses, otherwise empty.

    Parameters
    ----------
    name : str
        The setting's dotted name.
    value : object
    """
    if not is_automatic(name, value):
        return ""
    return "automatic" if isinstance(value, str) else f"automatic ({value:g})"


# The blanks before the name of a setting.
_NEXT_SETTING = re.compile(r"\s+(?=(?:seed|[a-z]\w*\.\w+)\s*=)")


def parse_assignments(assignments) -> dict:
    """Turn ``["cnn.epochs=5", "seed=1"]`` into nested values.

    An entry may have several settings with blanks between them, as make's ``SET``; values may have
    blanks, too.  Values are read as TOML, and as plain text where that fails; a single value is
    taken as a list of one where a list is needed.

    Raises
    ------
    UserError
        An entry is not of the form ``name=value``.
    """
    values: dict = {}
    for assignment in itertools.chain.from_iterable(map(_NEXT_SETTING.split, assignments)):
        name, equals, text = assignment.partition("=")
        if not equals or not name.strip():
            raise UserError(f"--set {assignment!r}: expected section.name=value")
        try:
            value = tomllib.loads(f"value = {text}")["value"]
        except (ValueError, RecursionError):
            value = text.strip()
        default = Settings().flatten().get(name.strip())
        if isinstance(default, tuple) and not isinstance(value, list):
            value = [value]
        elif isinstance(default, str) and not isinstance(value, str):
            value = text.strip()  # a folder may be called 2024
        set_nested(values, name.strip(), value, f"--set {assignment!r}")
    return values


def _read_meanings(section: type) -> dict:
    """The comment above each entry of a section, in one line and without its markup."""
    meanings = {}
    words = []
    for line in map(str.strip, inspect.getsource(section).splitlines()):
        if line.startswith("#:"):
            words.append(line[2:].strip())
        elif words:
            meanings[line.partition(":")[0]] = " ".join(words).replace("``", "")
            words = []
    return meanings
