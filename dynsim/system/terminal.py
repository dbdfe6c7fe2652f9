"""A rich console that prints text from files safely, and standard streams that tolerate failed writes.

A name in a scenario, a record or a servo map may contain rich markup, or escape sequences, which move the cursor,
change colours or rename the window. Both are printed literally and have no effect.
"""

from __future__ import annotations

import codecs
import os
import re
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
# Size of a printed message: characters per line, and lines.
LINE_MAX, LINES_MAX = 2000, 100
# Unicode categories of characters that are escaped: control characters, invisible and direction-changing characters,
# halves of surrogate pairs, line separators and paragraph separators.
_UNFIT = {"Cc", "Cf", "Cs", "Zl", "Zp"}


def plain(text: object) -> str:
    r"""Return the text with control characters escaped (ESC is written as ``\x1b``); line breaks are kept."""
    written = str(text)
    if written.isprintable():
        return written
    return "".join(
        c if c == "\n" or unicodedata.category(c) not in _UNFIT else c.encode("unicode_escape").decode("ascii")
        for c in written
    )


def shortened(text: object) -> str:
    """Return a message without the middle of very long lines and at most :data:`LINES_MAX` lines."""
    lines = str(text).split("\n")
    kept = [
        line if len(line) <= LINE_MAX else f"{line[: LINE_MAX - 300]} … {line[-300:]}" for line in lines[:LINES_MAX]
    ]
    return "\n".join(kept + [f"  and {len(lines) - LINES_MAX} more lines"] * (len(lines) > LINES_MAX))


def escaped(text: object) -> str:
    """Return text that can be inserted into rich markup: as :func:`plain`, with ``[red]`` printed literally."""
    return escape(plain(text))


def escaped_line(text: object) -> str:
    r"""Return a name or a sentence escaped as by :func:`escaped`, with line breaks written as ``\n``."""
    return escape(plain(text).replace("\n", "\\n"))


def escaped_problem(text: object) -> str:
    r"""Return an error escaped as by :func:`escaped` and :func:`shortened`; line breaks in it are written as ``\n``.

    The lines of an error after the first are indented; other line breaks are part of a name or an option.
    """
    return escape(shortened(re.sub(r"\n(?!  )", r"\\n", plain(text))))


class Terminal(Console):
    """Console that prints control characters in escaped form, even in text from other libraries.

    If the console interprets markup, text that is inserted into markup must be passed through :func:`escaped` first.
    """

    @property
    def unbounded(self) -> bool:
        """Whether the output is a file or a pipe of unknown width."""
        return not self.is_terminal and self._width is None

    @property
    def size(self) -> ConsoleDimensions:
        """Size of the terminal, or the size set by COLUMNS; without either, lines are not wrapped."""
        return ConsoleDimensions(UNBOUNDED, super().size.height) if self.unbounded else super().size

    @size.setter
    def size(self, new_size: tuple[int, int]) -> None:
        self._width, self._height = new_size

    def render_str(self, text: str, **options: Any) -> Text:
        """Render text without control characters; all table cells, titles and printed texts pass through here."""
        return super().render_str(plain(text), **options)


# Standard streams for which a failed write (closed pipe, full disk, ASCII terminal) does not end a run.


# Replacements of characters that dynsim prints, for encodings that lack them; all other characters become "?".
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
        # Redirect the stream to the null device: writing the rest of its buffer would fail again when Python exits.
        with suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def reserve_descriptors() -> None:
    """Redirect the descriptors of closed standard streams to the null device.

    Otherwise the next files to be opened would receive these descriptors, and output printed by a library would be
    written to a record or sent to the servos.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            # The system assigns the lowest free descriptor, which is the closed one.
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
    """Within the block, replace characters that the stream's encoding lacks by ASCII characters."""
    if not hasattr(stream, "reconfigure"):
        yield
        return
    before = stream.errors
    stream.reconfigure(errors="dynsim.plain")
    try:
        yield
    finally:
        # This fails only if the stream cannot be flushed.
        with suppress(OSError, ValueError):
            stream.reconfigure(errors=before)
