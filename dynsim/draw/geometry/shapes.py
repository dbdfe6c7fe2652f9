"""Shapes of bodies, surfaces and wheels for pages and films, and their faces; rods for bodies without shapes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.draw.geometry.meshes import Mesh, Meshes
from dynsim.record import Record
from dynsim.record.poses import ORIENTATION, POSITION
from dynsim.record.quaternion import of_matrix, of_turn, rotated
from dynsim.record.scene import HERE, WORLD, Body, Scene, SceneSurface, Shape, quaternion

# Number of points along each side of the drawn part of a curved surface, and along each side of a box face.
PATCH, FACE = 41, 13


def surface_grids(surface: SceneSurface, low: Array, high: Array) -> list[Array]:
    """Return grids of points on a surface, (n, m, 3) [m] each; NaN marks missing points.

    The grids cover a height field, the six faces of a box, or the part of a quadric near the box from ``low`` to
    ``high``.
    """
    if surface.kind == "height_field":
        x, y = np.meshgrid(*surface.grid)
        return [np.stack([x, y, np.array(surface.heights)], axis=-1)]
    if surface.kind == "box":
        return _box_faces(surface)
    return [quadric_patch(surface, low, high)]


def _box_faces(surface: SceneSurface) -> list[Array]:
    """Return points on the six faces of a box with sharp edges, (n, n, 3) each."""
    half, R = 0.5 * np.array(surface.edges), rotated(np.array(surface.orientation), np.eye(3))
    u, v = np.meshgrid(*2 * [np.linspace(-1.0, 1.0, FACE)])
    faces = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            local = np.roll(np.stack([np.full_like(u, side), u, v], axis=-1), axis, axis=-1) * half
            faces.append(np.array(surface.position) + local @ R.T)
    return faces


def quadric_patch(surface: SceneSurface, low: Array, high: Array) -> Array:
    """Return points of a quadric near a box, each at the root of C nearest along the normal of a tangent plane.

    With r = r₀ + s n along the normal n, C(r) = a s² + b s + c, where a = n·Q n/2, b = n·(Q r₀ + b) and c = C(r₀).

    Parameters
    ----------
    surface : SceneSurface
        The quadric.
    low, high : (3,) ndarray
        Corners of the box [m]; the search for the tangent plane starts at its centre.

    Returns
    -------
    (n, n, 3) ndarray
        Points [m]; NaN if there is no root, or if the root is farther away than the longest edge of the box. A plane
        has only four corners, so that it has no seams.
    """
    anchor, normal = 0.5 * (low + high), np.array([0.0, 0.0, 1.0])
    for _ in range(20):
        if not np.linalg.norm(surface.gradient(anchor)) > 1e-12:
            return np.full((2, 2, 3), np.nan)
        normal = surface.normal(anchor)
        anchor = anchor - surface.gap(anchor) * normal
    # The grid is along the axes of the world if possible.
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
        # Compute the smaller root in the form that also holds for a = 0.
        step = -2.0 * c / (b + np.copysign(np.sqrt(np.where(inside >= 0.0, inside, np.nan)), b))
    points = start + step[..., None] * normal
    points[~(np.abs(step) <= float((high - low).max()))] = np.nan
    return np.asarray(points)


def round_patch(surface: SceneSurface, low: Array, high: Array) -> Array:
    """Return points of a sphere or cylinder, (n, n, 3) [m]: the whole surface if it is small, or the part near a box.

    The meridians or generators start at the point nearest to the box, so that the part has a smooth edge. On a sphere,
    the part is an ellipse that is as long and as wide as the box, but at least half as wide as it is long.
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
        # Use the longest edge of the box that does not point to the centre; the box may be much longer than it is wide.
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
            # The box may have zero width and touch the sphere.
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
    """Return the eight corners of a box, (8, 3)."""
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def box_about(clouds: Sequence[Array], room: float = 0.0) -> tuple[Array, Array]:
    """Return the corners of the bounding box of all finite points, (…, k) each, with a margin.

    ``room`` is the margin relative to the longest edge. Without finite points the result is a unit box.
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
# Number of faces around a round solid, and from its equator to a pole.
AROUND, RINGS = 28, 4
# Radius of a rod drawn for a body without shapes, relative to the reach of the robot.
ROD = 0.008
# A spherical or cylindrical surface is drawn only near the robot if it is larger than this multiple of the view.
LARGE = 1.0
# Density of the ball that represents a payload without a radius [kg/m³] (steel), and colour of payloads.
DENSITY, BRASS = 7850.0, [0.72, 0.53, 0.2, 1.0]
# Thickness of a wall or slope relative to the view.
WALL = 0.02


def drawn_shape(shape: Shape, meshes: Meshes) -> dict[str, Any] | None:
    """Return a shape in the data format of the page, or None if its mesh was not found."""
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


def drawn_shapes(shapes: Iterable[Shape], meshes: Meshes) -> list[dict[str, Any]]:
    """Return shapes in the data format of the page, without those whose mesh was not found."""
    return [drawn for shape in shapes if (drawn := drawn_shape(shape, meshes)) is not None]


def body_shapes(scene: Scene, reach: float, meshes: Meshes) -> list[list[dict[str, Any]]]:
    """Return the shapes of every body; a body without shapes gets rods to its children, and joints get hubs."""
    own = set(range(len(scene.bodies))) - scene.bodies_of_objects
    tubes = [scene.bodies[k].shapes[0].size[0] for k in own if _is_tube(scene.bodies[k])]
    radius = float(np.median(tubes)) if tubes else ROD * reach
    base = set(scene.base)
    drawn = []
    for k, body in enumerate(scene.bodies):
        shapes = drawn_shapes(body.shapes, meshes)
        wanted = [child for child in scene.bodies if child.parent == k]
        # A rod extends from its joint, whereas a wheel surrounds its joint.
        bare = not shapes or (_is_tube(body) and np.abs(body.shapes[0].position).max() > 1e-9)
        if not shapes and k not in base:
            ends = [np.array(child.joint.position) for child in wanted if not child.joint.part_of]
            ends += [np.array(point.position) for point in scene.points if point.role == "hand" and point.body == k]
            shapes = [_rod(end, radius) for end in ends if np.linalg.norm(end) > 2.0 * radius]
        elif _is_tube(body):
            shapes += _stems(scene, k)
        pads = _pads(scene, k)
        # A hub would hide a pad about the joint.
        bare = bare and not any(np.linalg.norm(pad["p"]) < radius <= pad["size"][0] for pad in pads)
        if body.joint.kind == "revolute" and not body.joint.part_of and k not in base and bare:
            shapes.append(_hub(body, 1.45 * radius))
        drawn.append([*shapes, *pads, *_payloads(scene, k)])
    if not any(drawn):
        hands = {point.body for point in scene.points if point.body != WORLD} or {len(scene.bodies) - 1}
        for k in hands & set(range(len(scene.bodies))):
            drawn[k] = [{"kind": "box", "size": 3 * [0.06 * reach], "p": [0.0, 0.0, 0.03 * reach], "q": list(HERE)}]
    return drawn


def _pads(scene: Scene, k: int) -> list[dict[str, Any]]:
    """Return the spheres and capsules with which a body touches surfaces, except those that its shapes show."""
    pads = []
    for point in scene.contacts:
        start, tip = np.array(point.position), np.array(point.tip or point.position)
        shown = (
            np.linalg.norm(0.5 * (start + tip) - shape.position) < 1e-6 and shape.size[0] > 0.99 * point.radius
            for shape in scene.bodies[k].shapes
            if shape.kind in ("cylinder", "capsule", "sphere")
        )
        if point.body != k or not point.radius > 0.0 or any(shown):
            continue
        ball = {"kind": "sphere", "size": [point.radius], "p": start.tolist(), "q": list(HERE)}
        if point.tip is not None:
            rod = _rod(tip - start, point.radius)
            ball = rod | {"p": (0.5 * (start + tip)).tolist()}
        pads.append(ball | {"role": "pad", "text": f"{point.name}: radius {1e3 * point.radius:.3g} mm"})
    return pads


def _payloads(scene: Scene, k: int) -> list[dict[str, Any]]:
    """Return the payloads of a body as balls; a point mass is drawn as a ball of steel."""
    balls = []
    for load in scene.payloads:
        if load.body == k:
            radius = load.radius or (0.75 * load.mass / (np.pi * DENSITY)) ** (1.0 / 3.0)
            ball = {"kind": "sphere", "size": [radius], "p": list(load.position), "q": list(HERE), "colour": BRASS}
            balls.append(ball | {"role": "load", "text": f"{load.name}: {load.mass:.3g} kg"})
    return balls


def _stems(scene: Scene, k: int) -> list[dict[str, Any]]:
    """Return thin rods from a body to the hand or the tip of its gripper if the first shape of the body ends before."""
    tube = scene.bodies[k].shapes[0]
    far = float(np.linalg.norm(tube.position)) + 0.5 * tube.size[1] + tube.size[0]
    tip = np.array([scene.tip, 0.0, 0.0])
    ends = [np.array(point.position) + tip for point in scene.points if point.role == "hand" and point.body == k]
    return [_rod(end, 0.5 * tube.size[0]) | {"role": "stem"} for end in ends if np.linalg.norm(end) > far]


def thinnest(shapes: list[list[dict[str, Any]]]) -> float:
    """Return the smallest radius of the rods [m], except stems and pads; 0 without rods."""
    rods = (s for own in shapes for s in own if s["kind"] in ("cylinder", "capsule"))
    return min((s["size"][0] for s in rods if s.get("role") not in ("stem", "pad")), default=0.0)


def gripper(shapes: list[list[dict[str, Any]]], scene: Scene, reach: float) -> dict[str, Any]:
    """Return two gripper fingers as boxes in the frame of the hand [m], which end at the tip of the gripper.

    The result contains their forward distance, and their lateral distances when open and when closed.
    """
    size = max(1.7 * thinnest(shapes), 0.012 * reach)
    ahead = scene.tip - 0.8 * size
    return {"size": [1.6 * size, 0.4 * size, 0.8 * size], "ahead": ahead, "aside": [0.8 * size, 0.28 * size]}


def _is_tube(body: Body) -> bool:
    """Return whether dynsim draws a body as a rod: its first shape is a cylinder or capsule without a colour."""
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
    """Return a rotation that maps the z axis to a unit vector, as a quaternion, (4,)."""
    axis = np.cross([0.0, 0.0, 1.0], direction)
    size = float(np.linalg.norm(axis))
    if size < 1e-12:
        return np.array(HERE if direction[2] > 0.0 else (0.0, 1.0, 0.0, 0.0))
    return of_turn(axis / size, np.arctan2(size, direction[2]))


def drawn_surface(surface: SceneSurface, low: Array, high: Array) -> dict[str, Any]:
    """Return a surface in the data format of the page, near the box ``low`` to ``high`` in which everything moves."""
    drawn: dict[str, Any] = {"name": surface.name, "kind": surface.kind}
    span = float((high - low).max())
    near = abs(surface.radius or 0.0) <= LARGE * span
    if surface.kind == "plane" and surface.direction is not None:
        # The part of the plane below the box; its first axis is horizontal, and the second one points up.
        centre, normal = 0.5 * (low + high), np.array(surface.direction)
        first = np.cross([0.0, 0.0, 1.0], normal)
        first = first / np.linalg.norm(first) if np.linalg.norm(first) > 1e-6 else np.array([1.0, 0.0, 0.0])
        axes = np.array([first, np.cross(normal, first)])
        ends = (box_corners(low, high) - centre) @ axes.T
        start, end = ends.min(axis=0) - 0.1 * span, ends.max(axis=0) + 0.1 * span
        return drawn | {
            "p": (centre - surface.gap(centre) * normal + 0.5 * (start + end) @ axes).tolist(),
            "q": list(quaternion(np.array([*axes, normal]).T)),
            "size": (end - start).tolist(),
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


def floor_level(surface: SceneSurface) -> float | None:
    """Return the height of a horizontal plane whose free side is above it [m], or None for any other surface."""
    normal = surface.direction if surface.kind == "plane" else None
    return float((surface.position or HERE)[2]) if normal is not None and normal[2] > 1.0 - 1e-9 else None


def surface_solid(surface: SceneSurface, low: Array, high: Array) -> tuple[Array, Faces]:
    """Return corners, (n, 3) [m], and faces, (m, 4), of the part of a surface near the box ``low`` to ``high``.

    A plane is a thin wall behind the surface. Boxes and small spheres and cylinders are whole, with faces that point to
    the free side. Other surfaces have faces on both sides.
    """
    round_one = surface.kind in ("sphere", "cylinder")
    shape = drawn_surface(surface, low, high) if round_one or surface.kind == "box" else {"kind": surface.kind}
    if shape["kind"] == "plane":
        shape = _wall(surface, low, high)
    if shape["kind"] == "box":
        return solid(shape, [])
    if shape["kind"] in ("sphere", "cylinder"):
        radius = float(shape["radius"])
        corners, faces = solid({"q": HERE, **shape, "size": [abs(radius), shape.get("length", 0.0)]}, [], finer=3)
        return corners, faces if radius > 0.0 else faces[:, ::-1]
    (grid,) = [round_patch(surface, low, high)] if round_one else surface_grids(surface, low, high)
    corners, faces = grid_faces(grid)
    return corners, np.concatenate([faces, faces[:, ::-1]])


def _wall(surface: SceneSurface, low: Array, high: Array) -> dict[str, Any]:
    """Return a plane as a box behind it, as long and as wide as the box ``low`` to ``high`` requires."""
    patch = quadric_patch(surface, low, high)
    u, v, normal = patch[0, 1] - patch[0, 0], patch[1, 0] - patch[0, 0], np.array(surface.direction)
    size = np.array([np.linalg.norm(u), np.linalg.norm(v), WALL * float((high - low).max())])
    first = u / size[0]
    return {
        "kind": "box",
        "size": size.tolist(),
        "p": (patch.mean(axis=(0, 1)) - 0.5 * size[2] * normal).tolist(),
        "q": of_matrix(np.stack([first, np.cross(normal, first), normal], axis=1)).tolist(),
    }


def solid(shape: dict[str, Any], meshes: list[Mesh], finer: int = 1) -> tuple[Array, Faces]:
    """Return corners, (n, 3) [m], and faces, (m, 4), of a shape of :func:`drawn_shape`.

    A triangle repeats a corner. ``finer`` multiplies the number of faces of round shapes.
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
        # Radii and heights of rings, from bottom to top.
        rings_each = RINGS * finer
        angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 2 * rings_each + 1)
        radius = size[0]
        if shape["kind"] == "cylinder":
            half = 0.5 * size[1]
            rings = [(0.0, -half), (radius, -half), (radius, half), (0.0, half)]
        else:
            half = 0.5 * size[1] if shape["kind"] == "capsule" else 0.0
            ball = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
            apart = np.array([0.0, half])
            low, high = ball[: rings_each + 1] - apart, ball[rings_each:] + apart
            rings = [*low, *(high if half else high[1:])]
        corners, faces = _turned(np.array(rings), AROUND * finer)
    turned = rotated(np.array(shape["q"]), corners.T).T
    return np.array(shape["p"]) + turned, faces


