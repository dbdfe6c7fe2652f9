"""Bodies, joints, frames, contacts, couplings, ties, loads and the robot as plain frozen data in SI units.

Drives are in :mod:`dynsim.model.drives`, surfaces in :mod:`dynsim.model.surfaces`.

A :class:`Robot` is a tree of :class:`Link`; each link is one joint and the body it carries. The body's frame B moves
with the joint. At q = 0 it coincides with the joint frame J, whose pose in the parent's body frame is ``R_PJ`` and
``p_PJ``.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynsim.errors import ModelError
from dynsim.model.drives import Drive, Motor
from dynsim.model.joints import Row, rows
from dynsim.model.mobile_base import MobileBase
from dynsim.model.surfaces import Quadric as Quadric
from dynsim.model.surfaces import Surface
from dynsim.record.scene import Shape

Array = NDArray[np.float64]
WORLD = "world"
# Sum of the area vectors of a mesh, relative to its area, above which the mesh is open.
_OPEN = 1e-2


def vector(x: float, y: float, z: float) -> Array:
    """Return a 3-vector."""
    return np.array([x, y, z], dtype=np.float64)


@dataclass(frozen=True)
class Inertia:
    """Mass properties of a rigid body.

    Attributes
    ----------
    mass : float
        Mass [kg].
    com : (3,) ndarray
        Centre of mass in B [m].
    tensor : (3, 3) ndarray
        Inertia tensor about the centre of mass, in the axes of B [kg m²].
    """

    mass: float
    com: Array = field(default_factory=lambda: np.zeros(3))
    tensor: Array = field(default_factory=lambda: np.zeros((3, 3)))

    @classmethod
    def solid_sphere(cls, mass: float, radius: float, center: Array) -> Inertia:
        """Return a solid sphere about ``center``: I = 2 m r²/5; a point mass if the radius is zero."""
        return cls(mass, center, np.eye(3) * (0.4 * mass * radius**2))

    @classmethod
    def solid_cylinder(cls, mass: float, radius: float, length: float) -> Inertia:
        """Return a solid cylinder along +z from the frame's origin: I_x = I_y = m (3 r² + l²)/12, I_z = m r²/2."""
        side = mass * (3.0 * radius**2 + length**2) / 12.0
        return cls(mass, vector(0.0, 0.0, 0.5 * length), np.diag([side, side, 0.5 * mass * radius**2]))

    @classmethod
    def solid_box(cls, mass: float, edges: ArrayLike) -> Inertia:
        """Return a solid box about the frame's origin: I_x = m (b² + c²)/12."""
        squares = np.square(edges)
        return cls(mass, tensor=np.diag(mass / 12.0 * (squares.sum() - squares)))

    @classmethod
    def solid_capsule(cls, density: float, radius: float, length: float) -> Inertia:
        """Return a solid capsule along z about the frame's origin; ``length`` is the distance between its centres."""
        cylinder = cls.solid_cylinder(density * np.pi * radius**2 * length, radius, length)
        # The centre of mass of a half ball is 3 r/8 above its flat side.
        half = density * 2.0 / 3.0 * np.pi * radius**3
        moments = np.diag(half * radius**2 * np.array([83.0 / 320.0, 83.0 / 320.0, 0.4]))
        ends = (vector(0.0, 0.0, side * (0.5 * length + 0.375 * radius)) for side in (-1.0, 1.0))
        centred = cylinder.placed(np.eye(3), vector(0.0, 0.0, -0.5 * length))
        return cls.merged([centred, *(cls(half, end, moments) for end in ends)])

    @classmethod
    def solid_mesh(cls, density: float, corners: Array) -> Inertia:
        """Return the volume within triangles (n, 3, 3) [m], from the tetrahedra between the triangles and their centre.

        Raises
        ------
        ValueError
            If the surface is not closed: its area vectors do not sum to zero.
        """
        centre = corners.mean(axis=(0, 1))
        a, b, c = np.moveaxis(corners - centre, 1, 0)
        areas, volumes = np.cross(b - a, c - a), np.einsum("ti,ti->t", a, np.cross(b, c)) / 6.0
        volume = float(volumes.sum())
        if np.linalg.norm(areas.sum(axis=0)) > _OPEN * np.linalg.norm(areas, axis=1).sum() or volume == 0.0:
            raise ValueError("the mesh is not closed and has no volume")
        sums = a + b + c
        com = volumes @ sums / (4.0 * volume)
        # Second moments of a tetrahedron with one corner at the origin: V/20 (Σ c cᵀ + s sᵀ).
        second = sum(np.einsum("t,ti,tj->ij", volumes, x, x) for x in (a, b, c, sums)) / (20.0 * volume)
        second = second - np.outer(com, com)
        mass = density * abs(volume)
        return cls(mass, centre + com, mass * (np.trace(second) * np.eye(3) - second))

    def placed(self, R: Array, p: Array) -> Inertia:
        """Return the same inertia in a frame in which B has rotation R and origin p [m]."""
        tensor = R @ self.tensor @ R.T
        return Inertia(self.mass, p + R @ self.com, 0.5 * (tensor + tensor.T))

    def times(self, factor: float) -> Inertia:
        """Return the inertia of the same body with another density; a factor of 1 changes no bit."""
        return Inertia(factor * self.mass, self.com, factor * self.tensor)

    @classmethod
    def merged(cls, parts: Iterable[Inertia]) -> Inertia:
        """Return the sum of rigidly connected parts in a frame, I = Σ I_i + m_i (d_i² 1 − d_i d_iᵀ), d_i = c_i − c."""
        parts = list(parts)
        if len(parts) == 1:
            return parts[0]
        mass = sum(part.mass for part in parts)
        com = sum((part.mass * part.com for part in parts), np.zeros(3)) / mass if mass > 0.0 else np.zeros(3)
        tensor = np.zeros((3, 3))
        for part in parts:
            d = part.com - com
            tensor += part.tensor + part.mass * (d @ d * np.eye(3) - np.outer(d, d))
        return cls(mass, com, tensor)

    def nearest(self) -> Inertia:
        """Return a possible inertia with the same mass and axes, and the least change of the tensor (Frobenius norm).

        Principal moments are possible if and only if they are sums of two second moments that are not negative.
        """
        from scipy.optimize import nnls

        moments, axes = np.linalg.eigh(self.tensor)
        sums = np.ones((3, 3)) - np.eye(3)
        return replace(self, tensor=axes @ np.diag(sums @ nnls(sums, moments)[0]) @ axes.T)

    def check(self, name: str) -> None:
        """Raise :class:`ModelError` unless a real body can have these mass properties.

        Moments in files are rounded, and rotations add rounding errors. Violations are therefore ignored if they are
        below 1e-9 of the largest moment, or below the moment of the mass at a distance of one micrometre.
        """
        if not (np.isfinite(self.mass) and self.mass >= 0.0):
            raise ModelError(f"{name}: mass {self.mass} kg must be zero or positive")
        small = 1e-12 * self.mass
        # The condition is written so that NaN also fails.
        if not np.abs(self.tensor - self.tensor.T).max() <= 1e-9 * np.abs(self.tensor).max() + small:
            raise ModelError(f"{name}: the inertia tensor must be symmetric")
        moments = np.linalg.eigvalsh(self.tensor)
        slack = 1e-9 * float(abs(moments).max()) + small
        if moments[0] < -slack or moments[0] + moments[1] < moments[2] - slack:
            raise ModelError(
                f"{name}: principal moments of inertia {moments} kg m² are impossible for a body "
                "(each must be positive and no larger than the sum of the other two)"
            )


