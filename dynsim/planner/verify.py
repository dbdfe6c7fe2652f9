"""Verification of plans by simulation with planned and modified friction, and with displaced surfaces."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dynsim.model.description import Array
from dynsim.model.drives import Motor
from dynsim.planner import planned_scenario
from dynsim.planner.compiled.retract import ON
from dynsim.planner.dense import Dense, nearest
from dynsim.planner.problem import BraceSchedule, Candidate, Task, contact_names
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
class Case:
    """Errors of a simulated run.

    Attributes
    ----------
    friction_factor : float
        Factor by which μ is multiplied.
    surface_shift_m : float
        Displacement of all surfaces upwards [m].
    payload_factor, robot_factor : float
        Factors by which the masses of payloads, and of links and motors, are multiplied.
    """

    friction_factor: float = 1.0
    surface_shift_m: float = 0.0
    payload_factor: float = 1.0
    robot_factor: float = 1.0

    @property
    def label(self) -> str:
        """Errors as text."""
        factors = {
            "friction": self.friction_factor, "payloads": self.payload_factor, "mass of the robot": self.robot_factor,
        }  # fmt: skip
        texts = [f"{name} × {factor:g}" for name, factor in factors.items() if factor != 1.0]
        if self.surface_shift_m != 0.0:
            texts.append(f"surfaces {1e3 * self.surface_shift_m:+g} mm")
        return ", ".join(texts) or "as planned"


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
        Maximum heat as a multiple of the heat of the nominal run.
    hand_m : float or None
        Maximum rms error of the hand, in addition to the displacement of the surface [m]; None: no limit.
    turn_rad : float or None
        Maximum rms angle between the hand's orientation and its reference [rad]; None: no limit.
    wall_s : float
        Maximum wall-clock time of the simulation of a corner case [s].
    gains : tuple of float
        Gains k_p to choose from, in decreasing order [V/rad].
    payload, mass : float
        Relative errors of the masses of payloads, and of links and motors; 0: not tested.
    """

    friction: tuple[float, ...] = (1.0, 0.8, 1.2)
    shift_m: tuple[float, ...] = (0.0, 0.005, -0.005)
    heat: float = 1.5
    hand_m: float | None = None
    turn_rad: float | None = None
    wall_s: float = 10.0
    gains: tuple[float, ...] = (500.0, 200.0, 100.0, 50.0, 20.0, 10.0, 5.0)
    payload: float = 0.0
    mass: float = 0.0

    @property
    def corners(self) -> list[Case]:
        """Corner cases: all combinations of friction and surfaces, first as planned, then each error of masses."""
        cases = [Case(mu, shift) for shift in self.shift_m for mu in self.friction]
        for key, error in (("payload_factor", self.payload), ("robot_factor", self.mass)):
            cases += [Case(**{key: 1.0 + signed}) for signed in (error, -error) if error > 0.0]
        return cases

    def hand_limit(self, case: Case) -> float:
        """Return the maximum rms error of the hand in a run [m]; infinite without a limit."""
        return float("inf") if self.hand_m is None else abs(case.surface_shift_m) + self.hand_m

    @property
    def most_shift(self) -> float:
        """Maximum error of the surface height [m]."""
        return max(map(abs, self.shift_m), default=0.0)

    @property
    def most_friction(self) -> float:
        """Maximum relative error of friction."""
        return max((abs(factor - 1.0) for factor in self.friction), default=0.0)


@dataclass(frozen=True)
class Verification:
    """Which plans are verified, and how.

    Attributes
    ----------
    tolerances : Tolerances
        Errors and limits.
    verify : bool
        Whether corner cases are simulated. Requirements that need no run are always checked.
    explain : bool
        Whether the largest errors that rejected plans tolerate are determined.
    jobs : int
        Number of worker processes.
    """

    tolerances: Tolerances = field(default_factory=Tolerances)
    verify: bool = True
    explain: bool = False
    jobs: int = 1


@dataclass(frozen=True)
class Corner(Case):
    """Corner case: a run with modified friction, surfaces and masses.

    Attributes
    ----------
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
        Fraction of its phases during which each brace touches its surface.
    kind : str
        Kind of the reason: ``ended``, ``heat``, ``hand``, ``touch`` or ``limit``; empty if the case is accepted.
    rating_share, rated_joint : float, str
        Maximum rms torque of a motor as a fraction of its continuous rating, 0 if no rating is known; its joint.
    reason : str
        Reason why the corner case is rejected, with time and quantity; empty if it is accepted.
    """

    heat_W: float = float("nan")
    hand_rms_m: float = float("nan")
    electrical_energy_J: float = float("nan")
    joint_rate_max: float = float("nan")
    hand_turn_rms_rad: float = float("nan")
    closed_fraction: dict[str, float] = field(default_factory=dict)
    kind: str = ""
    rating_share: float = 0.0
    rated_joint: str = ""
    reason: str = ""

    @property
    def hand_error_m(self) -> float:
        """Rms error of the hand, in addition to the displacement of the surfaces [m]."""
        return self.hand_rms_m - abs(self.surface_shift_m)


