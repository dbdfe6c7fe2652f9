"""Servers of live pages: page by HTTP, commands and frames by web socket, on this machine only.

All users of the machine, and all web pages in a browser on it, can reach the loopback address. Therefore the path
contains a token, ``Host`` must be this server (against DNS rebinding), and the ``Origin`` of a web socket must be the
page of this server. Connections without a valid request cost the drive little: only a few are accepted per second, and
each has a short time for its request.
"""

from __future__ import annotations

import asyncio
import errno
import hmac
import http
import json
import logging
import os
import secrets
import socket as socketlib
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from dynsim.errors import DynsimError
from dynsim.teleop.web.pilot import MAX_BYTES, Deadman, PilotCommand, Refused, parse

LOG = logging.getLogger("dynsim.teleop")
LOOPBACK = "127.0.0.1"
FRAMES = 60.0
"""Maximum frame rate of a client [1/s]."""
MAX_CLIENTS = 16
MAX_MESSAGES = 400
"""Maximum number of messages per second from one client; the page sends 50."""
MAX_REFUSED = 20
"""Number of invalid messages after which the connection to a client is closed."""
MAX_ACCEPTED, MAX_WAITING = 40, 1024
"""Maximum number of connections that are accepted in each second, and of those that wait for it in the system."""
REQUEST_TIME = 1.0
"""Maximum time from the acceptance of a connection to its complete request [s]."""
LAST_MESSAGE_TIME = 1.0
"""Maximum time to send the last message to all clients [s]."""
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class _ListeningSocket(socketlib.socket):
    """Listening socket that accepts at most ``MAX_ACCEPTED`` connections per second.

    ``asyncio`` does not limit the rate, but it stops accepting for a second when ``accept`` reports that the system has
    no more file descriptors.
    """

    def __init__(self, port: int) -> None:
        super().__init__(socketlib.AF_INET, socketlib.SOCK_STREAM)
        if os.name == "posix":
            self.setsockopt(socketlib.SOL_SOCKET, socketlib.SO_REUSEADDR, 1)
        self.bind((LOOPBACK, port))
        self._accepted: deque[float] = deque(maxlen=MAX_ACCEPTED)
        self._resumes = 0.0

    def accept(self) -> tuple[socketlib.socket, Any]:
        now = time.monotonic()
        if now < self._resumes:  # within a pause asyncio would try again at once
            raise BlockingIOError
        try:
            if len(self._accepted) == MAX_ACCEPTED and now - self._accepted[0] < 1.0:
                raise OSError(errno.EMFILE, "too many connections per second")
            connection = super().accept()
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM):
                self._resumes = now + 0.5
            raise
        self._accepted.append(now)
        return connection


