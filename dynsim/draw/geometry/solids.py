"""Shapes as flat faces: corners and polygons, turning to the left seen from outside, all in the frame of one body."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.draw.geometry.mesh_files import Mesh
from dynsim.record.quaternion import rotated

Array = NDArray[np.float64]
Faces = NDArray[np.int64]
# Faces around what is round, and between the equator and a pole.
AROUND, RINGS = 28, 4
# Pieces that are as long as thick, at either end of a long rod.
ENDS = 3


def solid(shape: dict[str, Any], meshes: list[Mesh], finer: int = 1) -> tuple[Array, Faces]:
    """Corners, (n, 3) [m], and faces, (m, 4), of a shape of :mod:`dynsim.draw.geometry.shapes`.

    A triangle repeats a corner. What is round has ``finer`` times as many faces around it.
    """
    size = shape["size"]
    if shape["kind"] == "mesh":
        mesh = meshes[shape["mesh"]]
        corners, faces = mesh.corners * np.array(size), np.concatenate([mesh.triangles, mesh.triangles[:, -1:]], axis=1)
        if np.prod(size) < 0.0:
            faces = faces[:, ::-1]
    elif shape["kind"] == "box":
        corners, faces = _box(np.array(size))
    else:
        # Radius and height of rings, from below.
        rings_each = RINGS * finer
        angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 2 * rings_each + 1)
        radius = size[0]
        if shape["kind"] == "cylinder":
            half = 0.5 * size[1]
            rings = [(0.0, -half), *((radius, z) for z in _cuts(radius, half)), (0.0, half)]
        else:
            half = 0.5 * size[1] if shape["kind"] == "capsule" else 0.0
            ball = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
            apart = np.array([0.0, half])
            low, high = ball[: rings_each + 1] - apart, ball[rings_each:] + apart
            rings = [*low, *((radius, z) for z in _cuts(radius, half)[1:-1]), *(high if half else high[1:])]
        corners, faces = _turned(np.array(rings), AROUND * finer)
    turned = rotated(np.array(shape["q"]), corners.T).T
    return np.array(shape["p"]) + turned, faces


def _cuts(radius: float, half: float) -> Array:
    """Heights from −half to half at which a round side is cut: into pieces as long as its radius, at most three an end.

    Faces are painted in the order of their middles: those of a whole rod that leans to the viewer are nearer than a
    hub at its end, which they would cover.
    """
    if 2.0 * half <= 2.0 * ENDS * radius:
        return np.linspace(-half, half, max(int(np.ceil(2.0 * half / max(radius, 1e-12))), 1) + 1)
    end = radius * np.arange(ENDS + 1)
    return np.concatenate([end - half, half - end[::-1]])


def _box(size: Array) -> tuple[Array, Faces]:
    signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return signs * size, np.array(faces)


def _turned(rings: Array, sides: int) -> tuple[Array, Faces]:
    """The solid that rings (radius, height) about z enclose."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corners = np.concatenate([np.column_stack([radius * around, np.full(sides, z)]) for radius, z in rings])
    k = np.arange(sides)
    after = (k + 1) % sides
    faces = [
        np.stack([a + k, a + after, a + sides + after, a + sides + k], axis=1)
        for a in sides * np.arange(len(rings) - 1)
    ]
    return corners, np.concatenate(faces)


def grid_faces(grid: Array) -> tuple[Array, Faces]:
    """Corners and cells of a grid of points, (n, m, 3), as far as they are known."""
    rows, columns, _ = grid.shape
    number = np.arange(rows * columns).reshape(rows, columns)
    cells = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], axis=-1).reshape(-1, 4)
    corners = grid.reshape(-1, 3)
    return corners, cells[np.isfinite(corners[cells]).all(axis=(1, 2))]
