"""The web server of the page and its messages, on this machine only or on a given address.

Every address starts with a token that is drawn at each start, so that neither another user of the
machine nor a page of another server, whatever name it gives this machine, can read or write here.
On an address of the network the token is not encrypted.
"""

import asyncio
import concurrent.futures
import contextlib
import errno
import io
import ipaddress
import itertools
import json
import logging
import secrets
import socket
import threading
from dataclasses import dataclass, field
from pathlib import Path

import segno
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from deploy.errors import UserError
from pipeline.live.keeping import Keeper
from pipeline.live.messages import MAX_TAXELS, BadMessage, make_problem_message
from pipeline.live.recording import PAUSE_S
from pipeline.live.session import Session
from pipeline.simulation.pen import START_S

# Default address of the page, which other machines cannot reach.
HOST = "127.0.0.1"

# Bytes of a message.
MAX_MESSAGE_BYTES = 64 * 1024

# Minimum seconds between two answers, because a screen cannot display more.
MIN_ANSWER_INTERVAL_S = 0.012

# Minimum seconds between two messages with the spikes of the network, which are large and slow to
# draw; more of them would not be visible.
MIN_SPIKES_INTERVAL_S = 0.06

# Pages that may be open at a time.
MAX_PAGES = 8

# Connections that wait to be accepted.
MAX_WAITING_MESSAGES = 128

# Name of the QR code of the page's address.
QR_CODE = "qr.svg"

