"""Body poses, distances of points and link axes from surfaces, and sinking, at samples of joint positions."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import TypeGuard

import numpy as np

from dynsim.model.description import Array, Link, Quadric, Robot
from dynsim.model.surfaces import Surface

# Depth beyond its radius at which a body does not yet count as sinking [m]: the tolerance of contacts at the start.
SLACK = 1e-6
# Parts into which an axis is divided to find its depth in a box or a height field.
POINTS = 16


@dataclass(frozen=True)
class Sinking:
    """A body whose axis lay below a surface by more than its radius.

    Attributes
    ----------
    depth : largest depth of the axis below the surface, over the samples [m]
    radius : of the body [m]
    sample : index of the first sample at which it lay deeper than its radius
    """

    body: str
    surface: str
    depth: float
    radius: float
    sample: int


def poses(
    robot: Robot, q: Array, bodies: Collection[str] | None = None, directions: Array | None = None
) -> Iterator[tuple[Link, Array, Array]]:
    """R_WB, (3, 3, T), and p_WB, (3, T) [m], of each body in turn at joint positions q, (T, nq).

    Vectorised over the samples, which lie together in memory: thousands of them cost a millisecond. ``bodies``: only
    these and those that carry them. ``directions``, (k, 3) in W: d·R_WB, (k, 3, T), and d·p_WB, (k, T), instead.
    """
    view = np.eye(3) if directions is None else directions
    q = np.ascontiguousarray(q.T)
    links = {link.name: link for link in robot.links}
    wanted = set(links if bodies is None else bodies)
    for link in reversed(robot.links):
        if link.name in wanted and link.parent is not None:
            wanted.add(link.parent)
    waiting = dict.fromkeys(wanted, 0)
    for name in wanted:
        if (parent := links[name].parent) is not None:
            waiting[parent] += 1
    count = q.shape[1]
    known: dict[str, tuple[Array, Array]] = {}
    index = robot.position_index
    for i, link in enumerate(robot.links):
        if link.name not in wanted:
            continue
        if link.parent is None:
            R, p = (np.repeat((view @ part)[..., None], count, axis=-1) for part in (link.R_PJ, link.p_PJ))
        else:
            R_WP, p_WP = known[link.parent]
            R, p = link.R_PJ.T @ R_WP, p_WP + link.p_PJ @ R_WP
            waiting[link.parent] -= 1
            if not waiting[link.parent]:
                del known[link.parent]
        k, row = index[i], link.row
        if link.kind == "prismatic":
            p = p + q[k] * (link.axis @ R)
        elif link.kind != "revolute":
            # Later rows of a joint stay where its first one has put the body.
            if row.motion is not None:
                turn, shift = row.motion(link, q[k : k + len(row.neutral)])
                p = p + np.einsum("ijt,jt->it", R, shift)
                R = np.einsum("ijt,jkt->ikt", R, turn)
        else:
            x, y, z = link.axis
            K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            # R (1 + sin q K + (1 − cos q) K²); a product from the right is K'ᵀ from the left on the middle axis.
            R = R + np.sin(q[k]) * (K.T @ R) + (1.0 - np.cos(q[k])) * ((K @ K).T @ R)
        if waiting[link.name]:
            known[link.name] = R, p
        yield link, R, p


def axis_ends(robot: Robot) -> dict[str, list[Array]]:
    """Of each link the other ends of its axes, (3,) in its frame [m]; they begin at its joint.

    :attr:`Link.tip`; without one the joints that it carries, and the hand.
    """
    tips: dict[str, list[Array]] = {link.name: [] if link.tip is None else [link.tip] for link in robot.links}
    open_ended = {link.name for link in robot.links if link.tip is None}
    for link in robot.links:
        if link.parent in open_ended:
            tips[link.parent].append(link.p_PJ)
    if robot.hand[0] in open_ended:
        tips[robot.hand[0]].append(robot.hand[1])
    return tips


def gaps(
    robot: Robot, q: Array, points: Mapping[str, Sequence[tuple[Surface, Array]]]
) -> Iterator[tuple[Link, list[Array]]]:
    """Signed distances, (T,) [m], of points from surfaces, of each body in turn at joint positions q, (T, nq).

    ``points`` : by body, with the surface of each; (3,) in the body's frame [m]. Of planes alone only what counts
    along their normals is computed, a third.
    """
    surfaces = {id(surface): surface for pairs in points.values() for surface, _ in pairs}
    planes = {key: surface for key, surface in surfaces.items() if is_plane(surface)}
    flat = len(planes) == len(surfaces)
    # Of each plane its place among the normals, and its distance from the origin.
    rows = {key: (k, surface.c / np.linalg.norm(surface.b)) for k, (key, surface) in enumerate(planes.items())}
    normals = np.array([surface.b / np.linalg.norm(surface.b) for surface in planes.values()])
    for link, R, p in poses(robot, q, points, normals if flat else None):
        if link.name not in points:
            continue
        distances = []
        for surface, point in points[link.name]:
            position = p + point @ R if point.any() else p
            if flat:
                k, offset = rows[id(surface)]
                distances.append(position[k] + offset)
            else:
                distances.append(surface.gaps(position.T))
        yield link, distances


def is_plane(surface: Surface) -> TypeGuard[Quadric]:
    """True for a quadric without curvature."""
    return isinstance(surface, Quadric) and not surface.Q.any()


def sinking(robot: Robot, surfaces: Mapping[str, Surface], q: Array) -> list[Sinking]:
    """Bodies whose axes lie below a surface by more than their radius, at samples q, (T, nq).

    The axes of a body are those of :func:`axis_ends`. A body of unknown radius has radius zero.
    """
    sunk: list[Sinking] = []
    if not surfaces or not len(q):
        return sunk
    # Of a run that diverged the last samples may be beyond what squares of floats can hold.
    with np.errstate(over="ignore", invalid="ignore"):
        for link, name, gap in _axis_gaps(robot, surfaces, q):
            if gap.min() >= -link.radius - SLACK:
                continue
            depth = np.where(np.isfinite(gap), -gap, -np.inf)
            beyond = np.flatnonzero(depth > link.radius + SLACK)
            if beyond.size:
                sunk.append(Sinking(link.name, name, float(depth.max()), link.radius, int(beyond[0])))
    return sunk


def by_surface(sunk: Sequence[Sinking]) -> dict[str, list[Sinking]]:
    """Bodies below each surface that has any below it, by its name."""
    return {surface: [s for s in sunk if s.surface == surface] for surface in dict.fromkeys(s.surface for s in sunk)}


def _axis_gaps(robot: Robot, surfaces: Mapping[str, Surface], q: Array) -> Iterator[tuple[Link, str, Array]]:
    """Least distance of each body's axes from each surface, (T,) [m]; at their ends where all surfaces are planes."""
    tips, carriers = axis_ends(robot), robot.carriers
    bodies = [link.name for link in robot.links if link.name not in carriers]
    if all(map(is_plane, surfaces.values())):
        ends = {
            body: [(surface, end) for surface in surfaces.values() for end in (np.zeros(3), *tips[body])]
            for body in bodies
        }
        for link, each in gaps(robot, q, ends):
            count = 1 + len(tips[link.name])
            for k, name in enumerate(surfaces):
                yield link, name, reduce(np.minimum, each[k * count : (k + 1) * count])
        return
    for link, R, p in poses(robot, q, bodies):
        for name, surface in surfaces.items() if link.name in bodies else ():
            gap = surface.gaps(p.T)
            for tip in tips[link.name]:
                gap = np.minimum(gap, _segment_gap(surface, p.T, (tip @ R).T))
            yield link, name, gap


def _segment_gap(surface: Surface, start: Array, along: Array) -> Array:
    """Least signed distance of the lines from ``start`` to ``start + along``, (T, 3), without that of their beginning.

    Exact for plane, sphere and cylinder, whose distance grows with C: along a line C is a parabola. Of other surfaces
    the least of some points on the lines.
    """
    gap = surface.gaps(start + along)
    if not isinstance(surface, Quadric):
        for share in np.arange(1, POINTS) / POINTS:
            gap = np.minimum(gap, surface.gaps(start + share * along))
    elif surface.Q.any():
        slope = np.sum((start @ surface.Q + surface.b) * along, axis=1)
        curvature = np.sum((along @ surface.Q) * along, axis=1)
        bowl = curvature > 0.0
        lowest = np.clip(-slope / np.where(bowl, curvature, 1.0), 0.0, 1.0) * bowl
        gap = np.minimum(gap, surface.gaps(start + lowest[:, None] * along))
    return gap
