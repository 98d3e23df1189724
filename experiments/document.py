"""The generated parts of the documents: every command, every setting, tables and single figures.

``python -m experiments document`` writes them between their marks; a test checks that they are
current.  Tables and figures come from the files in ``results/``:

- ``<!-- NAME: made by experiments/document.py -->`` begins a table of ``results/NAME``,
  or ``commands``, ``licences`` or ``settings``; ``<!-- end of NAME -->`` ends it;
- ``<!-- figure: FILE PATH FORMAT -->0.891<!-- /figure -->`` has one value of a file: each word of
  the path (in quotes, if it has blanks) is a key of an object, or the name of an entry of a list
  (``name``, ``a``, ``network``); the format is Python's, with ``100*`` before it for points.
"""

import inspect
import json
import re
import shlex
from collections import Counter
from functools import reduce
from itertools import groupby
from pathlib import Path
from typing import Annotated

import typer

from deploy.errors import UserError
from deploy.files import read_json, replacing
from experiments import (
    adapt,
    fidelity,
    growth,
    licences,
    pens,
    speed,
    stream,
    study_tables,
    tables,
    transfer,
)
from experiments.catalogue import EXPERIMENTS
from experiments.results import RESULTS
from pipeline.results.sweep import format_sweep
from pipeline.settings import Settings, describe_settings

ROOT = Path(__file__).resolve().parent.parent
# The documents, relative to the root of the repository.
FILES = ("README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")))

# The rows of the table in the README, and their lines in the experiments of its columns.
BRIEF = {
    "logistic regression on event counts": {"counts"},
    "Gaussian kernel on square roots of counts": {"kernel"},
    "nearest training recording": {"nearest"},
    "CNN, trained as in the paper": {"cnn"},
    "ANN-SNN, trained as in the paper, emulated Loihi": {"loihi"},
    "CNN, longer training": {"cnn-matched"},
    "**one image**, emulated Loihi": {"chip", "own-loihi"},
    "- with one hot taxel": {"own-loihi-hot1"},
    "- with five dead taxels": {"own-loihi-dead5"},
    "**slices of time**, emulated Loihi": {"slices"},
    "- with one hot taxel ": {"slices-hot1"},
    "- with five dead taxels ": {"slices-dead5"},
    "**events**, emulated Loihi": {"events-chip", "events-loihi"},
    "- with one hot taxel  ": {"events-loihi-hot1"},
    "- with five dead taxels  ": {"events-loihi-dead5"},
    "events, small network, emulated Loihi": {"events-small-loihi"},
    "events, large network, emulated Loihi": {"events-large-loihi"},
}
# The columns: results, and one of their splits.
COLUMNS = {
    "ST-MNIST, random splits": (("table2-stmnist", "table2-stmnist-large"), "random"),
    "whole styles held out": (("table2-stmnist",), "styles"),
    "ST-MNIST, published split": (("table2-stmnist-published",), "published"),
    "Ev-Objects": (("real-touch-objects",), "published"),
    "Braille letters": (("real-touch-letters",), "published"),
}


def read_result(name: str) -> dict:
    """The content of a file in ``results/``, by its name without ``.json``."""
    return read_json(RESULTS / f"{name}.json", "it is a file of the repository: restore it")


def describe_commands() -> str:
    """Every command with its arguments and options, as Markdown."""
    from pipeline.commands.main import with_every_verb

    command = with_every_verb()
    groups = {}  # the first word of each command that has a parameter of this name and meaning
    for group, parameter in _list_parameters(command):
        groups.setdefault(_find_help(parameter), []).append(group)
    common = [parameter for parameter, groups_of in groups.items() if len(groups_of) > 3]
    names = Counter(name for name, _ in common)
    lines = ["\n## Options of several commands\n"]
    for name, text in common:
        groups_of = set(groups[name, text])
        of_command = (
            f" of `stmnist {groups_of.pop()}`" if names[name] > 1 and len(groups_of) == 1 else ""
        )
        lines.append(f"- `{name}`{of_command}: {text}")
    return "\n".join([*lines, *_list_sections(command, "stmnist", 2, common)])


def list_settings() -> str:
    """Every setting with its default and meaning, as Markdown, a heading for each section."""
    settings = describe_settings(Settings())
    sections = dict.fromkeys(row["name"].rpartition(".")[0] for row in settings)
    links = " · ".join(f"[{name}](#{name})" for name in sections if name)
    lines = [f"Sections: {links}"]
    for section, rows in groupby(settings, lambda row: row["name"].rpartition(".")[0]):
        about = getattr(Settings(), section) if section else Settings()
        lines += [
            f"\n## {section or 'The experiment'}\n",
            f"{_strip_markup(inspect.getdoc(about))}\n",
        ]
        for row in rows:
            default = json.dumps(row["default"], ensure_ascii=False)
            # A heading of its own, so that a search of the site finds a setting by its name.
            lines.append(f"\n### `{row['name']}`\n\nDefault: `{default}`\n\n{row['meaning']}")
    return "\n".join(lines)


