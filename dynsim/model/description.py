"""Bodies, joints, frames, contacts, couplings, ties, loads and the robot as plain frozen data in SI units.

Drives: :mod:`dynsim.model.drives`, surfaces: :mod:`dynsim.model.surfaces`.

A :class:`Robot` is a tree of :class:`Link`; each link is one joint and the body it carries. Frames: the body's frame B
moves with the joint; at q = 0 it is the joint frame J, placed in the parent's body frame by ``R_PJ`` and ``p_PJ``.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import ModelError
from dynsim.model.drives import Drive, Motor
from dynsim.model.joints import Row, rows
from dynsim.model.mobile_base import MobileBase
from dynsim.model.surfaces import Quadric as Quadric
from dynsim.model.surfaces import Surface
from dynsim.record.scene import Shape

Array = NDArray[np.float64]
WORLD = "world"


def vector(x: float, y: float, z: float) -> Array:
    """A 3-vector."""
    return np.array([x, y, z], dtype=np.float64)


@dataclass(frozen=True)
class Inertia:
    """Mass properties of a rigid body.

    Attributes
    ----------
    mass : float [kg]
    com : (3,) centre of mass in B [m]
    tensor : (3, 3) inertia about the centre of mass, axes of B [kg m²]
    """

    mass: float
    com: Array = field(default_factory=lambda: np.zeros(3))
    tensor: Array = field(default_factory=lambda: np.zeros((3, 3)))

    @classmethod
    def solid_sphere(cls, mass: float, radius: float, center: Array) -> Inertia:
        """Sphere about ``center``: I = 2 m r²/5; a point mass when the radius is zero."""
        return cls(mass, center, np.eye(3) * (0.4 * mass * radius**2))

    @classmethod
    def solid_cylinder(cls, mass: float, radius: float, length: float) -> Inertia:
        """Cylinder along +z from the frame's origin: I_x = I_y = m (3 r² + l²)/12, I_z = m r²/2."""
        side = mass * (3.0 * radius**2 + length**2) / 12.0
        return cls(mass, vector(0.0, 0.0, 0.5 * length), np.diag([side, side, 0.5 * mass * radius**2]))

    def placed(self, R: Array, p: Array) -> Inertia:
        """The same body seen from a frame in which B has rotation R and origin p [m]."""
        tensor = R @ self.tensor @ R.T
        return Inertia(self.mass, p + R @ self.com, 0.5 * (tensor + tensor.T))

    @classmethod
    def merged(cls, parts: Iterable[Inertia]) -> Inertia:
        """Bodies fixed to each other as one, all in one frame: I = Σ I_i + m_i (d_i² 1 − d_i d_iᵀ), d_i = c_i − c."""
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

    def check(self, name: str) -> None:
        """Raise :class:`ModelError` unless a real body can have these mass properties.

        Files have rounded moments, and rotations round them again: what is below 1e-9 of the largest moment, or below
        that of the mass at a micrometre from its centre, counts as zero.
        """
        if not (np.isfinite(self.mass) and self.mass >= 0.0):
            raise ModelError(f"{name}: mass {self.mass} kg; a mass must be zero or positive")
        small = 1e-12 * self.mass
        # Not NaN either.
        if not np.abs(self.tensor - self.tensor.T).max() <= 1e-9 * np.abs(self.tensor).max() + small:
            raise ModelError(f"{name}: the inertia tensor is not symmetric")
        moments = np.linalg.eigvalsh(self.tensor)
        slack = 1e-9 * float(abs(moments).max()) + small
        if moments[0] < -slack or moments[0] + moments[1] < moments[2] - slack:
            raise ModelError(
                f"{name}: principal moments of inertia {moments} kg m² are not those of a body "
                "(each must be positive and no larger than the sum of the other two)"
            )