@dataclass(frozen=True)
class Requirement:
    """Result of one requirement.

    Attributes
    ----------
    key : str
        Key in the section ``requirements`` of the scenario.
    value : float
        Value of the plan, in the unit of the key; NaN if a run ended early.
    limit : float
        Maximum value.
    reason : str
        Reason why the requirement is not met; empty if it is met, or if the reasons of the runs contain it.
    """

    key: str
    value: float
    limit: float
    reason: str = ""

    @property
    def met(self) -> bool:
        """Whether the requirement is met."""
        return self.value <= self.limit

    @property
    def margin(self) -> float:
        """Distance from the limit as a fraction of the limit; negative if the requirement is not met."""
        return 1.0 - self.value / self.limit


@dataclass(frozen=True)
class Verdict:
    """Corner cases of one plan with its gain, first the nominal run, and the results of its requirements."""

    k_p: float
    corners: tuple[Corner, ...]
    requirements: tuple[Requirement, ...] = ()

    @property
    def reasons(self) -> list[str]:
        """Reasons of rejected corner cases, then of requirements that are not met."""
        corners = [f"{corner.label}: {corner.reason}" for corner in self.corners if corner.reason]
        return corners + [requirement.reason for requirement in self.requirements if requirement.reason]

    @property
    def reason(self) -> str:
        """First reason; empty if all corner cases are accepted and all requirements met."""
        return next(iter(self.reasons), "")

    @property
    def kind(self) -> str:
        """Kind of this reason; empty if all are accepted."""
        return next((c.kind for c in self.corners if c.reason), "")

    @property
    def hand_m(self) -> float:
        """Largest rms error of the hand, in addition to the displacement of the surface [m]; NaN without runs."""
        errors = [c.hand_error_m for c in self.corners if np.isfinite(c.hand_rms_m)]
        return max(errors, default=np.nan)

    @property
    def survives(self) -> bool:
        """Whether all corner cases are accepted, and all requirements are met."""
        return bool(self.corners) and not self.reason

    @property
    def sound(self) -> bool:
        """Whether the nominal run is accepted."""
        return bool(self.corners) and not self.corners[0].reason

    @property
    def nominal(self) -> Corner | None:
        """Nominal run; None if there are no corner cases."""
        return self.corners[0] if self.corners else None


Require = Callable[[tuple[Candidate, ...], Dense, float, Sequence[Corner]], tuple[Requirement, ...]]