def make_part(name: str) -> str:
    """The content between the marks of a name, as Markdown.

    Raises
    ------
    UserError
        There is no such result.
    """
    if name == "licences":
        return make_markdown(licences.make_cells())
    if name == "commands":
        return describe_commands()
    if name == "settings":
        return list_settings()
    if name == "brief":
        return make_brief_table(COLUMNS)
    content = read_result(name)
    kind = content.get("experiment", "sweep")
    if kind == "sweep":
        return f"```\n{format_sweep(content).partition(chr(10) + '* on')[0]}\n```"
    if kind.startswith("adapt"):
        return make_markdown(adapt.make_cells(content))
    if kind == "fidelity":
        return make_markdown(fidelity.make_cells(content))
    if kind == "transfer":
        return make_markdown(transfer.make_cells(content))
    if kind == "speed":
        return make_markdown(speed.make_cells(content))
    if kind == "pens":
        return make_markdown(pens.make_cells(content))
    if kind == "stream":
        return make_markdown(stream.make_cells(content))
    if kind == "growth":
        return make_markdown(growth.make_cells(content))
    experiment = next(candidate for candidate in EXPERIMENTS if candidate.name == kind)
    splits = dict.fromkeys(row["split"] for row in content["rows"])
    parts = [make_markdown(study_tables.make_cells(experiment, content, split)) for split in splits]
    if content["comparisons"]:
        titles = {line.name: line.title for line in experiment.lines}
        parts.append(make_markdown(tables.make_comparison_cells(content, titles)))
    return "\n\n".join([*parts, experiment.note])


def make_brief_table(columns: dict) -> str:
    """Accuracies, a column for each split; empty where a network was not measured."""
    lines = [["accuracy, mean (SD)", *columns]]
    for title, names in BRIEF.items():
        line = []
        for files, split in columns.values():
            rows = [row for file in files for row in read_result(file)["rows"]]
            means = [
                _format_mean(row) for row in rows if row["name"] in names and row["split"] == split
            ]
            line.append("".join(means))
        lines += [[title, *line]] if any(line) else []
    return make_markdown(lines)


def _format_mean(row):
    """The mean of a row over its splits, with the SD where there are enough of them."""
    sd = "" if row["sd"] is None else f" ({row['sd']:.3f})"
    return f"{row['mean']:.3f}{sd}"


def make_markdown(cells) -> str:
    """A table of text, the heads first, without empty columns."""
    columns = [column for column in zip(*cells, strict=True) if any(column[1:])]
    heads, *rows = zip(*columns, strict=True)
    return "\n".join(f"|{'|'.join(line)}|" for line in (heads, ["---"] * len(heads), *rows))


def with_parts(text: str) -> str:
    """A document with updated parts and figures between their marks.

    Raises
    ------
    ValueError
        A part has a mark at its beginning but not at its end, or a figure does not exist.
    """
    mark = "made by experiments/document.py -->"
    for name in re.findall(rf"^<!-- ([\w-]+): {mark}$", text, re.MULTILINE):
        begin = f"<!-- {name}: {mark}"
        end = f"<!-- end of {name} -->"
        before, _, following = text.partition(begin)
        _, closed, after = following.partition(end)
        if not closed:
            raise ValueError(f"no mark {end!r} in the text")
        text = f"{before}{begin}\n{make_part(name)}\n{end}{after}"

    def write(match):
        return f"<!-- figure: {match[1]} -->{read_figure(match[1])}<!-- /figure -->"

    return re.sub(r"<!-- figure: ([^>]*?) -->.*?<!-- /figure -->", write, text, flags=re.DOTALL)


def read_figure(address: str) -> str:
    """One value, as text.

    Parameters
    ----------
    address : str
        File, path and format, such as ``losses rows cnn mean .3f``.

    Raises
    ------
    ValueError
        The result has no such value.
    """
    name, *path, layout = shlex.split(address)
    try:
        value = reduce(_find_entry, path, read_result(name))
        points = 100 if layout.startswith("100*") else 1
        return format(points * value, layout.removeprefix("100*"))
    except (KeyError, IndexError, StopIteration, TypeError, ValueError, UserError) as error:
        raise ValueError(f"figure {address!r}: {error!r}") from error


def _find_entry(value, word):
    if isinstance(value, dict):
        return value[word]
    if word.isdigit():
        return value[int(word)]
    return next(e for e in value if word in (e.get("name"), e.get("a"), e.get("network")))


def _list_parameters(command, group=""):
    """The first word of each command, and each of its parameters."""
    if hasattr(command, "commands"):
        for name, below in command.commands.items():
            yield from _list_parameters(below, group or name)
    else:
        yield from ((group, parameter) for parameter in command.params)


def _find_help(parameter):
    """Name and meaning of an argument or an option."""
    if parameter.param_type_name == "argument":
        name = parameter.name.upper()
    else:
        name = ", ".join([*parameter.opts, *parameter.secondary_opts])
    return name, " ".join((parameter.help or "").split())


def _list_sections(command, words, depth, common):
    summary = _strip_markup(command.help)
    if hasattr(command, "commands"):
        if depth > 2:  # the top command has its own title
            yield f"\n{'#' * (depth - 1)} {words}\n\n{summary}"
        for name, below in command.commands.items():
            yield from _list_sections(below, f"{words} {name}", depth + 1, common)
        return
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    usage = " ".join([words, *(p.name.upper() for p in arguments)])
    yield f"\n{'#' * (depth - 1)} {usage}\n\n{summary}\n"
    parameters = [_find_help(p) for p in command.params]
    for name, text in parameters:
        if (name, text) not in common:
            yield f"- `{name}`: {text}"
    also = [f"`{n}`" for n, text in parameters if (n, text) in common and n.startswith("-")]
    if also:
        yield f"- also: {', '.join(also)}"


def _strip_markup(text):
    """The text of a docstring in one line, without markup."""
    return re.sub(r":\w+:`~?([^`]*)`", r"`\1`", " ".join(text.split())).replace("``", "`")


def main(
    files: Annotated[list[Path] | None, typer.Argument(help="Documents (default: all).")] = None,
):
    """Write commands, settings and the figures of results/ into README and docs."""
    for path in files or [ROOT / name for name in FILES]:
        current = path.read_text(encoding="utf-8")
        updated = with_parts(current)
        if updated != current:
            with replacing(path, "w") as file:
                file.write(updated)
