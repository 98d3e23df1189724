"""Figures that the documents quote, from the files in ``results/``.

A figure is between marks, where the documentation command writes it:

- ``<!-- figure: FILE PATH FORMAT -->0.891<!-- /figure -->``, one value of a JSON file: each word of
  the path is a key of an object, or the ``model`` or ``row`` of an entry of a list; the format is
  Python's, with ``100*`` before it for percentages;
- a table or the output of a command, by a name of :data:`TABLES`.

Results have the hash of the recordings on which they were measured.  If these are not the present
built-in recordings, the table has a note.
"""

from __future__ import annotations

import re
from pathlib import Path

from deploy.errors import UserError
from deploy.files import read_json
from experiments.adaptation import METHODS
from experiments.choices import choices_text
from experiments.events import events_text
from experiments.losses import losses_text
from experiments.table2 import table_text
from experiments.table2_splits import MODELS
from pipeline.results.sweep_text import sweep_text

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "results"
TABLE2 = ("table2-images", "table2-slayer-random", "table2-slayer-writers", "table2-events")
"""Files with rows of Table 2."""

EARLIER = "earlier recordings"


def recordings_now() -> str:
    """SHA-256 of the present built-in recordings, from the file of their calibration."""
    return _read(ROOT / "pipeline" / "skin" / "calibration.json")["fit"]["recordings_sha256"]


def result(name: str) -> dict:
    """The content of a result file, by its name without ``.json``."""
    return _read(FOLDER / f"{name}.json")


def recordings_of(content: dict):
    """SHA-256 of the built-in recordings for which a result was measured; None if unknown.

    Results on pen trajectories have it as well, because both are made with the same skin.
    """
    made_from = (content.get("made_from") or {}).get("contents", {})
    return made_from.get("recordings") or content.get("source_sha256")


def is_present(content: dict) -> bool:
    """True if a result was measured on the present built-in recordings."""
    return recordings_of(content) == recordings_now()


def with_figures(text: str) -> str:
    """A document with updated values between the marks of single figures."""

    def write(found):
        return f"<!-- figure: {found[1]} -->{figure(found[1])}<!-- /figure -->"

    return re.sub(r"<!-- figure: ([^>]*?) -->.*?<!-- /figure -->", write, text, flags=re.DOTALL)


def figure(address: str) -> str:
    """One value, as text.

    Parameters
    ----------
    address : str
        File, path and format, such as ``losses-simulated loss chip-50 mean 100*.2f``.

    Raises
    ------
    ValueError
        The result has no such value.
    """
    name, *path, layout = address.split()
    try:
        value = result(name)
        for word in path:
            value = _entry(value, word)
        points = layout.startswith("100*")
        return format(100 * value if points else value, layout.removeprefix("100*"))
    except (KeyError, IndexError, StopIteration, TypeError, ValueError, UserError) as error:
        raise ValueError(f"figure {address!r}: {error!r}") from error


def _entry(value, word):
    if isinstance(value, dict):
        return value[word]
    if word.isdigit():
        return value[int(word)]
    return next(entry for entry in value if word in (entry.get("model"), entry.get("row")))


def table2_markdown() -> str:
    """Table 2 with random splits and splits with new writers, next to the paper's figures."""
    lines = ["| | random splits | new writers | paper, real data |", "|---|---|---|---|"]
    for name, model in MODELS.items():
        paper = "" if model.paper is None else f"{model.paper[0]:.2f} ({model.paper[1]:.2f})"
        cells = [_cell(name, key) for key in ("rows", "writer_rows")]
        lines.append(f"| {model.title} | {' | '.join(cells)} | {paper} |")
    return "\n".join(lines)


def _cell(model, key):
    """Mean (SD) over the splits of a row; their number unless it is ten; a note on recordings."""
    for name in TABLE2:
        if not (FOLDER / f"{name}.json").exists():
            continue
        content = result(name)
        for row in content[key]:
            if row["model"] == model and row["per_split"]:
                sd = row["accuracy_sd"]
                text = f"{row['accuracy_mean']:.3f}" + (f" ({sd:.3f})" if sd is not None else "")
                splits = len(row["per_split"])
                notes = [f"{splits} split{'s' * (splits > 1)}"] * (splits != 10)
                notes += [EARLIER] * (not is_present(content))
                return ", ".join([text, *notes])
    return "not measured"


def losses_markdown() -> str:
    """Points lost from the CNN to the chip, next to the paper's."""
    content = result("losses-simulated")
    here = "here" if is_present(content) else f"here, {EARLIER}"
    lines = [f"| points lost, 95 % interval | {here} | paper |", "|---|---|---|"]
    for stage, title, paper in (
        ("spiking-lif", "CNN to spiking network (NengoDL)", "2"),
        ("chip-100", "CNN to chip, presented for 100 steps", "3"),
        ("chip-50", "CNN to chip, presented for 50 steps, half the operations", ""),
    ):
        loss = content["loss"][stage]
        low, high = (100 * bound for bound in loss["ci95"])
        lines.append(f"| {title} | {100 * loss['mean']:.2f} ({low:.2f} to {high:.2f}) | {paper} |")
    return "\n".join(lines)