@dataclass(frozen=True)
class Link:
    """One joint and the body that it carries.

    Attributes
    ----------
    name, joint : str
        Names of the body and of its joint.
    parent : str or None
        Name of the parent body, None for the world.
    kind : str
        "revolute", "prismatic", or another row of :func:`dynsim.model.joints.rows`.
    axis : (3,) ndarray
        Unit joint axis in J (and B).
    R_PJ, p_PJ : (3, 3) ndarray, (3,) ndarray
        Rotation and position [m] of the joint in the parent's frame.
    damping : float
        Viscous loss D of the joint [N m s/rad or N s/m].
    friction : float
        Dry friction of the bearing, which can also hold the joint at rest [N m or N]; unilateral law only.
    lower, upper, velocity_limit, effort_limit : float
        Limits of the joint [rad or m; rad/s or m/s; N m or N]. They are not enforced; a run that exceeds a limit causes
        a warning.
    parameter : float
        Additional parameter that some kinds of joint require.
    armature : float
        Inertia that turns only with the joint, in addition to the inertia of its motor [kg m² or kg].
    joint_of_rows : str or None
        Name of the joint with several rows to which this row belongs; None for a joint with one row.
    radius : float
        Radius of a cylinder about the body's axis [m], zero if unknown. A run warns if the axis is deeper below a
        surface.
    tip : (3,) ndarray or None
        End point of the body's axis in B [m]; the axis starts at the joint. None: the axis ends at the joints that the
        body carries, or at the hand.
    shapes : tuple of Shape
        Visual shapes of the body, in B. If empty, a cylinder about its axis is drawn if ``radius`` and ``tip`` are
        known.
    solids : tuple of Shape
        Collision shapes of the body, in B: boxes, spheres, cylinders and capsules that can touch other bodies.
    omitted : tuple of str
        Collision shapes that cannot be solids, such as meshes, as texts for messages.
    """

    name: str
    joint: str
    parent: str | None
    kind: str
    axis: Array
    inertia: Inertia
    R_PJ: Array = field(default_factory=lambda: np.eye(3))
    p_PJ: Array = field(default_factory=lambda: np.zeros(3))
    damping: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf
    velocity_limit: float = np.inf
    effort_limit: float = np.inf
    radius: float = 0.0
    tip: Array | None = None
    shapes: tuple[Shape, ...] = ()
    parameter: float = 0.0
    joint_of_rows: str | None = None
    armature: float = 0.0
    friction: float = 0.0
    solids: tuple[Shape, ...] = ()
    omitted: tuple[str, ...] = ()

    @property
    def row(self) -> Row:
        """Kind of the row.

        Raises
        ------
        ModelError
            If the kind is unknown.
        """
        if self.kind not in rows():
            raise ModelError(f"{self.joint}: unknown joint kind {self.kind!r}; known: {', '.join(rows())}")
        return rows()[self.kind]

    @property
    def geometry(self) -> tuple[str, str | None, str, Array, Array, Array, float, Array | None]:
        """Everything that determines the position and extent of the body, without its mass."""
        return self.name, self.parent, self.kind, self.axis, self.R_PJ, self.p_PJ, self.radius, self.tip

    @property
    def units(self) -> tuple[str, str, str, str]:
        """Units of position, velocity, acceleration and force of the joint."""
        return self.row.units

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of all coordinates of the joint if this is its first row; empty for a later row."""
        row = self.row
        return tuple(f"{self.joint_of_rows}.{name}" for name in row.names) or (self.joint,) * len(row.neutral)


def without_body(link: Link) -> Link:
    """Return the link without mass, extent and shapes."""
    return replace(link, inertia=Inertia(0.0), radius=0.0, tip=None, shapes=(), solids=(), omitted=())


def in_rows(link: Link, rows: Sequence[tuple[str, str, Array]]) -> tuple[Link, ...]:
    """Return a joint of several rows, (suffix, kind, axis); only the last row carries the body of ``link``."""
    made: list[Link] = []
    for suffix, kind, axis in rows:
        turned = np.asarray(axis, dtype=np.float64)
        row = replace(link, joint=f"{link.joint}.{suffix}", kind=kind, axis=turned, joint_of_rows=link.joint)
        if len(made) < len(rows) - 1:
            row = replace(without_body(row), name=f"{link.name}.{suffix}")
        if made:
            row = replace(row, parent=made[-1].name, R_PJ=np.eye(3), p_PJ=np.zeros(3))
        made.append(row)
    return tuple(made)


@dataclass(frozen=True)
class Frame:
    """Named frame that is fixed to a body, such as a tool flange: rotation and origin in the body's frame.

    ``body`` is None for a frame fixed to the world: it has a name, but no moving part can be attached to it.
    """

    name: str
    body: str | None
    R: Array
    p: Array


@dataclass(frozen=True)
class Contact:
    """Point, sphere or capsule of a body, and the surface that it can touch.

    Attributes
    ----------
    point : (3,) ndarray
        The point, the centre of the sphere, or one end of the capsule's axis, in the body's frame [m].
    friction : float
        Kinetic coefficient μ.
    slip_smoothing : float
        Speed v_s [m/s] in the smoothed slip direction v_t/√(v_t² + v_s²); bilateral law only.
    pulling_friction : str
        "signed" (f_t = μ f_n as printed in [WM]) or "dissipative" (f_t = μ |f_n|); bilateral law only.
    static_friction : float or None
        Static coefficient μ_s; None: μ. This and all following attributes apply only to the unilateral law.
    stribeck : float
        Stribeck speed v_s [m/s] in μ + (μ_s − μ) exp(−(v/v_s)²); 0: the coefficient is μ as soon as the point slips.
    viscous_friction : float
        Increase of the friction coefficient with slip speed [s/m].
    restitution : float
        Ratio of the normal speeds after and before an impact.
    grip_axis : (3,) ndarray or None
        Axis in the body's frame along which friction is ``grip`` times the friction across it; time stepping only.
    stiffness, damping : float
        Stiffness and damping of body and surface along the normal [N/m, N s/m], 0: rigid; time stepping only.
    radius : float
        Radius of sphere or capsule [m].
    tip : (3,) ndarray or None
        Other end of a capsule's axis, in the same frame [m]. If the surface curves away from the free side, the nearest
        point of the axis touches, otherwise ``point``.
    left_out : bool
        True if no joint moves the point along the normal in any posture, so that it never touches.
    solid : Surface or None
        Solid of the body, if the contact is one of those between two solids; the surface is the other one.
    slot : int
        Number of this contact among those of the two solids.
    """

    name: str
    body: str
    point: Array
    surface: Surface
    surface_name: str = "floor"
    friction: float = 0.0
    slip_smoothing: float = 1e-3
    pulling_friction: str = "dissipative"
    static_friction: float | None = None
    stribeck: float = 0.0
    viscous_friction: float = 0.0
    restitution: float = 0.0
    grip: float = 1.0
    grip_axis: Array | None = None
    stiffness: float = 0.0
    damping: float = 0.0
    radius: float = 0.0
    tip: Array | None = None
    left_out: bool = False
    solid: Surface | None = None
    slot: int = 0
    is_between_bodies: bool = False

    @property
    def friction_at_rest(self) -> float:
        """Static coefficient μ_s; default: the kinetic coefficient."""
        return self.friction if self.static_friction is None else self.static_friction

    @property
    def geometry(self) -> tuple[str, str, Array, Surface, float, Array | None, Surface | None, int]:
        """Everything that determines the location of the contact and the surface that it can touch, without its law."""
        return self.name, self.body, self.point, self.surface, self.radius, self.tip, self.solid, self.slot


@dataclass(frozen=True)
class Foot:
    """Sphere of a body that can touch a surface of the scenario, independent of the declared contact points.

    On a body that spins about the centre of the sphere, the foot is a wheel: the touching point belongs to the sphere,
    so the sphere rolls.

    Attributes
    ----------
    point : (3,) ndarray
        Centre of the sphere in the body's frame [m].
    radius : float
        Radius [m].
    surface : str
        Name of the surface in the scenario.
    grip_axis : (3,) ndarray or None
        Axis in the body's frame along which there is no friction, as for a massless wheel.
    """

    name: str
    body: str
    point: Array
    radius: float
    surface: str
    grip_axis: Array | None = None


@dataclass(frozen=True)
class Coupling:
    """Joint that follows another joint, q = ratio q_leader + offset: a gear, a belt or a URDF mimic joint.

    It is an exact, lossless constraint whose force is not limited.
    """

    joint: str
    leader: str
    ratio: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Tie:
    """One direction in which two bodies are connected by a spring, a damper and a bound; time stepping only.

    The force or torque on ``body``, along or about the axis, is f = −k (x − x_0) − c dx/dt within its bound; the
    opposite force acts on ``other``. x = axis · (point − other point), or the component along the axis of the rotation
    of ``body`` relative to ``other``. Beyond the bound, x_0 moves. The bodies may belong to different trees; ``other``
    may be the world.

    Attributes
    ----------
    point, other_point : (3,) ndarray
        Points in the frames of ``body`` and ``other`` [m].
    axis : (3,) ndarray
        Axis in the frame of ``body``.
    stiffness, damping : float
        Stiffness k and damping c [N/m, N s/m; N m/rad, N m s/rad].
    bound : float
        Maximum force or torque [N or N m].
    turns : bool
        True if the tie acts about the axis, not along it.
    pushes : bool
        True for a one-sided tie, which only pushes ``body`` along the axis, without a bound.
    rest : float
        x_0 [m or rad]; NaN: the value of x when the tie begins.
    attitude : (3, 3) ndarray
        Rotation of ``other`` in the axes of ``body`` without deflection, for a torsional tie with a numeric rest value.
    holds : bool
        True if the tie is active from the start.
    """

    name: str
    body: str
    other: str
    axis: Array
    stiffness: float
    damping: float = 0.0
    bound: float = np.inf
    point: Array = field(default_factory=lambda: np.zeros(3))
    other_point: Array = field(default_factory=lambda: np.zeros(3))
    turns: bool = False
    pushes: bool = False
    rest: float = 0.0
    attitude: Array = field(default_factory=lambda: np.eye(3))
    holds: bool = True


@dataclass(frozen=True)
class Load:
    """External force and torque on a point of a body, as cubic polynomials of time.

    Attributes
    ----------
    body : str
        Name of a link.
    point : (3,) ndarray
        Point of application in the link's frame [m].
    in_body : bool
        Whether the components are in the axes of the link; otherwise in world axes.
    knots : (K + 1,) ndarray
        Increasing times [s].
    coefficients : (K, 6, 4) ndarray
        Coefficients of ascending powers of t - knots[k], for force x, y, z [N], then torque x, y, z [N m].
    hold : bool
        Whether the first and last values are held outside the knots; otherwise the load is zero there.
    """

    name: str
    body: str
    point: Array
    in_body: bool
    knots: Array
    coefficients: Array
    hold: bool

    def components(self, t: Array) -> Array:
        """Return force and torque at times t [s], (T,) → (T, 6) [N, N m]."""
        t = np.asarray(t, dtype=np.float64)
        inside = np.clip(t, self.knots[0], self.knots[-1])
        segment = np.minimum(np.searchsorted(self.knots, inside, side="right") - 1, len(self.coefficients) - 1)
        powers = (inside - self.knots[segment])[:, None] ** np.arange(4)
        values = np.einsum("tcp,tp->tc", self.coefficients[segment], powers)
        return values if self.hold else np.where((inside == t)[:, None], values, 0.0)


@dataclass(frozen=True)
class Robot:
    """Tree of links with its motors.

    Attributes
    ----------
    name : str
        Name of the robot.
    links : tuple of Link
        Joints and bodies; parents come before their children.
    motors : tuple of Drive
        Motors of the joints.
    hand : (str, (3,) ndarray)
        Controlled point: body name and point in its frame [m].
    gravity : (3,) ndarray
        Gravity in W [m/s²].
    q0 : (nq,) ndarray or None
        Initial configuration [rad or m]; None: zero.
    frames : tuple of Frame
        Additional named frames to which points can be attached.
    fixed_shapes, fixed_inertia : tuple of Shape, Inertia
        Shapes and mass of the parts fixed to the world.
    fixed_solids : tuple of Shape
        Collision shapes of the parts fixed to the world.
    couplings : tuple of Coupling
        Couplings between joints.
    ties : tuple of Tie
        Ties between bodies.
    base : MobileBase or None
        Mobile base; None if the robot is fixed or floats.
    feet : tuple of Foot
        Parts designed to touch surfaces, such as wheels.
    hand_frame : (3, 3) ndarray
        Axes of the hand's frame, whose orientation is controlled, in the axes of the body that carries the hand.
    nearest : tuple of str
        Joints without a set position whose limits exclude zero; they start at the legal position nearest to zero.
    notes : tuple of str
        Warnings for every run, such as repairs of the robot file.
    """

    name: str
    links: tuple[Link, ...]
    motors: tuple[Drive, ...]
    hand: tuple[str, Array]
    gravity: Array = field(default_factory=lambda: vector(0.0, 0.0, -9.81))
    q0: Array | None = None
    frames: tuple[Frame, ...] = ()
    fixed_shapes: tuple[Shape, ...] = ()
    couplings: tuple[Coupling, ...] = ()
    ties: tuple[Tie, ...] = ()
    base: MobileBase | None = None
    fixed_inertia: Inertia = field(default_factory=lambda: Inertia(0.0))
    feet: tuple[Foot, ...] = ()
    hand_frame: Array = field(default_factory=lambda: np.eye(3))
    nearest: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    fixed_solids: tuple[Shape, ...] = ()

    def holding(self, name: str) -> list[Tie]:
        """Return the ties by which a gripper of the robot can hold the named object; empty without a gripper."""
        return []

    @property
    def hand_axes(self) -> Array:
        """Axes of the hand in the axes of the body that carries it, (3, 3)."""
        return np.asarray(self.attached_axes(self.hand[0]) @ self.hand_frame)

    @property
    def root(self) -> str | None:
        """Name of the root link if it is fixed to the world; None if the robot has no such link."""
        fixed = (frame for frame in self.frames if frame.body is None and not frame.p.any())
        return next((frame.name for frame in fixed if np.array_equal(frame.R, np.eye(3))), None)

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the links that carry a body, in the order of the links."""
        carriers = self.carriers
        return tuple(link.name for link in self.links if link.name not in carriers)

    @property
    def carriers(self) -> frozenset[str]:
        """Names of the links without a body: all rows of a joint except the last."""
        joint = {link.name: link.joint_of_rows or link.joint for link in self.links}
        return frozenset(
            link.parent for link in self.links if link.parent in joint and joint[link.parent] == link.joint_of_rows
        )

    def attach(self, name: str, point: Array) -> tuple[int, Array]:
        """Return the index of a body, given its name or the name of a frame, and a point of the frame in body axes [m].

        Raises
        ------
        ModelError
            If there is no such body or frame, or the frame is fixed to the world.
        """
        index, frame = self._find(name)
        return index, point if frame is None else frame.p + frame.R @ point

    def attached_axes(self, name: str) -> Array:
        """Return the axes of the named body or frame in the body's axes, (3, 3); errors as for :meth:`attach`."""
        _, frame = self._find(name)
        return np.eye(3) if frame is None else frame.R

    def tree_of(self, body: str) -> NDArray[np.bool_]:
        """Return a mask, (n,), of the links in the same tree as ``body``: they have the same ancestor on the world."""
        roots: dict[str, str] = {}
        for link in self.links:
            roots[link.name] = link.name if link.parent is None else roots[link.parent]
        return np.array([root == roots[body] for root in roots.values()])

    def _find(self, name: str) -> tuple[int, Frame | None]:
        names, carriers = [link.name for link in self.links], self.carriers
        bodies = [name for name in names if name not in carriers]
        if name in bodies:
            return names.index(name), None
        frame = next((frame for frame in self.frames if frame.name == name), None)
        if frame is None:
            known = [*bodies, *(frame.name for frame in self.frames if frame.body is not None)]
            near = difflib.get_close_matches(name[:100], known, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            fixed = f"; frames: {', '.join(known[len(bodies) :])}" if len(known) > len(bodies) else ""
            raise ModelError(f"no body {name!r}{hint}; bodies: {', '.join(bodies)}{fixed}")
        if frame.body is None:
            raise ModelError(f"{name!r} is fixed to the world and does not move; bodies: {', '.join(bodies)}")
        return names.index(frame.body), frame

    @property
    def initial(self) -> Array:
        """Initial configuration, (nq,)."""
        return self.configuration({}) if self.q0 is None else np.asarray(self.q0, dtype=np.float64)

    def configuration(self, positions: Mapping[str, float]) -> Array:
        """Return coordinates [rad or m], (nq,), from values by joint.

        Followers follow their leaders. Other joints start at the position nearest to zero at which they and their
        followers are within their limits; joints with several rates are neutral.
        """
        leads = {coupling.joint: coupling for coupling in self.couplings if coupling.joint not in positions}
        q = np.array([value for link in self.links for value in link.row.neutral])
        limits = {link.joint: (link.lower, link.upper) for link in self.links}

        def chain(joint: str) -> list[Coupling]:
            couplings: list[Coupling] = []
            # A cycle of couplings determines no position; compilation rejects it.
            while joint in leads and len(couplings) <= len(leads):
                couplings.append(leads[joint])
                joint = couplings[-1].leader
            return couplings

        def follow(couplings: Sequence[Coupling], value: float) -> float:
            for coupling in reversed(couplings):
                value = coupling.ratio * value + coupling.offset
            return value

        chains = {joint: chain(joint) for joint in leads}
        for joint, couplings in chains.items():
            leader, offset = couplings[-1].leader, follow(couplings, 0.0)
            ratio = follow(couplings, 1.0) - offset
            if ratio and joint in limits and leader in limits:
                ends = sorted((limit - offset) / ratio for limit in limits[joint])
                low, high = limits[leader]
                limits[leader] = max(low, ends[0]), min(high, ends[1])
        for joint, k in zip(self.joint_names, self.position_index, strict=True):
            if joint in positions or joint in leads or np.isfinite(limits[joint]).any():
                couplings = chains.get(joint, [])
                leader = couplings[-1].leader if couplings else joint
                low, high = limits.get(leader, (0.0, 0.0))
                q[k] = follow(couplings, float(positions.get(leader, min(max(0.0, low), high))))
        return q

    @cached_property
    def nq(self) -> int:
        """Number of coordinates: one for each angle or distance, four for a ball joint."""
        return sum(len(link.row.neutral) for link in self.links)

    @cached_property
    def position_index(self) -> tuple[int, ...]:
        """Index in q at which the coordinates of each link begin."""
        index, first, beyond = [], 0, 0
        for link in self.links:
            if link.row.neutral:
                first, beyond = beyond, beyond + len(link.row.neutral)
            index.append(first + link.row.offset)
        return tuple(index)

    @property
    def position_names(self) -> tuple[str, ...]:
        """Names of the coordinates, in the order of q."""
        return tuple(name for link in self.links for name in link.coordinates)

    def with_motors_mounted(self) -> Robot:
        """Return the robot with massless motors: their masses are part of the links on which they are mounted."""
        links = {link.joint: link for link in self.links}
        inertia = {link.name: link.inertia for link in self.links}
        for motor in self.motors:
            link = links.get(motor.joint)
            if motor.mass > 0.0 and link is not None and link.parent in inertia:
                point = link.p_PJ if motor.mass_point is None else motor.mass_point
                inertia[link.parent] = Inertia.merged((inertia[link.parent], Inertia(motor.mass, point)))
        return replace(
            self,
            links=tuple(replace(link, inertia=inertia[link.name]) for link in self.links),
            motors=tuple(replace(motor, mass=0.0, mass_point=None) for motor in self.motors),
        )

    @property
    def circuits(self) -> int:
        """Number of motors with a circuit, whose current is a state."""
        return sum(isinstance(motor, Motor) for motor in self.motors)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, one for each rate, in the order of v."""
        return tuple(link.joint for link in self.links)
