"""Who may talk to the server, and what it says to whom; without a browser."""

import base64
import http.client
import json
import logging.handlers
import socket
import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from urllib.parse import urlsplit

import numpy as np
import pytest

from deploy.errors import UserError
from tests.pipeline.live.conftest import Parrot, served, stroke

pytest.importorskip("uvicorn", reason="the extra 'live' is not installed")
sync_client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed")
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402

from pipeline.live import keeping  # noqa: E402
from pipeline.live.qr import qr_code  # noqa: E402
from pipeline.live.server import LARGEST, PAGES, listen  # noqa: E402
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


def test_the_page_and_its_parts_are_there_with_what_browsers_heed(server):
    status, headers, body = get(server)
    assert status == 200
    for name in ("skin", "decision", "confidence", "clear", "saved"):
        assert f'id="{name}"' in body
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert headers["cache-control"] == "no-store"
    assert headers["referrer-policy"] == "no-referrer"
    _, own = parts(server)
    for name, kind in (("main.js", "javascript"), ("page.css", "css"), ("icon.svg", "svg")):
        status, headers, _ = get(server, own + name)
        assert (status, kind in headers["content-type"]) == (200, True)


def test_nothing_on_the_page_comes_from_elsewhere(server):
    from pipeline.live.server import PAGE

    for file in PAGE.iterdir():
        text = file.read_text("utf-8").replace("http://www.w3.org/2000/svg", "")
        assert "http:" not in text, file
        assert "https:" not in text, file
        assert "<script>" not in text, file
        assert 'style="' not in text, file


@pytest.mark.parametrize("path", ["/", "/main.js", "/wrong/", "/wrong/main.js", "/wrong/pen", "//"])
def test_without_the_token_there_is_nothing(server, path):
    status, _, body = get(server, path)
    assert status == 404
    assert "token" in body


@pytest.mark.parametrize(
    "name", ["..%2fserver.py", "../server.py", "%2e%2e/server.py", "nothing.js", "pen"]
)
def test_nothing_but_the_page_is_served(server, name):
    _, own = parts(server)
    status, _, body = get(server, own + name)
    assert status == 404
    assert "uvicorn" not in body


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", ""]
)
def test_other_hosts_are_turned_away(server, host):
    port, _ = parts(server)
    status, _, body = get(server, Host=host.format(port=port))
    assert status in (400, 403)
    assert 'id="skin"' not in body


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "https://127.0.0.1:{port}", "http://127.0.0.1:1"]
)
def test_other_origins_are_turned_away(server, origin):
    port, _ = parts(server)
    origin = origin.format(port=port)
    assert get(server, Origin=origin)[0] == 403
    with pytest.raises(InvalidStatus) as refused, connect(server, origin=origin):
        pass
    assert refused.value.response.status_code == 403


def test_a_socket_of_another_host_is_turned_away(server):
    port, _ = parts(server)
    raw = socket.create_connection(("127.0.0.1", port))
    url = f"ws://evil.example:{port}{parts(server)[1]}pen"
    with pytest.raises(InvalidStatus) as refused, sync_client.connect(url, sock=raw, proxy=None):
        pass
    assert refused.value.response.status_code == 403


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
        page.send("x" * (LARGEST + 1))
        _, closed = refused(page)
    assert closed.rcvd.code == 1009
    assert is_well(server)


def test_a_stroke_outside_the_skin_is_refused(server):
    with connect(server) as page:
        read_until(page, "ready")
        page.send(json.dumps({"type": "pen", "now": 0, "points": [[0, 40.0, 1.0, 0.5, 1]]}))
        text, _ = refused(page)
    assert missing(text[0], "points", "skin") == []
    assert is_well(server)


def test_a_page_does_not_wait_for_the_disk_of_another(server, monkeypatch):
    written, save = threading.Event(), server.keeper.save

    def slow(*given):
        assert written.wait(60)
        return save(*given)

    monkeypatch.setattr(server.keeper, "save", slow)
    with connect(server) as one, connect(server) as other:
        for page in (one, other):
            read_until(page, "ready")
        write(one)
        one.send(json.dumps({"type": "label", "label": 1}))
        write(other)
        read_until(other, "answer")
        written.set()
        assert read_until(one, "saved")


def test_two_pages_write_two_recordings_that_do_not_mix(server):
    with connect(server) as one, connect(server) as other:
        for page in (one, other):
            read_until(page, "ready")
        for mine, theirs in zip(stroke(right=1.0), stroke(right=8.0), strict=True):
            one.send(json.dumps(mine))
            other.send(json.dumps(theirs))
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
        for _ in range(PAGES):
            read_until(pages.enter_context(connect(server)), "hello")
        text, closed = refused(pages.enter_context(connect(server)))
    assert str(PAGES) in text[0]
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


def test_an_answer_that_fails_is_said_and_the_next_one_comes(tmp_path):
    class Hoarse(Parrot):
        failures = 1

        def answer(self, events, time_s):
            if self.failures:
                self.failures -= 1
                raise RuntimeError("a frog in the throat")
            return super().answer(events, time_s)

    with served(tmp_path / "kept", Hoarse) as server, connect(server) as page:
        read_until(page, "ready")
        write(page)
        assert "a frog" in read_until(page, "problem")[-1]["text"]
        write(page, start_ms=9000.0)
        assert read_until(page, "answer")


class Loud(Parrot):
    """Its spikes have the number of events in every byte."""

    def answer(self, events, time_s):
        spikes = {"input": np.full((3, 13), len(events) % 256, np.uint8)}
        return replace(super().answer(events, time_s), spikes=spikes)


