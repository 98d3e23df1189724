"""Groups of options that a verb receives as one value."""

from dataclasses import dataclass
from typing import Annotated

import typer
from typer.testing import CliRunner

from pipeline.commands.signatures import for_typer, group


@dataclass(frozen=True)
class Size:
    rows: int = 10
    columns: int = 20


SizeGiven = group(
    Size,
    rows=Annotated[int, typer.Option(help="Rows.")],
    columns=Annotated[int, typer.Option("--cols", help="Columns.")],
)


def told(*arguments):
    """The line that a verb with the group prints, or the status if it fails."""

    def verb(name: str, *, size: SizeGiven, loud: bool = False):
        typer.echo(f"{name} {size} {loud}")

    app = typer.Typer()
    app.command()(for_typer(verb))
    done = CliRunner().invoke(app, list(arguments))
    return done.output.strip() if done.exit_code == 0 else done.exit_code


def test_a_verb_receives_its_options_as_one_value_with_their_defaults():
    assert told("a") == "a Size(rows=10, columns=20) False"
    assert told("a", "--cols", "3", "--loud") == "a Size(rows=10, columns=3) True"
    assert told("a", "--columns", "3") == 2


def test_the_help_lists_the_options_with_short_placeholders_in_the_group_s_order():
    text = told("--help")
    assert 0 < text.index("--rows") < text.index("--cols") < text.index("--loud")
    assert "INTEGER" not in text
