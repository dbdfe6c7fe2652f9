"""Rows of tables of summaries; lists of choices and start positions."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from rich.console import Console

from dynsim.cli import screen
from dynsim.system.terminal import Terminal, escaped_line, plain

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from dynsim.engine import Start

Summary = Mapping[str, Any]

# Energies below this fraction of the energy turnover, other numbers below this fraction of the largest in the row, and
# numbers in SI units below this value count as rounding errors.
ROUNDING = 1e-12


def _format(value: float, form: str) -> str:
    """Format a number: zero as "0", and a number that is rounded to zero without a sign."""
    text = format(value, form)
    if value == 0.0:
        return "0"
    return text.removeprefix("-") if float(text) == 0.0 else text


def _number(value: Any, scale: float = 1.0, digits: int = 4) -> str:
    return "–" if value is None else _format(_without_rounding(value) * scale, f".{digits}g")


def _without_rounding(value: float, largest: float = 1.0) -> float:
    """Return a number in SI units, or 0 if it is a rounding error next to the largest one."""
    return 0.0 if abs(value) <= ROUNDING * largest else value


def without_rounding(values: Sequence[Any], unit: float = 0.0) -> list[Any]:
    """Return the values of one quantity, with 0 for rounding errors next to the largest number or ``unit``."""
    sizes = [abs(value) for value in values if isinstance(value, float) and math.isfinite(value)]
    largest = max([*sizes, unit])
    return [_without_rounding(value, largest) if isinstance(value, float) else value for value in values]


def _deepest(summary: Summary) -> str | None:
    """Return the largest depth of a body below a surface [mm], or None if no body was below one."""
    sunk = max(summary.get("sinking", ()), key=lambda entry: entry["depth_m"], default=None)
    return None if sunk is None else f"[bold red]{_number(sunk['depth_m'], 1e3, 3)}[/]"


def _energy(summary: Summary, key: str) -> float | None:
    """Read an energy from a summary [J]; return 0 if it is only rounding error of the turnover."""
    energy: float | None = summary.get(key)
    return 0.0 if energy and abs(energy) <= ROUNDING * summary.get("energy_turnover_J", 0.0) else energy


def _value(summary: Summary, key: str) -> Any:
    """Read a value from a summary, or a number about its mobile base; return None if it has no such value."""
    section, _, number = key.rpartition(".")
    return (summary.get(section, {}) if section else summary).get(number)


def _least_load(summary: Summary, key: str) -> float | None:
    loads = _value(summary, key)
    return None if loads is None else min(loads.values())


def _margin(value: float) -> str:
    return f"[bold red]{value:.3g}[/]" if value < 0.0 else f"{value:.3g}"


def _cause(summary: Summary, key: str) -> str | None:
    """Return the main cause of a distance from a target, or None if it is unknown."""
    return next((cause["cause"] for cause in summary.get(key, ())), None)


def _worst_joint(motor: Summary) -> str:
    """Return the name of a motor with its rms torque and nominal torque (stall torque if unknown)."""
    rating = motor.get("nominal_torque_N_m", motor.get("stall_torque_N_m", math.inf))
    return f"{escaped_line(motor['joint'])} {_loaded(motor['torque_rms_N_m'], rating)} of {rating:g}"


def _loaded(rms: float, nominal: float) -> str:
    text = _format(_without_rounding(rms, min(nominal, 1.0)), ".3g")
    return f"[bold red]{text}[/]" if rms > nominal else text


def _short(value: Any) -> str:
    return _number(value, digits=3)


def _exponent(value: float) -> str:
    return _format(value, ".1e")


# Key of the summary, function that reads the value, format, and heading; default: the name and unit of the key. A row
# without values is omitted.
_ROWS: tuple[tuple[str, Callable[[Summary, str], Any], Callable[[Any], str], str], ...] = (
    ("electrical_energy_J", _energy, _number, ""),
    ("electrical_energy_supply_J", _energy, _number, ""),
    ("electrical_energy_drawn_J", _energy, _number, ""),
    ("battery_energy_Wh", _value, _short, ""),
    ("worst_joint", _value, _worst_joint, "worst joint, rms torque [N m]"),
    ("mechanical_work_J", _energy, _number, ""),
    ("joule_heat_J", _energy, _number, ""),
    ("friction_heat_J", _energy, _number, ""),
    ("impact_loss_J", _energy, _number, ""),
    ("stop_loss_J", lambda summary, key: summary.get(key) or None, _number, ""),
    ("scheme_loss_J", _energy, _number, ""),
    ("hand_error_rms_m", _value, _number, ""),
    ("hand_error_max_m", _value, _number, ""),
    ("hand_error_z_rms_m", _value, _number, ""),
    ("hand_error_start_m", _value, _number, ""),
    ("hand_error_end_m", _value, _number, ""),
    ("hand_error_causes", _cause, str, "hand error, main cause"),
    ("initial_position_error_m", _value, _short, ""),
    ("final_position_error_m", _value, _short, ""),
    ("final_position_error_causes", _cause, str, "position error, main cause"),
    ("final_attitude_error_rad", _value, _short, ""),
    ("position_error_max_m", _value, _short, ""),
    ("attitude_error_max_rad", _value, _short, ""),
    ("joint_limit_violation_max_rad", _value, _short, ""),
    ("cost_initial", _value, _number, ""),
    ("cost_final", _value, _number, ""),
    ("mode_switches", _value, str, ""),
    ("sinking", lambda summary, _: _deepest(summary), str, "deepest below a surface [mm]"),
    ("base.tip_margin_min_settled", _value, _margin, ""),
    ("base.tip_margin_min", _value, _margin, ""),
    ("base.overturns_settled_at_s", _value, _short, ""),
    ("base.wheel_load_min_N", _least_load, _short, "min load, wheels, caster [N]"),
    ("energy_residual_relative", _value, _exponent, ""),
    ("constraint_drift_max_m", _value, _exponent, ""),
    ("method", _value, str, ""),
    ("integration_wall_s", _value, lambda v: f"{v:.3f}", ""),
    ("real_time_factor", _value, lambda v: f"{v:.0f}", ""),
)


class SummaryRow(NamedTuple):
    """Row of a table of summaries.

    Attributes
    ----------
    key : str
        Key of the summary, or the heading of a row of contacts, stops or motors.
    owner : str
        Contact, stop or joint to which the row belongs; "" for the robot.
    heading : str
        Heading without the owner.
    cells : list of str
        A cell for each run, with rich markup.
    """

    key: str
    owner: str
    heading: str
    cells: list[str]

    @property
    def label(self) -> str:
        """Heading with the owner."""
        return f"{self.owner}: {self.heading}" if self.owner else self.heading


def rows_of(summaries: Sequence[Summary], folded: bool = False) -> list[SummaryRow]:
    """Return the rows that any of the runs has, with a cell for each run.

    If ``folded``, contacts, stops and motors whose names differ only in a number share their rows: see :func:`_merged`.
    """
    from dynsim.record.quantities import summary_quantity

    rows = []
    for key, read, show, heading in _ROWS:
        values = [read(summary, key) for summary in summaries]
        if any(value is not None for value in values):
            values = values if show is _exponent else without_rounding(values)
            quantity = summary_quantity(key).fitted(values)
            scaled = [value * quantity.scale if isinstance(value, float) else value for value in values]
            cells = ["–" if value is None else show(value) for value in scaled]
            rows.append(SummaryRow(key, "", heading or quantity.label, cells))
    least = min(summary.get("electrical_energy_J") or 0.0 for summary in summaries)
    if len(summaries) > 1 and least > 0.0:
        cells = [f"{summary['electrical_energy_J'] / least:.3g}" for summary in summaries]
        rows.append(SummaryRow("", "", "energy, times the minimum", cells))
    rows += _contact_rows([{c["name"]: c for c in s.get("contacts", ())} for s in summaries], folded)
    rows += _stop_rows([{_stop_name(stop): stop for stop in s.get("joint_stops", ())} for s in summaries], folded)
    rows += _motor_rows(summaries, folded)
    return rows


def _kind(name: str) -> str:
    """Return the part of a name before its first number."""
    return re.sub(r"[_ .]*\d.*", "", name) or name


def _kind_of_stop(stop: Summary) -> str:
    return f"{_kind(stop['joint'])}, {'revolute' if stop['unit'] == 'rad' else 'prismatic'} stops"


def _kinds(kinds: Mapping[str, str]) -> dict[str, list[str]]:
    """Group names by their kinds; a group of several is named ``wheel × 14``."""
    groups: dict[str, list[str]] = {}
    for name, kind in kinds.items():
        groups.setdefault(kind, []).append(name)
    return {f"{kind} × {len(group)}" if len(group) > 1 else group[0]: group for kind, group in groups.items()}


def _merged(runs: Sequence[Mapping[str, Summary]], kinds: Mapping[str, str]) -> list[dict[str, Summary]]:
    """Merge the entries of each kind: extremes, means of means and fractions, sums of counts and losses.

    Entries that were not touched in a run do not count, so that the numbers of a run do not depend on the other runs;
    ``count`` of a kind of several is the number of touched entries, ``of`` that of the kind in all runs.
    """

    def merge(entries: Sequence[Summary], of: int) -> Summary:
        touched = [entry for entry in entries if entry["closed_fraction"] > 0.0 or entry.get("hits")]
        keys = dict.fromkeys(key for entry in touched or entries for key in entry)
        values = {key: [entry[key] for entry in touched or entries if entry.get(key) is not None] for key in keys}
        folded = {key: _fold(key, numbers) for key, numbers in values.items() if numbers}
        return folded | ({"count": len(touched), "of": of} if of > 1 else {})

    groups = _kinds(kinds)
    merged = []
    for run in runs:
        present = {kind: [run[name] for name in names if name in run] for kind, names in groups.items()}
        merged.append({kind: merge(entries, len(groups[kind])) for kind, entries in present.items() if entries})
    return merged


# How rows of several contacts or stops are folded, if their headings do not state it.
_FOLDS = {
    "pulling": "max",
    **dict.fromkeys(("closed", "sticking"), "mean"),
    **dict.fromkeys(("lift-offs, landings", "bounces, slip starts", "loss at impacts", "hits"), "sum"),
}


def _row(key: str, owner: str, entries: Sequence[Summary | None], cells: list[str]) -> SummaryRow:
    """Return a row of contacts or stops; the heading of a folded row states how it was folded."""
    name, bracket, unit = key.partition(" [")
    if name in _FOLDS and any(entry and "count" in entry for entry in entries):
        name = f"{name}, {_FOLDS[name]}"
    return SummaryRow(key, owner, f"{name}{bracket}{unit}", cells)


def _count_rows(owner: str, entries: Sequence[Summary | None]) -> Iterator[SummaryRow]:
    """Yield the number of touched contacts or stops of a kind in each run, unless all of them are always touched."""
    if any(entry and entry.get("count") != entry.get("of") for entry in entries):
        yield SummaryRow(
            "touched", owner, "number touched", [str(entry["count"]) if entry else "–" for entry in entries]
        )


def _fold(key: str, values: Sequence[Any]) -> Any:
    if isinstance(values[0], str):
        return values[0]
    if "_min" in key:
        return min(values)
    if "_max" in key or key == "pulling_fraction":
        return max(values)
    return sum(values) / len(values) if "_mean" in key or "_fraction" in key else sum(values)


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
    table = screen.new_table(title, show_header=bool(headings))
    for k, heading in enumerate(headings):
        table.add_column(heading, no_wrap=k == 0)
    for row in rows:
        table.add_row(*map(escaped_line, row))
    console.print(table)


def print_starts(console: Console, starts: Mapping[str, Start]) -> None:
    """Print the start positions of the hand and contact points [m] of each variant, as YAML lists in full precision.

    Also print the gaps of contacts and of pairs of bodies, the joints that `initial` moved, and the tip margin of a
    mobile base at rest.
    """
    for variant, start in starts.items():
        values = {"hand": f"{_coordinates(start.hand)}"}
        values |= {f"contact {name}": f"{_coordinates(point)}" for name, point in start.contacts.items()}
        pairs = list(start.pairs.items())
        texts = {
            name: f"{_format(_without_rounding(gap), '+.4g')} m" for name, gap in {**start.pairs, **start.gaps}.items()
        }
        values |= {f"gap of {name}": texts[name] for name, _ in pairs[:_MOST_PAIRS]}
        if further := pairs[_MOST_PAIRS:]:
            values[f"{len(further)} more pairs"] = f"{further[0][1]:+.4g} m or more"
        values |= {f"gap of {name}": texts[name] for name in start.gaps}
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
        for warning in start.warnings:
            console.print(warning_text(warning, variant), highlight=False)


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
    ("force, min [N]", lambda c: _format(c["normal_force_min_N"], ".2f"), None),
    ("force, max [N]", lambda c: _format(c["normal_force_max_N"], ".2f"), None),
    ("pulling [% of time]", _pulling, False),
    ("closed [% of time]", _percent("closed_fraction"), True),
    ("sticking [% of time]", _percent("sticking_fraction"), True),
    ("lift-offs, landings", lambda c: f"{c['lift_offs']}, {c['landings']}", True),
    ("bounces, slip starts", lambda c: f"{c['bounces']}, {c['slip_starts']}", True),
    ("loss at impacts [J]", lambda c: _number(c.get("impact_loss_J"), digits=3), True),
)


def _contact_rows(runs: Sequence[Mapping[str, Summary]], folded: bool) -> Iterator[SummaryRow]:
    """Yield the rows of all contacts, for one mapping of names to contacts per run.

    A candidate contact that never closed has no rows; for a declared contact that never closed, the smallest gap is
    printed.
    """
    names = dict.fromkeys(name for run in runs for name in run)
    having = {name: [run[name] for run in runs if name in run] for name in names}
    closing = {name: any(contact["closed_fraction"] > 0.0 for contact in having[name]) for name in names}
    kept = [name for name in names if closing[name] or any("gap_min_m" in contact for contact in having[name])]
    runs = [{name: run[name] for name in kept if name in run} for run in runs]
    if folded:
        yield from _contact_rows(_merged(runs, {name: _kind(name) for name in kept}), folded=False)
        return
    for name in kept:
        contacts = [run.get(name) for run in runs]
        if not all(contact["closed_fraction"] > 0.0 for contact in having[name]):
            cells = [_number(c.get("gap_min_m"), 1e3, 3) if c and not c["closed_fraction"] else "–" for c in contacts]
            yield SummaryRow("gap", name, "never touches, min gap [mm]", cells)
        yield from _count_rows(name, contacts)
        for heading, show, real in _CONTACT_ROWS if closing[name] else ():
            if real is None or any(_is_unilateral(contact) == real for contact in having[name]):
                cells = [show(c) if c and real in (None, _is_unilateral(c)) else "–" for c in contacts]
                yield _row(heading, name, contacts, cells)


# Rows of a joint stop: heading and format.
_STOP_ROWS: tuple[tuple[str, Callable[[Summary], str]], ...] = (
    ("hits", lambda s: str(s["hits"])),
    ("force, max [{force_unit}]", lambda s: _number(s["force_max"], digits=3)),
    ("closed [% of time]", _percent("closed_fraction")),
    ("loss at impacts [J]", lambda s: _number(s.get("impact_loss_J"), digits=3)),
)


def _stop_rows(runs: Sequence[Mapping[str, Summary]], folded: bool) -> Iterator[SummaryRow]:
    """Yield the rows of all joint stops that were hit in any run, for one mapping of names to stops per run."""
    if folded:
        runs = _merged(runs, {name: _kind_of_stop(stop) for run in runs for name, stop in run.items()})
    for name, stop in {name: stop for run in runs for name, stop in run.items()}.items():
        stops = [run.get(name) for run in runs]
        yield from _count_rows(name, stops)
        for heading, show in _STOP_ROWS:
            yield _row(heading.format(**stop), name, stops, [show(s) if s else "–" for s in stops])


def _stop_name(stop: Summary) -> str:
    limit = stop["limit"]
    position = f"{math.degrees(limit):.4g}°" if stop["unit"] == "rad" else f"{limit:.4g} {stop['unit']}"
    return f"{stop['joint']}, {stop['stop']} stop at {position}"


def _motor_rows(summaries: Sequence[Summary], folded: bool) -> Iterator[SummaryRow]:
    """Yield the rows of motors with known ratings: rms and nominal value; if ``folded``, ratios of each kind of joint.

    If there are many motors, only the most heavily loaded ones are shown.
    """
    for quantity, unit, label in _RATED:
        rms, nominal = f"{quantity}_rms_{unit}", f"nominal_{quantity}_{unit}"
        rated = [
            {motor["joint"]: motor for motor in summary.get("motors", ()) if motor.get(nominal) and rms in motor}
            for summary in summaries
        ]
        loads = [{joint: motor[rms] / motor[nominal] for joint, motor in motors.items()} for motors in rated]
        joints = list(dict.fromkeys(joint for load in loads for joint in load))
        if folded:
            for kind, members in _kinds({joint: _kind(joint) for joint in joints}).items():
                cells = [_spread([100.0 * load[joint] for joint in members if joint in load]) for load in loads]
                yield SummaryRow(quantity, kind, f"rms {quantity} [% of nominal]", cells)
            continue
        largest = {joint: max(load.get(joint, 0.0) for load in loads) for joint in joints}
        heaviest = sorted(joints, key=lambda joint: -largest[joint])[:_MOST_MOTORS]
        for joint in (joint for joint in joints if joint in heaviest):
            motors = [motors.get(joint) for motors in rated]
            cells = [f"{_loaded(m[rms], m[nominal])} of {m[nominal]:g}" if m else "–" for m in motors]
            yield SummaryRow(quantity, joint, label, cells)


def _spread(values: Sequence[float]) -> str:
    """Return range and mean of percentages; red beyond 100 %."""
    if not values:
        return "–"
    text = f"{min(values):.0f}…{max(values):.0f}, mean {sum(values) / len(values):.0f}"
    return f"[bold red]{text}[/]" if max(values) > 100.0 else text


# Motor ratings: quantity and unit as in the keys of the summary, and label in the table.
_RATED = (
    ("current", "A", "rms of nominal [A]"),
    ("torque", "N_m", "rms of nominal [N m]"),
    ("force", "N", "rms of nominal [N]"),
)
_MOST_MOTORS = 10
# Maximum number of pairs of bodies whose gaps are printed.
_MOST_PAIRS = 20


def warning_text(text: str, name: str = "") -> str:
    """Return the markup of a warning; ``name``: the variants to which it belongs."""
    return f"[yellow]warning:[/] {escaped_line(f'{name}: {text}' if name else text)}"
