"""Solids of bodies that touch each other, and the parts of link axes inside solid surfaces."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np

from dynsim.compile.clearance import axis_ends, poses
from dynsim.compile.scene import solid_shape
from dynsim.compile.shapes import bends_outward
from dynsim.model.description import WORLD, Array, Contact, Robot
from dynsim.model.surfaces import Box, Capsule, Quadric, Surface
from dynsim.record.quaternion import rotated
from dynsim.record.scene import Shape

# Depth up to which an axis does not count as inside a sphere or cylinder, and least depth for a box [m].
SLACK = 1e-4
# Depth of the core of a rounded corner, (1 − 1/√3) edge radii.
CORNER = 1.0 - 3.0**-0.5
# Cosine between the normals where the arm enters a solid and where it touches it; below, it passes through the solid.
THROUGH = -0.5
# Radius of the edges of boxes that touch bodies [m], at most half the shortest edge.
ROUNDING = 1e-3

Solid = Capsule | Box


def solids_of(robot: Robot) -> dict[str, list[Solid]]:
    """Return the solids of each body that has any.

    Those of a link with a radius are capsules about its axes, those of other bodies their shapes. Wheels are the
    spheres with which they touch the ground. The solids of the root link, the last entry, are fixed to the world.
    """
    solids: dict[str, list[Solid]] = {}
    tips = axis_ends(robot)
    for link in robot.links:
        if link.name in robot.carriers:
            continue
        own: list[Solid] = [_solid_of(shape, link.name) for shape in link.solids]
        if link.radius > 0.0:
            own = [Capsule(np.zeros(3), tip, link.radius, link.name) for tip in tips[link.name] if tip.any()] or own
        if not link.solids:
            wheels = {(*foot.point, foot.radius) for foot in robot.feet if foot.body == link.name}
            own += [Capsule(np.array(at), np.zeros(3), r, link.name) for *at, r in wheels if r > link.radius]
        if own:
            solids[link.name] = own
    if robot.fixed_solids:
        solids[robot.root or WORLD] = [_solid_of(shape, None) for shape in robot.fixed_solids]
    return solids


def with_solids(robot: Robot) -> Robot:
    """Return the robot whose links have the shapes of :func:`solids_of`; a capsule replaces the shapes of its link."""
    solids = solids_of(robot)
    return replace(
        robot,
        links=tuple(
            replace(link, solids=tuple(map(solid_shape, solids[link.name])))
            if link.radius > 0.0 and link.name in solids
            else link
            for link in robot.links
        ),
    )


def _solid_of(shape: Shape, body: str | None) -> Solid:
    """Return the solid of a shape; a cylinder is the capsule inside it, or the rounded plate if it is a flat disc."""
    R, p = rotated(np.array(shape.orientation), np.eye(3)), np.array(shape.position)
    if shape.kind == "box":
        edges = np.array(shape.size)
        return Box(p, R.T, edges, min(ROUNDING, 0.5 * float(edges.min())), body)
    radius, *length = shape.size
    half = 0.5 * sum(length) - (radius if shape.kind == "cylinder" else 0.0)
    if half < 0.0:
        # A square plate whose corners, rounded like its edges, are on the rim.
        thickness = length[0]
        edge = math.sqrt(2.0) * (radius - 0.5 * thickness) + thickness
        return Box(p, R.T, np.array([edge, edge, thickness]), 0.5 * thickness, body)
    along = half * R[:, 2]
    return Capsule(p - along, 2.0 * along, radius, body)


def tangent_planes(surface: Surface) -> list[Quadric]:
    """Return planes that touch a solid on its sides: six for a box or sphere, four for a cylinder; none for others.

    A surface on a body has no planes, because they would move with it.
    """
    if surface.carrier is not None or not bends_outward(surface):
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
