"""Write the numbers of README.md and docs/ from the results of the studies: ``python .ci/pages.py``.

In a page, ``<!-- = NAME -->`` follows a number in a sentence, and NAME is a key of :data:`NUMBERS`; a table is between
``<!-- table: NAME -->`` and ``<!-- end -->``, and NAME is a function in this file. Both come from the JSON files in
results/, which contain the version of dynsim that made them; results/README.md has the commands. ``--check`` changes
nothing and exits with 1 if a page is stale (tests/unit/test_pages.py).

Times come from the last ``PYTHONPATH=tests python -m studies.bench`` and ``… -m studies.start_up``; other numbers are
the same on every machine, to the digits shown.
"""

from __future__ import annotations

import ast
import csv
import io
import json
import math
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from dynsim.cli.comparison import print_comparison
from dynsim.scenario.combinations import LAWS, METHODS, RESTRICTIONS
from dynsim.snake.published import TABLE_III
from dynsim.system.terminal import Terminal

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "docs" / "site")]
from reference import scenario_keys  # noqa: E402
from studies.bench.programs import (  # noqa: E402
    ABA,
    CONSTRAINT_DYNAMICS,
    DYNSIM_CONTACTS,
    DYNSIM_FREE,
    DYNSIM_RADAU5,
    LCABA,
    MUJOCO_CONTACTS,
    MUJOCO_EULER,
    MUJOCO_FREE,
    MUJOCO_IMPLICIT,
    SAME_TASK,
)  # fmt: skip
from studies.bench.snake import BETA, Z  # noqa: E402
from studies.fault_table import markdown  # noqa: E402

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
NUMBER = re.compile(r"[−+-]?\d[\d.,]*(?:e[−+-]?\d+)?(?=<!-- = (\w+) -->)")
TABLE = re.compile(r"(?<=<!-- table: )(\w+)( -->\n).*?(?=<!-- end -->)", re.DOTALL)

# Mean error of the paper's manoeuvres in the coordinate that moves (Tanaka et al. 2019, Table III).
PAPER_ERROR_PERCENT = {"x": 1.0, "y": 34, "z": 1.5, "alpha": 1.9, "beta": 6.0, "gamma": 0.4}

VARIANTS = ("two_elbows", "elbow_7", "elbow_4", "no_elbow")
HEADS = ("two elbows", "elbow 7", "elbow 4", "no elbow")
NONE = "–"


@cache
def data(file: str) -> Any:
    return json.loads((ROOT / "results" / file).read_text(encoding="utf-8"))


@cache
def table_of(file: str) -> list[dict[str, str]]:
    with (ROOT / "results" / file).open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def validation() -> Any:
    return data("reference/validation.json")


def robot_files(read: str = "") -> str:
    """Return the number of robot files whose reading begins with ``read``."""
    return str(sum(row["read"].startswith(read) for row in data("reference/robot_files.json")["files"].values()))


def contact() -> Any:
    return data("contact/comparison.json")


def bench() -> Any:
    return data("reference/bench.json")


def start_up() -> Any:
    return data("reference/start_up.json")


def bodies(case: str) -> list[dict[str, Any]]:
    """Return the numbers of every program for the case that ends with a word."""
    return [row for row in data("reference/bodies.json")["bodies"] if row["case"].endswith(case)]


def overturning() -> Any:
    return data("overturning/configurations.json")


def number(value: float | None, digits: int = 4) -> str:
    """Return a value with ``digits`` significant digits and no exponent; 0 for zero."""
    if not value:
        return NONE if value is None else "0"
    places = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{places}f}".replace("-", "−")


def small(value: float | None, digits: int = 1) -> str:
    """Return a value as in 3.0e-10."""
    if value is None:
        return NONE
    mantissa, _, power = f"{value:.{digits}e}".partition("e")
    return "0" if value == 0.0 else f"{mantissa.replace('-', '−')}e{int(power)}"


def fixed(value: float | None, places: int) -> str:
    text = NONE if value is None else f"{value:.{places}f}".replace("-", "−")
    return "0" if text.strip("−0.") == "" else text


def percent(share: float) -> str:
    return fixed(100 * share, 1 if share < 0.9995 else 0)


def grouped(value: int) -> str:
    return f"{value:,}".replace(",", " ") if value >= 1000 else str(value)


