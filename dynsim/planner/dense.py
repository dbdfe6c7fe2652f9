"""Dense references of a plan: postures at many instants, on hand path and surfaces, with their heat."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from dynsim.compile.clearance import axis_ends, gaps
from dynsim.compile.references.inverse_kinematics import pressing
from dynsim.compile.references.plane_curve import clamped_cubic, quintic_rates
from dynsim.dynamics.contact.braces import statics as kb
from dynsim.errors import ModelError
from dynsim.jit.kernel import reals
from dynsim.model.description import Array, Contact
from dynsim.planner.compiled import ON
from dynsim.planner.problem import FINAL_SLIP_SCALE, Candidate, Clear, Task, key
from dynsim.scenario import build

# Instants of one pass along the path, at least, beside two for each knot; and the most time between two [s].
INSTANTS, SPACING = 50, 0.1
# A hand slower than this is at rest [m/s].
RESTS = 1e-2
# Instants at which links are checked for contact with each other.
LOOKS = 11


@dataclass(frozen=True)
class Dense:
    """A plan's references and their statics.

    Attributes
    ----------
    times : (T,) of the waypoints, over the whole path [s]; q: (T, n) [rad or m]
    rests : whether the references begin and end at rest
    fine : (M,) times at which the statics hold [s]
    torques : (M, n) of the moved joints [N m; N of prismatic ones]; forces: (M, c) normal ones [N]
    heat : mean of all motors [W]
    peak_torque, peak_force : greatest of revolute joints [N m], and of prismatic ones [N]; None without such joints
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
    """Dense references through postures at knots, (K, n); in words why there are none.

    A spline through the knots, every instant put back onto path and surfaces. The heat is that of
    :func:`dynsim.compile.references.inverse_kinematics.pressing` along them, accelerations and losses included, with
    all of the friction that a creeping brace feels. ``factor`` : so many times as many instants
    """
    span = task.span
    count = factor * max(INSTANTS, int(np.ceil(span / SPACING)), 2 * (len(knots) - 1))
    half = np.linspace(0.0, span, count + 1)
    start, end = (np.linalg.norm(np.diff(task.targets(np.array(pair)), axis=0)) for pair in _ends(task.duration))
    rests = bool(max(start, end) / 1e-4 < RESTS)
    if task.kind == "closed":
        spline = CubicSpline(np.append(knots, span), np.vstack([Q, Q[:1]]), bc_type="periodic")
    elif rests or task.kind == "there_and_back":
        spline = CubicSpline(knots, Q, bc_type="clamped")
    else:
        spline = CubicSpline(knots, Q, bc_type="not-a-knot")
    q = reals(spline(half))
    single = task.problem(braces, 1)
    for k, target in enumerate(task.wanted(half)):
        single.course.target[0] = target
        row = q[k : k + 1]
        if (left := single.retract(row, 20, 0.1 * ON)) > ON:
            return f"between knots, at t = {half[k]:.3g} s, no posture near by keeps hand and braces ({left:.2g} m off)"
    times = half
    if task.kind == "there_and_back":
        times, q = np.append(half, span + half[1:]), np.vstack([q, q[-2::-1]])
    return statics(task, braces, times, q, rests)