def _box(size: Array) -> tuple[Array, Faces]:
    signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return signs * size, np.array(faces)


def _turned(rings: Array, sides: int) -> tuple[Array, Faces]:
    """Return the solid of revolution of rings (radius, height) about z."""
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
    """Return the corners and the finite cells of a grid of points, (n, m, 3)."""
    rows, columns, _ = grid.shape
    number = np.arange(rows * columns).reshape(rows, columns)
    cells = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], axis=-1).reshape(-1, 4)
    corners = grid.reshape(-1, 3)
    return corners, cells[np.isfinite(corners[cells]).all(axis=(1, 2))]


def corners_of(record: Record, scene: Scene, body: int, row: int) -> list[tuple[Array, Faces]]:
    """Return world corners, (n, 3) [m], and faces, (m, 4), of each shape of a body at a sample, without meshes."""
    pose = record[POSITION][row, body].astype(np.float64), record[ORIENTATION][row, body].astype(np.float64)
    if not np.isfinite(pose[0]).all():
        return []
    shapes = (shape.placed(*pose) for shape in scene.bodies[body].shapes)
    return [solid(shape, []) for shape in drawn_shapes(shapes, Meshes())]


def outline(points: Array) -> Array:
    """Return the corners of the convex hull of plane points, (n, 2) → (m, 2), counterclockwise.

    If the points are on a line, its ends are returned.
    """
    from scipy.spatial import ConvexHull, QhullError  # imported here because it takes a third of a second

    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:
        return np.asarray(points[np.lexsort(points.T)[[0, -1]]])


