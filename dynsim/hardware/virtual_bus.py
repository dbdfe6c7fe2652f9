"""Servos in memory: a line with wire time, full control tables, motion, heat, supply, and scripted faults.

:class:`VirtualLine` takes bytes and gives bytes with their arrival times. :class:`VirtualPort` puts it under the client
library on a virtual clock; :mod:`dynsim.hardware.pseudo_terminal` puts it behind a serial device.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import serial
from dynamixel_sdk import PortHandler

from dynsim.hardware.clock import VirtualClock
from dynsim.hardware.control_table import (
    BAUD_RATES,
    BROADCAST_ID,
    RAD_PER_TICK,
    RAD_S2_PER_UNIT,
    RAD_S_PER_UNIT,
    RETURN_DELAY_SECONDS_PER_UNIT,
    TICKS_PER_TURN,
    VOLT_PER_UNIT,
    WATCHDOG_SECONDS_PER_UNIT,
    OperatingMode,
)
from dynsim.hardware.packet import ALERT, STATUS, Decoder, Instruction, Packet, StatusError, crc16, encode
from dynsim.hardware.servo_map import ServoMap
from dynsim.hardware.servo_plant import Drive, InertialLoad, ServoPlant
from dynsim.hardware.virtual_faults import AngleFault, FaultScript, TemperatureRamp, VoltageSag, WrongRegister
from dynsim.hardware.virtual_servo import ServoRegisters

PHYSICS_STEP = 2e-3
BYTE_TIMEOUT = 5e-3
"""Longest pause within a packet [s] (unverified)."""
TURNAROUND = 20e-6
"""Time a servo takes beyond its return delay before it answers [s] (unverified)."""
ADAPTER_LATENCY = 1e-3
"""From the wire to the reader: a USB adapter with its latency timer at 1 ms [s]."""
BOOT_TIME = 0.3
"""Silence after a reboot [s] (unverified)."""
AMBIENT = 25.0  # °C
THERMAL_RESISTANCE = 2.0  # K/W (unverified)
THERMAL_TIME = 300.0  # s (unverified)
OVERLOAD_FRACTION = 0.9  # of stall torque (unverified)
OVERLOAD_TIME = 1.0  # s (unverified)
SUPPLY_RESISTANCE = 0.05  # Ω
OVERHEATING, OVERLOAD, INPUT_VOLTAGE = 1 << 2, 1 << 5, 1 << 0

Listener = Callable[[float, Packet], None]


class VirtualLine:
    """N servos on one half-duplex line.

    Parameters
    ----------
    servos : mapping of int to ServoRegisters
        By ID.
    positions : sequence of float
        Initial servo angles [rad], 0 at tick 0.
    plant : ServoPlant, optional
        What the servos move; every one its own inertia if not given.
    script : FaultScript
    supply : float
        Voltage of the supply without load [V].
    listener : callable, optional
        Called with (time, packet) for every valid instruction packet on the line.
    """

    def __init__(
        self,
        servos: Mapping[int, ServoRegisters],
        *,
        positions: Iterable[float],
        plant: ServoPlant | None = None,
        script: FaultScript | None = None,
        supply: float = 12.0,
        listener: Listener | None = None,
    ) -> None:
        self.servos = dict(servos)
        self.ids = list(servos)
        self._models = [registers.model for registers in servos.values()]
        self.plant: ServoPlant = plant or InertialLoad(self._models, np.array(list(positions), dtype=np.float64))
        self.listener = listener
        self.supply = supply
        self.time = 0.0
        self.torque_since = math.inf
        self.unplugged = False
        self._script = script or FaultScript()
        self._random = random.Random(self._script.seed)
        self._decoder = Decoder()
        count = len(self.ids)
        self._drive = Drive(
            np.zeros(count, dtype=bool), np.ones(count, dtype=bool), self.plant.position.copy(), np.zeros(count), supply
        )
        self._goal_position, self._goal_velocity = self.plant.position.copy(), np.zeros(count)
        self._profile_velocity, self._profile_acceleration = np.zeros(count), np.zeros(count)
        self._set_rate = np.zeros(count)
        self._watchdog = np.zeros(count)
        self._temperature_limit, self._min_voltage = np.zeros(count), np.zeros(count)
        self._temperature = np.full(count, AMBIENT + 5.0)
        self._overload = np.zeros(count)
        self._play = self.plant.position.copy()
        self._turns = np.zeros(count, dtype=np.int64)
        self._last_packet = 0.0
        self._heard = 0.0
        self._boot_until: dict[int, float] = {}
        self._registered: dict[int, tuple[int, bytes]] = {}
        self._fired: set[int] = set()
        self._dead: set[int] = set()
        self._overload_torque = OVERLOAD_FRACTION * np.array([model.stall_torque for model in self._models])
        self._resistance = np.array([12.0 / model.stall_current for model in self._models])
        self._ampere_per_newtonmetre = np.array([1 / model.torque_constant for model in self._models])
        self._jammed_at: dict[int, float] = {}
        for index in range(count):
            self._hold_here(index)
            self._reload(index)
        self._apply_faults()

    # -- the wire -----------------------------------------------------------------------------------------------------

    @property
    def baud(self) -> int:
        """What the servos are set to [bit/s]."""
        return BAUD_RATES[next(iter(self.servos.values()))["baud"]]

    def transmit(self, data: bytes, start: float, baud: int) -> list[tuple[float, bytes]]:
        """Put bytes on the line at ``start`` [s]; the answers, each with the time its last byte reaches the reader.

        Raises
        ------
        OSError
            The adapter was pulled out.
        """
        end = start + len(data) * 10 / baud
        self.advance(end)
        if self.unplugged:
            raise serial.SerialException(5, "Input/output error")
        arrivals: list[tuple[float, bytes]] = []
        if self._any_active("echo"):
            arrivals.append((end + ADAPTER_LATENCY, data))
        # Another bit rate is noise to the servos; a packet that stopped half-way is given up after a while.
        packets = [*self._decoder.flush()] if start - self._heard > BYTE_TIMEOUT else []
        self._heard = end
        if baud == self.baud:
            for packet in [*packets, *self._decoder.feed(data)]:
                arrivals += self._execute(packet, end, baud)
        return arrivals

    def _execute(self, packet: Packet, now: float, baud: int) -> list[tuple[float, bytes]]:
        if packet.instruction == STATUS:
            return []
        self._last_packet = now
        if self.listener:
            self.listener(now, packet)
        arrivals: list[tuple[float, bytes]] = []
        for id_, reply in self._replies(packet):
            registers = self.servos[id_]
            now += registers["return_delay"] * RETURN_DELAY_SECONDS_PER_UNIT + TURNAROUND
            frame = encode(reply)
            now += len(frame) * 10 / baud
            arrivals += self._disturb(id_, frame, now + ADAPTER_LATENCY)
        return arrivals

    def _replies(self, packet: Packet) -> Iterable[tuple[int, Packet]]:
        p = packet.parameters
        if packet.instruction == Instruction.SYNC_READ and len(p) >= 5:
            address, length = int.from_bytes(p[0:2], "little"), int.from_bytes(p[2:4], "little")
            return [reply for id_ in p[4:] if self._listens(id_) for reply in self._read(id_, address, length)]
        if packet.instruction == Instruction.BULK_READ:
            entries = [p[k : k + 5] for k in range(0, len(p) - 4, 5)]
            return [
                reply
                for entry in entries
                if self._listens(entry[0])
                for reply in self._read(
                    entry[0], int.from_bytes(entry[1:3], "little"), int.from_bytes(entry[3:5], "little")
                )
            ]
        if packet.instruction == Instruction.SYNC_WRITE and len(p) >= 4:
            address, length = int.from_bytes(p[0:2], "little"), int.from_bytes(p[2:4], "little")
            for k in range(4, len(p) - length, length + 1):
                if self._listens(p[k]):
                    # Nobody answers a sync write: a refused goal goes unnoticed, as on real servos.
                    self._write(p[k], address, p[k + 1 : k + 1 + length])
            return []
        if packet.instruction == Instruction.BULK_WRITE:
            k = 0
            while k + 5 <= len(p):
                length = int.from_bytes(p[k + 3 : k + 5], "little")
                if self._listens(p[k]):
                    self._write(p[k], int.from_bytes(p[k + 1 : k + 3], "little"), p[k + 5 : k + 5 + length])
                k += 5 + length
            return []
        targets = self.ids if packet.id == BROADCAST_ID else [packet.id]
        replies = [reply for id_ in sorted(targets) if self._listens(id_) for reply in self._single(id_, packet)]
        silent = packet.id == BROADCAST_ID and packet.instruction != Instruction.PING
        return [] if silent else replies

    def _single(self, id_: int, packet: Packet) -> list[tuple[int, Packet]]:
        registers, p = self.servos[id_], packet.parameters
        level = registers["status_return_level"]
        match packet.instruction:
            case Instruction.PING:
                data = registers.read(0, 2) or b""
                return [(id_, self._status(id_, StatusError.NONE, data + bytes([registers["firmware"]])))]
            case Instruction.READ if len(p) == 4:
                return self._read(id_, int.from_bytes(p[0:2], "little"), int.from_bytes(p[2:4], "little"))
            case Instruction.WRITE if len(p) >= 3:
                error = self._write(id_, int.from_bytes(p[0:2], "little"), p[2:])
            case Instruction.REG_WRITE if len(p) >= 3:
                self._registered[id_] = (int.from_bytes(p[0:2], "little"), p[2:])
                registers["registered_instruction"] = 1
                error = StatusError.NONE
            case Instruction.ACTION:
                error = StatusError.RESULT_FAIL
                if id_ in self._registered:
                    address, data = self._registered.pop(id_)
                    registers["registered_instruction"] = 0
                    error = self._write(id_, address, data)
            case Instruction.REBOOT:
                answer = [(id_, self._status(id_, StatusError.NONE))] if level == 2 else []
                self._reboot(id_)
                return answer
            case Instruction.CLEAR if p == b"\x01\x44\x58\x4c\x22":
                self._forget_turns(self.ids.index(id_))
                error = StatusError.NONE
            case _:
                error = StatusError.INSTRUCTION
        return [(id_, self._status(id_, error))] if level == 2 else []

    def _read(self, id_: int, address: int, length: int) -> list[tuple[int, Packet]]:
        registers = self.servos[id_]
        if registers["status_return_level"] == 0:
            return []
        self._measure(self.ids.index(id_))
        data = registers.read(address, length)
        if data is None:
            return [(id_, self._status(id_, StatusError.ACCESS))]
        return [(id_, self._status(id_, StatusError.NONE, data))]

    def _write(self, id_: int, address: int, data: bytes) -> StatusError:
        registers, index = self.servos[id_], self.ids.index(id_)
        torque, mode = registers["torque_enable"], registers["operating_mode"]
        error = registers.write(address, data)
        if error:
            return error
        if registers["operating_mode"] != mode:
            self._forget_turns(index)
        if registers["torque_enable"] and not torque:
            self._hold_here(index)
            if self.torque_since == math.inf:
                self.torque_since = self.time
        self._reload(index)
        return StatusError.NONE

    def _status(self, id_: int, error: StatusError, data: bytes = b"") -> Packet:
        alert = ALERT if self.servos[id_]["hardware_error"] else 0
        return Packet(id_, STATUS, data, error | alert)

    def _listens(self, id_: int) -> bool:
        return id_ in self.servos and id_ not in self._dead and self.time >= self._boot_until.get(id_, 0.0)

    def _disturb(self, id_: int, frame: bytes, arrival: float) -> list[tuple[float, bytes]]:
        """What the scripted faults leave of a status packet."""
        chance = self._random.random
        for fault in self._active_faults():
            if getattr(fault, "id", None) not in (None, id_):
                continue
            match fault.kind:
                case "lost_status" if chance() < fault.probability:
                    return []
                case "truncated_status" if chance() < fault.probability:
                    frame = frame[: self._random.randrange(1, len(frame))]
                case "bad_crc" if chance() < fault.probability:
                    at = self._random.randrange(7, len(frame))
                    frame = frame[:at] + bytes([frame[at] ^ 1 << self._random.randrange(8)]) + frame[at + 1 :]
                case "noise" if chance() < fault.probability:
                    frame = self._random.randbytes(self._random.randrange(1, 12)) + frame
                case "late_status" if chance() < fault.probability:
                    arrival += fault.delay
                case "duplicate_id":
                    # Both drive the line; a zero bit wins. Only measured values differ between the two.
                    frame = bytes(a & b for a, b in zip(frame, self._frame_of_the_other(frame), strict=True))
        return [(arrival, frame)]

    def _frame_of_the_other(self, frame: bytes) -> bytes:
        if len(frame) < 15:
            return frame
        body = bytearray(frame[:-2])
        for k in range(9, len(body)):
            body[k] ^= self._random.randrange(4)
        return bytes(body) + crc16(body).to_bytes(2, "little")

    # -- motion, heat, supply -----------------------------------------------------------------------------------------

    def advance(self, now: float) -> None:
        """Let time pass until ``now`` [s]."""
        while now - self.time >= PHYSICS_STEP:
            if not self._drive.enabled.any() and np.abs(self.plant.velocity).max(initial=0.0) < 1e-4:
                # Nothing moves: one long step for the temperatures, so that waiting for pings costs nothing.
                steps = int((now - self.time) / PHYSICS_STEP)
                self.time += steps * PHYSICS_STEP
                self._warm(steps * PHYSICS_STEP)
            else:
                self.time += PHYSICS_STEP
                self._set_points(PHYSICS_STEP)
                self.plant.step(PHYSICS_STEP, self._drive)
                self._warm(PHYSICS_STEP)
                self._watch()
            self._apply_faults()

    def _set_points(self, dt: float) -> None:
        """Profile generator: a set point that runs to the goal with limited speed and acceleration (0: unlimited)."""
        drive = self._drive
        to_go = self._goal_position - drive.set_position
        acceleration = np.where(self._profile_acceleration > 0, self._profile_acceleration, np.inf)
        speed = np.where(self._profile_velocity > 0, self._profile_velocity, np.inf)
        distance = np.abs(to_go)
        # The speed from which it can still brake before the goal; at the goal that is 0, whatever the acceleration.
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
        self._temperature += (target - self._temperature) * -math.expm1(-dt / THERMAL_TIME)
        self._overload = np.where(torque > self._overload_torque, self._overload + dt, 0.0)
        sag = sum(fault.drop for fault in self._active_faults() if isinstance(fault, VoltageSag))
        self._drive.voltage = self.supply - sag - SUPPLY_RESISTANCE * float(current.sum())
        for fault in self._active_faults():
            if isinstance(fault, TemperatureRamp) and fault.id in self.servos:
                self._temperature[self.ids.index(fault.id)] += dt * fault.heating_rate

    def _watch(self) -> None:
        enabled = self._drive.enabled
        low_voltage = self._drive.voltage < self._min_voltage
        unheard = (self._watchdog > 0) & (self.time - self._last_packet > self._watchdog)
        hot = self._temperature > self._temperature_limit
        overloaded = self._overload > OVERLOAD_TIME
        if not (enabled & (low_voltage | unheard | hot | overloaded)).any():
            return
        for index in map(int, np.flatnonzero(enabled)):
            if overloaded[index]:
                self._raise_error(index, OVERLOAD)
            if hot[index]:
                self._raise_error(index, OVERHEATING)
            if low_voltage[index]:
                self._raise_error(index, INPUT_VOLTAGE)
            if unheard[index]:
                self._trip_watchdog(index)

    def _raise_error(self, index: int, bit: int) -> None:
        registers = self.servos[self.ids[index]]
        registers["hardware_error"] |= bit
        if registers["hardware_error"] & registers["shutdown"]:
            registers["torque_enable"] = 0
            self._reload(index)

    def _trip_watchdog(self, index: int) -> None:
        self._hold_here(index)
        self.servos[self.ids[index]]["bus_watchdog"] = -1
        self._reload(index)

    def _reboot(self, id_: int) -> None:
        index = self.ids.index(id_)
        self.servos[id_].restart()
        self._forget_turns(index)
        self._overload[index] = 0.0
        self._boot_until[id_] = self.time + BOOT_TIME
        self._reload(index)

    # -- registers and motion -----------------------------------------------------------------------------------------

    def _sense(self, index: int) -> int:
        # Reverse mode turns the shaft's sense, not that of the homing offset.
        return -1 if self.servos[self.ids[index]]["drive_mode"] & 1 else 1

    def _present_ticks(self, index: int, angle: float) -> int:
        registers = self.servos[self.ids[index]]
        ticks = self._sense(index) * round(angle / RAD_PER_TICK) - int(self._turns[index]) * TICKS_PER_TURN
        return ticks + registers["homing_offset"]

    def _angle(self, index: int, ticks: int) -> float:
        registers = self.servos[self.ids[index]]
        raw = ticks - registers["homing_offset"] + int(self._turns[index]) * TICKS_PER_TURN
        return self._sense(index) * raw * RAD_PER_TICK

    def _forget_turns(self, index: int) -> None:
        self._turns[index] = self._sense(index) * round(self.plant.position[index] / RAD_PER_TICK) // TICKS_PER_TURN

    def _hold_here(self, index: int) -> None:
        registers = self.servos[self.ids[index]]
        registers["goal_position"] = self._present_ticks(index, self.plant.position[index])
        registers["goal_velocity"] = 0
        self._drive.set_position[index] = self.plant.position[index]
        self._drive.set_velocity[index] = 0.0
        self._set_rate[index] = 0.0

    def _reload(self, index: int) -> None:
        """Take over what the motion needs from the registers."""
        registers, sense = self.servos[self.ids[index]], self._sense(index)
        self._drive.enabled[index] = bool(registers["torque_enable"])
        self._drive.in_position_mode[index] = registers["operating_mode"] != OperatingMode.VELOCITY
        self._goal_position[index] = self._angle(index, registers["goal_position"])
        self._goal_velocity[index] = sense * registers["goal_velocity"] * RAD_S_PER_UNIT
        self._profile_velocity[index] = registers["profile_velocity"] * RAD_S_PER_UNIT
        self._profile_acceleration[index] = registers["profile_acceleration"] * RAD_S2_PER_UNIT
        self._temperature_limit[index] = registers["temperature_limit"]
        self._min_voltage[index] = registers["min_voltage"] * VOLT_PER_UNIT
        self._watchdog[index] = max(0, registers["bus_watchdog"]) * WATCHDOG_SECONDS_PER_UNIT

    def _measure(self, index: int) -> None:
        """Bring the registers of one servo up to date before they are read."""
        id_ = self.ids[index]
        registers, sense = self.servos[id_], self._sense(index)
        angle = self.plant.position[index]
        for fault in self._active_faults():
            if isinstance(fault, AngleFault) and fault.id == id_:
                if fault.kind == "backlash":
                    half = fault.angle / 2
                    self._play[index] = min(max(self._play[index], angle - half), angle + half)
                    angle = self._play[index]
                else:
                    angle = angle + fault.angle
        model = self._models[index]
        effort = model.effort(sense * float(self.plant.torque[index]) * bool(self._drive.enabled[index]))
        velocity = round(sense * float(self.plant.velocity[index]) / RAD_S_PER_UNIT)
        registers["present_current" if model.measures_current else "present_load"] = effort
        registers["present_velocity"] = velocity
        registers["present_position"] = self._present_ticks(index, float(angle))
        registers["present_voltage"] = max(0, round(self._drive.voltage / VOLT_PER_UNIT))
        registers["present_temperature"] = min(255, max(0, round(float(self._temperature[index]))))
        registers["realtime_tick"] = int(self.time * 1e3) % 32768
        registers["moving"] = int(abs(velocity) > registers["moving_threshold"])

    # -- faults -------------------------------------------------------------------------------------------------------

    def _active_faults(self) -> list[Any]:
        if not self._script.faults:
            return []
        since = self.time - self.torque_since
        return [fault for fault in self._script.faults if fault.active(since)]

    def _any_active(self, kind: str) -> bool:
        return any(fault.kind == kind for fault in self._active_faults())

    def _apply_faults(self) -> None:
        """Faults that change a servo: once when they become active, the jam at every step."""
        for number, fault in enumerate(self._script.faults):
            if not fault.active(self.time - self.torque_since):
                continue
            if fault.kind == "stuck" and fault.id in self.servos:
                self._jam(self.ids.index(fault.id), first=number not in self._fired)
            if number in self._fired:
                continue
            self._fired.add(number)
            if fault.kind == "unplug":
                self.unplugged = True
            if getattr(fault, "id", None) in self.servos:
                self._strike(fault)

    def _strike(self, fault: Any) -> None:
        id_ = fault.id
        index = self.ids.index(id_)
        registers = self.servos[id_]
        if isinstance(fault, WrongRegister):
            name = {"wrong_model": "model_number", "wrong_firmware": "firmware", "wrong_mode": "operating_mode"}[
                fault.kind
            ]
            registers[name] = fault.value
            self._reload(index)
        match fault.kind:
            case "drop_off":
                self._dead.add(id_)
                registers["torque_enable"] = 0
                self._reload(index)
            case "reboot":
                self._reboot(id_)
            case "overload":
                self._raise_error(index, OVERLOAD)
            case "overheat":
                self._temperature[index] = registers["temperature_limit"] + 1.0
                self._raise_error(index, OVERHEATING)
            case "watchdog_trip":
                self._trip_watchdog(index)
            case "backlash":
                self._play[index] = self.plant.position[index]

    def _jam(self, index: int, *, first: bool) -> None:
        if first:
            self._jammed_at[index] = float(self.plant.position[index])
        self.plant.position[index] = self._jammed_at[index]
        self.plant.stop(index)


def line_for_map(servo_map: ServoMap, **options: Any) -> VirtualLine:
    """The servos of a map as they should be configured, every joint at its zero.

    Keyword arguments are those of :class:`VirtualLine`; ``posture`` [rad by joint] starts joints elsewhere.
    """
    posture = options.pop("posture", {})
    angles = []
    for servo in servo_map.servos:
        start = posture.get(servo.joint, servo.hold_at or 0.0)
        low, high = servo.position_limits
        angles.append(servo.to_ticks(min(max(start, low), high)) * RAD_PER_TICK)
    servos = {}
    for servo in servo_map.servos:
        registers = ServoRegisters(servo.model, servo.id, BAUD_RATES.index(servo_map.bus.baud))
        registers["operating_mode"] = servo.operating_mode
        registers["return_delay"] = int(servo_map.bus.return_delay / RETURN_DELAY_SECONDS_PER_UNIT)
        servos[servo.id] = registers
    return VirtualLine(servos, positions=angles, **options)


class VirtualPort(PortHandler):
    """The client library's port on a :class:`VirtualLine` and a :class:`VirtualClock`.

    Nothing here waits: reading with nothing to read lets virtual time pass until the next byte or the time-out.
    """

    POLL = 1e-5

    def __init__(self, line: VirtualLine, clock: VirtualClock, *, baud: int) -> None:
        super().__init__("virtual")
        self.line = line
        self.clock = clock
        self.baudrate = baud
        self.is_open = True
        self.tx_time_per_byte = 1e3 / baud * 10.0
        self._arriving: deque[tuple[float, bytes]] = deque()
        self._input = bytearray()

    def openPort(self) -> bool:
        return True

    def closePort(self) -> None:
        self.is_open = False

    def setBaudRate(self, baudrate: int) -> bool:
        if self.getCFlagBaud(baudrate) <= 0:
            return False
        self.baudrate = baudrate
        self.tx_time_per_byte = 1e3 / baudrate * 10.0
        return True

    def getCurrentTime(self) -> float:
        return self.clock.now() * 1e3

    def clearPort(self) -> None:
        self._receive()
        self._input.clear()

    def getBytesAvailable(self) -> int:
        self._receive()
        return len(self._input)

    def writePort(self, packet: Any) -> int:
        data = bytes(packet)
        start = self.clock.now()
        arrivals = self.line.transmit(data, start, self.baudrate)
        self.clock.sleep_until(start + len(data) * 10 / self.baudrate)
        self._arriving = deque(sorted([*self._arriving, *arrivals], key=lambda arrival: arrival[0]))
        return len(data)

    def readPort(self, length: int) -> bytes:
        self._receive()
        if not self._input:
            time_out = (self.packet_start_time + self.packet_timeout) * 1e-3
            soon = max(self.clock.now(), time_out) + self.POLL
            self.clock.sleep_until(min(soon, self._arriving[0][0]) if self._arriving else soon)
            self._receive()
        data = bytes(self._input[:length])
        del self._input[:length]
        return data

    def _receive(self) -> None:
        self.line.advance(self.clock.now())
        if self.line.unplugged:
            raise serial.SerialException(5, "Input/output error")
        while self._arriving and self._arriving[0][0] <= self.clock.now() + 1e-12:
            self._input += self._arriving.popleft()[1]
