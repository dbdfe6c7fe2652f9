"""Drives of joints as plain frozen data in SI units: DC motors, servos, ideal torque sources."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SMOOTHING = 1e-2
"""Default of the speed below which smoothed gear friction decreases to zero [rad/s]."""


@dataclass(frozen=True)
class Motor:
    """A DC motor on a joint ([WM] eqs 16–25).

    Attributes
    ----------
    joint : str
    torque_constant : K [N m/A = V s/rad]
    resistance : R [Ω]; inductance : L [H]; rotor_inertia : I_m [kg m²]
    gear_ratio : k; gear_damping : d_m on the motor side [N m s/rad]
    dry_friction : of the gear, at the joint [N m or N]: it holds the joint at rest; under the unilateral law
    voltage_limit : [V], inf for none
    current_limit : [A] that its driver keeps, inf for none
    nominal_current : [A], continuous rating; nominal_torque : at the joint [N m or N]; inf where not known
    mass : [kg] of a point on the link before the joint; without effect where that is fixed to the world
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
    current_limit: float = np.inf
    nominal_current: float = np.inf
    nominal_torque: float = np.inf
    dry_friction: float = 0.0

    @property
    def greatest_current(self) -> float:
        """The limit of current [A], as of a servo."""
        return self.current_limit

    @property
    def joint_constant(self) -> float:
        """K_m = K k [N m/A = V s/rad] at the joint."""
        return self.torque_constant * self.gear_ratio

    @property
    def armature(self) -> float:
        """J_m = I_m k² [kg m², or kg at a prismatic joint]."""
        return self.rotor_inertia * self.gear_ratio**2

    @property
    def reflected_damping(self) -> float:
        """D_m = d_m k² [N m s/rad, or N s/m]."""
        return self.gear_damping * self.gear_ratio**2


@dataclass(frozen=True)
class Servo:
    """A position servo on a revolute joint, everything at its output shaft; its law: dynsim.dynamics.drive.servo.

    Attributes
    ----------
    joint : str
    torque_constant : K_m [N m/A = V s/rad]; resistance : R [Ω]
    k_p, k_d : gains of the position loop [V/rad, V s/rad]
    k_v : gain of the velocity loop [V s/rad]
    velocity_mode : the loop follows the rate of the reference, not its position
    armature : J_m [kg m²]; reflected_damping : D_m [N m s/rad]
    coulomb_friction : τ_c [N m]; coulomb_speed : v_s [rad/s], below which it fades
        None: under the unilateral law it does not, and holds at rest; else below SMOOTHING
    voltage_limit, current_limit : [V], [A]; torque_limit : of the current, K_m i [N m]; inf for none
    nominal_current, nominal_torque : as of a :class:`Motor`
    free_drag : viscous drag of the gear while the servo is off [N m s/rad]
    mass, mass_point : as of a :class:`Motor`
    """

    joint: str
    torque_constant: float
    resistance: float
    k_p: float
    k_d: float = 0.0
    k_v: float = 0.0
    velocity_mode: bool = False
    armature: float = 0.0
    reflected_damping: float = 0.0
    coulomb_friction: float = 0.0
    coulomb_speed: float | None = None
    voltage_limit: float = np.inf
    current_limit: float = np.inf
    torque_limit: float = np.inf
    free_drag: float = 0.0
    mass: float = 0.0
    mass_point: Array | None = None
    nominal_current: float = np.inf
    nominal_torque: float = np.inf

    @property
    def joint_constant(self) -> float:
        """K_m [N m/A = V s/rad] at the joint."""
        return self.torque_constant

    @property
    def dry_friction(self) -> float:
        """Friction of the gear that is not smoothed where the method can do without [N m]."""
        return self.coulomb_friction if self.coulomb_speed is None else 0.0

    @property
    def greatest_current(self) -> float:
        """The lower of the limits of current and torque [A]."""
        return min(self.current_limit, self.torque_limit / self.torque_constant)

    @property
    def stall_torque(self) -> float:
        """Of the motor at rest, at the limit of its voltage or current, without the friction of the gear [N m]."""
        return self.torque_constant * min(self.voltage_limit / self.resistance, self.greatest_current)


@dataclass(frozen=True)
class TorqueSource:
    """A torque on a joint that is its own reference, within ``torque_limit`` [N m, or N]; the rest as of a motor."""

    joint: str
    torque_limit: float = np.inf
    mass: float = 0.0
    mass_point: Array | None = None
    nominal_torque: float = np.inf


Drive = Motor | Servo | TorqueSource
