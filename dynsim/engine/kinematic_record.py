"""From a run of the kinematic snake to its record: signals, summary, warnings."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim._version import __version__
from dynsim.compile.scene import snake_scene
from dynsim.engine.kinematic_run import SnakeRun
from dynsim.engine.provenance import provenance
from dynsim.jit.kernel import reals
from dynsim.record import Record
from dynsim.record.poses import add_body_poses
from dynsim.scenario import Scenario
from dynsim.scenario.effect import without_effect
from dynsim.snake import state as ss
from dynsim.snake.description import COORDINATES, conditioning
from dynsim.snake.kinematics import new_chain, posture_points
from dynsim.snake.state import SnakeTrace
from dynsim.snake.ticks import record_row

# Why the target waited, in the order of the counters of dynsim.snake.state.SnakeState; the last is the rest: after
# an obstacle, until switching has brought the joints below switching.release_fraction of their limits.
OBSTACLES = ("joint limit", "rate limit", "singular posture", "attitude at beta = 90 deg", "release of the joints")
OUT_OF_REACH = 1.0
"""A target that waits for so long at the end of a run [s] is called out of reach."""


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


def make_record(run: SnakeRun, scenario: Scenario, wall: float, pictured: bool = True) -> Record:
    """Signals, units, summary and provenance of a run, finished or not.

    Parameters
    ----------
    run : after its last tick; the state at the end becomes the last sample.
    wall : time that the ticks took [s].
    pictured : with the scene and the poses of its bodies.
    """
    description, state, law = run.description, run.state, run.controller.law
    model, period, ticks = run.model, run.controller.schedule.period, run.tick
    rows = -(-ticks // run.stride) + 1
    trace = SnakeTrace(*(array[:rows] for array in run.trace))
    record_row(model, law, state, run.rig, rows - 1, trace)
    if rows > 1:  # no control period begins at the end: what was held goes on
        for array in (trace.u, trace.slip, trace.at_limit):
            array[-1] = array[-2]
    trace.w_hat[-1] = state.w_hat
    time = np.append(np.arange(rows - 1) * run.stride, ticks) * period

    # Angles of w on the branch of the target, so that no curve jumps by 2 pi.
    w = trace.w.copy()
    w[:, 3:] = trace.w_target[:, 3:] + _wrapped(trace.w[:, 3:] - trace.w_target[:, 3:])
    position_error = np.linalg.norm(w[:, :3] - trace.w_target[:, :3], axis=1)
    attitude_error = attitude_distance(w, trace.w_target)
    grounded = law.grounded[trace.mode]
    points = np.zeros((rows, 1 + model.head_joints + 2 * model.base_joints, 3))
    posture_points(
        model, reals(trace.base), reals(trace.phi), run.rig.work.frame, new_chain(model), np.zeros(6), points
    )
    gripper = run.gripper[np.minimum(np.rint(time / period).astype(int), max(ticks - 1, 0))]

    names, wheels = description.joint_names, description.wheel_names
    pairs = tuple(f"pair{i + 1}" for i in range(description.pairs))
    record = Record(time, provenance=provenance(scenario))
    add = record.add
    add("phi", trace.phi, "rad", labels=names, description="joint angles, head to tail")
    add("rho", trace.rho, "rad", labels=wheels, description="angles of the active wheels")
    joints = len(names)
    add("phi_dot", trace.u[:, :joints], "rad/s", labels=names, description="joint rates held from this time on")
    add("rho_dot", trace.u[:, joints:], "rad/s", labels=wheels, description="wheel rates held from this time on")
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
    if pictured:
        record.scene = snake_scene(description)
        add_body_poses(record)
    record.summary = _summary(run, scenario, record, wall)
    return record


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


def _summary(run: SnakeRun, scenario: Scenario, record: Record, wall: float) -> dict[str, Any]:
    description, law, period = run.description, run.controller.law, run.controller.schedule.period
    counts = run.state.counts
    phi, w, at_limit = record["phi"], record["w"], record["at_limit"]
    beyond = np.maximum(phi - description.upper, description.lower - phi)
    duration = float(record.time[-1])
    summary = {
        "scenario": scenario.name,
        "variant": scenario.variant,
        "dynsim_version": __version__,
        "duration_s": duration,
        "integration_wall_s": wall,
        "real_time_factor": duration / wall if wall > 0.0 else 0.0,
        "steps": int(counts[ss.TICKS]),
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
    summary["warnings"] = [*_warnings(run, record, summary), *without_effect(scenario)]
    return summary


def _warnings(run: SnakeRun, record: Record, summary: dict[str, Any]) -> list[str]:
    found = []
    if summary["waiting_s"] > 0.0:
        share = 100.0 * summary["waiting_s"] / max(summary["duration_s"], 1e-9)
        why = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in summary["waiting_for_s"].items())
        found.append(f"the target waited for {summary['waiting_s']:.2f} s ({share:.0f} % of the run): {why}")
    if (gone := summary["out_of_reach"]) is not None:
        place = ", ".join(f"{value:.3f}" for value in record["w_target"][-1])
        found.append(
            f"the path is out of reach from t = {gone['since_s']:.2f} s on ({gone['reason']}): the target waited there "
            f"to the end of the run, at ({', '.join(COORDINATES)}) = ({place})"
        )
    if summary["path_slowed_s"] > 0.0:
        found.append(
            f"the path is too fast for the joints: the target was slower than commanded for "
            f"{summary['path_slowed_s']:.2f} s and came {summary['path_late_s']:.2f} s late "
            "(controller.rate_limit_rad_s)"
        )
    if summary["slowed_s"] > 0.0:
        found.append(
            f"feedback and shape points were slowed down for {summary['slowed_s']:.2f} s: they asked for more than the "
            "limits of joints and rates allow"
        )
    if summary["null_space_reduced_s"] > 0.0:
        found.append(
            f"the null-space motion was reduced for {summary['null_space_reduced_s']:.2f} s to keep the rate limit: "
            "the cost falls slower there (controller.null_gain)"
        )
    if summary["joint_limit_violation_max_rad"] > 1e-9:  # less is rounding
        beyond = np.maximum(record["phi"] - run.description.upper, run.description.lower - record["phi"]).max(axis=0)
        worst = int(beyond.argmax())
        found.append(
            f"{run.description.joint_names[worst]} passes its limit by {beyond[worst]:.3f} rad; a real one would stop "
            "(controller.limit_policy: allocate)"
        )
    if summary["clamped_joint_ticks"]:
        found.append(
            f"joints were clamped at their limits in {summary['clamped_joint_ticks']} joint-ticks: the head is off its "
            f"target by up to {1e3 * summary['position_error_max_m']:.3g} mm"
        )
    if summary["tipping"]:
        share = 100.0 * float((record["support_margin"] <= 0.0).mean())
        found.append(f"the robot tips: its centre of mass is outside the support polygon for {share:.1f} % of the run")
    least, margin = run.controller.least_margin, record["support_margin"]
    if least > 0.0 and not summary["tipping"] and margin.min() <= least:
        worst = int(margin.argmin())
        found.append(
            f"the support margin falls to {1e3 * margin[worst]:.1f} mm at t = {record.time[worst]:.2f} s, below "
            f"switching.least_margin_m ({1e3 * least:g} mm): it is tested when a mode is chosen, not within it"
        )
    return found + _refusal_warnings(summary["refusals"], run.controller.least_margin)


def _refusal_warnings(refusals: list[dict[str, Any]], least_margin: float) -> list[str]:
    """One line for every mode that was refused, and one for every mode that was taken although it tips."""
    found = []
    for mode, taken in dict.fromkeys((refusal["mode"], refusal["taken"]) for refusal in refusals):
        same = [refusal for refusal in refusals if (refusal["mode"], refusal["taken"]) == (mode, taken)]
        margin = same[0]["support_margin_m"]
        needed = f"a support margin of more than {1e3 * least_margin:g} mm is needed, it has"
        why = "its prediction diverges" if margin is None else f"{needed} {1e3 * margin:.1f} mm"
        what = "taken, as no other stands better," if taken else "refused"
        times = f" ({len(same)} times in all)" if len(same) > 1 else ""
        found.append(f"mode {mode} was {what} at t = {same[0]['time_s']:.3f} s{times}: {why}")
    return found
