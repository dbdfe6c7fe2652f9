"""Summaries and comparisons of runs on at most one screen: rows, columns and warnings are folded until they fit."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from difflib import SequenceMatcher

from rich.cells import cell_len
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from dynsim.cli import screen
from dynsim.cli.tables import Summary, SummaryRow, rows_of, warning_text
from dynsim.errors import first_few
from dynsim.system.terminal import escaped_line

# Rows that are printed first if not all fit on the screen: keys, or headings of rows of contacts.
_CHIEF = (
    "electrical_energy_J", "hand_error_rms_m", "final_position_error_m", "final_attitude_error_rad", "worst_joint",
    "base.tip_margin_min_settled", "base.overturns_settled_at_s", "sinking", "force, max [N]", "touched",
    "hand_error_max_m",
    "position_error_max_m", "attitude_error_max_rad", "joint_limit_violation_max_rad", "cost_final", "mode_switches",
    "base.wheel_load_min_N", "pulling [% of time]", "lift-offs, landings", "torque", "joule_heat_J", "friction_heat_J",
    "closed [% of time]", "sticking [% of time]", "energy_residual_relative",
)  # fmt: skip
# Maximum part of the screen for grouped warnings, and their minimum number.
_WARNINGS, _LEAST = 0.3, 3
# Lines of title, headings and notes of a table with a line for each variant.
_HEADER = 14
# Fraction of equal words above which two warnings are of the same kind.
_ALIKE = 0.5
# Words with numbers, and names with digits or underscores.
_NUMBERED = re.compile(r"\S*[\d_]\S*")
# Maximum number of variants that a warning names.
_NAMED = 3
_HIDDEN = "whole warnings: --rows all"


def print_summary(console: Console, summary: Summary, every: bool = False) -> None:
    """Print the numbers, contacts and warnings of one run, on at most one screen unless ``every`` row is wanted."""
    _print(console, f"{summary['scenario']} {summary['variant']}".strip(), {"": summary}, every)


def print_comparison(
    console: Console, summaries: Mapping[str, Summary], every: bool = False, failed: Sequence[str] = ()
) -> None:
    """Print the summaries of variants side by side, on at most one screen unless ``every`` row is wanted.

    Rows that are equal in all variants become one line. As long as the result is longer than the screen, warnings of
    the same kind are grouped, then contacts and joints whose names differ only in a number are folded, and finally only
    the most important rows are printed, with one line per variant if the variants do not fit side by side. Variants
    that ``failed`` are listed below the table.
    """
    _print(console, next(iter(summaries.values()))["scenario"], summaries, every, failed)


def _print(
    console: Console, title: str, summaries: Mapping[str, Summary], every: bool, failed: Sequence[str] = ()
) -> None:
    names, runs = list(summaries), list(summaries.values())
    rows, warnings = rows_of(runs), _warnings(summaries)
    missing = [f"failed, not in the table: {escaped_line(first_few(failed))}"] if failed else []
    kind = "completed variants" if failed else "variants"
    if every:
        screen.show(console, [*_side_by_side(title, names, rows, console.width), *missing, *warnings])
        return
    width, height = screen.size(console)
    folded = rows_of(runs, folded=True)
    texts = {name: summary.get("warnings", ()) for name, summary in summaries.items()}
    grouped = grouped_warnings(texts, runs=kind)
    # In a file or a pipe, no text is cut.
    pipe = screen.is_unbounded(console)
    short = grouped if pipe else grouped_warnings(texts, width, kind)
    hidden = [_HIDDEN] * (len(warnings) > len(grouped))
    cut = [_HIDDEN] * (short != grouped or bool(hidden))
    forms = ((rows, warnings), *((r, [*w, *h]) for r in (rows, folded) for w, h in ((grouped, hidden), (short, cut))))
    parts: list[RenderableType]
    for shown, lines in forms:
        different, equal = _without_equal(shown, kind)
        tables = _side_by_side(title, names, different, width)
        parts = [*tables, *equal, *missing, *lines]
        # Do not render long tables to count their lines.
        if sum(table.row_count for table in tables) < height and screen.lines(console, parts) <= height:
            screen.show(console, parts)
            return
    # The rows of contacts would make this line too long.
    equal = _without_equal([row for row in folded if not row.owner], kind)[1]
    most = max(_LEAST, min(int(_WARNINGS * height), height - len(names) - _HEADER))
    short = short if pipe else limited_warnings(short, most)
    parts = [
        *equal,
        *missing,
        "other rows and whole warnings: --rows all; all numbers: comparison.csv or summary.json",
        *short,
    ]
    table = _chief(console, title, names, different, width, height - screen.lines(console, parts))
    screen.show(console, [table, *parts])


def _without_equal(rows: Sequence[SummaryRow], kind: str) -> tuple[list[SummaryRow], list[str]]:
    """Return the rows that differ between variants, and a line with all others, if there are several variants."""
    equal = [row for row in rows if len(row.cells) > 1 and len(set(row.cells)) == 1]
    texts = []
    for row in equal:
        name, _, unit = row.label.partition(" [")
        texts.append(f"{escaped_line(name)} {row.cells[0]} {escaped_line(unit.removesuffix(']'))}".strip())
    return [row for row in rows if row not in equal], [f"equal in all {kind}: {'; '.join(texts)}"] if equal else []


def _side_by_side(title: str, names: Sequence[str], rows: Sequence[SummaryRow], width: int) -> list[Table]:
    """Return a table with a column per variant, or several tables if the columns do not fit into the width."""
    if not rows:
        return [screen.new_table(title)]
    headings = [
        f"  {row.heading}" if row.owner and k and rows[k - 1].owner == row.owner else row.label
        for k, row in enumerate(rows)
    ]
    room = width - max(map(cell_len, ["", *headings])) - screen.EDGES
    blocks: list[list[int]] = []
    left = 0
    for k, name in enumerate(names):
        across = max(map(screen.cell_width, [escaped_line(name), *(row.cells[k] for row in rows)])) + screen.PADDING
        if not blocks or left < across:
            blocks.append([])
            left = room
        blocks[-1].append(k)
        left -= across
    tables = []
    for block in blocks:
        tables.append(table := screen.new_table(title, show_header=any(names)))
        table.add_column("", no_wrap=True)
        for k in block:
            table.add_column(escaped_line(names[k]), justify="right", no_wrap=True)
        for heading, row in zip(headings, rows, strict=True):
            table.add_row(escaped_line(heading), *(row.cells[k] for k in block))
    return tables


def _chief(
    console: Console, title: str, names: Sequence[str], rows: Sequence[SummaryRow], width: int, height: int
) -> Table:
    """Return a table of the most important rows; one line per variant if the variants do not fit side by side."""
    ranked = sorted(rows, key=lambda row: _CHIEF.index(row.key) if row.key in _CHIEF else len(_CHIEF))
    for count in range(len(ranked), 0, -1):
        tables = _side_by_side(title, names, [row for row in rows if row in ranked[:count]], width)
        if len(tables) == 1 and screen.lines(console, tables) <= height:
            return tables[0]
    columns = [("variant", [*map(escaped_line, names)]), *((escaped_line(row.label), row.cells) for row in ranked)]
    return screen.listing(console, title, columns, height)


def _warnings(summaries: Mapping[str, Summary]) -> list[str]:
    """Return all warnings; equal warnings of several variants are one."""
    variants: dict[str, list[str]] = {}
    for name, summary in summaries.items():
        for warning in dict.fromkeys(summary.get("warnings", ())):
            variants.setdefault(warning, []).append(name)
    return [warning_text(warning, ", ".join(names)) for warning, names in variants.items()]


def grouped_warnings(
    warnings: Mapping[str, Sequence[str]], width: int | None = None, runs: str = "variants"
) -> list[str]:
    """Return a warning of each kind, the most frequent kind first, with its runs and the number of such warnings.

    Parameters
    ----------
    warnings : mapping of str to sequence of str
        Names of the runs, and their warnings.
    width : int, optional
        Number of characters to which each line is cut; default: whole lines.
    runs : str, optional
        Plural noun for the runs.
    """
    groups: list[list[tuple[str, str]]] = []
    known: dict[str, list[tuple[str, str]]] = {}
    for name, text in ((name, text) for name, own in warnings.items() for text in own):
        words = _NUMBERED.sub("", text)
        if words not in known:
            group = next((group for group in groups if _alike(words, _NUMBERED.sub("", group[0][1]))), None)
            if group is None:
                groups.append(group := [])
            known[words] = group
        known[words].append((name, text))
    lines = []
    for group in sorted(groups, key=lambda group: -len({name for name, _ in group})):
        names = list(dict.fromkeys(name for name, _ in group))
        several = f"{len(names)} of {len(warnings)} {runs}" if len(names) > _NAMED else ", ".join(names)
        times = f" (the first of {len(group)})" if len(group) > 1 else ""
        line = Text.from_markup(warning_text(group[0][1], several))
        if width is not None:
            line.truncate(width - len(times), overflow="ellipsis")
        lines.append(line.markup + times)
    return lines


def limited_warnings(lines: Sequence[str], most: int) -> list[str]:
    """Return at most so many lines of grouped warnings."""
    more = len(lines) - most + 1
    return [*lines] if more < 2 else [*lines[: most - 1], f"… and {more} more kinds of warnings"]


def _alike(first: str, second: str) -> bool:
    """Return whether two warnings without numbers are equal in most words."""
    return SequenceMatcher(None, first.split(), second.split()).ratio() > _ALIKE