def lines(heads: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """Return a Markdown table with the first ``left`` columns left-aligned and the others right-aligned."""
    return ruled(heads, ["---"] * left + ["---:"] * (len(heads) - left), rows)


def ruled(heads: Sequence[str], rules: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    def line(cells: Sequence[str]) -> str:
        return "|" + "".join(f" {cell} |" if cell else " |" for cell in cells) + "\n"

    return line(heads) + f"|{'|'.join(rules)}|\n" + "".join(map(line, rows))


def of_elbows(scenario: str, key: str) -> list[float]:
    return [validation()["runs"][f"{scenario} {name}"][key] for name in VARIANTS]


def _depth(variant: str, key: str) -> str:
    depth = 1e3 * validation()["elbows"][variant][key]
    return fixed(depth, 1) if 0.05 <= depth < 9.95 else fixed(depth, 0)


def elbows() -> str:
    rows, ledger = validation()["elbows"], of_elbows("elbow_comparison", "energy_residual_relative")

    def of(key: str, show: Callable[[float], str] = number) -> list[str]:
        return [show(rows[v][key]) for v in VARIANTS]

    return lines(
        ["", *HEADS],
        [
            ["electrical energy, net [J]", *of("electrical_energy_J")],
            ["electrical energy, from one supply that takes nothing back [J]", *of("electrical_energy_supply_J")],
            ["electrical energy, from such a supply for each motor [J]", *of("electrical_energy_drawn_J")],
            ["mechanical work ∫ Σ τ v dt [J]", *of("mechanical_work_J", lambda x: fixed(x, 3))],
            ["∫ Σ \\|τ v\\| dt [J]", *of("sum_of_absolute_power_J", lambda x: fixed(x, 2))],
            ["Joule heat [J]", *of("joule_heat_J")],
            ["friction heat [J]", *of("friction_heat_J", lambda x: fixed(x, 3))],
            ["hand error after 2 s, rms [mm]", *of("hand_error_rms_m", lambda x: fixed(1e3 * x, 1))],
            ["hand error after 2 s, vertical rms [mm]", *of("hand_error_z_rms_m", lambda x: fixed(1e3 * x, 1))],
            ["energy ledger residual / turnover", *map(small, ledger)],
            ["largest gap at a closed contact [m]", *of("largest_gap_m", lambda x: small(x, 0) if x else NONE)],
            [
                "deepest joint below the floor, at most / after 10 s [mm]",
                *(f"{_depth(v, 'joint_depth_max_m')} / {_depth(v, 'joint_depth_end_m')}" for v in VARIANTS),
            ],
        ],
    )


def glued_and_real() -> str:
    glued, real, links = (contact()[f"elbow_comparison{name}"] for name in ("", "_floor", "_links"))
    soft = links["soft"]

    def row(heading: str, runs: Any, key: str, show: Callable[[float], str], last: str = "") -> list[str]:
        return [heading, *(show(runs[v][key]) for v in VARIANTS), last]

    def both(heading: str, elbow: str, show: Callable[[Any, Any], str]) -> list[str]:
        pairs = ((glued[v]["contacts"].get(elbow), real[v]["contacts"].get(elbow)) for v in VARIANTS)
        return [heading, *(NONE if None in pair else show(*pair) for pair in pairs), ""]

    def millimetres(value: float) -> str:
        return number(1e3 * value)

    def forces(a: Any, b: Any) -> str:
        return f"{fixed(a['normal_force_mean_N'], 2)}; {fixed(b['normal_force_mean_N'], 2)}"

    def shares(_: Any, b: Any) -> str:
        return "; ".join(percent(b[key]) for key in ("closed_fraction", "sticking_fraction"))

    def count(variant: str) -> str:
        kinds = [kind for _, kind, _ in real[variant]["events"]]
        touched = bool(real[variant]["contacts"])
        return ", ".join(str(kinds.count(kind)) for kind in ("lift_off", "landing", "slip_start")) if touched else NONE

    pairs = (f"{glued[v]['rhs_evaluations']}; {real[v]['rhs_evaluations']}" for v in VARIANTS)
    return lines(
        ["", *HEADS, "soft"],
        [
            row("electrical energy, glued [J]", glued, "electrical_energy_J", number),
            row("… on a real floor", real, "electrical_energy_J", number),
            row("… where all links touch", links, "electrical_energy_J", number, number(soft["electrical_energy_J"])),
            row("hand error, rms, glued [mm]", glued, "hand_error_rms_m", millimetres),
            row("… on a real floor", real, "hand_error_rms_m", millimetres),
            row(
                "… where all links touch", links, "hand_error_rms_m", millimetres, millimetres(soft["hand_error_rms_m"])
            ),
            both("elbow 4: mean force, glued; real [N]", "elbow_4", forces),
            both("… closed; sticking, real [% of time]", "elbow_4", shares),
            both("elbow 7: mean force, glued; real [N]", "elbow_7", forces),
            both("… closed; sticking, real [% of time]", "elbow_7", shares),
            ["lift-offs, landings, slip starts, real", *map(count, VARIANTS), ""],
            row("impact loss, real [mJ]", real, "impact_loss_J", lambda x: fixed(1e3 * x, 1)),
            row("energy ledger residual, real", real, "energy_residual_relative", small),
            ["evaluations of the right-hand side, glued; real", *pairs, ""],
        ],
    )


def overturning_holds() -> str:
    rows = [overturning()["mobile_elbow_comparison"][v] for v in VARIANTS]

    def of(key: str, show: Callable[[Any], str]) -> list[str]:
        return [show(row[key]) for row in rows]

    def loads(case: dict[str, float]) -> str:
        return ", ".join(fixed(case[which], 1) for which in ("left", "right", "caster"))

    return lines(
        ["the base holds", *HEADS],
        [
            ["least tip margin, settled", *of("tip_margin_min_settled", _margin)],
            [
                "least load of left wheel, right wheel, caster, settled [N]",
                *of("wheel_load_min_settled_N", loads),
            ],
            ["largest traction demand of a wheel, settled", *of("traction_demand_max_settled", _demand)],
            ["`overturns_at_s`: first crossing of zero [ms]", *of("overturns_at_s", lambda x: fixed(1e3 * x, 2))],
            ["margin below zero [ms]", *of("margin_below_zero_s", _spans)],
            ["least tip margin in the whole run", *of("tip_margin_min", lambda x: fixed(x, 3))],
            [
                "least tip margin, arm holding still (no path of the hand)",
                *of("tip_margin_min_arm_held", _bare),
            ],
            [
                "tips over, arm holding still [ms]",
                *of("overturns_at_s_arm_held", lambda x: "never" if x is None else fixed(1e3 * x, 0)),
            ],
        ],
    )


def overturning_drives() -> str:
    rows = [overturning()["mobile_elbow_comparison_driving"][v] for v in VARIANTS]
    return lines(
        ["the base drives", *HEADS],
        [
            ["least tip margin, settled", *(_margin(row["tip_margin_min_settled"]) for row in rows)],
            ["margin below zero [ms]", *(_spans(row["margin_below_zero_s"]) for row in rows)],
        ],
    )


def _bare(value: float) -> str:
    return fixed(value, 3)


def _margin(value: float) -> str:
    return f"**{fixed(value, 3)}**" if value < 0.0 else fixed(value, 3)


def _demand(value: float | None) -> str:
    return NONE if value is None else fixed(value, 2)


def _spans(spans: list[list[float]]) -> str:
    """Return spans in milliseconds, to the sample; a span that lasts to the end of the fine run has no end."""
    first = f"{1e3 * spans[0][0] - 0.05:.1f}–{1e3 * spans[0][1]:.1f}"
    return first + (f", and from {1e3 * spans[1][0]:.0f} on" if len(spans) > 1 else "")


def assumptions() -> str:
    rows = []
    for case, variants in data("reference/assumptions.json")["cases"].items():
        energies = " · ".join(number(variants[v]["electrical_energy_J"]) for v in VARIANTS)
        errors = " · ".join(fixed(1e3 * variants[v]["hand_error_rms_m"], 1) for v in VARIANTS)
        pulling = percent(variants["two_elbows"]["pulling_elbow_4"])
        name = case.replace("|", "\\|")
        notes = {
            "as shipped": "as shipped: horizontal circle, one turn in 10 s, v_s = 1 mm/s",
            "one turn in 20 s": "one turn in 20 s (half a turn in the run)",
        }
        rows.append([notes.get(case, name), energies, errors, pulling])
    return lines(["changed", "electrical energy", "hand error", "elbow 4 pulling [%]"], rows, left=3)


def ledger() -> str:
    runs, free = validation()["runs"], validation()["ledger_residual_of_free_motion"]

    def of(scenario: str, *variants: str) -> str:
        names = [f"{scenario} {v}" for v in variants] or [name for name in runs if name.split()[0] == scenario]
        return ", ".join(small(runs[name]["energy_residual_relative"]) for name in names)

    def between(scenario: str) -> str:
        residuals = [
            summary["energy_residual_relative"] for name, summary in runs.items() if name.split()[0] == scenario
        ]
        return f"{small(min(residuals))} to {small(max(residuals))}"

    left = [
        (f"`{s}` {label}", of(s, *v))
        for s in ("elbow_comparison", "elbow_comparison_vertical", "mobile_elbow_comparison")
        for label, v in (("two elbows, elbow 7", VARIANTS[:2]), ("elbow 4, none", VARIANTS[2:]))
    ]
    left += [
        ("`mobile_elbow_comparison_driving`, all four", between("mobile_elbow_comparison_driving")),
        ("`mobile_path`, `mobile_reach` (until it tips)", f"{of('mobile_path')}, {of('mobile_reach')}"),
        ("`six_axis_arm`", of("six_axis_arm")),
        ("`thirty_links`, all three", between("thirty_links")),
        ("`single_pendulum` (free)", of("single_pendulum")),
    ]
    right = [(name.replace("undamped ", ""), small(value)) for name, value in free.items()]
    right += [("", "")] * (len(left) - len(right))
    rows = [[a, b, "", c, d] for (a, b), (c, d) in zip(left, right, strict=True)]
    rules = ["---", "---:", "---", "---", "---:"]
    heads = ["driven and damped", "residual", "", "free, no loss but friction", "residual"]
    return ruled(heads, rules, rows)


def time_stepping() -> str:
    rows = []
    for name, case in validation()["time_stepping"].items():
        scenario, variant = (name if " " in name else f"{name} ").split(" ", 1)
        taken = case["taken_by_steps_relative"]
        shown = small(taken) if abs(taken) < 1e-3 else f"{fixed(100 * taken, 2)} %"
        depth = number(1e3 * case["penetration_max_m"], 2)
        rows.append(
            [f"`{scenario}` {variant}".strip(), small(case["energy_residual_relative"], 0), shown, f"{depth} mm"]
        )
    return lines(["", "residual", "taken by the steps, of the turnover", "sinks in by"], rows)


def endings() -> str:
    study = data("endings/endings.json")
    kinds = [kind for kind in study["by_status"] if kind not in ("finished", "refused")]
    rows = []
    for method, ends in study["by_method"].items():
        wall = study["wall_s"][method]
        counts = [f"{ends.get(kind, 0):,}" for kind in ("finished", "refused", *kinds)]
        rows.append([f"`{method}`", *counts, f"{1e3 * wall['median']:.0f} ms, {number(wall['longest'], 2)} s"])
    heads = ["", "to the end", "refused before it", *(f"`{kind}`" for kind in kinds), "integration, median and longest"]
    return lines(heads, rows)


def right_hand_side() -> str:
    contenders = (
        ("dynsim, free", DYNSIM_FREE), ("dynsim, 2 frictional contacts", DYNSIM_CONTACTS), ("Pinocchio ABA, free", ABA),
        ("Pinocchio `constraintDynamics`, 2 × 3 rows", CONSTRAINT_DYNAMICS), ("Pinocchio `lcaba`, 2 × 3 rows", LCABA),
        ("MuJoCo `mj_step`, free", MUJOCO_FREE), ("MuJoCo `mj_step`, 2 frictional contacts", MUJOCO_CONTACTS),
    )  # fmt: skip
    sizes, times = by_links()
    return lines(
        heads_of(sizes), [[label, *(microseconds(times.get((n, name))) for n in sizes)] for label, name in contenders]
    )


def by_links() -> tuple[list[int], dict[tuple[int, str], float]]:
    """Return the numbers of links, and microseconds of a right-hand side by number of links and program."""
    times = {(row["links"], row["program"]): row["median_us"] for row in bench()["right_hand_side"]}
    return list(dict.fromkeys(n for n, _ in times)), times


def heads_of(sizes: Sequence[int]) -> list[str]:
    return ["", f"{sizes[0]} links", *map(str, sizes[1:])]


def microseconds(value: float | None) -> str:
    if value is None:
        return NONE
    rounded = float(f"{value:.3g}")
    return f"{rounded:,.0f}".replace(",", " ") if rounded >= 1000 else f"{rounded:g}"


def ratios() -> str:
    labels = (
        ("Pinocchio ABA", ABA), ("Pinocchio `constraintDynamics`", CONSTRAINT_DYNAMICS), ("Pinocchio `lcaba`", LCABA),
        ("MuJoCo, free", MUJOCO_FREE), ("MuJoCo, contacts", MUJOCO_CONTACTS),
    )  # fmt: skip
    sizes, times = by_links()

    def ratio(n: int, peer: str) -> str:
        if (n, peer) not in times:
            return NONE
        value = times[n, peer] / times[n, SAME_TASK[peer]]
        return f"{value:.{1 if value < 9.95 else 0}f}"

    return lines(heads_of(sizes), [[label, *(ratio(n, peer) for n in sizes)] for label, peer in labels])


def job() -> str:
    programs = (
        ("dynsim, `radau5`", DYNSIM_RADAU5), ("MuJoCo, Euler 1 ms", MUJOCO_EULER),
        ("MuJoCo, implicitfast 1 ms", MUJOCO_IMPLICIT),
    )  # fmt: skip
    rows: list[list[str]] = []
    for case in dict.fromkeys(entry["case"] for entry in bench()["job"]):
        by_program = {entry["program"]: entry for entry in bench()["job"] if entry["case"] == case}
        for k, (label, program) in enumerate(programs):
            entry = by_program[program]
            errors = [1e3 * entry["hand_error_max_m"], 1e3 * entry["hand_error_rms_m"], entry["current_error_max_A"]]
            cells = [f"{x:.2g}" if entry["same_physics"] else f"({x:.2g})" for x in errors]
            rows.append([case if k == 0 else "", label, f"{1e3 * entry['cpu_median_s']:.3g}", *cells])
    return lines(["case", "program", "CPU ms", "hand, max mm", "hand, rms mm", "current, max A"], rows, left=2)


def precision() -> str:
    measured = bench()["precision"]
    rtols = sorted({row["rtol"] for row in measured}, reverse=True)
    rows: list[list[str]] = []
    for scenario in dict.fromkeys(row["scenario"] for row in measured):
        for k, method in enumerate(dict.fromkeys(row["method"] for row in measured)):
            by = {row["rtol"]: row for row in measured if (row["scenario"], row["method"]) == (scenario, method)}
            cells = [f"{1e3 * by[r]['cpu_minimum_s']:.3g} / {_error(by[r]['error'])}" for r in rtols]
            rows.append([f"`{scenario}`" if k == 0 else "", method, *cells])
    return lines(["scenario", "method", *(small(r, 0) for r in rtols)], rows, left=2)


def _error(value: float) -> str:
    # The error of a block at rest is rounding.
    return small(value, 0) if value > 1e-15 else "0"


def sweeps() -> str:
    wall = {(row["runs"], row["jobs"]): row["wall_s"] for row in bench()["sweeps"]}
    rows = [[str(runs), *(fixed(wall[runs, n], 1) for n in (1, 2))] for runs in sorted({run for run, _ in wall})]
    return lines(["runs", "one process", "two processes"], rows)


@cache
def swept(name: str) -> dict[tuple[str, float], dict[str, str]]:
    """Return the rows of a sweep over one key, by variant and value."""
    rows = table_of(f"sweeps/{name}/sweep.csv")
    key = list(rows[0])[2]
    return {(row["variant"], float(row[key])): row for row in rows}


def over_friction(variant: str, column: str, which: Callable[[list[float]], float]) -> float:
    """Return the minimum or maximum (``which``) of a number of a configuration over all frictions."""
    return which([float(row[column]) for (name, _), row in swept("friction").items() if name == variant])


def energy_share(friction: float) -> str:
    """Return the energy of the arm on two elbows relative to the free arm [%]."""
    two, free = (float(swept("friction")[name, friction]["electrical_energy_J"]) for name in ("two_elbows", "no_elbow"))
    return fixed(100 * two / free, 1)


def voltage_needed(*variants: str) -> int:
    """Return the lowest integer voltage from which on the hand error is at most 2 % larger than at 24 V."""
    error = {point: float(row["hand_error_rms_m"]) for point, row in swept("voltage").items() if point[0] in variants}
    enough = {(name, volt) for (name, volt), off in error.items() if off <= 1.02 * error[name, 24.0]}
    return min(
        volt for volt in range(1, 25) if all((name, float(v)) in enough for name in variants for v in range(volt, 25))
    )


def of_masses(number: str, key: str, scale: float = 1.0) -> float:
    """Return a statistic of a number of the summary over random masses of links."""
    statistics = data("sweeps/tolerance/statistics.json")[0]["numbers"][number]
    return scale * float(statistics["mean_high"] - statistics["mean"] if key == "interval" else statistics[key])


def last_link_effect() -> float:
    """Return the effect of one standard deviation of the last link's mass, the largest effect of any link [J]."""
    effect: dict[str, float] = data("sweeps/tolerance/statistics.json")[0]["numbers"]["electrical_energy_J"]["effect"]
    largest = max(effect, key=lambda key: abs(effect[key]))
    assert largest == "plant.chain.9.mass_kg", largest
    return effect[largest]


def snake_bench() -> str:
    rows = [
        [
            row["program"],
            number(row["us_per_step"], 3),
            number(row["times_real_time"], 2),
            number(1e3 * row["z_rms_m"], 2),
            number(1e3 * row["beta_rms_rad"], 2),
        ]
        for row in bench()["snake"]
    ]
    return lines(["program, step", "µs a step", "times real time", "Δz off, rms mm", "Δβ off, rms mrad"], rows)


def touching_bodies() -> str:
    return lines(
        ["case", "program", "µs a step", "times real time", "penetration, µm", "drift, µm"],
        [
            [
                "" if k else row["case"],
                row["program"],
                number(row["us_per_step"], 2),
                number(row["times_real_time"], 2),
                number(1e6 * row["penetration_m"], 2),
                number(1e6 * row["drift_m"], 2) if "drift_m" in row else NONE,
            ]
            for case in ("other", "side", "spheres", "dominoes")
            for k, row in enumerate(bodies(case))
        ],
        left=2,
    )


def slower(case: str) -> str:
    """Return the ratio of a step's time to that of MuJoCo with its defaults."""
    own, peer = (next(r for r in bodies(case) if r["program"] == program) for program in ("dynsim 1 ms", "MuJoCo 1 ms"))
    return number(own["us_per_step"] / peer["us_per_step"], 2)


def falling_dominoes() -> str:
    rows = bodies("dominoes")
    heads = ["program", *(str(k + 2) for k in range(len(rows[0]["falls_s"]))), "wave, m/s"]
    times = [[NONE if t is None else fixed(1e3 * t, 0) for t in row["falls_s"]] for row in rows]
    return lines(heads, [[r["program"], *t, number(r["wave_m_s"], 3)] for r, t in zip(rows, times, strict=True)])


def of_snake(key: str, k: int, own: int = 0) -> float:
    """Return the ratio of a number of program k to the number of dynsim, with its controller (0) or without (1)."""
    rows = bench()["snake"]
    return float(rows[k][key] / rows[own][key])


def between_snakes(k: int, coordinate: int) -> float:
    """Return the rms difference of the head displacements between program k and dynsim."""
    own, peer = (bench()["snake"][n]["displacements"] for n in (0, k))
    return math.hypot(*(a[coordinate] - b[coordinate] for a, b in zip(own, peer, strict=True))) / math.sqrt(len(own))


def comparison() -> str:
    """Return some rows of the table that `dynsim compare elbow_comparison` prints."""
    output = io.StringIO()
    print_comparison(Terminal(file=output, width=120, emoji=False), validation()["elbow_summaries"], every=True)
    kept = ("electrical energy", "hand error, rms", "deepest", "ledger", "two_elbows", "───")
    text = [line[1:].rstrip() for line in output.getvalue().split("warning: ")[0].splitlines()]
    rows = [row for row in text if any(label in row for label in kept) and "times the minimum" not in row]
    return "```\n" + "\n".join(rows) + "\n```\n"


def combinations() -> str:
    """Return the contact laws and methods that support each feature that not all of them support, and why."""

    def supported(names: tuple[str, ...], all_of_them: tuple[str, ...]) -> str:
        return "all" if names == all_of_them else ", ".join(f"`{name}`" for name in names)

    rows = [
        [r.feature, supported(r.laws, LAWS), supported(r.methods, METHODS), f"{r.reason}; {r.fix}"]
        for r in RESTRICTIONS
    ]
    return "\n" + lines(["feature", "contact law", "method", "why, and what to do instead"], rows, left=4) + "\n"


def faults() -> str:
    return "\n" + markdown(data("reference/bridge_faults.json")["cells"]).strip("\n") + "\n\n"


def planned_sizes(file: str) -> dict[int, float]:
    """Return the heat of the published arm by number of braces [W]."""
    return {size["count"]: size["heat_W"] for size in data(f"planner/{file}.json")}


def planned_heat(count: int) -> str:
    """Return the heat of the published arm with ``count`` braces [W]."""
    return fixed(planned_sizes("published")[count], 2)


def planned_saving(count: int) -> str:
    """Return the share of the heat of the published arm with ``count`` − 1 braces that one more brace saves [%]."""
    heat = planned_sizes("published")
    return fixed(100.0 * (1.0 - heat[count] / heat[count - 1]), 0)


def posture_heat(friction: float) -> float:
    """Return the least heat of the published posture at rest, with both elbows pressed [W]."""
    return next(row["heat_W"] for row in data("planner/posture.json") if row["friction"] == friction)


def planned_arm() -> str:
    """Return the plans of the published arm, for braces with friction and without."""
    rows = []
    for friction, file in (("0.1", "published"), ("0", "frictionless")):
        for size in data(f"planner/{file}.json"):
            braces = size["braces"].replace(" on floor", "")
            forces = NONE
            if size["normal_force_min_N"] is not None:
                forces = f"{fixed(size['normal_force_min_N'], 1)} … {fixed(size['normal_force_max_N'], 1)}"
            heat, simulated = number(size["heat_W"]), number(size["simulated_W"])
            verdict = "yes" if size["survives"] else "no"
            rows.append((friction, braces, heat, simulated, forces, f"{size['k_p_V_per_rad']:g}", verdict))
    heads = ("μ", "braces", "heat [W]", "simulated [W]", "forces [N]", "k_p [V/rad]", "survives")
    return lines(heads, rows, left=2)


def beside_best_known(scene: dict[str, Any]) -> dict[int, float]:
    """Return the least heat found by a search over the least known heat of the scene, by number of braces."""
    long = next(entry for entry in data("planner/reference.json") if entry["seed"] == scene["seed"])
    known = {size["count"]: size["heat_W"] for size in long["sizes"]}
    ratios = {}
    for size in scene["sizes"]:
        heats = [heat for heat in (size["least_W"], known.get(size["count"])) if heat is not None]
        if heats:
            ratios[size["count"]] = (size["least_W"] or math.inf) / min(heats)
    return ratios


def best_beside_best_known(scene: dict[str, Any], known: str = "heat_W") -> float:
    """Return the same ratio for the best number of braces; ``searched_W``: over the result of the long search."""
    long = next(entry for entry in data("planner/reference.json") if entry["seed"] == scene["seed"])
    own = min(size["least_W"] for size in scene["sizes"] if size["least_W"] is not None)
    return float(own / min(own, *(size[known] for size in long["sizes"] if size[known] is not None)))


def planned_share(limit: float, each: bool = False, known: str = "heat_W") -> str:
    """Return how many scenes, or numbers of braces of each scene, are within a ratio of the best known heat."""
    scenes = data("planner/scenes.json")
    if each:
        ratios = [ratio for scene in scenes for ratio in beside_best_known(scene).values()]
    else:
        ratios = [best_beside_best_known(scene, known) for scene in scenes]
    return str(sum(ratio <= limit for ratio in ratios))


def planned_answers() -> list[dict[str, Any]]:
    """Return the best answer of each scene."""
    scenes = data("planner/scenes.json")
    return [size for scene in scenes for size in scene["sizes"] if size["count"] == scene["best"]]


def planned_change(other: str) -> float:
    """Return the largest change from the heat of the best answers to another of their numbers [%]."""
    sizes = [size for size in planned_answers() if size[other] is not None]
    return max(100.0 * abs(size[other] / size["heat_W"] - 1.0) for size in sizes)


def planned_nominal() -> list[float]:
    """Return the simulated heat of the best answers, run as planned, over the planned heat."""
    return [size["simulated_W"] / size["heat_W"] for size in planned_answers()]


def planned_gains() -> str:
    """Return the cost of plans on surfaces displaced by 5 mm, by gain."""
    rows = []
    for row in data("planner/gains.json"):
        arm = "published" if row["scene"].startswith("pressing") else row["scene"].replace("_", " ")
        times = [
            number(row["times_the_heat"][f"{shift:+g} mm"]) for shift in (0, 5, -5) if len(row["times_the_heat"]) == 3
        ]
        verdict = "yes" if row["survives"] else "no"
        head = (arm, f"{row['friction']:g}", str(row["count"]), f"{row['k_p_V_per_rad']:g}")
        rows.append((*head, *times, *(NONE,) * (3 - len(times)), verdict))
    heads = ("arm", "μ", "braces", "k_p [V/rad]", "as planned", "5 mm up", "5 mm down", "survives")
    return lines(heads, rows)


def planned_phases() -> str:
    """Return the heat of fixed braces, of braces that change, and of their runs."""
    rows = []
    for row in data("planner/phases.json"):
        chosen = "→" in row["chosen"]
        runs = (number(row["simulated_W"]), number(row["worst_W"])) if chosen else (NONE, NONE)
        verdict = NONE if not chosen else "yes" if row["survives"] else "no"
        change = number(row["changing_W"]) + ("" if chosen else " (not chosen)")
        seeds = f"{number(min(row['seeds_W']))} … {number(max(row['seeds_W']))}"
        rows.append((row["path"], number(row["fixed_W"]), change, seeds, *runs, verdict))
    heads = ("path of the hand", "fixed braces", "changing braces", "five seeds", "run", "worst run", "survives")
    return lines(heads, rows)


def planned_scenes() -> str:
    """Return the answer of each scene of the planner."""
    rows = []
    for scene in data("planner/scenes.json"):
        free = scene["sizes"][0]["heat_W"]
        best = next((size for size in scene["sizes"] if size["count"] == scene["best"]), None)
        head = (str(scene["seed"]), scene["kind"].replace("_", " "), str(scene["joints"]), f"{scene['friction']:g}")
        if best is None:
            rows.append((*head, *(NONE,) * 7))
            continue
        gain, verdict = f"{best['k_p_V_per_rad']:g}", "yes" if best["survives"] else "no"
        near = fixed(best_beside_best_known(scene), 3)
        heats = (number(best["heat_W"]), number(best["simulated_W"]))
        rows.append((*head, number(free), str(best["count"]), *heats, near, gain, verdict))
    heads = (
        "scene", "with", "joints", "μ", "unbraced [W]", "braces", "heat [W]", "simulated [W]", "best known", "k_p",
        "survives",
    )  # fmt: skip
    return lines(heads, rows, left=2)


def brace_pads() -> str:
    """Return the best position of the pad for each height of the bench."""
    height, pad = "surfaces.bench.center_m.2", "contacts.points.pad.point_m.2"
    plans = data("planner/brace_pad.json")
    rows = []
    for top in dict.fromkeys(row[height] for row in plans):
        best = min((row for row in plans if row[height] == top), key=lambda row: (not row["survives"], row["heat_W"]))
        numbers = (fixed(best["heat_W"], 2), fixed(1e3 * best["hand_sag_m"], 2), fixed(best["rating_share"], 2))
        at = fixed(best[pad], 1) if best["count"] else NONE
        rows.append((fixed(top + 0.05, 2), at, *numbers, "yes" if best["survives"] else "no"))
    return lines(("top [m]", "pad [m]", "heat [W]", "hand sag [mm]", "rms torque / rating", "survives"), rows)


def pad_free(key: str) -> float:
    """Return a number of the arm without the pad."""
    return float(next(row[key] for row in data("planner/brace_pad.json") if row["count"] == 0))


def snake_table_iii() -> str:
    """Return Table III of the paper on the snake, with the simulated values."""
    shown = ("paper_mean", "paper_sd", "kinematic", "dynamic", "measured")
    heads = ["moved", "quantity", "[T] mean", "[T] SD", "kinematic", "dynamic", "measured"]
    rows = [
        [row["variant"], f"`{row['quantity']}`", *(f"{float(row[name]) + 0.0:.4g}" for name in shown[:2])]
        + [f"{round(float(row[name]), 4) + 0.0:.4f}" for name in shown[2:]]
        for row in table_of("snake/table_iii.csv")
    ]
    return lines(heads, rows, left=2)


def snake_pushes(file: str) -> str:
    """Return Table IV or V of the paper on the snake, with the simulated values."""
    heads = ("posture", "direction", "[T] mean [N]", "[T] SD [N]", "simulated [N]", "target in the plate [mm]")
    rows = [
        (
            f"({row['posture']})", row["direction"], row["paper_mean"], row["paper_sd"],
            f"{float(row['simulated']):.1f}", f"{1e3 * float(row['depth_m']):.0f}",
        )
        for row in table_of(f"snake/{file}.csv")
    ]  # fmt: skip
    return lines(heads, rows, left=2)


def snake_table_iv() -> str:
    return snake_pushes("table_iv")


def snake_table_v() -> str:
    return snake_pushes("table_v")


def steps() -> Any:
    return data("snake/steps.json")


def observed(key: str) -> Any:
    """Return one of the observations of the dynamic snake."""
    return data("snake/observations.json")[key]


def snake_tasks() -> str:
    """Return the result of each task by level; gripper forces and torques, and energy, at the dynamic level."""
    runs = data("snake/tasks.json")["runs"]
    lines = [
        "| task | kinematic | dynamic | gripper, largest | supplied |",
        "|---|---|---|---|---|",
    ]
    for by_level in zip(runs[::2], runs[1::2], strict=True):
        moved = [
            f"{round(run['moved'], 1) + 0.0:.1f} {run['unit']}{', ' * bool(run['end'])}{run['end']}" for run in by_level
        ]
        dynamic = by_level[1]
        held = f"{dynamic['force_N']:.3g} N, {dynamic['torque_N_m']:.2g} N m" if dynamic["force_N"] else NONE
        name = f"`{dynamic['scenario']}` `{dynamic['variant']}`"
        lines.append(f"| {name} | {moved[0]} | {moved[1]} | {held} | {dynamic['supplied_J']:.0f} J |")
    return "\n".join(lines) + "\n"


def converged(key: str) -> float:
    """Return the largest error of the head with measured feedback, over both runs."""
    return max(run[key] for run in observed("measured_feedback").values())


def wheel_heights(which: int) -> list[float]:
    """Return the heights of the lower (0) or the higher (1) wheel of all lifted pairs [mm]."""
    return [pair[which] for pair in observed("lifted_wheels_mm").values()]


def end_value_mm(moved: str, column: int) -> float:
    """Return the displacement of the head with the shortest step, in a manoeuvre of Table III [mm]."""
    return 1e3 * steps()["end_values"][moved][0][column]


@cache
def bases() -> dict[tuple[float, float, float], dict[str, tuple[bool, float]]]:
    """Return whether each base (mass, track, caster) of the sweep stands, and its settled tip margin, by variant."""
    outcomes: dict[tuple[float, float, float], dict[str, tuple[bool, float]]] = {}
    for row in table_of("overturning/sweep.csv"):
        base = float(row["mass_kg"]), float(row["track_m"]), float(row["caster_m"])
        margin = float(row["tip_margin_min_settled"] or "nan")
        outcomes.setdefault(base, {})[row["variant"]] = row["stands"] == "True", margin
    return outcomes


def standing(variant: str) -> int:
    return sum(base[variant][0] for base in bases().values())


def least_standing(variant: str, axis: int, **fixed_at: float) -> tuple[float, float]:
    """Return the largest value along an axis of the sweep at which the base falls, and the next, at which it stands.

    ``fixed_at`` : values of the other two axes
    """
    names = ("mass", "track", "caster")
    line = {
        base[axis]: outcome[variant][0]
        for base, outcome in bases().items()
        if all(base[names.index(name)] == value for name, value in fixed_at.items())
    }
    falls = max(value for value, stands in line.items() if not stands)
    return falls, min(value for value, stands in line.items() if value > falls)


def kinematic() -> Any:
    return data("snake/kinematic.json")


def lifted_wheels() -> Any:
    return data("snake/lifted_wheels.json")


def of_kinematic(name: str, variant: str = "") -> dict[str, Any]:
    """Return the numbers of a run of the kinematic snake."""
    numbers: dict[str, Any] = kinematic()["runs"][name][variant]
    return numbers


def both(run: dict[str, Any], first: str, second: str) -> str:
    return f"{small(run[first])}, {small(run[second])}"


def snake_positioning() -> str:
    """Return the remaining error in each direction, next to the error measured in the paper."""
    symbols = {"alpha": "α", "beta": "β", "gamma": "γ"}
    rows = [
        (
            symbols.get(moved, moved),
            small(run["final_position_error_m"]),
            small(run["final_attitude_error_rad"]),
            both(run, "position_error_max_m", "attitude_error_max_rad"),
            f"{PAPER_ERROR_PERCENT[moved]:g} %",
        )
        for moved, run in kinematic()["runs"]["snake_positioning"].items()
    ]
    heads = ("moved", "end error, position [m]", "attitude [rad]", "largest during the run [m], [rad]", "[T]")
    return lines(heads, rows, left=1)


def snake_limits() -> str:
    """Return the results for each policy of modes and limits, and for each cost."""
    rows = [
        (
            f"`{variant}`",
            f"{number(run['cost_initial'])} → {number(run['cost_final'])}",
            number(run["joint_limit_violation_max_rad"], 3),
            both(run, "position_error_max_m", "attitude_error_max_rad"),
            str(run["mode_switches"]),
        )
        for variant, run in kinematic()["runs"]["snake_joint_limits"].items()
    ]
    heads = ("variant", "V start → end", "limit passed by [rad]", "head error, max [m], [rad]", "switches")
    return lines(heads, rows, left=1)


def snake_ways() -> str:
    """Return how long the target waited, forward and backward."""
    rows = []
    for name in ("snake_circle", "snake_circle_backward", "snake_door_arc"):
        for variant, run in kinematic()["runs"][name].items():
            waited = f"{fixed(run['waiting_s'], 2)} of {run['duration_s']:g}" if run["waiting_s"] else "0"
            title = f"`{name}` `{variant}`" if variant else f"`{name}`"
            rows.append((title, waited, str(run["mode_switches"]), small(run["position_error_max_m"])))
    return lines(("scenario, variant", "target waited [s]", "switches", "largest head error [m]"), rows, left=1)


def snake_circles() -> str:
    """Return the results of the circle backward with less time or another least margin."""
    rows = [
        (f"{circle['path_s']:g} s", f"{1e3 * circle['least_margin_m']:g} mm", f"{fixed(abs(circle['turned_deg']), 1)}°")
        for circle in kinematic()["circles"]
    ]
    return lines(("duration", "least margin", "ends at"), rows, left=0)


def snake_order() -> str:
    """Return the order in which the joints of the base fall below half of their initial angle."""
    rows = []
    for entry in kinematic()["order"]:
        times = sorted((time, name) for name, time in entry["halved_s"].items() if time is not None)
        order = ", ".join(f"{name.replace('theta', 'θ')} ({time:.1f} s)" for time, name in times)
        rows.append((f"{entry['null_gain']:g}", order, fixed(entry["null_space_reduced_s"], 1)))
    return lines(("k_η", "joints in their order", "null-space motion reduced [s]"), rows, left=3)


def snake_areas() -> str:
    """Return the support area and straightness to which each cost leads."""
    names = {"cyclic": "eq 19", "eq20": "eq 20 as printed", "eq20_min": "1/min d"}
    rows = []
    for variant, title in names.items():
        run = of_kinematic("snake_joint_limits", variant)
        rows.append((title, number(run["support_area_final_m2"]), number(run["base_rms_rad"], 3)))
    return lines(("cost, cyclic switching", "support area [m²]", "base part, rms angle [rad]"), rows, left=1)


def snake_on_servos() -> str:
    """Return the result of the check before a replay for each kinematic record, with the shipped and a wider map."""
    rows: dict[tuple[str, ...], list[str]] = {}
    for name, variants in kinematic()["servos"].items():
        for variant, said in variants.items():
            title = f"`{variant}`" if variant else ""
            rows.setdefault((f"`{name}`", reason(said["shipped"]), reason(said["wider"])), []).append(title)
    shown = [(f"{name} {', '.join(titles)}".strip(), *said) for (name, *said), titles in rows.items()]
    return lines(("record", "shipped map", "wider map"), shown, left=3)


def reason(refusal: str) -> str:
    """Return a short reason why a replay is refused."""
    if not refusal:
        return "passes"
    first, *entries = refusal.splitlines()
    if not entries:
        return re.split(r"[:;(]", first)[0].strip()
    violated = [entry.partition(", margin")[0].strip() for entry in entries if "margin" in entry]
    more = f", and {len(violated) - 1} more" if len(violated) > 1 else ""
    hint = f"; `{entries[-1].split(' would')[0].strip()}` passes" if "would pass" in entries[-1] else ""
    return f"{violated[0]}{more}{hint}"


def backward_circle() -> dict[str, Any]:
    """Return the numbers of the circle backward that is completed."""
    return of_kinematic("snake_circle_backward")


def turned(name: str, variant: str, digits: int = 1) -> str:
    """Return the yaw of the head from start to end [deg]."""
    return fixed(abs(of_kinematic(name, variant)["turned_deg"]), digits)


def fall_order(theta: str) -> str:
    """Return the factor by which halving the step reduces the error of the falling head, from two halvings."""
    coarse, _, fine = steps()["fall_errors_m"][theta]
    return fixed(math.sqrt(coarse / fine), 1)


def sag_error(quantity: str) -> float:
    """Return the rms deviation of the dynamic snake from the paper in a quantity, over the six manoeuvres."""
    off = [
        float(row["dynamic"]) - float(row["paper_mean"])
        for row in table_of("snake/table_iii.csv")
        if row["quantity"] == quantity
    ]
    return math.sqrt(sum(x * x for x in off) / len(off))


def modules() -> str:
    """Return a table of the files of the package with the first lines of their docstrings."""
    package = ROOT / "dynsim"
    rows = ["| file | contents |", "|---|---|"]
    folders = [package, *sorted(path.parent for path in package.rglob("__init__.py") if path.parent != package)]
    for folder in folders:
        for path in sorted(folder.glob("*.py"), key=lambda path: (path.name != "__init__.py", path.name)):
            text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
            first = " ".join(text.split("\n\n")[0].split()).replace("|", r"\|").removesuffix(".")
            name = path.relative_to(package)
            if path.name == "__init__.py":
                rows.append(f"| **dynsim/{'' if folder == package else f'{name.parent}/'}** | {first} |")
            elif not path.name.startswith("_"):
                rows.append(f"| `{name}` | {first} |")
    return "\n".join(rows) + "\n"


TABLES: dict[str, Callable[[], str]] = {
    table.__name__: table
    for table in (
        elbows, glued_and_real, overturning_holds, overturning_drives, assumptions, ledger,
        snake_table_iii, snake_table_iv, snake_table_v, time_stepping, endings, right_hand_side, ratios, job, precision,
        sweeps, snake_bench, touching_bodies, falling_dominoes,
        scenario_keys, combinations, comparison, faults, planned_arm, planned_gains, planned_phases, planned_scenes,
        brace_pads, snake_positioning, snake_limits,
        snake_ways, snake_circles, snake_order, snake_areas, snake_on_servos, snake_tasks, modules,
    )
}  # fmt: skip


def run(name: str) -> dict[str, Any]:
    numbers: dict[str, Any] = validation()["runs"][name]
    return numbers


def residual(name: str) -> str:
    return small(run(name)["energy_residual_relative"])


def energy(name: str) -> str:
    return number(run(name)["electrical_energy_J"])


def error(name: str, digits: int = 3) -> str:
    return number(1e3 * run(name)["hand_error_rms_m"], digits)


def ratio_of_energies(first: str, second: str) -> float:
    return float(run(first)["electrical_energy_J"] / run(second)["electrical_energy_J"])


def of_job(case: str, program: str) -> dict[str, Any]:
    return next(entry for entry in bench()["job"] if (entry["case"], entry["program"]) == (case, program))


def against_mujoco(case: str, program: str) -> str:
    return fixed(of_job(case, program)["cpu_median_s"] / of_job(case, DYNSIM_RADAU5)["cpu_median_s"], 1)


def of_contact(scenario: str, variant: str, name: str) -> dict[str, Any]:
    numbers: dict[str, Any] = contact()[scenario][variant]["contacts"][name]
    return numbers


def event(variant: str, kind: str, which: int = 0) -> float:
    times = [
        time for time, event_kind, _ in contact()["elbow_comparison_floor"][variant]["events"] if event_kind == kind
    ]
    return float(times[which])


def stuck(which: int) -> float:
    """Return how long elbow 7 does not move, with both elbows on a real floor [s]."""
    starts = [event("two_elbows", "slip_start", k) for k in (1, 2)]
    return starts[which] - event("two_elbows", "slip_stop", which)


def brush() -> dict[str, Any]:
    """Return the run of an arm without elbows whose links may touch."""
    numbers: dict[str, Any] = contact()["elbow_comparison_links"]["no_elbow"]
    return numbers


def of_each(key: str) -> list[float]:
    """Return a number of each of the four configurations."""
    return [float(summary[key]) for summary in validation()["elbows"].values()]


def at_the_start(key: str) -> float:
    """Return a number of the forces on the glued elbows at the start."""
    return float(validation()["forces_with_two_elbows"][key])


def apart(which: str, key: str) -> float:
    """Return the difference between two runs."""
    return float(validation()["differences"][which][key])


def assumed(case: str) -> dict[str, float]:
    """Return the results of two elbows with one assumption changed."""
    numbers: dict[str, float] = data("reference/assumptions.json")["cases"][case]["two_elbows"]
    return numbers


def dissipative_energy() -> float:
    return assumed("friction μ |f_n|")["electrical_energy_J"]


def on_floor(first: str, second: str, key: str) -> float:
    """Return the ratio of two configurations on a real floor."""
    return float(contact()["elbow_comparison_floor"][first][key] / contact()["elbow_comparison_floor"][second][key])


def real_less_glued(variant: str, key: str) -> float:
    return float(contact()["elbow_comparison_floor"][variant][key] - contact()["elbow_comparison"][variant][key])


def longest_below_zero_ms() -> float:
    """Return the longest time for which the tip margin of a braced base is below zero at the start [ms]."""
    spans = [
        summary["margin_below_zero_s"][0]
        for variant, summary in overturning()["mobile_elbow_comparison"].items()
        if variant != "no_elbow"
    ]
    return 1e3 * max(end - begin for begin, end in spans)


def explicit_over_implicit() -> list[float]:
    """Return the time of dopri5 over the time of radau5 at each tolerance, for the published arm."""
    time = {
        (row["method"], row["rtol"]): row["cpu_minimum_s"]
        for row in bench()["precision"]
        if row["scenario"] == "elbow_comparison"
    }
    return [time["dopri5", rtol] / time["radau5", rtol] for method, rtol in time if method == "radau5"]


def battery(column: str) -> list[float]:
    """Return a column of the energy table of the dynamic snake, by manoeuvre."""
    return [float(row[column]) for row in table_of("snake/energy.csv")]


HELD_CASE = "two elbows held, no friction"
NUMBERS: dict[str, Callable[[], str]] = {
    "saving": lambda: fixed(ratio_of_energies("elbow_comparison no_elbow", "elbow_comparison two_elbows"), 0),
    "energy_two": lambda: energy("elbow_comparison two_elbows"),
    "energy_7": lambda: energy("elbow_comparison elbow_7"),
    "error_two": lambda: fixed(1e3 * run("elbow_comparison two_elbows")["hand_error_rms_m"], 1),
    "error_7": lambda: fixed(1e3 * run("elbow_comparison elbow_7")["hand_error_rms_m"], 1),
    "hang": lambda: fixed(1e3 * validation()["elbows"]["no_elbow"]["hand_error_z_rms_m"], 0),
    "depth_none": lambda: _depth("no_elbow", "joint_depth_max_m"),
    "depth_4": lambda: _depth("elbow_4", "joint_depth_max_m"),
    "pulling": lambda: percent(of_contact("elbow_comparison", "two_elbows", "elbow_4")["pulling_fraction"]),
    "lift_off_ms": lambda: fixed(1e3 * event("two_elbows", "lift_off", 1), 1),
    "lift_7_ms": lambda: fixed(1e3 * event("two_elbows", "lift_off"), 1),
    "landing_7_ms": lambda: fixed(1e3 * event("two_elbows", "landing"), 0),
    "stuck_1_s": lambda: fixed(stuck(0), 2),
    "stuck_2_s": lambda: fixed(stuck(1), 2),
    "brush_s": lambda: fixed(brush()["events"][0][0], 3),
    "brush_ms": lambda: fixed(1e3 * (brush()["events"][1][0] - brush()["events"][0][0]), 0),
    "job_held_ms": lambda: number(1e3 * of_job(HELD_CASE, DYNSIM_RADAU5)["cpu_median_s"], 2),
    "job_held_ratio": lambda: against_mujoco(HELD_CASE, MUJOCO_EULER),
    "job_held_ratio_implicit": lambda: against_mujoco(HELD_CASE, MUJOCO_IMPLICIT),
    "job_free_ratio": lambda: against_mujoco("free arm", MUJOCO_EULER),
    "job_free_ratio_implicit": lambda: against_mujoco("free arm", MUJOCO_IMPLICIT),
    "boxes_slower": lambda: slower("other"),
    "beside_slower": lambda: slower("side"),
    "dominoes_slower": lambda: slower("dominoes"),
    "snake_slower": lambda: fixed(1.0 / of_snake("us_per_step", 2), 1),
    "snake_alone": lambda: percent(1.0 / of_snake("us_per_step", 2, 1)),
    "snake_slower_stiff": lambda: fixed(1.0 / of_snake("times_real_time", 3), 1),
    "snake_farther": lambda: fixed(of_snake("z_rms_m", 2), 1),
    "snake_apart_mm": lambda: fixed(1e3 * between_snakes(4, Z), 1),
    "snake_apart_mrad": lambda: fixed(1e3 * between_snakes(4, BETA), 1),
    "rhs_us": lambda: number(by_links()[1][10, DYNSIM_CONTACTS], 2),
    "cold_wall_s": lambda: number(start_up()["radau5"]["cold"]["wall_s"], 2),
    "cold_cpu_s": lambda: number(start_up()["radau5"]["cold"]["cpu_s"], 2),
    "warm_wall_s": lambda: number(start_up()["radau5"]["warm"]["wall_s"], 2),
    "warm_cpu_s": lambda: number(start_up()["radau5"]["warm"]["cpu_s"], 2),
    "compare_wall_s": lambda: number(start_up()["radau5"]["compare"]["wall_s"], 2),
    "compare_cpu_s": lambda: number(start_up()["radau5"]["compare"]["cpu_s"], 2),
    "cold_explicit_cpu_s": lambda: number(start_up()["dopri5"]["cold"]["cpu_s"], 2),
    "rotor_disc_J": lambda: fixed(validation()["electrical_energy_by_rotor_model_J"]["spinning"], 2),
    "rotor_armature_J": lambda: fixed(validation()["electrical_energy_by_rotor_model_J"]["armature"], 2),
    "knock_acceleration": lambda: number(validation()["knock_at_the_start"]["acceleration"], 4),
    "knock_jerk": lambda: number(validation()["knock_at_the_start"]["jerk"], 5),
    "knock_shaking": lambda: fixed(validation()["knock_at_the_start"]["shaking"], 2),
}  # fmt: skip
for _name, _runs in {
    "slope": ("block_on_slope rests", "block_on_slope slides", "block_on_slope pulled"),
    "bounce": ("bouncing_link half", "bouncing_link dead", "bouncing_link lively"),
    "fall": ("falling_arm",),
    "below": ("floor_below lands", "floor_below deep"),
    "wall": ("wall_push weak_hold", "wall_push strong_hold"),
    "pressing": ("pressing plain", "pressing gravity", "pressing commanded", "pressing optimal"),
    "pipe": ("brace_on_cylinder real",),
}.items():
    for _k, _run in enumerate(_runs, 1):
        NUMBERS[f"{_name}_{_k}_ledger"] = lambda name=_run: residual(name)
        NUMBERS[f"{_name}_{_k}_J"] = lambda name=_run: energy(name)
NUMBERS |= {
    "robot_files": robot_files,
    "robot_files_loaded": lambda: robot_files("loads"),
    "robot_files_agree": lambda: str(
        sum(row.get("agrees", False) for row in data("reference/robot_files.json")["files"].values())
    ),
    "robot_files_corrected": lambda: robot_files("loads after"),
    "slope_slip_s": lambda: fixed(run("block_on_slope pulled")["first_at_s"]["slip_start"], 4),
    "bounces_half": lambda: str(run("bouncing_link half")["events"].get("bounce", 0)),
    "bounces_dead": lambda: str(run("bouncing_link dead")["events"].get("bounce", 0)),
    "bounces_lively": lambda: str(run("bouncing_link lively")["events"].get("bounce", 0)),
    "fall_landings": lambda: str(run("falling_arm")["events"]["landing"]),
    "fall_lift_offs": lambda: str(run("falling_arm")["events"]["lift_off"]),
    "fall_rebounds": lambda: str(run("falling_arm")["events"]["bounce"]),
    "below_landing_s": lambda: fixed(run("floor_below lands")["first_at_s"]["landing"], 3),
    "below_mm": lambda: error("floor_below lands"),
    "snake_pull_deg": lambda: turned("snake_door_arc", "pull"),
    "snake_circle_deg": lambda: turned("snake_circle", "backward_switching"),
    "snake_singular_s": lambda: fixed(backward_circle()["waiting_for_s"]["singular posture"], 1),
    "snake_margin_mm": lambda: fixed(1e3 * backward_circle()["support_margin_min_m"], 1),
    "snake_operator_m": lambda: small(of_kinematic("snake_operator")["final_position_error_m"]),
    "snake_operator_rad": lambda: small(of_kinematic("snake_operator")["final_attitude_error_rad"]),
    "snake_operator_switches": lambda: str(of_kinematic("snake_operator")["mode_switches"]),
    "snake_eq20_jump": lambda: small(kinematic()["eq20_predictive"]["cost_rise_max_within_a_mode"]),
    "snake_dz_mm": lambda: fixed(1e3 * sag_error("dz_m"), 1),
    "snake_steps_mm": lambda: fixed(steps()["spread_mm"], 2),
    "snake_steps_mrad": lambda: fixed(steps()["spread_mrad"], 2),
    "tasks_ledger": lambda: small(max(run.get("ledger", 0.0) for run in data("snake/tasks.json")["runs"]), 0),
    "snake_measured_mm": lambda: fixed(converged("position_mm"), 1),
    "snake_measured_mrad": lambda: fixed(converged("attitude_mrad"), 1),
    "snake_y_paper_y": lambda: fixed(1e3 * TABLE_III["y"].mean[1], 0),
    "snake_y_paper_x": lambda: fixed(1e3 * TABLE_III["y"].mean[0], 0),
    "snake_y_y": lambda: fixed(end_value_mm("y", 1), 0),
    "snake_y_x": lambda: fixed(end_value_mm("y", 0), 0),
    "snake_shaken_mm": lambda: fixed(observed("mode_switching")["moved_mm"], 0),
    "snake_shaken_rad": lambda: fixed(observed("mode_switching")["turned_rad"], 2),
    "snake_switched_mm": lambda: fixed(observed("mode_switching")["error_mm"], 0),
    "snake_switched_rad": lambda: fixed(observed("mode_switching")["error_rad"], 2),
    "snake_switched_first_mm": lambda: fixed(observed("mode_switching")["first_error_mm"], 0),
    "snake_lower_least": lambda: fixed(min(wheel_heights(0)), 0),
    "snake_lower_most": lambda: fixed(max(wheel_heights(0)), 0),
    "snake_higher_least": lambda: fixed(min(wheel_heights(1)), 0),
    "snake_higher_most": lambda: fixed(max(wheel_heights(1)), 0),
    "bases": lambda: str(len(bases())),
    "bases_stand_two": lambda: str(standing("two_elbows")),
    "bases_stand_7": lambda: str(standing("elbow_7")),
    "bases_least_two": lambda: fixed(min(base["two_elbows"][1] for base in bases().values()), 3),
    "bases_least_7": lambda: fixed(min(base["elbow_7"][1] for base in bases().values()), 3),
    "bases_fall": lambda: str(len(bases()) - standing("no_elbow")),
    "bases_stand": lambda: str(standing("no_elbow")),
    "bases_fall_kg": lambda: number(least_standing("no_elbow", 0, track=0.3, caster=0.15)[0], 1),
    "bases_stand_kg": lambda: number(least_standing("no_elbow", 0, track=0.3, caster=0.15)[1], 2),
    "bases_fall_caster": lambda: number(least_standing("no_elbow", 2, mass=4.0, track=0.3)[0], 1),
    "bases_stand_caster": lambda: number(least_standing("no_elbow", 2, mass=4.0, track=0.3)[1], 2),
    "bases_fulcrum_kg": lambda: number(max(base[0] for base, x in bases().items() if not x["elbow_4"][0]), 1),
    "bases_only_4_falls": lambda: str(sum(x["no_elbow"][0] and not x["elbow_4"][0] for x in bases().values())),
    "bases_fulcrum_N": lambda: fixed(
        run("mobile_elbow_comparison elbow_4")["contacts"]["elbow_4"]["normal_force_mean_N"], 1
    ),
    "snake_fall_half": lambda: fall_order("theta_0.5"),
    "snake_fall_one": lambda: fall_order("theta_1"),
    "snake_dbeta_rad": lambda: fixed(sag_error("dbeta_rad"), 3),
    "below_touch_ms": lambda: fixed(1e4 * run("floor_below deep")["contacts"]["joint_7"]["closed_fraction"], 0),
    "wall_slip_s": lambda: fixed(run("wall_push weak_hold")["first_at_s"]["slip_start"], 2),
    "wall_weak_N": lambda: fixed(run("wall_push weak_hold")["contacts"]["elbow"]["normal_force_max_N"], 1),
    "wall_strong_N": lambda: fixed(run("wall_push strong_hold")["contacts"]["elbow"]["normal_force_max_N"], 1),
    "wall_ratio": lambda: fixed(ratio_of_energies("wall_push strong_hold", "wall_push weak_hold"), 1),
    "pressing_1_mm": lambda: error("pressing plain"),
    "pressing_2_mm": lambda: error("pressing gravity", 2),
    "pressing_3_mm": lambda: fixed(1e3 * run("pressing commanded")["hand_error_rms_m"], 2),
    "pressing_4_mm": lambda: fixed(1e3 * run("pressing optimal")["hand_error_rms_m"], 2),
    "published_W": lambda: fixed(0.1 * run("pressing plain")["electrical_energy_J"], 1),
    "tilted_yaw_operator": lambda: fixed(lifted_wheels()["records"]["snake_operator"]["yaw_deg"], 0),
    "tilted_operator_mm": lambda: number(lifted_wheels()["records"]["snake_operator"]["other_wheel_mm"], 2),
    "tilted_yaw_positioning": lambda: fixed(lifted_wheels()["records"]["snake_positioning"]["yaw_deg"], 0),
    "tilted_positioning_mm": lambda: number(lifted_wheels()["records"]["snake_positioning"]["other_wheel_mm"], 2),
    "tilted_yaw_limits": lambda: fixed(lifted_wheels()["records"]["snake_joint_limits"]["yaw_deg"], 0),
    "tilted_limits_mm": lambda: number(lifted_wheels()["records"]["snake_joint_limits"]["other_wheel_mm"], 2),
    "least_deviation_mm": lambda: number(lifted_wheels()["least_deviation_mm"], 2),
    "axle_off_mm": lambda: number(lifted_wheels()["grounded_axle_off_mm"], 2),
    "axle_off_mrad": lambda: number(lifted_wheels()["grounded_axle_off_mrad"], 1),
    "ticks_rms_mm": lambda: number(lifted_wheels()["in_ticks"]["off_rms_mm"], 2),
    "ticks_max_mm": lambda: number(lifted_wheels()["in_ticks"]["off_max_mm"], 2),
    "ticks_clear_mm": lambda: number(lifted_wheels()["in_ticks"]["clear_mm"], 2),
    "pad_free_mm": lambda: fixed(1e3 * pad_free("hand_sag_m"), 2),
    "pad_free_share": lambda: fixed(pad_free("rating_share"), 2),
    "planned_1_W": lambda: planned_heat(1),
    "planned_2_W": lambda: planned_heat(2),
    "planned_3_W": lambda: planned_heat(3),
    "planned_4_W": lambda: planned_heat(4),
    "posture_0_W": lambda: fixed(posture_heat(0.0), 1),
    "posture_W": lambda: fixed(posture_heat(0.1), 1),
    "posture_times": lambda: fixed(posture_heat(0.0) / planned_sizes("frictionless")[2], 0),
    "planned_3_saves": lambda: planned_saving(3),
    "planned_4_saves": lambda: planned_saving(4),
    "planned_within_1": lambda: planned_share(1.01),
    "planned_within_5": lambda: planned_share(1.05),
    "planned_searched_1": lambda: planned_share(1.01, known="searched_W"),
    "planned_searched_5": lambda: planned_share(1.05, known="searched_W"),
    "planned_each_within_1": lambda: planned_share(1.01, each=True),
    "planned_each_within_5": lambda: planned_share(1.05, each=True),
    "planned_each": lambda: planned_share(math.inf, each=True),
    "planned_effort": lambda: str(data("planner/reference.json")[0]["effort"]),
    "planned_accepted": lambda: str(sum(bool(size["survives"]) for size in planned_answers())),
    "planned_cpu_s": lambda: fixed(max(scene["search_cpu_s"] for scene in data("planner/scenes.json")), 1),
    "planned_floor_cpu_s": lambda: fixed(
        max(scene["search_cpu_s"] for scene in data("planner/scenes.json") if scene["kind"] == "floor"), 1
    ),
    "planned_instants": lambda: fixed(planned_change("with_4_times_the_instants_W"), 1),
    "planned_over": lambda: fixed(100.0 * (max(planned_nominal()) - 1.0), 1),
    "planned_under": lambda: fixed(100.0 * (1.0 - min(planned_nominal())), 0),
    "friction_share_low": lambda: energy_share(0.0),
    "friction_share_high": lambda: energy_share(0.5),
    "friction_two_low": lambda: fixed(over_friction("two_elbows", "electrical_energy_J", min), 0),
    "friction_two_high": lambda: fixed(over_friction("two_elbows", "electrical_energy_J", max), 0),
    "friction_free": lambda: fixed(over_friction("no_elbow", "electrical_energy_J", max), 0),
    "friction_mm_low": lambda: fixed(1e3 * over_friction("two_elbows", "hand_error_rms_m", min), 0),
    "friction_mm_high": lambda: fixed(1e3 * over_friction("two_elbows", "hand_error_rms_m", max), 0),
    "friction_mm_free": lambda: fixed(1e3 * over_friction("no_elbow", "hand_error_rms_m", max), 0),
    "volts_braced": lambda: str(voltage_needed("two_elbows", "elbow_7")),
    "volts_4": lambda: str(voltage_needed("elbow_4")),
    "volts_free": lambda: str(voltage_needed("no_elbow")),
    "volts_off_m": lambda: fixed(float(swept("voltage")["two_elbows", 3.0]["hand_error_rms_m"]), 2),
    "masses_J": lambda: fixed(of_masses("electrical_energy_J", "mean"), 3),
    "masses_J_interval": lambda: fixed(of_masses("electrical_energy_J", "interval"), 3),
    "masses_J_low": lambda: fixed(of_masses("electrical_energy_J", "low"), 1),
    "masses_J_high": lambda: fixed(of_masses("electrical_energy_J", "high"), 1),
    "masses_mm": lambda: fixed(of_masses("hand_error_rms_m", "mean", 1e3), 3),
    "masses_mm_interval": lambda: fixed(of_masses("hand_error_rms_m", "interval", 1e3), 3),
    "masses_mm_low": lambda: fixed(of_masses("hand_error_rms_m", "low", 1e3), 1),
    "masses_mm_high": lambda: fixed(of_masses("hand_error_rms_m", "high", 1e3), 1),
    "masses_explained": lambda: fixed(of_masses("electrical_energy_J", "explained", 100.0), 2),
    "masses_last_J": lambda: fixed(last_link_effect(), 2),
    "work_two": lambda: fixed(validation()["elbows"]["two_elbows"]["mechanical_work_J"], 2),
    "work_none": lambda: fixed(validation()["elbows"]["no_elbow"]["mechanical_work_J"], 2),
    "exchanged_low": lambda: fixed(min(of_each("sum_of_absolute_power_J")), 1),
    "exchanged_high": lambda: fixed(max(of_each("sum_of_absolute_power_J")), 1),
    "seven_more": lambda: fixed(
        100 * (ratio_of_energies("elbow_comparison elbow_7", "elbow_comparison two_elbows") - 1), 0
    ),
    "depth_7": lambda: fixed(1e3 * validation()["elbows"]["elbow_7"]["joint_depth_max_m"], 1),
    "push_ms": lambda: fixed(1e3 * at_the_start("pushes_until_s"), 0),
    "push_N": lambda: fixed(at_the_start("push_max_N"), 1),
    "pull_N": lambda: fixed(at_the_start("pull_max_N"), 1),
    "pull_low_N": lambda: fixed(at_the_start("pull_from_0.17_s_min_N"), 1),
    "pull_high_N": lambda: fixed(at_the_start("pull_from_0.17_s_max_N"), 1),
    "pull_7_from_ms": lambda: fixed(1e3 * at_the_start("elbow_7_pulls_from_s"), 1),
    "pull_7_until_ms": lambda: fixed(1e3 * at_the_start("elbow_7_pulls_until_s"), 1),
    "hand_off_mm": lambda: fixed(1e3 * at_the_start("hand_starts_off_m"), 0),
    "dissipative_more": lambda: fixed(
        100 * (dissipative_energy() / assumed("as shipped")["electrical_energy_J"] - 1), 1
    ),
    "real_two_seven": lambda: fixed(100 * abs(on_floor("two_elbows", "elbow_7", "electrical_energy_J") - 1), 2),
    "glue_J": lambda: fixed(real_less_glued("two_elbows", "electrical_energy_J"), 1),
    "glue_percent": lambda: fixed(
        100
        * real_less_glued("two_elbows", "electrical_energy_J")
        / contact()["elbow_comparison"]["two_elbows"]["electrical_energy_J"],
        1,
    ),
    "glue_mm": lambda: fixed(1e3 * real_less_glued("two_elbows", "hand_error_rms_m"), 1),
    "stops_1_s": lambda: fixed(event("two_elbows", "slip_stop", 0), 1),
    "stops_2_s": lambda: fixed(event("two_elbows", "slip_stop", 1), 1),
    "stick_percent": lambda: fixed(
        100
        * real_less_glued("elbow_7", "electrical_energy_J")
        / contact()["elbow_comparison"]["elbow_7"]["electrical_energy_J"],
        1,
    ),
    "stick_mm": lambda: fixed(1e3 * real_less_glued("elbow_7", "hand_error_rms_m"), 2),
    "brush_times": lambda: fixed(
        brush()["electrical_energy_J"] / contact()["elbow_comparison_links"]["two_elbows"]["electrical_energy_J"], 0
    ),
    "soft_J": lambda: fixed(contact()["elbow_comparison_links"]["soft"]["electrical_energy_J"], 1),
    "below_zero_ms": lambda: fixed(longest_below_zero_ms(), 1),
    "ledger_dopri5": lambda: small(validation()["ledger_residual_of_two_elbows"]["dopri5, rtol 1e-6, 10 s"]),
    "ledger_second_dopri5": lambda: small(validation()["ledger_residual_of_two_elbows"]["dopri5, rtol 1e-6, 1 s"]),
    "ledger_second_dopri5_tight": lambda: small(
        validation()["ledger_residual_of_two_elbows"]["dopri5, rtol 1e-8, 1 s"]
    ),
    "ledger_second_radau5": lambda: small(validation()["ledger_residual_of_two_elbows"]["radau5, rtol 1e-6, 1 s"]),
    "ledger_second_radau5_tight": lambda: small(
        validation()["ledger_residual_of_two_elbows"]["radau5, rtol 1e-8, 1 s"]
    ),
    "halved_energy": lambda: small(apart("half of rtol and atol, all variants, relative", "electrical_energy_J")),
    "halved_work": lambda: small(apart("half of rtol and atol, all variants, relative", "mechanical_work_J")),
    "off_dopri5_rad": lambda: small(apart("dopri5 against dopri5 at rtol 1e-11", "q_rad")),
    "off_radau5_rad": lambda: small(apart("radau5 against dopri5 at rtol 1e-11", "q_rad")),
    "off_m_star_rad": lambda: small(apart("m_star against articulated", "q_rad")),
    "explicit_least": lambda: fixed(min(explicit_over_implicit()), 0),
    "explicit_most": lambda: fixed(max(explicit_over_implicit()), 0),
    "snake_least_W": lambda: fixed(min(battery("mean_power_W")), 0),
    "snake_most_W": lambda: fixed(max(battery("mean_power_W")), 0),
    "snake_least_Wh": lambda: fixed(min(battery("battery_80_min_Wh")), 0),
    "snake_most_Wh": lambda: fixed(max(battery("battery_80_min_Wh")), 0),
    "snake_least_sheet_Wh": lambda: fixed(min(battery("battery_80_min_Wh_data_sheet_current")), 0),
    "snake_most_sheet_Wh": lambda: fixed(max(battery("battery_80_min_Wh_data_sheet_current")), 0),
    "pipe_sticks": lambda: fixed(100 * run("brace_on_cylinder real")["contacts"]["elbow"]["sticking_fraction"], 1),
    "pipe_glued_J": lambda: energy("brace_on_cylinder glued"),
    "pipe_free_J": lambda: fixed(run("brace_on_cylinder free")["electrical_energy_J"], 0),
}


def written(page: str) -> str:
    """Return a page with its present numbers.

    Raises
    ------
    KeyError
        If the page has a mark of an unknown number or table.
    """
    page = TABLE.sub(lambda match: f"{match[1]}{match[2]}{TABLES[match[1]]()}", page)
    return NUMBER.sub(lambda match: NUMBERS[match[1]](), page)


def stale() -> dict[str, list[str]]:
    """Return the correct lines of each stale page that the page does not contain."""
    changed = {}
    for path in PAGES:
        before = path.read_text(encoding="utf-8")
        after = written(before)
        if before != after:
            there = set(before.splitlines())
            changed[path.name] = [line for line in after.splitlines() if line not in there]
    return changed


def main(arguments: Sequence[str]) -> int:
    pages = stale()
    for page, rows in pages.items():
        print(page, *rows, sep="\n  ")
    if "--check" in arguments:
        return 1 if pages else 0
    for path in PAGES:
        if path.name in pages:
            path.write_text(written(path.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
