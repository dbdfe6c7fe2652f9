"""Terminal output: tables of summaries, comparisons, start positions and plans; lists, messages and progress bars."""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.table import Table

from dynsim.errors import RecordError
from dynsim.system.terminal import Terminal, escaped, escaped_line, escaped_problem, plain

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.progress import Progress, ProgressColumn, TaskID
    from rich.status import Status

    from dynsim.engine import Start
    from dynsim.engine.compilation import Compilation
    from dynsim.planner.answer import BracePlan, Size
    from dynsim.record import Record
    from dynsim.scenario import Scenario
    from dynsim.studies.compare import VariantProgress

Summary = Mapping[str, Any]

# Width of the longest row heading.
_HEADING_WIDTH = 30
# Energies below this fraction of the energy turnover, and coordinates below this value [m], count as rounding errors.
ROUNDING = 1e-12


def _format(value: float, form: str) -> str:
    """Format a number: zero as "0", and a number that is rounded to zero without a sign."""
    text = format(value, form)
    if value == 0.0:
        return "0"
    return text.removeprefix("-") if float(text) == 0.0 else text


def _number(value: Any, scale: float = 1.0, digits: int = 4) -> str:
    return "–" if value is None else _format(value * scale, f".{digits}g")


def _deepest(summary: Summary) -> str | None:
    """Return the largest depth of a body below a surface [mm], or None if no body was below one."""
    sunk = max(summary.get("sinking", ()), key=lambda entry: entry["depth_m"], default=None)
    return None if sunk is None else f"[bold red]{_number(sunk['depth_m'], 1e3, 3)}[/]"


def _base(key: str) -> Callable[[Summary], Any]:
    """Return a function that reads a number about the mobile base from a summary (None if there is no base)."""
    return lambda summary: summary.get("base", {}).get(key)


def _margin(value: float) -> str:
    return f"[bold red]{value:.3g}[/]" if value < 0.0 else f"{value:.3g}"


def _least_load(summary: Summary) -> float | None:
    loads = _base("wheel_load_min_N")(summary)
    return None if loads is None else min(loads.values())


def _energy(key: str) -> Callable[[Summary], float | None]:
    """Return a function that reads an energy from a summary [J]; 0 if it is only rounding error of the turnover."""

    def take(summary: Summary) -> float | None:
        energy: float | None = summary.get(key)
        return 0.0 if energy and abs(energy) <= ROUNDING * summary.get("energy_turnover_J", 0.0) else energy

    return take


def _cause(key: str) -> Callable[[Summary], str | None]:
    """Return a function that reads the main cause of a distance from a summary (None if unknown)."""
    return lambda summary: next((cause["cause"] for cause in summary.get(key, ())), None)


def _worst_joint(motor: Summary) -> str:
    """Return the name of a motor with its rms torque and nominal torque (stall torque if unknown)."""
    rating = motor.get("nominal_torque_N_m", motor.get("stall_torque_N_m", math.inf))
    return f"{escaped_line(motor['joint'])} {_loaded(motor['torque_rms_N_m'], rating)} of {rating:g}"


def _loaded(rms: float, nominal: float) -> str:
    return f"[bold red]{rms:.3g}[/]" if rms > nominal else f"{rms:.3g}"


def _short(value: Any) -> str:
    return _number(value, digits=3)


def _millimetres(value: Any) -> str:
    return _number(value, 1e3)


def _exponent(value: float) -> str:
    return _format(value, ".1e")