def _ends(duration: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """The first and the last tenth of a millisecond of a path."""
    return (0.0, 1e-4), (duration - 1e-4, duration)


def contacts(task: Task, braces: tuple[Candidate, ...]) -> Mapping[str, Contact]:
    """Braces as contacts, by name."""
    surfaces = build.surfaces(task.scenario)
    return {
        b.name: Contact(
            b.name, b.body, np.array(b.point_m), surfaces[b.surface], b.surface, friction=task.friction, radius=b.radius
        )
        for b in braces
    }


def statics(task: Task, braces: tuple[Candidate, ...], times: Array, q: Array, rests: bool) -> Dense | str:
    """What references cost, see :func:`references`."""
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
        return f"between knots the postures jump: {error}"
    torques, forces, solved = planner.least_heat(whole, rates, accelerations, tables)
    if solved < len(fine):
        return f"at t = {fine[solved]:.3g} s no forces within friction cones and limits of the motors carry the motion"
    weights = planner.arrays.motors[:, kb.HEAT]
    heat = float(np.trapezoid(torques**2 @ weights, fine) / task.duration)
    moved = torques[:, list(arm.links)]
    peaks = [np.abs(moved[:, arm.tables.prismatic == kind]) for kind in (0, 1)]
    peak_torque, peak_force = (float(peak.max()) if peak.size else None for peak in peaks)
    return Dense(times, q, rests, fine, moved, forces, heat, peak_torque, peak_force)


def nearest(
    task: Task, braces: tuple[Candidate, ...], times: Array, q: Array, shift: Array | None = None
) -> tuple[float, str, float]:
    """Least distance from a surface of what is not braced, over what it may be: (distance [m], what, when [s]).

    Links both of whose ends are braced may lie on the surface. ``shift`` : of all surfaces, (3,) [m]
    """
    best = (np.inf, "", 0.0)
    robot, arm = task.arm.model.robot, task.arm
    surfaces = build.surfaces(task.scenario)
    if shift is not None and shift.any():
        surfaces = {name: surface.shifted(shift) for name, surface in surfaces.items()}
    braced = {key(b.joint, arm.surfaces.index(b.surface), b.on_joint) for b in braces}
    leaning = {(joint, surface) for joint, surface, _ in braced}
    whole = arm.coordinates(q)
    for index, name in enumerate(arm.surfaces):
        free: dict[str, list[Clear]] = {}
        for at, point in task.clear.items():
            children = [(k, index) for k in range(arm.n) if arm.tables.parent[k] == point.joint]
            on_link = np.any(point.point) and (point.joint, index) in leaning and leaning.intersection(children)
            if point.surface == index and at not in braced and not on_link:
                free.setdefault(robot.links[arm.links[point.joint]].name, []).append(point)
        targets = {body: [(surfaces[name], point.point) for point in points] for body, points in free.items()}
        for link, distances in gaps(robot, whole, targets):
            for point, distance in zip(free[link.name], distances, strict=True):
                k = int(np.argmin(distance))
                if distance[k] - point.radius < best[0]:
                    best = (float(distance[k] - point.radius), point.label, float(times[k]))
    return best


def touching_links(task: Task, times: Array, q: Array) -> str:
    """In words which links that are no neighbours would touch each other, and when; empty: none.

    At some instants of the first pass.
    """
    chosen = np.unique(np.linspace(0, np.searchsorted(times, task.span), LOOKS).astype(int))
    arm, links = task.arm, task.arm.model.robot.links
    ends = axis_ends(arm.model.robot)
    segments = [(k, end) for k, i in enumerate(arm.links) for end in ends[links[i].name] if np.linalg.norm(end) > 1e-9]
    if len(segments) < 3:
        return ""
    lines = np.zeros((len(chosen), len(segments), 2, 3))
    for t, row in enumerate(arm.coordinates(q[chosen])):
        for m, (k, end) in enumerate(segments):
            R, p = arm.model.body_pose(arm.links[k], row)
            lines[t, m] = p, p + R @ end
    a, b = np.triu_indices(len(segments), 1)
    first, second = lines[:, a], lines[:, b]
    # Neighbours share a joint, and those over a link without length do.
    apart = np.linalg.norm(first[:, :, :, None] - second[:, :, None], axis=-1).min(axis=(0, 2, 3)) > 1e-9
    joints = np.array([k for k, _ in segments])
    parents = arm.tables.parent[joints]
    apart &= (parents[b] != joints[a]) & (parents[a] != joints[b])
    radii = np.array([links[arm.links[k]].radius for k in joints])
    touching = apart & (_segment_distances(first, second) < radii[a] + radii[b])
    if not touching.any():
        return ""
    t = int(touching.any(axis=1).argmax())
    pair = int(touching[t].argmax())
    names = [links[arm.links[joints[side[pair]]]].name for side in (a, b)]
    return f"{names[0]} and {names[1]} would touch each other at t = {times[chosen[t]]:.3g} s"


def _segment_distances(first: Array, second: Array) -> Array:
    """Of pairs of segments, (…, 2, 3), [m], (…) (Ericson, Real-Time Collision Detection, 5.1.9)."""
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
