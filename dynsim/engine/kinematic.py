"""Engine of the kinematic snake: task-space signals and warnings, carried objects, the run, its record and check."""

from __future__ import annotations

import logging
import math
import time as clock
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim._version import __version__
from dynsim.compile.hand_posture import turn_error
from dynsim.compile.model import Model
from dynsim.compile.scene import robot_scene, snake_scene
from dynsim.engine import Progress, Start
from dynsim.engine.compilation import kernels_logged
from dynsim.engine.gripper import (
    HARDENED,
    HARDENING,
    SOFT,
    SOFTENING,
    add_gripper,
    gripper_event,
    gripper_summary,
    nearest_object,
    refuse_capture,
    state_text,
)
from dynsim.engine.outcome import check_size, interrupted, run_to_end
from dynsim.engine.recording import pictured_parts, provenance
from dynsim.engine.snake_control import OBSTACLES, SnakeControl, control_periods
from dynsim.engine.target_distance import LEAST, DistanceCause
from dynsim.errors import ModelError, SimulationStopped
from dynsim.jit.kernel import reals
from dynsim.library.families import member
from dynsim.model.description import Array, Link, Robot
from dynsim.model.gripper import Gripper, grasp_frame, graspable
from dynsim.record import Event, Record
from dynsim.record.measures import SHORT, percent
from dynsim.record.poses import add_body_poses, pose_columns
from dynsim.record.scene import quaternion
from dynsim.scenario import Scenario, build
from dynsim.scenario.effect import without_effect
from dynsim.scenario.schema import SceneObject
from dynsim.snake import ticks as ss
from dynsim.snake.description import COORDINATES, CommandSource, SnakeDescription, conditioning
from dynsim.snake.kinematics import new_chain, posture_points
from dynsim.snake.ticks import SnakeTrace, new_trace, record_row, run_ticks
from dynsim.system import interruption

# Signals, summary and warnings of the task-space control, for both snake plants.


OUT_OF_REACH = 1.0
"""A target that has waited at least this long at the end of a run [s] is reported as out of reach."""


# A joint closer than this to its limit is at the limit [rad].
AT_LIMIT = 1e-9
ESTIMATE_ERROR = 1e-3
"""Errors of the controller's head position estimate above this [m] are reported."""


