"""``--help`` on a narrow terminal, and completion in the shell."""

import re
import shutil
import subprocess
import sys

import pytest

from pipeline.commands.main import command_line
from tests.command import ROOT, call, environment
from tests.test_documentation import commands

NARROW = 60
GROUPS = sorted({" ".join(words.split()[:-1]) for words in commands()})


@pytest.fixture
def shown(monkeypatch, capsys):
    def shown(words, width=NARROW):
        monkeypatch.setenv("COLUMNS", str(width))
        assert call(*words.split(), "--help") == 0
        return capsys.readouterr().out

    return shown


def words_of(text):
    return re.sub(r"[│╭╮╰╯─]", " ", text).split()


@pytest.mark.parametrize("words", [*GROUPS, *sorted(commands())])
def test_help_fits_60_columns_and_cuts_no_word(words, shown):
    text = shown(words)
    assert max(map(len, text.splitlines())) <= NARROW
    assert "…" not in text
    cut = set(words_of(text)) - set(words_of(shown(words, 300)))
    assert not cut, cut


@pytest.mark.parametrize("verb", command_line().commands.values(), ids=lambda verb: verb.name)
def test_the_list_says_of_a_verb_what_its_own_help_begins_with(verb):
    """In the one it is kept beside the name, so that no module is imported to list it."""
    assert " ".join(verb.chosen.help.partition("\n\n")[0].split()) == verb.help


@pytest.mark.parametrize("number", ["-1", "1000001", "many"])
def test_a_number_of_recordings_out_of_range_is_one_line(number, tmp_path, capsys):
    out = tmp_path / "x.zip"
    assert call("data", "simulate", "--out", out, "--samples-per-digit", number) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--samples-per-digit" in line
    assert not out.exists()


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
    ("typed", "offered"), [("stmnist com", "compare"), ("stmnist ladder --wh", "--whole")]
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


@pytest.mark.skipif(not shutil.which("bash"), reason="no bash")
def test_completion_can_be_shown():
    """In the shell that it is asked in, which here is bash, whatever started the tests."""
    done = subprocess.run(
        ["bash", "-c", f"'{sys.executable}' -m pipeline --show-completion; exit $?"],
        cwd=ROOT,
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert "_STMNIST_COMPLETE=complete_bash" in done.stdout, done.stderr
