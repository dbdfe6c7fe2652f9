"""Check of the sense of rotation: turns each joint by a small angle and back, and compares with the servo map.

A nudge is a replay of one servo, with all checks and abort rules of a replay: the servo is verified, armed where it
stands, moved by 3° and back at 0.1 rad/s at most, and its torque is switched off. All other servos have torque off.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from dynsim.hardware.bus.control_table import RAD_PER_TICK
from dynsim.hardware.bus.protocol import Bus, Clock
from dynsim.hardware.errors import ReplayAborted, ReplayInterrupted, VerificationFailed
from dynsim.hardware.replay.check import CheckedMotion, plan_cycle
from dynsim.hardware.replay.machine import Replay
from dynsim.hardware.replay.output import ReplayState, StopRequest
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.replay.trajectory import QUINTIC_PEAK, Path, quintic
from dynsim.hardware.replay.verify import read_ticks
from dynsim.hardware.servo_map import MappedServo, ServoMap, refuse_torque

ANGLE = math.radians(3.0)
SPEED = 0.1
"""Top speed of a nudge [rad/s]."""
PAUSE = 0.5
"""Pause at the far end [s], for a person to see the motion."""
KNOTS = 31
"""Knots of each leg: the interpolant is within 1e-7 rad of the quintic."""
YIELDS = 0.75
"""Following error that ends a nudge, in parts of its angle, so that a blocked joint is not loaded further."""
MOVED = 0.5
"""Least motion from which the sense of rotation is determined, in parts of the angle."""


@dataclass(frozen=True)
class Nudge:
    """What one joint did.

    Attributes
    ----------
    joint : str
    id : int
    asked, moved : float
        Way out of the goals and of the servo, in the map's sense [rad].
    ticks : int
        Way out in the servo's own count.
    """

    joint: str
    id: int
    asked: float
    moved: float
    ticks: int

    @property
    def followed(self) -> bool:
        """The servo went where it was sent."""
        return self.moved / self.asked >= MOVED


class _OneServo:
    """A bus on which a broadcast ping finds one servo: the others are none of this replay's business."""

    def __init__(self, bus: Bus, id_: int) -> None:
        self._bus = bus
        self._id = id_

    def ping_all(self) -> dict[int, tuple[int, int]]:
        return {id_: answer for id_, answer in self._bus.ping_all().items() if id_ == self._id}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)


def nudge(
    servo_map: ServoMap, servo: MappedServo, bus: Bus, clock: Clock, *, live: bool, stop: StopRequest | None = None
) -> Nudge | None:
    """Turn one joint 3° and back; None where ``live`` is false: the servo is verified then, and nothing moves.

    It goes in the positive sense of the map, or in the negative one where the positive limit is too near.

    Raises
    ------
    VerificationFailed
        A servo of the map has its torque on (what holds the robot must not be released by the way), this one is not fit
        to move, or has no room.
    ReplayInterrupted, ReplayAborted
        The user or an abort rule ended the nudge; torque is off.
    """
    refuse_torque(bus, servo_map.servos)
    tick = read_ticks(bus, [servo])[servo.id]
    start = servo.to_angle(tick)
    distance = _way(servo, start)
    single = _alone(servo_map, servo)
    motion = CheckedMotion(path=_out_and_back(start, distance), plan=plan_cycle(single, single.bus.rate))
    replay = Replay(motion, single, cast(Bus, _OneServo(bus, servo.id)), clock, live=live, stop=stop)
    result = replay.run()
    if result.fault is not None and result.fault_state is not None:
        if result.fault.cause == Cause.VERIFICATION:
            raise VerificationFailed(result.fault.text)
        kind = ReplayInterrupted if result.fault.cause == Cause.INTERRUPTED else ReplayAborted
        text = f"{servo.joint}: {result.fault.cause} in {result.fault_state.name}: {result.fault.text}"
        raise kind(f"{text}; robot left {result.end_state}", result=result)
    if not live:
        return None
    angles = result.record[servo.kind.follows.position][:, 0][result.record["state"] == ReplayState.REPLAY]
    moved = float(angles[np.nanargmax((angles - start) * np.sign(distance))] - start)
    return Nudge(servo.joint, servo.id, distance, moved, round(servo.sign * servo.gear * moved / RAD_PER_TICK))


def swapped(servo_map: ServoMap, agrees: Mapping[str, bool]) -> dict[str, int]:
    """The sign that the map should have for every joint that moved against the sense of the map."""
    return {servo.joint: -servo.sign for servo in servo_map.servos if not agrees.get(servo.joint, True)}


def _way(servo: MappedServo, start: float) -> float:
    low, high = servo.position_limits
    if start + ANGLE <= high:
        return ANGLE
    if start - ANGLE >= low:
        return -ANGLE
    raise VerificationFailed(f"{servo.joint} has no room for {math.degrees(ANGLE):g}° between its limits")


def _out_and_back(start: float, distance: float) -> Path:
    duration = QUINTIC_PEAK * ANGLE / SPEED
    leg = np.linspace(0.0, duration, KNOTS)
    fraction, rate = np.array([quintic(duration, t) for t in leg]).T
    time = np.concatenate([leg, duration + PAUSE + leg])
    position = start + distance * np.concatenate([fraction, 1 - fraction])[:, None]
    rates = distance * np.concatenate([rate, -rate])[:, None]
    return Path(time, position, rates[:-1], rates[1:])


def _alone(servo_map: ServoMap, servo: MappedServo) -> ServoMap:
    """The map of one servo that yields to what is in its way, and is limp afterwards."""
    watched, alone = copy.copy(servo), copy.copy(servo_map)
    if servo.in_position_mode:
        bound = min(YIELDS * ANGLE, servo.kind.following_error)
        watched.kind = servo.kind.model_copy(update={"following_error": bound})
    alone.servos = (watched,)
    alone.safety = servo_map.safety.model_copy(
        update={"policy": "off", "at_end": "off", "approach_velocity": min(SPEED, servo_map.safety.approach_velocity)}
    )
    return alone