def attitude(w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrices R = Rz(gamma) Ry(beta) Rx(alpha) of poses w, shape (T, 6) -> (T, 3, 3)."""
    (sa, sb, sg), (ca, cb, cg) = np.sin(w[:, 3:]).T, np.cos(w[:, 3:]).T
    return np.array(
        [
            [cg * cb, cg * sb * sa - sg * ca, cg * sb * ca + sg * sa],
            [sg * cb, sg * sb * sa + cg * ca, sg * sb * ca - cg * sa],
            [-sb, cb * sa, cb * ca],
        ]
    ).transpose(2, 0, 1)


def attitude_distance(w: NDArray[np.float64], w_target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation angle between two attitudes [rad], shape (T,)."""
    # Use the Frobenius norm, because the arc cosine of a trace loses half of the digits near zero.
    norm = np.linalg.norm(attitude(w) - attitude(w_target), axis=(1, 2))
    return 2.0 * np.arcsin(np.clip(norm / np.sqrt(8.0), 0.0, 1.0))


def hold_last(trace: SnakeTrace) -> None:
    """Copy the values of the last control period to the last row, because no control period starts at its time."""
    if len(trace.u) > 1:
        for array in (trace.u, trace.slip, trace.at_limit):
            array[-1] = array[-2]


def add_task(
    record: Record, run: SnakeControl, trace: SnakeTrace, w: NDArray[np.float64], points: NDArray[np.float64]
) -> None:
    """Add signals of the controlled point, the modes, the redundancy, the support, and the posture as a polyline.

    Parameters
    ----------
    record : Record
        Record to extend.
    run : SnakeControl
        Control of the run.
    trace : SnakeTrace
        One row for each sample of the record.
    w : (T, 6) ndarray
        Pose of the controlled point [m, rad].
    points : (T, points, 3) ndarray
        Points of the posture [m].
    """
    # Angles of w on the branch of the target, to avoid jumps by 2 pi.
    w = w.copy()
    off = w[:, 3:] - trace.w_target[:, 3:]
    w[:, 3:] = trace.w_target[:, 3:] + (off - 2.0 * np.pi * np.floor((off + np.pi) / (2.0 * np.pi)))
    position_error = np.linalg.norm(w[:, :3] - trace.w_target[:, :3], axis=1)
    attitude_error = attitude_distance(w, trace.w_target)
    grounded = run.controller.law.grounded[trace.mode]
    ticks, period = run.tick, run.controller.schedule.period
    gripper = run.gripper[np.minimum(np.rint(record.time / period).astype(int), max(ticks - 1, 0))]
    names = run.description.joint_names
    pairs = tuple(f"pair{i + 1}" for i in range(run.description.pairs))
    add = record.add
    add("w", w, "m, rad", labels=COORDINATES, description="pose of the controlled point")
    add("w_target", trace.w_target, "m, rad", labels=COORDINATES, description="target pose")
    add("w_estimate", trace.w_hat, "m, rad", labels=COORDINATES, description="pose estimated by the controller")
    add("position_error", position_error, "m", description="distance of the controlled point from its target")
    add("attitude_error", attitude_error, "rad", description="angle between its attitude and the target attitude")
    add("base_pose", trace.base, "m, rad", labels=("x", "y", "yaw"), description="pose of base part at wheel pair 1")
    add("mode", np.array(run.controller.modes.numbers)[trace.mode], "1", description="mode number")
    add("grounded", grounded, "1", labels=pairs, description="1 if the wheel pair is on the ground")
    add("gripper", gripper, "1", description="1: closed (hardened), 0: open (soft)")
    add("cost", trace.cost, "1", description="redundancy cost V")
    add("sigma_min", trace.sigma, "1", description="smallest singular value of the unweighted matrix B~ of the mode")
    add(
        "support_margin",
        trace.margin,
        "m",
        description="distance from the centre of mass to the nearest edge of the support polygon; negative: outside",
    )
    add("support_area", trace.area, "m^2", description="area of the support polygon")
    add("centre_of_mass", trace.centre, "m", labels=("x", "y", "z"))
    add("slip", trace.slip, "m/s", description="largest violation of a rolling constraint in the period")
    add("at_limit", trace.at_limit, "1", labels=names, description="1: joint removed from allocation, 2: clamped")
    labels = tuple(f"point{i}" for i in range(points.shape[1]))
    add("posture", points, "m", labels=labels, description="polyline: controlled point, joints, axles to the tail")


def task_summary(run: SnakeControl, record: Record) -> dict[str, Any]:
    """Return the controller's part of ``summary.json``."""
    description, law, period = run.description, run.controller.law, run.controller.schedule.period
    counts = run.state.counts
    phi, w, at_limit = record["phi"], record["w"], record["at_limit"]
    beyond = np.maximum(phi - description.upper, description.lower - phi)
    # Reasons for which the target waited, in periods, and the end of a wait that lasts to the end of the run [s].
    known, still = counts[ss.WAITED_FOR + 1 : ss.PATH_SLOWED], float(counts[ss.STILL] * period)
    waited = zip(OBSTACLES, [*known, counts[ss.WAITED] - known.sum()], strict=True)
    since = float(record.time[-1]) - still
    gone = {"since_s": since, "reason": OBSTACLES[counts[ss.STILL_FOR] - 1]} if still >= OUT_OF_REACH else None
    return {
        "initial_position_error_m": float(record["position_error"][0]),
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
        "waiting_for_s": {reason: float(count * period) for reason, count in waited if count},
        "path_slowed_s": float(counts[ss.PATH_SLOWED] * period),
        "path_late_s": float(run.state.progress[ss.LATE] * period),
        "out_of_reach": gone,
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
                # JSON has no infinity: None if the predicted state is not finite
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
    """Return the battery energy of a dynamic run, and the servo with the largest ratio of rms torque to its rating."""
    rated = {k: m.get("nominal_torque_N_m", m.get("stall_torque_N_m")) for k, m in enumerate(summary["motors"])}
    share = {k: summary["motors"][k]["torque_rms_N_m"] / rating for k, rating in rated.items() if rating}
    return {
        "battery_energy_Wh": summary["electrical_energy_supply_J"] / 3600.0,
        **({"worst_joint": summary["motors"][max(share, key=lambda k: share[k])]} if share else {}),
    }


def task_warnings(run: SnakeControl, record: Record, summary: dict[str, Any]) -> list[str]:
    """Return the warnings of the task-space control."""
    warnings = []
    if summary["waiting_s"] >= SHORT * summary["duration_s"] > 0.0:
        share = percent(min(summary["waiting_s"] / summary["duration_s"], 1.0))
        why = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in summary["waiting_for_s"].items())
        warnings.append(f"the target waited for {summary['waiting_s']:.2f} s ({share} of the run): {why}")
    if (gone := summary["out_of_reach"]) is not None:
        target = ", ".join(f"{value:.3f}" for value in record["w_target"][-1])
        warnings.append(
            f"the path is out of reach from t = {gone['since_s']:.2f} s on ({gone['reason']}): the target waited "
            f"until the end of the run at ({', '.join(COORDINATES)}) = ({target})"
        )
    if summary["path_slowed_s"] > 0.0:
        warnings.append(
            f"the path is too fast for the joints: the target was slower than commanded for "
            f"{summary['path_slowed_s']:.2f} s and is {summary['path_late_s']:.2f} s late "
            "(controller.rate_limit_rad_s)"
        )
    if summary["slowed_s"] > 0.0:
        warnings.append(
            f"feedback and shape points were slowed down for {summary['slowed_s']:.2f} s: they required more than the "
            "joint and rate limits allow"
        )
    if summary["null_space_reduced_s"] > 0.0:
        warnings.append(
            f"the null-space motion was reduced for {summary['null_space_reduced_s']:.2f} s to keep the rate limit: "
            "the cost decreases more slowly there (controller.null_gain)"
        )
    if summary["clamped_joint_ticks"]:
        off = np.linalg.norm(record["w_estimate"][:, :3] - record["w_target"][:, :3], axis=1).max()
        warnings.append(
            f"joints were clamped at their limits in {summary['clamped_joint_ticks']} joint-ticks: according to the "
            f"controller's joint angles, the head is off its target by up to {1e3 * off:.3g} mm"
        )
    estimate_error = np.linalg.norm(record["w"][:, :3] - record["w_estimate"][:, :3], axis=1).max()
    if estimate_error > ESTIMATE_ERROR and run.controller.schedule.state_source not in {ss.MEASURED, ss.GIVEN}:
        warnings.append(
            f"the controller's estimate of the head position is off by up to {1e3 * estimate_error:.3g} mm: servos sag "
            "under load and wheels slip; use controller.state: measured"
        )
    if summary["tipping"]:
        share = percent(float((record["support_margin"] <= 0.0).mean()))
        warnings.append(f"the robot tips: its centre of mass is outside the support polygon for {share} of the run")
    least, margin = run.controller.least_margin, record["support_margin"]
    if least > 0.0 and not summary["tipping"] and margin.min() <= least:
        worst = int(margin.argmin())
        warnings.append(
            f"the support margin drops to {1e3 * margin[worst]:.1f} mm at t = {record.time[worst]:.2f} s, below "
            f"switching.least_margin_m ({1e3 * least:g} mm): it is checked only when a mode is chosen"
        )
    return warnings + _refusal_warnings(summary["refusals"], run.controller.least_margin)


def _refusal_warnings(refusals: list[dict[str, Any]], least_margin: float) -> list[str]:
    """Return one line for each refused mode, and one for each mode that was used although the robot tips in it."""
    texts = []
    for mode, taken in dict.fromkeys((refusal["mode"], refusal["taken"]) for refusal in refusals):
        same = [refusal for refusal in refusals if (refusal["mode"], refusal["taken"]) == (mode, taken)]
        margin = same[0]["support_margin_m"]
        needed = f"it requires a support margin of more than {1e3 * least_margin:g} mm and has"
        why = "its prediction diverges" if margin is None else f"{needed} {1e3 * margin:.1f} mm"
        outcome = "used because no other mode is more stable," if taken else "refused"
        times = f" ({len(same)} times in total)" if len(same) > 1 else ""
        texts.append(f"mode {mode} was {outcome} at t = {same[0]['time_s']:.3f} s{times}: {why}")
    return texts


# Objects of a kinematic snake: they exert no forces, follow the gripper while it holds them, and are otherwise
# stationary.


# A grasp frame closer than this to the hinge axis defines no angle; the rotation of the gripper is used instead [m].
ON_AXIS = 0.01


@dataclass
class HeldObject:
    """An object that the gripper holds from one tick to another.

    Attributes
    ----------
    name : str
        Name of the object.
    start, end : int, float
        First and last tick.
    tip : ((3, 3) ndarray, (3,) ndarray)
        Rotation and position of the gripper tip at the start.
    q : ndarray
        All object coordinates at the start.
    released : ndarray or None
        Coordinates of the object from ``end`` on.
    """

    name: str
    start: int
    end: float
    tip: tuple[Array, Array]
    q: Array
    released: Array | None = None


class CarriedObjects:
    """Objects of a run, and the intervals in which the gripper held them.

    Parameters
    ----------
    scenario : Scenario
        Scenario with objects.
    gripper : Gripper
        Gripper of the snake.
    ahead : float
        Distance by which the gripper tip is in front of the controlled point [m].
    period : float
        Control period [s].
    """

    def __init__(self, scenario: Scenario, gripper: Gripper, ahead: float, period: float) -> None:
        self.objects: dict[str, SceneObject] = scenario.config.objects
        self.gripper, self._ahead, self._period = gripper, ahead, period
        links = [link for name, body in self.objects.items() for link in body.links(name)]
        frames = [frame for name, body in self.objects.items() for frame in body.frames(name)]
        start = np.concatenate([body.start() for body in self.objects.values()])
        first = next(iter(self.objects))
        self.robot = Robot("objects", tuple(links), (), (first, np.zeros(3)), q0=start, frames=tuple(frames))
        self.model, self.q = Model(self.robot), start.copy()
        # Slice of the coordinates of each object.
        sizes = [len(body.start()) for body in self.objects.values()]
        ends = np.cumsum(sizes).tolist()
        self._part = {name: slice(end - size, end) for name, size, end in zip(self.objects, sizes, ends, strict=True)}
        self.graspable = graspable(self.robot)
        self.grasps: list[HeldObject] = []
        self.events: list[Event] = []
        self._closed = False

    def tip(self, w: Array) -> tuple[Array, Array]:
        """Return rotation and position of the gripper tip at a pose (6,) of the controlled point."""
        R = attitude(w[None])[0]
        return R, w[:3] + self._ahead * R[:, 0]

    def command(self, tick: int, closed: bool, w: Array) -> None:
        """Close or open the gripper at a tick, with the controlled point at w (6,).

        Raises
        ------
        SimulationStopped
            If the gripper closes and no object is within capture range.
        """
        if closed == self._closed or not self.graspable:
            self._closed = closed
            return
        self._closed, time = closed, tick * self._period
        present = self.grasps[-1] if self.grasps and self.grasps[-1].end > tick else None
        if not closed:
            if present is not None:
                hardened = min((tick - present.start) * self._period / self.gripper.hardening, 1.0)
                present.end = tick + math.ceil(hardened * self.gripper.softening / self._period - 1e-9)
                self.events.append(gripper_event(present.end * self._period, "releases", present.name))
            return
        if present is not None:  # the gripper was still softening
            present.end = np.inf
            self.events.pop()
            return
        tip = self.tip(w)
        name, distance, angle = nearest_object(self.model, self.graspable, self.q, tip, self.gripper)
        refuse_capture(self.gripper, time, name, distance, angle)
        self.grasps.append(HeldObject(name, tick, np.inf, tip, self.q.copy()))
        self.events.append(gripper_event(time, "captures", name, distance))

    def release(self, tick: int, w: Array) -> None:
        """Release the objects that are due for release, with the controlled point at w (6,)."""
        for grasp in self.grasps:
            if grasp.released is None and grasp.end <= tick:
                part = self._part[grasp.name]
                grasp.released = self.q[part] = self._followed(grasp, *self.tip(w))

    def due(self, tick: int) -> float:
        """Return the number of periods until the next release."""
        return min((grasp.end - tick for grasp in self.grasps if grasp.released is None), default=math.inf)

    def _move_to(self, tick: int, w: Array) -> None:
        """Set the coordinates of held and released objects at a tick."""
        for grasp in self.grasps:
            if tick >= grasp.end and grasp.released is not None:
                self.q[self._part[grasp.name]] = grasp.released
            elif grasp.start <= tick <= grasp.end:
                self.q[self._part[grasp.name]] = self._followed(grasp, *self.tip(w))

    def _followed(self, grasp: HeldObject, R: Array, p: Array) -> Array:
        """Return the coordinates of a held object with the gripper at rotation R and position p."""
        body, (R0, p0) = self.objects[grasp.name], grasp.tip
        index, at = self.robot.attach(grasp_frame(grasp.name), np.zeros(3))
        B, origin = self.model.body_pose(index, grasp.q)
        before = grasp.q[self._part[grasp.name]]
        if body.joint is None:
            turn = R @ R0.T
            return np.array([*(p + turn @ (origin - p0)), *quaternion(turn @ B), *before[7:]])
        link = self.robot.links[index]
        axis = B @ link.axis
        if body.slide is not None:
            return np.clip(before + axis @ (p - p0), link.lower, link.upper)
        # Position of the grasp frame relative to the hinge axis, in the plane of the hinge: before it moves with the
        # tip, and afterwards.
        was = B @ at - axis * (axis @ B @ at)
        if np.linalg.norm(was) < ON_AXIS:
            return self._turned(grasp, before + axis @ turn_error(R0, R), link)
        now = was + (p - p0) - axis * (axis @ (p - p0))
        angle = float(np.arctan2(axis @ np.cross(was, now), was @ now))
        return self._turned(grasp, before + angle, link)

    def _turned(self, grasp: HeldObject, angle: Array, link: Link) -> Array:
        """Return an angle within the hinge limits, unwrapped relative to the last position."""
        last = self.q[self._part[grasp.name]]
        turns = np.round((last - angle) / (2.0 * np.pi))
        return np.clip(angle + 2.0 * np.pi * turns, link.lower, link.upper)

    def state_in_words(self, tick: int) -> str:
        """Return the state of the gripper at a tick as text for the pilot's page."""
        present = next((grasp for grasp in reversed(self.grasps) if grasp.start <= tick <= grasp.end), None)
        return state_text(self._state(present, tick), None if present is None else present.name)

    def positions(self, tick: int, w: Array) -> dict[str, float]:
        """Return the coordinates of the objects, with the controlled point at w (6,) at this tick."""
        self._move_to(tick, w)
        return dict(zip(self.robot.position_names, self.q.tolist(), strict=True))

    def _state(self, grasp: HeldObject | None, tick: float) -> int:
        if grasp is None:
            return SOFT
        if (grasp.end - tick) * self._period <= self.gripper.softening:
            return SOFTENING if tick < grasp.end else SOFT
        return HARDENED if (tick - grasp.start) * self._period >= self.gripper.hardening else HARDENING

    def add_to(self, record: Record, w: Array, ticks: NDArray[np.int64]) -> None:
        """Add object coordinates (signal ``q``) and gripper signals, at poses (T, 6) and ticks (T,)."""
        self.q, rows = self.robot.initial.copy(), []
        state, distance = np.zeros(len(ticks), dtype=np.int64), np.zeros(len(ticks))
        for row, tick in enumerate(ticks.tolist()):
            self._move_to(tick, w[row])
            rows.append(self.q.copy())
            if self.graspable:
                distance[row] = nearest_object(self.model, self.graspable, self.q, self.tip(w[row]))[1]
        for grasp in self.grasps:
            within = np.flatnonzero((ticks >= grasp.start) & (ticks <= grasp.end))
            state[within] = [self._state(grasp, tick) for tick in ticks[within].tolist()]
        labels = self.robot.position_names
        record.add("q", np.array(rows), "rad or m", labels=labels, description="coordinates of objects")
        if self.graspable:
            add_gripper(record, state, distance, self.events)


# Run of the kinematic snake: compiled control periods, with mode switches between them in Python.


CHUNK = 500  # ticks between checks for signals and progress updates: about 25 ms, at most ten times as long


class SnakeRun(SnakeControl):
    """Control of a snake whose joints follow the commanded rates exactly and whose base moves as its wheels roll."""

    objects: CarriedObjects | None = None

    def load_kernels(self) -> None:
        """Compile or load the kernels, so that this is not counted as simulation time."""
        law, schedule, trial = self.controller.law, self.controller.schedule, deepcopy(self.state)
        trace = new_trace(self.model, 1)
        run_ticks(self.model, law, schedule, trial, self.block.velocity, 0, 1, 1, 1, self.ws, trace)
        record_row(self.model, law, trial, self.ws, 0, trace)

    def advance(self) -> None:
        """Run the control periods up to the next possible change of command or mode; one if commands come singly.

        Raises
        ------
        SimulationStopped
            If the state is no longer finite, or the source failed.
        """
        self.begin_period()
        periods = min(self.periods(), CHUNK)
        if self.objects is not None:
            now, block = self.tick, self.block.gripper[self.tick - self.block_start :]
            w, _, _ = self.posture()
            self.objects.release(now, w)
            self.objects.command(now, bool(block[0]), w)
            changes = np.flatnonzero(block != block[0])
            periods = int(min([periods, self.objects.due(now), *changes[:1].tolist()]))
        law, schedule, velocity = self.controller.law, self.controller.schedule, self.block.velocity
        moving, stop = int(not self.recovering), int(self.controller.when_blocked)
        done, blocked = run_ticks(
            self.model, law, schedule, self.state, velocity, periods, moving, stop, self.stride, self.ws, self.trace
        )
        if done < 0:
            raise self.diverged()
        self.end_period(blocked)


# Record of a run of the kinematic snake: signals, summary, warnings.


def make_record(run: SnakeRun, scenario: Scenario, wall: float, pictured: bool = True) -> Record:
    """Return the record of a complete or incomplete run.

    Parameters
    ----------
    run : SnakeRun
        Run after its last tick; its final state becomes the last sample.
    scenario : Scenario
        Scenario of the run.
    wall : float
        Wall-clock time spent on the control periods [s].
    pictured : bool, optional
        If False, omit the scene and the poses of its bodies.
    """
    description, state, law = run.description, run.state, run.controller.law
    model, period, ticks = run.model, run.controller.schedule.period, run.tick
    rows = -(-ticks // run.stride) + 1
    trace = SnakeTrace(*(array[:rows] for array in run.trace))
    record_row(model, law, state, run.ws, rows - 1, trace)
    hold_last(trace)
    trace.w_hat[-1] = state.w_hat
    time = np.append(np.arange(rows - 1) * run.stride, ticks) * period
    points = np.zeros((rows, 1 + model.head_joints + 2 * model.base_joints, 3))
    posture_points(model, reals(trace.base), reals(trace.phi), run.ws.work.frame, new_chain(model), np.zeros(6), points)
    names, wheels, joints = description.joint_names, description.wheel_names, len(description.joint_names)
    record = Record(time, provenance=provenance(scenario))
    add = record.add
    add("phi", trace.phi, "rad", labels=names, description="joint angles, head to tail")
    add("rho", trace.rho, "rad", labels=wheels, description="angles of the active wheels")
    add("phi_dot", trace.u[:, :joints], "rad/s", labels=names, description="joint rates until the next control period")
    add("rho_dot", trace.u[:, joints:], "rad/s", labels=wheels, description="wheel rates until the next control period")
    add_task(record, run, trace, trace.w, points)
    if run.objects is not None:
        run.objects.add_to(record, trace.w, np.rint(time / period).astype(np.int64))
    if pictured:
        scene = snake_scene(description)
        if run.objects is not None:
            own, shifted = robot_scene(run.objects.robot, (), {}), len(scene.bodies)
            assert own is not None
            bodies = (replace(body, parent=body.parent + shifted) if body.parent >= 0 else body for body in own.bodies)
            scene = replace(scene, bodies=(*scene.bodies, *bodies))
        record.scene = pictured_parts(scene, scenario)
        add_body_poses(record)
    summary = {
        "scenario": scenario.name,
        "variant": scenario.variant,
        "dynsim_version": __version__,
        "duration_s": float(record.time[-1]),
        "integration_wall_s": wall,
        "real_time_factor": float(record.time[-1]) / wall if wall > 0.0 else 0.0,
        "steps": int(state.counts[ss.TICKS]),
        **task_summary(run, record),
        "final_position_error_causes": _clamped_joints(run, record),
    }
    warnings = [*task_warnings(run, record, summary), *_passed_limits(run, record)]
    if run.objects is not None and run.objects.graspable:
        summary["gripper"] = gripper_summary(record, run.objects.graspable)
    summary["warnings"] = [*warnings, *without_effect(scenario)]
    record.summary = summary
    return record


def _clamped_joints(run: SnakeRun, record: Record) -> list[dict[str, Any]]:
    """Return the joints that clamping keeps at their limits as the cause of an error of the head at the end."""
    d, phi = run.description, record["phi"][-1]
    at_limit = np.minimum(d.upper - phi, phi - d.lower) < AT_LIMIT
    if not (run.state.counts[ss.CLAMPED] and at_limit.any() and record["position_error"][-1] > LEAST):
        return []
    joints = [name for name, at in zip(d.joint_names, at_limit, strict=True) if at]
    return [DistanceCause("clamped", 1.0, joints)._asdict()]


def _passed_limits(run: SnakeRun, record: Record) -> list[str]:
    """Warn of the joint that exceeds its limit most; unlike the dynamic level, this level has no joint stops."""
    d = run.description
    beyond = np.maximum(record["phi"] - d.upper, d.lower - record["phi"]).max(axis=0)
    worst = int(beyond.argmax())
    if beyond[worst] <= 1e-9:  # rounding
        return []
    return [
        f"{d.joint_names[worst]} exceeds its limit by {beyond[worst]:.3f} rad; a real joint would stop there; "
        "use controller.limit_policy: allocate"
    ]


log = logging.getLogger(__name__)


def prepare(scenario: Scenario, source: CommandSource | None = None) -> SnakeRun:
    """Build robot, controller and initial state, and read the first commands.

    Parameters
    ----------
    scenario : Scenario
        Scenario with a kinematic plant.
    source : CommandSource, optional
        Source that replaces the commands and paths of the scenario.

    Raises
    ------
    ModelError
        If the robot cannot be controlled as configured, if the scenario uses unsupported sections, or if a command
        requests an unknown mode.
    ScenarioError
        If the recording rate does not divide the control rate, or the record would be too large.
    """
    if scenario.controller is None or member("controller", scenario.controller.type).ENGINE != "kinematic":
        raise ModelError(f"plant {scenario.plant.type!r} (kinematic) requires controller.type: task_space")
    config = scenario.config
    for section, used, fix in (
        ("contacts.points", config.contacts.points, "remove it"),
        ("loads", config.loads, "remove it"),
        ("sensors.wrench", config.sensors and config.sensors.wrench, "remove it, or set plant.level: dynamic"),
    ):
        if used:
            plant = f"the kinematic plant {scenario.plant.type!r}, which has no forces"
            raise ModelError(f"{section} is not supported by {plant}; {fix}", keys=tuple(section.split(".")))
    description = build.machine(scenario)
    assert isinstance(description, SnakeDescription)
    controller = build.snake_controller(scenario, description)
    model, period = description.arrays(), controller.schedule.period
    ticks, stride = control_periods(scenario, period)
    rows, bodies = -(-ticks // stride) + 1, len(snake_scene(description).bodies)
    check_size(scenario, rows, sum(array[0].size for array in new_trace(model, 1)) + pose_columns(bodies))
    run = SnakeRun(description, model, controller, controller.source if source is None else source, ticks, stride)
    if scenario.config.objects:
        plant = scenario.plant
        ahead = plant.gripper_length_m - description.point_offset
        run.objects = CarriedObjects(scenario, plant.gripper.gripper(plant.gripper_length_m), ahead, period)
    run.read_commands(waiting=False)
    return run


def check(scenario: Scenario, started: Callable[[Start], None]) -> Start:
    """Check the scenario, see :func:`dynsim.engine.check`; a snake has no contact points."""
    start = Start(prepare(scenario).state.w_target[:3].copy(), {}, warnings=without_effect(scenario))
    started(start)
    return start


def simulate(
    scenario: Scenario,
    progress: Progress | None = None,
    source: CommandSource | None = None,
    *,
    pictured: bool = True,
) -> Record:
    """Simulate the scenario, see :func:`dynsim.engine.simulate`; also raises the errors of :func:`prepare`.

    A live ``source`` (joystick) replaces the commands and paths of the scenario. It is read in every control period and
    receives the state of the robot. To run in real time, its ``read`` waits until the period is due.
    """
    run = prepare(scenario, source)
    with kernels_logged(log, "kinematic snakes"):
        run.load_kernels()
    started = clock.perf_counter()

    def work() -> None:
        log.info("%s: integrating %g s in %d control periods", scenario.title, scenario.duration_s, run.ticks)
        while run.tick < run.ticks:
            _check_wall(run, clock.perf_counter() - started, scenario.integrator.wall_limit_s)
            run.advance()
            if progress is not None:
                progress(run.time)
            interruption.check()

    def record() -> Record:
        wall = clock.perf_counter() - started
        log.info("%s: integrated %d control periods in %.3f s", scenario.title, run.tick, wall)
        return make_record(run, scenario, wall, pictured)

    return run_to_end(work, lambda: interrupted(scenario, run.time, run.postures()), record)


def _check_wall(run: SnakeRun, spent: float, limit: float | None) -> None:
    """Raise SimulationStopped if the wall-clock limit [s] is exceeded."""
    if limit is not None and spent > limit:
        raise SimulationStopped(
            f"stopped at t = {run.time:g} s: the wall-clock limit, integrator.wall_limit_s = {limit:g} s, is exceeded "
            f"in mode {run.mode}",
            time=run.time,
            state=run.postures(),
        )
