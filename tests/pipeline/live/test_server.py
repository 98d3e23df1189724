"""Who may talk to the server, and what it says to whom; without a browser."""

import http.client
import json
import logging.handlers
import socket
import threading
import time
from contextlib import ExitStack
from urllib.parse import urlsplit

import numpy as np
import pytest

from deploy.errors import UserError
from tests.pipeline.live.conftest import Parrot, served, stroke

pytest.importorskip("uvicorn", reason="the extra 'live' is not installed")
sync_client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402

from pipeline.live import keeping  # noqa: E402
from pipeline.live.server import MAX_MESSAGE_BYTES, MAX_PAGES, listen  # noqa: E402
from tests.command import missing  # noqa: E402


def parts(server):
    url = urlsplit(server.url)
    return url.port, url.path


def get(server, path=None, **headers):
    """Status, headers and body of a request."""
    port, own = parts(server)
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=120)
    connection.request("GET", own if path is None else path, headers=headers)
    response = connection.getresponse()
    body = response.read().decode()
    connection.close()
    return response.status, dict(response.getheaders()), body


def connect(server, path=None, **options):
    port, own = parts(server)
    path = f"{own}pen" if path is None else path
    options = {"proxy": None, "max_queue": None, **options}  # a full queue would hide the end
    return sync_client.connect(f"ws://127.0.0.1:{port}{path}", **options)


def read_until(page, kind, seconds=120):
    """Messages up to the first of a kind, or of one of several."""
    kinds = (kind,) if isinstance(kind, str) else kind
    messages, end = [], time.monotonic() + seconds
    while time.monotonic() < end:
        messages.append(json.loads(page.recv(timeout=seconds)))
        if messages[-1]["type"] in kinds:
            return messages
    raise AssertionError(f"no {kinds} in {[message['type'] for message in messages]}")


def write(page, **options):
    for message in stroke(**options):
        page.send(json.dumps(message))


def test_the_page_has_the_elements_of_the_contract(server):
    status, _, body = get(server)
    assert status == 200
    for name in ("skin", "decision", "confidence", "clear", "saved"):
        assert f'id="{name}"' in body


def test_the_page_tells_browsers_what_to_heed(server):
    _, headers, _ = get(server)
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert headers["cache-control"] == "no-store"
    assert headers["referrer-policy"] == "no-referrer"


def test_the_page_s_parts_are_there(server):
    _, own = parts(server)
    for name, kind in (("main.js", "javascript"), ("page.css", "css"), ("icon.svg", "svg")):
        status, headers, _ = get(server, own + name)
        assert (status, kind in headers["content-type"]) == (200, True)


@pytest.mark.parametrize("path", ["/", "/main.js", "/wrong/", "/wrong/main.js", "/wrong/pen", "//"])
def test_without_the_token_there_is_nothing(server, path):
    status, headers, body = get(server, path)
    assert (status, "html" in headers["content-type"]) == (404, True)
    assert "token" in body


@pytest.mark.parametrize(
    "name", ["..%2fserver.py", "../server.py", "%2e%2e/server.py", "nothing.js", "pen"]
)
def test_nothing_but_the_page_is_served(server, name):
    _, own = parts(server)
    status, _, body = get(server, own + name)
    assert status == 404
    assert "uvicorn" not in body


@pytest.mark.parametrize("path", ["/pen", "/wrong/pen"])
def test_a_socket_without_the_token_is_turned_away(server, path):
    with pytest.raises(InvalidStatus) as refused, connect(server, path):
        pass
    assert refused.value.response.status_code in (403, 404)


def test_the_own_page_is_welcome_and_a_digit_is_kept(server):
    port, _ = parts(server)
    with connect(server, origin=f"http://localhost:{port}") as page:
        messages = read_until(page, "ready")
        assert messages[0]["type"] == "hello"
        assert messages[0]["data_set"] == server.keeper.data_set
        write(page)
        messages = read_until(page, "answer")
        page.send(json.dumps({"type": "label", "label": 1}))
        saved = read_until(page, "saved")[-1]
    assert (server.keeper.folder / saved["name"]).is_file()
    assert len(server.keeper) == 1


def test_a_network_that_waits_for_the_end_has_a_verdict_when_the_pen_rests(tmp_path):
    class Waits(Parrot):
        threshold = None

    messages, received = list(stroke(seconds=0.1))[:-1], 0
    later = (messages[-1]["now"] + passed_ms for passed_ms in range(5, 2000, 5))
    messages += [{"type": "pen", "now": now_ms, "points": []} for now_ms in later]
    with served(tmp_path / "kept", Waits) as server, connect(server) as page:
        read_until(page, "ready")
        for message in messages:
            page.send(json.dumps(message))
            events = read_until(page, "events")[-1]
            received += len(events["ns"])
            if events["settled"]:
                break
            while events["ns"] and read_until(page, "answer")[-1]["events"] < received:
                pass
        assert not events["ns"]  # nothing new but that there is nothing more
        assert read_until(page, "answer")[-1]["verdict"] is not None


