"""References of a plan: postures at many instants, exactly on hand path and surfaces, and what they cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from dynsim.compile.clearance import axis_ends, gaps
from dynsim.compile.references.feed_forward import pressing
from dynsim.compile.splines import clamped_cubic, quintic_rates
from dynsim.dynamics.contact.braces import tables as kb
from dynsim.errors import ModelError
from dynsim.jit.kernel import reals
from dynsim.model.description import Array, Contact
from dynsim.planner.compiled import ON
from dynsim.planner.problem import Candidate, Task
from dynsim.scenario import build

# Instants of one pass along the path, at least; and the most time between two [s].
INSTANTS, SPACING = 50, 0.1
# Slower than this the hand rests [m/s].
RESTS = 1e-2
# Slip [m/s] over which the friction that is charged grows to its value: a brace that creeps feels all of it, whatever
# planned voltages, which must not ring, make of it.
CHARGED = 1e-3
# Instants at which links are compared with each other.
LOOKS = 11


@dataclass(frozen=True)
class Dense:
    """A plan's references and their statics.

    Attributes
    ----------
    times : (T,) of the waypoints, over the whole path [s]; q: (T, n) [rad or m]
    rests : whether the references begin and end at rest
    fine : (M,) times at which the statics hold [s]
    torques : (M, n) of the moved joints [N m]; forces: (M, c) normal ones [N]
    heat : mean of all motors [W]; peak: greatest torque [N m]
    clearance : least distance of what is not braced from a surface [m], what, and when [s]
    """

    times: Array
    q: Array
    rests: bool
    fine: Array
    torques: Array
    forces: Array
    heat: float
    peak: float
    clearance: tuple[float, str, float]


def references(task: Task, braces: tuple[Candidate, ...], knots: Array, Q: Array, factor: int = 1) -> Dense | str:
    """Dense references through postures at knots, (K, n); in words why there are none.

    A spline through the knots, every instant put back onto path and surfaces. The heat is that of
    :func:`dynsim.compile.references.feed_forward.pressing` along them, accelerations and losses included, with all of
    the friction that a creeping brace feels. ``factor`` : so many times as many instants
    """
    span = task.span
    count = factor * max(INSTANTS, int(np.ceil(span / SPACING)))
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
        planner, tables = pressing(model, fine, whole, rates, placed, task.options.min_N, CHARGED)
    except ModelError as error:
        return f"between knots the postures jump: {error}"
    torques, forces = np.zeros((len(fine), model.n)), np.zeros((len(fine), len(braces)))
    for t in range(len(fine)):
        row = slice(t, t + 1)
        torques[row], solved = planner.torques(whole[row], rates[row], accelerations[row], tables[row])
        if solved < 1:
            return f"at t = {fine[t]:.3g} s no forces within friction cones and limits of the motors carry the motion"
        forces[t] = planner.arrays.found[:, kb.FORCES]
    weights = planner.arrays.motors[:, kb.HEAT]
    heat = float(np.trapezoid(torques**2 @ weights, fine) / task.duration)
    moved = torques[:, list(arm.links)]
    clear = nearest(task, braces, fine, whole[:, list(arm.columns)])
    return Dense(times, q, rests, fine, moved, forces, heat, float(np.abs(moved).max()), clear)


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
    held = {(b.joint, b.surface) for b in braces}
    whole = arm.coordinates(q)
    for name in arm.surfaces:
        index = arm.surfaces.index(name)
        rows: dict[str, list[tuple[float, str, Array]]] = {}
        for joint, point, radius, _, label, surface in task.clear:
            if surface != index or any(
                b.joint == joint and b.surface == name and np.allclose(b.on_joint, point) for b in braces
            ):
                continue
            children = [k for k in range(arm.n) if arm.tables.parent[k] == joint]
            if np.any(point) and (joint, name) in held and any((k, name) in held for k in children):
                continue
            rows.setdefault(robot.links[arm.links[joint]].name, []).append((radius, label, point))
        found = gaps(robot, whole, {body: [(surfaces[name], p) for *_, p in held_] for body, held_ in rows.items()})
        for link, distances in found:
            for (radius, label, _), distance in zip(rows[link.name], distances, strict=True):
                k = int(np.argmin(distance))
                if distance[k] - radius < best[0]:
                    best = (float(distance[k] - radius), label, float(times[k]))
    return best


def touching_links(task: Task, times: Array, q: Array) -> str:
    """In words which links that are no neighbours would touch each other, and when; empty: none.

    At some instants of the first pass.
    """
    chosen = np.unique(np.linspace(0, np.searchsorted(times, task.span), LOOKS).astype(int))
    times, q = times[chosen], q[chosen]
    arm = task.arm
    robot, ends = arm.model.robot, axis_ends(arm.model.robot)
    segments = [
        (k, end, robot.links[i].radius)
        for k, i in enumerate(arm.links)
        for end in ends[robot.links[i].name]
        if np.linalg.norm(end) > 1e-9
    ]
    if len(segments) < 3:
        return ""
    parent = arm.tables.parent
    for t, row in zip(times, arm.coordinates(q), strict=True):
        lines = []
        for k, end, radius in segments:
            R, p = arm.model.body_pose(arm.links[k], row)
            lines.append((k, p, p + R @ end, radius))
        for a, (k, p, pe, r) in enumerate(lines):
            for j, s, se, rs in lines[a + 1 :]:
                # Neighbours share a joint, and those over a link without length do.
                near = min(np.linalg.norm(x - y) for x in (p, pe) for y in (s, se)) < 1e-9
                if near or parent[j] == k or parent[k] == j:
                    continue
                if _segment_distance(p, pe, s, se) < r + rs:
                    names = robot.links[arm.links[k]].name, robot.links[arm.links[j]].name
                    return f"{names[0]} and {names[1]} would touch each other at t = {t:.3g} s"
    return ""


def _segment_distance(a: Array, b: Array, c: Array, d: Array) -> float:
    """Of two segments a–b and c–d [m] (Ericson, Real-Time Collision Detection, 5.1.9)."""
    u, v, w = b - a, d - c, a - c
    A, e, f, g, h = (float(x @ y) for x, y in ((u, u), (v, v), (v, w), (u, w), (u, v)))
    den = A * e - h * h
    s = min(max((h * f - g * e) / den, 0.0), 1.0) if den > 1e-12 * A * e else 0.0
    t = (h * s + f) / e
    if t < 0.0:
        t, s = 0.0, min(max(-g / A, 0.0), 1.0)
    elif t > 1.0:
        t, s = 1.0, min(max((h - g) / A, 0.0), 1.0)
    return float(np.linalg.norm(a + s * u - c - t * v))
