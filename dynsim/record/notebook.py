"""HTML tables by which notebooks display objects."""

from __future__ import annotations

import html
from collections.abc import Iterable


def table(title: str, rows: Iterable[tuple[object, ...]], more: str = "") -> str:
    """HTML of a table with its title; the first cell of a row names it. ``more`` follows as it is."""
    lines = "".join(
        f'<tr><th style="text-align:left">{html.escape(str(first))}</th>'
        + "".join(f'<td style="text-align:left">{html.escape(str(cell))}</td>' for cell in cells)
        + "</tr>"
        for first, *cells in rows
    )
    return f"<div><b>{html.escape(title)}</b><table>{lines}</table>{more}</div>"