# Heading, key of the summary or function that reads the value from it, and format. A row without values is omitted.
_ROWS: tuple[tuple[str, str | Callable[[Summary], Any], Callable[[Any], str]], ...] = (
    ("electrical energy [J]", _energy("electrical_energy_J"), _number),
    ("  from one supply [J]", _energy("electrical_energy_supply_J"), _number),
    ("  from separate supplies [J]", _energy("electrical_energy_drawn_J"), _number),
    ("battery energy [Wh]", "battery_energy_Wh", _short),
    ("worst joint, rms torque [N m]", "worst_joint", _worst_joint),
    ("mechanical work [J]", _energy("mechanical_work_J"), _number),
    ("Joule heat [J]", _energy("joule_heat_J"), _number),
    ("friction heat [J]", _energy("friction_heat_J"), _number),
    ("impact loss, all contacts [J]", _energy("impact_loss_J"), _number),
    ("stop loss [J]", lambda s: s.get("stop_loss_J") or None, _number),
    ("loss of time stepping [J]", _energy("scheme_loss_J"), _number),
    ("hand error, rms [mm]", "hand_error_rms_m", _millimetres),
    ("  max [mm]", "hand_error_max_m", _millimetres),
    ("  vertical, rms [mm]", "hand_error_z_rms_m", _millimetres),
    ("  at the start [mm]", "hand_error_start_m", _millimetres),
    ("  at the end [mm]", "hand_error_end_m", _millimetres),
    ("  main cause at the end", _cause("hand_error_causes"), str),
    ("initial position error [m]", "initial_position_error_m", _short),
    ("final position error [m]", "final_position_error_m", _short),
    ("  main cause", _cause("final_position_error_causes"), str),
    ("final attitude error [rad]", "final_attitude_error_rad", _short),
    ("position error, max [m]", "position_error_max_m", _short),
    ("attitude error, max [rad]", "attitude_error_max_rad", _short),
    ("joint limit exceeded by [rad]", "joint_limit_violation_max_rad", _short),
    ("cost, initial", "cost_initial", _number),
    ("cost, final", "cost_final", _number),
    ("mode switches", "mode_switches", str),
    ("deepest below a surface [mm]", _deepest, str),
    ("tip margin, settled", _base("tip_margin_min_settled"), _margin),
    ("  whole run", _base("tip_margin_min"), _margin),
    ("  tips over at [s]", _base("overturns_settled_at_s"), _short),
    ("min load, wheels, caster [N]", _least_load, _short),
    ("ledger residual, relative", "energy_residual_relative", _exponent),
    ("constraint drift [m]", "constraint_drift_max_m", _exponent),
    ("integration method", "method", str),
    ("integration [s]", "integration_wall_s", lambda v: f"{v:.3f}"),
    ("speed, times real time", "real_time_factor", lambda v: f"{v:.0f}"),
)


def print_summary(console: Console, summary: Summary) -> None:
    """Print the numbers, contacts and warnings of one run."""
    table = _table(f"{summary['scenario']} {summary['variant']}".strip(), show_header=False)
    table.add_column()
    table.add_column(justify="right")
    for heading, cells in _rows([summary], [summary]):
        table.add_row(heading, *cells)
    console.print(table)
    _print_warnings(console, {"": summary})


