"""Bodies that touch surfaces from outside (boxes, spheres, cylinders), and the parts of link axes inside them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from dynsim.compile.clearance import axis_ends, poses
from dynsim.compile.shapes import bends_outward
from dynsim.model.description import Array, Contact, Robot
from dynsim.model.surfaces import Box, Quadric, Surface

# Depth up to which an axis does not count as inside a sphere or cylinder, and least depth for a box [m].
SLACK = 1e-4
# Depth of the core of a rounded corner, (1 − 1/√3) edge radii.
CORNER = 1.0 - 3.0**-0.5
# Cosine between the normals where the arm enters a solid and where it touches it; below, it passes through the solid.
THROUGH = -0.5


def tangent_planes(surface: Surface) -> list[Quadric]:
    """Return planes that touch a solid on its sides: six for a box or sphere, four for a cylinder; none for others."""
    if not bends_outward(surface):
        return []
    if isinstance(surface, Box):
        centre, axes, sizes = surface.centre, np.asarray(surface.axes), 0.5 * np.asarray(surface.edges)
    else:
        assert isinstance(surface, Quadric)
        centre, sizes = np.asarray(surface.drawn.position), np.full(3, surface.drawn.radius)
        axes = np.eye(3)
        if surface.drawn.direction is not None:
            axes = np.linalg.svd(np.atleast_2d(surface.drawn.direction))[2][1:]
    sides = [(sign * axis, size) for axis, size in zip(axes, sizes, strict=False) for sign in (1.0, -1.0)]
    return [Quadric(np.zeros((3, 3)), normal, -float(normal @ centre) - size) for normal, size in sides]


def axes_inside(robot: Robot, surface: Surface, q: Array) -> float:
    """Return the length of the link axes inside a solid [m] in one posture, (nq,).

    The part with which a robot is mounted in the solid does not count.
    """
    tips, length = axis_ends(robot), 0.0
    mounted: dict[str | None, bool] = {None: True}
    for link, R, p in poses(robot, q[None]):
        origin = p[:, 0]
        mounted[link.name] = mounted[link.parent] and surface.gap(origin) < 0.0
        for tip in tips[link.name]:
            along = (tip @ R)[:, 0]
            start, end = _inside(surface, origin, along)
            if start > 0.0 or not mounted[link.name]:
                length += (end - start) * float(np.linalg.norm(along))
    return length


def passes_through(robot: Robot, contact: Contact, q: Array) -> bool:
    """Return whether the arm enters the solid of a contact and touches it on the opposite side, in one posture."""
    index, point = robot.attach(contact.body, contact.point)
    placed = {link.name: (R[..., 0], p[:, 0]) for link, R, p in poses(robot, q[None])}
    link = robot.links[index]
    R, p = placed[link.name]
    points = [p + point @ R, p]
    parents = {link.name: link.parent for link in robot.links}
    name = parents[link.name]
    while name is not None:
        if name not in robot.carriers:  # the rows of a free joint connect no bodies
            points.append(placed[name][1])
        name = parents[name]
    for end, start in pairwise(points):
        first, last = _inside(contact.surface, start, end - start)
        if last > first and first > 0.0:
            entered = contact.surface.normal(start + first * (end - start))
            return bool(entered @ contact.surface.normal(points[0]) < THROUGH)
    return False


def _inside(surface: Surface, start: Array, along: Array) -> tuple[float, float]:
    """Return the interval of shares u in [0, 1] for which ``start + u along`` is inside a solid; (0, 0) if none is.

    The corners of a box are rounded, so the box is made smaller by the depth of its corners.
    """
    if isinstance(surface, Box):
        half = 0.5 * np.asarray(surface.edges)
        half -= min(max(CORNER * surface.edge_radius, SLACK), 0.25 * float(half.min()))
        offset, rate = surface.axes @ (start - surface.centre), surface.axes @ along
        rate = np.where(rate == 0.0, 1e-300, rate)
        limits = np.sort([(-half - offset) / rate, (half - offset) / rate], axis=0)
        first, last = limits[0].max(), limits[1].min()
    else:
        assert isinstance(surface, Quadric)
        curvature, slope = float(along @ surface.Q @ along), float((surface.Q @ start + surface.b) @ along)
        value = float(0.5 * start @ surface.Q @ start + surface.b @ start + surface.c) + SLACK
        root = slope**2 - 2.0 * curvature * value
        if curvature <= 1e-12 * float(np.abs(surface.Q).max()) * float(along @ along):
            first, last = (0.0, 1.0) if value < 0.0 else (0.0, 0.0)
        elif root <= 0.0:
            return 0.0, 0.0
        else:
            first, last = (-slope - np.sqrt(root)) / curvature, (-slope + np.sqrt(root)) / curvature
    first, last = max(float(first), 0.0), min(float(last), 1.0)
    return (first, last) if last > first else (0.0, 0.0)
