"""``stmnist live`` as a process: its start, its end, and what survives."""

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys

import pytest

from deploy.check.bundle import read_bundle
from pipeline.live.network import SHIPPED
from pipeline.recordings.files.reading import read_source
from tests.command import call, environment
from tests.pipeline.live.conftest import stroke

pytest.importorskip("uvicorn", reason="the extra 'live' is not installed")
pytest.importorskip("segno", reason="the extra 'live' is not installed")
sync_client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")


def address(process):
    line = process.stdout.readline()
    assert line.startswith("live: http://127.0.0.1:"), line + process.stderr.read()
    return line.split()[1]


def socket_of(url):
    return sync_client.connect(url.replace("http", "ws") + "pen", proxy=None)


def messages_of(page):
    return iter(lambda: json.loads(page.recv(timeout=300)), None)


def write_and_label(page, digit):
    """Write a line, say what it was, and return the answer to that."""
    messages = messages_of(page)
    next(message for message in messages if message["type"] == "ready")
    for message in stroke():
        page.send(json.dumps(message))
    page.send(json.dumps({"type": "label", "label": digit}))
    return next(message for message in messages if message["type"] in ("saved", "problem"))


@pytest.fixture
def live(tmp_path):
    """Starts the command in a group of its own, which Ctrl-C reaches from a background too."""
    processes = []

    def begin(run):
        kept = tmp_path / "kept"
        named = () if run is None else (run,)
        arguments = ("live", *named, "--port", 0, "--no-browser", "--record", kept)
        process = subprocess.Popen(
            [sys.executable, "-m", "pipeline", *map(str, arguments)],
            env=environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        processes.append(process)
        return process, kept

    yield begin
    for process in processes:
        with contextlib.suppress(ProcessLookupError):  # nor may any that it started be left
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def test_ctrl_c_ends_it_cleanly_and_what_was_kept_works_as_data(live, tmp_path, capsys):
    """Without a run: the network is that of the package."""
    process, kept = live(None)
    with socket_of(address(process)) as page:
        hello = next(message for message in messages_of(page) if message["type"] == "hello")
        assert hello["architecture"] == read_bundle(SHIPPED).spec.architecture
        assert write_and_label(page, 4)["type"] == "saved"
        os.kill(process.pid, signal.SIGINT)
        _, error = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "Traceback" not in error
    assert re.search(rf"\b1 recording.* {kept}", error)
    recordings = read_source(kept, jobs=1)
    assert recordings.labels.tolist() == [4]
    assert recordings.source.written
    capsys.readouterr()
    assert call("data", "import", kept, "--json", "--jobs", 1) == 0
    assert json.loads(capsys.readouterr().out)["written"] is True
    assert call("data", "inspect", next(kept.glob("4/*.mat")), "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["source"], facts["simulated"], facts["writer"]) == ("written", True, 1)


def test_a_killed_server_has_lost_nothing(live, tiny_run, tmp_path, capsys):
    """Its folder is free for another, of a bundle copied from elsewhere, but not for two."""
    process, kept = live(tiny_run)
    with socket_of(address(process)) as page:
        name = write_and_label(page, 4)["name"]
        os.killpg(process.pid, signal.SIGKILL)
        process.wait(300)
    assert read_source(kept, jobs=1).ids == (name.removesuffix(".mat"),)
    shutil.copytree(tiny_run / "bundle", tmp_path / "elsewhere")
    again, _ = live(tmp_path / "elsewhere")
    with socket_of(address(again)) as page:
        assert write_and_label(page, 5)["name"] == "5/w001-0002.mat"
        assert call("live", tiny_run, "--port", 0, "--record", kept, "--no-browser") == 2
    assert "--record" in capsys.readouterr().err


def test_a_run_that_does_not_exist_is_one_line(tmp_path, capsys):
    assert call("live", tmp_path / "none", "--port", 0, "--no-browser") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "does not exist; give the folder of a run" in line
    assert not (tmp_path / "none").exists()


def test_a_port_in_use_is_one_line(tiny_run, tmp_path, capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        status = call("live", tiny_run, "--port", port, "--record", tmp_path / "k", "--no-browser")
    assert status == 2
    error = capsys.readouterr().err
    assert f"port {port}" in error
    assert "--port" in error


def test_without_the_extra_it_says_what_to_install(tmp_path):
    code = (
        "import sys\n"
        "class Barred:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in ('uvicorn', 'starlette'):\n"
        "            raise ImportError('barred', name=name)\n"
        "sys.meta_path.insert(0, Barred())\n"
        "from pipeline.commands.main import main\n"
        "main(['live', 'nowhere'])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert "live" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "written").exists()
