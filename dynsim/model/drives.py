"""Drives of joints as plain frozen data in SI units: DC motors, servos, ideal torque sources."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from dynsim.config.base import NonNegative, Positive, StrictConfig, Vector3, default, error_at
from dynsim.dynamics import tables as ka
from dynsim.dynamics.drive import law as law

Array = NDArray[np.float64]
SMOOTHING = 1e-2
"""Default speed below which smoothed gear friction decreases to zero [rad/s]."""


@dataclass(frozen=True)
class Motor:
    """DC motor on a joint ([WM] eqs 16–25).

    Attributes
    ----------
    joint : str
        Name of the joint.
    torque_constant : float
        Torque constant K [N m/A = V s/rad].
    resistance, inductance, rotor_inertia : float
        Resistance R [Ω], inductance L [H], rotor inertia I_m [kg m²].
    gear_ratio, gear_damping : float
        Gear ratio k, and gear damping d_m on the motor side [N m s/rad].
    voltage_limit : float
        Maximum voltage [V]; infinite if unlimited.
    mass : float
        Point mass on the link before the joint [kg]; it has no effect if that link is fixed to the world.
    mass_point : (3,) ndarray or None
        Position of the mass in that link's frame [m]; None: at the joint.
    current_limit : float
        Maximum current of the motor's driver [A]; infinite if unlimited.
    nominal_current, nominal_torque : float
        Continuous ratings of the current [A] and of the torque or force at the joint [N m or N]; infinite if unknown.
    dry_friction : float
        Dry friction of the gear, referred to the joint, which can also hold the joint at rest [N m or N]; unilateral
        law only.
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
        """Current limit [A]; same interface as for a servo."""
        return self.current_limit

    @property
    def stall_torque(self) -> float:
        """Torque or force at the joint at rest, at the voltage or current limit of the motor [N m or N]."""
        return self.joint_constant * min(self.voltage_limit / self.resistance, self.greatest_current)

    @property
    def joint_constant(self) -> float:
        """Torque constant at the joint, K_m = K k [N m/A = V s/rad]."""
        return self.torque_constant * self.gear_ratio

    @property
    def armature(self) -> float:
        """Rotor inertia at the joint, J_m = I_m k² [kg m², or kg at a prismatic joint]."""
        return self.rotor_inertia * self.gear_ratio**2

    @property
    def reflected_damping(self) -> float:
        """Gear damping at the joint, D_m = d_m k² [N m s/rad, or N s/m]."""
        return self.gear_damping * self.gear_ratio**2


