"""Headers of the pages and rejections of the teleop server, and connections without a request."""

from __future__ import annotations

import errno
import http.client
import re
import socket
import subprocess
import sys
import time

import pytest

from dynsim.teleop.web.pilot import Deadman
from dynsim.teleop.web.server import MAX_ACCEPTED, Server, _ListeningSocket


@pytest.mark.parametrize("wrong", [False, True])
def test_all_headers_of_an_answer(wrong: bool) -> None:
    server = Server(
        deadman=Deadman((), time.monotonic), hello={}, axes=0, modes=(), page=lambda socket: "page", end=lambda: None
    )
    server.start()
    try:
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
        connection.request("GET", "/wrong/" if wrong else f"/{server.token}/")
        answer = connection.getresponse()
        headers = [(name, value) for name, value in answer.getheaders() if name != "Date"]
        body = answer.read()
    finally:
        server.stop()
    assert (answer.status, body) == ((403, b"") if wrong else (200, b"page"))
    # By the standard names: browsers ignore a header with another name.
    assert sorted(headers) == [
        ("Cache-Control", "no-store"),
        ("Connection", "close"),
        ("Content-Length", str(len(body))),
        ("Content-Security-Policy", "frame-ancestors 'none'"),
        ("Content-Type", "text/html; charset=utf-8"),
        ("Cross-Origin-Opener-Policy", "same-origin"),
        ("Cross-Origin-Resource-Policy", "same-origin"),
        ("Referrer-Policy", "no-referrer"),
        ("X-Content-Type-Options", "nosniff"),
        ("X-Frame-Options", "DENY"),
    ]


FLOOD = """
import http.client, logging, resource, socket, sys, time
from dynsim.teleop.web.pilot import Deadman
from dynsim.teleop.web.server import Server
logging.basicConfig(format="%(message)s")
server = Server(
    deadman=Deadman((), time.monotonic), hello={}, axes=0, modes=(), page=lambda socket: "page", end=lambda: None
)
server.start()
idle = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(int(sys.argv[1]))]
connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
connection.connect()
few = len(idle) + int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_NOFILE, (few, few))
connection.request("GET", f"/{server.token}/")
print(connection.getresponse().status)
server.stop()
"""


@pytest.mark.long
@pytest.mark.parametrize("descriptors", [20, pytest.param(200, marks=pytest.mark.slow)])
def test_idle_connections_delay_the_page_and_are_one_line_of_log(descriptors: int) -> None:
    """Also when the process has too few file descriptors for them."""
    command = [sys.executable, "-c", FLOOD, "150", str(descriptors)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout == "200\n"
    (line,) = done.stderr.splitlines()
    assert re.fullmatch(r"\d+ connections to the drive's port failed, or came too fast", line)


def test_the_rate_of_accepted_connections_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 10.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    with _ListeningSocket(0) as listening:
        listening.listen(2 * MAX_ACCEPTED)
        listening.setblocking(False)
        clients = [socket.create_connection(listening.getsockname()) for _ in range(MAX_ACCEPTED + 2)]
        accepted = [listening.accept()[0] for _ in range(MAX_ACCEPTED)]
        with pytest.raises(OSError, match="too many") as error:
            listening.accept()
        assert error.value.errno == errno.EMFILE
        with pytest.raises(BlockingIOError):
            listening.accept()
        now += 1.0
        accepted.append(listening.accept()[0])
        for connection in (*clients, *accepted):
            connection.close()
