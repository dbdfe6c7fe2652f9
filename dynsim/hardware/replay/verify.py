"""Are the servos on the bus the ones of the map, set up as the replay needs them, and fit to move?"""

from __future__ import annotations

from collections.abc import Callable

from dynsim.hardware.bus.control_table import (
    HEALTH_BLOCK,
    MODEL_BY_NUMBER,
    RETURN_DELAY_SECONDS_PER_UNIT,
    STATE_BLOCK,
    VOLT_PER_UNIT,
    OperatingMode,
    describe_hardware_error,
)
from dynsim.hardware.bus.protocol import Bus, NoAnswer, RequestRefused, too_busy
from dynsim.hardware.replay.motion import Task
from dynsim.hardware.replay.registers import LimitRow, compare_limits
from dynsim.hardware.servo_map import Servo, ServoMap

EEPROM_BLOCK = (0, 64)
TRIAL_READS = 10
TRIAL_MISSES = 2
"""Of ten trial reads a servo may miss so many."""
NEEDED_SHUTDOWN = 0b0010_0100  # overheating, overload
STATUS_TO_ALL = 2
ACKNOWLEDGE = (
    "check power, cable, ID and baud rate (`dynsim hw scan`); a servo with Protocol 1 firmware does not answer"
)

Registers = dict[str, int]


def snapshot(bus: Bus, servo: Servo) -> Registers:
    """All registers of a servo, by name. Raises NoAnswer or RequestRefused."""
    eeprom = bus.read_block(servo.id, *EEPROM_BLOCK).data
    ram = bus.read_block(servo.id, *HEALTH_BLOCK).data
    return servo.model.registers_in(EEPROM_BLOCK[0], eeprom + ram)


def all_registers(bus: Bus, servo_map: ServoMap) -> dict[str, Registers | str]:
    """Registers of every servo by joint, or why it did not answer. Raises PortError."""
    contents: dict[str, Registers | str] = {}
    for servo in servo_map.servos:
        try:
            contents[servo.joint] = snapshot(bus, servo)
        except (NoAnswer, RequestRefused) as error:
            contents[servo.joint] = str(error)
    return contents


def configure(bus: Bus, servo_map: ServoMap, report: Callable[[str], None]) -> None:
    """Write operating mode, return delay and drive mode where they differ from what the replay needs (EEPROM).

    Raises
    ------
    NoAnswer, RequestRefused
        Also when torque is on: the EEPROM is locked then.
    """
    for servo in servo_map.servos:
        now = snapshot(bus, servo)
        for name, value in _wanted_eeprom(servo, servo_map).items():
            if now[name] != value:
                bus.write(servo.id, servo.model.fields[name], value)
                report(f"{servo.joint} (ID {servo.id}): {name} {now[name]} -> {value}")


def _wanted_eeprom(servo: Servo, servo_map: ServoMap) -> Registers:
    return {
        "operating_mode": int(servo.operating_mode),
        "return_delay": int(servo_map.bus.return_delay / RETURN_DELAY_SECONDS_PER_UNIT),
        "drive_mode": 0,
    }


def verify(
    bus: Bus, servo_map: ServoMap, motion: Task, *, poll: Callable[[], None]
) -> tuple[list[str], list[LimitRow]]:
    """Everything that is wrong with the servos on the bus, one line each; empty when the robot may move.

    With it the limits that the servos have stored, beside the map's.

    Parameters
    ----------
    poll : callable
        Called between servos; may raise to break off.
    """
    problems: list[str] = []
    rows: list[LimitRow] = []
    silent = False
    present = bus.ping_all()
    poll()
    for id_, (model, firmware) in present.items():
        if id_ not in servo_map.ids:
            name = MODEL_BY_NUMBER[model].name if model in MODEL_BY_NUMBER else f"model {model}"
            problems.append(f"ID {id_}: {name} (firmware {firmware}) is on the bus but not in the map")
    for servo, needs in zip(servo_map.servos, motion.needs(), strict=True):
        poll()
        try:
            registers = snapshot(bus, servo)
        except NoAnswer as missing:
            silent = True
            hint = "two servos with this ID?" if missing.garbled or servo.id in present else ACKNOWLEDGE
            problems.append(f"{servo.joint}: {missing}; {hint}")
            continue
        except RequestRefused as refused:
            problems.append(f"{servo.joint}: {refused}")
            continue
        found = _unfit(servo, registers, servo_map)
        if registers["model_number"] == servo.model.number:
            rows.append(compare_limits(servo, registers, servo_map.safety, needs))
            found += [*rows[-1].refused, *_out_of_place(servo, registers)]
        problems += [f"{servo.joint} (ID {servo.id}): {text}" for text in found]
    missed = [] if problems else _trial_reads(bus, servo_map, poll)
    if (silent or missed) and (busy := too_busy(bus)):
        missed.append(busy)
    return problems + missed, rows


