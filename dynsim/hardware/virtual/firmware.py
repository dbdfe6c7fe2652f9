"""Firmware of a virtual servo: instructions of Protocol 2.0 and their answers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from dynsim.hardware.bus.control_table import BROADCAST_ID, EEPROM_END, RAD_S_PER_UNIT
from dynsim.hardware.bus.packet import ALERT, STATUS, Instruction, Packet, StatusError, encode, encode_fast
from dynsim.hardware.virtual.servos import Hearing, VirtualServos

CLEAR_TURNS = b"\x01\x44\x58\x4c\x22"
RESET_ALL = 0xFF
KEPT_BY_RESET: dict[int, tuple[str, ...]] = {RESET_ALL: (), 0x01: ("id",), 0x02: ("id", "baud")}
"""Registers that a factory reset does not change, by its parameter."""

SHADOWED = (Instruction.WRITE, Instruction.REG_WRITE)
"""Instructions that a servo carries out without an answer when they are sent to its secondary ID, in RAM."""


class Answer(NamedTuple):
    """A frame that one or several servos send at one time.

    Attributes
    ----------
    servos : tuple of int
        The servos that send, by the IDs they had at first; more than one when they share an ID.
    frame : bytes
    chained : bool
        It follows on the answer before without a pause.
    """

    servos: tuple[int, ...]
    frame: bytes
    chained: bool = False


def together(frames: Sequence[tuple[int, bytes]]) -> Answer:
    """Servos that answer at once, each with its frame: all drive the line, and a zero bit wins (unverified)."""
    if len(frames) == 1:
        servo, frame = frames[0]
        return Answer((servo,), frame)
    line = bytearray(max((frame for _, frame in frames), key=len))
    for _, frame in frames:
        for k, byte in enumerate(frame):
            line[k] &= byte
    return Answer(tuple(servo for servo, _ in frames), bytes(line))


class Firmware:
    """Carries out instructions on servos. These are named by the ID they had at first."""

    def __init__(self, servos: VirtualServos) -> None:
        self._servos = servos
        self._registered: dict[int, tuple[int, bytes]] = {}

    def answers(self, packet: Packet, hearing: Hearing) -> Iterator[Answer]:
        """Carry out an instruction; what comes back, in the order of the line."""
        p = packet.parameters
        match packet.instruction:
            case Instruction.SYNC_READ | Instruction.FAST_SYNC_READ if len(p) >= 5:
                address, length = int.from_bytes(p[0:2], "little"), int.from_bytes(p[2:4], "little")
                entries = [(id_, address, length) for id_ in p[4:]]
                read = self._fast_read if packet.instruction == Instruction.FAST_SYNC_READ else self._read_many
                yield from read(entries, hearing)
            case Instruction.BULK_READ | Instruction.FAST_BULK_READ:
                entries = [
                    (p[k], int.from_bytes(p[k + 1 : k + 3], "little"), int.from_bytes(p[k + 3 : k + 5], "little"))
                    for k in range(0, len(p) - 4, 5)
                ]
                read = self._fast_read if packet.instruction == Instruction.FAST_BULK_READ else self._read_many
                yield from read(entries, hearing)
            case Instruction.SYNC_WRITE if len(p) >= 4:
                address, length = int.from_bytes(p[0:2], "little"), int.from_bytes(p[2:4], "little")
                for k in range(4, len(p) - length, length + 1):
                    # Nobody answers a sync write: a refused goal goes unnoticed, as on real servos.
                    self._write_silently(p[k], address, p[k + 1 : k + 1 + length], hearing)
            case Instruction.BULK_WRITE:
                k = 0
                while k + 5 <= len(p):
                    address = int.from_bytes(p[k + 1 : k + 3], "little")
                    length = int.from_bytes(p[k + 3 : k + 5], "little")
                    self._write_silently(p[k], address, p[k + 5 : k + 5 + length], hearing)
                    k += 5 + length
            case _:
                yield from self._answers_of_each(packet, hearing)

    def _write_silently(self, id_: int, address: int, data: bytes, hearing: Hearing) -> None:
        for servo in self._awake(hearing, id_):
            self._servos.write(servo, address, data)
        if hearing.by_shadow and address >= EEPROM_END:
            for servo in self._shadows(hearing, id_):
                self._servos.write(servo, address, data)

    def _answers_of_each(self, packet: Packet, hearing: Hearing) -> Iterator[Answer]:
        broadcast = packet.id == BROADCAST_ID
        for servo in self._shadows(hearing, packet.id):
            if packet.instruction in SHADOWED and int.from_bytes(packet.parameters[0:2], "little") >= EEPROM_END:
                self._reply(servo, packet.id, packet)
        # A list: the instruction may give a servo another ID.
        for id_ in sorted(hearing.by_id) if broadcast else [packet.id]:
            frames = []
            for servo in self._awake(hearing, id_):
                reply = self._reply(servo, id_, packet)
                if reply and (not broadcast or packet.instruction == Instruction.PING):
                    frames.append((servo, encode(reply)))
            if frames:
                yield together(frames)

    def _reply(self, servo: int, id_: int, packet: Packet) -> Packet | None:
        registers, p = self._servos.registers[servo], packet.parameters
        answers_all = registers["status_return_level"] == 2
        match packet.instruction:
            case Instruction.PING:
                data = (registers.read(0, 2) or b"") + bytes([registers["firmware"]])
                return self._status(servo, id_, StatusError.NONE, data)
            case Instruction.READ if len(p) == 4:
                return self._read(servo, id_, int.from_bytes(p[0:2], "little"), int.from_bytes(p[2:4], "little"))
            case Instruction.WRITE if len(p) >= 3:
                error = self._servos.write(servo, int.from_bytes(p[0:2], "little"), p[2:])
            case Instruction.REG_WRITE if len(p) >= 3:
                error = self._register(servo, int.from_bytes(p[0:2], "little"), p[2:])
            case Instruction.ACTION:
                error = self._act(servo)
            case Instruction.REBOOT | Instruction.FACTORY_RESET:
                # The answer goes out before, as the servo was.
                answer = self._status(servo, id_, StatusError.NONE)
                if packet.instruction == Instruction.REBOOT:
                    self._servos.reboot(servo)
                elif p[:1] == bytes([RESET_ALL]) and packet.id == BROADCAST_ID:
                    return None  # it would give all of them one ID
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

    def _read_many(self, entries: Sequence[tuple[int, int, int]], hearing: Hearing) -> Iterator[Answer]:
        for id_, address, length in entries:
            replies = [(servo, self._read(servo, id_, address, length)) for servo in self._awake(hearing, id_)]
            if frames := [(servo, encode(reply)) for servo, reply in replies if reply]:
                yield together(frames)

    def _fast_read(self, entries: Sequence[tuple[int, int, int]], hearing: Hearing) -> Iterator[Answer]:
        """One packet, of which every servo sends its part; behind one that is silent nobody speaks (unverified)."""
        speakers, replies = [], []
        for id_, address, length in entries:
            servo = next(iter(self._awake(hearing, id_)), None)
            reply = None if servo is None else self._read(servo, id_, address, length)
            if servo is None or reply is None:
                break
            if len(reply.parameters) != length:
                reply = Packet(id_, STATUS, bytes(length), reply.error)
            speakers.append(servo)
            replies.append(reply)
        parts = encode_fast(replies, [length for _, _, length in entries])
        for index, (servo, part) in enumerate(zip(speakers, parts, strict=True)):
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

    def _awake(self, hearing: Hearing, id_: int) -> list[int]:
        """Servos that have an ID and are not dead, off or starting."""
        return list(filter(self._servos.listens, hearing.by_id.get(id_, ())))

    def _shadows(self, hearing: Hearing, id_: int) -> list[int]:
        """Servos of which it is the secondary ID."""
        return list(filter(self._servos.listens, hearing.by_shadow.get(id_, ())))

    def _register(self, servo: int, address: int, data: bytes) -> StatusError:
        """Keep a write until :meth:`_act`."""
        self._registered[servo] = (address, data)
        self._servos.registers[servo]["registered_instruction"] = 1
        return StatusError.NONE

    def _act(self, servo: int) -> StatusError:
        """Carry out the registered write; a restart has forgotten it."""
        registers = self._servos.registers[servo]
        if not registers["registered_instruction"]:
            return StatusError.RESULT_FAIL
        registers["registered_instruction"] = 0
        return self._servos.write(servo, *self._registered.pop(servo))

    def _clear_turns(self, servo: int) -> StatusError:
        """Count turns from here; only at rest."""
        index = self._servos.ids.index(servo)
        if abs(self._servos.plant.velocity[index]) > self._servos.registers[servo]["moving_threshold"] * RAD_S_PER_UNIT:
            return StatusError.RESULT_FAIL
        self._servos.forget_turns(index)
        return StatusError.NONE