def print_comparison(console: Console, summaries: Mapping[str, Summary]) -> None:
    """Print all variants side by side, one column per variant; use several tables if the terminal is too narrow."""
    names, everything = list(summaries), list(summaries.values())
    # "wheel2R 3.17 of 1.68" is the widest cell; most tables do not have this row.
    cell = max([20 if any(s.get("worst_joint") for s in everything) else 10, *map(len, names)]) + 2
    across = max(1, (console.width - _HEADING_WIDTH) // cell)
    for start in range(0, len(names), across):
        table = _table(everything[0]["scenario"])
        table.add_column("", no_wrap=True)
        for name in names[start : start + across]:
            table.add_column(escaped_line(name), justify="right", no_wrap=True)
        for heading, cells in _rows(everything, everything[start : start + across], compared=True):
            table.add_row(heading, *cells)
        console.print(table)
    _print_warnings(console, summaries)


def _table(title: object, **options: Any) -> Table:
    """Return an empty table without vertical lines."""
    return Table(title=escaped_line(title), title_justify="left", **{"box": box.SIMPLE_HEAD, **options})


def _value(summary: Summary, source: str | Callable[[Summary], Any]) -> Any:
    return summary.get(source) if isinstance(source, str) else source(summary)


def _rows(
    summaries: Sequence[Summary], shown: Sequence[Summary], compared: bool = False
) -> Iterator[tuple[str, list[str]]]:
    """Yield the rows that any run has, with a cell for each run shown; if ``compared``, also ratios of energies."""
    for heading, source, show in _ROWS:
        if any(_value(summary, source) is not None for summary in summaries):
            values = [_value(summary, source) for summary in shown]
            yield escaped_line(heading), ["–" if value is None else show(value) for value in values]
    least = min(summary.get("electrical_energy_J") or 0.0 for summary in summaries)
    if compared and least > 0.0:
        yield "energy, times the minimum", [f"{summary['electrical_energy_J'] / least:.3g}" for summary in shown]
    contacts = [{contact["name"]: contact for contact in summary.get("contacts", ())} for summary in shown]
    for name in dict.fromkeys(contact["name"] for s in summaries for contact in s.get("contacts", ())):
        yield from _contact_rows(name, [by_name.get(name) for by_name in contacts])
    yield from _stop_rows(summaries, shown)
    yield from _motor_rows(summaries, shown)


def print_choices(console: Terminal) -> None:
    """Print all shipped scenarios, plants, surfaces, controllers, paths and motors, each with a short description."""
    from dynsim.library.families import FAMILIES, member, members
    from dynsim.scenario import load_scenario, shipped_scenarios, variant_names

    scenarios = []
    for path in shipped_scenarios():
        description = load_scenario(path).config.description
        sentence = re.split(r"(?<!et al)\.\s", description, maxsplit=1)[0].strip().removesuffix(".")
        scenarios.append((path.stem, ", ".join(variant_names(path)), sentence))
    _print_choice(console, "scenarios", scenarios, ("name", "variants", "description"))
    for family in FAMILIES:
        firsts = [(name, (member(family, name).__doc__ or "").strip().partition("\n")[0]) for name in members(family)]
        _print_choice(console, f"{family}s", firsts)


def _print_choice(
    console: Terminal, title: str, rows: Sequence[tuple[str, ...]], headings: tuple[str, ...] = ()
) -> None:
    """Print a table to a terminal, or tab-separated lines to a file or pipe, for use by other programs."""
    if console.unbounded:
        lines = ["\t".join(plain(cell).replace("\n", "\\n") for cell in row) for row in [(title,), *rows, ()]]
        # Do not print through the console, which would expand the tabs.
        print("\n".join(lines), file=console.file)
        return
    table = _table(title, show_header=bool(headings))
    for k, heading in enumerate(headings):
        table.add_column(heading, no_wrap=k == 0)
    for row in rows:
        table.add_row(*map(escaped_line, row))
    console.print(table)


def print_starts(console: Console, starts: Mapping[str, Start]) -> None:
    """Print the start positions of the hand and contact points [m] of each variant, as YAML lists in full precision.

    Also print the contact gaps, the joints that `initial` moved, and the tip margin of a mobile base at rest.
    """
    for variant, start in starts.items():
        values = {"hand": f"{_coordinates(start.hand)}"}
        values |= {f"contact {name}": f"{_coordinates(point)}" for name, point in start.contacts.items()}
        values |= {f"gap of {name}": f"{gap:+.4g} m" for name, gap in start.gaps.items()}
        for joint, (to, was, unit) in start.solved.items():
            values[joint] = f"{to!r} {unit}, set by `initial`; was {was:.6g}"
        for joint, (at, unit) in start.nearest.items():
            values[joint] = f"{at!r} {unit}, the legal position nearest to 0, because none is set"
        if start.tip_margin is not None:
            braced = ""
            if start.tip_margin_braced is not None:
                braced = f", {start.tip_margin_braced:.4g} with brace forces of least heat"
            values["tip margin"] = f"{start.tip_margin:.4g} at rest{braced} (1: safest, 0: tips)"
        if start.off_path is not None:
            away = "at the hand" if start.off_path < 1e-9 else f"{start.off_path:.4g} m from the hand"
            values["hand path"] = f"starts {away}"
        width = max(map(len, values))
        lines = [f"  {variant}{', ' if variant else ''}at the start [m]:"]
        lines += [f"    {name:<{width}}  {value}" for name, value in values.items()]
        if start.aloft:
            lines += [f"    some contact points are not on their surfaces; to put them there, use  {start.aloft}"]
        console.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)
        _print_warnings(console, {variant: {"warnings": start.warnings}})


def _coordinates(point: NDArray[np.float64]) -> list[float]:
    """Return coordinates [m] that are read back as the same doubles; replace rounding errors around zero by 0.0."""
    return [0.0 if abs(x) <= ROUNDING else x for x in point.tolist()]


def _pulling(contact: Summary) -> str:
    from dynsim.record.measures import percent

    pulling = contact["pulling_fraction"]
    return f"[bold red]{percent(pulling).removesuffix(' %')}[/]" if pulling > 0.0 else "0"


