"""Bodies, joints, motors, surfaces and contacts as plain frozen data in SI units.

A :class:`Robot` is a tree of :class:`Link`; each link is one joint and the body it carries. Frames: the body's frame B
moves with the joint; at q = 0 it is the joint frame J, placed in the parent's body frame by ``R_PJ`` and ``p_PJ``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import ModelError

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
    def solid_cylinder(cls, mass: float, radius: float, length: float) -> Inertia:
        """Cylinder along +z from the frame's origin: I_x = I_y = m (3 r² + l²)/12, I_z = m r²/2."""
        side = mass * (3.0 * radius**2 + length**2) / 12.0
        return cls(mass, vector(0.0, 0.0, 0.5 * length), np.diag([side, side, 0.5 * mass * radius**2]))

    def check(self, name: str) -> None:
        """Raise :class:`ModelError` unless a real body can have these mass properties."""
        if not (np.isfinite(self.mass) and self.mass >= 0.0):
            raise ModelError(f"{name}: mass {self.mass} kg; a mass must be zero or positive")
        if not np.allclose(self.tensor, self.tensor.T, rtol=0, atol=1e-12 * max(1.0, float(abs(self.tensor).max()))):
            raise ModelError(f"{name}: the inertia tensor is not symmetric")
        moments = np.linalg.eigvalsh(self.tensor)
        slack = 1e-9 * max(float(moments[-1]), 1e-300)
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

    @property
    def units(self) -> tuple[str, str, str, str]:
        """Units of position, velocity, acceleration and force of the joint."""
        return ("m", "m/s", "m/s²", "N") if self.kind == "prismatic" else ("rad", "rad/s", "rad/s²", "N m")


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
    """

    joint: str
    torque_constant: float
    resistance: float
    inductance: float
    rotor_inertia: float
    gear_ratio: float
    gear_damping: float = 0.0
    voltage_limit: float = np.inf


@dataclass(frozen=True)
class Quadric:
    """A surface C(r) = r·Q r/2 + b·r + c = 0; C > 0 is outside, where ∇C points."""

    Q: Array
    b: Array
    c: float

    def gap(self, position: Array) -> float:
        """Signed distance [m] of a point along the normal; exact for plane, sphere and cylinder."""
        from dynsim.kernels.contact import surface_distance

        gradient = self.Q @ position + self.b
        slope = float(np.linalg.norm(gradient))
        normal = gradient / slope
        value = float(0.5 * position @ self.Q @ position + self.b @ position + self.c)
        return float(surface_distance(value, slope, float(normal @ self.Q @ normal)))


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
class Robot:
    """A tree of links with its motors.

    ``hand`` is the controlled point (body name, point in its frame [m]); ``q0`` the initial configuration [rad or m],
    zero unless given.
    """

    name: str
    links: tuple[Link, ...]
    motors: tuple[Motor, ...]
    hand: tuple[str, Array]
    gravity: Array = field(default_factory=lambda: vector(0.0, 0.0, -9.81))
    q0: Array | None = None

    @property
    def initial(self) -> Array:
        """Initial configuration, (n,)."""
        return np.zeros(len(self.links)) if self.q0 is None else np.asarray(self.q0, dtype=np.float64)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in the order of q."""
        return tuple(link.joint for link in self.links)
