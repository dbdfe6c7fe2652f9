"""Mechanics of virtual servos: motor law, interface of plants behind servos, and inertias as the simplest plant.

The position loop of a Dynamixel MX servo is (by default) proportional, and the motor brakes itself by its back-EMF:

    τ = clip(k (θ_set − θ), ±τ_stall V/12) − d ω        d = τ_stall / ω_no_load

with the supply V; τ_stall and ω_no_load are those at 12 V. A constant speed ω is followed with a lag of d/k in time, of
ω d/k in angle, and the motor by itself never exceeds ω_no_load V/12. k is the MX-106's stiffness at its default gain,
41 N·m/rad, scaled with stall torque for other models. Gear friction is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from dynsim.hardware.bus.control_table import MX_106, ServoModel

if TYPE_CHECKING:
    from dynsim.model.drives import Servo

Array = NDArray[np.float64]

STIFFNESS_PER_STALL_TORQUE = 41.0 / MX_106.stall_torque  # 1/rad
VELOCITY_TIME_CONSTANT = 0.02
"""Time constant of the closed velocity loop, with the servo's own inertia only [s] (unverified)."""
FREE_DAMPING = 0.1
"""Damping of an unpowered gear train as a fraction of the back-EMF damping (unverified)."""


@dataclass
class Drive:
    """Set points of the servos' controllers for their motors; all arrays of shape (N,), in servo angles.

    Attributes
    ----------
    enabled, in_position_mode : bool arrays
    set_position : array
        [rad].
    set_velocity : array
        [rad/s].
    voltage : float
        Supply at the servos [V].
    """

    enabled: NDArray[np.bool_]
    in_position_mode: NDArray[np.bool_]
    set_position: Array
    set_velocity: Array
    voltage: float


class MotorLaw:
    """Torque of N servos from their set points: the servo law of the simulation, with constants of their models.

    Attributes
    ----------
    stiffness, damping, stall_torque : array, shape (N,)
        k [N·m/rad], d [N·m·s/rad], τ_stall at 12 V [N·m].
    inertia : array, shape (N,)
        The output inertia at which the position loop is critically damped, d²/(4k) [kg·m²].
    """

    def __init__(self, models: list[ServoModel]) -> None:
        self.stall_torque = np.array([model.stall_torque for model in models])
        self.damping = self.stall_torque / np.array([model.no_load_speed for model in models])
        self.stiffness = STIFFNESS_PER_STALL_TORQUE * self.stall_torque
        self.inertia = self.damping**2 / (4 * self.stiffness)
        # Replaying on real servos imports this module and nothing of the simulation.
        from dynsim.model.servo import ServoBank

        self._bank = ServoBank(self.servos([model.name for model in models], np.ones(len(models))))

    def torque(self, position: Array, velocity: Array, drive: Drive) -> Array:
        """Output torque [N·m], shape (N,), at an angle [rad] and speed [rad/s]."""
        self._bank.command(drive.enabled, drive.in_position_mode, drive.set_position, drive.set_velocity)
        self._bank.supply(drive.voltage)
        return self._bank.torque(position, velocity)

    def servos(self, joints: list[str], gears: Array) -> list[Servo]:
        """The same servos on joints which they turn through gears, (N,) servo turns per joint turn.

        K_m = V/ω_no_load and R = V K_m/τ_stall at 12 V, so that d = K_m²/R; a torque per volt is K_m/R.
        """
        from dynsim.model.drives import Servo

        torque_constants = 12.0 / (self.stall_torque / self.damping)
        resistances = 12.0 * torque_constants / self.stall_torque
        volts = resistances / torque_constants
        return [
            Servo(
                joint=joint,
                torque_constant=float(torque_constants[a] * gear),
                resistance=float(resistances[a]),
                k_p=float(self.stiffness[a] * volts[a] * gear),
                k_v=float(self.inertia[a] / VELOCITY_TIME_CONSTANT * volts[a] * gear),
                armature=float(self.inertia[a] * gear**2),
                free_drag=float(FREE_DAMPING * self.damping[a] * gear**2),
            )
            for a, (joint, gear) in enumerate(zip(joints, gears, strict=True))
        ]


class ServoPlant(Protocol):
    """Mechanics behind the servos' output shafts.

    Attributes
    ----------
    position, velocity, torque : array, shape (N,)
        Servo angle [rad] (0 at tick 0), speed [rad/s], motor torque [N·m].
    rests : bool
        Nothing would move as long as all servos are off, so time may pass without steps.
    """

    position: Array
    velocity: Array
    torque: Array

    @property
    def rests(self) -> bool: ...

    def step(self, dt: float, drive: Drive) -> None:
        """Advance by ``dt`` [s]."""
        ...

    def stop(self, index: int) -> None:
        """Bring one shaft to rest where it is, and hold it there during the next step (a jammed gear)."""
        ...


class InertialLoad:
    """Every servo turns an inertia of its own: a second-order response, critically damped."""

    def __init__(self, models: list[ServoModel], position: Array) -> None:
        self.law = MotorLaw(models)
        self.position = np.array(position, dtype=np.float64)
        self.velocity = np.zeros(len(models))
        self.torque = np.zeros(len(models))
        self._jammed = np.zeros(len(models), dtype=bool)

    @property
    def rests(self) -> bool:
        return bool(np.abs(self.velocity).max(initial=0.0) < 1e-4)

    def step(self, dt: float, drive: Drive) -> None:
        self.torque = self.law.torque(self.position, self.velocity, drive)
        self.velocity = np.where(self._jammed, 0.0, self.velocity + dt * self.torque / self.law.inertia)
        self.position += dt * self.velocity
        self._jammed[:] = False

    def stop(self, index: int) -> None:
        self.velocity[index] = 0.0
        self._jammed[index] = True