def _percent(key: str) -> Callable[[Summary], str]:
    return lambda contact: f"{100.0 * contact[key]:.1f}" if 0.0 < contact[key] < 1.0 else f"{100.0 * contact[key]:.0f}"


def _is_unilateral(contact: Summary) -> bool:
    """Return whether the contact followed the unilateral law."""
    return "sticking_fraction" in contact


# Heading of each row, format, and the contact law for which it is printed: bilateral (False), unilateral (True) or both
# (None).
_CONTACT_ROWS: tuple[tuple[str, Callable[[Summary], str], bool | None], ...] = (
    ("force, mean [N]", lambda c: _format(c["normal_force_mean_N"], ".2f"), None),
    ("  min [N]", lambda c: _format(c["normal_force_min_N"], ".2f"), None),
    ("  max [N]", lambda c: _format(c["normal_force_max_N"], ".2f"), None),
    ("  pulling [% of time]", _pulling, False),
    ("  closed [% of time]", _percent("closed_fraction"), True),
    ("  sticking [% of time]", _percent("sticking_fraction"), True),
    ("  lift-offs, landings", lambda c: f"{c['lift_offs']}, {c['landings']}", True),
    ("  bounces, slip starts", lambda c: f"{c['bounces']}, {c['slip_starts']}", True),
    ("  loss at impacts [J]", lambda c: _number(c.get("impact_loss_J"), digits=3), True),
)


def _contact_rows(name: str, contacts: Sequence[Summary | None]) -> Iterator[tuple[str, list[str]]]:
    """Yield the table rows for one contact, with one cell per run; None stands for a run without this contact.

    A candidate contact that never closed has no rows; for a declared contact that never closed, the smallest gap is
    printed.
    """
    having = [contact for contact in contacts if contact]
    if not any(contact["closed_fraction"] > 0.0 or "gap_min_m" in contact for contact in having):
        return
    if not all(contact["closed_fraction"] > 0.0 for contact in having):
        cells = [_number(c.get("gap_min_m"), 1e3, 3) if c and not c["closed_fraction"] else "–" for c in contacts]
        yield escaped_line(_prefixed(name, "never touches, min gap [mm]")), cells
    if not any(contact["closed_fraction"] > 0.0 for contact in having):
        return
    for heading, show, real in _CONTACT_ROWS:
        if real is None or any(_is_unilateral(contact) == real for contact in having):
            cells = [show(c) if c and real in (None, _is_unilateral(c)) else "–" for c in contacts]
            yield escaped_line(_prefixed(name, heading)), cells


# Rows of a joint stop: heading and format.
_STOP_ROWS: tuple[tuple[str, Callable[[Summary], str]], ...] = (
    ("hits", lambda s: str(s["hits"])),
    ("  force, max [{force_unit}]", lambda s: _number(s["force_max"], digits=3)),
    ("  closed [% of time]", _percent("closed_fraction")),
    ("  loss at impacts [J]", lambda s: _number(s.get("impact_loss_J"), digits=3)),
)


def _stop_rows(summaries: Sequence[Summary], shown: Sequence[Summary]) -> Iterator[tuple[str, list[str]]]:
    """Yield the table rows for all joint stops that were hit in any run, with one cell for each run shown."""
    stops = {_stop(stop): stop for summary in summaries for stop in summary.get("joint_stops", ())}
    for key, stop in stops.items():
        cells = [{_stop(stop): stop for stop in summary.get("joint_stops", ())}.get(key) for summary in shown]
        joint, limit = key
        position = f"{math.degrees(limit):.4g}°" if stop["unit"] == "rad" else f"{limit:.4g} {stop['unit']}"
        for heading, show in _STOP_ROWS:
            text = _prefixed(f"{joint}, stop at {position}", heading.format(**stop))
            yield escaped_line(text), ["–" if stop is None else show(stop) for stop in cells]


