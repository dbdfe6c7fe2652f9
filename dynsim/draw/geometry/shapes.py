"""Shapes of bodies and surfaces for pages and films, and their faces; rods for bodies without shapes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.draw.geometry.mesh_files import Mesh
from dynsim.draw.geometry.meshes import Meshes
from dynsim.draw.geometry.surfaces import box_corners, surface_grids
from dynsim.record import Record
from dynsim.record.poses import ORIENTATION, POSITION
from dynsim.record.quaternion import of_turn, rotated
from dynsim.record.scene import HERE, WORLD, Body, Scene, SceneSurface, Shape

Array = NDArray[np.float64]
Faces = NDArray[np.int64]
# Numbers of faces around a round solid, and between its equator and a pole.
AROUND, RINGS = 28, 4
# Number of pieces as long as thick at either end of a long rod.
ENDS = 3
# Radius of a rod drawn for a body without shapes, in parts of the robot's reach.
ROD = 0.008
# A spherical or cylindrical surface larger than this many times the view is drawn only near the robot.
LARGE = 4.0


def drawn_shape(shape: Shape, meshes: Meshes) -> dict[str, Any] | None:
    """A shape as the page reads it; None for a mesh that was not found."""
    drawn: dict[str, Any] = {
        "kind": shape.kind,
        "size": list(shape.size),
        "p": list(shape.position),
        "q": list(shape.orientation),
    }
    if shape.colour is not None:
        drawn["colour"] = list(shape.colour)
    if shape.kind == "mesh":
        mesh = meshes.index(shape.file)
        if mesh is None:
            return None
        drawn["mesh"] = mesh
    return drawn


def body_shapes(scene: Scene, reach: float, meshes: Meshes) -> list[list[dict[str, Any]]]:
    """Shapes of every body; rods to what it carries where it has none, and a hub about the axis of its joint."""
    radius = _radius(scene, ROD * reach)
    base = set(scene.base)
    drawn = []
    for k, body in enumerate(scene.bodies):
        shapes = [shown for shape in body.shapes if (shown := drawn_shape(shape, meshes)) is not None]
        wanted = [child for child in scene.bodies if child.parent == k]
        # A rod leads away from its joint, a wheel lies about it.
        bare = not shapes or (_is_tube(body) and np.abs(body.shapes[0].position).max() > 1e-9)
        if not shapes and k not in base:
            ends = [np.array(child.joint.position) for child in wanted if not child.joint.part_of]
            ends += [np.array(point.position) for point in scene.points if point.role == "hand" and point.body == k]
            shapes = [_rod(end, radius) for end in ends if np.linalg.norm(end) > 2.0 * radius]
        elif _is_tube(body):
            shapes += _stems(scene, k)
        if body.joint.kind == "revolute" and not body.joint.part_of and k not in base and bare:
            shapes.append(_hub(body, 1.45 * radius))
        drawn.append(shapes)
    if not any(drawn):
        hands = {point.body for point in scene.points if point.body != WORLD} or {len(scene.bodies) - 1}
        for k in hands & set(range(len(scene.bodies))):
            drawn[k] = [{"kind": "box", "size": 3 * [0.06 * reach], "p": [0.0, 0.0, 0.03 * reach], "q": list(HERE)}]
    return drawn


def _stems(scene: Scene, k: int) -> list[dict[str, Any]]:
    """A thin rod to the hand of a body whose own one ends before it."""
    tube = scene.bodies[k].shapes[0]
    far = float(np.linalg.norm(tube.position)) + 0.5 * tube.size[1] + tube.size[0]
    ends = [np.array(point.position) for point in scene.points if point.role == "hand" and point.body == k]
    return [_rod(end, 0.5 * tube.size[0]) | {"role": "stem"} for end in ends if np.linalg.norm(end) > far]


def thinnest(shapes: list[list[dict[str, Any]]]) -> float:
    """The least radius of what is round [m], but for stems; 0 where nothing is."""
    round_ones = (
        s for shape in shapes for s in shape if s["kind"] in ("cylinder", "capsule") and s.get("role") != "stem"
    )
    return min((shape["size"][0] for shape in round_ones), default=0.0)


def gripper(shapes: list[list[dict[str, Any]]], reach: float) -> dict[str, Any]:
    """Two fingers at the hand, boxes in its body's axes [m]: how far ahead, and aside when open and when closed."""
    size = max(1.7 * thinnest(shapes), 0.012 * reach)
    return {"size": [1.6 * size, 0.4 * size, 0.8 * size], "ahead": 0.5 * size, "aside": [0.8 * size, 0.28 * size]}


