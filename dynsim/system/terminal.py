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
    r"""Return a text in which control characters are written out (ESC as ``\x1b``); line breaks are kept."""
    written = str(text)
    if written.isprintable():
        return written
    return "".join(
        c if c == "\n" or unicodedata.category(c) not in _UNFIT else c.encode("unicode_escape").decode("ascii")
        for c in written
    )


def escaped(text: object) -> str:
    """Return a text for use where rich reads markup: as :func:`plain`, and ``[red]`` is printed literally."""
    return escape(plain(text))


def escaped_line(text: object) -> str:
    r"""Return :func:`escaped` of a name or a sentence, with line breaks written as ``\n``."""
    return escape(plain(text).replace("\n", "\\n"))


class Terminal(Console):
    """Console that prints control characters in escaped form, also in texts of other libraries.

    Markup is interpreted if the console is set up to: texts inserted into markup need :func:`escaped`.
    """

    @property
    def unbounded(self) -> bool:
        """Whether the output is a file or a pipe of unknown width."""
        return not self.is_terminal and self._width is None

    @property
    def size(self) -> ConsoleDimensions:
        """Size of the terminal, or from COLUMNS; without either, lines are not wrapped."""
        return ConsoleDimensions(UNBOUNDED, super().size.height) if self.unbounded else super().size

    @size.setter
    def size(self, new_size: tuple[int, int]) -> None:
        self._width, self._height = new_size

    def render_str(self, text: str, **options: Any) -> Text:
        """Render text without control characters; cells, titles and prints all pass through here."""
        return super().render_str(plain(text), **options)


# Standard output and error whose failures (closed pipes, full disks, ASCII terminals) do not end a run.


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
    """Text stream that discards its output after its first failure, stored in ``failure``."""

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
        # The content of its buffer would fail again when Python ends.
        with suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def reserve_descriptors() -> None:
    """Redirect the descriptors of closed standard streams to the null device.

    Otherwise the next files opened would get them, and the output of a library would go to a record, or to the servos.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            # The system assigns the lowest free descriptor.
            os.open(os.devnull, os.O_RDWR)


@contextmanager
def lenient_streams() -> Iterator[LenientStream | None]:
    """Make standard output and error lenient within the block; yield standard output, or None if it is closed."""
    reserve_descriptors()
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
    """Write characters that the stream's encoding lacks as plain letters."""
    if not hasattr(stream, "reconfigure"):
        yield
        return
    before = stream.errors
    stream.reconfigure(errors="dynsim.plain")
    try:
        yield
    finally:
        # Fails only if a stream cannot be flushed.
        with suppress(OSError, ValueError):
            stream.reconfigure(errors=before)
