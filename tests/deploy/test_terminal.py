"""What is printed: escaped, in any encoding, to streams that may be closed or full."""

import ast
import io
import os
import subprocess
import sys

import pytest

from deploy.files import read_json, write_json
from deploy.tables import aligned
from deploy.terminal import printable, remark, show
from tests.command import ROOT, call, environment
from tests.pipeline.handmade import archive, good_members

OBEYED = "\x1b[2J\x1b]0;mine\x07\u202e\r\nx"


def test_what_a_terminal_would_obey_is_escaped(capsys):
    assert printable("é\u4e2d a\x1b[2J\n") == "é\u4e2d a\\x1b[2J\\n"
    show(f"one {OBEYED[:4]}\ntwo")
    remark("three \x07")
    assert capsys.readouterr() == ("one \\x1b[2J\ntwo\n", "three \\x07\n")
    assert aligned([["name", "n"], ["a\nb\x1b", "1"]]) == ["name      n", "a\\nb\\x1b  1"]


def controls(text):
    """Characters that a terminal obeys, but for the ends of lines."""
    return [c for c in text if not c.isprintable() and c != "\n"]


@pytest.mark.parametrize("as_json", [[], ["--json"]])
def test_class_names_and_sources(tmp_path, capsys, as_json):
    members = {
        name.replace("data_submission/3/", f"data_submission/{OBEYED}/"): content
        for name, content in good_members(2).items()
    }
    path = tmp_path / "st\x1b[2J.zip"
    archive(path, members)
    for verb in (["import", path], ["stats", "--data", path]):
        assert call("data", *verb, "--jobs", 1, *as_json) == 0
    out, err = capsys.readouterr()
    assert controls(out + err) == []
    assert "mine" in out


def test_targets_and_names_of_runs(tiny_run, tmp_path, capsys):
    import shutil

    runs = [shutil.copytree(tiny_run, tmp_path / name) for name in ("a\x1b[2J", "b")]
    for name in ("nengo", "fast"):
        path = runs[0] / "checks" / f"{name}.json"
        write_json(path, {**read_json(runs[0] / "checks" / "nengo.json", ""), "target": OBEYED})
    pair = [runs[0] / "checks" / f"{name}.json" for name in ("nengo", "emulator")]
    assert call("check", "compare", *pair) == 0
    assert call("compare", *runs) == 0
    assert call("report", runs[0]) == 2
    out, err = capsys.readouterr()
    assert controls(out + err) == []
    assert "checks/nengo.json: " in err


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


def test_nothing_is_printed_past_the_escaping():
    """A name from a file could come with it."""
    found = [
        path.relative_to(ROOT).as_posix()
        for package in ("deploy", "models", "pipeline")
        for path in sorted((ROOT / package).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and getattr(node.func, "id", None) == "print"
    ]
    assert set(found) == {"deploy/terminal.py", "deploy/cli.py"}


class Terminal(io.StringIO):
    """A stream that says that it is a terminal."""

    def isatty(self):
        return True


LINES = {
    "stmnist: own/: no such file": 31,
    "does not fit: layer dense1": 31,
    "warning: 3 recordings have no events": 33,
    "rate-lif: warning: conv1: 60.0% silent": 33,
    "emulator  0.700  0.600 to 0.800  -0.100  20  0.002  *": 1,
    "nengo     0.800  0.700 to 0.900  +0.000   0  1.000": None,
}


def terminals(monkeypatch):
    """Standard output and error that are terminals; from within a test, which pytest captures."""
    for name in ("NO_COLOR", "TERM"):
        monkeypatch.delenv(name, raising=False)
    streams = Terminal(), Terminal()
    monkeypatch.setattr(sys, "stdout", streams[0])
    monkeypatch.setattr(sys, "stderr", streams[1])
    return streams


def test_errors_warnings_and_significant_differences_have_colours(monkeypatch):
    streams = terminals(monkeypatch)
    for line, code in LINES.items():
        expected = line if code is None else f"\x1b[{code}m{line}\x1b[0m"
        for print_, stream in zip((show, remark), streams, strict=True):
            stream.truncate(0), stream.seek(0)
            print_(line)
            assert stream.getvalue() == expected + "\n"


@pytest.mark.parametrize(("name", "value"), [("NO_COLOR", "1"), ("TERM", "dumb")])
def test_colours_can_be_switched_off(monkeypatch, name, value):
    _, error = terminals(monkeypatch)
    monkeypatch.setenv(name, value)
    remark("\n".join(LINES))
    assert error.getvalue() == "\n".join(LINES) + "\n"


def test_no_colours_in_a_file_and_none_from_a_name(monkeypatch):
    _, error = terminals(monkeypatch)
    remark("warning: \x1b[32mgreen")
    assert error.getvalue() == "\x1b[33mwarning: \\x1b[32mgreen\x1b[0m\n"
    result = subprocess.run(
        [sys.executable, "-m", "pipeline", "data", "inspect", "nowhere.mat"],
        cwd=ROOT, env=environment(), capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert result.returncode == 2
    assert "\x1b" not in result.stderr
