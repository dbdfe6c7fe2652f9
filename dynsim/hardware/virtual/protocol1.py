"""Dynamixel Protocol 1.0 of a virtual servo whose protocol register says 1: enough to find it and to set it back.

FF FF | ID | length | instruction | parameters | checksum, the length counting parameters + 2, the checksum being the
complement of the sum from ID to parameters. Addresses are single bytes: what lies above 255 cannot be reached.
"""

from __future__ import annotations

from collections.abc import Iterator

from dynsim.hardware.bus.control_table import BROADCAST_ID
from dynsim.hardware.bus.packet import Instruction, Packet, StatusError
from dynsim.hardware.virtual.addresses import Hearing
from dynsim.hardware.virtual.firmware import KEPT_BY_RESET, RESET_ALL, Answer, Firmware, together

HEADER = b"\xff\xff"
HARDWARE_BITS = 0b100101
"""Voltage, heat and overload stand at the same bits as in the hardware error register."""
RANGE_ERROR, INSTRUCTION_ERROR = 1 << 3, 1 << 6


def checksum(body: bytes) -> int:
    """Of the bytes from ID to the last parameter."""
    return ~sum(body) & 0xFF


def encode1(id_: int, code: int, parameters: bytes = b"") -> bytes:
    """Bytes on the wire; ``code`` is an instruction, or the error byte of a status packet."""
    body = bytes([id_, len(parameters) + 2, code]) + parameters
    return HEADER + body + bytes([checksum(body)])


class Decoder1:
    """Instruction packets out of a stream of bytes; the counterpart of :class:`dynsim.hardware.bus.packet.Decoder`."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Take bytes, give every packet that is complete."""
        self._buffer += data
        buffer = self._buffer
        while (start := buffer.find(HEADER)) >= 0:
            del buffer[:start]
            if len(buffer) < 4:
                return
            # FF FF FD 00 is the head of Protocol 2.0: no packet has length 0.
            if buffer[2] == 0xFF or buffer[3] < 2:
                del buffer[0]
                continue
            end = 4 + buffer[3]
            if len(buffer) < end:
                return
            frame = bytes(buffer[:end])
            if checksum(frame[2:-1]) != frame[-1]:
                del buffer[0]
                continue
            del buffer[:end]
            yield Packet(frame[2], frame[4], frame[5:-1])
        del buffer[: max(0, len(buffer) - 1)]

    def flush(self) -> Iterator[Packet]:
        """Forget what is incomplete."""
        self._buffer.clear()
        return iter(())


class Protocol1:
    """Answers to packets of Protocol 1.0."""

    def __init__(self, firmware: Firmware) -> None:
        self._firmware = firmware
        self._servos = firmware.servos

    def answers(self, packet: Packet, hearing: Hearing) -> Iterator[Answer]:
        """Carry out an instruction; what comes back, in the order of the line."""
        p = packet.parameters
        if packet.instruction == Instruction.SYNC_WRITE and len(p) >= 2:
            address, length = p[0], p[1]
            for k in range(2, len(p) - length, length + 1):
                for servo in self._firmware.awake(hearing, p[k]):
                    self._firmware.write(servo, address, p[k + 1 : k + 1 + length])
            return
        broadcast = packet.id == BROADCAST_ID
        for id_ in sorted(hearing.by_id) if broadcast else [packet.id]:
            frames = []
            for servo in self._firmware.awake(hearing, id_):
                frame = self._reply(servo, id_, packet)
                if frame and (not broadcast or packet.instruction == Instruction.PING):
                    frames.append((servo, frame))
            if frames:
                yield together(frames)

    def _reply(self, servo: int, id_: int, packet: Packet) -> bytes | None:
        firmware, registers, p = self._firmware, self._servos.registers[servo], packet.parameters
        level = registers["status_return_level"]
        data = b""
        match packet.instruction:
            case Instruction.PING:
                return self._status(servo, id_, StatusError.NONE)
            case Instruction.READ if len(p) == 2:
                found = self._servos.read(servo, p[0], p[1])
                data, error = found or b"", StatusError.NONE if found else StatusError.ACCESS
                return self._status(servo, id_, error, data) if level else None
            case Instruction.WRITE if len(p) >= 2:
                error = firmware.write(servo, p[0], p[1:])
            case Instruction.REG_WRITE if len(p) >= 2:
                error = firmware.register(servo, p[0], p[1:])
            case Instruction.ACTION:
                error = firmware.act(servo)
            case Instruction.FACTORY_RESET:
                answer = self._status(servo, id_, StatusError.NONE)
                if packet.id != BROADCAST_ID:
                    self._servos.reset(servo, KEPT_BY_RESET[RESET_ALL])
                return answer if level == 2 else None
            case Instruction.REBOOT:
                answer = self._status(servo, id_, StatusError.NONE)
                self._servos.reboot(servo)
                return answer if level == 2 else None
            case _:
                error = StatusError.INSTRUCTION
        return self._status(servo, id_, error) if level == 2 else None

    def _status(self, servo: int, id_: int, error: StatusError, data: bytes = b"") -> bytes:
        code = self._servos.registers[servo]["hardware_error"] & HARDWARE_BITS
        if error:
            code |= INSTRUCTION_ERROR if error in (StatusError.INSTRUCTION, StatusError.RESULT_FAIL) else RANGE_ERROR
        return encode1(id_, code, data)
