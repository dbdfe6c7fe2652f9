"""Signals, summary and warnings of the snake's task-space control, for both snake plants."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.engine.snake_control import OBSTACLES, SnakeControl
from dynsim.record import Record
from dynsim.record.measures import SHORT, percent
from dynsim.snake import state as ss
from dynsim.snake.description import COORDINATES, conditioning
from dynsim.snake.state import SnakeTrace

OUT_OF_REACH = 1.0
"""A target whose motion has waited for this time at the end of a run [s] is reported out of reach."""


ASTRAY = 1e-3
"""A head that is further than this from where its controller takes it to be [m] is reported."""


def _wrapped(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return angle - 2.0 * np.pi * np.floor((angle + np.pi) / (2.0 * np.pi))


def attitude(w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices R = Rz(gamma) Ry(beta) Rx(alpha) of poses w, shape (T, 6) -> (T, 3, 3)."""
    (sa, sb, sg), (ca, cb, cg) = np.sin(w[:, 3:]).T, np.cos(w[:, 3:]).T
    return np.array(
        [
            [cg * cb, cg * sb * sa - sg * ca, cg * sb * ca + sg * sa],
            [sg * cb, sg * sb * sa + cg * ca, sg * sb * ca - cg * sa],
            [-sb, cb * sa, cb * ca],
        ]
    ).transpose(2, 0, 1)


