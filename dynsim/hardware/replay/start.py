"""How far a robot stands from where a motion begins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynsim.hardware.bus.control_table import STATE_BLOCK
from dynsim.hardware.bus.protocol import Bus, too_busy
from dynsim.hardware.errors import VerificationFailed
from dynsim.hardware.replay.motion import QUINTIC_PEAK
from dynsim.hardware.servo_map import Servo, ServoMap

ATTEMPTS = 3


@dataclass(frozen=True)
class Distance:
    """Where one joint stands, and where the motion begins [rad]."""

    joint: str
    now: float
    start: float

    def __str__(self) -> str:
        return f"{self.joint} {abs(self.start - self.now):.3f} rad (from {self.now:.3f} to {self.start:.3f})"


@dataclass(frozen=True)
class WayToStart:
    """The move before a replay.

    Attributes
    ----------
    distances : tuple of Distance
        Of the joints in position mode, the furthest first.
    duration : float
        [s].
    far : tuple of Distance
        Those beyond ``safety.start_distance``.
    """

    distances: tuple[Distance, ...]
    duration: float
    far: tuple[Distance, ...]


def way_to_start(bus: Bus, servo_map: ServoMap, start: NDArray[np.float64]) -> WayToStart:
    """Read where the joints stand; ``start`` is the posture to go to [rad], shape (N,).

    Raises
    ------
    VerificationFailed
        A servo does not answer.
    """
    ticks = read_ticks(bus, [servo for servo in servo_map.servos if servo.in_position_mode])
    distances = [
        Distance(servo.joint, servo.to_angle(ticks[servo.id]), float(target))
        for servo, target in zip(servo_map.servos, start, strict=True)
        if servo.in_position_mode
    ]
    distances.sort(key=lambda one: -abs(one.start - one.now))
    furthest = abs(distances[0].start - distances[0].now) if distances else 0.0
    far = [one for one in distances if abs(one.start - one.now) > servo_map.safety.start_distance]
    duration = QUINTIC_PEAK * furthest / servo_map.safety.approach_velocity
    return WayToStart(tuple(distances), duration, tuple(far))


def read_ticks(bus: Bus, servos: list[Servo]) -> dict[int, int]:
    """Servo position by ID. Raises VerificationFailed where one does not answer."""
    ticks: dict[int, int] = {}
    for _ in range(ATTEMPTS):
        missing = [servo.id for servo in servos if servo.id not in ticks]
        if not missing:
            break
        for id_, reply in bus.sync_read(missing, *STATE_BLOCK).replies.items():
            ticks[id_] = int.from_bytes(reply.data[6:10], "little", signed=True)
    silent = [f"{servo.joint} (ID {servo.id})" for servo in servos if servo.id not in ticks]
    if silent:
        busy = too_busy(bus)
        raise VerificationFailed(
            f"no answer from {', '.join(silent)}: check power, cable, ID and baud rate{busy and '; '}{busy}"
        )
    return ticks
