"""Servos outside the compiled kernels: the kernels' parameter row, and the servo law for arrays of servos.

The law is the source that the kernels compile (``dynsim.dynamics.drive.servo``), called as plain Python without numba.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynsim.dynamics import tables as ka
from dynsim.dynamics.drive import servo as law
from dynsim.model.drives import SMOOTHING, Servo

Array = NDArray[np.float64]


def servo_row(m: Servo) -> Array:
    """Row of ``DriveArrays.motor`` of a servo, (MOTOR_SIZE,)."""
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
    """N servos, each on a shaft of its own."""

    def __init__(self, servos: list[Servo]) -> None:
        self._table = np.array([servo_row(servo) for servo in servos]).reshape(-1, ka.MOTOR_SIZE)
        self._mode = np.array(
            [ka.VELOCITY_MODE if servo.velocity_mode else ka.POSITION_MODE for servo in servos], dtype=np.int64
        )
        self._position, self._velocity = np.zeros(len(servos)), np.zeros(len(servos))

    def command(
        self, enabled: NDArray[np.bool_], in_position_mode: NDArray[np.bool_], position: Array, velocity: Array
    ) -> None:
        """Modes and set points [rad, rad/s] from now on, all (N,); what is not ``enabled`` is off."""
        modes = np.where(in_position_mode, ka.POSITION_MODE, ka.VELOCITY_MODE)
        self._mode, self._position, self._velocity = np.where(enabled, modes, ka.OFF), position, velocity

    def supply(self, voltage: float) -> None:
        """Limit all voltages to that of a supply [V]."""
        self._table[:, ka.U_MAX] = max(voltage, 0.0)

    def torque(self, q: Array, v: Array) -> Array:
        """Torques at the output shafts at positions [rad] and rates [rad/s], (N,) → (N,) [N m]."""
        torques = np.empty(len(self._mode))
        for a, (mode, q_ref, v_ref, at, rate) in enumerate(
            zip(self._mode, self._position, self._velocity, q, v, strict=True)
        ):
            asked = law.servo_command(self._table, a, mode, q_ref, v_ref, at, rate)
            torques[a] = law.servo_torque(self._table, a, mode, asked, rate)
        return torques