def _motor_rows(summaries: Sequence[Summary], shown: Sequence[Summary]) -> Iterator[tuple[str, list[str]]]:
    """Yield the table rows for motors with known ratings, with one cell for each run shown: rms and nominal value.

    If there are many motors, only the most heavily loaded ones are shown.
    """
    for quantity, unit, label in _RATED:
        rms, nominal = f"{quantity}_rms_{unit}", f"nominal_{quantity}_{unit}"
        rated = [m for summary in summaries for m in summary.get("motors", ()) if m.get(nominal) and rms in m]
        load = {m["joint"]: 0.0 for m in rated}
        for motor in rated:
            load[motor["joint"]] = max(load[motor["joint"]], motor[rms] / motor[nominal])
        heaviest = sorted(load, key=lambda joint: -load[joint])[:_MOST_MOTORS]
        for joint in (joint for joint in load if joint in heaviest):
            motors: list[Summary] = [next((m for m in s.get("motors", ()) if m["joint"] == joint), {}) for s in shown]
            cells = [f"{_loaded(m[rms], m[nominal])} of {m[nominal]:g}" if m.get(nominal) else "–" for m in motors]
            yield escaped_line(f"{joint}: {label}"), cells


# Motor ratings: quantity and unit as in the keys of the summary, and label in the table.
_RATED = (
    ("current", "A", "rms of nominal [A]"),
    ("torque", "N_m", "rms of nominal [N m]"),
    ("force", "N", "rms of nominal [N]"),
)
_MOST_MOTORS = 10


def _stop(stop: Summary) -> tuple[str, float]:
    return stop["joint"], stop["limit"]


def _prefixed(contact: str, heading: str) -> str:
    return heading if heading.startswith(" ") else f"{contact}: {heading}"


def _print_warnings(console: Console, summaries: Mapping[str, Summary]) -> None:
    for name, summary in summaries.items():
        for warning in summary.get("warnings", ()):
            prefix = f"{name}: " if name else ""
            console.print(f"[yellow]warning:[/] {escaped_line(prefix + warning)}", highlight=False)


# Consoles, messages and progress bars.
# No emoji: rich would replace ":b:" in a path or key.
console = Terminal(emoji=False)
errors = Terminal(stderr=True, soft_wrap=True, highlight=False, emoji=False)


def print_error(text: object) -> None:
    """Print an error to standard error, as one line and its indented continuation; the text is escaped here."""
    errors.print(f"[red]error:[/] {escaped_problem(text)}")


def print_warning(text: object) -> None:
    """Print a warning to standard error as :func:`print_error` prints an error."""
    errors.print(f"[yellow]warning:[/] {escaped_problem(text)}")


def print_line(text: str) -> None:
    """Print text to standard output without wrapping; pass names in the text through :func:`escaped` first."""
    console.print(text, highlight=False, soft_wrap=True)


def print_written(path: Path) -> None:
    """Print where the files of a command are."""
    print_line(f"Written to {escaped(path)}")


# Maximum width of the title of a progress bar [characters].
_TITLE_WIDTH = 22
# Expected compilation time of the kernels if they have never been compiled before [s].
_COMPILED_S = 90.0
# Names of the record in the folder of a run, and of the summary in the folder of a comparison.
RECORD, COMPARISON = "record.h5", "comparison.json"


def labelled(paths: Sequence[Path], *, trust: bool = False) -> dict[str, Record]:
    """Load records from files and folders, and return them by label: the variant, numbered if it occurs repeatedly.

    Raises
    ------
    RecordError
        As for :meth:`dynsim.record.Record.load`.
    """
    from dynsim.record import Record
    from dynsim.system.files import file_name

    records: dict[str, Record] = {}
    for path in record_files(paths):
        record = Record.load(path, trust=trust)
        name = file_name(record.summary.get("variant") or path.parent.name or path.stem)
        label = next(label for k in itertools.count(1) if (label := name if k == 1 else f"{name}_{k}") not in records)
        records[label] = record
    return records


def record_files(paths: Sequence[Path]) -> list[Path]:
    """Return the paths of records; replace each folder by the record in it, or by the records of its variants.

    Raises
    ------
    RecordError
        If a folder contains no records.
    """
    files = []
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        inside = [path / RECORD] if (path / RECORD).is_file() else _variant_records(path)
        if not inside:
            raise RecordError(
                f"{path}: no {RECORD} in this folder or its subfolders; pass a record, or the folder of a run"
            )
        files += inside
    return files


def _variant_records(folder: Path) -> list[Path]:
    """Return the records in the subfolders of a folder: variants in the order of the comparison, then all others."""
    files = sorted(folder.glob(f"*/{RECORD}"))
    try:
        order = list(json.loads((folder / COMPARISON).read_text(encoding="utf-8"))["variants"])
    except (OSError, ValueError, KeyError, TypeError):
        return files
    return sorted(files, key=lambda path: order.index(path.parent.name) if path.parent.name in order else len(order))