@dataclass(frozen=True)
class Link:
    """One joint and the body it carries.

    Attributes
    ----------
    name, joint : str
        Names of the body and of its joint.
    parent : str or None
        Name of the parent body, None for the world.
    kind : "revolute", "prismatic", or another row of :func:`dynsim.model.joints.rows`
    axis : (3,) unit joint axis in J (and B)
    R_PJ, p_PJ : (3, 3), (3,) placement of the joint in the parent's frame [m]
    damping : float
        Viscous loss D of the joint [N m s/rad or N s/m].
    friction : of its bearing, against any motion and up to which it holds [N m or N]; under the unilateral law
    lower, upper, velocity_limit, effort_limit : float
        Limits of the joint [rad or m; rad/s or m/s; N m or N]. Nothing enforces them: a run that passes one warns.
    parameter : what else its kind of joint needs
    armature : inertia that only turns with the joint, beside that of its motor [kg m² or kg]
    joint_of_rows : name of the joint with several rows that this is one of, None for a joint of its own
    radius : of a cylinder about the body's axis [m], zero when unknown: deeper than that below a surface, a run warns
    tip : (3,) or None
        Other end of the axis in B [m], the first is the joint; None: the joints that the body carries, and the hand.
    shapes : what the body looks like, in B; empty: a cylinder about its axis, if ``radius`` and ``tip`` are known
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

    @property
    def row(self) -> Row:
        """Its kind.

        Raises
        ------
        ModelError
            There is no such kind.
        """
        if self.kind not in rows():
            raise ModelError(f"{self.joint}: joint kind {self.kind!r}; known: {', '.join(rows())}")
        return rows()[self.kind]

    @property
    def geometry(self) -> tuple[str, str | None, str, Array, Array, Array, float, Array | None]:
        """What says where the body is and how far it reaches, without its mass."""
        return self.name, self.parent, self.kind, self.axis, self.R_PJ, self.p_PJ, self.radius, self.tip

    @property
    def units(self) -> tuple[str, str, str, str]:
        """Units of position, velocity, acceleration and force of the joint."""
        return self.row.units

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates that begin with this row: those of its joint, none for a later row."""
        row = self.row
        return tuple(f"{self.joint_of_rows}.{name}" for name in row.names) or (self.joint,) * len(row.neutral)


def in_rows(link: Link, rows: Sequence[tuple[str, str, Array]]) -> tuple[Link, ...]:
    """A joint of several rows, (suffix, kind, axis) each, the body of ``link`` on the last; the others are massless."""
    made: list[Link] = []
    for suffix, kind, axis in rows:
        last, first = len(made) == len(rows) - 1, not made
        made.append(
            replace(
                link,
                name=link.name if last else f"{link.name}.{suffix}",
                joint=f"{link.joint}.{suffix}",
                parent=link.parent if first else made[-1].name,
                kind=kind,
                axis=np.asarray(axis, dtype=np.float64),
                inertia=link.inertia if last else Inertia(0.0),
                R_PJ=link.R_PJ if first else np.eye(3),
                p_PJ=link.p_PJ if first else np.zeros(3),
                radius=link.radius if last else 0.0,
                tip=link.tip if last else None,
                shapes=link.shapes if last else (),
                joint_of_rows=link.joint,
            )
        )
    return tuple(made)


@dataclass(frozen=True)
class Frame:
    """A named frame fixed on a body, such as a tool flange; its rotation and origin in the body's frame.

    ``body`` is None for what is fixed to the world: it has a name, but nothing that moves can be attached to it.
    """

    name: str
    body: str | None
    R: Array
    p: Array