def _radius(scene: Scene, default: float) -> float:
    tubes = [shape.size[0] for body in scene.bodies if _is_tube(body) for shape in body.shapes[:1]]
    return float(np.median(tubes)) if tubes else default


def _is_tube(body: Body) -> bool:
    """Whether it is drawn as a rod of dynsim's own: a cylinder without colour through the body's origin."""
    return bool(body.shapes) and body.shapes[0].kind in ("cylinder", "capsule") and body.shapes[0].colour is None


def _rod(end: Array, radius: float) -> dict[str, Any]:
    length = float(np.linalg.norm(end))
    return {
        "kind": "capsule",
        "size": [radius, length],
        "p": (0.5 * end).tolist(),
        "q": from_z(end / length).tolist(),
        "role": "rod",
    }


def _hub(body: Body, radius: float) -> dict[str, Any]:
    return {
        "kind": "cylinder",
        "size": [radius, 2.5 * radius],
        "p": [0.0, 0.0, 0.0],
        "q": from_z(np.array(body.joint.axis)).tolist(),
        "role": "hub",
    }


def from_z(direction: Array) -> Array:
    """A turn that takes z to a unit vector, (4,)."""
    axis = np.cross([0.0, 0.0, 1.0], direction)
    size = float(np.linalg.norm(axis))
    if size < 1e-12:
        return np.array(HERE if direction[2] > 0.0 else (0.0, 1.0, 0.0, 0.0))
    return of_turn(axis / size, np.arctan2(size, direction[2]))


def drawn_surface(surface: SceneSurface, low: Array, high: Array) -> dict[str, Any]:
    """A surface next to the box from ``low`` to ``high`` in which everything moves."""
    drawn: dict[str, Any] = {"name": surface.name, "kind": surface.kind}
    span = float((high - low).max())
    near = abs(surface.radius or 0.0) <= LARGE * span
    if surface.kind == "plane" and surface.direction is not None:
        centre = 0.5 * (low + high)
        normal = np.array(surface.direction)
        return drawn | {
            "p": (centre - surface.gap(centre) * normal).tolist(),
            "q": from_z(normal).tolist(),
            "half": 1.1 * float(np.linalg.norm(high - low)),
        }
    if surface.kind == "sphere" and near:
        return drawn | {"p": list(surface.position or ()), "radius": surface.radius}
    if surface.kind == "cylinder" and near and surface.direction is not None:
        axis, position = np.array(surface.direction), np.array(surface.position)
        along = [(corner - position) @ axis for corner in box_corners(low, high)]
        start, end = min(along) - 0.1 * span, max(along) + 0.1 * span
        return drawn | {
            "p": (position + 0.5 * (start + end) * axis).tolist(),
            "q": from_z(axis).tolist(),
            "radius": surface.radius,
            "length": end - start,
        }
    if surface.kind == "box":
        return drawn | {
            "p": list(surface.position or ()),
            "q": list(surface.orientation or HERE),
            "size": list(surface.edges or ()),
        }
    (grid,) = surface_grids(surface, low, high)
    rows, columns, _ = grid.shape
    numbers = [None if not np.isfinite(value) else round(float(value), 5) for value in grid.ravel()]
    return drawn | {"kind": "grid", "rows": rows, "columns": columns, "points": numbers}


def solid(shape: dict[str, Any], meshes: list[Mesh], finer: int = 1) -> tuple[Array, Faces]:
    """Corners, (n, 3) [m], and faces, (m, 4), of a shape of :func:`drawn_shape`.

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


def corners_of(record: Record, scene: Scene, body: int, row: int) -> list[tuple[Array, Faces]]:
    """Corners in the world, (n, 3) [m], and faces, (m, 4), of each shape of a body at a sample; meshes are left out."""
    pose = record[POSITION][row, body].astype(np.float64), record[ORIENTATION][row, body].astype(np.float64)
    if not np.isfinite(pose[0]).all():
        return []
    shapes = (drawn_shape(shape.placed(*pose), Meshes()) for shape in scene.bodies[body].shapes)
    return [solid(shape, []) for shape in shapes if shape is not None]


def outline(points: Array) -> Array:
    """Corners of the convex hull of points in a plane, (n, 2) → (m, 2), turning to the left; of a line its ends."""
    from scipy.spatial import ConvexHull, QhullError  # takes a third of a second

    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:
        return np.asarray(points[np.lexsort(points.T)[[0, -1]]])
