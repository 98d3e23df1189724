"""Programs that hold, flood or abuse the connections of ``stmnist live``, and damaged files of a
writer in the folder of its recordings."""

import contextlib
import json
import os
import resource
import signal
import socket
import struct
import subprocess
import sys
import time
import zipfile
from urllib.parse import urlsplit

import numpy as np

from deploy.check.bundle import read_bundle

from ..command import ROOT
from . import damage

FILES = 256
"""Files that the server may have open."""

PATIENCE = 5.0
"""Seconds within which the page must be there, and a stroke be answered, on an idle machine."""

WRITER = 7
"""Who writes on the page."""

SHARE = 0.6
"""Largest share of a core that the server may use after the attacks."""


def attacked(rng, folder, base):
    """Serve a finished run, attack the server in some ways, and look whether the page works.

    Returns
    -------
    list of str
        What was wrong.
    """
    folder.mkdir(parents=True)
    if rng.random() < 0.5:
        _keep_damaged(rng, folder / "written", base)
    with _served(folder, base) as (server, url):
        port, path = urlsplit(url).port, urlsplit(url).path
        held, findings = [], []
        try:
            with _page(port, path) as page:
                # Each once: those with the token together leave room for two of the eight pages.
                order = rng.permutation(len(ATTACKS))[: int(rng.integers(1, 4))]
                chosen = [ATTACKS[index] for index in order]
                for attack in chosen:
                    held += attack(rng, port, path)
                patience = PATIENCE * _slowness()
                begun, used = time.monotonic(), _cpu(server)
                _get(port, path, patience)
                page.send(json.dumps({"type": "writer", "number": WRITER, "each": 0}))
                _until(page, "writer", patience)
                _until(page, "learned", 10 * patience, writer=WRITER)
                _page(port, path, patience).close()
                time.sleep(2)
                share = (_cpu(server) - used) / (time.monotonic() - begun)
                if share > SHARE and labelling not in chosen:  # what was saved is still learned
                    findings.append(f"takes {share:.0%} of a core")
        except (OSError, TimeoutError, AssertionError, ValueError) as error:
            findings.append(f"the page does not work: {type(error).__name__}: {error}")
        except Exception as error:  # those of websockets
            findings.append(f"the page was cut off: {type(error).__name__}: {error}")
        finally:
            for connection in held:
                with contextlib.suppress(Exception):
                    connection.close()
        server.send_signal(signal.SIGINT)
        try:
            status = server.wait(30)
        except subprocess.TimeoutExpired:
            return [*findings, "does not end after Ctrl-C"]
    err = (folder / ".err").read_text(errors="replace")
    if status != 130:
        findings.append(f"status {status} after Ctrl-C")
    if "Traceback" in err:
        findings.append(
            f"{err.count('Traceback')} tracebacks: {err.strip().splitlines()[-1][:200]}"
        )
    if len(err) > 5000:
        findings.append(f"{len(err)} characters on standard error")
    return findings


def _keep_damaged(rng, folder, base):
    """What is kept of a writer's handwriting, damaged, or a pipe or link in its place."""
    bundle = read_bundle(base / "run" / "bundle")
    path = folder / f".readout-w{WRITER:03d}-{bundle.id[:12]}.npz"
    weights, n = bundle.spec.layers[-1].weights, 5
    given = {
        "bundle": np.array(bundle.id),
        "names": np.array([f"3/w007-{index:04d}.mat" for index in range(n)]),
        "labels": rng.integers(0, 10, n),
        "right": rng.random(n) < 0.5,
        "responses": rng.random((n, 11, weights.shape[1])).astype(np.float32),
        "weights": weights,
    }
    folder.mkdir(parents=True)
    way = rng.random()
    if way < 0.1:
        os.mkfifo(path)
    elif way < 0.2:
        path.symlink_to("/dev/zero")
    else:
        with zipfile.ZipFile(path, "w") as archive:
            for key, array in damage.arrays(rng, given).items():
                with archive.open(key + ".npy", "w") as stream:
                    np.lib.format.write_array(stream, np.asarray(array), allow_pickle=True)
        if way < 0.4:
            path.write_bytes(damage.some_bytes(rng, path.read_bytes()))


@contextlib.contextmanager
def _served(folder, base):
    """The server as a process with few files, and the address that it prints."""
    with open(folder / ".err", "w") as err:
        server = subprocess.Popen(
            [sys.executable, "-m", "pipeline", "live", str(base / "run"), "--port", "0",
             "--no-browser", "--record", str(folder / "written")],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(ROOT), "STMNIST_CACHE": str(base / "cache")},
            stdout=subprocess.PIPE,
            stderr=err,
            text=True,
            start_new_session=True,
            preexec_fn=_limited,
        )  # fmt: skip
    try:
        line = server.stdout.readline().split()
        assert line, "the server did not start: " + (folder / ".err").read_text()[-300:]
        yield server, line[1]
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(server.pid, signal.SIGKILL)
        server.wait()
        server.stdout.close()


def _limited():
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_NOFILE, (FILES, FILES))


