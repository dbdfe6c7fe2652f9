"""Servos on a virtual line: registers, motion, heating, supply, watchdogs, and the firmware that answers requests."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynsim.hardware.bus.control_table import (
    BAUD_RATES,
    BROADCAST_ID,
    PWM_PER_UNIT,
    RAD_PER_TICK,
    RAD_S2_PER_UNIT,
    RAD_S_PER_UNIT,
    TABLE_SIZE,
    TICKS_PER_TURN,
    VOLT_PER_UNIT,
    WATCHDOG_SECONDS_PER_UNIT,
    Field,
    OperatingMode,
    ServoModel,
)
from dynsim.hardware.bus.packet import ALERT, STATUS, Instruction, Packet, StatusError, encode, encode_fast
from dynsim.hardware.virtual.faults import AngleFault, Fault, FaultScript, TemperatureRamp, VoltageSag
from dynsim.hardware.virtual.simulated_plant import Drive, InertialLoad, ServoPlant

# Registers of one virtual servo; the access rules are the same as in a real servo.


GOAL_LIMITS = {"goal_pwm": "pwm_limit", "goal_current": "current_limit", "goal_velocity": "velocity_limit"}
MODES = {True: (0, 1, 3, 4, 5, 16), False: (1, 3, 4, 16)}
"""Operating modes of servos with and without a current sensor."""


class ServoRegisters:
    """Control table of one servo.

    Attributes
    ----------
    model : ServoModel
    """

    def __init__(self, model: ServoModel, id_: int, baud_code: int) -> None:
        self.model = model
        self._table = bytearray(TABLE_SIZE)
        self._field_at = {item.address: name for name, item in model.fields.items()}
        # Reading a state requires a dozen registers, so look up their addresses once.
        self._spans = {
            name: (slice(item.address, item.address + item.size), item.size, item.signed)
            for name, item in model.fields.items()
        }
        self.reset()
        self["id"], self["baud"] = id_, baud_code

    def __getitem__(self, name: str) -> int:
        span, _, signed = self._spans[name]
        return int.from_bytes(self._table[span], "little", signed=signed)

    def __setitem__(self, name: str, value: int) -> None:
        span, size, signed = self._spans[name]
        self._table[span] = value.to_bytes(size, "little", signed=signed)

    @property
    def baud(self) -> int:
        """Bit rate [bit/s]."""
        return BAUD_RATES[self["baud"]]

    def reset(self, keep: Collection[str] = ()) -> None:
        """Reset all registers except ``keep`` to factory defaults, and restart the servo."""
        kept = {name: self[name] for name in keep}
        for name, item in self.model.fields.items():
            self[name] = kept.get(name, item.default)
        self["model_number"] = self.model.number
        self.restart()

    def restart(self) -> None:
        """Reset the RAM to its state after power-on."""
        for name, item in self.model.fields.items():
            if not item.in_eeprom:
                self[name] = item.default
        for pointers, data, count in self.model.indirect:
            for k in range(count):
                self._table[pointers + 2 * k : pointers + 2 * k + 2] = (data + k).to_bytes(2, "little")
                self._table[data + k] = 0
        if "goal_current" in self.model.fields:
            self["goal_current"] = self["current_limit"]
        self["goal_pwm"] = self["pwm_limit"]

    def read(self, address: int, length: int) -> bytes | None:
        """Return bytes of the table with indirect addresses resolved; None if some bytes are outside the table."""
        if length < 1 or address + length > TABLE_SIZE:
            return None
        if address + length <= self.model.indirect[0][1]:
            return bytes(self._table[address : address + length])
        return bytes(self._table[self._resolve(a)] for a in range(address, address + length))

    def write(self, address: int, data: bytes) -> StatusError:
        """Write consecutive registers, or none of them if there is an error."""
        if not data or address + len(data) > TABLE_SIZE:
            return StatusError.ACCESS
        end = address + len(data)
        direct = end <= self.model.indirect[0][0]
        targets = range(address, end) if direct else [self._resolve(a) for a in range(address, end)]
        pending: list[tuple[str, int]] = []
        position = 0
        while position < len(targets):
            start = targets[position]
            pointer = any(pointers <= start < pointers + 2 * count for pointers, _, count in self.model.indirect)
            unused = any(first <= start < first + count for _, first, count in self.model.indirect)
            if pointer or (unused and start == address + position):
                if pointer and self["torque_enable"]:
                    return StatusError.ACCESS
                self._table[start] = data[position]
                position += 1
                continue
            name = self._field_at.get(start)
            if name is None:
                return StatusError.ACCESS
            item = self.model.fields[name]
            whole = range(start, start + item.size)
            if targets[position : position + item.size] != (whole if direct else [*whole]):
                return StatusError.DATA_LENGTH
            value = item.decode(data[position : position + item.size])
            error = self._objection(name, item, value)
            if error:
                return error
            pending.append((name, value))
            position += item.size
        for name, value in pending:
            self[name] = value
        return StatusError.NONE

    def _objection(self, name: str, field: Field, value: int) -> StatusError:
        if not field.writable or (field.in_eeprom and self["torque_enable"]):
            return StatusError.ACCESS
        if field.low is not None and not field.low <= value <= (field.high or 0):
            return StatusError.DATA_RANGE
        if name == "operating_mode" and value not in MODES[self.model.measures_current]:
            return StatusError.DATA_RANGE
        if name in GOAL_LIMITS or name == "goal_position":
            if self["bus_watchdog"] == -1:
                return StatusError.DATA_RANGE
            low, high = self._goal_range(name)
            if not low <= value <= high:
                return StatusError.DATA_LIMIT
        if name == "torque_enable" and value and self["hardware_error"] & self["shutdown"]:
            return StatusError.RESULT_FAIL
        return StatusError.NONE

    def _goal_range(self, name: str) -> tuple[int, int]:
        if name == "goal_position":
            if self["operating_mode"] == OperatingMode.POSITION:
                return self["min_position"], self["max_position"]
            # Multi-turn modes have no position limits.
            return -1_048_575, 1_048_575
        limit = self[GOAL_LIMITS[name]]
        return -limit, limit

    def _resolve(self, address: int) -> int:
        for pointers, data, count in self.model.indirect:
            if data <= address < data + count:
                at = pointers + 2 * (address - data)
                target = int.from_bytes(self._table[at : at + 2], "little")
                # A real servo follows a pointer to another indirect byte only once.
                return target if target < TABLE_SIZE else address
        return address


PROTOCOL = 2
"""Protocol version used on the line. A servo that is set to another version never answers."""
PHYSICS_STEP = 2e-3
COMMUNICATION_END = 14
"""Communication settings (IDs, bit rate, protocol) have addresses below this address."""
GOALS = range(100, 120)
"""Addresses of the goals and the profile; writing to these addresses does not change the torque state or the mode."""
TRAJECTORY = 136, 144
"""Addresses of the speed and position of the profile, which are updated only when they are read."""
STATE = range(124, 136)
"""Addresses of load, speed and position; each cycle reads them, but not the voltage, the temperature and the clock."""
BOOT_TIME = 0.3
"""Time after a reboot in which a servo does not answer [s] (unverified)."""
AMBIENT = 25.0  # °C
THERMAL_RESISTANCE = 2.0  # K/W (unverified)
THERMAL_TIME = 300.0  # s (unverified)
OVERLOAD_FRACTION = 0.9  # fraction of the stall torque (unverified)
OVERLOAD_TIME = 1.0  # s (unverified)
CURRENT_NOISE = 3e-3
"""Standard deviation of the measured current as a fraction of the stall current (unverified)."""
SUPPLY_RESISTANCE = 0.05  # Ω
BROWN_OUT = 0.5
"""Fraction of the rated voltage below which the electronics of the servos stop, and above which they restart
(unverified)."""
OVERHEATING, OVERLOAD, INPUT_VOLTAGE = 1 << 2, 1 << 5, 1 << 0


@dataclass
class BaudGroup:
    """Servos with the same bit rate, identified by their initial IDs.

    Attributes
    ----------
    by_id : dict of int to list of int
        Initial IDs of the servos by their present ID; several servos may have the same present ID.
    members : int array
        Indices of the servos in the list of all servos.
    """

    by_id: dict[int, list[int]] = field(default_factory=dict)
    members: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


def group_by_baud(servos: Mapping[int, ServoRegisters]) -> dict[int, BaudGroup]:
    """Return the servos that receive packets at each bit rate [bit/s], according to their present registers."""
    groups: dict[int, BaudGroup] = {}
    for index, (first_id, registers) in enumerate(servos.items()):
        if registers["protocol"] != PROTOCOL:
            continue
        group = groups.setdefault(registers.baud, BaudGroup())
        group.members = np.append(group.members, index)
        group.by_id.setdefault(registers["id"], []).append(first_id)
    return groups


class VirtualServos:
    """N servos and the plant that they drive.

    Parameters
    ----------
    registers : mapping of int to ServoRegisters
        Registers by initial ID. If the ID of a servo is changed later, this key and the ID in fault scripts stay the
        same.
    positions : iterable of float
        Initial servo angles [rad], 0 at tick 0.
    plant : ServoPlant or None
        Plant that the servos drive; if None, each servo drives a separate inertia.
    script : FaultScript
        Scripted faults; :class:`~dynsim.hardware.virtual.line.VirtualLine` applies those of status packets.

    Attributes
    ----------
    supply : float
        Supply voltage without load [V].
    registers : dict
        ServoRegisters by initial ID.
    ids : list of int
        Initial IDs.
    baud_groups : dict of int to BaudGroup
        Servos that receive packets at each bit rate.
    time : float
        Simulated time of the servos [s].
    torque_since : float
        Time at which the torque of any servo was first switched on [s]; infinite before this time.
    last_packet : array, shape (N,)
        Time of the last packet that each servo could receive [s]; used by the watchdogs.
    dead : set of int
        IDs of the servos whose power or cable is lost.
    unplugged : bool
        True if the adapter was unplugged.
    temperature : array, shape (N,)
        Temperature of the windings [°C].
    play : array, shape (N,)
        Angle of the output side of the backlash [rad].
    """

    def __init__(
        self,
        registers: Mapping[int, ServoRegisters],
        *,
        positions: Iterable[float],
        plant: ServoPlant | None,
        script: FaultScript,
    ) -> None:
        self.registers = dict(registers)
        self.ids = list(registers)
        self.baud_groups = group_by_baud(self.registers)
        self._models = [table.model for table in registers.values()]
        self.plant: ServoPlant = plant or InertialLoad(self._models, np.array(list(positions), dtype=np.float64))
        self.supply = min(model.rated_voltage for model in self._models)
        self._brown_out = BROWN_OUT * self.supply
        self.time = 0.0
        self.torque_since = math.inf
        self.dead: set[int] = set()
        self.unplugged = False
        self._fired: set[int] = set()
        self._powered = self._switched_on = True
        self._script = script
        count = len(self.ids)
        self.last_packet, self._set_rate, self._watchdog, self._overload = np.zeros((4, count))
        self._drive = Drive(
            np.zeros(count, dtype=bool),
            np.ones(count, dtype=bool),
            self.plant.position.copy(),
            np.zeros(count),
            self.supply,
        )
        self._goal_position, self._goal_velocity = self.plant.position.copy(), np.zeros(count)
        self._profile_velocity, self._profile_acceleration = np.zeros(count), np.zeros(count)
        self._temperature_limit, self._min_voltage = np.zeros(count), np.zeros(count)
        self._noise = np.random.default_rng(script.seed)
        self.temperature = np.full(count, AMBIENT + 5.0)
        self.play = self.plant.position.copy()
        self._turns = np.zeros(count, dtype=np.int64)
        self._sense = [1] * count
        self._boot_until: dict[int, float] = {}
        self._overload_torque = OVERLOAD_FRACTION * np.array([model.stall_torque for model in self._models])
        self._resistance = np.array([model.rated_voltage / model.stall_current for model in self._models])
        self._ampere_per_newtonmetre = np.array([1 / model.torque_constant for model in self._models])
        for index in range(count):
            self.reload(index)
            self.hold_position(index)
            self.reload(index)
        self.inject()

    def active_faults(self) -> list[Fault]:
        """Return the faults of the script that are active now."""
        if not self._script.faults:
            return []
        since = self.time - self.torque_since
        return [fault for fault in self._script.faults if fault.active(since)]

    def _next_fault(self) -> float:
        """Return the time of the next start or end of a fault [s]."""
        changes = [self.torque_since + time for fault in self._script.faults for time in fault.span]
        return min((time for time in changes if time > self.time), default=math.inf)

    def inject(self) -> None:
        """Apply the faults that change a servo: once when they become active, a jam at every step."""
        on = not any(fault.kind == "supply_loss" for fault in self.active_faults())
        if on != self._switched_on:
            self._switched_on = on
            self._update_supply(0.0)
        for number, fault in enumerate(self._script.faults):
            if not fault.active(self.time - self.torque_since):
                continue
            if fault.kind == "stuck" and fault.id in self.registers:
                self.plant.stop(self.ids.index(fault.id))
            if number in self._fired:
                continue
            self._fired.add(number)
            if fault.kind == "unplug":
                self.unplugged = True
            if getattr(fault, "id", None) in self.registers:
                self._inject_into_servo(fault)

    def _inject_into_servo(self, fault: Any) -> None:
        index, registers = self.ids.index(fault.id), self.registers[fault.id]
        match fault.kind:
            case "wrong_model" | "wrong_firmware" | "wrong_mode":
                registers[fault.register] = fault.value
                self.reload(index)
            case "drop_off":
                self.dead.add(fault.id)
                registers["torque_enable"] = 0
                self.reload(index)
            case "reboot":
                self.reboot(fault.id)
            case "overload":
                self.raise_error(index, OVERLOAD)
            case "overheat":
                self.temperature[index] = registers["temperature_limit"] + 1.0
                self.raise_error(index, OVERHEATING)
            case "watchdog_trip":
                self.trip_watchdog(index)
            case "backlash":
                self.play[index] = self.plant.position[index]

    # -- requests -----------------------------------------------------------------------------------------------------

    def receives(self, id_: int) -> bool:
        """Return True if a servo can receive packets now."""
        there = self._powered and id_ in self.registers and id_ not in self.dead
        return there and self.time >= self._boot_until.get(id_, 0.0)

    def read(self, id_: int, address: int, length: int) -> bytes | None:
        """Return bytes of a servo's control table, with present measurements; None if they are outside the table."""
        index = self.ids.index(id_)
        self.measure(index, motion_only=STATE.start <= address and address + length <= STATE.stop)
        if address < TRAJECTORY[1] and address + length > TRAJECTORY[0]:
            registers = self.registers[id_]
            registers["position_trajectory"] = self._present_ticks(index, self._drive.set_position[index])
            rate = self._set_rate[index] if self._drive.in_position_mode[index] else self._drive.set_velocity[index]
            registers["velocity_trajectory"] = round(self._sense[index] * float(rate) / RAD_S_PER_UNIT)
        return self.registers[id_].read(address, length)

    def write(self, id_: int, address: int, data: bytes) -> StatusError:
        """Write to the control table of a servo, and apply the consequences for its state."""
        registers, index = self.registers[id_], self.ids.index(id_)
        torque, mode = registers["torque_enable"], registers["operating_mode"]
        if error := registers.write(address, data):
            return error
        if GOALS.start <= address and address + len(data) <= GOALS.stop:
            self._load_goals(index)
            return StatusError.NONE
        if registers["operating_mode"] != mode:
            self.reload(index)
            self.reset_turns(index)
        if registers["torque_enable"] and not torque:
            self.hold_position(index)
            if self.torque_since == math.inf:
                self.torque_since = self.time
        self.reload(index)
        if address < COMMUNICATION_END:
            self.baud_groups = group_by_baud(self.registers)
        return StatusError.NONE

    def reset(self, id_: int, keep: Collection[str]) -> None:
        """Reset a servo to factory defaults except the registers ``keep``, and restart it."""
        self.registers[id_].reset(keep)
        self.reload(self.ids.index(id_))
        self.baud_groups = group_by_baud(self.registers)
        self.reboot(id_)

    def reboot(self, id_: int) -> None:
        """Reset a servo to its power-on state; it does not answer for BOOT_TIME."""
        index = self.ids.index(id_)
        self.registers[id_].restart()
        self.reset_turns(index)
        self._overload[index] = 0.0
        self._boot_until[id_] = self.time + BOOT_TIME
        self.reload(index)

    def _update_supply(self, current: float) -> None:
        """Update the supply voltage for a total current [A]; servos fail below BROWN_OUT and restart above it."""
        sag = sum(fault.drop for fault in self.active_faults() if isinstance(fault, VoltageSag))
        self._drive.voltage = (self.supply - sag - SUPPLY_RESISTANCE * current) * self._switched_on
        powered = self._drive.voltage >= self._brown_out
        if powered != self._powered:
            self._powered = powered
            for id_ in self.ids:
                self.reboot(id_)

    def reset_turns(self, index: int) -> None:
        """Restart the count of turns at the present position."""
        self._turns[index] = self._sense[index] * round(self.plant.position[index] / RAD_PER_TICK) // TICKS_PER_TURN

    # -- motion, heat, supply -----------------------------------------------------------------------------------------

    def step(self, until: float) -> None:
        """Execute one physics step or, if nothing moves, all steps until ``until`` [s] or until a fault changes."""
        if not self._drive.enabled.any() and self.plant.rests:
            # Nothing moves: update the temperatures in one long step, so that waiting for pings is not slow.
            steps = max(1, int((min(until, self._next_fault()) - self.time) / PHYSICS_STEP))
            self.time += steps * PHYSICS_STEP
            self._warm(steps * PHYSICS_STEP)
        else:
            self.time += PHYSICS_STEP
            self._set_points(PHYSICS_STEP)
            self.plant.step(PHYSICS_STEP, self._drive)
            self._warm(PHYSICS_STEP)
            self._watch()

    def _set_points(self, dt: float) -> None:
        """Move the set points towards the goals, with the speed and acceleration of the profile (0: unlimited)."""
        drive = self._drive
        to_go = self._goal_position - drive.set_position
        acceleration = np.where(self._profile_acceleration > 0, self._profile_acceleration, np.inf)
        speed = np.where(self._profile_velocity > 0, self._profile_velocity, np.inf)
        distance = np.abs(to_go)
        # Maximum speed that still allows braking before the goal; it is 0 at the goal, whatever the acceleration.
        braking = np.sqrt(2 * acceleration * np.maximum(distance, 1e-12))
        wanted = np.sign(to_go) * np.minimum(np.minimum(speed, braking), distance / dt)
        change = acceleration * dt
        self._set_rate = np.minimum(np.maximum(wanted, self._set_rate - change), self._set_rate + change)
        drive.set_position = drive.set_position + dt * self._set_rate
        drive.set_velocity = np.minimum(
            np.maximum(self._goal_velocity, drive.set_velocity - change), drive.set_velocity + change
        )

    def _warm(self, dt: float) -> None:
        torque = np.abs(self.plant.torque) * self._drive.enabled
        current = torque * self._ampere_per_newtonmetre
        heat = current**2 * self._resistance
        target = AMBIENT + THERMAL_RESISTANCE * heat
        self.temperature += (target - self.temperature) * -math.expm1(-dt / THERMAL_TIME)
        self._overload = np.where(torque > self._overload_torque, self._overload + dt, 0.0)
        self._update_supply(float(current.sum()))
        for fault in self.active_faults():
            if isinstance(fault, TemperatureRamp) and fault.id in self.registers:
                self.temperature[self.ids.index(fault.id)] += dt * fault.heating_rate

    def _watch(self) -> None:
        enabled = self._drive.enabled
        low_voltage = self._drive.voltage < self._min_voltage
        timed_out = (self._watchdog > 0) & (self.time - self.last_packet > self._watchdog)
        hot = self.temperature > self._temperature_limit
        overloaded = self._overload > OVERLOAD_TIME
        if not (enabled & (low_voltage | timed_out | hot | overloaded)).any():
            return
        for index in map(int, np.flatnonzero(enabled)):
            if overloaded[index]:
                self.raise_error(index, OVERLOAD)
            if hot[index]:
                self.raise_error(index, OVERHEATING)
            if low_voltage[index]:
                self.raise_error(index, INPUT_VOLTAGE)
            if timed_out[index]:
                self.trip_watchdog(index)

    def raise_error(self, index: int, bit: int) -> None:
        """Set a bit in the error register, and switch the torque off if the register ``shutdown`` contains this bit."""
        registers = self.registers[self.ids[index]]
        registers["hardware_error"] |= bit
        if registers["hardware_error"] & registers["shutdown"]:
            registers["torque_enable"] = 0
            self.reload(index)

    def trip_watchdog(self, index: int) -> None:
        """Stop a servo as its watchdog does; it then rejects goals until the watchdog is cleared."""
        self.hold_position(index)
        self.registers[self.ids[index]]["bus_watchdog"] = -1
        self.reload(index)

    # -- registers and motion -----------------------------------------------------------------------------------------

    def _present_ticks(self, index: int, angle: float) -> int:
        ticks = self._sense[index] * round(angle / RAD_PER_TICK) - int(self._turns[index]) * TICKS_PER_TURN
        return ticks + self.registers[self.ids[index]]["homing_offset"]

    def _angle(self, index: int, ticks: int) -> float:
        registers = self.registers[self.ids[index]]
        raw = ticks - registers["homing_offset"] + int(self._turns[index]) * TICKS_PER_TURN
        return self._sense[index] * raw * RAD_PER_TICK

    def hold_position(self, index: int) -> None:
        """Set the goals and the set point to the present position of the shaft."""
        registers = self.registers[self.ids[index]]
        registers["goal_position"] = self._present_ticks(index, self.plant.position[index])
        registers["goal_velocity"] = 0
        self._drive.set_position[index] = self.plant.position[index]
        self._drive.set_velocity[index] = 0.0
        self._set_rate[index] = 0.0

    def reload(self, index: int) -> None:
        """Load the settings that affect the motion from the registers."""
        registers = self.registers[self.ids[index]]
        # Reverse mode changes the direction of the shaft, but not the sign of the homing offset.
        self._sense[index] = -1 if registers["drive_mode"] & 1 else 1
        self._drive.enabled[index] = bool(registers["torque_enable"])
        self._drive.in_position_mode[index] = registers["operating_mode"] != OperatingMode.VELOCITY
        self._temperature_limit[index] = registers["temperature_limit"]
        self._min_voltage[index] = registers["min_voltage"] * VOLT_PER_UNIT
        self._watchdog[index] = max(0, registers["bus_watchdog"]) * WATCHDOG_SECONDS_PER_UNIT
        self._load_goals(index)

    def _load_goals(self, index: int) -> None:
        """Load the goals and the profile from the registers."""
        registers = self.registers[self.ids[index]]
        self._goal_position[index] = self._angle(index, registers["goal_position"])
        self._goal_velocity[index] = self._sense[index] * registers["goal_velocity"] * RAD_S_PER_UNIT
        self._profile_velocity[index] = registers["profile_velocity"] * RAD_S_PER_UNIT
        self._profile_acceleration[index] = registers["profile_acceleration"] * RAD_S2_PER_UNIT

    def measure(self, index: int, *, motion_only: bool = False) -> None:
        """Update the measurements in the registers of one servo."""
        id_ = self.ids[index]
        registers, sense = self.registers[id_], self._sense[index]
        angle = self.plant.position[index]
        for fault in self.active_faults():
            if isinstance(fault, AngleFault) and fault.id == id_:
                if fault.kind == "backlash":
                    half = fault.angle / 2
                    self.play[index] = min(max(self.play[index], angle - half), angle + half)
                    angle = self.play[index]
                else:
                    angle = angle + fault.angle
        model = self._models[index]
        effort = pwm = 0
        if self._drive.enabled[index]:
            load = sense * float(self.plant.torque[index]) / model.stall_torque
            effort = model.effort((load + CURRENT_NOISE * self._noise.standard_normal()) * model.stall_torque)
            # The voltage of the motor is the part that drives the current and the back-EMF, in units of the rated one.
            voltage = load + sense * float(self.plant.velocity[index]) / model.no_load_speed
            pwm = round(voltage * self.supply / max(self._drive.voltage, self._brown_out) / PWM_PER_UNIT)
        registers["present_pwm"] = pwm
        velocity = round(sense * float(self.plant.velocity[index]) / RAD_S_PER_UNIT)
        registers["present_current" if model.measures_current else "present_load"] = effort
        registers["present_velocity"] = velocity
        registers["present_position"] = self._present_ticks(index, float(angle))
        registers["moving"] = int(abs(velocity) > registers["moving_threshold"])
        if motion_only:
            return
        registers["present_voltage"] = max(0, round(self._drive.voltage / VOLT_PER_UNIT))
        registers["present_temperature"] = min(255, max(0, round(float(self.temperature[index]))))
        registers["realtime_tick"] = int(self.time * 1e3) % 32768


