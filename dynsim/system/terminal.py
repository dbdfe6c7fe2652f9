"""A terminal of rich, and texts from files made safe to print on it.

A name in a scenario, a record or a servo map may contain escape sequences, which move the cursor, change colours or
rename the window, and the markup of rich. Both are printed literally and have no effect.
"""

from __future__ import annotations

import unicodedata
from typing import Any

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
