"""Quantities from the signals of a record, for summaries and figures: energy sinks, hand errors, base loads."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.record import Record

# Where the electrical energy goes, in the order in which it is drawn and printed.
SINKS = ("heat_joule", "loss_gear", "loss_joint", "heat_friction")
# Further sinks, under the unilateral law or by time stepping. Elastic energy is that gained since the start.
MORE_SINKS = ("loss_impact", "loss_stop", "loss_damper", "energy_elastic", "loss_scheme")
STORES = ("energy_kinetic", "energy_potential", "energy_magnetic")

# Largest residual of the energy ledger without a warning, as a share of the turnover.
RESIDUAL_LIMIT = 1e-6
# A share of a run that would read 0.0 %.
SHORT = 5e-4
# A share of a run's time below this is rounding error.
ROUNDED = 1e-9

# States of a gripper by the numbers of the signal ``gripper_state``.
GRIPPER_STATES = ("soft", "hardening", "hardened", "softening")
# Kind of the event of a mobile base that tips; found between samples, where the margin is zero.
TIP_OVER = "tip_over"


def sinks(record: Record) -> tuple[str, ...]:
    """The sinks of energy that a record has."""
    return SINKS + tuple(name for name in MORE_SINKS if name in record)


def percent(share: float) -> str:
    """A share of a run with one decimal, and more where it takes them to tell it from none or all of it."""
    least = min(share, 1.0 - share)
    decimals = 1 if least < ROUNDED else max(1, -math.floor(math.log10(100.0 * least)))
    return f"{100.0 * share:.{decimals}f} %"


def energy_turnover(record: Record) -> float:
    """Energy that changed hands: the largest over time of half the sum of all terms' sizes [J]."""
    total = np.abs(record["energy_electrical"]) + np.abs(record["work_constraint"])
    if "work_loads" in record:
        total = total + np.abs(record["work_loads"]).sum(axis=1)
    for name in sinks(record):
        total = total + np.abs(record[name])
    for name in STORES:
        total = total + np.abs(record[name] - record[name][:1])
    return float(0.5 * total.max(initial=0.0))


def hand_target(record: Record) -> NDArray[np.float64] | None:
    """Where the hand should be, (T, 3) [m]: the target of the path or, of a measured run, where the goals have it."""
    return next((record[name] for name in ("target_position", "hand_position_goal") if name in record), None)


def hand_error(record: Record, settle: float) -> dict[str, float | None]:
    """Root mean square, maximum and vertical root mean square of the hand's distance from its target [m].

    Counted from t = ``settle`` on; None without a target or when the run is shorter.
    """
    names = ("hand_error_rms_m", "hand_error_max_m", "hand_error_z_rms_m")
    first = int(np.searchsorted(record.time, settle))
    target = hand_target(record)
    if target is None or len(record) - first < 2:
        return dict.fromkeys(names)
    error, time = record["hand_position"][first:] - target[first:], record.time[first:]
    x, y, z = error.T**2
    square = x + y + z
    values = (_mean(square, time) ** 0.5, square.max() ** 0.5, _mean(z, time) ** 0.5)
    return dict(zip(names, map(float, values), strict=True))


def hand_turn_error(record: Record, settle: float) -> dict[str, float | None]:
    """Root mean square and maximum of the angle between the hand's orientation and its target [rad].

    Counted from t = ``settle`` on; None when the run is shorter, nothing where no orientation is asked for.
    """
    if "hand_turn_error" not in record:
        return {}
    names, late = ("hand_turn_error_rms_rad", "hand_turn_error_max_rad"), record.time >= settle
    angle, time = record["hand_turn_error"][late], record.time[late]
    if len(time) < 2:
        return dict.fromkeys(names)
    return dict(zip(names, (_mean(angle**2, time) ** 0.5, float(angle.max())), strict=True))


def least_loads(record: Record, steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Least loads of wheels and caster, (3,) [N], over the samples and over all steps (``steps``, empty: unknown)."""
    loads = record["wheel_load"].min(axis=0, initial=np.inf)
    return np.minimum(loads, steps[:3]) if len(steps) else loads


def base_summary(
    record: Record, settle: float, steps: NDArray[np.float64], travel: NDArray[np.float64]
) -> dict[str, Any]:
    """How a mobile base has driven and stood; None where there is nothing to say.

    Parameters
    ----------
    settle : time from which ``tip_margin_min_settled`` and ``overturns_settled_at_s`` count [s]
    travel : way of the axle's middle along the heading, backwards negative, (T,) [m]
    steps : (4,) least loads and least margin over all steps, which are closer together than the samples; or empty
    """
    pose, load, margin = record["base_pose"], record["wheel_load"], record["tip_margin"]
    tips = [event.time for event in record.events if event.kind == TIP_OVER]
    traction, labels = record["traction_demand"], record.labels["wheel_load"]

    def least(values: NDArray[np.float64], since: float) -> float | None:
        margins = [*values[record.time >= since].tolist(), *(0.0 for time in tips if time >= since)]
        if np.isfinite(steps).all() and len(steps) and since == -np.inf:
            margins.append(float(steps[-1]))
        return min(margins, default=None)

    def named(loads: NDArray[np.float64] | None) -> dict[str, float] | None:
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
    """First time from ``settle`` on at which a mobile base tips, or lies beyond tipping [s]; None: never."""
    time, margin = record.time, record["tip_margin"]
    late = [event.time for event in record.events if event.kind == TIP_OVER and event.time >= settle]
    late += time[(time >= settle) & (margin < 0.0)][:1].tolist()
    return min(late, default=None)


def _mean(values: NDArray[np.float64], time: NDArray[np.float64]) -> float:
    """Mean over time, by trapezoids."""
    return float(np.trapezoid(values, time) / (time[-1] - time[0]))
