"""Names from files on a terminal: control characters are shown as escapes, never sent."""

import io

import pytest
from rich.table import Table
from support.messages import lines_with

from dynsim.cli.comparison import print_comparison, print_summary
from dynsim.system.terminal import Terminal, escaped, escaped_line, plain, shortened

EVIL = "a\x1b]0;title\x07[red]b[/red][link=http://x]c[/link]\x9b2Jd\u202ee\x00\r\ud800\\"
SHOWN = r"a\x1b]0;title\x07[red]b[/red][link=http://x]c[/link]\x9b2Jd\u202ee\x00\r\ud800" + "\\"


def test_what_a_terminal_would_obey_is_written_out():
    assert plain(EVIL) == SHOWN
    assert plain("two\nlines, ü, 日本, 1 000\u00a0J, −2 °C, π") == "two\nlines, ü, 日本, 1 000\u00a0J, −2 °C, π"
    assert escaped_line("two\nlines") == r"two\nlines"


@pytest.mark.parametrize("colours", [False, True])
def test_a_terminal_shows_texts_as_they_are_written(colours: bool):
    output = io.StringIO()
    terminal = Terminal(file=output, force_terminal=colours, width=300, emoji=False, highlight=False, color_system=None)
    terminal.print(f"[red]error:[/] {escaped(EVIL)}", soft_wrap=True)
    table = Table(title=escaped_line(EVIL))
    table.add_column(escaped_line(EVIL))
    table.add_row(escaped_line(EVIL))
    terminal.print(table)
    # One who forgets to escape gets markup, but no escape sequences.
    terminal.print("\x1b[31m\x9b2J[bold]x[/]")
    shown = output.getvalue()
    assert shown.count(SHOWN) == 4
    assert all(c == "\n" or c.isprintable() for c in shown)


def test_a_brace_that_pulls_for_a_moment_is_not_said_to_pull_never():
    contact = {
        "name": "elbow", "normal_force_mean_N": 1.0, "normal_force_min_N": -9.26, "normal_force_max_N": 1.0,
        "pulling_fraction": 2e-4, "closed_fraction": 1.0,
    }  # fmt: skip
    output = io.StringIO()
    summary = {"scenario": "a", "variant": "", "electrical_energy_J": 1.0, "warnings": [], "contacts": [contact]}
    print_summary(Terminal(file=output, width=300), summary)
    assert len(lines_with(output.getvalue(), "0.02")) == 1


def test_tables_show_names_as_they_are_written():
    contact = {
        "name": EVIL, "normal_force_mean_N": 1.0, "normal_force_min_N": 1.0, "normal_force_max_N": 1.0,
        "pulling_fraction": 0.5, "closed_fraction": 1.0,
    }  # fmt: skip
    summary = {"scenario": EVIL, "variant": EVIL, "electrical_energy_J": 1.0, "warnings": [EVIL], "contacts": [contact]}
    for show in (lambda t: print_summary(t, summary), lambda t: print_comparison(t, {EVIL: summary})):
        output = io.StringIO()
        show(Terminal(file=output, width=300, emoji=False))
        assert output.getvalue().count(SHOWN) >= 4
        assert all(c == "\n" or c.isprintable() for c in output.getvalue())


def test_grouped_warnings_show_names_as_they_are_written():
    warnings = [f"{EVIL}: slips for {k} % of the run, and so on for a whole line of text" for k in range(60)]
    output = io.StringIO()
    print_summary(Terminal(file=output, width=300, emoji=False), {"scenario": "a", "variant": "", "warnings": warnings})
    (line,) = lines_with(output.getvalue(), "the first of 60")
    assert line.startswith(f"warning: {SHOWN}: slips for 0 %")
    assert all(c == "\n" or c.isprintable() for c in output.getvalue())


def test_messages_have_a_limited_size():
    assert shortened("short\nlines") == "short\nlines"
    lines = shortened("\n".join(["beginning " + "x" * 10**6 + " end"] * 1000)).split("\n")
    assert len(lines) == 101
    assert lines[-1] == "  and 900 more lines"
    assert all(len(line) < 2010 and line.startswith("beginning") and line.endswith("end") for line in lines[:-1])