# Firmware of the virtual servos: it executes the instructions of Protocol 2.0 and answers them.


CLEAR_TURNS = b"\x01\x44\x58\x4c\x22"
RESET_ALL = 0xFF
KEPT_BY_RESET: dict[int, tuple[str, ...]] = {RESET_ALL: (), 0x01: ("id",), 0x02: ("id", "baud")}
"""Registers that a factory reset does not change, by the parameter of the reset instruction."""


class Answer(NamedTuple):
    """Frame that one servo sends, or that several servos send at the same time.

    Attributes
    ----------
    servos : tuple of int
        Initial IDs of the sending servos; several if they have the same present ID.
    frame : bytes
    chained : bool
        True if the frame directly follows the previous answer, without a pause.
    """

    servos: tuple[int, ...]
    frame: bytes
    chained: bool = False


def merge_frames(frames: Sequence[tuple[int, bytes]]) -> Answer:
    """Merge frames that are sent at the same time: all servos drive the line, and a zero bit wins (unverified)."""
    line = bytearray(max((frame for _, frame in frames), key=len))
    for _, frame in frames:
        for k, byte in enumerate(frame):
            line[k] &= byte
    return Answer(tuple(servo for servo, _ in frames), bytes(line))


def _word(parameters: bytes, at: int) -> int:
    return int.from_bytes(parameters[at : at + 2], "little")


