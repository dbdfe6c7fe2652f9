"""Live drives in separate processes, and raw clients of their servers."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

PATIENCE_S = 180.0


def prepare_child() -> None:
    """Restore SIGINT: if the tests run in the background it is ignored, and child processes would inherit that."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Teleop:
    """Process of ``dynsim teleop``, or of another command with its page, and the address that it prints."""

    def __init__(
        self, folder: Path, *arguments: str, command: Sequence[str] = ("teleop",), writes: bool = True
    ) -> None:
        self.folder = folder
        out = ["--out", str(folder)] if writes else []
        command = [sys.executable, "-m", "dynsim", *command, *arguments, "--no-open", *out]
        self.process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            preexec_fn=prepare_child,
            start_new_session=True,
            cwd=folder.parent,
        )
        assert self.process.stdout is not None
        self.said = ""
        while not (match := re.search(r"http://\S+", self.said)):
            line = self.process.stdout.readline()
            assert line, self.said
            self.said += line
        self.address = match[0]
        parts = urlsplit(self.address)
        assert parts.hostname == "127.0.0.1"
        self.port, self.path = int(parts.port or 0), parts.path

    def finish(self) -> int:
        """Wait for the end and return the exit code."""
        out, _ = self.process.communicate(timeout=PATIENCE_S)
        self.said += out
        return self.process.returncode

    def interrupt(self) -> int:
        """Send Ctrl-C and return the exit code."""
        self.process.send_signal(signal.SIGINT)
        return self.finish()

    def group_is_gone(self) -> bool:
        """Return whether all processes of its session have ended."""
        try:
            os.killpg(self.process.pid, 0)
        except ProcessLookupError:
            return True
        return False

    def connect(self) -> Client:
        """Return a pilot's socket, opened as by the page."""
        return Client(self)

    def ask(self, path: str, headers: Mapping[str, str | None]) -> tuple[int, bytes]:
        """Return status and body of the answer to a request with these headers."""
        lines = [f"GET {path} HTTP/1.1", *(f"{name}: {value}" for name, value in headers.items() if value is not None)]
        with socket.create_connection(("127.0.0.1", self.port), timeout=30) as raw:
            raw.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
            answer = b""
            while chunk := raw.recv(65536):
                answer += chunk
                if b"101 Switching" in answer:
                    break
        head, _, body = answer.partition(b"\r\n\r\n")
        return int(head.split()[1]), body

    def upgrade(self, **changes: str | None) -> dict[str, str | None]:
        """Return the headers of a web socket from the page."""
        headers: dict[str, str | None] = {
            "Host": f"127.0.0.1:{self.port}",
            "Origin": f"http://127.0.0.1:{self.port}",
            "Upgrade": "websocket",
            "Connection": "Upgrade",
            "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
            "Sec-WebSocket-Version": "13",
        }
        return headers | changes


class Client:
    """Raw client that sends and receives JSON."""

    def __init__(self, teleop: Teleop) -> None:
        from websockets.sync.client import connect

        origin = f"http://127.0.0.1:{teleop.port}"
        address = f"ws://127.0.0.1:{teleop.port}{teleop.path}drive"
        self._open = ExitStack()
        self.socket = self._open.enter_context(connect(address, origin=origin, compression=None, ping_interval=None))
        self.count, self.over = 0, ""
        self.hello: dict[str, Any] = self.until("hello")["hello"]

    def close(self) -> None:
        """Close the connection."""
        self._open.close()

    def say(self, **message: Any) -> None:
        """Send one message."""
        self.socket.send(json.dumps(message))

    def wish(self, axes: Mapping[str, float], held: bool = True, **more: Any) -> None:
        """Send the wanted value of each named axis, zero for others."""
        self.count += 1
        names = [axis["name"] for axis in self.hello["axes"]]
        self.say(n=self.count, axes=[axes.get(name, 0.0) for name in names], held=held, **more)

    def hear(self) -> dict[str, Any]:
        """Return the next message."""
        message = dict(json.loads(self.socket.recv(timeout=60)))
        self.over = message.get("over", self.over)
        return message

    def until(self, key: str, test: Callable[[Any], bool] = lambda value: True) -> dict[str, Any]:
        """Return the next message with a key whose value passes a test."""
        end = time.monotonic() + 60
        while time.monotonic() < end:
            message = self.hear()
            if key in message and test(message[key]):
                return message
        raise AssertionError(f"no {key}")

    def take(self) -> None:
        """Become the pilot, with the key released."""
        self.say(do="take")
        self.until("role", lambda role: role == "pilot")
        self.wish({}, held=False)

    def drive(self, axes: Mapping[str, float], seconds: float, **more: Any) -> None:
        """Hold the key and the axes for a time, as a browser does."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.wish(axes, **more)
            time.sleep(0.02)
