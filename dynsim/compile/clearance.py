"""Body poses, distances of points and link axes from surfaces, and sunken bodies, at sampled joint positions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.model.description import Array, Link, Quadric, Robot
from dynsim.model.surfaces import Surface

# Depth in addition to its radius up to which a body does not count as sunken [m]; equals the contact start tolerance.
SLACK = 1e-6
# Number of segments into which an axis is divided to compute its depth in a box or a height field.
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


def poses(robot: Robot, q: Array) -> Iterator[tuple[Link, Array, Array]]:
    """Yield each body with R_WB, (3, 3, T), and p_WB, (3, T) [m], at joint positions q, (T, nq).

    The computation is vectorized over the samples, which are contiguous in memory: thousands of samples take a
    millisecond.
    """
    q = np.ascontiguousarray(q.T)
    last_child = {link.parent: link.name for link in robot.links}
    world = np.repeat(np.eye(3)[..., None], q.shape[1], axis=-1), np.zeros((3, q.shape[1]))
    known: dict[str | None, tuple[Array, Array]] = {None: world}
    for k, link in zip(robot.position_index, robot.links, strict=True):
        R_WP, p_WP = known[link.parent]
        # A product from the right is the transposed matrix from the left on the middle axis.
        R, p = link.R_PJ.T @ R_WP, p_WP + link.p_PJ @ R_WP
        if (row := link.row).motion is not None:  # only the first row of a joint moves the body
            turn, shift = row.motion(link, q[k : k + len(row.neutral)])
            if shift.any():
                p = p + np.einsum("ijt,jt->it", R, shift)
            R = np.einsum("ijt,jkt->ikt", R, turn)
        if last_child[link.parent] == link.name:
            del known[link.parent]
        if link.name in last_child:
            known[link.name] = R, p
        yield link, R, p


def axis_ends(robot: Robot) -> dict[str, list[Array]]:
    """Return the end points of the axes of each link, (3,) in its frame [m]; the axes start at the link's joint.

    If :attr:`Link.tip` is set, it is the only end point. Otherwise the end points are the joints that the link carries
    and the hand.
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

    ``points`` contains surface and point, (3,) in the body's frame [m], for each body.
    """
    needed = {*points, *(surface.carrier for own in points.values() for surface, _ in own)}
    placed = {link.name: (link, R, p) for link, R, p in poses(robot, q) if link.name in needed}
    for body, own in points.items():
        link, R, p = placed[body]
        distances = []
        for surface, point in own:
            at = p + point @ R
            if surface.carrier is not None:
                _, turn, origin = placed[surface.carrier]
                at = np.einsum("abt,at->bt", turn, at - origin)
            distances.append(surface.gaps(at.T))
        yield link, distances


def sinking(robot: Robot, surfaces: Mapping[str, Surface], q: Array) -> list[Sinking]:
    """Return the bodies whose axes are below a surface by more than their radius, at samples q, (T, nq).

    The axes are defined by :func:`axis_ends`. A body whose radius is unknown is treated as if its radius were zero.
    """
    sunk: list[Sinking] = []
    if not surfaces or not len(q) or _is_above(robot, surfaces, q):
        return sunk
    # The last samples of a diverged run may overflow when squared.
    with np.errstate(over="ignore", invalid="ignore"):
        for link, name, gap in axis_gaps(robot, surfaces, q):
            if gap.min() >= -link.radius - SLACK:
                continue
            depth = np.where(np.isfinite(gap), -gap, -np.inf)
            beyond = np.flatnonzero(depth > link.radius + SLACK)
            if beyond.size:
                sunk.append(Sinking(link.name, name, float(depth.max()), link.radius, int(beyond[0])))
    return sunk


def _is_above(robot: Robot, surfaces: Mapping[str, Surface], q: Array) -> bool:
    """Return whether no body is sunk, from heights in single precision, which take a quarter of the time of the poses.

    Only hinges and sliders above planes are examined; otherwise, or within the rounding error, the result is False.
    """
    planes = [s for s in surfaces.values() if isinstance(s, Quadric) and not s.Q.any() and s.carrier is None]
    if len(planes) < len(surfaces) or not {link.kind for link in robot.links} <= {"revolute", "prismatic"}:
        return False
    tips, rounded = axis_ends(robot), np.ascontiguousarray(q.T, dtype=np.float32)
    spread = float(np.abs(q).sum(axis=1).max())
    lengths = sum(float(np.linalg.norm(p)) for link in robot.links for p in (link.p_PJ, *tips[link.name]))
    for plane in planes:
        size = float(np.linalg.norm(plane.b))
        # A joint rounds its angle, and about twenty times the normal; all heights are at most the sum of the lengths.
        error = float(np.finfo(np.float32).eps) * (20.0 * len(robot.links) + spread)
        error *= abs(plane.c) / size + lengths + spread
        # Normal of the plane in the axes of a body, (3, T), and height of its joint above the plane, (T,).
        known: dict[str | None, Any] = {None: (_single(plane.b[:, None] / size), np.float32(plane.c / size))}
        for k, link in zip(robot.position_index, robot.links, strict=True):
            normal, height = known[link.parent]
            height, normal = height + _single(link.p_PJ) @ normal, _single(link.R_PJ.T) @ normal
            if link.kind == "prismatic":
                height = height + rounded[k] * (_single(link.axis) @ normal)
            else:  # Rodrigues' formula
                x, y, z = link.axis
                across = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]], dtype=np.float32)
                turned = across @ normal
                normal = (
                    normal + np.sin(rounded[k]) * turned + (np.float32(1.0) - np.cos(rounded[k])) * (across @ turned)
                )
            known[link.name] = normal, height
            lowest = min(
                float((height + end).min()) for end in (0, *(_single(tip) @ normal for tip in tips[link.name]))
            )
            if not lowest > error - link.radius - SLACK:
                return False
    return True


def _single(values: Array) -> NDArray[np.float32]:
    return values.astype(np.float32)


def by_surface(sunk: Sequence[Sinking]) -> dict[str, list[Sinking]]:
    """Return the sunken bodies grouped by surface."""
    return {surface: [s for s in sunk if s.surface == surface] for surface in dict.fromkeys(s.surface for s in sunk)}


def axis_gaps(robot: Robot, surfaces: Mapping[str, Surface], q: Array) -> Iterator[tuple[Link, str, Array]]:
    """Yield the minimum distance of each body's axes from each surface of the world, (T,) [m]."""
    surfaces = {name: surface for name, surface in surfaces.items() if surface.carrier is None}
    tips, carriers = axis_ends(robot), robot.carriers
    for link, R, p in poses(robot, q):
        for name, surface in surfaces.items() if link.name not in carriers else ():
            gap = surface.gaps(p.T)
            for tip in tips[link.name]:
                gap = np.minimum(gap, _segment_gap(surface, p.T, (tip @ R).T))
            yield link, name, gap


def _segment_gap(surface: Surface, start: Array, along: Array) -> Array:
    """Return the minimum signed distance of the segments from ``start`` to ``start + along``, (T, 3).

    The start points are not examined. The result is exact for planes, spheres and cylinders, because their distance
    increases with C, and C is a parabola along a line. For other surfaces, the result is the minimum over some points
    on the segments.
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