def attitude_distance(w: NDArray[np.float64], w_target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle of the rotation between two attitudes [rad], shape (T,)."""
    # From the Frobenius norm: the arc cosine of a trace loses half the digits near zero.
    norm = np.linalg.norm(attitude(w) - attitude(w_target), axis=(1, 2))
    return 2.0 * np.arcsin(np.clip(norm / np.sqrt(8.0), 0.0, 1.0))


def hold_last(trace: SnakeTrace) -> None:
    """Complete the last row, at whose time no control period begins, with the values held until then."""
    if len(trace.u) > 1:
        for array in (trace.u, trace.slip, trace.at_limit):
            array[-1] = array[-2]


def add_task(
    record: Record, run: SnakeControl, trace: SnakeTrace, w: NDArray[np.float64], points: NDArray[np.float64]
) -> None:
    """Signals of the controlled point, the modes, the redundancy, the support, and the posture as a polyline.

    Parameters
    ----------
    trace : a row for each sample of the record
    w : (T, 6) pose of the controlled point
    points : (T, points, 3) [m]
    """
    # Angles of w on the branch of the target, so that no curve jumps by 2 pi.
    w = w.copy()
    w[:, 3:] = trace.w_target[:, 3:] + _wrapped(w[:, 3:] - trace.w_target[:, 3:])
    position_error = np.linalg.norm(w[:, :3] - trace.w_target[:, :3], axis=1)
    attitude_error = attitude_distance(w, trace.w_target)
    grounded = run.controller.law.grounded[trace.mode]
    ticks, period = run.tick, run.controller.schedule.period
    gripper = run.gripper[np.minimum(np.rint(record.time / period).astype(int), max(ticks - 1, 0))]
    names = run.description.joint_names
    pairs = tuple(f"pair{i + 1}" for i in range(run.description.pairs))
    add = record.add
    add("w", w, "m, rad", labels=COORDINATES, description="pose of the controlled point")
    add("w_target", trace.w_target, "m, rad", labels=COORDINATES, description="its target")
    add("w_estimate", trace.w_hat, "m, rad", labels=COORDINATES, description="what the controller takes it for")
    add("position_error", position_error, "m", description="distance of the controlled point from its target")
    add("attitude_error", attitude_error, "rad", description="angle between its attitude and the target's")
    add("base_pose", trace.base, "m, rad", labels=("x", "y", "yaw"), description="base part, at wheel pair 1")
    add("mode", np.array(run.controller.modes.numbers)[trace.mode], "1", description="mode number")
    add("grounded", grounded, "1", labels=pairs, description="1 where the wheel pair is on the ground")
    add("gripper", gripper, "1", description="1 closed (hardened), 0 open (soft)")
    add("cost", trace.cost, "1", description="V of the redundancy")
    add("sigma_min", trace.sigma, "1", description="smallest singular value of B~ of the mode, unweighted")
    add("support_margin", trace.margin, "m", description="centre of mass inside the support polygon by this much")
    add("support_area", trace.area, "m^2", description="of the support polygon")
    add("centre_of_mass", trace.centre, "m", labels=("x", "y", "z"))
    add("slip", trace.slip, "m/s", description="largest violation of a wheel row within the period")
    add("at_limit", trace.at_limit, "1", labels=names, description="1 joint out of the allocation, 2 clamped")
    labels = tuple(f"point{i}" for i in range(points.shape[1]))
    add("posture", points, "m", labels=labels, description="polyline: controlled point, joints, axles to the tail")


def _waiting_for(counts: NDArray[np.int64], period: float) -> dict[str, float]:
    """Why the target waited, and how long [s]; reasons that did not occur are left out."""
    known = counts[ss.WAITED_FOR + 1 : ss.PATH_SLOWED]
    ticks = [*known, counts[ss.WAITED] - known.sum()]
    return {name: float(count * period) for name, count in zip(OBSTACLES, ticks, strict=True) if count}


def _out_of_reach(counts: NDArray[np.int64], period: float, duration: float) -> dict[str, Any] | None:
    """Since when a target has waited that waits at the end of the run, and for what; None where it does not."""
    still = float(counts[ss.STILL] * period)
    if still < OUT_OF_REACH:
        return None
    return {"since_s": duration - still, "reason": OBSTACLES[counts[ss.STILL_FOR] - 1]}


def task_summary(run: SnakeControl, record: Record) -> dict[str, Any]:
    """What the control has done, for ``summary.json``."""
    description, law, period = run.description, run.controller.law, run.controller.schedule.period
    counts = run.state.counts
    phi, w, at_limit = record["phi"], record["w"], record["at_limit"]
    beyond = np.maximum(phi - description.upper, description.lower - phi)
    duration = float(record.time[-1])
    return {
        "final_position_error_m": float(record["position_error"][-1]),
        "final_attitude_error_rad": float(record["attitude_error"][-1]),
        "position_error_max_m": float(record["position_error"].max()),
        "attitude_error_max_rad": float(record["attitude_error"].max()),
        "displacement": (w[-1] - w[0]).tolist(),
        "target_displacement": (record["w_target"][-1] - record["w_target"][0]).tolist(),
        "final_phi_rad": phi[-1].tolist(),
        "final_base_pose": record["base_pose"][-1].tolist(),
        "joint_limit_violation_max_rad": float(max(beyond.max(), 0.0)),
        "joints_taken_out": [description.joint_names[j] for j in np.flatnonzero((at_limit == 1).any(axis=0))],
        "waiting_s": float(counts[ss.WAITED] * period),
        "waiting_for_s": _waiting_for(counts, period),
        "path_slowed_s": float(counts[ss.PATH_SLOWED] * period),
        "path_late_s": float(run.state.progress[ss.LATE] * period),
        "out_of_reach": _out_of_reach(counts, period, duration),
        "slowed_s": float(counts[ss.SLOWED] * period),
        "null_space_reduced_s": float(counts[ss.NULL_REDUCED] * period),
        "clamped_joint_ticks": int(counts[ss.CLAMPED]),
        "joint_rate_max_rad_s": float(np.abs(record["phi_dot"]).max()),
        "wheel_rate_max_rad_s": float(np.abs(record["rho_dot"]).max(initial=0.0)),
        "slip_max_m_s": float(record["slip"].max()),
        "cost_initial": float(record["cost"][0]),
        "cost_final": float(record["cost"][-1]),
        "mode_switches": run.switcher.switches,
        "modes_refused": sum(not refusal.taken for refusal in run.switcher.refusals),
        "refusals": [
            {
                "time_s": refusal.tick * period,
                "mode": run.controller.modes.numbers[refusal.row],
                # JSON has no infinity: None where the predicted state is no longer finite
                "support_margin_m": refusal.margin if np.isfinite(refusal.margin) else None,
                "taken": refusal.taken,
            }
            for refusal in run.switcher.refusals
        ],
        "sigma_min_min": float(record["sigma_min"].min()),
        "support_margin_min_m": float(record["support_margin"].min()),
        "support_area_initial_m2": float(record["support_area"][0]),
        "support_area_final_m2": float(record["support_area"][-1]),
        "tipping": bool((record["support_margin"] <= 0.0).any()),
        "model": {
            str(number): conditioning(run.model, law, row, record["base_pose"][0], phi[0])._asdict()
            for row, number in enumerate(run.controller.modes.numbers)
        },
    }


def effort(summary: dict[str, Any]) -> dict[str, Any]:
    """What a battery gives for a dynamic run, and the servo whose rms torque is the largest part of its rating."""
    rated = {k: m.get("nominal_torque_N_m", m.get("stall_torque_N_m")) for k, m in enumerate(summary["motors"])}
    share = {k: summary["motors"][k]["torque_rms_N_m"] / rating for k, rating in rated.items() if rating}
    return {
        "battery_energy_Wh": summary["electrical_energy_supply_J"] / 3600.0,
        **({"worst_joint": summary["motors"][max(share, key=lambda k: share[k])]} if share else {}),
    }


def task_warnings(run: SnakeControl, record: Record, summary: dict[str, Any]) -> list[str]:
    """What a user should know of the control, a line each."""
    warnings = []
    if summary["waiting_s"] >= SHORT * summary["duration_s"] > 0.0:
        share = percent(min(summary["waiting_s"] / summary["duration_s"], 1.0))
        why = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in summary["waiting_for_s"].items())
        warnings.append(f"the target waited for {summary['waiting_s']:.2f} s ({share} of the run): {why}")
    if (gone := summary["out_of_reach"]) is not None:
        target = ", ".join(f"{value:.3f}" for value in record["w_target"][-1])
        warnings.append(
            f"the path is out of reach from t = {gone['since_s']:.2f} s on ({gone['reason']}): the target waited there "
            f"to the end of the run, at ({', '.join(COORDINATES)}) = ({target})"
        )
    if summary["path_slowed_s"] > 0.0:
        warnings.append(
            f"the path is too fast for the joints: the target was slower than commanded for "
            f"{summary['path_slowed_s']:.2f} s and came {summary['path_late_s']:.2f} s late "
            "(controller.rate_limit_rad_s)"
        )
    if summary["slowed_s"] > 0.0:
        warnings.append(
            f"feedback and shape points were slowed down for {summary['slowed_s']:.2f} s: they asked for more than the "
            "limits of joints and rates allow"
        )
    if summary["null_space_reduced_s"] > 0.0:
        warnings.append(
            f"the null-space motion was reduced for {summary['null_space_reduced_s']:.2f} s to keep the rate limit: "
            "the cost falls slower there (controller.null_gain)"
        )
    if summary["clamped_joint_ticks"]:
        off = np.linalg.norm(record["w_estimate"][:, :3] - record["w_target"][:, :3], axis=1).max()
        warnings.append(
            f"joints were clamped at their limits in {summary['clamped_joint_ticks']} joint-ticks: by the joint angles "
            f"that the controller knows, the head is off its target by up to {1e3 * off:.3g} mm"
        )
    astray = np.linalg.norm(record["w"][:, :3] - record["w_estimate"][:, :3], axis=1).max()
    if astray > ASTRAY and run.controller.schedule.state_source not in {ss.MEASURED, ss.GIVEN}:
        warnings.append(
            f"the head is up to {1e3 * astray:.3g} mm from where the controller takes it to be: servos sag under their "
            "loads and wheels slip (controller.state: measured sees both)"
        )
    if summary["tipping"]:
        share = percent(float((record["support_margin"] <= 0.0).mean()))
        warnings.append(f"the robot tips: its centre of mass is outside the support polygon for {share} of the run")
    least, margin = run.controller.least_margin, record["support_margin"]
    if least > 0.0 and not summary["tipping"] and margin.min() <= least:
        worst = int(margin.argmin())
        warnings.append(
            f"the support margin falls to {1e3 * margin[worst]:.1f} mm at t = {record.time[worst]:.2f} s, below "
            f"switching.least_margin_m ({1e3 * least:g} mm): it is tested when a mode is chosen, not within it"
        )
    return warnings + _refusal_warnings(summary["refusals"], run.controller.least_margin)


def _refusal_warnings(refusals: list[dict[str, Any]], least_margin: float) -> list[str]:
    """One line for every mode that was refused, and one for every mode that was taken although it tips."""
    texts = []
    for mode, taken in dict.fromkeys((refusal["mode"], refusal["taken"]) for refusal in refusals):
        same = [refusal for refusal in refusals if (refusal["mode"], refusal["taken"]) == (mode, taken)]
        margin = same[0]["support_margin_m"]
        needed = f"a support margin of more than {1e3 * least_margin:g} mm is needed, it has"
        why = "its prediction diverges" if margin is None else f"{needed} {1e3 * margin:.1f} mm"
        outcome = "taken, as no other stands better," if taken else "refused"
        times = f" ({len(same)} times in all)" if len(same) > 1 else ""
        texts.append(f"mode {mode} was {outcome} at t = {same[0]['time_s']:.3f} s{times}: {why}")
    return texts
