"""The generated parts of the documentation: every command, every setting, and measured figures.

``python -m experiments document`` updates them between their marks in the files of
`FILES`; a test checks that they are current.  Figures come from ``results/``
(:mod:`experiments.figures`).
"""

from __future__ import annotations

import inspect
import json
import re
from itertools import groupby
from pathlib import Path
from typing import Annotated

import typer

from deploy.files import replacing
from experiments.figures import TABLES, with_figures
from pipeline.settings import Settings, describe

ROOT = Path(__file__).resolve().parent.parent
FILES = (
    *("README.md", "docs/commands.md", "docs/settings.md"),
    *("docs/adapt.md", "docs/benchmarks.md", "docs/bundle.md", "docs/events.md", "docs/live.md"),
    *("docs/nengo-loihi.md", "docs/training.md"),
)
"""Files with generated parts, relative to the root of the repository."""


def commands() -> str:
    """Every command with its arguments and options, as Markdown."""
    from pipeline.commands.main import with_every_verb

    return "\n".join(_sections(with_every_verb(), "stmnist", 2))


def settings() -> str:
    """Every setting with its default and meaning, as Markdown, a heading for each section."""
    lines = []
    for section, rows in groupby(describe(Settings()), lambda row: row["name"].rpartition(".")[0]):
        about = getattr(Settings(), section) if section else Settings()
        lines += [f"\n## {section or 'The experiment'}\n", f"{_plain(inspect.getdoc(about))}\n"]
        for row in rows:
            default = json.dumps(row["default"], ensure_ascii=False)
            lines.append(f"- `{row['name']}`, by default `{default}`: {row['meaning']}")
    return "\n".join(lines)


PARTS = {"commands": commands, "settings": settings, **TABLES}


def with_parts(text: str) -> str:
    """A document with updated parts and figures between their marks.

    Raises
    ------
    ValueError
        A part has a mark at its beginning but not at its end, or a figure does not exist.
    """
    for name, part in PARTS.items():
        begin = f"<!-- {name}: written by python -m experiments document -->"
        end = f"<!-- end of {name} -->"
        before, found, rest = text.partition(begin)
        if not found:
            continue
        _, closed, after = rest.partition(end)
        if not closed:
            raise ValueError(f"no mark {end!r} in the text")
        text = f"{before}{begin}\n{part()}\n{end}{after}"
    return with_figures(text)


def _sections(command, words, depth):
    summary = _plain(command.help)
    if hasattr(command, "commands"):
        if depth > 2:  # the top command has its own title
            yield f"\n{'#' * (depth - 1)} {words}\n\n{summary}"
        for name, below in command.commands.items():
            yield from _sections(below, f"{words} {name}", depth + 1)
        return
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    usage = " ".join([words, *(p.name.upper() for p in arguments)])
    yield f"\n{'#' * (depth - 1)} {words}\n\n`{usage}`\n\n{summary}\n"
    for parameter in command.params:
        if parameter.param_type_name == "argument":
            name = parameter.name.upper()
        else:
            name = ", ".join([*parameter.opts, *parameter.secondary_opts])
        yield f"- `{name}`: {' '.join((parameter.help or '').split())}"


def _plain(text):
    """The text of a docstring in one line, without markup."""
    return re.sub(r":\w+:`~?([^`]*)`", r"`\1`", " ".join(text.split())).replace("``", "`")


def main(
    files: Annotated[list[Path] | None, typer.Argument(help="Files (default: all).")] = None,
):
    """Write commands, settings and the figures of results/ into README and docs."""
    for path in files or [ROOT / name for name in FILES]:
        current = path.read_text(encoding="utf-8")
        with replacing(path, "w") as file:
            file.write(with_parts(current))