# Groups of wheels, their ground contact, the support polygon, and the centre of pressure or mass.
@dataclass(frozen=True)
class WheelGroups:
    """Groups of wheels that are lifted together.

    Attributes
    ----------
    names : tuple of str
        Names of the groups.
    places : tuple of tuple of tuple of int
        For each group, the body and the shape index of each of its wheels.
    down : (T, groups) ndarray or None
        1 if a group is on the ground, 0 if it is lifted; None if not recorded.
    """

    names: tuple[str, ...] = ()
    places: tuple[tuple[tuple[int, int], ...], ...] = ()
    down: Array | None = None


def wheel_groups(record: Record, scene: Scene) -> WheelGroups:
    """Return the wheel pairs of a snake, or the two wheels of a mobile base."""
    if "grounded" in record:
        names = record.labels["grounded"]
        index = {body.name: k for k, body in enumerate(scene.bodies)}
        places = [_pair_wheels(scene, index[name]) if name in index else () for name in names]
        return WheelGroups(names, tuple(places), np.asarray(record["grounded"], dtype=np.float64))
    wheels = scene.base[1:]
    if "wheel_load" in record and wheels:
        names = tuple(scene.bodies[k].joint.labels[0] for k in wheels)
        down = (record["wheel_load"][:, : len(wheels)] > 0.0).astype(np.float64)
        return WheelGroups(names, tuple(((k, 0),) for k in wheels), down)
    return WheelGroups()