PAGE = Path(__file__).with_name("page")
LOOK = Path(__file__).parents[1] / "look.css"
_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
# The page for addresses that are not those of the page.
MISSING_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>No page here</title>
<h1>No page here</h1>
<p>Open the address that <code>stmnist live</code> printed in the terminal, with its token.</p>
</html>
"""

_HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",  # the address has the token
    "cache-control": "no-store",
}


@dataclass
class _Page:
    """A page that is open.

    Attributes
    ----------
    socket : WebSocket
    session : Session
    turn : asyncio.Lock
        Held by whoever uses the session.
    wake, draw : asyncio.Event
        Set when there may be something to answer, or spikes to draw.
    """

    socket: WebSocket
    session: Session
    turn: asyncio.Lock = field(default_factory=asyncio.Lock)
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    draw: asyncio.Event = field(default_factory=asyncio.Event)


class Live:
    """The objects that all pages share: network, folder, one thread for the network's answers.

    Messages are handled in threads, as many as there may be pages, because a message can simulate
    ten seconds of the skin or wait for the disk.  The event loop does neither, so that no page
    waits for what another one has asked for.

    Parameters
    ----------
    make_decider : callable
        Returns the :class:`~pipeline.live.deciding.PageDecider`; may take long.
    keeper : Keeper
    parameters : pipeline.simulation.parameters.Parameters
    about : dict
        Plain values for the page: ``bundle``, ``accuracy`` and the like.
    make_examples : callable, optional
        Returns the list of :class:`~pipeline.live.examples.Example` of the network's check; called
        when the network is ready.
    """

    def __init__(self, make_decider, keeper: Keeper, parameters, about: dict, make_examples=list):
        self._make_examples = make_examples
        self._make_decider = make_decider
        self._keeper = keeper
        self._parameters = parameters
        self._about = about
        self._numbers = itertools.count(1)
        self._open = 0
        self._page_threads = concurrent.futures.ThreadPoolExecutor(MAX_PAGES, "page")
        self._network_thread = concurrent.futures.ThreadPoolExecutor(1, "network")
        self._decider = self._examples = None
        self.picture: bytes | None = None  # QR code of the address, for other devices
        self._files = {file.name: file for file in (*PAGE.iterdir(), LOOK) if file.suffix in _KINDS}
        self.token = secrets.token_urlsafe(18)

    @contextlib.asynccontextmanager
    async def lifespan(self, app):
        """Make the network ready while the page is already there."""
        work = asyncio.get_running_loop().run_in_executor(self._network_thread, self._make_decider)
        self._decider = asyncio.ensure_future(work)
        self._examples = asyncio.ensure_future(self._wait_for_examples())
        try:
            yield
        finally:
            for threads in (self._page_threads, self._network_thread):
                threads.shutdown(wait=False, cancel_futures=True)

    async def _wait_for_examples(self):
        """The samples of the check and, where there are none, the reason."""
        try:
            await asyncio.shield(self._decider)
            loop = asyncio.get_running_loop()
            return await loop.run_in_executor(self._page_threads, self._make_examples), ""
        except Exception as error:  # reported on the page, which works without examples
            return [], str(error)

    def make_app(self):
        """The ASGI application."""
        routes = [
            Route("/{token}/", self._send_page),
            Route("/{token}/{name}", self._send_page),
            WebSocketRoute("/{token}/pen", self._open_socket),
        ]
        handlers = {404: lambda request, error: _refuse_address()}
        app = Starlette(routes=routes, lifespan=self.lifespan, exception_handlers=handlers)
        app.router.redirect_slashes = False
        return app

    def _has_token(self, connection):
        token = connection.path_params["token"]
        return secrets.compare_digest(token.encode(), self.token.encode())

    async def _send_page(self, request: Request):
        if not self._has_token(request):
            return _refuse_address()
        name = request.path_params.get("name", "index.html")
        if name == QR_CODE and self.picture is not None:
            return Response(self.picture, media_type=_KINDS[".svg"], headers=_HEADERS)
        file = self._files.get(name)
        if file is None:
            return _refuse_address()
        return Response(file.read_bytes(), media_type=_KINDS[file.suffix], headers=_HEADERS)

    async def _open_socket(self, socket: WebSocket):
        if not self._has_token(socket):
            await socket.close(1008, "the token in the address is missing or wrong")
            return
        await socket.accept()
        if self._open >= MAX_PAGES:
            text = f"{MAX_PAGES} pages are open; close one of them, and this page will connect"
            await _send_messages(socket, [make_problem_message(text)])
            await socket.close(1013, "too many pages")
            return
        self._open += 1
        try:
            await self._serve_page(socket)
        except (WebSocketDisconnect, RuntimeError):  # from Starlette if the socket is closed
            pass
        except asyncio.CancelledError:  # the server has ended
            pass
        finally:
            self._open -= 1

    async def _serve_page(self, socket):
        session = Session(next(self._numbers), self._keeper, self._parameters)
        page = _Page(socket, session)
        hello = {
            "type": "hello",
            **self._about,
            **_LIMITS,
            "data_set": self._keeper.data_set,
            "shared": self.picture is not None,
        }
        await _send_messages(socket, [hello, session.make_writer_message()])
        work = self._send_outputs, self._send_spikes, self._send_examples
        tasks = [asyncio.create_task(send(page)) for send in work]
        try:
            await self._handle_messages(page)
        except BadMessage as error:
            await _send_messages(
                socket, [make_problem_message(f"a message was refused: {error}; reload this page")]
            )
            await socket.close(1008, "a message was refused")
        finally:
            for task in tasks:
                task.cancel()

    async def _handle_messages(self, page):
        """Handle the messages of a page until it closes."""
        loop = asyncio.get_running_loop()
        session = page.session
        while True:
            message = await page.socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            if message.get("text") is None:
                raise BadMessage("not text")
            async with page.turn:
                replies = await loop.run_in_executor(
                    self._page_threads, session.handle, message["text"]
                )
            await _send_messages(page.socket, replies)
            events = [reply for reply in replies if reply["type"] == "events"]
            if any(r["ns"] or r["settled"] or session.changes_with_time for r in events):
                page.wake.set()

    async def _send_examples(self, page):
        """Say which examples there are as soon as they are known."""
        samples, reason = await asyncio.shield(self._examples)
        async with page.turn:
            examples = page.session.set_examples(samples)
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            await _send_messages(page.socket, [{**examples, "reason": reason}])

    async def _send_outputs(self, page):
        """Send the outputs of the network one at a time, each for the latest events."""
        try:
            decider = await asyncio.shield(self._decider)
        except Exception as error:  # any error is reported on the page
            problem = make_problem_message(f"the network cannot be made ready: {error}")
            await _send_messages(page.socket, [problem])
            return
        async with page.turn:
            page.session.begin(decider)
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            await _send_messages(page.socket, [_make_ready_message(decider)])
            while True:
                await page.wake.wait()
                page.wake.clear()
                async with page.turn:
                    task = page.session.make_output_task()
                if task is not None:
                    output = await self._compute_output(task)
                    await _send_messages(page.socket, [output] if output is not None else [])
                    page.draw.set()
                    await asyncio.sleep(MIN_ANSWER_INTERVAL_S)

    async def _compute_output(self, task):
        """The message with the network's output, or with the problem; None without an output."""
        loop = asyncio.get_running_loop()
        try:
            return await loop.run_in_executor(self._network_thread, task)
        except Exception as error:  # reported; the next one may succeed
            return make_problem_message(f"the network could not answer: {error}")

    async def _send_spikes(self, page):
        """Send the spikes of the latest output; those of the last one always."""
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            while True:
                await page.draw.wait()
                page.draw.clear()
                spikes = page.session.make_spikes_message()
                await _send_messages(page.socket, [spikes] if spikes is not None else [])
                await asyncio.sleep(MIN_SPIKES_INTERVAL_S)


