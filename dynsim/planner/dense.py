"""Dense references of a plan: postures at many instants that keep hand and braces on path and surfaces; their heat."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from dynsim.compile.clearance import gaps
from dynsim.compile.references.inverse_kinematics import pressing
from dynsim.compile.references.splines import clamped_cubic, quintic_rates
from dynsim.dynamics.contact.braces import statics as kb
from dynsim.errors import ModelError
from dynsim.jit.kernel import reals
from dynsim.model.description import Array, Contact
from dynsim.planner.arm import axis_lines, axis_points
from dynsim.planner.compiled import ON
from dynsim.planner.problem import FINAL_SLIP_SCALE, Candidate, Clear, Task, key
from dynsim.scenario import build

# Minimum number of instants per pass along the path (at least two per knot), and maximum time between instants [s].
INSTANTS, SPACING = 50, 0.1
# Hand speed below which the hand counts as at rest [m/s].
REST_SPEED = 1e-2
# Number of instants at which links are checked for contact with each other.
CHECKS = 11


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


def references(task: Task, braces: tuple[Candidate, ...], knots: Array, Q: Array, factor: int = 1) -> Dense | str:
    """Compute dense references through postures at knots.

    The references are a spline through the knots that is projected onto path and surfaces at every instant. Their heat
    is computed with :func:`dynsim.compile.references.inverse_kinematics.pressing`, including accelerations and losses,
    and with the full friction of a creeping brace.

    Parameters
    ----------
    task : Task
        Planning problem.
    braces : tuple of Candidate
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
    span = task.span
    count = factor * max(INSTANTS, int(np.ceil(span / SPACING)), 2 * (len(knots) - 1))
    half = np.linspace(0.0, span, count + 1)
    start, end = (np.linalg.norm(np.diff(task.targets(np.array(pair)), axis=0)) for pair in _ends(task.duration))
    rests = bool(max(start, end) / 1e-4 < REST_SPEED)
    if task.kind == "closed":
        spline = CubicSpline(np.append(knots, span), np.vstack([Q, Q[:1]]), bc_type="periodic")
    elif rests or task.kind == "there_and_back":
        spline = CubicSpline(knots, Q, bc_type="clamped")
    else:
        spline = CubicSpline(knots, Q, bc_type="not-a-knot")
    q = reals(spline(half))
    single = task.problem(braces, 1)
    for k, target in enumerate(task.hand_targets(half)):
        single.course.target[0] = target
        row = q[k : k + 1]
        if (left := single.retract(row, 20, 0.1 * ON)) > ON:
            return (
                f"at t = {half[k]:.3g} s, between two knots, hand and braces cannot be kept on path and surfaces "
                f"(residual {left:.2g} m)"
            )
    times = half
    if task.kind == "there_and_back":
        times, q = np.append(half, span + half[1:]), np.vstack([q, q[-2::-1]])
    return statics(task, braces, times, q, rests)