def _unfit(servo: Servo, registers: Registers, servo_map: ServoMap) -> list[str]:
    found = []
    if registers["model_number"] != servo.model.number:
        return [f"is model {registers['model_number']}, the map says {servo.model.name} ({servo.model.number})"]
    if registers["firmware"] < servo.kind.firmware_min:
        found.append(f"firmware {registers['firmware']} is older than {servo.kind.firmware_min}")
    if registers["operating_mode"] != servo.operating_mode:
        mode = registers["operating_mode"]
        name = OperatingMode(mode).name.lower() if mode in list(OperatingMode) else str(mode)
        found.append(f"is in mode {name}, must be {servo.kind.mode} (--configure sets it)")
    if registers["drive_mode"]:
        found.append(
            f"drive mode is {registers['drive_mode']}, must be 0: the sense belongs into the map (--configure sets it)"
        )
    delay = registers["return_delay"] * RETURN_DELAY_SECONDS_PER_UNIT
    if delay > servo_map.bus.return_delay + 1e-9:
        found.append(
            f"return delay is {delay * 1e6:.0f} µs, planned {servo_map.bus.return_delay * 1e6:.0f} µs "
            "(--configure sets it)"
        )
    if registers["status_return_level"] != STATUS_TO_ALL:
        found.append(f"status return level is {registers['status_return_level']}, must be {STATUS_TO_ALL}")
    if registers["shutdown"] & NEEDED_SHUTDOWN != NEEDED_SHUTDOWN:
        found.append(f"shutdown is 0x{registers['shutdown']:02x}: overheating and overload must switch the torque off")
    if registers["hardware_error"]:
        found.append(
            f"hardware error: {describe_hardware_error(registers['hardware_error'])}; only a restart clears it"
        )
    volts, supply = registers["present_voltage"] * VOLT_PER_UNIT, servo_map.safety.supply
    if not supply.lowest <= volts <= supply.highest:
        found.append(f"supply is {volts:.1f} V, allowed {supply.lowest:g} to {supply.highest:g} V")
    if registers["present_temperature"] > servo_map.safety.temperature_max:
        found.append(f"{registers['present_temperature']} °C is above {servo_map.safety.temperature_max:g} °C")
    return found


def _out_of_place(servo: Servo, registers: Registers) -> list[str]:
    """A posture the robot must not start from."""
    tick = registers["present_position"]
    low, high = servo.tick_limits
    if not servo.in_position_mode or low <= tick <= high:
        return []
    return [
        f"stands at {servo.to_angle(tick):.3f} rad (tick {tick}), outside of its limits "
        f"{servo.position_limits[0]:.3f} to {servo.position_limits[1]:.3f} rad; move it by hand"
    ]


def _trial_reads(bus: Bus, servo_map: ServoMap, poll: Callable[[], None]) -> list[str]:
    """Two servos with one ID may answer a ping alike; their measured values differ sooner or later."""
    missed = dict.fromkeys(servo_map.ids, 0)
    for _ in range(TRIAL_READS):
        poll()
        replies = bus.sync_read(servo_map.ids, *STATE_BLOCK).replies
        for id_ in servo_map.ids:
            missed[id_] += id_ not in replies
    if all(count == TRIAL_READS for count in missed.values()):
        return ["nobody answers a sync read: is the adapter's latency timer at 1 ms?"]
    return [
        f"{servo.joint} (ID {servo.id}): {missed[servo.id]} of {TRIAL_READS} answers were missing or garbled; "
        "two servos with this ID, or a bad cable?"
        for servo in servo_map.servos
        if missed[servo.id] > TRIAL_MISSES
    ]
