"""Scene of a record: shapes and poses of the robot and the surfaces, as plain data for figures and viewers.

A pose is a position [m] and an orientation, a unit quaternion (w, x, y, z). The frame of a body moves with its joint;
at joint position zero it coincides with the frame of the joint, whose pose is relative to the parent.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from dynsim.errors import RecordError
from dynsim.record.quaternion import Array, of_matrix, product, rotated

if TYPE_CHECKING:
    from pydantic import TypeAdapter

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
ShapeKind = Literal["cylinder", "capsule", "box", "sphere", "mesh"]
JointKind = Literal["revolute", "prismatic", "planar", "ball", "fixed"]
Matrix3 = tuple[Vector3, Vector3, Vector3]

WORLD = -1
"""Body index that stands for the world."""
# Depths below a surface that are smaller than this count as zero [m], because contact errors and the single precision
# of poses can cause such depths.
NOT_BELOW = 1e-4
HERE: Quaternion = (1.0, 0.0, 0.0, 0.0)
"""Identity orientation."""
_FIELD = ("position", "spacing", "heights")
"""Attributes that a height field requires."""


class _Finite:
    """Base class of all parts of a scene: pydantic accepts only finite numbers."""

    __pydantic_config__: ClassVar[Any] = {"allow_inf_nan": False}


@dataclass(frozen=True)
class Shape(_Finite):
    """Solid on a body, for drawing only; it does not affect the mechanics.

    Attributes
    ----------
    kind : "cylinder", "capsule", "box", "sphere" or "mesh"
        Kind of the solid, which is centred on its frame; cylinders and capsules extend along z.
    size : tuple of float
        Cylinder and capsule: radius and length [m]; the length of a capsule is the distance between the centres of its
        end spheres. Box: edge lengths along x, y and z [m]. Sphere: radius [m]. Mesh: scale factors along x, y and z.
    position, orientation : tuple of float
        Pose in the frame of the body.
    file : str
        Path of the mesh file, as written in the robot file.
    colour : tuple of float or None
        Red, green, blue and opacity from 0 to 1, if specified.
    """

    kind: ShapeKind
    size: tuple[float, ...]
    position: Vector3 = (0.0, 0.0, 0.0)
    orientation: Quaternion = HERE
    file: str = ""
    colour: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        count = {"cylinder": 2, "capsule": 2, "box": 3, "sphere": 1, "mesh": 3}[self.kind]
        if len(self.size) != count:
            raise RecordError(f"the size of a {self.kind} must be {count} numbers, got {len(self.size)}")

    def placed(self, position: ArrayLike, orientation: ArrayLike) -> Shape:
        """Return the shape with its pose in another frame.

        Parameters
        ----------
        position, orientation : array_like
            Pose of the body's frame in the other frame.
        """
        turn = np.asarray(orientation, dtype=np.float64)
        where = np.asarray(position) + rotated(turn, np.array(self.position))
        return replace(self, position=vector3(where), orientation=_four(product(turn, np.array(self.orientation))))


@dataclass(frozen=True)
class Joint(_Finite):
    """Joint between a body and its parent.

    Attributes
    ----------
    name : str
        Name of the joint.
    kind : "revolute", "prismatic", "planar", "ball" or "fixed"
        Planar: translation along x and y of the joint frame, then rotation about z. Ball: orientation of the body in
        the joint frame.
    axis : tuple of float
        Unit vector, with the same components in the frames of the joint and of the body.
    position, orientation : tuple of float
        Pose of the joint in the frame of the parent.
    signal, labels : str, tuple of str
        Signal of the record with the joint position, and its columns: one column [rad or m], three columns for a planar
        joint [m, m, rad], the four components w, x, y, z of a quaternion of any length for a ball joint, and no column
        for a fixed joint.
    lower, upper : float or None
        Limits [rad or m].
    part_of : str
        Name of the joint with several rates to which this joint belongs; "" for an independent joint.
    """

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
            raise RecordError(f"joint {self.name!r} is {self.kind} but has {len(self.labels)} columns")


@dataclass(frozen=True)
class Body(_Finite):
    """Rigid body; ``parent`` is the index of its parent body, or ``WORLD``."""

    name: str
    parent: int
    joint: Joint
    shapes: tuple[Shape, ...] = ()

    @property
    def radius(self) -> float:
        """Radius of the body's thickest cylinder or capsule [m]; 0 if it has no such shape.

        The axis of the body may be this far below a surface.
        """
        round_ones = (shape for shape in self.shapes if shape.kind in ("cylinder", "capsule"))
        return max((float(shape.size[0]) for shape in round_ones), default=0.0)


@dataclass(frozen=True)
class SceneSurface(_Finite):
    """Surface C(r) = 0 in the world; C > 0 is the free side, into which ∇C points.

    Attributes
    ----------
    name : str
        Name of the surface.
    Q, b, c : tuple of tuple of float, tuple of float, float
        Coefficients of a quadric, C = r·Q r/2 + b·r + c. They are zero for a box (C is the distance) and for a height
        field (C = z − h).
    kind : "plane", "sphere", "cylinder", "quadric", "box" or "height_field"
        Kind of the surface.
    position : tuple of float or None
        Plane: point closest to the origin of the world. Sphere and box: centre. Cylinder: point on the axis. Height
        field: first grid point; its z is the zero level of the heights [m].
    direction : tuple of float or None
        Normal of a plane, or axis of a cylinder.
    radius : float or None
        Radius of a sphere or cylinder [m], negative if the free side is inside; for a box, radius of its edges [m].
    orientation, edges : tuple of float or None
        Orientation and edge lengths [m] of a box.
    spacing, heights : tuple or None
        Grid spacing of a height field along x and y, and its heights, one row per y [m]; only the heights that are
        drawn.
    """

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
        """Create a surface from its coefficients; planes, spheres and cylinders are recognised."""
        Q, b = np.asarray(Q, dtype=np.float64), np.asarray(b, dtype=np.float64)
        with np.errstate(all="ignore"):
            kind, parameters = _simple_kind(Q, b, float(c))
        if not all(np.isfinite(value).all() for value in parameters.values()):
            kind, parameters = "quadric", {}
        return cls(name, (vector3(Q[0]), vector3(Q[1]), vector3(Q[2])), vector3(b), float(c), kind, **parameters)

    def value(self, points: Array) -> Array:
        """Return C at points, (…, 3) → (…)."""
        if self.kind == "box":
            core = 0.5 * np.array(self.edges) - (self.radius or 0.0)
            beyond = np.abs((points - np.array(self.position)) @ rotated(np.array(self.orientation), np.eye(3))) - core
            inside = np.minimum(beyond.max(axis=-1), 0.0)
            return np.asarray(np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + inside - (self.radius or 0.0))
        if self.kind == "height_field":
            return np.asarray(points[..., 2] - self._height(points[..., 0], points[..., 1]))
        bent = np.einsum("...i,ij,...j", points, np.array(self.Q), points)
        return np.asarray(0.5 * bent + points @ np.array(self.b) + self.c)

    def gradient(self, points: Array) -> Array:
        """Return ∇C at points, (…, 3) → (…, 3)."""
        if self.kind in ("box", "height_field"):
            step = 1e-6
            ends = [(points + step * axis, points - step * axis) for axis in np.eye(3)]
            return np.stack([self.value(ahead) - self.value(behind) for ahead, behind in ends], axis=-1) / (2.0 * step)
        return np.asarray(points @ np.array(self.Q) + np.array(self.b))

    def normal(self, points: Array) -> Array:
        """Return the unit normals towards the free side at points, (…, 3) → (…, 3); zero if ∇C is zero."""
        slope = self.gradient(points)
        size = np.linalg.norm(slope, axis=-1, keepdims=True)
        return np.asarray(slope / np.where(size > 0.0, size, 1.0))

    def gap(self, points: Array) -> Array:
        """Return signed distances [m] of points along ∇C, (…, 3) → (…); exact for plane, sphere and cylinder."""
        value, size, n = self.value(points), np.linalg.norm(self.gradient(points), axis=-1), self.normal(points)
        inner = size * size - 2.0 * value * np.einsum("...i,ij,...j", n, np.array(self.Q), n)
        with np.errstate(all="ignore"):
            return np.asarray(np.where(inner > 0.0, 2.0 * value / (size + np.sqrt(inner)), value / size))

    @property
    def grid(self) -> tuple[Array, Array]:
        """Grid coordinates x, (nx,), and y, (ny,), of a height field [m]."""
        start, heights = np.array(self.position), np.array(self.heights)
        x, y = (start[s] + np.array(self.spacing)[s] * np.arange(heights.shape[1 - s]) for s in (0, 1))
        return x, y

    def _height(self, x: Array, y: Array) -> Array:
        """Return heights by bilinear interpolation; outside the grid, return the height at its edge."""
        from scipy.ndimage import map_coordinates  # imported here because height fields are rare

        start, spacing = np.array(self.position), np.array(self.spacing)
        cells = np.stack([(y - start[1]) / spacing[1], (x - start[0]) / spacing[0]])
        # For a single point, the arrays are zero-dimensional, which map_coordinates does not accept.
        heights = map_coordinates(np.array(self.heights), cells.reshape(2, -1), order=1, mode="nearest")
        return np.asarray(heights).reshape(cells.shape[1:])


@dataclass(frozen=True)
class Point(_Finite):
    """Named point on a body.

    Attributes
    ----------
    name : str
        Name of the point.
    role : "hand", "contact" or "support"
        A support is a ground contact of a mobile base.
    body : int
        Index of the body, or ``WORLD``.
    position : tuple of float
        Position in the frame of the body [m].
    surface : str
        Name of the surface that a contact point touches.
    friction : float
        Friction coefficient that defines the friction cone of a contact point; 0 if unknown.
    radius : float
        Radius of the sphere or capsule about a contact point [m].
    tip : tuple of float or None
        Other end of a capsule's axis in the frame of the body [m].
    carrier : int
        Index of the body that carries the surface, or ``WORLD``.
    """

    name: str
    role: Literal["hand", "contact", "support"]
    body: int
    position: Vector3
    surface: str = ""
    friction: float = 0.0
    radius: float = 0.0
    tip: Vector3 | None = None
    carrier: int = WORLD


@dataclass(frozen=True)
class CarriedMass(_Finite):
    """Payload on a body (index ``body``): centre of mass in its frame [m], mass [kg], and radius [m], 0 for a point."""

    name: str
    body: int
    position: Vector3
    mass: float
    radius: float = 0.0


@dataclass(frozen=True)
class FixedFrame(_Finite):
    """Named frame fixed to a body (index ``body``, or ``WORLD``), such as a tool flange, with its pose on the body."""

    name: str
    body: int
    position: Vector3
    orientation: Quaternion


@dataclass(frozen=True)
class SoftGripper(_Finite):
    """Soft gripper of a snake.

    Attributes
    ----------
    capture : float
        Maximum distance to a grasp frame at which the gripper captures an object [m].
    force, torque : float
        Maximum force [N] and torque [N m] that the gripper can exert on a grasped object.
    """

    capture: float
    force: float
    torque: float


@dataclass(frozen=True)
class Scene(_Finite):
    """Bodies (parents first), surfaces, named points and fixed shapes.

    Attributes
    ----------
    bodies : tuple of Body
        Bodies; each follows its parent.
    surfaces : tuple of SceneSurface
        Surfaces.
    points : tuple of Point
        The hand and the contact points.
    fixed : tuple of Shape
        Shapes fixed in the world.
    supports : tuple of Point
        Ground contacts of a mobile base: left wheel, right wheel, caster. They are not in ``points``, so that older
        versions of dynsim, which do not know their role, ignore them.
    objects : tuple of str
        Names of the bodies that are objects, not parts of the robot.
    resistance, voltage_limit : float or None
        Resistance [ohm] and voltage limit [V] of the DC motors, if they are the same for all motors.
    mesh_folders : tuple of str
        Folders that are searched for mesh files.
    grip : SoftGripper or None
        Gripper of a snake.
    tip : float
        Distance by which the tip of a snake's gripper is ahead of the controlled point [m].
    frames : tuple of FixedFrame
        Frames of the robot file that are fixed to bodies or to the world.
    payloads : tuple of CarriedMass
        Payloads of the robot.

    Raises
    ------
    RecordError
        If a body precedes its parent, or a point is on a body that does not exist.
    """

    bodies: tuple[Body, ...] = ()
    surfaces: tuple[SceneSurface, ...] = ()
    points: tuple[Point, ...] = ()
    fixed: tuple[Shape, ...] = ()
    supports: tuple[Point, ...] = ()
    objects: tuple[str, ...] = ()
    resistance: float | None = None
    voltage_limit: float | None = None
    mesh_folders: tuple[str, ...] = ()
    grip: SoftGripper | None = None
    tip: float = 0.0
    frames: tuple[FixedFrame, ...] = ()
    payloads: tuple[CarriedMass, ...] = ()

    def __post_init__(self) -> None:
        for k, body in enumerate(self.bodies):
            if not WORLD <= body.parent < k:
                raise RecordError(f"body {body.name!r} ({k}) must come after its parent ({body.parent})")
        points: tuple[Point | FixedFrame | CarriedMass, ...]
        points = (*self.points, *self.supports, *self.frames, *self.payloads)
        for point in points:
            if not WORLD <= point.body < len(self.bodies):
                raise RecordError(f"point {point.name!r} is on body {point.body}, but only {len(self.bodies)} exist")

    @property
    def hand(self) -> Point | None:
        """Controlled point."""
        return next((point for point in self.points if point.role == "hand"), None)

    @property
    def contacts(self) -> tuple[Point, ...]:
        """Contact points."""
        return tuple(point for point in self.points if point.role == "contact")

    @property
    def base(self) -> tuple[int, ...]:
        """Indices of the bodies of a mobile base: the body with the supports, then its wheels."""
        if not self.supports or self.supports[0].body == WORLD:
            return ()
        base = self.supports[0].body
        # The coordinates of the base's joint include the angles of its wheels.
        joint = self.bodies[base].joint.part_of
        own = {body.joint.name for body in self.bodies if joint and body.joint.part_of == joint}
        wheels = [k for k, body in enumerate(self.bodies) if body.parent == base and own & set(body.joint.labels)]
        return base, *wheels

    @property
    def bodies_of_objects(self) -> set[int]:
        """Indices of the bodies of objects, of the bodies on them, and of the bodies of the rows of their joints."""
        known = set[int]()
        for k, body in enumerate(self.bodies):
            if body.name in self.objects or body.joint.part_of in self.objects or body.parent in known:
                known.add(k)
        return known

    @property
    def rows(self) -> dict[int, list[int]]:
        """Indices of the bodies of each joint, parents first, by the last one.

        A joint with several rates has a body without shape and mass for each row except the last.
        """
        chains: dict[int, list[int]] = {}
        for k, body in enumerate(self.bodies):
            part, parent = body.joint.part_of, body.parent
            same = part and parent != WORLD and self.bodies[parent].joint.part_of == part
            chains[k] = [*(chains.pop(parent, ()) if same else ()), k]
        return chains

    @property
    def wheel_names(self) -> dict[str, str]:
        """Display names of the wheel motors of a mobile base, by label: "base.left" is the left wheel."""
        labels = [label for k in self.base[1:] for label in self.bodies[k].joint.labels]
        return {label: f"{label.rpartition('.')[2]} wheel" for label in labels}

    def surface(self, name: str) -> SceneSurface | None:
        """Return the surface with this name, or None."""
        return next((surface for surface in self.surfaces if surface.name == name), None)

    def to_json(self) -> str:
        """Return the scene as JSON text that :meth:`from_json` can read."""
        return json.dumps(self, default=vars)

    @classmethod
    def from_json(cls, text: str) -> Scene:
        """Read a text written by :meth:`to_json` and check every part of it; keys of later versions are ignored.

        Raises
        ------
        RecordError
            If the text does not describe a scene.
        """
        # Imported here because it is needed only for reading.
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
    """Return three numbers as floats."""
    x, y, z = np.asarray(values, dtype=np.float64).tolist()
    return x, y, z


def quaternion(R: ArrayLike) -> Quaternion:
    """Return the unit quaternion, w ≥ 0, of a rotation matrix, as floats."""
    return _four(of_matrix(R))


def _four(values: ArrayLike) -> Quaternion:
    w, x, y, z = np.asarray(values, dtype=np.float64).tolist()
    return w, x, y, z


def _simple_kind(Q: Array, b: Array, c: float) -> tuple[Any, dict[str, Any]]:
    """Return the kind (plane, sphere, cylinder or quadric) of a quadric and its parameters."""
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
