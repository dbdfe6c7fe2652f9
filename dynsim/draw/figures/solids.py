"""Shapes of bodies as points on their surfaces, from which outlines and faces follow: all are convex."""

from __future__ import annotations

import numpy as np

from dynsim.draw.figures.style import Array
from dynsim.record import Record
from dynsim.record.poses import ORIENTATION, POSITION
from dynsim.record.quaternion import rotated
from dynsim.record.scene import Scene, Shape

# Corners of what is round.
CORNERS = 24


def solids(record: Record, bodies: tuple[int, ...], row: int) -> list[Array]:
    """Shapes of some bodies of the record's scene at a sample, in the world, (n, 3) [m] each; meshes are left out."""
    scene, found = record.scene, list[Array]()
    assert isinstance(scene, Scene)
    for body in bodies:
        place = record[POSITION][row, body].astype(np.float64)
        turn = record[ORIENTATION][row, body].astype(np.float64)
        found += [place + rotated(turn, points.T).T for one in scene.bodies[body].shapes if len(points := surface(one))]
    return [points for points in found if np.isfinite(points).all()]


def surface(shape: Shape) -> Array:
    """Points on a shape whose convex hull it is, in its body's frame, (n, 3) [m]; none of a mesh."""
    angle = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    if shape.kind == "box":
        signs = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3), axis=-1).reshape(-1, 3)
        points = signs * np.array(shape.size)
    elif shape.kind == "cylinder":
        radius, length = shape.size
        rim = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(CORNERS)], axis=1)
        points = np.concatenate([rim + np.array([0.0, 0.0, end * length]) for end in (-0.5, 0.5)])
    elif shape.kind in ("sphere", "capsule"):
        latitude = np.linspace(-0.5 * np.pi, 0.5 * np.pi, CORNERS // 2 + 1)[:, None]
        ball = np.stack(
            np.broadcast_arrays(np.cos(latitude) * np.cos(angle), np.cos(latitude) * np.sin(angle), np.sin(latitude)),
            axis=-1,
        ).reshape(-1, 3)
        half = 0.5 * shape.size[1] if shape.kind == "capsule" else 0.0
        points = np.concatenate([shape.size[0] * ball + np.array([0.0, 0.0, end * half]) for end in (-1.0, 1.0)])
    else:
        return np.zeros((0, 3))
    return np.array(shape.position) + rotated(np.array(shape.orientation), points.T).T


def outline(points: Array) -> Array:
    """Corners of the convex hull of points in a plane, (n, 2) → (m, 2), turning to the left; of a line its ends."""
    ordered = np.unique(points, axis=0).tolist()
    return np.array(_side(ordered) + _side(ordered[::-1])) if len(ordered) > 1 else points


def _side(ordered: list[list[float]]) -> list[list[float]]:
    """The hull's corners from the first of points in order of x up to the last, which is left out."""
    kept: list[list[float]] = []
    for x, y in ordered:
        while len(kept) > 1:
            (ax, ay), (bx, by) = kept[-2:]
            if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0.0:
                break
            kept.pop()
        kept.append([x, y])
    return kept[:-1]


def faces(points: Array) -> Array:
    """Triangles of the convex hull of points, (m, 3, 3), that turn to the left seen from outside."""
    from scipy.spatial import ConvexHull, QhullError  # takes a third of a second

    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return np.zeros((0, 3, 3))
    triangles = points[hull.simplices]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = (normals * hull.equations[:, :3]).sum(axis=1) < 0.0
    triangles[inward] = triangles[inward, ::-1]
    return np.asarray(triangles)
