"""Size of the screen on which a command prints, and the lines that tables and texts need on it."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console, RenderableType

from dynsim.system.terminal import Terminal

# Size of a screen whose size is unknown; also the minimum height [lines].
COLUMNS, LINES = 120, 40
# Lines that follow a table: the paths of results and of the page.
AFTER = 2


def size(console: Console) -> tuple[int, int]:
    """Return the columns and lines that a table may use: those of the terminal, with at least 40 lines."""
    unbounded = isinstance(console, Terminal) and console.unbounded
    height = max(LINES, console.height if console.is_terminal else 0)
    return COLUMNS if unbounded else console.width, height - AFTER


def lines(console: Console, parts: Sequence[RenderableType]) -> int:
    """Return the number of lines that the parts need on the screen."""
    options = console.options.update(width=size(console)[0])
    return sum(len(console.render_lines(part, options, pad=False)) for part in parts)


def show(console: Console, parts: Sequence[RenderableType]) -> None:
    """Print the parts one below the other."""
    for part in parts:
        console.print(part, highlight=False)
