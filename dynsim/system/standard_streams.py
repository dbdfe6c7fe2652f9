"""Standard output and error whose failures do not end a run: closed pipes, full disks, ASCII terminals.

Results of commands are in files, so a failure to print must not lose them.
"""

from __future__ import annotations

import codecs
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast

# Characters that dynsim prints → their replacements in encodings that lack them; others become "?".
_PLAIN = {
    "−": "-", "–": "-", "—": "-", "…": "...", "→": "->", "·": " ", "×": "x", "°": " deg", "µ": "u", "μ": "mu",
    "Ω": "ohm", "²": "^2", "³": "^3", "⁻": "^-", "√": "sqrt", "∫": "int ", "Σ": "sum ", "τ": "tau", "≤": "<=",
    "≥": ">=", "π": "pi", "“": '"', "”": '"', "‘": "'", "’": "'", "•": "*", "━": "-", "╸": "-", "╺": "-", "é": "e",
}  # fmt: skip


def _plain(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(_PLAIN.get(sign, "?") for sign in error.object[error.start : error.end]), error.end


codecs.register_error("dynsim.plain", _plain)


class LenientStream:
    """A text stream that discards its output from its first failure on, which ``failure`` keeps."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.failure: OSError | None = None

    def write(self, text: str) -> int:
        if self.failure is None:
            try:
                return self._stream.write(text)
            except OSError as error:
                self._give_up(error)
        return len(text)

    def flush(self) -> None:
        if self.failure is None:
            try:
                self._stream.flush()
            except OSError as error:
                self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        self.failure = error
        # What is still in its buffer would fail once more when Python ends.
        with suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def hold_descriptors() -> None:
    """Let the descriptors of closed standard streams lead nowhere.

    The next files opened would get them: what a library prints would go to a record, or to the servos.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            # The system gives the lowest that is free.
            os.open(os.devnull, os.O_RDWR)


@contextmanager
def lenient_streams() -> Iterator[LenientStream | None]:
    """Within the block standard output and error are lenient; gives standard output, None where it is closed."""
    hold_descriptors()
    before = sys.stdout, sys.stderr
    with _encodable(sys.stdout), _encodable(sys.stderr):
        output = LenientStream(sys.stdout) if sys.stdout is not None else None
        sys.stdout = cast(TextIO, output)
        sys.stderr = cast(TextIO, LenientStream(sys.stderr)) if sys.stderr is not None else sys.stderr
        try:
            yield output
        finally:
            for stream in (sys.stdout, sys.stderr):
                if stream is not None:
                    stream.flush()
            sys.stdout, sys.stderr = before


@contextmanager
def _encodable(stream: Any) -> Iterator[None]:
    """Signs that the stream's encoding lacks are written in plain letters."""
    if not hasattr(stream, "reconfigure"):
        yield
        return
    before = stream.errors
    stream.reconfigure(errors="dynsim.plain")
    try:
        yield
    finally:
        # Fails only where a stream cannot be flushed.
        with suppress(OSError, ValueError):
            stream.reconfigure(errors=before)
