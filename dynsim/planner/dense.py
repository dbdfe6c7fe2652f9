"""Dense references of a plan: postures at many instants that keep hand and braces on path and surfaces; their heat."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from dynsim.compile.bracing import RAMP, PressingBrace
from dynsim.compile.clearance import gaps
from dynsim.compile.references.inverse_kinematics import pressing
from dynsim.compile.references.splines import clamped_cubic, quintic_rates
from dynsim.dynamics.contact.braces import statics as kb
from dynsim.errors import ModelError
from dynsim.jit.kernel import reals
from dynsim.model.description import Array, Contact
from dynsim.planner.compiled.retract import ON
from dynsim.planner.problem import LIFTING, BraceSchedule, BraceSet, Clear, Task, contact_names
from dynsim.scenario import build

# Minimum number of instants per pass along the path (at least two per knot), and maximum time between instants [s].
INSTANTS, SPACING = 50, 0.1


@dataclass(frozen=True)
class Dense:
    """References of a plan with their statics.

    Attributes
    ----------
    times : (T,) ndarray
        Times of the waypoints over the whole path [s].
    q : (T, n) ndarray
        Joint positions at the waypoints [rad or m].
    rests : bool
        Whether the references start and end at rest.
    fine : (M,) ndarray
        Times at which the statics are evaluated [s].
    torques : (M, n) ndarray
        Torques of the moving joints [N m, or N if prismatic].
    forces : (M, c) ndarray
        Normal forces of the braces [N].
    heat : float
        Mean heat of all motors [W].
    peak_torque : float or None
        Maximum torque of revolute joints [N m]; None without such joints.
    peak_force : float or None
        Maximum force of prismatic joints [N]; None without such joints.
    schedule : BraceSchedule
        Braces of each phase.
    """

    times: Array
    q: Array
    rests: bool
    fine: Array
    torques: Array
    forces: Array
    heat: float
    peak_torque: float | None
    peak_force: float | None
    schedule: BraceSchedule

    def acting(self, t: int) -> NDArray[np.int64]:
        """Return the indices of the braces that may press at waypoint ``t``."""
        forces = self.forces[self.sample(t)]
        return np.flatnonzero(forces > 0.0) if self.schedule.borders else np.arange(len(forces))

    def sample(self, t: int) -> int:
        """Return the index of the statics at waypoint ``t``."""
        return min(round(self.times[t] / self.fine[1]), len(self.fine) - 1)


def references(task: Task, braces: BraceSet | BraceSchedule, knots: Array, Q: Array, factor: int = 1) -> Dense | str:
    """Compute dense references through postures at knots.

    The references are a spline through the knots that is projected onto path and surfaces at every instant. Their heat
    is computed with :func:`dynsim.compile.references.inverse_kinematics.pressing`, including accelerations and losses,
    and with the full friction of a creeping brace.

    Parameters
    ----------
    task : Task
        Planning problem.
    braces : tuple of Candidate or BraceSchedule
        Braces of the plan.
    knots : (K,) ndarray
        Times of the knots [s].
    Q : (K, n) ndarray
        Postures at the knots [rad or m].
    factor : int, optional
        Factor by which the number of instants is multiplied.

    Returns
    -------
    Dense or str
        References with their statics, or the reason why they do not exist.
    """
    span, schedule = task.span, BraceSchedule.of(braces)
    count = factor * max(INSTANTS, int(np.ceil(span / SPACING)), 2 * (len(knots) - 1))
    half = np.linspace(0.0, span, count + 1)
    if task.kind == "closed":
        spline = CubicSpline(np.append(knots, span), np.vstack([Q, Q[:1]]), bc_type="periodic")
    elif task.rests or task.kind == "there_and_back":
        spline = CubicSpline(knots, Q, bc_type="clamped")
    else:
        spline = CubicSpline(knots, Q, bc_type="not-a-knot")
    q = reals(spline(half))
    single = task.problem(schedule, 1)
    idle, near = np.maximum(task.idle_times(schedule, half) - RAMP, 0.0), LIFTING * span
    for k, target in enumerate(task.hand_targets(half)):
        single.course.target[0] = target
        row = q[k : k + 1]
        if idle[k].any():
            # Braces rise and land without jumps of their position and velocity.
            rise, clearance = np.minimum(idle[k] / near, 1.0), task.options.clearance_m
            single.evaluate(row, np.zeros((1, len(rise))))
            top = np.maximum(single.work.gap[0, : len(rise)], clearance)
            single.course.apart[0] = rise**2 * (3.0 - 2.0 * rise) * top
            single.course.apart[0, rise == 1.0] = clearance
        single.course.guided[0] = idle[k] < near
        if (left := single.retract(row, 20, 0.1 * ON)) > ON:
            return (
                f"at t = {half[k]:.3g} s, between two knots, hand and braces cannot be kept on path and surfaces "
                f"(residual {left:.2g} m)"
            )
    times = half
    if task.kind == "there_and_back":
        times, q = np.append(half, span + half[1:]), np.vstack([q, q[-2::-1]])
    return statics(task, schedule, times, q, task.rests)


def contacts(task: Task, braces: BraceSet) -> Mapping[str, Contact]:
    """Return the braces as named contacts."""
    surfaces = build.surfaces(task.scenario)
    return {
        name: Contact(
            name, b.body, np.array(b.point_m), surfaces[b.surface], b.surface, friction=task.friction, radius=b.radius
        )
        for name, b in zip(contact_names(braces), braces, strict=True)
    }


def statics(task: Task, schedule: BraceSchedule, times: Array, q: Array, rests: bool) -> Dense | str:
    """Compute the statics of references; see :func:`references`."""
    arm, model = task.arm, task.arm.model
    spacing = getattr(task.scenario.controller, "knot_spacing_s", 0.02)
    fine = np.linspace(0.0, task.duration, max(int(np.ceil(task.duration / spacing)), 6) + 1)
    whole = arm.coordinates(clamped_cubic(times, q, fine, rests))
    if model.nq != model.n:
        rates, accelerations = np.zeros((2, len(fine), model.n))
        rates[:, list(arm.links)], accelerations[:, list(arm.links)] = quintic_rates(
            float(fine[1]), whole[:, list(arm.columns)]
        )
    else:
        rates, accelerations = quintic_rates(float(fine[1]), whole)
    during = [task.intervals(schedule, b) if schedule.borders else None for b in schedule.braces]
    named = contacts(task, schedule.braces).items()
    placed = {name: PressingBrace(contact, None, times) for (name, contact), times in zip(named, during, strict=True)}
    try:
        planner, tables, shares = pressing(model, fine, whole, rates, placed, task.options.min_N)
    except ModelError as error:
        return f"the postures jump between knots: {error}"
    torques, forces, solved = planner.least_heat(whole, rates, accelerations, tables, shares)
    if solved < len(fine):
        return f"at t = {fine[solved]:.3g} s the motion needs forces beyond the friction cones or the motor limits"
    weights = planner.arrays.motors[:, kb.HEAT]
    heat = float(np.trapezoid(torques**2 @ weights, fine) / task.duration)
    moved = torques[:, list(arm.links)]
    peaks = [np.abs(moved[:, arm.tables.prismatic == kind]) for kind in (0, 1)]
    peak_torque, peak_force = (float(peak.max()) if peak.size else None for peak in peaks)
    return Dense(times, q, rests, fine, moved, forces, heat, peak_torque, peak_force, schedule)


def nearest(
    task: Task, braces: BraceSet | BraceSchedule, times: Array, q: Array, shift: Array | None = None
) -> tuple[float, str, float]:
    """Find the smallest distance of an unbraced point from a surface, or of two solids.

    A link that is braced at both ends may rest on the surface. Braces may be close to their surfaces before and after
    their phases.

    Parameters
    ----------
    task : Task
        Planning problem.
    braces : tuple of Candidate or BraceSchedule
        Braces of the plan.
    times : (T,) ndarray
        Times [s].
    q : (T, n) ndarray
        Joint positions [rad or m].
    shift : (3,) ndarray, optional
        Displacement of all surfaces [m].

    Returns
    -------
    distance : float
        Smallest distance [m].
    part : str
        Point and surface, or two bodies; empty if there are no points.
    time : float
        Time [s].
    """
    best = task.nearest_pair(times, q)
    robot, arm = task.arm.model.robot, task.arm
    surfaces = build.surfaces(task.scenario)
    if shift is not None and shift.any():
        surfaces = {name: surface.shifted(shift) for name, surface in surfaces.items()}
    schedule = BraceSchedule.of(braces)
    whole, near = arm.coordinates(q), LIFTING * task.span + RAMP
    points = list(task.free(schedule.braces).values())
    for phase, (index, name) in product(task.phases(schedule), enumerate(arm.surfaces)):
        leaning = {(b.joint, arm.surfaces.index(b.surface)) for b in phase.braces}
        during = np.flatnonzero((times >= phase.start) & (times <= phase.end))
        free: dict[str, list[tuple[Clear, Array]]] = {}
        for point in points:
            children = [(k, index) for k in range(arm.n) if arm.tables.parent[k] == point.joint]
            on_link = np.any(point.point) and (point.joint, index) in leaning and leaning.intersection(children)
            if point.surface == index and not on_link:
                free.setdefault(robot.links[arm.links[point.joint]].name, []).append((point, np.zeros(len(during))))
        for b in schedule.braces:
            if b.surface == name and b not in phase.braces:
                lifting = [(times >= t - near) & (times <= u + near) for t, u in task.intervals(schedule, b)]
                ignored = np.where(np.any(lifting, axis=0), np.inf, 0.0)[during]
                lifted = Clear(b.joint, b.on_joint, b.radius, 0.0, b.label, index)
                free.setdefault(robot.links[arm.links[b.joint]].name, []).append((lifted, ignored))
        targets = {body: [(surfaces[name], point.point) for point, _ in points] for body, points in free.items()}
        for link, distances in gaps(robot, whole[during], targets):
            for (point, ignored), distance in zip(free[link.name], distances, strict=True):
                k = int(np.argmin(distance + ignored))
                if distance[k] + ignored[k] - point.radius < best[0]:
                    best = (float(distance[k] - point.radius), point.label, float(times[during[k]]))
    return best