def _make_ready_message(decider) -> dict:
    """The message that the network answers from now on, with its sizes and times."""
    return {
        "type": "ready",
        "layers": [{"name": name, "neurons": n} for name, n in decider.layers.items()],
        "steps": decider.steps,
        "first_step": decider.first_step,
        "threshold": decider.threshold,
        "window_s": decider.window_s,
        "usual_s": decider.usual_s,
    }


_LIMITS = {"start_s": START_S, "pause_s": PAUSE_S, "most_taxels": MAX_TAXELS}


async def _send_messages(socket, messages):
    for message in messages:
        await socket.send_text(json.dumps(message))


def _refuse_address():
    """The page for other addresses than those of the page."""
    return HTMLResponse(MISSING_PAGE, 404, headers=_HEADERS)


def listen(port: int, host: str = HOST) -> socket.socket:
    """A socket on an address of this machine.

    Parameters
    ----------
    port : int
        0 for any free port.
    host : str
        One address or name of this machine; only requests for it are answered.

    Raises
    ------
    UserError
        The port is in use or not permitted, or the address is not one of this machine.
    """
    remedy = "choose an address of this machine, such as 'hostname -I' or 'ip address' lists"
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError) as error:
        raise UserError(f"--host {host!r}: no such address ({error}); {remedy}") from error
    if ipaddress.ip_address(str(address[0]).partition("%")[0]).is_unspecified:
        raise UserError(f"--host {host!r}: stands for all addresses; {remedy}")
    listening = socket.socket(family, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind(address)
        listening.listen(MAX_WAITING_MESSAGES)
    except OSError as error:
        listening.close()
        if error.errno == errno.EADDRNOTAVAIL:
            raise UserError(f"--host {host!r}: {error.strerror}; {remedy}") from error
        raise UserError(
            f"port {port}: {error.strerror}; another 'stmnist live' may be running: "
            "choose another port with --port, or --port 0 for any that is free"
        ) from error
    return listening


class Server(uvicorn.Server):
    """Uvicorn's server, with a call when it listens; another thread can end it.

    Parameters
    ----------
    live : Live
    listening : socket.socket
        The socket that :func:`listen` has returned.
    when_listening : callable, optional
        Called with the page's address.
    host : str
        As given to :func:`listen`.
    """

    def __init__(self, live: Live, listening, when_listening=None, host: str = HOST):
        self._listening = listening
        self._when_listening = when_listening
        port = listening.getsockname()[1]
        host = f"[{host}]" if ":" in host else host
        self.url = f"http://{host}:{port}/{live.token}/"
        if host != HOST:
            picture = io.BytesIO()
            look = {"svgclass": None, "lineclass": None}
            code = segno.make_qr(self.url, error="m")
            code.save(picture, kind="svg", light="white", scale=8, **look)
            live.picture = picture.getvalue()
        self.listens = threading.Event()
        super().__init__(
            uvicorn.Config(
                live.make_app(),
                log_level="error",
                access_log=False,
                ws="websockets-sansio",
                ws_max_size=MAX_MESSAGE_BYTES,
                ws_ping_interval=None,  # a page in a sleeping tab does not answer
                ws_per_message_deflate=False,  # local traffic; saves milliseconds
                server_header=False,
                timeout_graceful_shutdown=1,
            )
        )
        # Pages that do not close in time when the server ends are no error.
        logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)

    async def startup(self, sockets=None):
        """See uvicorn."""
        await super().startup(sockets)
        if self.started:
            self.listens.set()
            if self._when_listening is not None:
                self._when_listening(self.url)

    def run(self):
        """Serve until Ctrl-C, which raises `KeyboardInterrupt`, or until ``should_exit``."""
        super().run(sockets=[self._listening])
