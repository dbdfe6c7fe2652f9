"""Measured values and statements of [T], and tables that compare them with simulated records.

[T]: M. Tanaka et al., "Task-Space Control of Articulated Mobile Robots With a Soft Gripper for Operations", IEEE
Transactions on Robotics 35(1), 2019.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dynsim.record import Record
from dynsim.snake.description import COORDINATES
from dynsim.snake.lifting import snake_geometry
from dynsim.system.files import write_text

Table = list[list[str]]  # the first row has the headings


class Displacement(NamedTuple):
    """Relative displacement of the head: x, y, z [m] and alpha, beta, gamma [rad]."""

    target: tuple[float, ...]
    mean: tuple[float, ...]
    deviation: tuple[float, ...]  # standard deviation over five runs


# [T] Table III, by the coordinate that was moved.
TABLE_III: dict[str, Displacement] = {
    "x": Displacement(
        (0.20, 0, 0, 0, 0, 0),
        (0.20, 0.0052, 0.0024, 0.0092, -0.0047, -0.012),
        (0.0025, 0.0015, 0.00082, 0.0061, 0.015, 0.0059),
    ),
    "y": Displacement(
        (0, 0.1, 0, 0, 0, 0),
        (-0.069, 0.066, 0.014, -0.055, -0.055, -0.075),
        (0.0036, 0.0033, 0.00071, 0.0053, 0.0047, 0.0039),
    ),
    "z": Displacement(
        (0, 0, -0.1, 0, 0, 0),
        (-0.011, 0.0040, -0.10, 0.013, -0.013, 0.0075),
        (0.0017, 0.00081, 0.00090, 0.0042, 0.0050, 0.0033),
    ),
    "alpha": Displacement(
        (0, 0, 0, np.pi / 2, 0, 0),
        (-0.054, -0.035, 0.030, 1.54, -0.060, -0.063),
        (0.0042, 0.0018, 0.0011, 0.014, 0.0051, 0.0037),
    ),
    "beta": Displacement(
        (0, 0, 0, 0, -np.pi / 6, 0),
        (0.00062, 0.0015, 0.0061, 0.019, -0.55, -0.0060),
        (0.0013, 0.0011, 0.00094, 0.0061, 0.0063, 0.0047),
    ),
    "gamma": Displacement(
        (0, 0, 0, 0, 0, np.pi / 4),
        (-0.018, 0.00032, 0.027, 0.050, -0.12, 0.79),
        (0.0020, 0.0016, 0.00057, 0.0073, 0.0070, 0.0084),
    ),
}


def displacement(record: Record) -> np.ndarray:
    """Return the relative displacement of the controlled point as defined in [T] V.A, shape (6,) [m, rad].

    It is the mean over the last second of the run minus the mean over the first second.
    """
    first, last = record.time <= 1.0, record.time >= record.time[-1] - 1.0
    return record["w"][last].mean(axis=0) - record["w"][first].mean(axis=0)


def table_iii(records: Mapping[str, Record]) -> Table:
    """Return Table III with targets, measurements from [T] and simulations, for the manoeuvres that were simulated."""
    rows = [["moved", "what", *COORDINATES]]
    for moved, published in TABLE_III.items():
        if moved in records:
            rows.append([moved, "target", *(f"{v:.4g}" for v in published.target)])
            rows.append([moved, "[T] mean", *(f"{v:.3g}" for v in published.mean)])
            rows.append([moved, "[T] standard deviation", *(f"{v:.2g}" for v in published.deviation)])
            rows.append([moved, "simulated", *(f"{v:.6f}" for v in displacement(records[moved]) + 0.0)])
    return rows


UNITS = ("m", "m", "m", "rad", "rad", "rad")
# Mapping from table columns to the suffixes of the variants of `snake_positioning_dynamic`, after the moved coordinate.
SOURCES = {"kinematic": "_kinematic", "dynamic": "", "measured": "_measured"}


def table_iii_dynamic(records: Mapping[str, Record]) -> Table:
    """Return Table III next to kinematic and dynamic simulations, and simulations with a measured head pose.

    Each row contains one number from the paper.
    """
    rows = [["variant", "quantity", "paper_mean", "paper_sd", *SOURCES]]
    for moved, published in TABLE_III.items():
        names = {source: moved + ending for source, ending in SOURCES.items()}
        displacements = {source: displacement(records[name]) for source, name in names.items() if name in records}
        if not displacements:
            continue
        for i, (coordinate, unit) in enumerate(zip(COORDINATES, UNITS, strict=True)):
            simulated = [
                f"{displacements[source][i] + 0.0:.6f}" if source in displacements else "" for source in SOURCES
            ]
            numbers = [f"{published.mean[i]:.4g}", f"{published.deviation[i]:.3g}"]
            rows.append([moved, f"d{coordinate}_{unit}", *numbers, *simulated])
    return rows


class Push(NamedTuple):
    """Posture in a push test, and the measured contact forces f_x, f_y, f_z of the head on a plate.

    Attributes
    ----------
    height, beside : float
        Coordinates z_h and y_h of the head point [m].
    l_shape : bool
        Whether the base part is bent by 90 degrees instead of straight.
    mean, deviation : tuple of float
        Mean and standard deviation over five runs [N].
    """

    height: float
    beside: float
    l_shape: bool
    mean: tuple[float, float, float]
    deviation: tuple[float, float, float]


# [T] Table IV: postures with different heights z_h.
TABLE_IV: dict[str, Push] = {
    "i": Push(0.40, 0.0, False, (16.9, 5.71, 15.7), (0.3, 0.22, 0.3)),
    "ii": Push(0.35, 0.0, False, (24.0, 8.60, 12.1), (1.1, 0.20, 0.1)),
    "iii": Push(0.30, 0.0, False, (30.4, 9.72, 10.1), (1.7, 0.33, 0.2)),
    "iv": Push(0.40, 0.0, True, (14.9, 5.41, 15.5), (0.3, 0.36, 0.2)),
    "v": Push(0.35, 0.0, True, (21.4, 7.1, 11.3), (0.5, 0.5, 0.2)),
    "vi": Push(0.30, 0.0, True, (26.3, 9.94, 10.3), (1.1, 0.35, 0.2)),
}
# [T] Table V: postures with different lateral positions y_h; f_y of posture (v) has one more digit.
TABLE_V: dict[str, Push] = {
    "ii": TABLE_IV["ii"],
    "vii": Push(0.35, 0.1, False, (20.4, 11.1, 13.2), (0.4, 0.5, 0.2)),
    "viii": Push(0.35, 0.2, False, (15.0, 10.1, 15.5), (0.5, 0.9, 0.3)),
    "v": Push(0.35, 0.0, True, (21.4, 7.12, 11.3), (0.5, 0.48, 0.2)),
    "ix": Push(0.35, 0.1, True, (19.2, 12.7, 13.5), (1.1, 0.6, 0.4)),
    "x": Push(0.35, 0.2, True, (13.5, 14.9, 16.1), (0.5, 1.1, 0.2)),
}
# Mapping from the coordinate in the name of a variant to the direction in which the head pushes.
PUSHES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, -1.0)}
# Name of the contact point that touches the plate.
PLATE = "plate"
# Depth of the target inside the plate at which f_z is evaluated [m]; the paper does not specify it.
DEPTH_Z = 0.07


class Pushed(NamedTuple):
    """Result of a simulated push test.

    Attributes
    ----------
    force : float
        Force of the plate against the push [N].
    depth : float
        Depth of the target inside the plate at this force [m].
    stop_acted : bool
        Whether a mechanical stop carried force while the head pushed.
    """

    force: float
    depth: float
    stop_acted: bool


def pushed(record: Record, coordinate: str) -> Pushed:
    """Evaluate f_x and f_y at their maximum, and f_z at the depth DEPTH_Z or, if not reached, at the maximum depth."""
    plate = record.labels["contact_normal_force"].index(PLATE)
    force, gap = record["contact_normal_force"][:, plate], record["contact_gap"][0, plate]
    target = record["w_target"][:, :3]
    depth = (target - target[0]) @ np.array(PUSHES[coordinate]) - gap
    at = int(np.argmax(depth >= min(DEPTH_Z, depth.max()) - 1e-9)) if coordinate == "z" else int(force.argmax())
    touching = force > 0.0
    return Pushed(float(force[at]), float(depth[at]), bool(record["stop_force"][touching].any()))


def push_table(published: Mapping[str, Push], records: Mapping[str, Record]) -> Table:
    """Return Table IV or V next to the simulated pushes."""
    rows = [["posture", "direction", "paper_mean", "paper_sd", "simulated", "depth_m", "start", "stop_acted"]]
    for posture, push in published.items():
        for k, coordinate in enumerate(PUSHES):
            record = records.get(f"{posture}_{coordinate}")
            if record is None:
                continue
            result = pushed(record, coordinate)
            numbers = [f"{push.mean[k]:.4g}", f"{push.deviation[k]:.3g}", f"{result.force:.3f}", f"{result.depth:.4f}"]
            start = record.provenance["scenario"]["plant"]["dynamics"]["start"]
            direction = "-z" if coordinate == "z" else coordinate
            rows.append([posture, direction, *numbers, start, "yes" if result.stop_acted else "no"])
    return rows


def wheel_table(records: Mapping[str, Record]) -> Table:
    """Return the load, slip distance and friction energy of each wheel in each variant."""
    rows = [["variant", "wheel", "mean_load_N", "largest_load_N", "slip_m", "friction_J"]]
    for variant, record in records.items():
        if "contact_slip_velocity" not in record:
            continue
        time, load, slip = record.time, record["contact_normal_force"], record["contact_slip_distance"]
        power = -(record["contact_force"] * record["contact_slip_velocity"]).sum(axis=2)
        energy = (0.5 * (power[1:] + power[:-1]) * np.diff(time)[:, None]).sum(axis=0)
        for k, wheel in enumerate(record.labels["contact_normal_force"]):
            mean = record["contact_impulse"][-1, k] / (time[-1] - time[0])
            numbers = [f"{mean:.3f}", f"{load[:, k].max():.3f}", f"{slip[-1, k]:.5f}", f"{energy[k] + 0.0:.5f}"]
            rows.append([variant, wheel, *numbers])
    return rows


# [T] Table I: battery life [min].
BATTERY_LIFE = 80.0
# Stall current of the MX-106 at 12 V [A]: the value in the data sheet, and the value of the model, U / R.
STALL_CURRENT = (5.2, 3.3)


def energy_table(records: Mapping[str, Record]) -> Table:
    """Return how the energy of a run is used, and the battery capacity needed for the 80 min of [T] Table I.

    The motor of the model has a lower stall current than the data sheet; with the current of the data sheet, all
    electrical energies would be larger by this ratio.
    """
    more = STALL_CURRENT[0] / STALL_CURRENT[1]
    names = ("supply_J", "joule_J", "gear_J", "wheel_friction_J", "tyre_J", "mean_power_W")
    rows = [["variant", *names, "battery_80_min_Wh", "battery_80_min_Wh_data_sheet_current"]]
    for variant, record in records.items():
        if "energy_electrical_supply" not in record:
            continue
        supply = record["energy_electrical_supply"][-1]
        power = supply / (record.time[-1] - record.time[0])
        battery = power * BATTERY_LIFE / 60.0
        tyre = record["loss_damper"][-1] if "loss_damper" in record else 0.0
        parts = (supply, record["heat_joule"][-1], record["loss_gear"][-1], record["heat_friction"][-1], tyre, power)
        rows.append([variant, *(f"{value:.3f}" for value in (*parts, battery, more * battery))])
    return rows


class Statement(NamedTuple):
    """Statement in [T], and the function that evaluates the same quantity from a record."""

    section: str
    quantity: str
    published: str
    variant: str
    simulated: Callable[[Record], str]


# [T] V.B: error of the head during mode switching, "about 30 mm and 0.1 rad".
HEAD_ERROR = (0.030, 0.1)  # [m], [rad]


def base_joints(record: Record) -> np.ndarray:
    """Return the joint angles of the base part, shape (T, n_b) [rad]."""
    return record["phi"][:, snake_geometry(record).head_joints :]


def mode_sequence(record: Record) -> list[tuple[float, int]]:
    """Return (time [s], mode number) at the start and at each change of mode."""
    mode = record["mode"]
    starts = np.flatnonzero(np.diff(mode, prepend=mode[0] - 1))
    return [(float(record.time[i]), int(mode[i])) for i in starts]


def used_limit(record: Record) -> np.ndarray:
    """Return the largest yaw angle of each sample as a fraction of its limit, shape (T,).

    Pitch angles are excluded: the shape point determines most of them.
    """
    geometry = snake_geometry(record)
    yaw = ~geometry.pitch
    return np.asarray(np.abs(record["phi"][:, yaw] / geometry.upper[yaw]).max(axis=1))


def opening(record: Record) -> np.ndarray:
    """Return the opening angle of the door, or the rotation of the head if the record has no door, shape (T,) [°]."""
    has_door = "door" in record.labels.get("q", ())
    angle = record["q"][:, record.labels["q"].index("door")] if has_door else record["w"][:, 5]
    return np.asarray(np.abs(np.rad2deg(angle - angle[0])))


def _largest_base_angle(record: Record) -> str:
    angle = np.abs(base_joints(record)).max(axis=1)
    return f"{angle[0]:.3f} -> {angle[-1]:.3f}"


def _straightening(record: Record) -> str:
    """Return the base joints, in the order of the time [s] from which they stay below half of their first angle."""
    angle, names = np.abs(base_joints(record)), record.labels["phi"][-base_joints(record).shape[1] :]
    rows, texts = len(angle), []
    # First row from which the joint stays below half of its first angle; the number of rows if it never does.
    below = [int(np.append(-1, np.flatnonzero(column > 0.5 * column[0]))[-1]) + 1 for column in angle.T]
    for j in np.argsort(below, kind="stable"):
        texts.append(f"{names[j]} " + (f"{record.time[below[j]]:.1f}" if below[j] < rows else "never"))
    return ", ".join(texts)


def _same_wheels(record: Record) -> str:
    shown = {
        (int(m), tuple(np.flatnonzero(g == 0) + 1)) for m, g in zip(record["mode"], record["grounded"], strict=True)
    }
    return "; ".join(f"mode {m}: {', '.join(map(str, pairs))}" for m, pairs in sorted(shown) if pairs)


def _cost(record: Record) -> str:
    # Negative if V always decreases within a mode.
    rise = np.diff(record["cost"])[np.diff(record["mode"]) == 0].max()
    return f"{record['cost'][0]:.2f} -> {record['cost'][-1]:.2f}; largest increase per sample {rise:.1e}"


def _error(name: str, scale: float) -> Callable[[Record], str]:
    return lambda record: f"{scale * record[name].max():.2g}"


def _summary(key: str, form: str = "") -> Callable[[Record], str]:
    return lambda record: format(record.summary[key], form)


def _rms_base_angle(record: Record) -> str:
    return f"{np.sqrt((base_joints(record)[-1] ** 2).mean()):.3f}"


# Statements in [T] V.B (Figs 8 to 10), IV.C.5 (Table II) and V.E (Fig 16), in the order of the text.
JOINT_LIMITS: tuple[Statement, ...] = (
    Statement("V.B", "maximum base joint angle, start -> end [rad]",
              "near the limit (1.1), decreased with time", "cyclic", _largest_base_angle),
    Statement("V.B", "fixing state for t < 2 s, then the switching state: t [s] (mode)",
              "mode 1; at t >= 2: 2, 3, ..., 6, 2, 3, ... every 1 s", "cyclic",
              lambda r: ", ".join(f"{t:.0f} ({m})" for t, m in mode_sequence(r))),
    Statement("IV.C.5, Table II", "lifted pairs of each mode in use",
              "mode 1: 3, 6; 2: 6, 7; 3: 5, 6; 4: 4, 5; 5: 3, 4; 6: 2, 3", "cyclic", _same_wheels),
    Statement("IV.C.5, Table II", "wheel pairs on the ground, minimum and maximum", "5 of 7", "cyclic",
              lambda r: f"{r['grounded'].sum(axis=1).min()} and {r['grounded'].sum(axis=1).max()}"),
    Statement("V.B, Fig 9", "cost V", "decreased with time", "cyclic", _cost),
    Statement("V.B, Fig 9", "maximum position error of the head [mm]", f"about {1e3 * HEAD_ERROR[0]:.0f}", "cyclic",
              _error("position_error", 1e3)),
    Statement("V.B, Fig 9", "maximum attitude error of the head [rad]", f"about {HEAD_ERROR[1]}", "cyclic",
              _error("attitude_error", 1.0)),
    Statement("V.B, Fig 10", "maximum yaw angle, fraction of its limit", "the joint limit was avoided", "cyclic",
              lambda r: f"{used_limit(r).max():.6f}"),
    Statement("V.B, Fig 10", "joints stay below half the first angle from t [s]", "in order from the tail to the head",
              "cyclic", _straightening),
    Statement("IV.C.5", "the same without switching", "switching makes the robot operable again", "fixed",
              _straightening),
    Statement("IV.C.5, V.E", "V at the end, predictive switching", "better than the prescribed order", "predictive",
              _cost),
    Statement("V.E, Fig 15", "minimum support margin [mm]", "hardly falls", "cyclic",
              lambda r: f"{1e3 * r['support_margin'].min():.1f}"),
    *(
        Statement("V.E, Fig 16", f"{quantity}, at the end", published, variant, take)
        for quantity, reference, published_20, take in (
            ("rms base joint angle [rad]", "straight (Fig 8)", "not straight", _rms_base_angle),
            ("area of the support polygon [m^2]", "(Fig 8)", "greater than in Fig 8",
             _summary("support_area_final_m2", ".4f")),
            ("support margin [mm]", "", "", lambda r: f"{1e3 * r['support_margin'][-1]:.1f}"),
        )
        for variant, published in (("cyclic", reference), ("eq20", published_20), ("eq20_min", published_20))
    ),
)  # fmt: skip

# Scenarios for [T] V.D.3, Fig 14: the arc without and with a door.
DOORS = ("snake_door_arc", "snake_door")
DOOR: tuple[Statement, ...] = tuple(
    Statement("V.D.3, Fig 14", quantity, published, variant, take)
    for quantity, take, texts in (
        ("opened to [deg]", lambda r: f"{opening(r)[-1]:.2f}",
         ("(d), (f): the robot could not move backward", "(e), (g): able to resume moving backward", "")),
        ("maximum yaw angle, fraction of its limit", lambda r: f"{used_limit(r).max():.4f}",
         ("(d), (f): the joint reached the limit angle", "changed posture", "")),
        ("target waited [s]", _summary("waiting_s", ".2f"), ("", "", "")),
        ("mode switches", _summary("mode_switches"), ("fixing state", "mode switching", "")),
        ("maximum position error of the gripper [mm]", _error("position_error", 1e3),
         ("", "maintaining the position and attitude", "")),
        ("maximum attitude error of the gripper [rad]", _error("attitude_error", 1.0),
         ("", "maintaining the position and attitude", "")),
    )
    for variant, published in zip(("pull", "pull_switching", "pull_predictive", "push"),
                                  (texts[0], texts[1], texts[1], texts[2]), strict=True)
)  # fmt: skip


def statements(listed: tuple[Statement, ...], records: Mapping[str, Record]) -> Table:
    """Return a table that compares statements with simulated values, for the variants that were simulated."""
    rows = [["[T]", "what", "published", "variant", "simulated"]]
    rows += [[*s[:4], s.simulated(records[s.variant])] for s in listed if s.variant in records]
    return rows


POLICIES = ("fixed", "cyclic", "predictive")


def policies(records: Mapping[str, Record]) -> Table:
    """Return a table of the mode switching policies, with one column per policy."""
    shown = {name: records[name] for name in POLICIES if name in records}
    lines: tuple[tuple[str, Callable[[Record], str]], ...] = (
        ("V, start -> end", lambda r: f"{r['cost'][0]:.2f} -> {r['cost'][-1]:.2f}"),
        ("V at half time", lambda r: f"{r['cost'][len(r.time) // 2]:.2f}"),
        ("maximum base joint angle, start -> end [rad]", _largest_base_angle),
        ("joints excluded at their limits", lambda r: " ".join(r.summary["joints_taken_out"]) or "none"),
        ("maximum yaw angle, fraction of its limit", lambda r: f"{used_limit(r).max():.6f}"),
        ("maximum position error of the head [mm]", _error("position_error", 1e3)),
        ("maximum attitude error of the head [rad]", _error("attitude_error", 1.0)),
        ("minimum support margin [mm]", lambda r: f"{1e3 * r['support_margin'].min():.1f}"),
        ("support area at the end [m^2]", _summary("support_area_final_m2", ".4f")),
        ("mode switches", _summary("mode_switches")),
        ("rejected modes", _summary("modes_refused")),
        ("modes", lambda r: " ".join(str(m) for _, m in mode_sequence(r))),
        ("wall time [s]", _summary("integration_wall_s", ".3f")),
    )
    return [["", *shown], *([quantity, *(take(record) for record in shown.values())] for quantity, take in lines)]


def tables(scenario: str, records: Mapping[str, Record]) -> dict[str, Table]:
    """Return tables by file name that compare a shipped scenario with [T]; empty for scenarios that are not in [T]."""
    if scenario == "snake_positioning":
        results = {"table_iii": table_iii(records)}
    elif scenario == "snake_positioning_dynamic":
        results = {
            "table_iii": table_iii_dynamic(records),
            "wheels": wheel_table(records),
            "energy": energy_table(records),
        }
    elif scenario == "snake_push":
        results = {"table_iv": push_table(TABLE_IV, records), "table_v": push_table(TABLE_V, records)}
    elif scenario == "snake_joint_limits":
        results = {"joint_limits": statements(JOINT_LIMITS, records), "policies": policies(records)}
    elif scenario in DOORS:
        results = {"door": statements(DOOR, records)}
    else:
        results = {}
    # A table that has only a heading row or column has no simulated variant.
    return {name: rows for name, rows in results.items() if len(rows) > 1 and len(rows[0]) > 1}


def write_tables(records: Mapping[str, Record], folder: Path) -> list[Path]:
    """Write the tables that compare the variants of a scenario with [T] as CSV files; return the files.

    Raises
    ------
    RecordError
        If a file cannot be written.
    """
    scenarios = {record.summary["scenario"] for record in records.values()}
    written = []
    for name, rows in tables(scenarios.pop(), records).items() if len(scenarios) == 1 else ():
        stream = io.StringIO()
        csv.writer(stream, lineterminator="\n").writerows(rows)
        written.append(write_text(folder / f"{name}.csv", stream.getvalue()))
    return written
