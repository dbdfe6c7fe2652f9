"""Study: tipping of a mobile base with four elbow configurations, and a sweep over parameters of the base.

``PYTHONPATH=tests python -m studies.overturning`` writes results/overturning/ (configurations.json, sweep.csv,
sweep.png), which docs/validation/bracing.md quotes, in about two minutes.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withTickedStroke
from numpy.typing import NDArray

from dynsim._version import __version__
from dynsim.draw.figures.style import look, new_figure, save, variant_styles
from dynsim.engine import simulate
from dynsim.errors import DynsimError
from dynsim.scenario import load_scenario, variant_names
from dynsim.studies.sweep import csv_table
from dynsim.system.files import write_json, write_text

Array = NDArray[np.float64]
Row = dict[str, Any]

SCENARIO = "mobile_elbow_comparison"
SCENARIOS = (SCENARIO, f"{SCENARIO}_driving")
FOLDER = Path("results/overturning")

# The hand starts next to its circle, so voltages jump; the reaction of the base lasts milliseconds.
START: dict[str, Any] = {"duration_s": 0.5, "record.rate_hz": 20_000}
# Without a path the arm keeps its posture, and nothing jumps.
HELD: dict[str, Any] = {"controller.hand": None}

# Varied parameters of the base, two at a time; the shipped values are among them.
MASSES_KG = (0.5, 1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0)
TRACKS_M = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6)
CASTERS_M = (0.06, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)
AXES = {
    "mass_kg": ("mass of the base body [kg]", MASSES_KG),
    "track_m": ("track [m]", TRACKS_M),
    "caster_m": ("caster ahead of the axle [m]", CASTERS_M),
}
# After the settled time the margin changes slowly.
SWEEP: dict[str, Any] = {"record.rate_hz": 50}
COLUMNS = (
    *AXES, "variant", "stands", "tip_margin_min_settled", "tip_margin_min", "overturns_at_s", "reason",
    "dynsim_version",
)  # fmt: skip

SHADE = "#E4EEF6"
# Marks on the side of a zero line where values are negative.
_TICKS = withTickedStroke(spacing=7, length=0.7, angle=-135)


def below_zero(time: Array, margin: Array) -> list[tuple[float, float | None]]:
    """Return the intervals in which the margin is below zero in the samples [s]; None: to the end."""
    edges = np.diff(np.concatenate([[0], margin < 0.0, [0]]).astype(int))
    first, last = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return [(float(time[a]), float(time[b]) if b < len(time) else None) for a, b in zip(first, last, strict=True)]


def configuration(scenario: str, variant: str) -> Row:
    """Evaluate one configuration: its start on a fine grid of samples, then the whole run, and with the arm at rest."""
    loaded = load_scenario(scenario, variant)
    whole, start = simulate(loaded), simulate(load_scenario(scenario, variant, START))
    held = simulate(load_scenario(scenario, variant, HELD)).summary["base"]
    late, settled = whole.time > start.time[-1], whole.time >= loaded.metrics.settle_s
    time, margin, load = (
        np.concatenate([start[name], whole[name][late]]) if name else np.concatenate([start.time, whole.time[late]])
        for name in ("", "tip_margin", "wheel_load")
    )
    base, labels = whole.summary["base"], whole.labels["wheel_load"]
    traction = whole["traction_demand"][settled]
    return {
        "tip_margin_min": float(margin.min()),
        "tip_margin_min_settled": base["tip_margin_min_settled"],
        "overturns_at_s": base["overturns_at_s"],
        "margin_below_zero_s": below_zero(time, margin),
        "wheel_load_min_N": dict(zip(labels, load.min(axis=0).tolist(), strict=True)),
        "wheel_load_min_settled_N": dict(zip(labels, whole["wheel_load"][settled].min(axis=0).tolist(), strict=True)),
        "wheel_load_final_N": base["wheel_load_final_N"],
        "traction_demand_max_settled": float(np.nanmax(traction)) if np.isfinite(traction).any() else None,
        "hand_error_rms_m": whole.summary["hand_error_rms_m"],
        "electrical_energy_J": whole.summary["electrical_energy_J"],
        "energy_residual_relative": whole.summary["energy_residual_relative"],
        "tip_margin_min_arm_held": held["tip_margin_min"],
        "overturns_at_s_arm_held": held["overturns_at_s"],
    }


def shipped_base() -> dict[str, Any]:
    """Return ``plant.base`` of the varied scenario."""
    base: dict[str, Any] = load_scenario(SCENARIO).resolved["plant"]["base"]
    return base


def overrides(base: Mapping[str, Any], mass: float, track: float, caster: float) -> dict[str, Any]:
    """Return overrides for a base of the same shape with another mass, so that inertia grows with mass."""
    return {
        "plant.base.mass_kg": mass,
        "plant.base.inertia_kg_m2": [mass / base["mass_kg"] * moment for moment in base["inertia_kg_m2"]],
        "plant.base.track_m": track,
        "plant.base.caster_m": [caster, *base["caster_m"][1:]],
    }


def point(mass: float, track: float, caster: float, variant: str) -> Row:
    """Run one point of the sweep: it stands if its margin stays above zero from the settled time on."""
    row: Row = {"mass_kg": mass, "track_m": track, "caster_m": caster, "variant": variant, "stands": None}
    row["dynsim_version"] = __version__
    try:
        summary = simulate(
            load_scenario(SCENARIO, variant, SWEEP | overrides(shipped_base(), mass, track, caster))
        ).summary
    except DynsimError as error:
        return row | {"reason": " ".join(str(error).split())}
    numbers = {key: summary["base"][key] for key in ("tip_margin_min_settled", "tip_margin_min", "overturns_at_s")}
    return row | numbers | {"stands": numbers["tip_margin_min_settled"] > 0.0, "reason": ""}


def points() -> list[tuple[float, float, float]]:
    """Return mass, track and caster for every pair of them, with the third as shipped."""
    base = shipped_base()
    shipped = (base["mass_kg"], base["track_m"], base["caster_m"][0])
    grid = product(MASSES_KG, TRACKS_M, CASTERS_M)
    return [point for point in grid if any(at == value for at, value in zip(point, shipped, strict=True))]


def sweep(progress: Callable[[int, int], None]) -> list[Row]:
    """Run all points with all variants; call ``progress`` with the numbers of completed and total runs."""
    cases = [(*at, variant) for at in points() for variant in variant_names(SCENARIO)]
    rows = []
    for case in cases:
        rows.append(point(*case))
        progress(len(rows), len(cases))
    return rows


def picture(rows: Sequence[Row]) -> Figure:
    """Plot pairs of mass, track and caster: where each variant begins to tip, and where bracing matters."""
    base = shipped_base()
    shipped = {"mass_kg": base["mass_kg"], "track_m": base["track_m"], "caster_m": base["caster_m"][0]}
    styles = variant_styles(variant_names(SCENARIO))
    figure = new_figure(3.4, f"{SCENARIO}: bases that stand once settled")
    panels = figure.subplots(1, 3)
    for axes, (x, y) in zip(panels, combinations(AXES, 2), strict=True):
        third = next(key for key in AXES if key not in (x, y))
        _panel(axes, [row for row in rows if row[third] == shipped[third]], x, y, styles)
        axes.plot(shipped[x], shipped[y], "k*", markersize=9, zorder=6)
        name, unit = third.rsplit("_", 1)
        axes.set(xlabel=AXES[x][0], ylabel=AXES[y][0], title=f"{name} as shipped, {shipped[third]:g} {unit}")
    falling = [name for name in styles if any(row["variant"] == name and row["stands"] is False for row in rows)]
    handles: list[Any] = [
        Line2D([], [], color=styles[name]["color"], path_effects=[_TICKS], label=f"limit of {name}") for name in falling
    ]
    handles += [
        Patch(color=SHADE, label="bracing decides"),
        Line2D([], [], color="k", marker="*", linestyle="", markersize=8, label="as shipped"),
        Line2D([], [], color="k", marker=".", linestyle="", markersize=3, label="run"),
    ]
    figure.put_below({handle.get_label(): handle for handle in handles}, 5)
    standing = [name for name in styles if name not in falling]
    stand = f"; with {' and '.join(standing)} it stands in every run" if standing else ""
    figure.note(
        f"The base tips over on the side of the ticks{stand}. Bracing decides: it stands with two elbows, but not with "
        f"none. dynsim {__version__}."
    )
    return figure


def _panel(axes: Axes, rows: Sequence[Row], x: str, y: str, styles: Mapping[str, Mapping[str, Any]]) -> None:
    """Plot the zero line of every variant's margin over x and y; failed runs are crossed out."""
    xs, ys = np.array(AXES[x][1]), np.array(AXES[y][1])
    margins = {name: np.full((len(ys), len(xs)), np.nan) for name in styles}
    for row in rows:
        if not row["reason"]:
            margins[row["variant"]][ys == row[y], xs == row[x]] = row["tip_margin_min_settled"]
    decides = np.minimum(margins["two_elbows"], -margins["no_elbow"])
    if np.nanmax(decides) > 0.0:
        axes.contourf(xs, ys, decides, levels=[0.0, np.inf], colors=[SHADE])
    for name, style in styles.items():
        if np.nanmin(margins[name]) < 0.0 < np.nanmax(margins[name]):
            axes.contour(xs, ys, margins[name], levels=[0.0], colors=[style["color"]], linewidths=1.6).set(
                path_effects=[_TICKS]
            )
    axes.plot(*(grid.ravel() for grid in np.meshgrid(xs, ys)), "k.", markersize=2.0, clip_on=False)
    axes.plot(*np.array([(row[x], row[y]) for row in rows if row["reason"]]).reshape(-1, 2).T, "kx", markersize=5.0)


