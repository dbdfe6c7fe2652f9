"""Verification of plans by simulation with planned and modified friction, and with displaced surfaces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dynsim.model.description import Array
from dynsim.model.drives import Motor
from dynsim.planner import planned_scenario
from dynsim.planner.compiled import ON
from dynsim.planner.dense import Dense, nearest
from dynsim.planner.problem import Candidate, Task
from dynsim.record import Record
from dynsim.record.measures import hand_target
from dynsim.scenario import Scenario
from dynsim.studies.batch import simulate_batch

# Fraction of a driver's current limit at which the limit counts as reached.
AT_LIMIT = 0.999
# Distance from a joint limit at which the joint counts as at its stop [rad or m].
AT_STOP = 1e-6
# Depth beyond which an unbraced point counts as touching a surface [m]; it allows for sampling and for the tolerance of
# references.
DEPTH_MAX = 1e-4
# Maximum number of gains tried per plan.
TRIES = 3
# Number of bisections to find the tolerated error.
STEPS = 5


@dataclass(frozen=True)
class Tolerances:
    """Corner cases to simulate, and the limits that a plan must meet in all of them.

    Attributes
    ----------
    friction : tuple of float
        Factors by which μ is multiplied.
    shift_m : tuple of float
        Displacements of all surfaces upwards, against gravity [m].
    heat : float
        Maximum heat as a multiple of the planned heat.
    nominal : float
        Maximum excess of the heat in the nominal run, as a fraction of the planned heat.
    hand_m : float
        Maximum rms error of the hand, in addition to the displacement of the surface [m].
    turn_rad : float
        Maximum rms angle between the hand's orientation and its reference [rad].
    wall_s : float
        Maximum wall-clock time of the simulation of a corner case [s].
    gains : tuple of float
        Gains k_p to choose from, in decreasing order [V/rad].
    """

    friction: tuple[float, ...] = (1.0, 0.8, 1.2)
    shift_m: tuple[float, ...] = (0.0, 0.005, -0.005)
    heat: float = 1.5
    nominal: float = 0.05
    hand_m: float = 0.005
    turn_rad: float = 0.05
    wall_s: float = 10.0
    gains: tuple[float, ...] = (500.0, 200.0, 100.0, 50.0, 20.0, 10.0, 5.0)

    @property
    def most_shift(self) -> float:
        """Maximum error of the surface height [m]."""
        return max(map(abs, self.shift_m), default=0.0)

    @property
    def most_friction(self) -> float:
        """Maximum relative error of friction."""
        return max((abs(factor - 1.0) for factor in self.friction), default=0.0)


@dataclass(frozen=True)
class Corner:
    """Corner case: a run with modified friction and surfaces.

    Attributes
    ----------
    friction_factor : float
        Factor by which μ is multiplied.
    surface_shift_m : float
        Displacement of all surfaces upwards [m].
    heat_W : float
        Mean heat [W]; NaN if the run ended early.
    hand_rms_m : float
        Rms error of the hand [m]; NaN if the run ended early.
    electrical_energy_J : float
        Electrical energy of the motors [J].
    joint_rate_max : float
        Maximum joint rate [rad/s or m/s].
    hand_turn_rms_rad : float
        Rms error of the hand's orientation [rad]; NaN without a reference orientation.
    closed_fraction : dict
        Fraction of the time during which each brace touches its surface.
    reason : str
        Reason why the corner case is rejected, with time and quantity; empty if it is accepted.
    """

    friction_factor: float
    surface_shift_m: float
    heat_W: float = float("nan")
    hand_rms_m: float = float("nan")
    electrical_energy_J: float = float("nan")
    joint_rate_max: float = float("nan")
    hand_turn_rms_rad: float = float("nan")
    closed_fraction: dict[str, float] = field(default_factory=dict)
    reason: str = ""

    @property
    def label(self) -> str:
        """Friction factor and displacement as text."""
        return f"friction × {self.friction_factor:g}, surfaces {1e3 * self.surface_shift_m:+g} mm"


@dataclass(frozen=True)
class Verdict:
    """Corner cases of one plan with its gain; the first corner case is the nominal run."""

    k_p: float
    corners: tuple[Corner, ...]

    @property
    def reason(self) -> str:
        """Reason for rejecting the first rejected corner case; empty if all are accepted."""
        return next((f"{c.label}: {c.reason}" for c in self.corners if c.reason), "")

    @property
    def survives(self) -> bool:
        """Whether all corner cases are accepted."""
        return bool(self.corners) and not self.reason

    @property
    def sound(self) -> bool:
        """Whether the nominal run is accepted."""
        return bool(self.corners) and not self.corners[0].reason

    @property
    def nominal(self) -> Corner | None:
        """Nominal run; None if there are no corner cases."""
        return self.corners[0] if self.corners else None


class Verifier:
    """Simulation of the corner cases of several plans at a time."""

    def __init__(self, task: Task, tolerances: Tolerances, jobs: int = 1) -> None:
        self.task, self.tolerances, self.jobs = task, tolerances, jobs

    def verify(self, plans: Sequence[tuple[tuple[Candidate, ...], Dense]]) -> list[Verdict]:
        """Return the verdict on each plan for the largest gain with which it survives, or for the last gain tried.

        The first gain follows from statics: a displacement δ changes the force of a brace by δ/(J K⁻¹ Jᵀ), with
        K = K_m k_p/R. Then smaller gains are tried. The nominal run is simulated first; if it fails, the other corners
        are skipped.
        """
        gains = self.tolerances.gains
        first, *others = [(mu, shift) for shift in self.tolerances.shift_m for mu in self.tolerances.friction]
        left = {}
        for number, (braces, dense) in enumerate(plans):
            tolerated = [k_p for k_p in gains if self._tolerates(braces, dense, k_p)]
            left[number] = (tolerated or [min(gains)])[: TRIES if braces else 1]
        verdicts: dict[int, Verdict] = {}
        while left:
            trial = {number: tried.pop(0) for number, tried in left.items()}
            nominal = self._runs([(*plans[number], k_p, first) for number, k_p in trial.items()])
            verdicts |= {n: Verdict(k_p, (c,)) for (n, k_p), c in zip(trial.items(), nominal, strict=True)}
            sound = [n for n in trial if verdicts[n].survives]
            corners_of_all = self._runs([(*plans[n], trial[n], corner) for n in sound for corner in others])
            for k, n in enumerate(sound):
                corners = corners_of_all[k * len(others) : (k + 1) * len(others)]
                verdicts[n] = Verdict(trial[n], (*verdicts[n].corners, *corners))
            # If the nominal run fails, it would be even worse with smaller gains.
            left = {n: tried for n, tried in left.items() if tried and n in sound and not verdicts[n].survives}
        return [verdicts[number] for number in range(len(plans))]

    def _runs(self, runs: Sequence[tuple[tuple[Candidate, ...], Dense, float, tuple[float, float]]]) -> list[Corner]:
        """Simulate corner cases of several plans in parallel."""
        if not runs:
            return []
        scenarios = [self.perturbed(braces, dense, k_p, *corner) for braces, dense, k_p, corner in runs]
        results = simulate_batch(scenarios, jobs=min(self.jobs, len(runs)), keep_records="all")
        corners = []
        for (braces, dense, _, (mu, shift)), result in zip(runs, results, strict=True):
            if result.record is None or not result.ok:
                corners.append(Corner(mu, shift, reason=result.reason))
            else:
                corners.append(self._judge(braces, dense, mu, shift, result.record))
        return corners

    def perturbed(
        self, braces: tuple[Candidate, ...], dense: Dense, k_p: float, friction: float = 1.0, shift: float = 0.0
    ) -> Scenario:
        """Return the plan's scenario with modified friction and displaced surfaces."""
        more: dict[str, Any] = {}
        if friction != 1.0 or shift != 0.0:
            more["surface_error"] = {"shift_m": (shift * self._up).tolist(), "friction_factor": friction}
        more["integrator"] = {"method": planned_scenario.method(self.task), "wall_limit_s": self.tolerances.wall_s}
        more["record"] = {"rate_hz": 100.0}
        return planned_scenario.scenario(self.task, braces, dense, k_p, more=more)

    @property
    def _up(self) -> Array:
        gravity = self.task.arm.model.robot.gravity
        return -gravity / np.linalg.norm(gravity)

    def _tolerates(self, braces: tuple[Candidate, ...], dense: Dense, k_p: float) -> bool:
        """Return whether, according to statics, the heat stays within its limit at the maximum surface displacement."""
        worst = self.tolerances.most_shift
        if not braces or worst == 0.0:
            return True
        task, tables = self.task, self.task.arm.tables
        motors = {motor.joint: motor for motor in task.arm.model.robot.motors}
        gains = planned_scenario.stiffness_gains(task, braces, dense, k_p)
        constants = [m.joint_constant / m.resistance for j in task.arm.joints if isinstance(m := motors[j], Motor)]
        stiffness = gains * np.array(constants)
        problem = task.problem(braces, 1)
        work, up = problem.work, self._up
        hot, none = 0.0, np.zeros((len(problem.course.knot), len(braces)))
        rows = range(0, len(dense.times), max(len(dense.times) // 12, 1))
        for t in rows:
            problem.evaluate(dense.q[t : t + 1].copy(), none)
            J = work.gap_rate[0, : len(braces)]
            rise = np.array([up @ normal for normal in work.normal])
            torque = dense.torques[min(round(dense.times[t] / dense.fine[1]), len(dense.fine) - 1)]
            pressed = J @ (J / stiffness).T + ON * np.eye(len(braces))
            hottest = 0.0
            for shift in (worst, -worst):
                change = J.T @ np.linalg.solve(pressed, shift * rise)
                hottest = max(hottest, float(tables.heat @ (torque - change) ** 2))
            hot += hottest
        return hot / len(rows) <= 1.2 * self.tolerances.heat * dense.heat

    def _judge(self, braces: tuple[Candidate, ...], dense: Dense, mu: float, shift: float, record: Record) -> Corner:
        """Evaluate a run, and find the first reason to reject it."""
        tolerances, time = self.tolerances, record.time
        heat = float(record.summary["joule_heat_J"]) / float(time[-1])
        target = hand_target(record)
        assert target is not None
        error = np.linalg.norm(record["hand_position"] - target, axis=1)
        rms = float(np.sqrt(np.mean(error**2)))
        closed = {contact["name"]: float(contact["closed_fraction"]) for contact in record.summary["contacts"]}
        turn = float("nan")
        if "hand_turn_error" in record:
            turn = float(np.sqrt(np.mean(record["hand_turn_error"] ** 2)))
        reason = ""
        allowed = abs(shift) + tolerances.hand_m
        if heat > tolerances.heat * dense.heat:
            power = record["heat_joule"].ravel() if "heat_joule" in record else np.zeros(len(time))
            late = np.flatnonzero(power > tolerances.heat * dense.heat * np.maximum(time, 0.1 * time[-1]))
            since = float(time[late[0]]) if late.size else float(time[-1])
            reason = f"heat of {heat:.3g} W exceeds {tolerances.heat:g} × {dense.heat:.3g} W from t = {since:.3g} s"
        elif mu == 1.0 and shift == 0.0 and heat > (1.0 + tolerances.nominal) * dense.heat:
            # Less heat is fine: the plan assumes full sliding friction even if a brace sticks.
            reason = (
                f"heat of {heat:.3g} W over the whole run exceeds the planned {dense.heat:.3g} W by more than "
                f"{100 * tolerances.nominal:g} %"
            )
        elif rms > allowed:
            k = int(error.argmax())
            reason = f"hand error {1e3 * rms:.3g} mm rms (limit {1e3 * allowed:.3g} mm), maximum at t = {time[k]:.3g} s"
        elif turn > tolerances.turn_rad:
            k = int(record["hand_turn_error"].argmax())
            reason = (
                f"orientation error of the hand {turn:.3g} rad rms (limit {tolerances.turn_rad:g} rad), maximum at "
                f"t = {time[k]:.3g} s"
            )
        else:
            reason = self._touches(braces, record, shift) or self._limits(record)
        joints = self.task.arm.joints
        rates = record["v"][:, [record.labels["v"].index(joint) for joint in joints]]
        energy, rate = float(record.summary["electrical_energy_J"]), float(np.abs(rates).max())
        return Corner(mu, shift, heat, rms, energy, rate, turn, closed, reason)

    def _touches(self, braces: tuple[Candidate, ...], record: Record, shift: float) -> str:
        """Return a text about an unbraced point or pair of solids that touches; empty if nothing does."""
        arm = self.task.arm
        places = np.array([record.labels["q"].index(joint) for joint in arm.joints])
        q = record["q"][:, places]
        # The surfaces of the run are displaced by the shift.
        distance, part, when = nearest(self.task, braces, record.time, q, shift * self._up)
        if distance < -DEPTH_MAX:
            return f"{part}: contact without a brace, {-1e3 * distance:.3g} mm deep at t = {when:.3g} s"
        return ""

    def _limits(self, record: Record) -> str:
        """Return a text about a limit of a motor, joint or base that is reached; empty if none is."""
        robot, time = self.task.arm.model.robot, record.time
        for motor, voltage, current in zip(robot.motors, record["voltage"].T, record["current"].T, strict=True):
            if not isinstance(motor, Motor):
                continue
            for name, values, limit, unit in (
                ("voltage", voltage, motor.voltage_limit, "V"),
                ("current", current, AT_LIMIT * motor.current_limit, "A"),
            ):
                at = np.flatnonzero(np.abs(values) >= limit)
                if at.size:
                    return f"{motor.joint}: {name} at its limit of {limit:.3g} {unit} at t = {time[at[0]]:.3g} s"
        for link, k in zip(robot.links, robot.position_index, strict=True):
            values = record["q"][:, k]
            at = np.flatnonzero((values <= link.lower + AT_STOP) | (values >= link.upper - AT_STOP))
            if at.size:
                return f"{link.joint}: at its stop at t = {time[at[0]]:.3g} s"
        if robot.base is not None:
            margin = record["tip_margin"]
            if float(margin.min()) < 0.0:
                return f"the base tips at t = {time[int(margin.argmin())]:.3g} s"
        return ""

    def tolerance(self, braces: tuple[Candidate, ...], dense: Dense, k_p: float) -> tuple[float | None, float | None]:
        """Find the largest tolerated error of surface height [m] and relative error of friction, each by bisection.

        An entry is None if the tolerances do not include such an error.
        """

        def tolerates(corner: tuple[float, float]) -> bool:
            both = corner, (2.0 - corner[0], -corner[1])
            return not any(c.reason for c in self._runs([(braces, dense, k_p, each) for each in both]))

        def largest(most: float, corner: Callable[[float], tuple[float, float]]) -> float | None:
            low, high = 0.0, most
            if most == 0.0:
                return None
            if tolerates(corner(high)):
                return high
            for _ in range(STEPS):
                middle = 0.5 * (low + high)
                low, high = (middle, high) if tolerates(corner(middle)) else (low, middle)
            return low

        shift = largest(self.tolerances.most_shift, lambda x: (1.0, x))
        friction = largest(self.tolerances.most_friction, lambda x: (1.0 + x, 0.0))
        return shift, friction
