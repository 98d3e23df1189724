"""What is printed: escaped, in any encoding, to streams that may be closed or full."""

import os
import subprocess
import sys

from deploy.tables import align_rows
from deploy.terminal import escape_control, remark, show
from tests.command import ROOT, environment
from tests.pipeline.handmade import archive, good_members

OBEYED = "\x1b[2J\x1b]0;mine\x07\u202e\r\nx"


def test_what_a_terminal_would_obey_is_escaped(capsys):
    assert escape_control("é\u4e2d a\x1b[2J\n") == "é\u4e2d a\\x1b[2J\\n"
    show(f"one {OBEYED[:4]}\ntwo")
    remark("three \x07")
    assert capsys.readouterr() == ("one \\x1b[2J\ntwo\n", "three \\x07\n")
    assert align_rows([["name", "n"], ["a\nb\x1b", "1"]]) == ["name      n", "a\\nb\\x1b  1"]


def run(*arguments, closed=(), **options):
    """The command as a process, with standard streams closed from its start."""

    def close():
        for number in closed:
            os.close(number)

    return subprocess.run(
        [sys.executable, "-m", "pipeline", *map(str, arguments)],
        cwd=ROOT,
        preexec_fn=close,
        timeout=300,
        check=False,
        **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "env": environment(), **options},
    )


def test_names_that_the_terminal_cannot_write(tmp_path):
    members = {
        name.replace("data_submission/3/", "data_submission/\u4e2d\u6587/"): content
        for name, content in good_members(2).items()
    }
    archive(tmp_path / "st.zip", members)
    plain = environment(
        PYTHONIOENCODING="ascii", STMNIST_CACHE=str(tmp_path / "cache"), PYTHONUTF8="0"
    )
    done = run("data", "import", tmp_path / "st.zip", "--jobs", 1, env=plain)
    assert (done.returncode, done.stderr) == (0, b"")
    assert rb"\u4e2d\u6587 2" in done.stdout
    done = run("data", "import", tmp_path / "\u4e2d\u6587.zip", env=plain)
    assert done.returncode == 2
    assert rb"\u4e2d\u6587.zip: " in done.stderr


LINES = {
    "stmnist: own/: no such file": 31,
    "does not fit: layer dense1": 31,
    "warning: 3 recordings have no events": 33,
    "rate-lif: warning: conv1: 60.0% silent": 33,
    "emulator  0.700  0.600 to 0.800  -0.100  20  0.002  *": 1,
    "nengo     0.800  0.700 to 0.900  +0.000   0  1.000": None,
}
