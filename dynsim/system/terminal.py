"""A terminal of rich, and texts from files made safe to print on it.

A name in a scenario, a record or a servo map may contain escape sequences, which move the cursor, change colours or
rename the window, and the markup of rich. Both are printed literally and have no effect.
"""

from __future__ import annotations

import codecs
import os
import sys
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast

from rich.console import Console, ConsoleDimensions
from rich.markup import escape
from rich.text import Text

# Width of output to a file or pipe, in columns: tables are as wide as they need to be.
UNBOUNDED = 10_000
# Control characters, invisible and direction-changing ones, halves of surrogate pairs, line and paragraph separators.
_UNFIT = {"Cc", "Cf", "Cs", "Zl", "Zp"}


def plain(text: object) -> str:
    r"""A text with every character that a terminal might obey written out: ESC as ``\x1b``. Lines stay lines."""
    written = str(text)
    if written.isprintable():
        return written
    return "".join(
        c if c == "\n" or unicodedata.category(c) not in _UNFIT else c.encode("unicode_escape").decode("ascii")
        for c in written
    )


def escaped(text: object) -> str:
    """A text for a place where rich reads markup: as :func:`plain`, and ``[red]`` stays ``[red]``."""
    return escape(plain(text))


def escaped_line(text: object) -> str:
    r"""As :func:`escaped`, of a name or a sentence: a line break stays in the line, as ``\n``."""
    return escape(plain(text).replace("\n", "\\n"))


class Terminal(Console):
    """A console that prints control characters in escaped form, also in texts of other libraries.

    Markup is interpreted if the console is set up to: texts that are inserted into markup need :func:`escaped`.
    """

    @property
    def unbounded(self) -> bool:
        """A file or a pipe, of which nobody has said how wide it is."""
        return not self.is_terminal and self._width is None

    @property
    def size(self) -> ConsoleDimensions:
        """That of the terminal or of COLUMNS; without either lines end where they end."""
        return ConsoleDimensions(UNBOUNDED, super().size.height) if self.unbounded else super().size

    @size.setter
    def size(self, new_size: tuple[int, int]) -> None:
        self._width, self._height = new_size

    def render_str(self, text: str, **options: Any) -> Text:
        """Cells, titles and prints all come by here."""
        return super().render_str(plain(text), **options)


# Standard output and error whose failures do not end a run: closed pipes, full disks, ASCII terminals.


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
