"""Artifacts: results on disk that know what they were made from.

An artifact is one or more files.  One of them, its *record*, is JSON, is written last, and has the
entry ``made_from``: the artifact's :class:`Origin`, which holds

- the values of all settings that it depends on, those of the artifacts it uses included, and
- hashes of contents that no setting determines, such as the recordings.  No path is in it: a file
  that was moved is still the same file.

An artifact is *current* if its record has the origin that the settings give now; otherwise
:meth:`Artifact.state` says which entries differ.  Every result of this project that takes time to
make is found in this way: those of a run, the splits of an experiment and the points of a sweep.
(Only a check that was interrupted keeps its streams in a way of its own, :mod:`deploy.check.run`,
since it runs on hosts that have no settings.)

A dependency cannot be forgotten.  An origin declares its settings, and the code that makes the
artifact is given ``origin.view(settings)``, which has no others: to read another one raises
:class:`pipeline.settings.UndeclaredSetting`, in this process, in a worker or on a cluster.
Dependencies are declared rather than recorded while the artifact is made, because a declared origin
is known beforehand: it can be looked up before any work is done, and it serves as the artifact's
name where several variants are kept side by side (:class:`Library`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from deploy import __version__
from deploy.files import read_json, write_json
from pipeline.settings import Settings, names_in

CURRENT, OUTDATED, MISSING = "current", "outdated", "missing"
"""States of an artifact."""

DELETE_IT = "delete it and run the command again"
"""Remedy for a damaged file."""

LONGEST = 100
"""Characters of a value in a reason."""

PACKAGE = "package version"
"""The entry of an origin's contents that changes with each release of this package."""