def refused(page):
    """What the server says before it hangs up."""
    said = []
    try:
        while True:
            said.append(json.loads(page.recv(timeout=120)))
    except ConnectionClosed as closed:
        return [message["text"] for message in said if message["type"] == "problem"], closed


def is_well(server):
    with connect(server) as page:
        read_until(page, "ready")
        write(page)
        return bool(read_until(page, "answer"))


@pytest.mark.parametrize(
    "message", ["{", '{"type": "rm"}', b"\x00\x01", '{"type": "label", "label": 99}']
)
def test_a_malformed_message_is_refused_and_the_server_stays_up(server, message):
    with connect(server) as page:
        read_until(page, "ready")
        page.send(message)
        text, closed = refused(page)
    assert "refused" in text[0]
    assert closed.rcvd.code == 1008
    assert is_well(server)
    assert len(server.keeper) == 0


def test_a_message_that_is_too_large_ends_the_connection_only(server):
    with connect(server) as page:
        read_until(page, "ready")
        page.send("x" * (MAX_MESSAGE_BYTES + 1))
        _, closed = refused(page)
    assert closed.rcvd.code == 1009
    assert is_well(server)


def test_a_stroke_outside_the_skin_is_refused(server):
    with connect(server) as page:
        read_until(page, "ready")
        page.send(json.dumps({"type": "pen", "now": 0, "points": [[0, 40.0, 1.0, 0.5, 1]]}))
        text, _ = refused(page)
    assert missing(text[0], "points", "range") == []
    assert is_well(server)


def test_two_pages_write_two_recordings_that_do_not_mix(server):
    with connect(server) as one, connect(server) as other:
        for page in (one, other):
            read_until(page, "ready")
        for result, expected in zip(stroke(right=1.0), stroke(right=8.0), strict=True):
            one.send(json.dumps(result))
            other.send(json.dumps(expected))
        columns = []
        for page, digit in ((one, 1), (other, 7)):
            page.send(json.dumps({"type": "label", "label": digit}))
            told = [m for m in read_until(page, "saved") if m["type"] == "events"]
            columns.append([taxel // 10 for message in told for taxel in message["taxel"]])
    assert np.median(columns[0]) <= 2  # landing shakes taxels everywhere a little
    assert np.median(columns[1]) >= 7
    assert len(server.keeper) == 2


def test_too_many_pages_are_told_so(server):
    with ExitStack() as pages:
        for _ in range(MAX_PAGES):
            read_until(pages.enter_context(connect(server)), "hello")
        text, closed = refused(pages.enter_context(connect(server)))
    assert str(MAX_PAGES) in text[0]
    assert closed.rcvd.code == 1013
    assert is_well(server)


def test_a_page_that_goes_in_the_middle_leaves_nothing_behind(server):
    with connect(server) as page:
        read_until(page, "ready")
        for message in list(stroke())[:6]:
            page.send(json.dumps(message))
    assert is_well(server)
    assert len(server.keeper) == 0
    assert not list(server.keeper.folder.glob("[0-9]"))


def test_a_port_in_use_is_said(server):
    port, _ = parts(server)
    with pytest.raises(UserError, match=f"port {port}.*--port"):
        listen(port)


def test_a_recording_that_is_being_saved_when_the_server_ends_is_saved(tmp_path, monkeypatch):
    """The server does not wait for its page, and says nothing."""
    saving, may_end, save = threading.Event(), threading.Event(), keeping._create

    def slow(*given):
        saving.set()
        assert may_end.wait(60)
        save(*given)

    monkeypatch.setattr(keeping, "_create", slow)
    logged = logging.handlers.BufferingHandler(1000)
    with served(tmp_path / "kept") as server:
        logger = logging.getLogger("uvicorn.error")
        monkeypatch.setattr(logger, "handlers", [logged])
        with connect(server) as page:
            read_until(page, "ready")
            write(page)
            page.send(json.dumps({"type": "label", "label": 1}))
            assert saving.wait(60)
            server.should_exit = True
            server.thread.join(60)
            assert not server.thread.is_alive()
        may_end.set()
    assert [path.name for path in (tmp_path / "kept" / "1").iterdir()] == ["w001-0001.mat"]
    errors = [record for record in logged.buffer if record.levelno >= logging.ERROR]
    assert [record.getMessage() for record in errors] == []


@pytest.fixture
def shared(tmp_path):
    with served(tmp_path / "shared", host="127.0.0.2") as server:
        yield server


def test_an_address_asked_for_is_the_only_one_listened_on(shared):
    port, own = parts(shared)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port))
    address = f"ws://127.0.0.2:{port}{own}pen"
    with sync_client.connect(address, proxy=None) as page:
        assert read_until(page, "ready")[0]["shared"] is True
    with pytest.raises(InvalidStatus):
        sync_client.connect(address.replace(own, "/wrong/"), proxy=None)
