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
# Number of parts of an axis for computing its depth in a box or a height field.
POINTS = 16


@dataclass(frozen=True)
class Sinking:
    """A body whose axis was below a surface by more than its radius.

    Attributes
    ----------
    body : str
        Name of the body.
    surface : str
        Name of the surface.
    depth : float
        Largest depth of the axis below the surface over all samples [m].
    radius : float
        Radius of the body [m].
    sample : int
        Index of the first sample with a depth larger than the radius.
    """

    body: str
    surface: str
    depth: float
    radius: float
    sample: int


def poses(
    robot: Robot, q: Array, bodies: Collection[str] | None = None, directions: Array | None = None
) -> Iterator[tuple[Link, Array, Array]]:
    """Yield each body with R_WB, (3, 3, T), and p_WB, (3, T) [m], at joint positions q, (T, nq).

    Vectorized over the samples, which are contiguous in memory: thousands of samples cost a millisecond.

    Parameters
    ----------
    robot : Robot
        Description of the robot.
    q : (T, nq) ndarray
        Joint positions [rad or m].
    bodies : collection of str, optional
        Only these bodies and the bodies that carry them; default: all.
    directions : (k, 3) ndarray, optional
        Directions d in W: yield d·R_WB, (k, 3, T), and d·p_WB, (k, T), instead.
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
            # Only the first row of a joint moves the body.
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
    """Return the end points of the axes of each link, (3,) in its frame [m]; the axes start at its joint.

    The end is :attr:`Link.tip` if it is set, otherwise the joints that the link carries, and the hand.
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
    """Yield each body with the signed distances, (T,) [m], of its points from surfaces, at joint positions q, (T, nq).

    ``points`` contains surface and point, (3,) in the body's frame [m], for each body. If all surfaces are planes, only
    components along their normals are computed, which takes a third of the time.
    """
    surfaces = {id(surface): surface for pairs in points.values() for surface, _ in pairs}
    planes = {key: surface for key, surface in surfaces.items() if is_plane(surface)}
    flat = len(planes) == len(surfaces)
    # Index among the normals, and distance from the origin, for each plane.
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
    """Return True for a quadric without curvature."""
    return isinstance(surface, Quadric) and not surface.Q.any()


def sinking(robot: Robot, surfaces: Mapping[str, Surface], q: Array) -> list[Sinking]:
    """Return the bodies whose axes are below a surface by more than their radius, at samples q, (T, nq).

    The axes are defined by :func:`axis_ends`. A body of unknown radius has radius zero.
    """
    sunk: list[Sinking] = []
    if not surfaces or not len(q):
        return sunk
    # The last samples of a diverged run may overflow when squared.
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
    """Return the sinking bodies for each surface that has any."""
    return {surface: [s for s in sunk if s.surface == surface] for surface in dict.fromkeys(s.surface for s in sunk)}


def _axis_gaps(robot: Robot, surfaces: Mapping[str, Surface], q: Array) -> Iterator[tuple[Link, str, Array]]:
    """Yield the minimum distance of each body's axes from each surface, (T,) [m]; at their ends if all surfaces are
    planes.
    """
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
    """Return the minimum signed distance of the lines from ``start`` to ``start + along``, (T, 3), without the start
    points.

    Exact for plane, sphere and cylinder, whose distance increases with C: along a line C is a parabola. For other
    surfaces, the minimum over some points on the lines.
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
