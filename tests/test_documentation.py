"""Every command and option has help and is in the README; the Makefile lists its targets."""

import re
import subprocess

import pytest
import typer.main

from pipeline.commands.main import app
from pipeline.commands.reference import with_reference
from tests.command import ROOT

README = ROOT / "README.md"
TARGETS = [
    *("setup", "data", "train", "convert", "loihi-emulate", "loihi-hardware"),
    *("check", "benchmark", "report", "test", "lint", "clean", "help"),
]


def commands():
    """Each command's words, such as ``"check run"``, with the command."""

    def walk(command, words):
        if hasattr(command, "commands"):
            for name, below in command.commands.items():
                yield from walk(below, [*words, name])
        else:
            yield " ".join(words), command

    return dict(walk(typer.main.get_command(app), []))


def readme():
    return README.read_text(encoding="utf-8")


def options(command):
    return [o for p in command.params for o in p.opts if o.startswith("--") and o != "--help"]


@pytest.mark.parametrize("words", sorted(commands()))
def test_a_command_and_its_options_have_help(words):
    command = commands()[words]
    assert command.help
    assert command.help.strip()
    for parameter in command.params:
        assert getattr(parameter, "help", None), f"{words}: {parameter.name} has no help"


@pytest.mark.parametrize("words", sorted(commands()))
def test_a_command_is_in_the_readme(words):
    assert f"stmnist {words}" in readme()


def test_the_readmes_reference_is_the_current_one():
    text = readme()
    assert text == with_reference(text), "run: python -m pipeline.commands.reference README.md"


def test_every_option_is_in_the_readme():
    text = readme()
    every = {option for command in commands().values() for option in options(command)}
    missing = sorted(o for o in every if not re.search(re.escape(o) + r"(?![\w-])", text))
    assert not missing


def test_the_makefile_lists_its_targets():
    done = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True)
    listed = {line.split()[1]: line.split(None, 2)[2] for line in done.stdout.splitlines()}
    assert set(TARGETS) <= set(listed)
    assert all(listed.values())


def test_make_without_a_target_is_help():
    done = subprocess.run(["make"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "make loihi-emulate" in done.stdout


@pytest.mark.parametrize("target", TARGETS)
def test_a_target_of_the_makefile_calls_a_command_that_exists(target):
    done = subprocess.run(
        ["make", "-n", "-o", "setup", "-o", ".venv/installed", target, "DATA=x y.zip", "SEED=3"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    for called in re.findall(r"^\.venv/bin/stmnist (.*)$", done.stdout, re.M):
        assert any(called.startswith(words) for words in commands()), called


def test_a_wrong_python_is_one_clear_line(tmp_path):
    for name in ("Makefile", "setup.sh", "pyproject.toml", "constraints.txt"):
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    done = subprocess.run(
        ["make", "setup", "PYTHON=no-such-python"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "Python 3.11, 3.12 or 3.13 is needed" in done.stderr.splitlines()[0]