class Firmware:
    """Firmware that executes instructions on servos, which are identified by their initial IDs."""

    def __init__(self, servos: VirtualServos) -> None:
        self._servos = servos
        self._registered: dict[int, tuple[int, bytes]] = {}

    def answers(self, packet: Packet, group: BaudGroup) -> Iterator[Answer]:
        """Execute an instruction and yield the answers, in the order in which they are sent."""
        p = packet.parameters
        match packet.instruction:
            case Instruction.SYNC_READ | Instruction.FAST_SYNC_READ if len(p) >= 5:
                entries = [(id_, _word(p, 0), _word(p, 2)) for id_ in p[4:]]
            case Instruction.BULK_READ | Instruction.FAST_BULK_READ:
                entries = [(p[k], _word(p, k + 1), _word(p, k + 3)) for k in range(0, len(p) - 4, 5)]
            case Instruction.SYNC_WRITE if len(p) >= 4:
                length = _word(p, 2)
                for k in range(4, len(p) - length, length + 1):
                    self._write_silently(p[k], _word(p, 0), p[k + 1 : k + 1 + length], group)
                return
            case Instruction.BULK_WRITE:
                k = 0
                while k + 5 <= len(p):
                    length = _word(p, k + 3)
                    self._write_silently(p[k], _word(p, k + 1), p[k + 5 : k + 5 + length], group)
                    k += 5 + length
                return
            case _:
                yield from self._answers_of_each(packet, group)
                return
        fast = packet.instruction in (Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ)
        yield from (self._fast_read if fast else self._read_many)(entries, group)

    def _write_silently(self, id_: int, address: int, data: bytes, group: BaudGroup) -> None:
        """Write without answering: as on real servos, a rejected goal is not reported."""
        for servo in self._awake(group, id_):
            self._servos.write(servo, address, data)

    def _answers_of_each(self, packet: Packet, group: BaudGroup) -> Iterator[Answer]:
        broadcast = packet.id == BROADCAST_ID
        # Iterate over a copy, because the instruction may change the ID of a servo.
        for id_ in sorted(group.by_id) if broadcast else [packet.id]:
            frames = []
            for servo in self._awake(group, id_):
                reply = self._reply(servo, id_, packet)
                if reply and (not broadcast or packet.instruction == Instruction.PING):
                    frames.append((servo, encode(reply)))
            if frames:
                yield merge_frames(frames)

    def _reply(self, servo: int, id_: int, packet: Packet) -> Packet | None:
        registers, p = self._servos.registers[servo], packet.parameters
        answers_all = registers["status_return_level"] == 2
        match packet.instruction:
            case Instruction.PING:
                data = (registers.read(0, 2) or b"") + bytes([registers["firmware"]])
                return self._status(servo, id_, StatusError.NONE, data)
            case Instruction.READ if len(p) == 4:
                return self._read(servo, id_, _word(p, 0), _word(p, 2))
            case Instruction.WRITE if len(p) >= 3:
                error = self._servos.write(servo, _word(p, 0), p[2:])
            case Instruction.REG_WRITE if len(p) >= 3:
                self._registered[servo] = (_word(p, 0), p[2:])  # until ACTION
                registers["registered_instruction"], error = 1, StatusError.NONE
            case Instruction.ACTION:
                error = self._act(servo)
            case Instruction.REBOOT | Instruction.FACTORY_RESET:
                # Create the answer first, because it describes the state before the restart.
                answer = self._status(servo, id_, StatusError.NONE)
                if packet.instruction == Instruction.REBOOT:
                    self._servos.reboot(servo)
                elif p[:1] == bytes([RESET_ALL]) and packet.id == BROADCAST_ID:
                    return None  # ignored, because it would assign the same ID to all servos
                elif p and p[0] in KEPT_BY_RESET:
                    self._servos.reset(servo, KEPT_BY_RESET[p[0]])
                else:
                    answer = self._status(servo, id_, StatusError.DATA_RANGE)
                return answer if answers_all else None
            case Instruction.CLEAR if p == CLEAR_TURNS:
                error = self._clear_turns(servo)
            case _:
                error = StatusError.INSTRUCTION
        return self._status(servo, id_, error) if answers_all else None

    def _read_many(self, entries: Sequence[tuple[int, int, int]], group: BaudGroup) -> Iterator[Answer]:
        for id_, address, length in entries:
            replies = [(servo, self._read(servo, id_, address, length)) for servo in self._awake(group, id_)]
            if frames := [(servo, encode(reply)) for servo, reply in replies if reply]:
                yield merge_frames(frames)

    def _fast_read(self, entries: Sequence[tuple[int, int, int]], group: BaudGroup) -> Iterator[Answer]:
        """Yield the parts of one packet, one from each servo; servos after a silent servo do not send (unverified)."""
        senders, replies = [], []
        for id_, address, length in entries:
            servo = next(iter(self._awake(group, id_)), None)
            reply = None if servo is None else self._read(servo, id_, address, length)
            if servo is None or reply is None:
                break
            if len(reply.parameters) != length:
                reply = Packet(id_, STATUS, bytes(length), reply.error)
            senders.append(servo)
            replies.append(reply)
        parts = encode_fast(replies, [length for _, _, length in entries])
        for index, (servo, part) in enumerate(zip(senders, parts, strict=True)):
            yield Answer((servo,), part, chained=index > 0)

    def _read(self, servo: int, id_: int, address: int, length: int) -> Packet | None:
        if self._servos.registers[servo]["status_return_level"] == 0:
            return None
        data = self._servos.read(servo, address, length)
        if data is None:
            return self._status(servo, id_, StatusError.ACCESS)
        return self._status(servo, id_, StatusError.NONE, data)

    def _status(self, servo: int, id_: int, error: StatusError, data: bytes = b"") -> Packet:
        alert = ALERT if self._servos.registers[servo]["hardware_error"] else 0
        return Packet(id_, STATUS, data, error | alert)

    def _awake(self, group: BaudGroup, id_: int) -> list[int]:
        """Return the servos that have the ID ``id_`` and can receive packets."""
        return list(filter(self._servos.receives, group.by_id.get(id_, ())))

    def _act(self, servo: int) -> StatusError:
        """Execute the write that was registered for a servo, unless a restart has cleared it."""
        registers = self._servos.registers[servo]
        if not registers["registered_instruction"]:
            return StatusError.RESULT_FAIL
        registers["registered_instruction"] = 0
        return self._servos.write(servo, *self._registered.pop(servo))

    def _clear_turns(self, servo: int) -> StatusError:
        """Restart the count of turns at the present position; return an error if the servo is moving."""
        index = self._servos.ids.index(servo)
        if abs(self._servos.plant.velocity[index]) > self._servos.registers[servo]["moving_threshold"] * RAD_S_PER_UNIT:
            return StatusError.RESULT_FAIL
        self._servos.reset_turns(index)
        return StatusError.NONE