@contextmanager
def drawing(folder: Path, quiet: bool) -> Iterator[None]:
    """Show a status line while figures are being drawn in the block."""
    with nullcontext() if quiet else console.status(f"drawing {escaped(folder)}"):
        yield


def _bars(*columns: str | ProgressColumn, quiet: bool) -> Progress:
    """Create progress bars with these columns and the elapsed and remaining time; a terminal keeps them at the end."""
    from rich import progress
    from rich.table import Column

    return progress.Progress(
        *columns,
        progress.TimeElapsedColumn(table_column=Column(no_wrap=True)),
        "to go",
        progress.TimeRemainingColumn(table_column=Column(no_wrap=True)),
        console=Console(quiet=True) if quiet else console,
        transient=not console.is_terminal,
        disable=quiet,
    )


def show_compilation(status: Status, task: str, now: Compilation | None) -> None:
    """Show in the status line which kernels are being compiled."""
    status.update(task if now is None else f"{task}: {escaped(now.text)}, {now.elapsed:.0f} s")


@contextmanager
def _compilation_shown(quiet: bool, show: Callable[[Compilation | None], None] = lambda now: None) -> Iterator[None]:
    """Print the first compilation of kernels in the block, and show its progress; suppress both if ``quiet``."""
    from dynsim.engine.compilation import shown_by_caller, watched

    shown: list[Compilation] = []

    def compiling(now: Compilation | None) -> None:
        if now is not None and not shown:
            shown.append(now)
            console.print(f"{escaped(now.text[0].upper() + now.text[1:])}.", highlight=False)
        show(now)

    if quiet:
        shown_by_caller()
        yield
        return
    with watched(compiling):
        yield


@contextmanager
def progress(scenarios: Sequence[Scenario], quiet: bool) -> Iterator[VariantProgress]:
    """Show a progress bar per scenario, and one more if its references take long; yield a progress callback."""
    from rich.progress import BarColumn

    from dynsim.engine import REFERENCES, SIMULATION

    # The text fits into 80 columns for times up to 9999 s: the bar shrinks, but the times do not.
    done = "{task.completed:.2f} / {task.total:g} s {task.fields[what]}"
    kernels: list[TaskID] = []

    def compiling(now: Compilation | None) -> None:
        if now is None:
            bars.update(kernels[0], visible=False)
            return
        if not kernels:
            kernels.append(bars.add_task("kernels", total=now.expected or _COMPILED_S, what="compiled"))
        bars.update(kernels[0], completed=now.elapsed, visible=True)

    with _bars("{task.description}", BarColumn(), done, quiet=quiet) as bars, _compilation_shown(quiet, compiling):

        def add(scenario: Scenario, kind: str, visible: bool) -> TaskID:
            title = scenario.variant or scenario.name
            title = title if len(title) <= _TITLE_WIDTH else title[: _TITLE_WIDTH - 1] + "…"
            return bars.add_task(escaped(title), total=scenario.duration_s, what=kind, visible=visible)

        preparing = {s.variant: add(s, "references", False) for s in scenarios}
        simulating = {s.variant: add(s, "simulated", True) for s in scenarios}

        def report(variant: str, time: float, stage: str = SIMULATION) -> None:
            bars.update(preparing[variant], completed=time, visible=stage == REFERENCES, refresh=stage == REFERENCES)
            if stage == SIMULATION:
                bars.update(simulating[variant], completed=time)

        yield report


