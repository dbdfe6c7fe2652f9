"""What limits a servo has stored itself, beside those of the map.

The servo's own limits act where this program does not reach: it ignores goals beyond them without a word, and goes limp
at its own thresholds. A difference is shown; one that makes the map untrue keeps the robot from being armed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dynsim.hardware.bus.control_table import HARDWARE_ERRORS, RAD_S_PER_UNIT, VOLT_PER_UNIT
from dynsim.hardware.replay.motion import Needs
from dynsim.hardware.safety import Safety
from dynsim.hardware.servo_map import Servo

QUANTITIES = ("position °", "velocity rad/s", "torque N m", "temperature °C", "supply V")
NOT_LIMITED = "-"
VOLTAGE_SHUTDOWN = 1 << next(bit for bit, name in HARDWARE_ERRORS.items() if name == "input voltage")


@dataclass(frozen=True)
class LimitRow:
    """One servo's limits beside the map's.

    Attributes
    ----------
    joint : str
    id : int
    cells : tuple of (str, str)
        What the servo has stored and what the map says, for each of QUANTITIES.
    refused : tuple of str
        Differences with which the robot must not be armed.
    differs : tuple of str
        Other differences worth knowing.
    """

    joint: str
    id: int
    cells: tuple[tuple[str, str], ...]
    refused: tuple[str, ...]
    differs: tuple[str, ...]


def needs_of_map(servo: Servo) -> Needs:
    """All that the map allows."""
    low, high = servo.position_limits
    return Needs(low, high, servo.kind.limits.velocity)


def compare_limits(servo: Servo, registers: dict[str, int], safety: Safety, needs: Needs) -> LimitRow:
    """The limits in a servo's EEPROM, beside those of the map.

    Refused are limits within which the servo would ignore goals of the motion or fall behind it, and thresholds with
    which it goes limp before the replay's own rule can stop it, or protects itself later than its data sheet says.
    """
    compared = (
        _position(servo, registers, needs),
        _velocity(servo, registers, needs),
        _torque(servo, registers),
        _temperature(servo, registers, safety),
        _supply(registers, safety),
    )
    return LimitRow(
        servo.joint,
        servo.id,
        tuple((one.servo, one.map) for one in compared),
        tuple(one.refused for one in compared if one.refused),
        tuple(one.differs for one in compared if one.differs),
    )


@dataclass(frozen=True)
class _Compared:
    servo: str
    map: str
    refused: str = ""
    differs: str = ""


def _position(servo: Servo, registers: dict[str, int], needs: Needs) -> _Compared:
    if not servo.in_position_mode:
        return _Compared(NOT_LIMITED, NOT_LIMITED)
    low, high = registers["min_position"], registers["max_position"]
    own = np.degrees(sorted((servo.to_angle(low), servo.to_angle(high))))
    told = np.degrees(servo.position_limits)
    cells = f"{own[0]:.0f} to {own[1]:.0f}", f"{told[0]:.0f} to {told[1]:.0f}"
    goals = sorted((servo.to_ticks(needs.low), servo.to_ticks(needs.high)))
    if goals[0] < low or goals[1] > high:
        return _Compared(
            *cells, refused=f"the motion needs ticks {goals[0]} to {goals[1]}, its own limits are {low} to {high}"
        )
    allowed = servo.tick_limits
    if allowed[0] < low or allowed[1] > high:
        return _Compared(*cells, differs=f"its own position limits are narrower than the map's: ticks {low} to {high}")
    return _Compared(*cells)


def _velocity(servo: Servo, registers: dict[str, int], needs: Needs) -> _Compared:
    units, told = registers["velocity_limit"], servo.kind.limits.velocity
    own = units * RAD_S_PER_UNIT / servo.gear
    cells = f"{own:.2f}", f"{told:.2f}"
    below = units < abs(servo.to_velocity_units(told))
    if below and not servo.in_position_mode:
        return _Compared(
            *cells,
            refused=f"its velocity limit is {own:.2f} rad/s, below the map's; faster goals would be ignored silently",
        )
    if units < abs(servo.to_velocity_units(needs.fastest)):
        return _Compared(
            *cells,
            refused=f"the motion needs {needs.fastest:.2f} rad/s, its velocity limit is {own:.2f}: it would lag",
        )
    return _Compared(*cells, differs=f"its velocity limit of {own:.2f} rad/s is below the map's" if below else "")


def _torque(servo: Servo, registers: dict[str, int]) -> _Compared:
    told = servo.kind.limits.torque
    if "current_limit" not in registers:
        return _Compared(NOT_LIMITED, f"{told:.1f}")
    # It bounds the goals of the modes that control current; neither of those that a map can name is one.
    own = servo.gear * servo.model.torque(registers["current_limit"])
    below = f"its current limit is worth {own:.1f} N m, below the map's" if own < told else ""
    return _Compared(f"{own:.1f}", f"{told:.1f}", differs=below)


def _temperature(servo: Servo, registers: dict[str, int], safety: Safety) -> _Compared:
    own, told = registers["temperature_limit"], safety.temperature_max
    cells = f"{own}", f"{told:g}"
    if own <= told:
        return _Compared(
            *cells, refused=f"goes limp at {own} °C, before the map's temperature_max of {told:g} °C stops the robot"
        )
    if own > (highest := servo.model.fields["temperature_limit"].default):
        return _Compared(
            *cells, refused=f"its temperature limit is {own} °C, a {servo.model.name} is to shut down at {highest} °C"
        )
    return _Compared(*cells)


def _supply(registers: dict[str, int], safety: Safety) -> _Compared:
    low, high = registers["min_voltage"] * VOLT_PER_UNIT, registers["max_voltage"] * VOLT_PER_UNIT
    told = safety.supply
    cells = f"{low:g} to {high:g}", f"{told.lowest:g} to {told.highest:g}"
    if low <= told.lowest and told.highest <= high:
        return _Compared(*cells)
    if registers["shutdown"] & VOLTAGE_SHUTDOWN:
        return _Compared(
            *cells,
            refused=f"goes limp outside of {low:g} to {high:g} V, within the map's supply range",
        )
    return _Compared(
        *cells, differs=f"raises its alert outside of {low:g} to {high:g} V, within the map's supply range"
    )


def difference_lines(rows: Sequence[LimitRow]) -> list[str]:
    """The rows as a table of text, every cell "servo | map", with the differences below."""
    table = [["joint", "ID", *QUANTITIES]]
    table += [[row.joint, str(row.id), *(" | ".join(cell) for cell in row.cells)] for row in rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in table]
    return ["limits, stored in the servo | of the map:", *lines, *differences(rows)]


def differences(rows: Sequence[LimitRow]) -> list[str]:
    """Differences worth knowing, one line each, refused ones first."""
    refused = [f"{row.joint} (ID {row.id}): {text}" for row in rows for text in row.refused]
    return refused + [f"note: {row.joint} (ID {row.id}): {text}" for row in rows for text in row.differs]