def events_markdown() -> str:
    """The network on events over seeds, for simulated writers and for real pen trajectories."""
    content = result("events-seeds")
    earlier = "" if is_present(content) else f", {EARLIER}"
    groups = {"simulated hands": [], "real pen trajectories": []}
    for name, run in content["runs"].items():
        groups[name.partition(",")[0]].append(run)
    simulated, real = groups.values()
    heads = "recordings", "trained", "chip", "operations", "agreement"
    heads = [*heads, "early decision after", "its accuracy"]
    keys = "trained", "fast", "operations", "agreement", "share", "accuracy_by_itself"

    def cells(pick):
        values = dict(
            zip(keys, (pick([run[key] for run in simulated]) for key in keys), strict=True)
        )
        return _of_events(values)

    mean, low, high = cells(lambda v: sum(v) / len(v)), cells(min), cells(max)
    rows = [
        [f"simulated writers, mean of {len(simulated)} seeds{earlier}", *mean],
        ["lowest and highest of them", *(f"{a}, {b}" for a, b in zip(low, high, strict=True))],
        *(
            [f"**real pen trajectories**, seed {seed}{earlier}", *_of_events(run)]
            for seed, run in enumerate(real)
        ),
    ]
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _of_events(run):
    return [
        f"{run['trained']:.3f}",
        f"{run['fast']:.3f}",
        f"{run['operations']:.2f}",
        f"{run['agreement']:.1%}".replace("%", " %"),
        f"{run['share']:.0%}".replace("%", " %"),
        f"{run['accuracy_by_itself']:.3f}",
    ]


def adaptation_markdown(name: str) -> str:
    """A network for people to whom nothing was fitted, before and after it is fitted to each.

    Parameters
    ----------
    name : str
        A result of ``python -m experiments adapt --handwriting``.
    """
    heads = ("fitted", "people, draws", "of each digit", "before", "after", "gain, points")
    heads = [*heads, "worst person", "lost", "changed"]
    lines = [heads, ["---"] * len(heads)]
    for method, found in result(name)["methods"].items():
        for count, row in found["each"].items():
            low, high = row["interval95"]
            cells = [
                *(METHODS[method].title, f"{found['people']}, {found['draws']}", count),
                *(f"{row['before']:.3f}", f"{row['after']:.3f}"),
                f"{row['gain_points']:+.1f} ({low:+z.1f} to {high:+z.1f})",
                *(format(row["worst"], "+z.1f"), format(row["lost"], "z.1f")),
                f"{row['used']:.0%}".replace("%", " %"),
            ]
            lines.append(cells)
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _sweep_output(name, command):
    content = result(name)
    table = sweep_text(content).partition("\n* on the Pareto front")[0]
    return _output(command, table, content)


def _table2_output(name, command):
    content = result(name)
    _, rows = table_text(content).split("\n\n", 1)
    return _output(command, rows, content)


def _speed_output(part, options):
    from experiments import emulator_speed  # imports NengoLoihi, without TensorFlow
    from fastloihi import speed  # isort: skip

    content = result("speed")
    text_of = speed.text_of if part == "networks" else emulator_speed.speed_text
    return _output(f"python -m experiments speed {options}", text_of(content[part]), content)


def _output(command, text, content):
    """The output of a command in a block, with a note if the recordings are earlier ones."""
    block = f"```\n$ {command}\n{text.rstrip()}\n```"
    return "\n".join([block, *_note(content)])


def _note(content):
    if is_present(content):
        return []
    earlier = (recordings_of(content) or "unknown")[:8]
    return ["", f"(Measured on {EARLIER}, SHA-256 `{earlier}...`.)"]


TABLES = {
    "table 2": table2_markdown,
    "output of table2": lambda: _table2_output(
        "table2-images",
        "python -m experiments table2 --models cnn,ann-snn,loihi,own-ann-snn,own-loihi",
    ),
    "output of table2 with SLAYER": lambda: _table2_output(
        "table2-slayer-random",
        "python -m experiments table2 --models slayer,slayer-small --kind random",
    ),
    "output of table2 with SLAYER on new writers": lambda: _table2_output(
        "table2-slayer-writers",
        "python -m experiments table2 --models slayer,slayer-small --kind writers",
    ),
    "output of table2 on events": lambda: _table2_output(
        "table2-events", "python -m experiments table2 --models events,events-loihi"
    ),
    "losses": losses_markdown,
    "output of losses": lambda: _text(
        "losses-simulated", "python -m experiments losses", losses_text
    ),
    "output of conversion": lambda: _text(
        "conversion-simulated", "python -m experiments choices", choices_text
    ),
    "output of events": lambda: _events_output("events-simulated", ""),
    "output of events with pen trajectories": lambda: _events_output(
        "events-pen", " --data pen.zip --out runs/time-pen"
    ),
    "events over seeds": events_markdown,
    "output of emulator": lambda: _speed_output("image", "runs/default/bundle"),
    "output of emulator on events": lambda: _speed_output("events", "runs/events/bundle"),
    "output of emulator on networks": lambda: _speed_output("networks", "--networks"),
    "output of sweep": lambda: _sweep_output("sweep", "stmnist sweep runs/sweep"),
    "output of sweep of architectures": lambda: _sweep_output(
        "architectures",
        "stmnist sweep runs/architectures --grid cnn.architecture=10x10-6c4-24c3-10o,...",
    ),
    "adaptation on events": lambda: adaptation_markdown("adapt-events"),
    "adaptation on images": lambda: adaptation_markdown("adapt-images"),
}
"""Content between the marks of each name, as Markdown."""


def _text(name, command, text_of):
    content = result(name)
    return _output(command, text_of(content), content)


def _events_output(name, options):
    """The output of ``benchmark events`` without the explanation of its columns."""
    content = result(name)
    seeds = len(content["variants"]["as-is"]["seeds"])
    command = f"python -m experiments events{f' --seeds {seeds}' if seeds > 1 else ''}{options}"
    rows = events_text(content).partition("\n\nas-is:")[0]
    return _output(command, rows, content)


def _read(path):
    return read_json(path, "it is a file of the repository: restore it")