@dataclass(frozen=True)
class Contact:
    """A point, sphere or capsule of a body, and the surface that it can touch.

    Attributes
    ----------
    point : (3,) in the body's frame [m]: the point, the centre of the sphere, or one end of the capsule's axis
    friction : kinetic coefficient μ
    slip_smoothing : v_s [m/s] of the direction v_t/√(v_t² + v_s²); bilateral law
    pulling_friction : "signed" (f_t = μ f_n as [WM] prints it) or "dissipative" (f_t = μ |f_n|); bilateral law
    static_friction : coefficient μ_s that holds at rest; None: μ. This and what follows: unilateral law
    stribeck : speed [m/s] of μ + (μ_s − μ) exp(−(v/v_s)²); 0: μ from the first slip on
    viscous_friction : what each m/s adds to the coefficient [s/m]
    restitution : share of the normal speed that is left after an impact, with its sign turned
    grip_axis : (3,) in the body's frame, or None: friction along it is ``grip`` times that across; time stepping only
    stiffness, damping : of body and surface along the normal [N/m, N s/m], 0: rigid; time stepping only
    radius : of sphere or capsule [m]
    tip : (3,) or None
        The other end of a capsule's axis, in the same frame [m]. Where the surface bends away from the free side the
        nearest point of the axis touches, elsewhere ``point``.
    left_out : no joint moves it along the normal in any posture, so that it never touches
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

    @property
    def friction_at_rest(self) -> float:
        """Static coefficient μ_s, by default the kinetic one."""
        return self.friction if self.static_friction is None else self.static_friction

    @property
    def geometry(self) -> tuple[str, str, Array, Surface, float, Array | None]:
        """What says where it is and what it can touch, without its law."""
        return self.name, self.body, self.point, self.surface, self.radius, self.tip


@dataclass(frozen=True)
class Foot:
    """A sphere of a body that can touch one of the scenario's surfaces, whatever contact points that declares.

    On a body that spins about its own centre it is a wheel: the point that touches is that of the sphere, so it rolls.

    Attributes
    ----------
    point : (3,) centre of the sphere in the body's frame [m]; radius [m]
    surface : name of the surface in the scenario
    grip_axis : (3,) in the body's frame, or None: no friction along it, as of a wheel without mass
    """

    name: str
    body: str
    point: Array
    radius: float
    surface: str
    grip_axis: Array | None = None


@dataclass(frozen=True)
class Coupling:
    """A joint that follows another one, q = ratio q_leader + offset: a gear, a belt, a URDF mimic joint.

    It is a constraint without losses: it holds exactly, and takes whatever force that needs.
    """

    joint: str
    leader: str
    ratio: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Tie:
    """One direction in which two bodies hold each other by a spring, a damper and a bound; time stepping only.

    The force on ``body``, along the axis or about it, and its opposite on ``other`` is f = −k (x − x_0) − c dx/dt
    within its bound, x = axis · (point − other point), or the part along the axis of the rotation of ``body`` against
    ``other``. Beyond the bound x_0 moves. Bodies may be of different trees; ``other`` may be the world.

    Attributes
    ----------
    point, other_point : (3,) in the frames of ``body`` and ``other`` [m]
    axis : (3,) in the frame of ``body``
    stiffness, damping : k, c [N/m, N s/m; N m/rad, N m s/rad]
    bound : of the force [N or N m]
    turns : about the axis, not along it
    pushes : one-sided: it only pushes ``body`` along the axis, without a bound
    rest : x_0 [m or rad]; NaN: x when the tie begins
    attitude : (3, 3) of ``other`` in the axes of ``body`` where a torsion whose rest is a number is not turned
    holds : from the start on
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
    """A force and a torque from outside on a point of a body, as cubic polynomials of time.

    Attributes
    ----------
    body : name of a link
    point : (3,) where the force acts, in the link's frame [m]
    in_body : whether the components are in the axes of the link, else of the world
    knots : (K + 1,) increasing times [s]
    coefficients : (K, 6, 4) ascending powers of t - knots[k], force x, y, z [N], then torque x, y, z [N m]
    hold : whether the values at the first and the last knot go on beyond them, else it is zero there
    """

    name: str
    body: str
    point: Array
    in_body: bool
    knots: Array
    coefficients: Array
    hold: bool

    def components(self, t: Array) -> Array:
        """Force and torque at times t [s], (T,) → (T, 6) [N, N m]."""
        t = np.asarray(t, dtype=np.float64)
        inside = np.clip(t, self.knots[0], self.knots[-1])
        segment = np.minimum(np.searchsorted(self.knots, inside, side="right") - 1, len(self.coefficients) - 1)
        powers = (inside - self.knots[segment])[:, None] ** np.arange(4)
        values = np.einsum("tcp,tp->tc", self.coefficients[segment], powers)
        return values if self.hold else np.where((inside == t)[:, None], values, 0.0)