def test_spikes_come_less_often_than_answers(tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.live.server.SPIKES_APART_S", 3600.0)
    with served(tmp_path / "kept", Loud) as server, connect(server) as page:
        read_until(page, "ready")
        told = []
        for message in stroke():
            page.send(json.dumps(message))
            told += read_until(page, "events")
            if told[-1]["ns"]:
                told += read_until(page, "answer")
        kinds = [message["type"] for message in told]
        assert kinds.count("answer") > 5
        assert kinds.count("spikes") == 1


def test_the_last_spikes_are_those_of_the_last_answer(tmp_path):
    with served(tmp_path / "kept", Loud) as server, connect(server) as page:
        read_until(page, "ready")
        write(page)
        page.send(json.dumps({"type": "label", "label": 1}))
        n, told = None, []
        while n is None or told[-1] != n % 256:
            message = read_until(page, ("saved", "spikes"))[-1]
            if message["type"] == "saved":
                n = message["events"]
            else:
                told.append(base64.b64decode(message["layers"]["input"])[0])
        assert told == sorted(told)


def test_a_network_that_cannot_be_made_ready_is_said_on_the_page(tmp_path):
    def broken():
        raise UserError("the bundle has no readout")

    with served(tmp_path / "kept", broken) as server, connect(server) as page:
        assert "no readout" in read_until(page, "problem")[-1]["text"]


def test_odd_requests_are_refused_without_a_word_on_the_terminal(server, monkeypatch):
    port, own = parts(server)
    logged = logging.handlers.BufferingHandler(1000)  # the terminal's is older than this test
    monkeypatch.setattr(logging.getLogger("uvicorn.error"), "handlers", [logged])
    for name in ("x" * 300, "%ff", "%00", "a/../index.html"):
        assert get(server, own + name)[0] == 404
    with socket.create_connection(("127.0.0.1", port), timeout=120) as raw:
        raw.send(
            f"GET {own}pen HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\n"
            "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n".encode()
        )
        assert b"101" in raw.recv(4096)
        raw.send(b"\x81\x82\0\0\0\0\xff\xfe")  # a frame of text that is not UTF-8
        while raw.recv(4096):
            pass
    assert is_well(server)
    assert [record.getMessage() for record in logged.buffer] == []


def test_a_recording_that_is_being_saved_when_the_server_ends_is_saved(tmp_path, monkeypatch):
    """The server does not wait for its page, and says nothing; what comes later is refused."""
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
    assert not (tmp_path / "kept" / ".lock").exists()
    errors = [record for record in logged.buffer if record.levelno >= logging.ERROR]
    assert [record.getMessage() for record in errors] == []
    with pytest.raises(UserError, match="nothing is saved"):
        server.keeper.save(1, None)


@pytest.fixture
def shared(tmp_path):
    with served(tmp_path / "shared", host="127.0.0.2") as server:
        yield server


def ask_of(shared, host, origin=None, name=""):
    """Status and body of a request to the shared address, under the name of a host."""
    port, own = parts(shared)
    connection = http.client.HTTPConnection("127.0.0.2", port, timeout=120)
    headers = {"Host": host.format(port=port)}
    if origin is not None:
        headers["Origin"] = origin.format(port=port)
    connection.request("GET", own + name, headers=headers)
    response = connection.getresponse()
    body = response.read()
    connection.close()
    return response.status, body


def test_an_address_asked_for_is_the_only_one_answered_to(shared):
    here = "127.0.0.2:{port}"
    assert ask_of(shared, here)[0] == 200
    assert ask_of(shared, here, f"http://{here}")[0] == 200
    for other in (
        "127.0.0.1:{port}",
        "localhost:{port}",
        "127.0.0.2",
        "127.0.0.2:1",
        "0.0.0.0:{port}",
    ):
        assert ask_of(shared, other)[0] == 403
        assert ask_of(shared, here, f"http://{other}")[0] == 403
    port, own = parts(shared)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port))
    address = f"ws://127.0.0.2:{port}{own}pen"
    with sync_client.connect(address, proxy=None) as page:
        assert read_until(page, "ready")[0]["shared"] is True
    with pytest.raises(InvalidStatus):
        sync_client.connect(address.replace(own, "/wrong/"), proxy=None)


def test_the_qr_code_is_of_the_whole_address_and_behind_the_token(shared, server):
    status, picture = ask_of(shared, "127.0.0.2:{port}", name="qr.svg")
    assert status == 200
    assert picture == qr_code(shared.url).svg
    assert picture != qr_code(shared.url[:-2]).svg
    assert shared.url.startswith("http://127.0.0.2:")
    assert get(server, parts(server)[1] + "qr.svg")[0] == 404  # to itself the page needs none
    text = qr_code(shared.url).text
    assert max(map(len, text.splitlines())) <= 80
    assert set(text) <= set(" ▀▄█\n")


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "", "203.0.113.7", "no such host", "x" * 300])
def test_an_address_that_cannot_be_served_is_said(host):
    with pytest.raises(UserError, match="--host"):
        listen(0, host)


def test_examples_that_cannot_be_read_are_said_and_the_rest_works(tmp_path):
    def tests():
        raise UserError("own: has changed since the network was trained")
        yield

    with served(tmp_path / "kept", tests=tests()) as server, connect(server) as page:
        said = read_until(page, "examples")[-1]
        assert "has changed" in said["reason"]
        assert sum(said["test"]) == 0
        write(page)
        assert read_until(page, "answer")