def _pair_wheels(scene: Scene, pair: int) -> tuple[tuple[int, int], ...]:
    """Return the wheels of a pair: shapes of its body away from the centre line, and wheels that rotate on it."""
    own = [(pair, k) for k, shape in enumerate(scene.bodies[pair].shapes) if shape.position[1] != 0.0]
    turning = [k for k, body in enumerate(scene.bodies) if body.parent == pair and body.joint.position[1] != 0.0]
    return (*own, *((k, 0) for k in turning))


def supports(scene: Scene, groups: WheelGroups) -> list[dict[str, Any]]:
    """Return the points that span the support polygon, each with its body, position and group of wheels."""
    if scene.supports:
        return [{"body": point.body, "p": list(point.position), "group": -1} for point in scene.supports]
    points = []
    for group, places in enumerate(groups.places):
        for body, shape in places:
            points.append({"body": body, "p": list(scene.bodies[body].shapes[shape].position), "group": group})
    return points


def cop_of(record: Record) -> tuple[str, Array] | None:
    """Return the point that must be in the support polygon: centre of pressure (base) or centre of mass (snake).

    The result contains the name of the point and its positions, (T, 2).
    """
    for signal, name in (("center_of_pressure", "centre of pressure"), ("centre_of_mass", "centre of mass")):
        if signal in record:
            return name, np.asarray(record[signal][:, :2], dtype=np.float64)
    return None
