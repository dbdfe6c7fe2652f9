"""The scene of a record: shapes and places of robot and surfaces, as plain data for figures and viewers.

Placements are a position [m] and an orientation, a unit quaternion (w, x, y, z). A body's frame moves with its joint;
at joint position zero it is the joint's frame, which is placed in the parent's frame.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynsim.errors import RecordError
from dynsim.record.quaternion import of_matrix, product, rotated

if TYPE_CHECKING:
    from pydantic import TypeAdapter

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
ShapeKind = Literal["cylinder", "capsule", "box", "sphere", "mesh"]
JointKind = Literal["revolute", "prismatic", "planar", "ball", "fixed"]
Matrix3 = tuple[Vector3, Vector3, Vector3]

WORLD = -1
"""Index of the world among the bodies."""
# A depth below a surface of less than this counts as zero [m]: contacts and single precision of poses leave so much.
NOT_BELOW = 1e-4
HERE: Quaternion = (1.0, 0.0, 0.0, 0.0)
"""The orientation without rotation."""
_FIELD = ("position", "spacing", "heights")
"""Attributes of a height field."""
_CHECKS: Any = {"allow_inf_nan": False}
"""Configuration of pydantic for reading each class."""


@dataclass(frozen=True)
class Shape:
    """A solid on a body, for the eye; it has no part in the mechanics.

    Attributes
    ----------
    kind : "cylinder", "capsule", "box", "sphere" or "mesh"
        Cylinders and capsules lie along z, all kinds about the origin of their placement.
    size : tuple of float
        Cylinder and capsule: radius and length [m], that of a capsule between the centres of its ends. Box: edges along
        x, y and z. Sphere: radius. Mesh: scale along x, y and z.
    position, orientation : placement in the body's frame
    file : of a mesh, as the robot's file names it
    colour : red, green, blue and opacity from 0 to 1, None: not stated
    """

    __pydantic_config__: ClassVar[Any] = _CHECKS
    kind: ShapeKind
    size: tuple[float, ...]
    position: Vector3 = (0.0, 0.0, 0.0)
    orientation: Quaternion = HERE
    file: str = ""
    colour: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        count = {"cylinder": 2, "capsule": 2, "box": 3, "sphere": 1, "mesh": 3}[self.kind]
        if len(self.size) != count:
            raise RecordError(f"a {self.kind} has {count} numbers as its size, not {len(self.size)}")

    def placed(self, position: ArrayLike, orientation: ArrayLike) -> Shape:
        """The same shape seen from a frame in which the body's has a position [m] and an orientation."""
        turn = np.asarray(orientation, dtype=np.float64)
        where = np.asarray(position) + rotated(turn, np.array(self.position))
        return replace(self, position=vector3(where), orientation=_four(product(turn, np.array(self.orientation))))


@dataclass(frozen=True)
class Joint:
    """How a body moves against its parent.

    Attributes
    ----------
    kind : "revolute", "prismatic", "planar", "ball" or "fixed"
        Planar: along x and y of the joint's frame, then about z. Ball: the body's orientation in the joint's frame.
    axis : unit vector in the joint's frame (and the body's)
    position, orientation : placement of the joint in the parent's frame
    signal, labels : str, tuple of str
        Where the record has the joint's position: columns of a signal, one [rad or m], of a planar joint three [m, m,
        rad], of a ball joint the four of a quaternion w, x, y, z of any length; none of what is fixed.
    lower, upper : limits [rad or m], None for none
    part_of : name of the joint with several rates that this is one of, "" for a joint of its own
    """

    __pydantic_config__: ClassVar[Any] = _CHECKS
    name: str
    kind: JointKind
    axis: Vector3
    position: Vector3
    orientation: Quaternion
    signal: str
    labels: tuple[str, ...]
    lower: float | None = None
    upper: float | None = None
    part_of: str = ""

    def __post_init__(self) -> None:
        if len(self.labels) != {"planar": 3, "ball": 4, "fixed": 0}.get(self.kind, 1):
            raise RecordError(f"joint {self.name!r} is {self.kind} and has {len(self.labels)} columns")


@dataclass(frozen=True)
class Body:
    """A rigid body; ``parent`` is the index of the body that carries it, ``WORLD`` for none."""

    __pydantic_config__: ClassVar[Any] = _CHECKS
    name: str
    parent: int
    joint: Joint
    shapes: tuple[Shape, ...] = ()

    @property
    def radius(self) -> float:
        """Of its thickest cylinder or capsule [m]; 0 where it has none. So far its axis may reach below a surface."""
        round_ones = (shape for shape in self.shapes if shape.kind in ("cylinder", "capsule"))
        return max((float(shape.size[0]) for shape in round_ones), default=0.0)


