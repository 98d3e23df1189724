"""The command's end: its exit status, whoever reads what it prints."""

import errno
import os
import subprocess
import sys

import pytest

from tests.command import environment


def run(*arguments, stdout):
    return subprocess.run(
        [sys.executable, "-m", "pipeline", *map(str, arguments)],
        stdout=stdout,
        stderr=subprocess.PIPE,
        env=environment(PYTHONUNBUFFERED=""),
        text=True,
        timeout=300,
    )


@pytest.fixture
def unread():
    """A pipe whose reader has gone."""
    reader, writer = os.pipe()
    os.close(reader)
    yield writer
    os.close(writer)


@pytest.mark.parametrize(
    "arguments",
    [("settings", "--json"), ("--help",), ("--version",)],
    ids=["a verb", "typer", "less than a buffer"],
)
def test_a_reader_that_has_seen_enough_is_no_error(unread, arguments):
    done = run(*arguments, stdout=unread)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_a_full_disk_is_one_line():
    with open("/dev/full", "w") as full:
        done = run("settings", "--json", stdout=full)
    assert done.returncode == 2
    assert done.stderr.startswith(f"stmnist: {os.strerror(errno.ENOSPC)}")
    assert done.stderr.count("\n") == 1
