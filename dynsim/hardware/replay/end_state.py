"""What every servo is doing when a replay is over, read from its registers: never what it was asked to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from dynsim.hardware.bus.control_table import HEALTH_BLOCK, describe_hardware_error
from dynsim.hardware.bus.protocol import Bus
from dynsim.hardware.replay.rules import decode_health
from dynsim.hardware.servo_map import Servo

AT_REST = 0.1
"""Slower joints and wheels stand still [rad/s]; a few units of the velocity register."""
READS = 3
"""Times a servo is asked before it counts as silent."""

HOLDING, LIMP, MOVING = "holding", "limp: off", "moving"
SILENT, TRIPPED = "does not answer", "watchdog tripped"
WHOLE = {HOLDING: "holding", LIMP: "off", SILENT: "unreachable"}
"""What the robot does where all its servos do the same; other things are called as they are."""


@dataclass(frozen=True)
class ServoEnd:
    """One servo at the end.

    Attributes
    ----------
    joint : str
    id : int
    torque : bool or None
        Whether it is on; None, as all that follows, where the servo did not answer.
    error : int or None
        Hardware error register.
    position, velocity : float or None
        Of the joint [rad], [rad/s].
    doing : str
        "holding", "limp: off", "limp: <hardware error>", "moving", "watchdog tripped" or "does not answer".
    """

    joint: str
    id: int
    torque: bool | None = None
    error: int | None = None
    position: float | None = None
    velocity: float | None = None
    doing: str = SILENT

    def as_dict(self) -> dict[str, Any]:
        """With units in the names, for summaries."""
        found = asdict(self)
        found["position_rad"], found["velocity_rad_s"] = found.pop("position"), found.pop("velocity")
        return found

    def __str__(self) -> str:
        text = f"{self.joint} (ID {self.id}): {self.doing}"
        if self.error:
            text += f", error: {describe_hardware_error(self.error)}"
        return text if self.position is None else f"{text}, {self.position:.4f} rad, {self.velocity:.3f} rad/s"


def read_health(bus: Bus, servos: Sequence[Servo]) -> dict[int, dict[str, int]]:
    """Registers 64 to 146 of every servo that answers, by ID and name.

    Raises
    ------
    PortError
    """
    found: dict[int, dict[str, int]] = {}
    for _ in range(READS):
        silent = [servo for servo in servos if servo.id not in found]
        if not silent:
            break
        replies = bus.sync_read([servo.id for servo in silent], *HEALTH_BLOCK).replies
        found |= {servo.id: decode_health(servo, replies[servo.id].data) for servo in silent if servo.id in replies}
    return found


def read_back(bus: Bus, servos: Sequence[Servo]) -> tuple[ServoEnd, ...]:
    """What every servo is doing now. Raises PortError."""
    health = read_health(bus, servos)
    return tuple(
        _end(servo, health[servo.id]) if servo.id in health else ServoEnd(servo.joint, servo.id) for servo in servos
    )


def _end(servo: Servo, registers: dict[str, int]) -> ServoEnd:
    torque, error = bool(registers["torque_enable"]), registers["hardware_error"]
    position, velocity = servo.to_angle(registers["present_position"]), servo.to_velocity(registers["present_velocity"])
    if not torque:
        doing = f"limp: {describe_hardware_error(error)}" if error else LIMP
    elif registers["bus_watchdog"] == -1:
        doing = TRIPPED
    else:
        doing = HOLDING if abs(velocity) < AT_REST else MOVING
    return ServoEnd(servo.joint, servo.id, torque, error, position, velocity, doing)


def of_the_whole(servos: Sequence[ServoEnd]) -> str:
    """One phrase for all servos: "holding", "off", "unreachable", or who does what.

    The largest group is counted, the others are named, as in
    "mixed: 16 holding; wheel1, wheel2 does not answer; elbow limp: overload".
    """
    groups: dict[str, list[str]] = {}
    for servo in servos:
        groups.setdefault(servo.doing, []).append(servo.joint)
    if len(groups) <= 1:
        doing = next(iter(groups), SILENT)
        return WHOLE.get(doing, doing)
    largest = max(groups, key=lambda doing: len(groups[doing]))
    told = [
        f"{len(joints)} {doing}" if doing == largest and len(joints) > 1 else f"{', '.join(joints)} {doing}"
        for doing, joints in sorted(groups.items(), key=lambda group: -len(group[1]))
    ]
    return f"mixed: {'; '.join(told)}"
