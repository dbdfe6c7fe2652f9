"""Headers of the pages and rejections of the teleop server."""

from __future__ import annotations

import http.client
import time

import pytest

from dynsim.teleop.web.pilot import Deadman
from dynsim.teleop.web.server import Server


@pytest.mark.parametrize("wrong", [False, True])
def test_all_headers_of_an_answer(wrong: bool) -> None:
    server = Server(Deadman((), time.monotonic), {}, 0, (), lambda socket: "page", lambda: None)
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