@dataclass(frozen=True)
class SceneSurface:
    """A surface C(r) = 0 in the world; C > 0 is the free side, where ∇C points.

    Attributes
    ----------
    Q, b, c : C = r·Q r/2 + b·r + c of a quadric; zero of a box (C is the distance) and a height field (C = z − h)
    kind : "plane", "sphere", "cylinder", "quadric", "box" or "height_field"
    position : on a plane, next to the world's origin; centre of a sphere or box; on the axis of a cylinder; of the
        first height of a field, whose z is zero [m]
    direction : normal of a plane, axis of a cylinder
    radius : of a sphere or cylinder [m], negative where the free side is inside; of the edges of a box
    orientation, edges : of a box
    spacing, heights : of a field along x and y, a row for each y [m]; no more than are drawn
    """

    __pydantic_config__: ClassVar[Any] = _CHECKS
    name: str
    Q: Matrix3
    b: Vector3
    c: float
    kind: Literal["plane", "sphere", "cylinder", "quadric", "box", "height_field"] = "quadric"
    position: Vector3 | None = None
    direction: Vector3 | None = None
    radius: float | None = None
    orientation: Quaternion | None = None
    edges: Vector3 | None = None
    spacing: tuple[float, float] | None = None
    heights: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        needed = {"box": ("position", "radius", "orientation", "edges"), "height_field": _FIELD}.get(self.kind, ())
        if lacking := [name for name in needed if getattr(self, name) is None]:
            raise RecordError(f"surface {self.name!r} is a {self.kind} without {lacking[0]}")

    @classmethod
    def of_quadric(cls, name: str, Q: ArrayLike, b: ArrayLike, c: float) -> SceneSurface:
        """A surface by its coefficients, with the parameters of the simple kind that it is of, if any."""
        Q, b = np.asarray(Q, dtype=np.float64), np.asarray(b, dtype=np.float64)
        with np.errstate(all="ignore"):
            kind, parameters = _simple_kind(Q, b, float(c))
        if not all(np.isfinite(value).all() for value in parameters.values()):
            kind, parameters = "quadric", {}
        return cls(name, (vector3(Q[0]), vector3(Q[1]), vector3(Q[2])), vector3(b), float(c), kind, **parameters)

    def value(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """C at points, (…, 3) → (…)."""
        if self.kind == "box":
            core = 0.5 * np.array(self.edges) - (self.radius or 0.0)
            beyond = np.abs((points - np.array(self.position)) @ rotated(np.array(self.orientation), np.eye(3))) - core
            inside = np.minimum(beyond.max(axis=-1), 0.0)
            return np.asarray(np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + inside - (self.radius or 0.0))
        if self.kind == "height_field":
            return np.asarray(points[..., 2] - self._height(points[..., 0], points[..., 1]))
        bent = np.einsum("...i,ij,...j", points, np.array(self.Q), points)
        return np.asarray(0.5 * bent + points @ np.array(self.b) + self.c)

    def gradient(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """∇C at points, (…, 3) → (…, 3)."""
        if self.kind in ("box", "height_field"):
            step = 1e-6
            ends = [(points + step * axis, points - step * axis) for axis in np.eye(3)]
            return np.stack([self.value(ahead) - self.value(behind) for ahead, behind in ends], axis=-1) / (2.0 * step)
        return np.asarray(points @ np.array(self.Q) + np.array(self.b))

    def normal(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit normals into the free side at points, (…, 3) → (…, 3); zero where ∇C is."""
        slope = self.gradient(points)
        size = np.linalg.norm(slope, axis=-1, keepdims=True)
        return np.asarray(slope / np.where(size > 0.0, size, 1.0))

    def gap(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distances [m] of points along ∇C, (…, 3) → (…), exact for plane, sphere and cylinder."""
        value, size, n = self.value(points), np.linalg.norm(self.gradient(points), axis=-1), self.normal(points)
        inner = size * size - 2.0 * value * np.einsum("...i,ij,...j", n, np.array(self.Q), n)
        with np.errstate(all="ignore"):
            return np.asarray(np.where(inner > 0.0, 2.0 * value / (size + np.sqrt(inner)), value / size))

    @property
    def grid(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """x, (nx,), and y, (ny,), of the heights of a field [m]."""
        start, heights = np.array(self.position), np.array(self.heights)
        x, y = (start[s] + np.array(self.spacing)[s] * np.arange(heights.shape[1 - s]) for s in (0, 1))
        return x, y

    def _height(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Between the heights of the grid in straight lines; beyond it as at its edge."""
        from scipy.ndimage import map_coordinates  # height fields are rare

        start, spacing = np.array(self.position), np.array(self.spacing)
        cells = np.stack([(y - start[1]) / spacing[1], (x - start[0]) / spacing[0]])
        # A single point is an array of no dimension, which map_coordinates does not take.
        heights = map_coordinates(np.array(self.heights), cells.reshape(2, -1), order=1, mode="nearest")
        return np.asarray(heights).reshape(cells.shape[1:])


@dataclass(frozen=True)
class Point:
    """A named point on a body.

    Attributes
    ----------
    role : "hand", "contact" or "support", where a mobile base stands on the ground
    body : index, ``WORLD`` for a point in the world
    position : in the body's frame [m]
    surface : name of the surface that holds a contact point
    """

    __pydantic_config__: ClassVar[Any] = _CHECKS
    name: str
    role: Literal["hand", "contact", "support"]
    body: int
    position: Vector3
    surface: str = ""


@dataclass(frozen=True)
class Scene:
    """Bodies, each after the one that carries it, surfaces, named points, and what stands still in the world.

    Attributes
    ----------
    points : the hand and the contact points
    supports : where a mobile base touches the ground: left wheel, right wheel, caster. Not among the points, so that
        earlier versions, which do not know their role, pass them over

    Raises
    ------
    RecordError
        A body comes before its parent, or a point is on none.
    """

    __pydantic_config__: ClassVar[Any] = _CHECKS
    bodies: tuple[Body, ...] = ()
    surfaces: tuple[SceneSurface, ...] = ()
    points: tuple[Point, ...] = ()
    fixed: tuple[Shape, ...] = ()
    supports: tuple[Point, ...] = ()

    def __post_init__(self) -> None:
        for k, body in enumerate(self.bodies):
            if not WORLD <= body.parent < k:
                raise RecordError(f"body {body.name!r} ({k}) does not come after its parent ({body.parent})")
        for point in (*self.points, *self.supports):
            if not WORLD <= point.body < len(self.bodies):
                raise RecordError(f"point {point.name!r} is on body {point.body}, there are {len(self.bodies)}")

    @property
    def hand(self) -> Point | None:
        """The controlled point."""
        return next((point for point in self.points if point.role == "hand"), None)

    @property
    def contacts(self) -> tuple[Point, ...]:
        """The contact points."""
        return tuple(point for point in self.points if point.role == "contact")

    @property
    def base(self) -> tuple[int, ...]:
        """Indices of the bodies of a mobile base: the one that stands on the supports, then its wheels."""
        if not self.supports or self.supports[0].body == WORLD:
            return ()
        base = self.supports[0].body
        # The joint of the base has the angles of its wheels among its coordinates.
        joint = self.bodies[base].joint.part_of
        own = {body.joint.name for body in self.bodies if joint and body.joint.part_of == joint}
        wheels = [k for k, body in enumerate(self.bodies) if body.parent == base and own & set(body.joint.labels)]
        return base, *wheels

    @property
    def wheel_names(self) -> dict[str, str]:
        """What pictures call the motors of a mobile base's wheels, by their labels: "base.left" is the left wheel."""
        labels = [label for k in self.base[1:] for label in self.bodies[k].joint.labels]
        return {label: f"{label.rpartition('.')[2]} wheel" for label in labels}

    def surface(self, name: str) -> SceneSurface | None:
        """The surface of a name."""
        return next((surface for surface in self.surfaces if surface.name == name), None)

    def to_json(self) -> str:
        """The scene as a text of JSON; :meth:`from_json` reads it."""
        return json.dumps(self, default=vars)

    @classmethod
    def from_json(cls, text: str) -> Scene:
        """Read :meth:`to_json`; every part is checked. Keys of later versions are passed over.

        Raises
        ------
        RecordError
            The text describes no scene.
        """
        # Imported here: only who reads a scene needs it.
        from pydantic import ValidationError

        try:
            return _adapter().validate_json(text)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            key_path = ".".join(map(str, first["loc"]))
            raise RecordError(f"scene{f': {key_path}' if key_path else ''}: {first['msg']}") from error


@cache
def _adapter() -> TypeAdapter[Scene]:
    from pydantic import TypeAdapter

    return TypeAdapter(Scene)


def vector3(values: ArrayLike) -> Vector3:
    """Three numbers as plain floats."""
    x, y, z = np.asarray(values, dtype=np.float64).tolist()
    return x, y, z


def quaternion(R: ArrayLike) -> Quaternion:
    """Unit quaternion, w ≥ 0, of a rotation matrix, as plain floats."""
    return _four(of_matrix(R))


def _four(values: ArrayLike) -> Quaternion:
    w, x, y, z = np.asarray(values, dtype=np.float64).tolist()
    return w, x, y, z


def _simple_kind(Q: NDArray[np.float64], b: NDArray[np.float64], c: float) -> tuple[Any, dict[str, Any]]:
    """Plane, sphere or cylinder, and its parameters."""
    if not Q.any():
        slope = np.linalg.norm(b)
        return "plane", {"position": vector3(-c / slope**2 * b), "direction": vector3(b / slope)}
    sizes, axes = np.linalg.eigh(Q)
    small = 1e-9 * float(np.abs(sizes).max())
    if np.ptp(sizes) <= small:
        s = float(sizes.mean())
        centre = -b / s
        square = float(centre @ centre) - 2.0 * c / s
        if square > 0.0:
            return "sphere", {"position": vector3(centre), "radius": float(np.copysign(square**0.5, s))}
    flat = np.abs(sizes) <= small
    if flat.sum() == 1:
        s, axis = float(sizes[~flat].mean()), axes[:, flat][:, 0]
        if np.ptp(sizes[~flat]) <= small and abs(float(axis @ b)) <= 1e-9 * max(1.0, float(np.linalg.norm(b))):
            centre = -(b - axis * float(axis @ b)) / s
            square = float(centre @ centre) - 2.0 * c / s
            if square > 0.0:
                position, radius = vector3(centre), float(np.copysign(square**0.5, s))
                return "cylinder", {"position": position, "direction": vector3(axis), "radius": radius}
    return "quadric", {}
