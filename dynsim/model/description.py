"""Bodies, joints, motors, surfaces and contacts as plain frozen data in SI units.

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

Array = NDArray[np.float64]
WORLD = "world"


def vector(x: float, y: float, z: float) -> Array:
    """A 3-vector."""
    return np.array([x, y, z], dtype=np.float64)


def listed(names: Sequence[str]) -> str:
    """Names for a line of text: all of a few, the first and the last of many."""
    return ", ".join(names) if len(names) <= 4 else f"{names[0]} … {names[-1]} ({len(names)})"


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
        if not np.allclose(self.tensor, self.tensor.T, rtol=0, atol=1e-9 * abs(self.tensor).max() + small):
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
    kind : "revolute" or "prismatic"
    axis : (3,) unit joint axis in J (and B)
    R_PJ, p_PJ : (3, 3), (3,) placement of the joint in the parent's frame [m]
    damping : float
        Viscous loss D of the joint [N m s/rad or N s/m].
    lower, upper, velocity_limit, effort_limit : float
        Limits of the joint [rad or m; rad/s or m/s; N m or N]. Nothing enforces them: a run that passes one warns.
    radius : of a cylinder about the body's axis [m], zero when unknown: deeper than that below a surface, a run warns
    tip : (3,) or None
        Other end of the axis in B [m], the first is the joint; None: the joints that the body carries, and the hand.
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

    @property
    def units(self) -> tuple[str, str, str, str]:
        """Units of position, velocity, acceleration and force of the joint."""
        return ("m", "m/s", "m/s²", "N") if self.kind == "prismatic" else ("rad", "rad/s", "rad/s²", "N m")


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
class Motor:
    """A DC motor on a joint ([WM] eqs 16–25).

    Attributes
    ----------
    joint : str
    torque_constant : K [N m/A = V s/rad]
    resistance : R [Ω]; inductance : L [H]; rotor_inertia : I_m [kg m²]
    gear_ratio : k; gear_damping : d_m on the motor side [N m s/rad]
    voltage_limit : [V], inf for none
    mass : [kg] of a point on the link before the joint; on the base it moves nothing
    mass_point : (3,) or None
        Where, in that link's frame [m]; None: at the joint.
    """

    joint: str
    torque_constant: float
    resistance: float
    inductance: float
    rotor_inertia: float
    gear_ratio: float
    gear_damping: float = 0.0
    voltage_limit: float = np.inf
    mass: float = 0.0
    mass_point: Array | None = None


@dataclass(frozen=True)
class Quadric:
    """A surface C(r) = r·Q r/2 + b·r + c = 0; C > 0 is outside, where ∇C points."""

    Q: Array
    b: Array
    c: float

    def gap(self, position: Array) -> float:
        """Signed distance [m] of a point along the normal; exact for plane, sphere and cylinder."""
        from dynsim.kernels.constraint.surface import surface_distance

        gradient = self.Q @ position + self.b
        slope = float(np.linalg.norm(gradient))
        normal = gradient / slope
        value = float(0.5 * position @ self.Q @ position + self.b @ position + self.c)
        return float(surface_distance(value, slope, float(normal @ self.Q @ normal)))

    def gaps(self, positions: Array) -> Array:
        """:meth:`gap` of many points, (T, 3) → (T,) [m]; where ∇C vanishes, as in the middle of a sphere, too."""
        if not self.Q.any():
            return np.asarray((positions @ self.b + self.c) / np.linalg.norm(self.b))
        Qr = positions @ self.Q
        gradient = Qr + self.b
        value = np.sum((0.5 * Qr + self.b) * positions, axis=1) + self.c
        square = np.sum(gradient * gradient, axis=1)
        steepest = float(np.abs(np.linalg.eigvalsh(self.Q)).max())
        bent = np.sum((gradient @ self.Q) * gradient, axis=1)
        curvature = np.where(square > 0.0, bent / np.where(square > 0.0, square, 1.0), -steepest * np.sign(value))
        inner = square - 2.0 * curvature * value
        slope = np.sqrt(square)
        return np.asarray(
            np.where(
                inner > 0.0,
                2.0 * value / (slope + np.sqrt(np.maximum(inner, 1e-300))),
                value / np.maximum(slope, 1e-300),
            )
        )


@dataclass(frozen=True)
class Contact:
    """A body-fixed point held to a surface.

    Attributes
    ----------
    point : (3,) in the body's frame [m]
    friction : kinetic coefficient μ
    slip_smoothing : v_s [m/s] of the direction v_t/√(v_t² + v_s²)
    pulling_friction : "signed" (f_t = μ f_n as [WM] prints it) or "dissipative" (f_t = μ |f_n|)
    """

    name: str
    body: str
    point: Array
    surface: Quadric
    surface_name: str = "floor"
    friction: float = 0.0
    slip_smoothing: float = 1e-3
    pulling_friction: str = "dissipative"


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
class Robot:
    """A tree of links with its motors.

    ``hand`` is the controlled point (body name, point in its frame [m]); ``q0`` the initial configuration [rad or m],
    zero unless given; ``frames`` further names to attach points to; ``couplings`` of joints to joints.
    """

    name: str
    links: tuple[Link, ...]
    motors: tuple[Motor, ...]
    hand: tuple[str, Array]
    gravity: Array = field(default_factory=lambda: vector(0.0, 0.0, -9.81))
    q0: Array | None = None
    frames: tuple[Frame, ...] = ()
    couplings: tuple[Coupling, ...] = ()

    def attach(self, name: str, point: Array) -> tuple[int, Array]:
        """Index of the body that has a name, or a frame of that name, and a point of that frame in the body's [m].

        Raises
        ------
        ModelError
            No such body or frame, or a frame that is fixed to the world.
        """
        bodies = [link.name for link in self.links]
        if name in bodies:
            return bodies.index(name), point
        frame = next((frame for frame in self.frames if frame.name == name), None)
        if frame is None:
            names = [*bodies, *(frame.name for frame in self.frames if frame.body is not None)]
            near = difflib.get_close_matches(name[:100], names, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            fixed = f"; frames: {', '.join(names[len(bodies) :])}" if len(names) > len(bodies) else ""
            raise ModelError(f"no body {name!r}{hint}; bodies: {', '.join(bodies)}{fixed}")
        if frame.body is None:
            raise ModelError(f"{name!r} is fixed to the world and does not move; bodies: {', '.join(bodies)}")
        return bodies.index(frame.body), frame.p + frame.R @ point

    @property
    def initial(self) -> Array:
        """Initial configuration, (n,)."""
        return self.configuration({}) if self.q0 is None else np.asarray(self.q0, dtype=np.float64)

    def configuration(self, given: Mapping[str, float]) -> Array:
        """Positions of all joints [rad or m], (n,): as given, followers where their leaders have them, others zero."""
        leads = {coupling.joint: coupling for coupling in self.couplings if coupling.joint not in given}

        def position(joint: str) -> float:
            chain: list[Coupling] = []
            # A cycle of couplings has no position; the compilation refuses it.
            while joint in leads and len(chain) <= len(leads):
                chain.append(leads[joint])
                joint = chain[-1].leader
            q = float(given.get(joint, 0.0))
            for coupling in reversed(chain):
                q = coupling.ratio * q + coupling.offset
            return q

        return np.array([position(joint) for joint in self.joint_names])

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
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in the order of q."""
        return tuple(link.joint for link in self.links)