class Verifier:
    """Simulation of the corner cases of several plans at a time."""

    def __init__(self, task: Task, tolerances: Tolerances, jobs: int = 1, require: Require | None = None) -> None:
        self.task, self.tolerances, self.jobs = task, tolerances, jobs
        self._require = require or (lambda *plan: ())
        # Runs by references, gain and errors; the references are kept, so that their identity is unique.
        self._known: dict[tuple[int, float, Case], tuple[Dense, Corner]] = {}
        self._first: dict[int, tuple[Dense, int]] = {}

    def verify(self, plans: Sequence[tuple[tuple[Candidate, ...], Dense]]) -> list[Verdict]:
        """Return the verdict on each plan for the first gain with which it survives, or for the best gain tried.

        The first gain follows from statics: a displacement δ changes the force of a brace by δ/(J K⁻¹ Jᵀ), with
        K = K_m k_p/R. If a run needs too much heat, the next smaller gain is tried, otherwise the next larger gain. The
        nominal run is simulated first; if it is rejected, errors and other gains are not tried.
        """
        gains, others = self.tolerances.gains, self.tolerances.corners[1:]
        tried: dict[int, list[Verdict]] = {number: [] for number in range(len(plans))}
        trial: dict[int, int] = {n: self._first_gain(*plan) for n, plan in enumerate(plans)}
        while trial:
            nominal = dict(zip(trial, self.nominal([plans[n] for n in trial], list(trial.values())), strict=True))
            sound = [n for n in trial if not nominal[n].reason]
            corners = self._runs([(*plans[n], gains[trial[n]], corner) for n in sound for corner in others])
            following: dict[int, int] = {}
            for n, k in trial.items():
                at = sound.index(n) * len(others) if n in sound else 0
                runs = (nominal[n], *(corners[at : at + len(others)] if n in sound else ()))
                verdict = Verdict(gains[k], runs, self._require(*plans[n], gains[k], runs))
                tried[n].append(verdict)
                if n in sound and not verdict.survives and len(tried[n]) < (TRIES if plans[n][0] else 1):
                    known = {each.k_p for each in tried[n]}
                    step = 1 if verdict.kind == "heat" else -1
                    left = [m for m in (k + step, k - step) if 0 <= m < len(gains) and gains[m] not in known]
                    following |= {n: left[0]} if left else {}
            trial = following
        return [min(verdicts, key=lambda verdict: len(verdict.reasons)) for verdicts in tried.values()]

    def nominal(
        self, plans: Sequence[tuple[tuple[Candidate, ...], Dense]], gains: Sequence[int] | None = None
    ) -> list[Corner]:
        """Simulate the nominal runs of plans with the gains of these indices, by default the first gain of each."""
        gains = gains or [self._first_gain(*plan) for plan in plans]
        runs = zip(plans, gains, strict=True)
        return self._runs([(*plan, self.tolerances.gains[k], self.tolerances.corners[0]) for plan, k in runs])

    def _first_gain(self, braces: tuple[Candidate, ...], dense: Dense) -> int:
        """Return the index of the largest gain that tolerates the errors according to statics, or of the last."""
        if id(dense) not in self._first:
            gains = self.tolerances.gains
            tolerated = (k for k, k_p in enumerate(gains) if self._tolerates(braces, dense, k_p))
            self._first[id(dense)] = dense, next(tolerated, len(gains) - 1)
        return self._first[id(dense)][1]

    def _runs(self, runs: Sequence[tuple[tuple[Candidate, ...], Dense, float, Case]]) -> list[Corner]:
        """Simulate corner cases of several plans in parallel, except for known ones."""
        new = [run for run in runs if (id(run[1]), *run[2:]) not in self._known]
        if new:
            results = simulate_batch(
                [self.perturbed(*run) for run in new], jobs=min(self.jobs, len(new)), keep_records="all"
            )
            for (_, dense, k_p, case), result in zip(new, results, strict=True):
                if result.record is None or not result.ok:
                    corner = Corner(**vars(case), kind="ended", reason=result.reason)
                else:
                    _, nominal = self._known.get((id(dense), k_p, self.tolerances.corners[0]), (dense, None))
                    corner = self._judge(dense.schedule, case, result.record, nominal)
                self._known[id(dense), k_p, case] = dense, corner
        return [self._known[id(dense), k_p, case][1] for _, dense, k_p, case in runs]

    def perturbed(self, braces: tuple[Candidate, ...], dense: Dense, k_p: float, case: Case = Case()) -> Scenario:
        """Return the plan's scenario with modified friction and masses, and displaced surfaces."""
        more: dict[str, Any] = {}
        friction, shift, payload, robot = vars(case).values()
        if friction != 1.0 or shift != 0.0:
            more["surface_error"] = {"shift_m": (shift * self._up).tolist(), "friction_factor": friction}
        if payload != 1.0 or robot != 1.0:
            more["mass_error"] = {"payload_factor": payload, "robot_factor": robot}
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
        stiffness = planned_scenario.stiffness(task, braces, dense, k_p)
        problem = task.problem(braces, 1)
        work, up = problem.work, self._up
        hot, none = 0.0, np.zeros((len(problem.course.knot), len(braces)))
        rows = range(0, len(dense.times), max(len(dense.times) // 12, 1))
        for t in rows:
            problem.evaluate(dense.q[t : t + 1].copy(), none)
            acting = dense.acting(t)
            J = work.gap_rate[0, acting]
            rise = np.array([up @ normal for normal in work.normal[acting]])
            torque = dense.torques[dense.sample(t)]
            pressed = J @ (J / stiffness).T + ON * np.eye(len(J))
            hottest = 0.0
            for shift in (worst, -worst):
                change = J.T @ np.linalg.solve(pressed, shift * rise)
                hottest = max(hottest, float(tables.heat @ (torque - change) ** 2))
            hot += hottest
        return hot / len(rows) <= 1.2 * self.tolerances.heat * dense.heat

    def _judge(self, schedule: BraceSchedule, case: Case, record: Record, nominal: Corner | None) -> Corner:
        """Evaluate a run, and find the first reason to reject it; its heat is compared with the nominal run."""
        tolerances, time, shift = self.tolerances, record.time, case.surface_shift_m
        heat = float(record.summary["joule_heat_J"]) / float(time[-1])
        target = hand_target(record)
        assert target is not None
        error = np.linalg.norm(record["hand_position"] - target, axis=1)
        rms = float(np.sqrt(np.mean(error**2)))
        # Other contacts are pairs of bodies that stay apart.
        shares = dict(zip(contact_names(schedule.braces), self.task.shares(schedule), strict=True))
        closed = {
            c["name"]: min(float(c["closed_fraction"]) / shares[c["name"]], 1.0)
            for c in record.summary["contacts"]
            if c["name"] in shares
        }
        turn = float("nan")
        if "hand_turn_error" in record:
            turn = float(np.sqrt(np.mean(record["hand_turn_error"] ** 2)))
        share, rated = max(_rated_shares(record), default=(0.0, ""))
        kind, reason = "", ""
        least = np.inf if nominal is None else nominal.heat_W
        allowed = tolerances.hand_limit(case)
        if touching := self._touches(schedule, record, shift):
            kind, reason = "touch", touching
        elif heat > tolerances.heat * least:
            power = record["heat_joule"].ravel() if "heat_joule" in record else np.zeros(len(time))
            late = np.flatnonzero(power > tolerances.heat * least * np.maximum(time, 0.1 * time[-1]))
            since = float(time[late[0]]) if late.size else float(time[-1])
            kind = "heat"
            reason = f"heat of {heat:.3g} W exceeds {tolerances.heat:g} × {least:.3g} W from t = {since:.3g} s"
        elif limit := self._limits(record):
            kind, reason = "limit", limit
        elif rms > allowed:
            k = int(error.argmax())
            kind = "hand"
            reason = f"hand error {1e3 * rms:.3g} mm rms (limit {1e3 * allowed:.3g} mm), maximum at t = {time[k]:.3g} s"
        elif tolerances.turn_rad is not None and turn > tolerances.turn_rad:
            k = int(record["hand_turn_error"].argmax())
            kind = "hand"
            reason = (
                f"orientation error of the hand {turn:.3g} rad rms (limit {tolerances.turn_rad:g} rad), maximum at "
                f"t = {time[k]:.3g} s"
            )
        joints = self.task.arm.joints
        rates = record["v"][:, [record.labels["v"].index(joint) for joint in joints]]
        energy, rate = float(record.summary["electrical_energy_J"]), float(np.abs(rates).max())
        return Corner(
            **vars(case), heat_W=heat, hand_rms_m=rms, electrical_energy_J=energy, joint_rate_max=rate,
            hand_turn_rms_rad=turn, closed_fraction=closed, rating_share=share, rated_joint=rated, kind=kind,
            reason=reason,
        )  # fmt: skip

    def _touches(self, schedule: BraceSchedule, record: Record, shift: float) -> str:
        """Return a text about an unbraced point or pair of solids that touches; empty if nothing does."""
        arm = self.task.arm
        places = np.array([record.labels["q"].index(joint) for joint in arm.joints])
        q = record["q"][:, places]
        # The surfaces of the run are displaced by the shift.
        distance, part, when = nearest(self.task, schedule, record.time, q, shift * self._up)
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

        def tolerates(corner: Case) -> bool:
            both = corner, Case(2.0 - corner.friction_factor, -corner.surface_shift_m)
            return not any(c.reason for c in self._runs([(braces, dense, k_p, each) for each in both]))

        def largest(most: float, corner: Callable[[float], Case]) -> float | None:
            low, high = 0.0, most
            if most == 0.0:
                return None
            if tolerates(corner(high)):
                return high
            for _ in range(STEPS):
                middle = 0.5 * (low + high)
                low, high = (middle, high) if tolerates(corner(middle)) else (low, middle)
            return low

        shift = largest(self.tolerances.most_shift, lambda x: Case(surface_shift_m=x))
        friction = largest(self.tolerances.most_friction, lambda x: Case(1.0 + x))
        return shift, friction


def _rated_shares(record: Record) -> Iterator[tuple[float, str]]:
    """Yield the rms load of each motor with a continuous rating as a fraction of this rating, and its joint."""
    for motor in record.summary["motors"]:
        for load, unit in (("torque", "N_m"), ("force", "N")):
            if (rating := motor.get(f"continuous_{load}_{unit}")) is not None:
                yield motor[f"{load}_rms_{unit}"] / rating, motor["joint"]
