"""Grids of points on the surfaces of a scene, for quadrics on the part near the robot; corners of boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dynsim.record.quaternion import rotated
from dynsim.record.scene import SceneSurface

Array = NDArray[np.float64]
# Numbers of points along each side of the drawn part of a curved surface, and of a face of a box.
PATCH, FACE = 41, 13


def surface_grids(surface: SceneSurface, low: Array, high: Array) -> list[Array]:
    """Grids of points on a surface, (n, m, 3) [m] each, NaN where there are none.

    All of a height field and of the six faces of a box, of a quadric the part next to the box from ``low`` to ``high``.
    """
    if surface.kind == "height_field":
        x, y = np.meshgrid(*surface.grid)
        return [np.stack([x, y, np.array(surface.heights)], axis=-1)]
    if surface.kind == "box":
        return _box_faces(surface)
    return [quadric_patch(surface, low, high)]


def _box_faces(surface: SceneSurface) -> list[Array]:
    """Points of the six faces of a box, its edges sharp, (n, n, 3) each."""
    half, R = 0.5 * np.array(surface.edges), rotated(np.array(surface.orientation), np.eye(3))
    u, v = np.meshgrid(*2 * [np.linspace(-1.0, 1.0, FACE)])
    faces = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            local = np.roll(np.stack([np.full_like(u, side), u, v], axis=-1), axis, axis=-1) * half
            faces.append(np.array(surface.position) + local @ R.T)
    return faces


def quadric_patch(surface: SceneSurface, low: Array, high: Array) -> Array:
    """Points of a quadric over its tangent plane next to a box, along the normal to the nearest root of C.

    With r = r₀ + s n on the normal n, C(r) = a s² + b s + c, where a = n·Q n/2, b = n·(Q r₀ + b) and c = C(r₀).

    Parameters
    ----------
    low, high : (3,) corners of the box [m]; its middle is where the tangent plane is sought from

    Returns
    -------
    Array
        (n, n, 3) [m], NaN where there is no root, or none within the longest edge of the box. A plane has the four
        corners only, without seams between.
    """
    anchor, normal = 0.5 * (low + high), np.array([0.0, 0.0, 1.0])
    for _ in range(20):
        if not np.linalg.norm(surface.gradient(anchor)) > 1e-12:
            return np.full((2, 2, 3), np.nan)
        normal = surface.normal(anchor)
        anchor = anchor - surface.gap(anchor) * normal
    # Along the axes of the world where that is possible.
    across = np.eye(3)[:2] if abs(normal[2]) > 0.99 else np.linalg.svd(normal[None])[2][1:]
    reach = (box_corners(low, high) - anchor) @ across.T
    Q = np.array(surface.Q)
    count = PATCH if Q.any() else 2
    u, v = np.meshgrid(*(np.linspace(reach[:, k].min(), reach[:, k].max(), count) for k in (0, 1)))
    start = anchor + u[..., None] * across[0] + v[..., None] * across[1]
    a = 0.5 * float(normal @ Q @ normal)
    b = start @ Q @ normal + float(np.array(surface.b) @ normal)
    c = surface.value(start)
    inside = b * b - 4.0 * a * c
    with np.errstate(all="ignore"):
        # The smaller root, in the form that also holds for a = 0.
        step = -2.0 * c / (b + np.copysign(np.sqrt(np.where(inside >= 0.0, inside, np.nan)), b))
    points = start + step[..., None] * normal
    points[~(np.abs(step) <= float((high - low).max()))] = np.nan
    return np.asarray(points)


def round_patch(surface: SceneSurface, low: Array, high: Array) -> Array:
    """Points of a sphere or cylinder, (n, n, 3) [m]: all of a small one, else the part around the point next to a box.

    Its meridians or generators start there, so that the part ends in a smooth edge: an ellipse on a sphere, as long and
    as wide as the box, or half as wide as long.
    """
    centre, radius = np.array(surface.position), abs(float(surface.radius or 0.0))
    middle, reach = 0.5 * (low + high), 0.6 * float(np.linalg.norm(high - low))
    widest = min(np.pi, reach / radius)
    away = middle - centre
    axis = None if surface.kind == "sphere" else np.array(surface.direction)
    if axis is not None:
        away = away - axis * (away @ axis)
    size = float(np.linalg.norm(away))
    if not size > 1e-9:
        away = np.linalg.svd((np.eye(3)[0] if axis is None else axis)[None])[2][1]
        size = 1.0
    towards = away / size
    turn = np.linspace(-1.0, 1.0, PATCH)
    if axis is None:
        # Along the box, which may be much longer than wide, unless its longest edge points at the centre.
        edges = np.eye(3)[np.argsort(low - high)]
        along = next(edge for edge in edges if abs(edge @ towards) < 0.9)
        along = along - towards * (along @ towards)
        first = along / np.linalg.norm(along)
        sides = np.array([first, np.cross(towards, first)])
        share, round_about = np.meshgrid(0.5 * (turn + 1.0), np.pi * turn, indexing="ij")
        if not 0.0 < widest < np.pi:
            polar = share * widest
        else:
            reaches = 0.6 * np.abs(sides) @ (high - low) / radius
            # A box may have no width at all, and stand on the sphere.
            a, b = np.minimum(np.maximum(reaches, max(0.5 * reaches.max(), 0.2 * widest)), np.pi)
            polar = share / np.hypot(np.cos(round_about) / a, np.sin(round_about) / b)
        across = np.cos(round_about)[..., None] * sides[0] + np.sin(round_about)[..., None] * sides[1]
        return np.asarray(centre + radius * (np.cos(polar)[..., None] * towards + np.sin(polar)[..., None] * across))
    length = float(np.abs(axis) @ (high - low))
    angle, along = np.meshgrid(widest * turn, (middle - centre) @ axis + 0.5 * turn * length)
    side = np.cross(axis, towards)
    ring = np.cos(angle)[..., None] * towards + np.sin(angle)[..., None] * side
    return np.asarray(centre + radius * ring + along[..., None] * axis)


def box_corners(low: Array, high: Array) -> Array:
    """The eight corners of a box, (8, 3)."""
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def box_about(clouds: Sequence[Array], room: float = 0.0) -> tuple[Array, Array]:
    """Corners of the box about all points that are finite, (…, k) each, with ``room`` in parts of its longest edge.

    A unit box where there is none.
    """
    points = np.concatenate([cloud.reshape(-1, cloud.shape[-1]) for cloud in clouds])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return np.zeros(points.shape[1]), np.ones(points.shape[1])
    low, high = points.min(axis=0), points.max(axis=0)
    edge = room * float((high - low).max())
    return low - edge, high + edge
