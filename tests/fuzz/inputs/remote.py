"""Messages of a pilot, and requests to the server of a drive, which must continue to serve its page."""

from __future__ import annotations

import json
import math
import socket
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any

from fuzz.case import Draft
from fuzz.mutations import NUMBERS, TEXTS, mutate_bytes, mutate_text, mutate_tree

AXES, MODES = 2, (1, 2)
ITEMS = (*NUMBERS, *TEXTS, None, True, False, [], {}, [0.5], [0.1, -0.3], [1, "x"], [math.nan, 0], "take", "switching")
REQUEST = (
    "GET /{token}{path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    "Origin: http://127.0.0.1:{port}\r\nSec-WebSocket-Version: 13\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)


def draw(rng: Random, records: Path, kind: str) -> Draft:
    if kind == "message":
        texts = [_message(rng) for _ in range(rng.choice((1, 3, 8)))]
        return Draft(repr(texts)[:200], {}, [], partial(message_losses, texts))
    token, path = (
        rng.choice(("{token}", "{token}", "{token}", "x", "", "{token}x", "../etc")),
        rng.choice(("/", "/drive", "", "/x", "//", "/drive/")),
    )
    data, mutation = REQUEST.replace("{token}", token).replace("{path}", path).encode(), f"{token}{path}"
    choice = rng.random()
    if choice < 0.3:
        data, more = mutate_bytes(rng, data)
    elif choice < 0.6:
        data, more = mutate_text(rng, data.decode())
    elif choice < 0.75:
        old = rng.choice((b"GET", b"HTTP/1.1", b"127.0.0.1:{port}", b"13", b"websocket"))
        new = rng.choice((b"", b"POST", b"x" * 9000, b"\xff\xfe", b"HTTP/9.9", b"evil.example", b"\r\nX: " * 200))
        data, more = data.replace(old, new), f"{old!r} became {new[:20]!r}"
    else:
        more = "sound"
    # Frames of a web socket behind the request; without a mask, or random.
    frames = b"".join(
        rng.choice((b"\x81\x02{}", b"\x81\xfe\xff\xff", b"\x88\x80abcd", rng.randbytes(20)))
        for _ in range(rng.choice((0, 0, 1, 3)))
    )
    return Draft(f"{mutation}: {more}, {len(frames)} bytes of frames", {}, [], partial(request_losses, data, frames))


def _message(rng: Random) -> str | bytes:
    tree: dict[str, Any] = {
        "n": rng.randrange(1000),
        "axes": [rng.uniform(-2, 2) for _ in range(AXES)],
        "held": rng.random() < 0.7,
    }
    if rng.random() < 0.4:
        tree |= {"mode": rng.choice((1, 2, "switching", "fixing")), "closed": rng.random() < 0.5}
    if rng.random() < 0.1:
        tree = {"do": rng.choice(("take", "leave", "end", "x", 3, None, []))}
    choice = rng.random()
    if choice < 0.35:
        tree[rng.choice((*tree, "x", "do", "é"))] = rng.choice(ITEMS)
    elif choice < 0.5:
        mutate_tree(rng, tree)
    text = json.dumps(tree)
    if rng.random() < 0.2:
        data, _ = mutate_text(rng, text)
        return data if rng.random() < 0.3 else data.decode("utf-8", "replace")
    return text


def message_losses(texts: list[str | bytes]) -> list[str]:
    """Return messages that were read as something else, and speeds beyond the limits of the dead-man switch."""
    from dynsim.teleop.web.pilot import Deadman, PilotCommand, Refused, parse

    now, lost, newest = [0.0], [], PilotCommand(-1, (), False)
    deadman = Deadman(_axes(), lambda: now[0])
    for text in texts:
        now[0] += 0.1
        try:
            parsed = parse(text, AXES, MODES)
        except Refused as reason:
            if not str(reason) or len(str(reason)) > 200 or any(ord(sign) < 32 for sign in str(reason)):
                lost.append(f"an unclear reason {str(reason)[:80]!r}")
            continue
        message = json.loads(text)
        if isinstance(parsed, PilotCommand):
            speeds = [round(100 * max(-1, min(1, axis))) / 100 for axis in message["axes"]]
            if [*parsed.axes] != speeds or (parsed.count, parsed.held) != (message["n"], message.get("held", False)):
                lost.append(f"{str(text)[:80]} was read as {parsed}")
            deadman.receive(parsed)
            # Messages that were overtaken have no effect.
            newest = parsed if parsed.count > newest.count else newest
        elif parsed != message["do"]:
            lost.append(f"{str(text)[:80]} was read as {parsed}")
        command, state, _ = deadman.command()
        if any(abs(speed) > axis.limit for speed, axis in zip(command.velocity, _axes(), strict=True)):
            lost.append(f"speeds {command.velocity} are beyond the limits")
        if any(command.velocity) and not newest.held:
            lost.append(f"a motion without the switch, in the state {state}")
    return lost


def _axes() -> list[Any]:
    from dynsim.teleop.snake import PilotAxis

    return [PilotAxis("x", "hand", "m/s", 0.1), PilotAxis("yaw", "hand", "rad/s", 0.5)]


@cache
def _server() -> Any:
    """Return a server of this process; it ends with the process."""
    from dynsim.teleop.web.pilot import Deadman
    from dynsim.teleop.web.server import Server

    server = Server(
        deadman=Deadman(_axes(), lambda: 0.0),
        hello={"robot": "x"},
        axes=AXES,
        modes=MODES,
        page=lambda address: "page",
        end=lambda: None,
    )
    server.start()
    return server


def request_losses(data: bytes, frames: bytes) -> list[str]:
    """Return an answer that is not HTTP, or a page that is no longer served."""
    server = _server()
    fill = {b"{token}": server.token.encode(), b"{port}": str(server.port).encode()}
    for key, text in fill.items():
        data = data.replace(key, text)
    answer = _exchange(server.port, data + frames)
    lost = []
    if answer and not answer.startswith(b"HTTP/1.1 "):
        lost.append(f"the answer is not HTTP: {answer[:60]!r}")
    if answer.startswith(b"HTTP/1.1 200") and not data.startswith(f"GET /{server.token}".encode()):
        lost.append("a page without the token")
    if any(word in answer for word in (b"Traceback", b".py", b"dynsim/")):
        lost.append("the answer reveals the program")
    plain = f"GET /{server.token}/ HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n\r\n".encode()
    if not _exchange(server.port, plain, end=False).endswith(b"\r\n\r\npage"):
        lost.append("the page is no longer served")
    return lost


def _exchange(port: int, data: bytes, end: bool = True) -> bytes:
    """Send bytes, ``end`` the sending, and return the answer."""
    with socket.create_connection(("127.0.0.1", port), timeout=20.0) as connection:
        answer = b""
        try:
            connection.sendall(data)
            if end:
                connection.shutdown(socket.SHUT_WR)
            while part := connection.recv(65536):
                answer += part
        except (ConnectionResetError, BrokenPipeError):
            pass
    return answer
