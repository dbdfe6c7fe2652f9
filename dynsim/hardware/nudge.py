"""Check of the direction of rotation: turn each joint by a small angle and back, and compare with the servo map.

A nudge is a replay on a single servo, with all checks and abort rules of a replay: the servo is verified, armed at its
present position, moved by 3° and back at no more than 0.1 rad/s, and then its torque is switched off. The torque of all
other servos stays off.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from dynsim.hardware.bus.control_table import RAD_PER_TICK
from dynsim.hardware.bus.protocol import Bus, Clock
from dynsim.hardware.errors import ReplayAborted, ReplayInterrupted, VerificationFailed
from dynsim.hardware.replay.check import CheckedMotion, plan_cycle
from dynsim.hardware.replay.machine import Replay
from dynsim.hardware.replay.output import ReplayState, StopRequest
from dynsim.hardware.replay.rules import Cause, read_ticks
from dynsim.hardware.replay.trajectory import QUINTIC_PEAK, Path, quintic
from dynsim.hardware.servo_map import MappedServo, ServoMap, refuse_torque

ANGLE = math.radians(3.0)
SPEED = 0.1
"""Maximum speed of a nudge [rad/s]."""
PAUSE = 0.5
"""Pause at the far end of the motion [s], so that a person can see that the joint has moved."""
KNOTS = 31
"""Number of knots for each direction; the interpolant is within 1e-7 rad of the quintic."""
ERROR_LIMIT = 0.75
"""Following error at which a nudge is aborted, as a fraction of its angle; this limits the load on a blocked joint."""
MOVED = 0.5
"""Minimum motion needed to determine the direction of rotation, as a fraction of the commanded angle."""


@dataclass(frozen=True)
class Nudge:
    """Result of nudging one joint.

    Attributes
    ----------
    joint : str
    id : int
    asked, moved : float
        Commanded and measured displacement at the far end [rad], positive in the positive direction of the servo map.
    ticks : int
        Measured displacement in servo ticks.
    """

    joint: str
    id: int
    asked: float
    moved: float
    ticks: int

    @property
    def followed(self) -> bool:
        """True if the servo moved in the commanded direction by at least ``MOVED`` of the commanded angle."""
        return self.moved / self.asked >= MOVED


class _OneServo:
    """Bus on which a broadcast ping finds only one servo, so that the replay ignores all other servos."""

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
    """Turn one joint by 3° and back.

    The joint turns in the positive direction of the map, or in the negative direction if the upper limit is too close.

    Parameters
    ----------
    servo_map : ServoMap
        Map that contains the servo.
    servo : MappedServo
        Servo to move.
    bus, clock : Bus, Clock
        Bus and clock for the replay.
    live : bool
        If False, verify the servo without moving it.
    stop : StopRequest, optional
        Object through which the user can stop the nudge.

    Returns
    -------
    Nudge or None
        Measured motion; None if ``live`` is False.

    Raises
    ------
    VerificationFailed
        If the torque of any servo in the map is on (the servo may be holding the robot, and a nudge ends with its
        torque off), or if the servo to be moved is not ready or is too close to its limits.
    ReplayInterrupted, ReplayAborted
        If the user or an abort rule ends the nudge; the torque is off then.
    """
    refuse_torque(bus, servo_map.servos)
    tick = read_ticks(bus, [servo])[servo.id]
    start = servo.to_angle(tick)
    distance = _signed_distance(servo, start)
    single = _single_servo_map(servo_map, servo)
    motion = CheckedMotion(path=_out_and_back(start, distance), plan=plan_cycle(single, single.bus.rate))
    replay = Replay(motion, single, cast(Bus, _OneServo(bus, servo.id)), clock, live=live, stop=stop or StopRequest())
    result = replay.run()
    if result.fault is not None and result.fault_state is not None:
        if result.fault.cause == Cause.VERIFICATION:
            raise VerificationFailed(result.fault.text)
        kind = ReplayInterrupted if result.fault.cause == Cause.INTERRUPTED else ReplayAborted
        text = f"{servo.joint}: {result.fault.cause} in {result.fault_state.name}: {result.fault.text}"
        raise kind(f"{text}; end state: {result.end_state}", result=result)
    if not live:
        return None
    angles = result.record[servo.kind.follows.position][:, 0][result.record["state"] == ReplayState.REPLAY]
    moved = float(angles[np.nanargmax((angles - start) * np.sign(distance))] - start)
    return Nudge(servo.joint, servo.id, distance, moved, round(servo.sign * servo.gear * moved / RAD_PER_TICK))


def _signed_distance(servo: MappedServo, start: float) -> float:
    low, high = servo.position_limits
    if start + ANGLE <= high:
        return ANGLE
    if start - ANGLE >= low:
        return -ANGLE
    raise VerificationFailed(f"{servo.joint} is less than {math.degrees(ANGLE):g}° from both limits; move it by hand")


def _out_and_back(start: float, distance: float) -> Path:
    duration = QUINTIC_PEAK * ANGLE / SPEED
    leg = np.linspace(0.0, duration, KNOTS)
    fraction, rate = np.array([quintic(duration, t) for t in leg]).T
    time = np.concatenate([leg, duration + PAUSE + leg])
    position = start + distance * np.concatenate([fraction, 1 - fraction])[:, None]
    rates = distance * np.concatenate([rate, -rate])[:, None]
    return Path(time, position, rates[:-1], rates[1:])


def _single_servo_map(servo_map: ServoMap, servo: MappedServo) -> ServoMap:
    """Return a map with one servo, whose settings make it stop at an obstacle and end with its torque off."""
    watched, alone = copy.copy(servo), copy.copy(servo_map)
    if servo.in_position_mode:
        bound = min(ERROR_LIMIT * ANGLE, servo.kind.following_error)
        watched.kind = servo.kind.model_copy(update={"following_error": bound})
    alone.servos = (watched,)
    alone.safety = servo_map.safety.model_copy(
        update={"policy": "off", "at_end": "off", "approach_velocity": min(SPEED, servo_map.safety.approach_velocity)}
    )
    return alone