def _ends(duration: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the first and last 0.1 ms of a path [s]."""
    return (0.0, 1e-4), (duration - 1e-4, duration)


def contacts(task: Task, braces: tuple[Candidate, ...]) -> Mapping[str, Contact]:
    """Return the braces as named contacts."""
    surfaces = build.surfaces(task.scenario)
    return {
        b.name: Contact(
            b.name, b.body, np.array(b.point_m), surfaces[b.surface], b.surface, friction=task.friction, radius=b.radius
        )
        for b in braces
    }


def statics(task: Task, braces: tuple[Candidate, ...], times: Array, q: Array, rests: bool) -> Dense | str:
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
    placed: dict[str, tuple[Contact, float | None]] = {
        name: (contact, None) for name, contact in contacts(task, braces).items()
    }
    try:
        planner, tables = pressing(model, fine, whole, rates, placed, task.options.min_N, FINAL_SLIP_SCALE)
    except ModelError as error:
        return f"the postures jump between knots: {error}"
    torques, forces, solved = planner.least_heat(whole, rates, accelerations, tables)
    if solved < len(fine):
        return f"at t = {fine[solved]:.3g} s the motion needs forces beyond the friction cones or the motor limits"
    weights = planner.arrays.motors[:, kb.HEAT]
    heat = float(np.trapezoid(torques**2 @ weights, fine) / task.duration)
    moved = torques[:, list(arm.links)]
    peaks = [np.abs(moved[:, arm.tables.prismatic == kind]) for kind in (0, 1)]
    peak_torque, peak_force = (float(peak.max()) if peak.size else None for peak in peaks)
    return Dense(times, q, rests, fine, moved, forces, heat, peak_torque, peak_force)


def nearest(
    task: Task, braces: tuple[Candidate, ...], times: Array, q: Array, shift: Array | None = None
) -> tuple[float, str, float]:
    """Find the smallest distance of an unbraced point from a surface, or of two solids.

    A link that is braced at both ends may rest on the surface.

    Parameters
    ----------
    task : Task
        Planning problem.
    braces : tuple of Candidate
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
    braced = {key(b.joint, arm.surfaces.index(b.surface), b.on_joint) for b in braces}
    leaning = {(joint, surface) for joint, surface, _ in braced}
    whole = arm.coordinates(q)
    for index, name in enumerate(arm.surfaces):
        free: dict[str, list[Clear]] = {}
        for point in task.free(braces).values():
            children = [(k, index) for k in range(arm.n) if arm.tables.parent[k] == point.joint]
            on_link = np.any(point.point) and (point.joint, index) in leaning and leaning.intersection(children)
            if point.surface == index and not on_link:
                free.setdefault(robot.links[arm.links[point.joint]].name, []).append(point)
        targets = {body: [(surfaces[name], point.point) for point in points] for body, points in free.items()}
        for link, distances in gaps(robot, whole, targets):
            for point, distance in zip(free[link.name], distances, strict=True):
                k = int(np.argmin(distance))
                if distance[k] - point.radius < best[0]:
                    best = (float(distance[k] - point.radius), point.label, float(times[k]))
    return best


def touching_links(task: Task, times: Array, q: Array) -> str:
    """Check whether pairs of solids touch each other; without pairs of links, whether links that are not neighbours do.

    The latter is checked at some instants of the first pass. Returns a text with the links and the time; empty if no
    links touch.
    """
    distance, bodies, time = task.nearest_pair(times, q)
    if distance < 0.0:
        return f"{bodies} touch each other at t = {time:.3g} s"
    if task.self_contact:
        return ""
    chosen = np.unique(np.linspace(0, np.searchsorted(times, task.span), CHECKS).astype(int))
    arm, links = task.arm, task.arm.model.robot.links
    segments = axis_points(arm, (1.0,))
    if len(segments) < 3:
        return ""
    lines = np.array([axis_lines(arm, row) for row in q[chosen]])
    a, b = np.triu_indices(len(segments), 1)
    first, second = lines[:, a], lines[:, b]
    # Neighbours share a joint, possibly across a link of zero length.
    apart = np.linalg.norm(first[:, :, :, None] - second[:, :, None], axis=-1).min(axis=(0, 2, 3)) > 1e-9
    joints, radii = (np.array([segment[i] for segment in segments]) for i in (0, 2))
    parents = arm.tables.parent[joints]
    apart &= (parents[b] != joints[a]) & (parents[a] != joints[b])
    touching = apart & (_segment_distances(first, second) < radii[a] + radii[b])
    if not touching.any():
        return ""
    t = int(touching.any(axis=1).argmax())
    pair = int(touching[t].argmax())
    names = [links[arm.links[joints[side[pair]]]].name for side in (a, b)]
    return f"{names[0]} and {names[1]} touch each other at t = {times[chosen[t]]:.3g} s"


def _segment_distances(first: Array, second: Array) -> Array:
    """Return the distances [m] between pairs of segments, (…, 2, 3) (Ericson, Real-Time Collision Detection, 5.1.9)."""
    u, v, w = (
        first[..., 1, :] - first[..., 0, :],
        second[..., 1, :] - second[..., 0, :],
        first[..., 0, :] - second[..., 0, :],
    )
    A, e, f, g, h = (np.sum(x * y, axis=-1) for x, y in ((u, u), (v, v), (v, w), (u, w), (u, v)))
    den = A * e - h * h
    oblique = den > 1e-12 * A * e
    s = np.where(oblique, np.clip((h * f - g * e) / np.where(oblique, den, 1.0), 0.0, 1.0), 0.0)
    t = (h * s + f) / e
    s = np.where(t < 0.0, np.clip(-g / A, 0.0, 1.0), np.where(t > 1.0, np.clip((h - g) / A, 0.0, 1.0), s))
    return np.asarray(np.linalg.norm(w + u * s[..., None] - v * np.clip(t, 0.0, 1.0)[..., None], axis=-1))