@contextmanager
def sweep_progress(runs: int, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar for all runs of a sweep and the number of failed runs; yield a progress callback."""
    from rich.progress import BarColumn, MofNCompleteColumn

    bar = _bars("runs", BarColumn(), MofNCompleteColumn(), "{task.fields[failed]}", quiet=quiet)
    task = bar.add_task("", total=runs, failed="")

    def compiling(now: Compilation | None) -> None:
        if bar.live.is_started:
            bar.update(task, failed="" if now is None else f"compiling, {now.elapsed:.0f} s")

    def report(done: int, failed: int) -> None:
        # Start the bar here, so that an error before the first run is printed without a bar.
        bar.start()
        bar.update(task, completed=done, failed=f"{failed} failed" if failed else "")

    try:
        with _compilation_shown(quiet, compiling):
            yield report
    finally:
        if bar.live.is_started:
            bar.stop()


@contextmanager
def plan_progress(quiet: bool) -> Iterator[Callable[[str, float], None]]:
    """Show a progress bar for the stages of a plan; yield a callback for the stage and the fraction done."""
    from rich.progress import BarColumn

    with _bars("{task.description}", BarColumn(), quiet=quiet) as bar, _compilation_shown(quiet):
        task = bar.add_task("searching", total=1.0)
        yield lambda stage, share: bar.update(task, description=stage, completed=share)


@contextmanager
def film_progress(quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar for the frames of an animation; yield a progress callback."""
    from rich.progress import BarColumn, MofNCompleteColumn

    with _bars("frames", BarColumn(), MofNCompleteColumn(), quiet=quiet) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


# Table of a brace plan. A brace counts as lifted off if it is in contact for less than this fraction of the time.
LIFTED = 0.999


def print_plan(plan: BracePlan) -> None:
    """Print a table row for each number of braces, then the reasons why plans were rejected or not found."""
    table = _table(f"{plan.task.scenario.title}: braces", box=box.HEAVY_HEAD)
    heads = (
        "braces", "on", "heat [W]", "simulated [W]", "all energy [J]", "k_p [V/rad]", "forces [N]", "rounds",
        "survives",
    )  # fmt: skip
    for head in heads:
        table.add_column(head, justify="left" if head in ("on", "survives") else "right")
    for size in plan.sizes:
        table.add_row(*_cells(size))
    console.print(table)
    if any(size.planned is not None and size.agreed == 0 for size in plan.sizes):
        print_line("rounds: search rounds that found this heat independently; 0 if it was found by exchanging braces")
    best = plan.best
    if best is not None:
        label = escaped(best.label) if best.braces else "no braces"
        print_line(f"best: {label}{' (rejected)' if best.survives is False else ''}")
    for size in plan.sizes:
        for text in _notes(size):
            print_line(f"{size.count} brace{'' if size.count == 1 else 's'}: {escaped(text)}")
    missed, reached = len(plan.tally.missed), len(plan.tally.reached)
    if missed:
        print_line(
            f"no posture found for {missed} of {missed + reached} sets tried; this does not prove that none exists"
        )


def _cells(size: Size) -> tuple[str, ...]:
    if size.planned is None:
        return str(size.count), "not found", "–", "–", "–", "–", "–", f"0/{size.rounds}", "–"
    dense, nominal = size.planned.dense, size.nominal
    forces = f"{dense.forces.min():.3g} … {dense.forces.max():.3g}" if size.count else "–"
    survives = {True: "yes", False: "no", None: "not verified"}[size.survives]
    return (
        str(size.count),
        escaped(size.label),
        f"{size.heat:.4g}",
        "–" if nominal is None else f"{nominal.heat_W:.4g}",
        "–" if nominal is None else f"{nominal.electrical_energy_J:.4g}",
        f"{size.k_p:g}",
        forces,
        f"{size.agreed}/{size.rounds}",
        survives,
    )


def _tolerated(shift_m: float | None, friction: float | None) -> list[str]:
    """Return a text about the errors that a rejected plan tolerates, within the tested range."""
    texts = []
    if shift_m is not None:
        texts.append(f"{1e3 * shift_m:.2g} mm surface error" if shift_m else "no tested surface error")
    if friction is not None:
        texts.append(f"{100 * friction:.2g} % friction error" if friction else "no tested friction error")
    return [f"tolerates, one at a time and in both directions: {' and '.join(texts)}"] if texts else []


def _notes(size: Size) -> list[str]:
    notes = [f"rejected, {size.reason}"] if size.planned is not None and size.reason else []
    if size.planned is None:
        notes.append(size.reason)
    if size.verdict is not None and not size.verdict.sound:
        notes.append(f"rejected as planned with k_p = {size.k_p:g} V/rad: errors were not tested")
    for brace, share in ({} if size.nominal is None else size.nominal.closed_fraction).items():
        if share < LIFTED:
            notes.append(f"{brace} lifts off for {100.0 * (1.0 - share):.2g} % of the time in the run without errors")
    if size.tolerance is not None:
        notes += _tolerated(*size.tolerance)
    notes += [f"{label} would need less heat, but: {why}" for label, why in size.cheaper]
    return notes
