"""Distances and normals of surfaces, computed directly from a scenario, and the touching points of contacts.

Boxes and height fields use separate methods: clamped points for boxes, SciPy's splines and a search for the foot of the
perpendicular for height fields.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.model.surfaces import Box, Capsule

Array = NDArray[np.float64]

# Initial positions along an axis at which its distance is evaluated, and number of bisections of the best part.
_SHARES, _CUTS = 33, 60


@dataclass(frozen=True)
class Shape:
    """A surface: distances (T,) [m] and unit normals (T, 3) to the free side at positions (T, 3).

    ``bends``: whether the middle of a straight line can be nearest to it.
    """

    look: Callable[[Array], tuple[Array, Array]]
    bends: bool

    def distance(self, position: Array) -> Array:
        """Return signed distances (T,) [m]."""
        return self.look(position)[0]


def shape(config: Mapping[str, Any], shift: Array, heights: Any = None) -> Shape:
    """Return the surface that a section of a scenario describes, moved by a vector [m].

    ``heights`` has origin (2,), spacing (2,) and heights (ny, nx) of a height field whose file may no longer exist.
    """
    kind = config["type"]
    if kind == "plane":
        normal = _unit(config.get("normal", [0.0, 0.0, 1.0]))
        point = np.array(config.get("point_m", [0.0, 0.0, 0.0])) + shift
        return Shape(lambda r: ((r - point) @ normal, np.broadcast_to(normal, r.shape)), False)
    if kind in ("sphere", "cylinder"):
        sign = -1.0 if config.get("inside") else 1.0
        centre = np.array(config["center_m"] if kind == "sphere" else config["point_m"]) + shift
        axis = np.zeros(3) if kind == "sphere" else _unit(config["axis"])
        radius = config["radius_m"]

        def round_one(r: Array) -> tuple[Array, Array]:
            away = r - centre
            away = away - np.outer(away @ axis, axis)
            far = np.linalg.norm(away, axis=1)
            return sign * (far - radius), sign * away / np.maximum(far, 1e-300)[:, None]

        return Shape(round_one, sign > 0.0)
    if kind == "box":
        return Shape(_box(config, shift), True)
    if kind == "height_field":
        return Shape(_field(*heights, shift), False)
    raise NotImplementedError(kind)


def solid(described: Box | Capsule) -> Shape:
    """Return a solid of a body, or a surface that a body carries, in the frame of this body."""
    if isinstance(described, Box):
        core, radius = 0.5 * described.edges - described.edge_radius, described.edge_radius
        return Shape(_rounded(described.centre, described.axes.T, core, radius), True)
    start, axis, radius = described.start, described.axis, described.radius

    def look(r: Array) -> tuple[Array, Array]:
        share = np.clip((r - start) @ axis / max(float(axis @ axis), 1e-300), 0.0, 1.0)
        away = r - start - np.outer(share, axis)
        far = np.linalg.norm(away, axis=1)
        return far - radius, away / np.maximum(far, 1e-300)[:, None]

    return Shape(look, True)


def seen_from(surface: Shape, rotation: Array, origin: Array) -> Shape:
    """Return a surface in the world that moves with a frame, (T, 3, 3) and (T, 3)."""

    def look(r: Array) -> tuple[Array, Array]:
        far, normal = surface.look(np.einsum("tij,ti->tj", rotation, r - origin))
        return far, np.einsum("tij,tj->ti", rotation, normal)

    return Shape(look, surface.bends)


def nearest(surface: Shape, start: Array, end: Array | None) -> Array:
    """Return the point of the axis from start to end, (T, 3) each, that is nearest to a surface."""
    if end is None or not surface.bends:
        return start
    along = end - start
    shares = np.linspace(0.0, 1.0, _SHARES)
    far = np.stack([surface.distance(start + u * along) for u in shares], axis=1)
    best = far.argmin(axis=1)
    low, high = shares[np.maximum(best - 1, 0)], shares[np.minimum(best + 1, _SHARES - 1)]
    # For equal halves use the smaller slope: distances of convex bodies are convex along a line.
    for _ in range(_CUTS):
        middle = 0.5 * (low + high)
        at = start + middle[:, None] * along
        rising = (surface.look(at)[1] * along).sum(axis=1) > 0.0
        low, high = np.where(rising, low, middle), np.where(rising, middle, high)
    share = 0.5 * (low + high)
    at_start, at_end = surface.distance(start), surface.distance(end)
    there = surface.distance(start + share[:, None] * along)
    share = np.where(at_start <= there, 0.0, share)
    share = np.where(at_end < np.minimum(there, at_start), 1.0, share)
    return np.asarray(start + share[:, None] * along)


def _box(config: Mapping[str, Any], shift: Array) -> Callable[[Array], tuple[Array, Array]]:
    roll, pitch, yaw = np.deg2rad(config.get("rpy_deg", [0.0, 0.0, 0.0]))
    about = [
        np.array([[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]]),
        np.array([[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]]),
        np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]]),
    ]
    R = about[2] @ about[1] @ about[0]
    rounding = config.get("edge_radius_m", 0.005)
    core = 0.5 * np.array(config["edges_m"]) - rounding
    return _rounded(np.array(config["center_m"]) + shift, R, core, rounding)


def _rounded(centre: Array, R: Array, core: Array, rounding: float) -> Callable[[Array], tuple[Array, Array]]:
    def look(r: Array) -> tuple[Array, Array]:
        own = (r - centre) @ R
        outside = np.maximum(np.abs(own) - core, 0.0)
        far = np.linalg.norm(outside, axis=1)
        inner = (np.abs(own) - core).max(axis=1)
        face = np.eye(3)[(np.abs(own) - core).argmax(axis=1)]
        away = np.where(far[:, None] > 0.0, outside / np.maximum(far, 1e-300)[:, None], face)
        return np.where(far > 0.0, far, inner) - rounding, (np.sign(own) * away) @ R.T

    return look


def _field(origin: Array, spacing: Array, heights: Array, shift: Array) -> Callable[[Array], tuple[Array, Array]]:
    from scipy.interpolate import RectBivariateSpline

    ny, nx = heights.shape
    x, y = origin[0] + spacing[0] * np.arange(nx), origin[1] + spacing[1] * np.arange(ny)
    spline = RectBivariateSpline(x, y, heights.T, kx=3, ky=3, s=0)

    def height(px: Array, py: Array) -> tuple[Array, Array, Array]:
        cx, cy = np.clip(px, x[0], x[-1]), np.clip(py, y[0], y[-1])
        slope_x, slope_y = spline.ev(cx, cy, dx=1), spline.ev(cx, cy, dy=1)
        # The surface is extended linearly beyond the grid.
        return spline.ev(cx, cy) + slope_x * (px - cx) + slope_y * (py - cy), slope_x, slope_y

    def look(r: Array) -> tuple[Array, Array]:
        at = r[:, :2].copy()
        # The foot of the perpendicular: r − c is along the normal there.
        for _ in range(200):
            z, slope_x, slope_y = height(at[:, 0], at[:, 1])
            rise = r[:, 2] - z
            # Gauss–Newton iteration for the least distance; it converges quickly near the surface.
            dx, dy = r[:, 0] - at[:, 0], r[:, 1] - at[:, 1]
            gx, gy = dx + slope_x * rise, dy + slope_y * rise
            det = (1 + slope_x**2) * (1 + slope_y**2) - (slope_x * slope_y) ** 2
            step_x = ((1 + slope_y**2) * gx - slope_x * slope_y * gy) / det
            step_y = ((1 + slope_x**2) * gy - slope_x * slope_y * gx) / det
            at += np.stack([step_x, step_y], axis=1)
            if max(np.abs(step_x).max(initial=0.0), np.abs(step_y).max(initial=0.0)) < 1e-13:
                break
        z, slope_x, slope_y = height(at[:, 0], at[:, 1])
        normal = np.stack([-slope_x, -slope_y, np.ones_like(z)], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        foot = np.stack([at[:, 0], at[:, 1], z], axis=1)
        return ((r - foot) * normal).sum(axis=1), normal

    def moved(r: Array) -> tuple[Array, Array]:
        return look(r - shift)

    return moved


def _unit(direction: Any) -> Array:
    vector = np.array(direction, dtype=np.float64)
    return np.asarray(vector / np.linalg.norm(vector))
