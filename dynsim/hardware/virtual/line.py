"""Servos in memory on one half-duplex line: bytes in, bytes out with their arrival times.

:class:`dynsim.hardware.virtual.port.VirtualPort` puts a line under the client library on a virtual clock,
:mod:`dynsim.hardware.virtual.pseudo_terminal` behind a serial device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import serial

from dynsim.hardware.bus.control_table import (
    BAUD_RATES,
    BROADCAST_ID,
    RAD_PER_TICK,
    RETURN_DELAY_SECONDS_PER_UNIT,
)
from dynsim.hardware.bus.packet import ALERT, STATUS, Decoder, Instruction, Packet, StatusError, encode
from dynsim.hardware.servo_map import ServoMap
from dynsim.hardware.virtual.faults import FaultScript
from dynsim.hardware.virtual.injection import Injection
from dynsim.hardware.virtual.registers import ServoRegisters
from dynsim.hardware.virtual.servo_plant import ServoPlant
from dynsim.hardware.virtual.servos import PHYSICS_STEP, VirtualServos

BYTE_TIMEOUT = 5e-3
"""Longest pause within a packet [s] (unverified)."""
TURNAROUND = 20e-6
"""Time a servo takes beyond its return delay before it answers [s] (unverified)."""
ADAPTER_LATENCY = 1e-3
"""From the wire to the reader: a USB adapter with its latency timer at 1 ms [s]."""

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
        script = script or FaultScript()
        self.servos = VirtualServos(servos, positions=positions, plant=plant, script=script, supply=supply)
        self.listener = listener
        self._faults = Injection(self.servos, script)
        self._decoder = Decoder()
        self._heard = 0.0
        self._registered: dict[int, tuple[int, bytes]] = {}
        self._faults.apply()

    @property
    def time(self) -> float:
        """[s]."""
        return self.servos.time

    @property
    def unplugged(self) -> bool:
        """The adapter was pulled out."""
        return self._faults.unplugged

    def advance(self, now: float) -> None:
        """Let time pass until ``now`` [s]."""
        while now - self.servos.time >= PHYSICS_STEP:
            self.servos.step(now)
            self._faults.apply()

    @property
    def baud(self) -> int:
        """What the servos are set to [bit/s]."""
        return BAUD_RATES[next(iter(self.servos.registers.values()))["baud"]]

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
        if self._faults.echo:
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
        self.servos.heard = now
        if self.listener:
            self.listener(now, packet)
        arrivals: list[tuple[float, bytes]] = []
        for id_, reply in self._replies(packet):
            registers = self.servos.registers[id_]
            now += registers["return_delay"] * RETURN_DELAY_SECONDS_PER_UNIT + TURNAROUND
            frame = encode(reply)
            now += len(frame) * 10 / baud
            arrivals += self._faults.disturb(id_, frame, now + ADAPTER_LATENCY)
        return arrivals

    def _replies(self, packet: Packet) -> Iterable[tuple[int, Packet]]:
        p = packet.parameters
        if packet.instruction == Instruction.SYNC_READ and len(p) >= 5:
            address, length = int.from_bytes(p[0:2], "little"), int.from_bytes(p[2:4], "little")
            return [reply for id_ in p[4:] if self.servos.listens(id_) for reply in self._read(id_, address, length)]
        if packet.instruction == Instruction.BULK_READ:
            entries = [p[k : k + 5] for k in range(0, len(p) - 4, 5)]
            return [
                reply
                for entry in entries
                if self.servos.listens(entry[0])
                for reply in self._read(
                    entry[0], int.from_bytes(entry[1:3], "little"), int.from_bytes(entry[3:5], "little")
                )
            ]
        if packet.instruction == Instruction.SYNC_WRITE and len(p) >= 4:
            address, length = int.from_bytes(p[0:2], "little"), int.from_bytes(p[2:4], "little")
            for k in range(4, len(p) - length, length + 1):
                if self.servos.listens(p[k]):
                    # Nobody answers a sync write: a refused goal goes unnoticed, as on real servos.
                    self.servos.write(p[k], address, p[k + 1 : k + 1 + length])
            return []
        if packet.instruction == Instruction.BULK_WRITE:
            k = 0
            while k + 5 <= len(p):
                length = int.from_bytes(p[k + 3 : k + 5], "little")
                if self.servos.listens(p[k]):
                    self.servos.write(p[k], int.from_bytes(p[k + 1 : k + 3], "little"), p[k + 5 : k + 5 + length])
                k += 5 + length
            return []
        targets = self.servos.ids if packet.id == BROADCAST_ID else [packet.id]
        replies = [reply for id_ in sorted(targets) if self.servos.listens(id_) for reply in self._single(id_, packet)]
        silent = packet.id == BROADCAST_ID and packet.instruction != Instruction.PING
        return [] if silent else replies

    def _single(self, id_: int, packet: Packet) -> list[tuple[int, Packet]]:
        registers, p = self.servos.registers[id_], packet.parameters
        level = registers["status_return_level"]
        match packet.instruction:
            case Instruction.PING:
                data = registers.read(0, 2) or b""
                return [(id_, self._status(id_, StatusError.NONE, data + bytes([registers["firmware"]])))]
            case Instruction.READ if len(p) == 4:
                return self._read(id_, int.from_bytes(p[0:2], "little"), int.from_bytes(p[2:4], "little"))
            case Instruction.WRITE if len(p) >= 3:
                error = self.servos.write(id_, int.from_bytes(p[0:2], "little"), p[2:])
            case Instruction.REG_WRITE if len(p) >= 3:
                self._registered[id_] = (int.from_bytes(p[0:2], "little"), p[2:])
                registers["registered_instruction"] = 1
                error = StatusError.NONE
            case Instruction.ACTION:
                error = StatusError.RESULT_FAIL
                if id_ in self._registered:
                    address, data = self._registered.pop(id_)
                    registers["registered_instruction"] = 0
                    error = self.servos.write(id_, address, data)
            case Instruction.REBOOT:
                answer = [(id_, self._status(id_, StatusError.NONE))] if level == 2 else []
                self.servos.reboot(id_)
                return answer
            case Instruction.CLEAR if p == b"\x01\x44\x58\x4c\x22":
                self.servos.forget_turns(self.servos.ids.index(id_))
                error = StatusError.NONE
            case _:
                error = StatusError.INSTRUCTION
        return [(id_, self._status(id_, error))] if level == 2 else []

    def _read(self, id_: int, address: int, length: int) -> list[tuple[int, Packet]]:
        if self.servos.registers[id_]["status_return_level"] == 0:
            return []
        data = self.servos.read(id_, address, length)
        if data is None:
            return [(id_, self._status(id_, StatusError.ACCESS))]
        return [(id_, self._status(id_, StatusError.NONE, data))]

    def _status(self, id_: int, error: StatusError, data: bytes = b"") -> Packet:
        alert = ALERT if self.servos.registers[id_]["hardware_error"] else 0
        return Packet(id_, STATUS, data, error | alert)


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
