"""examples/stream.py: events as JSON lines in, decisions as JSON lines out."""

import io
import json
import re
import runpy
import signal
import socket
import subprocess
import sys

import pytest

from deploy.check.bundle import write_bundle
from pipeline.recordings.recordings import Recordings
from tests.command import ROOT, environment, process_of, without_processes
from tests.deploy.stream.test_stream import STEP_US, events_of, make_bundle, replay

COMMAND = ("-m", "examples.stream")


@pytest.fixture
def call_example(monkeypatch, capsys, caplog):
    """Run the example in this process; returns its status, what it printed, and what it told."""

    def call(*arguments, given=""):
        monkeypatch.setattr(sys, "argv", ["stream.py", *map(str, arguments)])
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(given.encode())))
        status = 0
        capsys.readouterr()
        try:
            runpy.run_module("examples.stream", run_name="__main__")
        except SystemExit as end:
            status = end.code
        out, err = capsys.readouterr()
        return status, out, err + caplog.text  # logged warnings are on standard error elsewhere

    return call


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    made = make_bundle()
    return write_bundle(tmp_path_factory.mktemp("example") / "bundle", made.spec, made.checks)


@pytest.fixture(scope="module")
def expected(bundle):
    from deploy.stream.stream import Stream

    return [decision.number for decision in replay(Stream(bundle, "us"), bundle.checks.inputs)]


def lines_of(bundle):
    """A line for each event: objects, lists and a list of events by turns."""
    lines, start_us = [], 5_000_000
    for index, sample in enumerate(bundle.checks.inputs):
        columns = [column.astype(int).tolist() for column in events_of(sample, start_us)]
        rows = [list(row) for row in zip(*columns, strict=True)]
        if index % 3 == 0:
            lines += [dict(zip("txyp", row, strict=True)) for row in rows]
        elif index % 3 == 1:
            lines += rows
        else:
            lines.append(rows)
        start_us += len(sample) * STEP_US + 700_000
    return [json.dumps(line) for line in lines]


def decisions_of(printed):
    return [json.loads(line)["number"] for line in printed.splitlines()]


def test_events_from_standard_input_and_lines_that_are_none(bundle, expected, call_example):
    first, *others = lines_of(bundle)
    # A malformed event in a list leaves the others as they are.
    huge = f"[{'9' * 400}, 1, 1, 1]"
    first = f'[{first}, {{"t": 1}}, [1, [2], 3, 4], [1, 2, 3], ["4"], {huge}]'
    lines = ["not JSON", "[]", "", '{"t": 1}', first, *others, "[9e9, 99, 0, 1]", "7"]
    status, out, err = call_example(bundle.path, "--unit", "us", given="\n".join(lines))
    assert status == 0
    assert decisions_of(out) == expected
    assert _count_faults(err, "without numbers for time and place") == 8
    assert "1 outside the sensor" in err


def _count_faults(told, fault):
    return sum(int(number) for number in re.findall(rf"(\d+) {fault}", told))


def test_recordings_are_played_and_named(bundle, tmp_path, call_example):
    events = [events_of(sample, 0) for sample in bundle.checks.inputs]
    arrays = [{"x": x, "y": y, "t": t, "p": p} for t, x, y, p in events]
    labels = [index % 3 for index in range(len(arrays))]
    recordings = Recordings.from_arrays(arrays, labels, time_unit="us")
    path = recordings.write(tmp_path / "played.zip")
    with without_processes():
        status, out, _ = call_example(bundle.path, "--replay", path, "--speed", "0")
        ids = Recordings.read(path).ids
    assert status == 0
    said = [json.loads(line) for line in out.splitlines()]
    assert [each["recording"] for each in said] == list(ids)
    assert said[0]["start"] == 0
    assert said[-1]["time"] < 10 * len(said)  # seconds, as the unit of the command


def test_a_port_or_unit_that_is_none_is_said(bundle, call_example):
    for wrong in (["--udp", "99999"], ["--unit", "h"]):
        status, _, err = call_example(bundle.path, *wrong)
        assert status == 2
        assert wrong[0] in err


def test_events_from_a_port_are_decided_on_by_the_clock_of_this_machine(bundle):
    with process_of(
        *(*COMMAND, bundle.path, "--unit", "us", "--udp", "0"),
        cwd=ROOT,
        env=environment(),
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        lines = iter(process.stderr.readline, "")
        heard = next(line for line in lines if "listening" in line)
        port = int(heard.split("127.0.0.1:")[1].split(";")[0])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
            sending.sendto(b'[0, 1, 1, 1]\n{"t": 30, "x": 2, "y": 1, "p": 0}', ("127.0.0.1", port))
            # Times that no clock has do not stop the clock of the silence.
            sending.sendto(b"[NaN, 1, 1, 1]\n[1e300, 1, 1, 1]\nno event", ("127.0.0.1", port))
            decision = json.loads(process.stdout.readline())  # silence by the clock
        process.send_signal(signal.SIGINT)
        _, said = process.communicate()
    assert decision["events"] == 2
    assert _count_faults(said, "without numbers for time and place") == 3
    assert "Warning" not in said
    assert process.returncode == 0


def test_a_reader_that_ends_ends_the_example_quietly(bundle):
    with subprocess.Popen(
        [sys.executable, *COMMAND, str(bundle.path), "--unit", "us"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=ROOT,
        env=environment(),
        text=True,
    ) as process:
        process.stdout.close()
        process.stdin.write("\n".join(lines_of(bundle)))
        process.stdin.close()
        errors = process.stderr.read()
    assert "Traceback" not in errors


def test_a_missing_bundle_is_said_in_one_line(tmp_path, call_example):
    status, _, err = call_example(tmp_path)
    assert status == 2
    assert "not a bundle" in err
    assert err.count("\n") == 1