@dataclass(frozen=True)
class Servo:
    """Position servo on a revolute joint; all values refer to its output shaft. See dynsim.dynamics.drive.law.

    Attributes
    ----------
    joint : str
        Name of the joint.
    torque_constant, resistance : float
        Torque constant K_m [N m/A = V s/rad] and resistance R [Ω].
    k_p, k_d : float
        Gains of the position loop [V/rad, V s/rad].
    k_v : float
        Gain of the velocity loop [V s/rad].
    velocity_mode : bool
        True if the loop follows the rate of the reference, not its position.
    armature, reflected_damping : float
        Armature J_m [kg m²] and reflected damping D_m [N m s/rad].
    coulomb_friction : float
        Coulomb friction τ_c of the gear [N m].
    coulomb_speed : float or None
        v_s, speed below which the friction decreases to zero [rad/s]; None: SMOOTHING, or, under the unilateral law,
        dry friction that can hold the joint at rest.
    voltage_limit, current_limit, torque_limit : float
        Limits of voltage [V], of current [A], and of current expressed as torque K_m i [N m]; infinite if unlimited.
    nominal_current, nominal_torque, mass, mass_point
        As for :class:`Motor`.
    free_drag : float
        Viscous drag of the gear while the servo is off [N m s/rad].
    sheet : str
        Name of its data sheet in :mod:`dynsim.config.data_sheets`; empty if its values are not from there.
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
    sheet: str = ""

    @property
    def joint_constant(self) -> float:
        """Torque constant K_m at the joint [N m/A = V s/rad]."""
        return self.torque_constant

    @property
    def dry_friction(self) -> float:
        """Gear friction [N m] that is not smoothed, provided that the method supports dry friction."""
        return self.coulomb_friction if self.coulomb_speed is None else 0.0

    @property
    def greatest_current(self) -> float:
        """Smaller of the current limit and the torque limit, expressed as a current [A]."""
        return min(self.current_limit, self.torque_limit / self.torque_constant)

    @property
    def stall_torque(self) -> float:
        """Torque of the motor at rest, at its voltage or current limit, without gear friction [N m]."""
        return self.torque_constant * min(self.voltage_limit / self.resistance, self.greatest_current)


@dataclass(frozen=True)
class TorqueSource:
    """Ideal torque source whose reference is its torque, up to ``torque_limit`` [N m or N]; see :class:`Motor`."""

    joint: str
    torque_limit: float = np.inf
    mass: float = 0.0
    mass_point: Array | None = None
    nominal_torque: float = np.inf


Drive = Motor | Servo | TorqueSource


def continuous_torque(motor: Drive) -> float:
    """Return the continuous torque or force at the joint [N m or N], limited by rating and nominal current."""
    if isinstance(motor, TorqueSource):
        return motor.nominal_torque
    return min(motor.nominal_torque, motor.joint_constant * motor.nominal_current)


# Keys common to all motors of a scenario, and keys of a geared brushed DC motor ([WM] eqs 16–25).


def limit(value: float | None) -> float:
    """Return the value of an optional limit; None becomes infinity."""
    return np.inf if value is None else value


class DriveParameters(StrictConfig):
    """Parameters of all kinds of motor: mass and continuous rating."""

    mass_kg: NonNegative = default(0.0, "mass of motor and gear, a point mass on the link before the joint")
    mass_point_m: Vector3 | None = default(
        None, "position of the mass in that link's frame; default: at the motor's joint"
    )

    nominal_torque_N_m: Positive | None = default(
        None, "continuous torque rating of motor and gear, at the joint; N at a prismatic joint"
    )

    @model_validator(mode="after")
    def _check_mass(self) -> Self:
        if self.mass_point_m is not None and self.mass_kg == 0.0:
            raise error_at("mass_point_m", "has no effect without mass_kg")
        return self

    @property
    def mass_point(self) -> NDArray[np.float64] | None:
        """Position of the mass, (3,) [m]; None: at the joint."""
        return None if self.mass_point_m is None else np.array(self.mass_point_m)

    @property
    def nominal_torque(self) -> float:
        """Continuous rating [N m or N], infinite if unknown."""
        return limit(self.nominal_torque_N_m)


class MotorParameters(DriveParameters):
    """DC motor with L di/dt = u − R i − K k v and joint torque K k i − I_m k² v̇ − d_m k² v."""

    torque_constant_N_m_per_A: Positive
    resistance_ohm: Positive
    inductance_H: Positive
    rotor_inertia_kg_m2: NonNegative
    gear_ratio: Positive = Field(description="motor turns per joint turn; at a prismatic joint rad of the motor per m")
    gear_damping_N_m_s_per_rad: NonNegative = default(0.0, "viscous, on the motor side")
    coulomb_friction_N_m: NonNegative = default(
        0.0, "dry friction of the gear, at the joint; N at a prismatic joint; unilateral law"
    )
    voltage_limit_V: Positive | None = None
    nominal_current_A: Positive | None = default(None, "continuous rating: a run that exceeds it warns")
    peak_current_A: Positive | None = default(None, "current limit of its driver")

    @model_validator(mode="after")
    def _check_currents(self) -> Self:
        if limit(self.peak_current_A) < (self.nominal_current_A or 0.0):
            raise error_at("peak_current_A", f"is less than nominal_current_A = {self.nominal_current_A:g}")
        return self

    @field_validator("inductance_H", mode="before")
    @classmethod
    def _not_zero(cls, value: Any) -> Any:
        """Reject L = 0, which textbooks often assume, with a hint."""
        if value == 0:
            raise ValueError("must be positive; to neglect it, use 1e-6 with integrator.method: auto or radau5")
        return value

    def motor(self, joint: str) -> Motor:
        """Return the motor on the named joint."""
        return Motor(
            joint=joint,
            torque_constant=self.torque_constant_N_m_per_A,
            resistance=self.resistance_ohm,
            inductance=self.inductance_H,
            rotor_inertia=self.rotor_inertia_kg_m2,
            gear_ratio=self.gear_ratio,
            gear_damping=self.gear_damping_N_m_s_per_rad,
            dry_friction=self.coulomb_friction_N_m,
            voltage_limit=limit(self.voltage_limit_V),
            mass=self.mass_kg,
            mass_point=self.mass_point,
            current_limit=limit(self.peak_current_A),
            nominal_current=limit(self.nominal_current_A),
            nominal_torque=self.nominal_torque,
        )


# Data-sheet parameters of a servo in position or velocity mode, all at the output shaft.


# Gains that each mode uses; the first must be positive.
GAINS = {"position": ("k_p_V_per_rad", "k_d_V_s_per_rad"), "velocity": ("k_v_V_s_per_rad",)}


class ServoParameters(DriveParameters):
    """Servo parameters at the output shaft: K_m = U/ω_0 and R = U K_m/τ_stall at ``voltage_V``, the voltage limit U.

    The servo has its own gains; the gains of the controller are for DC motors.
    """

    voltage_V: Positive = Field(description="supply voltage at which stall torque and no-load speed are rated")
    stall_torque_N_m: Positive
    no_load_speed_rad_per_s: Positive
    mode: Literal["position", "velocity"] = default("position", "part of the reference that the servo follows")
    k_p_V_per_rad: NonNegative = default(0.0, "position mode")
    k_d_V_s_per_rad: NonNegative = default(0.0, "position mode")
    k_v_V_s_per_rad: NonNegative = default(0.0, "velocity mode")
    rotor_inertia_kg_m2: NonNegative = default(0.0, "rotor and gear, at the output shaft")
    gear_damping_N_m_s_per_rad: NonNegative = default(0.0, "viscous, at the output shaft")
    coulomb_friction_N_m: NonNegative = default(0.0, "friction of the gear, at the output shaft")
    coulomb_speed_rad_per_s: Positive | None = default(
        None, "speed below which Coulomb friction fades; default: 0.01; under the unilateral law dry friction"
    )
    current_limit_A: Positive | None = None
    torque_limit_N_m: Positive | None = default(None, "current limit as torque without gear friction")
    nominal_current_A: Positive | None = default(None, "continuous rating: a run that exceeds it warns")

    @model_validator(mode="after")
    def _check_currents(self) -> Self:
        if limit(self.current_limit_A) < (self.nominal_current_A or 0.0):
            raise error_at("nominal_current_A", f"is more than current_limit_A = {self.current_limit_A:g}")
        return self

    @model_validator(mode="before")
    @classmethod
    def _gains_of_the_mode(cls, data: Any) -> Any:
        """Set the default gains of the other mode to 0, because the user did not write them and they have no effect."""
        if not isinstance(data, Mapping):
            return data
        mode = data.get("mode", cls.model_fields["mode"].default)
        others = [key for name, keys in GAINS.items() if name != mode for key in keys]
        return {**{key: 0.0 for key in others if cls.model_fields[key].default}, **data} if mode in GAINS else data

    @model_validator(mode="after")
    def _check_gains(self) -> Self:
        own = GAINS[self.mode][0]
        if getattr(self, own) == 0.0:
            raise error_at(own, f"must be positive in mode {self.mode}")
        for name, keys in GAINS.items():
            for key in keys:
                if name != self.mode and getattr(self, key) != 0.0:
                    raise error_at(key, f"has no effect in mode {self.mode}")
        return self

    def servo(self, joint: str) -> Servo:
        """Return the servo on the named joint."""
        torque_constant = self.voltage_V / self.no_load_speed_rad_per_s
        return Servo(
            joint=joint,
            torque_constant=torque_constant,
            resistance=self.voltage_V * torque_constant / self.stall_torque_N_m,
            k_p=self.k_p_V_per_rad,
            k_d=self.k_d_V_s_per_rad,
            k_v=self.k_v_V_s_per_rad,
            velocity_mode=self.mode == "velocity",
            armature=self.rotor_inertia_kg_m2,
            reflected_damping=self.gear_damping_N_m_s_per_rad,
            coulomb_friction=self.coulomb_friction_N_m,
            coulomb_speed=self.coulomb_speed_rad_per_s,
            voltage_limit=self.voltage_V,
            current_limit=limit(self.current_limit_A),
            torque_limit=limit(self.torque_limit_N_m),
            mass=self.mass_kg,
            mass_point=self.mass_point,
            nominal_current=limit(self.nominal_current_A),
            nominal_torque=self.nominal_torque,
        )


# Use of servos outside the compiled kernels: their parameter row for the kernels, and the servo law for arrays of
# servos.


def servo_row(m: Servo) -> Array:
    """Return the row of ``DriveArrays.motor`` of a servo, (MOTOR_SIZE,)."""
    row = np.zeros(ka.MOTOR_SIZE)
    row[ka.K_M], row[ka.RESISTANCE] = m.torque_constant, m.resistance
    row[ka.J_M], row[ka.D_M] = m.armature, m.reflected_damping
    row[ka.K_P], row[ka.K_D], row[ka.K_V] = m.k_p, m.k_d, m.k_v
    row[ka.U_MAX] = m.voltage_limit
    row[ka.I_MAX] = m.greatest_current
    speed = SMOOTHING if m.coulomb_speed is None else m.coulomb_speed
    row[ka.COULOMB], row[ka.COULOMB_SPEED], row[ka.FREE_DRAG] = m.coulomb_friction, speed, m.free_drag
    return row


class ServoBank:
    """N servos on separate shafts."""

    def __init__(self, servos: list[Servo]) -> None:
        self._table = np.array([servo_row(servo) for servo in servos]).reshape(-1, ka.MOTOR_SIZE)
        self._mode = np.array(
            [ka.VELOCITY_MODE if servo.velocity_mode else ka.POSITION_MODE for servo in servos], dtype=np.int64
        )
        self._position, self._velocity = np.zeros(len(servos)), np.zeros(len(servos))

    def command(
        self, enabled: NDArray[np.bool_], in_position_mode: NDArray[np.bool_], position: Array, velocity: Array
    ) -> None:
        """Set modes and set points [rad, rad/s], all (N,), from now on; servos that are not ``enabled`` are off."""
        modes = np.where(in_position_mode, ka.POSITION_MODE, ka.VELOCITY_MODE)
        self._mode, self._position, self._velocity = np.where(enabled, modes, ka.OFF), position, velocity

    def supply(self, voltage: float) -> None:
        """Limit all voltages to a supply voltage [V]."""
        self._table[:, ka.U_MAX] = max(voltage, 0.0)

    def torque(self, q: Array, v: Array) -> Array:
        """Return the torques at the output shafts for positions [rad] and rates [rad/s], (N,) → (N,) [N m]."""
        torques = np.empty(len(self._mode))
        for a, (mode, q_ref, v_ref, at, rate) in enumerate(
            zip(self._mode, self._position, self._velocity, q, v, strict=True)
        ):
            asked = law.servo_command(self._table, a, mode, q_ref, v_ref, at, rate)
            torques[a] = law.servo_torque(self._table, a, mode, asked, rate)
        return torques