def table(configurations: Mapping[str, Row]) -> str:
    """Return the configurations of one scenario, for the terminal."""
    lines = [
        f"{'':12}{'margin min':>11}{'settled':>9}{'overturns at':>14} settled loads left, right, caster [N]; under zero"
    ]
    for name, row in configurations.items():
        tips = row["overturns_at_s"]
        loads = ", ".join(f"{load:.1f}" for load in row["wheel_load_min_settled_N"].values())
        spells = ", ".join(
            f"{a:.4f} s to {'the end' if b is None else f'{b:.4f} s'}" for a, b in row["margin_below_zero_s"]
        )
        lines.append(
            f"{name:12}{row['tip_margin_min']:11.3f}{row['tip_margin_min_settled']:9.3f}"
            f"{'never' if tips is None else f'{tips:.4f} s':>14}  {loads}; {spells or 'never'}"
        )
    return "\n".join(lines)


def _as_csv(rows: Sequence[Row]) -> str:
    return csv_table(
        COLUMNS,
        [{key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()} for row in rows],
    )


def _report(done: int, of: int) -> None:
    if done == of or done % 10 == 0:
        print(f"\rsweep: {done} of {of} runs", end="\n" if done == of else "", file=sys.stderr, flush=True)


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {"dynsim_version": __version__}
    for scenario in SCENARIOS:
        result[scenario] = {variant: configuration(scenario, variant) for variant in variant_names(scenario)}
        print(f"{scenario}\n{table(result[scenario])}")
    write_json(FOLDER / "configurations.json", result)
    runs = sweep(_report)
    write_text(FOLDER / "sweep.csv", _as_csv(runs))
    with look():
        print(save(picture(runs), FOLDER / "sweep.png"))
