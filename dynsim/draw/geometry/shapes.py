"""Shapes of bodies and surfaces for pages and films, and their faces; rods for bodies without shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.draw.geometry.meshes import Mesh, Meshes
from dynsim.record import Record
from dynsim.record.poses import ORIENTATION, POSITION
from dynsim.record.quaternion import of_turn, rotated
from dynsim.record.scene import HERE, WORLD, Body, Scene, SceneSurface, Shape

# Grids of points on the surfaces of a scene, for quadrics on the part near the robot; corners of boxes.


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


# Wheels of a record in groups, times on the ground, support polygon, and centre of pressure or mass.


@dataclass(frozen=True)
class WheelGroups:
    """Wheels that are lifted together.

    Attributes
    ----------
    names : of the groups
    places : for each group (body, index of the shape on it)
    down : (T, groups), 1 on the ground; None where it was not recorded
    """

    names: tuple[str, ...] = ()
    places: tuple[tuple[tuple[int, int], ...], ...] = ()
    down: Array | None = None


def wheel_groups(record: Record, scene: Scene) -> WheelGroups:
    """Pairs of a snake, or the two wheels of a mobile base."""
    if "grounded" in record:
        names = record.labels["grounded"]
        index = {body.name: k for k, body in enumerate(scene.bodies)}
        places = [_of_pair(scene, index[name]) if name in index else () for name in names]
        return WheelGroups(names, tuple(places), np.asarray(record["grounded"], dtype=np.float64))
    wheels = scene.base[1:]
    if "wheel_load" in record and wheels:
        names = tuple(scene.bodies[k].joint.labels[0] for k in wheels)
        down = (record["wheel_load"][:, : len(wheels)] > 0.0).astype(np.float64)
        return WheelGroups(names, tuple(((k, 0),) for k in wheels), down)
    return WheelGroups()


def _of_pair(scene: Scene, pair: int) -> tuple[tuple[int, int], ...]:
    """Wheels on a body: its own beside its middle, and those that turn on it."""
    own = [(pair, k) for k, shape in enumerate(scene.bodies[pair].shapes) if shape.position[1] != 0.0]
    turning = [k for k, body in enumerate(scene.bodies) if body.parent == pair and body.joint.position[1] != 0.0]
    return (*own, *((k, 0) for k in turning))


def supports(scene: Scene, groups: WheelGroups) -> list[dict[str, Any]]:
    """Points whose hull the robot stands on: on which body, and with which group of wheels they are on the ground."""
    if scene.supports:
        return [{"body": point.body, "p": list(point.position), "group": -1} for point in scene.supports]
    points = []
    for group, places in enumerate(groups.places):
        for body, shape in places:
            points.append({"body": body, "p": list(scene.bodies[body].shapes[shape].position), "group": group})
    return points


def cop_of(record: Record) -> tuple[str, Array] | None:
    """What must lie within the support: centre of pressure of a mobile base, centre of mass of a snake, (T, 2)."""
    for signal, name in (("center_of_pressure", "centre of pressure"), ("centre_of_mass", "centre of mass")):
        if signal in record:
            return name, np.asarray(record[signal][:, :2], dtype=np.float64)
    return None