@dataclass(frozen=True)
class Robot:
    """A tree of links with its motors.

    ``hand``: the controlled point (body name, point in its frame [m]); ``hand_frame``: (3, 3) axes, in those of that
    body, of the frame that was named for the hand, whose orientation is that of the frame; ``q0``: initial
    configuration [rad or m], zero unless given; ``frames``: further names to attach points to; ``fixed_shapes``,
    ``fixed_inertia``: what stands still in the world; ``couplings`` of joints to joints; ``ties`` of bodies to bodies;
    ``base``: what it drives on, None: it stands fixed or floats; ``feet``: what of it is made to touch, such as wheels.
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

    def holding(self, name: str) -> list[Tie]:
        """Ties by which a gripper of the robot can hold the object of that name: none."""
        return []

    @property
    def hand_axes(self) -> Array:
        """Axes of the hand in those of the body that carries it, (3, 3)."""
        return np.asarray(self.attached_axes(self.hand[0]) @ self.hand_frame)

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the links that carry a body, in their order."""
        carriers = self.carriers
        return tuple(link.name for link in self.links if link.name not in carriers)

    @property
    def carriers(self) -> frozenset[str]:
        """Names of the links that carry no body: of a joint with several rows all but the last."""
        joint = {link.name: link.joint_of_rows or link.joint for link in self.links}
        return frozenset(
            link.parent for link in self.links if link.parent in joint and joint[link.parent] == link.joint_of_rows
        )

    def attach(self, name: str, point: Array) -> tuple[int, Array]:
        """Index of the body that has a name, or a frame of that name, and a point of that frame in the body's [m].

        Raises
        ------
        ModelError
            No such body or frame, or a frame that is fixed to the world.
        """
        index, frame = self._find(name)
        return index, point if frame is None else frame.p + frame.R @ point

    def attached_axes(self, name: str) -> Array:
        """Axes of the body or frame of that name in the body's, (3, 3); raises what :meth:`attach` does."""
        _, frame = self._find(name)
        return np.eye(3) if frame is None else frame.R

    def tree_of(self, body: str) -> NDArray[np.bool_]:
        """Which links belong to the tree of a link, (n,): those with the same ancestor that the world carries."""
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
        """Coordinates [rad or m], (nq,): as given by joint, followers where their leaders have them, others neutral."""
        leads = {coupling.joint: coupling for coupling in self.couplings if coupling.joint not in positions}
        q = np.array([value for link in self.links for value in link.row.neutral])

        def position(joint: str) -> float:
            chain: list[Coupling] = []
            # A cycle of couplings has no position; the compilation refuses it.
            while joint in leads and len(chain) <= len(leads):
                chain.append(leads[joint])
                joint = chain[-1].leader
            value = float(positions.get(joint, 0.0))
            for coupling in reversed(chain):
                value = coupling.ratio * value + coupling.offset
            return value

        for joint, k in zip(self.joint_names, self.position_index, strict=True):
            if joint in positions or joint in leads:
                q[k] = position(joint)
        return q

    @property
    def nq(self) -> int:
        """Number of coordinates: one for each angle or distance, four for a ball joint."""
        return sum(len(link.row.neutral) for link in self.links)

    @property
    def position_index(self) -> tuple[int, ...]:
        """For each link where its own coordinates begin in q."""
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
        """The robot whose motors weigh nothing any more: their masses are part of the links that they sit on."""
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
        """How many motors have a circuit, whose current is a state."""
        return sum(isinstance(motor, Motor) for motor in self.motors)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, one for each rate, in the order of v."""
        return tuple(link.joint for link in self.links)
