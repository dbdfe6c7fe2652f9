"""The server of a drive: page by HTTP, commands and frames by web socket, on this machine only.

Every user of the machine, and every web page in a browser on it, can reach the loopback address. So the path contains a
token, ``Host`` must be this server (against DNS rebinding), and the ``Origin`` of a web socket must be its own page.
"""

from __future__ import annotations

import asyncio
import hmac
import http
import json
import secrets
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from websockets.asyncio.server import Server as Listener
from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from dynsim.errors import DynsimError
from dynsim.teleop.web.pilot import MOST_BYTES, Deadman, PilotCommand, Refused, parse

HERE = "127.0.0.1"
FRAMES = 60.0
"""Most frames that a client gets [1/s]."""
MOST_CLIENTS = 16
MOST_WORDS = 400
"""Most messages of a client in a second; a browser sends 50."""
MOST_REFUSED = 20
"""Messages of a client that are none, after which it is closed."""
GOODBYE = 1.0
"""For a last word to all clients [s]."""
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-LiveFrame-Options": "DENY",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


@dataclass(eq=False)
class _Client:
    socket: ServerConnection
    news: asyncio.Event = field(default_factory=asyncio.Event)
    refused: int = 0
    begun: float = 0.0
    words: int = 0


class Server:
    """Runs in a thread of its own from :meth:`start` to :meth:`stop`.

    Parameters
    ----------
    deadman : hears the pilot
    hello : said to every client at first
    axes, modes : of the robot
    page : the page, of the address of the socket
    end : called when the pilot ends the drive
    """

    def __init__(
        self,
        deadman: Deadman,
        hello: Mapping[str, Any],
        axes: int,
        modes: tuple[int, ...],
        page: Callable[[str], str],
        end: Callable[[], None],
    ) -> None:
        self._deadman, self._hello, self._axes, self._modes, self._end = deadman, hello, axes, modes, end
        self._make_page = page
        self.token = secrets.token_urlsafe(24)
        self._clients: dict[ServerConnection, _Client] = {}
        self._pilot: _Client | None = None
        self._frame = ""
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None
        self._ready = threading.Event()
        self._quit: asyncio.Event | None = None
        self._why = ""
        self.failure: BaseException | None = None
        self.port = 0
        self._page = b""
        self.came = False

    @property
    def address(self) -> str:
        """Of the page."""
        return f"http://{HERE}:{self.port}/{self.token}/"

    @property
    def socket(self) -> str:
        """Of the web socket."""
        return f"ws://{HERE}:{self.port}/{self.token}/drive"

    @property
    def clients(self) -> int:
        """Browsers that are connected."""
        return len(self._clients)

    def start(self, port: int = 0) -> None:
        """Listen; 0 takes a free port.

        Raises
        ------
        DynsimError
            The port is taken.
        """
        self._thread = threading.Thread(target=self._run, args=(port,), name="dynsim live server", daemon=True)
        self._thread.start()
        self._ready.wait()
        if self.failure is not None:
            self._thread.join()
            raise DynsimError(f"cannot listen on {HERE}, port {port}: {self.failure}; choose another --http-port")

    def stop(self, why: str = "") -> None:
        """Tell all clients why the drive is over, say goodbye and end the thread."""
        self._why = why
        if self._loop is not None and self._quit is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._quit.set)
        if self._thread is not None:
            self._thread.join()

    def show(self, frame: Mapping[str, Any]) -> None:
        """Give every client a new frame; from any thread. One that is still busy gets only the newest."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._announce, json.dumps(frame, separators=(",", ":")))

    def _announce(self, text: str) -> None:
        self._frame = text
        for client in self._clients.values():
            client.news.set()

    def _run(self, port: int) -> None:
        try:
            asyncio.run(self._serve(port))
        except BaseException as error:
            self.failure = error
        finally:
            self._ready.set()

    async def _serve(self, port: int) -> None:
        self._loop, self._quit = asyncio.get_running_loop(), asyncio.Event()
        async with serve(
            self._meet,
            HERE,
            port,
            process_request=self._guard,
            max_size=MOST_BYTES,
            max_queue=8,
            compression=None,
            close_timeout=1.0,
            server_header=None,
        ) as listener:
            self.port = _port(listener)
            self._page = self._make_page(self.socket).encode()
            self._ready.set()
            await self._quit.wait()
            messages = (client.socket.send(json.dumps({"over": self._why})) for client in self._clients.values())
            # A browser that takes nothing more is not waited for.
            with suppress(TimeoutError):
                await asyncio.wait_for(asyncio.gather(*messages, return_exceptions=True), GOODBYE)

    def _guard(self, connection: ServerConnection, request: Request) -> Response | None:
        """None for the pilot's own socket; the page, or a refusal that says nothing."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        own = {f"{name}:{self.port}" for name in (HERE, "localhost")}
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
        if len(self._clients) >= MOST_CLIENTS:
            return _answer(http.HTTPStatus.SERVICE_UNAVAILABLE)
        return None

    async def _meet(self, socket: ServerConnection) -> None:
        """One client, from its first message to its last."""
        client = _Client(socket)
        self._clients[socket] = client
        self.came = True
        sender: asyncio.Task[None] | None = None
        try:
            await socket.send(json.dumps({"hello": dict(self._hello)}))
            await self._tell_roles()
            sender = asyncio.create_task(self._send(client))
            async for message in socket:
                if not self._count(client):
                    await socket.close(1008, "too many messages")
                    break
                await self._hear(client, message)
        except ConnectionClosed:
            pass
        finally:
            del self._clients[socket]
            if sender is not None:
                sender.cancel()
            if self._pilot is client:
                self._release()
                await self._tell_roles()

    def _count(self, client: _Client) -> bool:
        assert self._loop is not None
        now = self._loop.time()
        if now - client.begun >= 1.0:
            client.begun, client.words = now, 0
        client.words += 1
        return client.words <= MOST_WORDS

    async def _hear(self, client: _Client, message: str | bytes) -> None:
        try:
            heard = parse(message, self._axes, self._modes)
        except Refused as reason:
            client.refused += 1
            await client.socket.send(json.dumps({"refused": str(reason)}))
            if client.refused >= MOST_REFUSED:
                await client.socket.close(1008, "messages that are none")
            return
        if heard == "take" and self._pilot is None:
            self._pilot = client
            await self._tell_roles()
        elif client is not self._pilot:
            return
        elif isinstance(heard, PilotCommand):
            self._deadman.hear(heard)
        elif heard == "leave":
            self._release()
            await self._tell_roles()
        elif heard == "end":
            self._end()

    def _release(self) -> None:
        self._pilot = None
        self._deadman.forget()

    async def _tell_roles(self) -> None:
        for client in list(self._clients.values()):
            role = "pilot" if client is self._pilot else "watching"
            try:
                await client.socket.send(json.dumps({"role": role, "free": self._pilot is None}))
            except ConnectionClosed:
                continue

    async def _send(self, client: _Client) -> None:
        """Frames as they come, the newest only."""
        try:
            while True:
                await client.news.wait()
                client.news.clear()
                await client.socket.send(self._frame)
                await asyncio.sleep(1.0 / FRAMES)
        except ConnectionClosed:
            return


def _port(listener: Listener) -> int:
    (socket,) = listener.sockets
    return int(socket.getsockname()[1])


def _answer(status: http.HTTPStatus, body: bytes = b"") -> Response:
    headers = Headers(_HEADERS)
    headers["Content-Type"] = "text/html; charset=utf-8"
    headers["Content-Length"] = str(len(body))
    headers["Connection"] = "close"
    return Response(status.value, status.phrase, headers, body)