def _cpu(server):
    """Seconds of processor time that a process has taken."""
    with open(f"/proc/{server.pid}/stat") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _slowness():
    """How much longer than alone a program takes now, because others use the machine too."""
    begun, used = time.monotonic(), time.process_time()
    while time.process_time() - used < 0.2:
        pass
    return max(1.0, (time.monotonic() - begun) / 0.2)


def _get(port, path, patience):
    with socket.create_connection(("127.0.0.1", port), timeout=patience) as page:
        page.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
        assert page.recv(4096).startswith(b"HTTP/1.1 200"), "the page is not served"


def _until(page, kind, seconds, **values):
    """Read messages up to one of a kind with some values."""
    wanted, end = {"type": kind, **values}, time.monotonic() + seconds
    while time.monotonic() < end:
        message = json.loads(page.recv(timeout=max(end - time.monotonic(), 0.01)))
        if wanted.items() <= message.items():
            return
        if message["type"] == "problem":
            raise ValueError(message["text"])
    raise TimeoutError(f"no {kind} in {seconds:g} s")


def _connections(port, n):
    made = []
    for _ in range(n):
        with contextlib.suppress(OSError):
            made.append(socket.create_connection(("127.0.0.1", port), timeout=PATIENCE))
    return made


def silent(rng, port, path):
    """Connections that say nothing, more than there are files."""
    return _connections(port, int(rng.integers(50, 2 * FILES)))


def slow(rng, port, path):
    """Requests that never come to an end."""
    made = _connections(port, int(rng.integers(10, FILES)))
    for connection in made:
        with contextlib.suppress(OSError):
            connection.send(b"GET /x HTTP/1.1\r\nHost: 127.0.0.1"[: int(rng.integers(1, 30))])
    return made


def garbage(rng, port, path):
    """What is no request, and requests of other things than the page."""
    made = _connections(port, 20)
    for connection in made:
        words = [
            rng.bytes(int(rng.integers(1, 2000))),
            f"GET {path}{'x' * 300} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode(),
            f"GET {path}%ff%00 HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode(),
            f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Length: 9\r\n\r\n".encode(),
        ]
        with contextlib.suppress(OSError):
            connection.send(words[int(rng.integers(0, len(words)))])
    return made


def frames(rng, port, path):
    """A page that sends frames of random bytes."""
    made = _connections(port, 2)
    for connection in made:
        with contextlib.suppress(OSError):
            connection.send(
                f"GET {path}pen HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\n"
                "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
                "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n".encode()
            )
            content = rng.bytes(int(rng.integers(0, 120)))
            connection.send(b"\x81" + bytes([0x80 | len(content)]) + bytes(4) + content)
    return made


def _page(port, path, patience=120.0, **options):
    """A page that is ready; the place of one that is gone may have to become free first."""
    from websockets.sync.client import connect

    end, address = time.monotonic() + patience, f"ws://127.0.0.1:{port}{path}pen"
    while True:
        page = connect(address, proxy=None, open_timeout=patience, ping_interval=None, **options)
        try:
            _until(page, "ready", patience)
            return page
        except ValueError:
            page.close()
            if time.monotonic() > end:
                raise
        time.sleep(0.1)


def leaping(rng, port, path):
    """Pages that do not read, and whose clocks leap with every message."""
    made, step = [], float(rng.choice([30.0, 3000.0, 30_000.0]))
    for _ in range(2):
        page = _page(port, path, max_queue=1)
        made.append(page)
        for n in range(60):
            t = step * (n + 1)
            points = [[t, 4.0, 4.0, 0.5, 1], [t + step / 2, 4.0, 5.0, 0.5, 1]]
            if n % 2:
                points.append([t + step / 2 + 1, 4.0, 5.0, 0.5, 0])
            message = json.dumps({"type": "pen", "now": t + step * 0.9, "points": points})
            with contextlib.suppress(Exception):
                page.send(message)
    return made


def labelling(rng, port, path):
    """A page that saves one recording after another, and does not read."""
    page = _page(port, path, max_queue=1)
    for n in range(int(rng.integers(20, 400))):
        t = 3000.0 * (n + 1)
        points = [[t, 4.0, 1.0, 0.5, 1], [t + 50, 4.0, 6.0, 0.5, 1], [t + 100, 4.0, 6.0, 0.5, 0]]
        with contextlib.suppress(Exception):
            page.send(json.dumps({"type": "pen", "now": t + 100, "points": points}))
            page.send(json.dumps({"type": "label", "label": int(rng.integers(0, 10))}))
    return [page]


def rejoining(rng, port, path):
    """A page that leaps and is gone without a word, again and again."""
    points = [[1000.0, 4.0, 4.0, 0.5, 1], [11_000.0, 4.0, 5.0, 0.5, 1]]
    leap = json.dumps({"type": "pen", "now": 12_000.0, "points": points})
    for _ in range(int(rng.integers(10, 60))):
        page = _page(port, path)
        for _ in range(50):
            page.send(leap)
        page.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        page.socket.close()
    return []


ATTACKS = (silent, slow, garbage, frames, leaping, labelling, rejoining)
