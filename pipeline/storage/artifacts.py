"""Artifacts: results on disk with a record of what they were made from.

An artifact is one or more files.  One of them, its *record*, is a JSON file that is written last.
Its entry ``made_from`` is the artifact's :class:`Origin`, which has

- the values of all settings on which the artifact depends, including those of the artifacts that
  it uses, and
- hashes of contents that no setting determines, such as the recordings.  It has no paths, because
  moving a file does not change the artifact.

An artifact is *current* if its record has the origin that follows from the present settings;
otherwise :meth:`Artifact.find_state` returns the entries that differ.  Every result of this
project that takes time to make is found in this way: those of a run, the splits of an experiment
and the points of a sweep.  (Only an interrupted check has another mechanism for its streams,
:mod:`deploy.check.run`, since it also runs on hosts without settings.)

A dependency cannot be forgotten.  An origin declares its settings, and the code that makes the
artifact receives ``settings.select(origin.settings)``, which has only these.  Reading another one
raises :class:`pipeline.settings.base.UndeclaredSetting`, in this process, in a worker or on a
cluster.

Dependencies are declared rather than recorded while the artifact is made, because a declared origin
is known beforehand: it can be compared before any work is done, and its key is the name of an
artifact of which several variants are stored (:class:`Library`).
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from deploy import __version__
from deploy.files import read_json, write_json
from pipeline.settings import KEPT_SETTINGS, Settings, format_automatic, list_names_in

# States of an artifact.
CURRENT = "current"
OUTDATED = "outdated"
MISSING = "missing"

# Remedy for a damaged file.
DELETE_IT = "delete it and run the command again"

_HASH = re.compile("[0-9a-f]{64}")

# Maximum length of a value in a message.
MAX_TEXT_LENGTH = 100

# The entry of an origin's contents that changes with each release of this package.
PACKAGE = "package version"


@dataclass(frozen=True)
class Origin:
    """The inputs that an artifact is made from.

    Attributes
    ----------
    settings : dict
        Values by dotted name, in JSON's types.
    contents : dict of str to str
        Hashes or versions of other dependencies, by a name that the user understands.
    """

    settings: dict = field(default_factory=dict)
    contents: dict = field(default_factory=dict)

    @classmethod
    def from_settings(cls, settings: Settings, reads=(), uses=(), contents=None) -> Origin:
        """Make the origin of an artifact from settings and other origins.

        Parameters
        ----------
        settings : Settings
        reads : sequence of str
            Settings (``"cnn.epochs"``) and groups of settings (``"image"``) that are read to make
            the artifact, in addition to those of the artifacts that it uses.
        uses : sequence of Origin
            Origins of the artifacts from which it is made.
        contents : dict of str to str, optional
            Other values on which the artifact depends.
        """
        names = [name for entry in reads for name in list_names_in(entry)]
        values = {name: _make_plain(settings.get_value(name)) for name in names}
        merged = {PACKAGE: __version__, **(contents or {})}
        for name in KEPT_SETTINGS:
            if name in values and settings.is_set_by_user(name):
                merged[f"{name} is kept"] = f"as it was set: {values[name]}"
        for used in uses:
            values = _merge_entries(used.settings, values)
            merged = _merge_entries(used.contents, merged)
        return cls(values, merged)

    @property
    def key(self) -> str:
        """SHA-256 of settings and contents."""
        return hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode()).hexdigest()

    def with_content(self, name: str, value: str) -> Origin:
        """The origin with another content."""
        return replace(self, contents={**self.contents, name: value})

    def to_json(self) -> dict:
        """The origin as plain values: the entry ``made_from`` of a record."""
        return {"settings": self.settings, "contents": self.contents}

    def list_changes_since(self, recorded) -> tuple:
        """Differences between the origin and that in a record.

        Parameters
        ----------
        recorded : dict or None
            From :meth:`to_json`; anything else was written before origins were recorded.

        Returns
        -------
        tuple of Change
        """
        if not _is_origin(recorded):
            return (Change("made by an earlier version, which did not record its settings"),)
        changes = []
        for now, before, show in (
            (self.settings, recorded["settings"], _format_value),
            (self.contents, recorded["contents"], _format_content),
        ):
            for name in dict.fromkeys([*now, *before]):
                if now.get(name) != before.get(name) or (name in now) != (name in before):
                    values = (_describe(name, recorded, show) for recorded in (before, now))
                    changes.append(Change(name, *values))
        return tuple(changes)


def _format_content(value):
    """A content for a message: the first digits of a hash, all of another text."""
    text = str(value)
    return text[:12] if _HASH.fullmatch(text) else text


def _describe(name, recorded, show):
    """A value of an origin for a message."""
    if name not in recorded:
        return "unused"
    return format_automatic(name, recorded[name]) or show(recorded[name])


@dataclass(frozen=True)
class Change:
    """A difference between the recorded origin of an artifact and its present origin.

    Attributes
    ----------
    name : str
        A setting or a content.
    before, now : str or None
        Its values; None if the name is sufficient.
    """

    name: str
    before: str | None = None
    now: str | None = None

    def __str__(self):
        if self.now is None:
            return self.name
        return f"{self.name} changed from {self.before} to {self.now}"


@dataclass(frozen=True)
class State:
    """The state of an artifact relative to the settings.

    Attributes
    ----------
    name : str
        Name of the artifact.
    condition : str
        `CURRENT`, `OUTDATED` or `MISSING`.
    because : tuple of Change
        The reasons, if it is outdated.
    record : dict
        The content of its record; empty if it is missing.
    """

    name: str
    condition: str
    because: tuple = ()
    record: dict = field(default_factory=dict)

    @property
    def is_current(self) -> bool:
        """True if the artifact need not be made again."""
        return self.condition == CURRENT

    @property
    def is_outdated(self) -> bool:
        """True if the artifact was made from other settings or contents."""
        return self.condition == OUTDATED

    @property
    def is_missing(self) -> bool:
        """True if the artifact was not made yet, or lacks a file."""
        return self.condition == MISSING

    def describe_reasons(self) -> str:
        """The first reasons why the artifact is outdated, in one line."""
        first_reasons = list(map(str, self.because[:3]))
        others = len(self.because) - len(first_reasons)
        return ", ".join(first_reasons) + (f" and {others} more" if others else "")

    def announce(self, action: str, say):
        """Say why an outdated artifact is made again.

        Parameters
        ----------
        action : str
            Such as ``"training"``.
        say : callable
        """
        if self.is_outdated:
            say(f"{self.name}: {action} again: {self.describe_reasons()}")

    def to_json(self) -> dict:
        """``name``, ``state`` and ``because``."""
        return {"name": self.name, "state": self.condition, "because": list(map(str, self.because))}


@dataclass(frozen=True)
class Artifact:
    """The place of an artifact, and the origin that it has if it is current.

    Attributes
    ----------
    name : str
        Name of the artifact for the user.
    record : Path
        Its JSON file, written last.
    origin : Origin
        The origin that follows from the present settings.
    files : tuple of Path
        The other files; without one of them the artifact is missing.
    made_from : callable
        Function that returns the origin recorded in a record's content.
    """

    name: str
    record: Path
    origin: Origin
    files: tuple = ()
    made_from: Callable = lambda content: content.get("made_from")

    @property
    def folder(self) -> Path:
        """The folder of the record."""
        return self.record.parent

    def find_state(self) -> State:
        """Compare the record with the origin that follows from the settings.

        Raises
        ------
        UserError
            The record is damaged.
        """
        if not all(path.exists() for path in (self.record, *self.files)):
            return State(self.name, MISSING)
        content = read_json(self.record, DELETE_IT)
        changes = self.origin.list_changes_since(self.made_from(content))
        return State(self.name, OUTDATED if changes else CURRENT, changes, content)

    def write(self, content: dict) -> dict:
        """Write the record after the other files; return its content."""
        content = {"made_from": self.origin.to_json(), **content}
        write_json(self.record, content)
        return content


@dataclass(frozen=True)
class Library:
    """A folder with several variants of artifacts, such as networks, each under its origin's key.

    A stage uses it in the same way as the folder of a run.

    Attributes
    ----------
    path : Path
    """

    path: Path

    def find_folder(self, name: str, origin: Origin) -> Path:
        """The folder of one variant."""
        return self.path / name / origin.key[:16]


def _merge_entries(used, values):
    """Merge entries of two origins; common entries must be equal."""
    for name in used.keys() & values.keys():
        if used[name] != values[name]:
            raise ValueError(
                f"{name} is {values[name]!r} here and {used[name]!r} in an artifact that is used; "
                "an artifact and those that it uses need the same settings"
            )
    return {**used, **values}


def _is_origin(recorded):
    return isinstance(recorded, dict) and all(
        isinstance(recorded.get(entry), dict) for entry in ("settings", "contents")
    )


def _make_plain(value):
    """A value after conversion to JSON and back."""
    return [_make_plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value


def _format_value(value):
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= MAX_TEXT_LENGTH else text[: MAX_TEXT_LENGTH - 3] + "..."
