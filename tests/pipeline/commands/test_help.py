"""The list of commands, and completion in the shell."""

import subprocess
import sys

import pytest

from pipeline.commands.main import make_command_line
from tests.command import ROOT, environment, printed_by


@pytest.mark.parametrize("verb", make_command_line().commands.values(), ids=lambda verb: verb.name)
def test_the_list_says_of_a_verb_what_its_own_help_begins_with(verb):
    """In the one it is kept next to the name, so that no module is imported to list it."""
    assert " ".join(verb.command.help.partition("\n\n")[0].split()) == verb.help


IMPORTED = """
import sys
from pipeline.commands.main import with_every_verb
with_every_verb()
print([name for name in ("scipy", "matplotlib", "nengo", "tensorflow") if name in sys.modules])
"""


def test_no_help_waits_for_a_slow_package():
    assert printed_by(IMPORTED).strip() == "[]"


COMPLETE = """
import sys
sys.argv = ["stmnist"]
from pipeline.commands.main import main
try:
    main([])
finally:
    assert "tensorflow" not in sys.modules
"""


@pytest.mark.parametrize(
    ("typed", "offered"), [("stmnist com", "compare"), ("stmnist ladder --sa", "--samples")]
)
def test_completion_offers_commands_and_options_without_tensorflow(typed, offered):
    done = subprocess.run(
        [sys.executable, "-c", COMPLETE],
        cwd=ROOT,
        env=environment(
            _STMNIST_COMPLETE="complete_bash",
            COMP_WORDS=typed,
            COMP_CWORD=str(len(typed.split()) - 1),
        ),
        capture_output=True,
        text=True,
    )
    assert offered in done.stdout.split(), done.stderr
    assert "Error" not in done.stderr
