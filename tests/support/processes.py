"""Child processes of tests: waits for their output, and ends them in any case."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any


def wait_for(condition: Callable[[], bool], timeout: float = 120.0, failure: str = "nothing happened") -> None:
    """Return as soon as the condition holds; fail after ``timeout`` [s], long enough for a busy machine."""
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, failure
        time.sleep(0.02)


class Child:
    """Child in a separate process group, with its stderr in a file that can be read while it runs."""

    def __init__(self, command: Sequence[str], stderr: Path, **options: Any) -> None:
        self._stderr = stderr
        with stderr.open("w") as file:
            self.process = subprocess.Popen(
                command, stdout=subprocess.DEVNULL, stderr=file, start_new_session=True, **options
            )

    @property
    def stderr(self) -> str:
        return self._stderr.read_text()

    def wait_for(self, text: str, count: int = 1) -> None:
        """Wait until the child has written ``text`` to stderr ``count`` times; fail if it ends before."""

        def written() -> bool:
            ended = self.process.poll() is not None
            if self.stderr.count(text) >= count:
                return True
            assert not ended, self.stderr
            return False

        wait_for(written, failure=f"no {text!r} in {self.stderr!r}")

    def end(self, timeout: float = 120.0) -> int:
        """Wait for the child to end and return its exit code."""
        return self.process.wait(timeout)


@contextmanager
def started(command: Sequence[str], stderr: Path, **options: Any) -> Iterator[Child]:
    """Provide a running child; when the block ends, its whole group is ended."""
    child = Child(command, stderr, **options)
    try:
        yield child
    finally:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(child.process.pid, signal.SIGKILL)
        child.process.wait(timeout=20)