class _FailureCount(logging.Handler):
    """Counter of log lines about connections that failed, instead of a traceback for each."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.count += 1


@dataclass(eq=False)
class _Client:
    socket: ServerConnection
    new_frame: asyncio.Event = field(default_factory=asyncio.Event)
    refused: int = 0
    begun: float = 0.0
    messages: int = 0


@dataclass(eq=False, kw_only=True)
class PageServer:
    """Server of one page and its web sockets; it runs in a separate thread from :meth:`start` to :meth:`stop`.

    Parameters
    ----------
    hello : mapping
        First message to each client.
    page : callable
        Function that returns the page; its argument is the address of the web socket.
    """

    hello: Mapping[str, Any]
    page: Callable[[str], str]
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    port: int = 0
    failure: BaseException | None = None
    had_clients: bool = False
    _clients: dict[ServerConnection, _Client] = field(default_factory=dict)
    _frame: str = ""
    _loop: asyncio.AbstractEventLoop | None = None
    _thread: threading.Thread | None = None
    _ready: threading.Event = field(default_factory=threading.Event)
    _quit: asyncio.Event | None = None
    _why: str = ""
    _page: bytes = b""
    _failures: _FailureCount = field(default_factory=_FailureCount)
    _log: logging.Logger = field(default_factory=lambda: logging.Logger("connections of a drive", logging.ERROR))

    def __post_init__(self) -> None:
        self._log.addHandler(self._failures)

    @property
    def address(self) -> str:
        """Address of the page."""
        return f"http://{LOOPBACK}:{self.port}/{self.token}/"

    @property
    def socket(self) -> str:
        """Address of the web socket."""
        return f"ws://{LOOPBACK}:{self.port}/{self.token}/drive"

    @property
    def clients(self) -> int:
        """Number of connected browsers."""
        return len(self._clients)

    def start(self, port: int = 0) -> None:
        """Start the server; if the port is 0, select a free port.

        Raises
        ------
        DynsimError
            If the port is in use.
        """
        self._thread = threading.Thread(target=self._run, args=(port,), name="dynsim live server", daemon=True)
        self._thread.start()
        self._ready.wait()
        if self.failure is not None:
            self._thread.join()
            raise DynsimError(f"cannot listen on {LOOPBACK}, port {port}: {self.failure}; choose another --http-port")

    def stop(self, why: str = "") -> None:
        """Send the reason for the end to all clients, close the connections and end the thread."""
        self._why = why
        if self._loop is not None and self._quit is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._quit.set)
        if self._thread is not None:
            self._thread.join()
        if count := self._failures.count:
            self._failures.count = 0
            LOG.warning("%d connections to the drive's port failed, or came too fast", count)

    def show(self, frame: Mapping[str, Any]) -> None:
        """Send a new frame to all clients; thread-safe. A busy client receives only the newest frame."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._set_frame, json.dumps(frame, separators=(",", ":")))

    def _set_frame(self, text: str) -> None:
        self._frame = text
        for client in self._clients.values():
            client.new_frame.set()

    def _run(self, port: int) -> None:
        try:
            asyncio.run(self._serve(port))
        except BaseException as error:
            self.failure = error
        finally:
            self._ready.set()

    async def _serve(self, port: int) -> None:
        self._loop, self._quit = asyncio.get_running_loop(), asyncio.Event()
        self._loop.set_exception_handler(lambda loop, context: self._log.error(context["message"]))
        async with serve(
            self._serve_client,
            sock=_ListeningSocket(port),
            backlog=MAX_WAITING,
            open_timeout=REQUEST_TIME,
            logger=self._log,
            process_request=self._guard,
            max_size=MAX_BYTES,
            max_queue=8,
            compression=None,
            close_timeout=1.0,
            server_header=None,
        ) as listener:
            self.port = listener.sockets[0].getsockname()[1]
            self._page = self.page(self.socket).encode()
            self._ready.set()
            await self._quit.wait()
            messages = (client.socket.send(json.dumps({"over": self._why})) for client in self._clients.values())
            # Do not wait for a browser that no longer reads messages.
            with suppress(TimeoutError):
                await asyncio.wait_for(asyncio.gather(*messages, return_exceptions=True), LAST_MESSAGE_TIME)

    def _guard(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the page, a rejection without details, or None if the request is a valid web socket of the page."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        own = {f"{name}:{self.port}" for name in (LOOPBACK, "localhost")}
        if len(hosts) != 1 or hosts[0] not in own:
            return _answer(http.HTTPStatus.FORBIDDEN)
        if request.path == "/favicon.ico":
            return _answer(http.HTTPStatus.NO_CONTENT)
        _, token, *others = (*request.path.split("/"), "", "")
        if not hmac.compare_digest(token.encode("utf-8", "replace"), self.token.encode()):
            return _answer(http.HTTPStatus.FORBIDDEN)
        if others[:2] == ["", ""]:
            return _answer(http.HTTPStatus.OK, self._page)
        if others[0] != "drive" or others[1:] != ["", ""]:
            return _answer(http.HTTPStatus.FORBIDDEN)
        if len(origins) != 1 or origins[0] not in {f"http://{name}" for name in own}:
            return _answer(http.HTTPStatus.FORBIDDEN)
        if len(self._clients) >= MAX_CLIENTS:
            return _answer(http.HTTPStatus.SERVICE_UNAVAILABLE)
        return None

    async def _serve_client(self, socket: ServerConnection) -> None:
        """Serve one client until its connection ends."""
        client = _Client(socket)
        self._clients[socket] = client
        self.had_clients = True
        sender: asyncio.Task[None] | None = None
        try:
            await socket.send(json.dumps({"hello": dict(self.hello)}))
            await self._joined()
            if self._frame:
                client.new_frame.set()
            sender = asyncio.create_task(self._send(client))
            async for message in socket:
                if not self._count(client):
                    await socket.close(1008, "too many messages")
                    break
                await self._handle(client, message)
        except ConnectionClosed:
            pass
        finally:
            del self._clients[socket]
            if sender is not None:
                sender.cancel()
            await self._left(client)

    def _count(self, client: _Client) -> bool:
        assert self._loop is not None
        now = self._loop.time()
        if now - client.begun >= 1.0:
            client.begun, client.messages = now, 0
        client.messages += 1
        return client.messages <= MAX_MESSAGES

    async def _handle(self, client: _Client, message: str | bytes) -> None:
        """Handle a message; close the connection after too many invalid messages."""
        try:
            await self._receive(client, message)
        except Refused as reason:
            client.refused += 1
            await client.socket.send(json.dumps({"refused": str(reason)}))
            if client.refused >= MAX_REFUSED:
                await client.socket.close(1008, "too many invalid messages")

    async def _receive(self, client: _Client, message: str | bytes) -> None:
        """Handle a message; raise Refused if it is not valid."""
        raise NotImplementedError

    async def _joined(self) -> None:
        """Inform the clients that another client has connected."""

    async def _left(self, client: _Client) -> None:
        """Inform the other clients that a client has disconnected."""

    async def _send(self, client: _Client) -> None:
        """Send the newest frame whenever a new frame is available."""
        with suppress(ConnectionClosed):
            while True:
                await client.new_frame.wait()
                client.new_frame.clear()
                await client.socket.send(self._frame)
                await asyncio.sleep(1.0 / FRAMES)


@dataclass(eq=False, kw_only=True)
class Server(PageServer):
    """Server of a drive: one client is the pilot, the others watch.

    Parameters
    ----------
    deadman : Deadman
        Dead-man switch that receives the commands from the pilot.
    axes : int
        Number of axes of the robot.
    modes : tuple of int
        Modes that a pilot may request.
    end : callable
        Function that is called when the pilot ends the drive.
    """

    deadman: Deadman
    axes: int
    modes: tuple[int, ...]
    end: Callable[[], None]
    _pilot: _Client | None = None

    async def _receive(self, client: _Client, message: str | bytes) -> None:
        parsed = parse(message, self.axes, self.modes)
        if parsed == "take" and self._pilot is None:
            self._pilot = client
            await self._joined()
        elif client is not self._pilot:
            return
        elif isinstance(parsed, PilotCommand):
            self.deadman.receive(parsed)
        elif parsed == "leave":
            await self._left(client)
        elif parsed == "end":
            self.end()

    async def _left(self, client: _Client) -> None:
        if self._pilot is client:
            self._pilot = None
            self.deadman.reset()
            await self._joined()

    async def _joined(self) -> None:
        for client in list(self._clients.values()):
            role = "pilot" if client is self._pilot else "watching"
            with suppress(ConnectionClosed):
                await client.socket.send(json.dumps({"role": role, "free": self._pilot is None}))


def _answer(status: http.HTTPStatus, body: bytes = b"") -> Response:
    headers = Headers(_HEADERS)
    headers["Content-Type"] = "text/html; charset=utf-8"
    headers["Content-Length"] = str(len(body))
    headers["Connection"] = "close"
    return Response(status.value, status.phrase, headers, body)
