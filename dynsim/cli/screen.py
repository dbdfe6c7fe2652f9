"""Size of the screen on which a command prints, and tables that fit on it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from textwrap import wrap
from typing import Any

from rich import box
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from dynsim.system.terminal import Terminal, escaped_line

# Size of a screen whose size is unknown; also the minimum height [lines].
COLUMNS, LINES = 120, 40
# Lines that follow a table: the paths of results and of the page.
AFTER = 2
# Space between the columns of a table, and at its edges [characters].
PADDING, EDGES = 3, 4


def is_unbounded(console: Console) -> bool:
    """Return whether the output is a file or a pipe of unknown width."""
    return isinstance(console, Terminal) and console.unbounded


def size(console: Console) -> tuple[int, int]:
    """Return the columns and lines that a table may use: those of the terminal, with at least 40 lines."""
    height = max(LINES, console.height if console.is_terminal else 0)
    return COLUMNS if is_unbounded(console) else console.width, height - AFTER


def lines(console: Console, parts: Sequence[RenderableType]) -> int:
    """Return the number of lines that the parts need on the screen."""
    options = console.options.update(width=size(console)[0])
    return sum(len(console.render_lines(part, options, pad=False)) for part in parts)


def show(console: Console, parts: Sequence[RenderableType]) -> None:
    """Print the parts one below the other."""
    for part in parts:
        console.print(part, highlight=False)


@cache
def cell_width(cell: str) -> int:
    """Return the width of a text with markup."""
    return Text.from_markup(cell).cell_len


def new_table(title: object, **options: Any) -> Table:
    """Return an empty table without vertical lines."""
    return Table(title=escaped_line(title), title_justify="left", **{"box": box.SIMPLE_HEAD, **options})


def _wide(heading: str, least: int, high: int) -> int:
    """Return the width with which a heading has at most ``high`` lines, at least ``least``."""
    text = Text.from_markup(heading).plain
    widths = range(least, len(text))
    return next((w for w in widths if len(wrap(text, w, break_on_hyphens=False)) <= high), max(least, len(text)))


def listing(console: Console, title: object, columns: Sequence[tuple[str, Sequence[str]]], height: int) -> Table:
    """Return a table of the first columns that fit into the width of the screen, and the first rows that fit.

    Parameters
    ----------
    console : Console
        Console on which the table will be printed.
    title : str
        Title of the table.
    columns : sequence of tuple
        Heading, which is wrapped, and cells of each column, with markup; the first column has the names of the rows.
    height : int
        Maximum number of lines of the table; at least one row is shown.
    """
    count = len(columns[0][1])
    table = new_table(title)
    shown: list[tuple[str, Sequence[str], int]] = []
    left = size(console)[0] - EDGES + PADDING
    for k, (heading, cells) in enumerate(columns):
        names = [f"… and {count} more"] if k == 0 else []
        width = max(map(cell_width, [*names, *cells, *heading.split()]))
        if k == 0 or width + PADDING <= left:
            left -= width + PADDING
            shown.append((heading, cells, width))
    # Headings have as few lines as the width allows.
    most = max(cell_width(heading) for heading, _, _ in shown)
    high = next(n for n in range(1, most + 1) if sum(_wide(h, w, n) - w for h, _, w in shown) <= left or n == most)
    for k, (heading, _, width) in enumerate(shown):
        table.add_column(heading, justify="right" if k else "left", width=_wide(heading, width, high))
    room = height - lines(console, [table])
    fitting = count if count <= room else max(room - 1, 1)
    for k in range(fitting):
        table.add_row(*(cells[k] for _, cells, _ in shown))
    if fitting < count:
        table.add_row(f"… and {count - fitting} more")
    return table
