"""Packets of Dynamixel Protocol 2.0: checksum, byte stuffing, encoder, and a decoder that resynchronises after noise.

A packet is FF FF FD 00 | ID | length (2) | instruction | parameters | CRC-16 (2). The length is the number of bytes of
instruction, parameters and checksum. If FF FF FD occurs between the length and the checksum, the sender inserts another
FD after it.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from dynsim.hardware.bus.control_table import BROADCAST_ID

HEADER = b"\xff\xff\xfd"
STATUS = 0x55
MAX_LENGTH = 1024
"""Maximum value of the length field that is accepted; a larger value is treated as noise."""


class Instruction(IntEnum):
    """Instruction codes."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class StatusError(IntEnum):
    """Lower seven bits of the error byte of a status packet; bit 7 (ALERT) means that a hardware error is set."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


ALERT = 0x80


def _crc_table() -> array[int]:
    """Return the checksum of each possible pair of bytes."""
    value = np.arange(0x10000, dtype=np.uint16)
    for _ in range(16):
        top = value >> 15
        value <<= 1
        value ^= top * np.uint16(0x8005)
    return array("H", value.tobytes())


_CRC_TABLE = _crc_table()


def crc16(data: bytes | bytearray) -> int:
    """Return the CRC-16 with polynomial 0x8005 and initial value 0, without reflection."""
    crc = 0
    # A leading zero does not change the checksum and makes the number of bytes even.
    even = b"\0" + data if len(data) % 2 else data
    for two in struct.unpack(f">{len(even) // 2}H", even):
        crc = _CRC_TABLE[crc ^ two]
    return crc


def stuff(body: bytes) -> bytes:
    """Insert FD after every FF FF FD in the body of a packet, which consists of instruction and parameters."""
    return body.replace(HEADER, HEADER + b"\xfd")


def contains_bare_header(stuffed: bytes) -> bool:
    """Return True if FF FF FD occurs without a following FD, which no sender produces.

    This detects a truncated packet that is merged with the next packet; the checksum alone would miss 1 in 65536 of
    these cases.
    """
    return HEADER in stuffed and HEADER in stuffed.replace(HEADER + b"\xfd", b"\0")


def unstuff(body: bytes) -> bytes:
    """Undo :func:`stuff`."""
    return body.replace(HEADER + b"\xfd", HEADER)


class Packet(NamedTuple):
    """One packet, in either direction.

    Attributes
    ----------
    id : int
    instruction : int
        Instruction code; ``STATUS`` for a reply.
    error : int
        Error byte of a reply, 0 otherwise.
    parameters : bytes
        Parameters without byte stuffing.
    """

    id: int
    instruction: int
    parameters: bytes = b""
    error: int = 0


def encode(packet: Packet) -> bytes:
    """Return a packet as the bytes to be sent on the line."""
    first = bytes([packet.instruction, packet.error]) if packet.instruction == STATUS else bytes([packet.instruction])
    body = stuff(first + packet.parameters)
    frame = HEADER + b"\0" + bytes([packet.id]) + (len(body) + 2).to_bytes(2, "little") + body
    return frame + crc16(frame).to_bytes(2, "little")


def encode_fast(replies: Sequence[Packet], sizes: Sequence[int]) -> list[bytes]:
    """Return the bytes that each servo sends in answer to a fast read; together they form one broadcast status packet.

    Each part consists of error, ID, data and the checksum of all bytes so far; the first part starts with the header
    and the length. The length includes the requested bytes of all servos (``sizes``). There is no byte stuffing.
    """
    bodies = [bytes([reply.error, reply.id]) + reply.parameters for reply in replies]
    length = 1 + sum(size + 4 for size in sizes)
    head = HEADER + b"\0" + bytes([BROADCAST_ID]) + length.to_bytes(2, "little") + bytes([STATUS])
    frame, parts = b"", []
    for body in bodies:
        part = (head if not frame else b"") + body
        part += crc16(frame + part).to_bytes(2, "little")
        frame += part
        parts.append(part)
    return parts


class Decoder:
    """Decoder that extracts packets from a stream of bytes with possible noise, truncated packets and wrong checksums.

    After a wrong checksum the search continues one byte later, so that a valid packet is detected even inside an
    apparent packet with a wrong length. Call :meth:`flush` after the last bytes.

    Attributes
    ----------
    garbage : int
        Number of bytes skipped so far.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.garbage = 0

    def feed(self, data: bytes | bytearray) -> Iterator[Packet]:
        """Add bytes and yield all complete packets."""
        self._buffer += data
        return self._packets(final=False)

    def flush(self) -> Iterator[Packet]:
        """Give up waiting for the rest of an incomplete packet: yield the packets after it, and discard all bytes."""
        return self._packets(final=True)

    def _packets(self, *, final: bool) -> Iterator[Packet]:
        buffer = self._buffer
        while True:
            start = buffer.find(HEADER)
            if start < 0:
                keep = 0 if final else _header_prefix(buffer)
                self._skip(len(buffer) - keep)
                return
            self._skip(start)
            end = 7 + int.from_bytes(buffer[5:7], "little")
            possible = buffer[3:4] == b"\0" and 10 <= end <= 7 + MAX_LENGTH
            if not final and (len(buffer) < 7 or (possible and len(buffer) < end)):
                return
            frame = bytes(buffer[:end])
            if not possible or len(frame) < end or contains_bare_header(frame[7:-2]) or not _checksum_matches(frame):
                self._skip(1)
                continue
            # Unstuff the body only, because FF FF FD may also span the length field and the instruction.
            body = unstuff(frame[7:-2])
            del buffer[:end]
            if body[0] == STATUS:
                if len(body) < 2:
                    self.garbage += end
                    continue
                yield Packet(frame[4], STATUS, body[2:], body[1])
            else:
                yield Packet(frame[4], body[0], body[1:])

    def _skip(self, count: int) -> None:
        self.garbage += count
        del self._buffer[:count]


def _checksum_matches(frame: bytes) -> bool:
    return crc16(frame[:-2]) == int.from_bytes(frame[-2:], "little")


def _header_prefix(buffer: bytearray) -> int:
    """Return the number of bytes at the end of ``buffer`` that could be the start of a header."""
    for length in (2, 1):
        if buffer.endswith(HEADER[:length]):
            return length
    return 0