@dataclass(frozen=True)
class Origin:
    """The inputs that an artifact is made from.

    Attributes
    ----------
    settings : dict
        Values by dotted name, as JSON has them.
    contents : dict of str to str
        Hashes or versions of what is no setting, by a name that the user understands.
    """

    settings: dict = field(default_factory=dict)
    contents: dict = field(default_factory=dict)

    @classmethod
    def of(cls, settings: Settings, reads=(), uses=(), contents=None) -> Origin:
        """The origin of an artifact that is to be made.

        Parameters
        ----------
        settings : Settings
        reads : sequence of str
            Settings (``"cnn.epochs"``) and sections (``"image"``) that its making reads, beside
            those of the artifacts it uses.
        uses : sequence of Origin
            Origins of the artifacts that it is made from.
        contents : dict of str to str, optional
            Other values on which it depends.
        """
        names = [name for entry in reads for name in names_in(entry)]
        values = {name: _plain(settings.value(name)) for name in names}
        merged = {PACKAGE: __version__, **(contents or {})}
        for used in uses:
            values = _joined(used.settings, values)
            merged = _joined(used.contents, merged)
        return cls(values, merged)

    @property
    def key(self) -> str:
        """SHA-256 of all of it."""
        text = json.dumps(self.to_json(), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def view(self, settings: Settings) -> Settings:
        """The settings that code which makes the artifact may read."""
        return settings.only(self.settings)

    def to_json(self) -> dict:
        """The origin as plain values, as a record has it under ``made_from``."""
        return {"settings": self.settings, "contents": self.contents}

    def changes_since(self, recorded) -> tuple:
        """Differences between the origin and that in a record.

        Parameters
        ----------
        recorded : dict or None
            As from :meth:`to_json`; anything else is the record of a version that kept none.

        Returns
        -------
        tuple of Change
        """
        if not _is_origin(recorded):
            return (Change("made by an earlier version, which did not record its settings"),)
        changes = []
        for now, before, show in (
            (self.settings, recorded["settings"], _shown),
            (self.contents, recorded["contents"], _shortened),
        ):
            for name in dict.fromkeys([*now, *before]):
                if now.get(name) != before.get(name) or (name in now) != (name in before):
                    values = (
                        show(part[name]) if name in part else "unused" for part in (before, now)
                    )
                    changes.append(Change(name, *values))
        return tuple(changes)


@dataclass(frozen=True)
class Change:
    """One difference between what an artifact was made from and what it would be made from now.

    Attributes
    ----------
    what : str
        A setting or a content.
    before, now : str or None
        Its values; None where ``what`` says it all.
    """

    what: str
    before: str | None = None
    now: str | None = None

    def __str__(self):
        return self.what if self.now is None else f"{self.what}: {self.before} -> {self.now}"

    @property
    def sentence(self) -> str:
        """The change as part of a sentence."""
        if self.now is None:
            return self.what
        return f"{self.what} changed from {self.before} to {self.now}"


@dataclass(frozen=True)
class State:
    """The state of an artifact relative to the settings.

    Attributes
    ----------
    name : str
        Name of the artifact.
    state : str
        `CURRENT`, `OUTDATED` or `MISSING`.
    because : tuple of Change
        Why it is outdated.
    record : dict
        The content of its record; empty if it is missing.
    """

    name: str
    state: str
    because: tuple = ()
    record: dict = field(default_factory=dict)

    @property
    def is_current(self) -> bool:
        """True if it need not be made again."""
        return self.state == CURRENT

    def reasons(self) -> str:
        """Why it is outdated, in one line with the first few changes."""
        shown = [change.sentence for change in self.because[:3]]
        left = len(self.because) - len(shown)
        return ", ".join(shown) + (f" and {left} more" if left else "")

    def announcement(self, action: str) -> str | None:
        """The line that says why something is done again, or None if it never was.

        Parameters
        ----------
        action : str
            Such as ``"training"``.
        """
        if self.state != OUTDATED:
            return None
        return f"{self.name}: {action} again: {self.reasons()}"

    def to_json(self) -> dict:
        """``name``, ``state`` and ``because``."""
        return {"name": self.name, "state": self.state, "because": list(map(str, self.because))}


def recorded_origin(content: dict):
    """Read the origin of an artifact from its record."""
    return content.get("made_from")


@dataclass(frozen=True)
class Artifact:
    """The place of an artifact.

    Attributes
    ----------
    name : str
        Name of the artifact for the user.
    record : Path
        Its JSON file, written last.
    files : tuple of Path
        The others; without one of them the artifact is missing.
    made_from : callable
        From the record's content to what it says of the artifact's origin.
    """

    name: str
    record: Path
    files: tuple = ()
    made_from: Callable = recorded_origin

    def state(self, origin: Origin) -> State:
        """Compare what is there with what the settings ask for.

        Raises
        ------
        UserError
            The record is damaged.
        """
        if not all(path.exists() for path in (self.record, *self.files)):
            return State(self.name, MISSING)
        content = read_json(self.record, DELETE_IT)
        changes = origin.changes_since(self.made_from(content))
        return State(self.name, OUTDATED if changes else CURRENT, changes, content)

    def write(self, origin: Origin, content: dict) -> dict:
        """Write the record, once the other files are there; return its content."""
        content = {"made_from": origin.to_json(), **content}
        write_json(self.record, content)
        return content


@dataclass(frozen=True)
class Library:
    """A folder that keeps variants of an artifact side by side, each under its origin's key.

    Attributes
    ----------
    path : Path
    """

    path: Path

    def folder(self, name: str, origin: Origin) -> Path:
        """The folder of one variant."""
        return self.path / name / origin.key[:16]


def _joined(used, own):
    """Two parts of origins as one; what both have must be the same."""
    for name in used.keys() & own.keys():
        if used[name] != own[name]:
            raise ValueError(
                f"{name} is {own[name]!r} here and {used[name]!r} in an artifact that is used; "
                "an artifact and those that it uses need the same settings"
            )
    return {**used, **own}


def _is_origin(recorded):
    return isinstance(recorded, dict) and all(
        isinstance(recorded.get(part), dict) for part in ("settings", "contents")
    )


def _plain(value):
    """A value as JSON gives it back."""
    return [_plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value


def _shown(value):
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."


def _shortened(content):
    text = str(content)
    return text if len(text) <= 16 else text[:12]
