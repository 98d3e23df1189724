"""The command reference of README.md, written from the commands themselves.

``python -m pipeline.commands.reference README.md`` puts it between the two marks; a test holds it
current.
"""

from __future__ import annotations

import sys
from pathlib import Path

import typer.main

from deploy.files import replacing

BEGIN = "<!-- reference: written by python -m pipeline.commands.reference README.md -->"
END = "<!-- end of reference -->"


def reference() -> str:
    """Every command with its arguments and options, as Markdown."""
    from pipeline.commands.main import app

    return "\n".join(_sections(typer.main.get_command(app), "stmnist"))


def with_reference(text: str) -> str:
    """A README's text with the part between the marks written anew.

    Raises
    ------
    ValueError
        It has no such marks.
    """
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError("no marks of the reference in the text")
    return f"{before}{BEGIN}\n{reference()}\n{END}{after}"


def _sections(command, words):
    if hasattr(command, "commands"):
        for name, below in command.commands.items():
            yield from _sections(below, f"{words} {name}")
        return
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    usage = " ".join([words, *(p.name.upper() for p in arguments)])
    yield f"\n**`{usage}`**  "
    yield " ".join(command.help.split()) + "\n"
    for parameter in command.params:
        if parameter.param_type_name == "argument":
            name = parameter.name.upper()
        else:
            name = ", ".join([*parameter.opts, *parameter.secondary_opts])
        yield f"- `{name}` {' '.join((parameter.help or '').split())}"


if __name__ == "__main__":
    path = Path(sys.argv[1])
    current = path.read_text(encoding="utf-8")
    with replacing(path, "w") as file:
        file.write(with_reference(current))
