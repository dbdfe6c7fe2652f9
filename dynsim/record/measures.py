"""Quantities computed from a record's signals, for summaries and figures: energy sinks, hand errors, base loads."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dynsim.record import Record
from dynsim.record.quaternion import Array

# Sinks of the electrical energy, in the order in which they are plotted and printed.
SINKS = ("heat_joule", "loss_gear", "loss_joint", "heat_friction")
# Additional sinks under the unilateral law or with time stepping. Elastic energy is relative to the start of the run.
MORE_SINKS = ("loss_impact", "loss_stop", "loss_damper", "energy_elastic", "loss_scheme")
STORES = ("energy_kinetic", "energy_potential", "energy_magnetic")

# Largest residual of the energy ledger without a warning, as a fraction of the turnover.
RESIDUAL_LIMIT = 1e-6
# Smallest fraction of a run that is not printed as 0.0 %.
SHORT = 5e-4
# Fractions of the duration of a run that are smaller than this are rounding errors.
ROUNDED = 1e-9

# States of a gripper, indexed by the signal ``gripper_state``.
GRIPPER_STATES = ("soft", "hardening", "hardened", "softening")
# Kind of the event at which a mobile base tips: its tip margin passes zero. The event is located between samples.
TIP_OVER = "tip_over"


def sinks(record: Record) -> tuple[str, ...]:
    """Return the energy sinks that a record contains."""
    return SINKS + tuple(name for name in MORE_SINKS if name in record)


def servo_limits(record: Record, name: str) -> dict[str, float]:
    """Return a limit of the servo map by joint, such as "torque_N_m"; empty for records of older versions."""
    limits: dict[str, dict[str, float]] = record.provenance.get("limits", {})
    return {joint: values[name] for joint, values in limits.items() if name in values}


def percent(share: float) -> str:
    """Format a fraction of a run with one decimal, or with enough decimals to distinguish it from 0 % and 100 %."""
    least = min(share, 1.0 - share)
    decimals = 1 if least < ROUNDED else max(1, -math.floor(math.log10(100.0 * least)))
    return f"{100.0 * share:.{decimals}f} %"


def energy_turnover(record: Record) -> float:
    """Return the energy turnover [J]: the maximum over time of half the sum of the absolute values of all terms."""
    total = np.abs(record["energy_electrical"]) + np.abs(record["work_constraint"])
    if "work_loads" in record:
        total = total + np.abs(record["work_loads"]).sum(axis=1)
    for name in sinks(record):
        total = total + np.abs(record[name])
    for name in STORES:
        total = total + np.abs(record[name] - record[name][:1])
    return float(0.5 * total.max(initial=0.0))


def hand_target(record: Record) -> Array | None:
    """Return the target of the hand, (T, 3) [m], or None.

    The target is on the hand path; in a measured run, it is the position of the hand at the joint goals.
    """
    return next((record[name] for name in ("target_position", "hand_position_goal") if name in record), None)


def hand_error(record: Record, settle: float) -> dict[str, float | None]:
    """Return the rms, maximum and vertical rms distance of the hand from its target, and the first and last one [m].

    The first three ignore samples before t = ``settle`` and are None if the run is shorter. All are None without a
    target.
    """
    names = ("hand_error_rms_m", "hand_error_max_m", "hand_error_z_rms_m")
    first = int(np.searchsorted(record.time, settle))
    target = hand_target(record)
    ends = dict[str, float | None].fromkeys(("hand_error_start_m", "hand_error_end_m"))
    if target is None or not len(record):
        return dict.fromkeys(names) | ends
    for name, k in zip(ends, (0, -1), strict=True):
        ends[name] = float(np.linalg.norm(record["hand_position"][k] - target[k]))
    if len(record) - first < 2:
        return dict.fromkeys(names) | ends
    error, time = record["hand_position"][first:] - target[first:], record.time[first:]
    x, y, z = error.T**2
    square = x + y + z
    values = (_mean(square, time) ** 0.5, square.max() ** 0.5, _mean(z, time) ** 0.5)
    return dict(zip(names, map(float, values), strict=True)) | ends


def hand_turn_error(record: Record, settle: float) -> dict[str, float | None]:
    """Return the rms and maximum angle between the orientation of the hand and its target [rad].

    Samples before t = ``settle`` are ignored. The values are None if the run is shorter; the result is empty without a
    target orientation.
    """
    if "hand_turn_error" not in record:
        return {}
    names, late = ("hand_turn_error_rms_rad", "hand_turn_error_max_rad"), record.time >= settle
    angle, time = record["hand_turn_error"][late], record.time[late]
    if len(time) < 2:
        return dict.fromkeys(names)
    return dict(zip(names, (_mean(angle**2, time) ** 0.5, float(angle.max())), strict=True))


def least_loads(record: Record, steps: Array) -> Array:
    """Return the minimum loads of wheels and caster, (3,) [N], over all samples and over all steps.

    ``steps`` is the array described in :func:`base_summary`; if it is empty, only the samples count.
    """
    loads = record["wheel_load"].min(axis=0, initial=np.inf)
    return np.minimum(loads, steps[:3]) if len(steps) else loads


def base_summary(record: Record, settle: float, steps: Array, travel: Array) -> dict[str, Any]:
    """Summarise motion and stability of a mobile base; undefined values are None.

    Parameters
    ----------
    record : Record
        Record of a mobile base.
    settle : float
        Time from which ``tip_margin_min_settled`` and ``overturns_settled_at_s`` are evaluated [s].
    steps : ndarray, shape (4,) or (0,)
        Minimum loads [N] and minimum tip margin over all integration steps, which are closer together than the samples;
        empty if unknown.
    travel : ndarray, shape (T,)
        Distance travelled by the midpoint of the axle along the heading [m]; negative: backwards.
    """
    pose, load, margin = record["base_pose"], record["wheel_load"], record["tip_margin"]
    tips = [event.time for event in record.events if event.kind == TIP_OVER]
    traction, labels = record["traction_demand"], record.labels["wheel_load"]

    def least(values: Array, since: float) -> float | None:
        margins = [*values[record.time >= since].tolist(), *(0.0 for time in tips if time >= since)]
        if np.isfinite(steps).all() and len(steps) and since == -np.inf:
            margins.append(float(steps[-1]))
        return min(margins, default=None)

    def named(loads: Array | None) -> dict[str, float] | None:
        return None if loads is None else dict(zip(labels, loads.tolist(), strict=True))

    return {
        "pose_final": pose[-1].tolist() if len(pose) else None,
        "path_length_m": float(np.abs(np.diff(travel)).sum()),
        "wheel_load_min_N": named(least_loads(record, steps) if len(load) else None),
        "wheel_load_final_N": named(load[-1] if len(load) else None),
        "tip_margin_min": least(margin, -np.inf),
        "tip_margin_min_settled": least(margin, settle),
        "overturns_at_s": min(tips, default=None),
        "overturns_settled_at_s": overturns_settled(record, settle),
        "traction_demand_max": max(traction[np.isfinite(traction)].tolist(), default=None),
    }


def overturns_settled(record: Record, settle: float) -> float | None:
    """Return the first time [s], not before ``settle``, at which a mobile base tips or has tipped, or None."""
    time, margin = record.time, record["tip_margin"]
    late = [event.time for event in record.events if event.kind == TIP_OVER and event.time >= settle]
    late += time[(time >= settle) & (margin < 0.0)][:1].tolist()
    return min(late, default=None)


def _mean(values: Array, time: Array) -> float:
    """Return the mean over time (trapezoidal rule)."""
    return float(np.trapezoid(values, time) / (time[-1] - time[0]))
