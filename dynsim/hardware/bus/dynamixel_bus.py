"""Dynamixel servos through the unmodified client library (dynamixel-sdk 4.1.0), on real and virtual ports alike.

Defects of the library, and their workarounds here (tests/hardware/test_sdk_defects.py tests those that can be shown:
when one of its tests fails, the library was repaired and the workaround can be removed):

- An interrupted read leaves ``port.is_using`` set, and every later write is dropped: the flag is cleared before each
  transaction, and signal handlers only set a flag of their own.
- One lost status packet costs a time-out and the answers of all later servos: the sync read here takes the bytes
  itself, decodes all packets, and assigns them by ID. The library also drops the packet after a truncated one.
- Group reads drop the error byte: the decoder keeps it.
- Byte stuffing of requests is lost, some stuffed answers are mangled: a request whose body holds FF FF FD is rejected
  here, answers of a wrong length count as garbled, and Fast Sync Read is never used.
- Its read of one servo accepts any status of that servo as the answer, whatever its length, and its reads and writes
  of one servo wait 34 ms for an answer, whatever the adapter needs: those answers, too, are received and checked here.
- ``getData`` returns no negative numbers: fields are decoded here.
- A dead port raises termios.error or OSError beside SerialException; a stalled one blocks: all become PortError, and
  writes wait here. pyserial's write time-out also counts time in which this process was suspended.
"""

from __future__ import annotations

import errno
import os
import select
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import serial
from dynamixel_sdk import COMM_SUCCESS, PortHandler, Protocol2PacketHandler

from dynsim.hardware.bus.control_table import BROADCAST_ID, Field
from dynsim.hardware.bus.packet import ALERT, HEADER, STATUS, Decoder, Packet, StatusError
from dynsim.hardware.bus.protocol import BlockRead, NoAnswer, RequestRefused, ServoReply, TerminalError, require_posix
from dynsim.hardware.errors import PortError

WRITE_TIMEOUT = 0.25
"""Longest wait for a port that takes no byte [s]."""
READ_WAIT = 5e-4
"""Longest wait for a byte before time-outs are checked [s]."""
NOTHING_TO_READ = "returned no data"
"""Part of pyserial's message for a read without data from a port that was ready."""
MARKS = 16
"""Number of reads after which a missed answer is no longer expected."""
RETRIES = 2
"""Further attempts of a single read or write; the timed loop makes none."""
SINGLE_LATENCY = 0.034
"""Least latency that a single read or write allows, as in the library: the timed loop makes none of them [s]."""
STATUS_BYTES = 11
"""Bytes of an answer beside its parameters."""
TORQUE_ENABLE = 64


class SerialPort(PortHandler):
    """The library's port, opened with a write time-out and (by default) for this process alone.

    Attributes
    ----------
    longest_pause : float
        Longest delay by the operating system in a wait for a byte [s].
    """

    def __init__(self, name: str, *, exclusive: bool = True) -> None:
        super().__init__(name)
        self.longest_pause = 0.0
        self.is_open = False
        self.exclusive = exclusive

    def setupPort(self, cflag_baud: int) -> bool:
        if self.is_open:
            self.closePort()
        self.ser = serial.Serial(
            port=self.port_name,
            baudrate=self.baudrate,
            bytesize=serial.EIGHTBITS,
            timeout=0,
            exclusive=self.exclusive or None,
        )
        self.is_open = True
        self.ser.reset_input_buffer()
        self.tx_time_per_byte = 1e3 / self.baudrate * 10.0
        return True

    def readPort(self, length: int) -> bytes:
        # A short wait instead of the library's busy loop: it leaves the processor to others.
        began = time.monotonic()
        select.select([self.ser.fileno()], [], [], READ_WAIT)
        self.longest_pause = max(self.longest_pause, time.monotonic() - began - READ_WAIT)
        try:
            return self.ser.read(length)
        except serial.SerialException as error:
            # Beside another process that took the bytes; on a port of one's own it is the adapter that is gone.
            if self.exclusive or NOTHING_TO_READ not in str(error):
                raise
            return b""

    def writePort(self, packet: Iterable[int]) -> int:
        # pyserial counts the time in which this process was stopped: a write that was done counted as one that blocked.
        left = data = bytes(packet)
        while left:
            try:
                left = left[os.write(self.ser.fileno(), left) :]
            except BlockingIOError:
                if not select.select([], [self.ser.fileno()], [], WRITE_TIMEOUT)[1]:
                    raise serial.SerialTimeoutException("write timeout") from None
        return len(data)


def open_serial_port(name: str, baud: int, *, exclusive: bool = True) -> SerialPort:
    """Open a serial port.

    Raises
    ------
    PortError
        No such port, no permission, held by another process, a baud rate the library refuses, or a system without
        POSIX.
    """
    require_posix(name)
    port = SerialPort(name, exclusive=exclusive)
    try:
        opened = port.setBaudRate(baud)
    except (OSError, TerminalError, ValueError) as error:
        raise PortError(f"{name}: {_why_not_opened(error)}") from error
    if not opened:
        raise PortError(f"{name}: the client library refuses {baud} bit/s")
    return port


def _why_not_opened(error: Exception) -> str:
    text = str(error).lower()
    number = getattr(error, "errno", None)
    if "exclusively lock" in text or number == errno.EAGAIN:
        return "in use by another process (a replay? `dynsim hw stop` works beside it)"
    if number == errno.ENOENT or "no such file" in text:
        return "no such port; is the adapter plugged in?"
    if number == errno.EACCES or "permission denied" in text:
        return "permission denied; on Linux join the group dialout"
    return f"cannot be opened ({error})"


def latency_timer(port_name: str) -> int | None:
    """Latency timer of a USB serial adapter [ms], None where the system does not say (Linux FTDI driver only)."""
    entry = Path("/sys/bus/usb-serial/devices") / Path(port_name).resolve().name / "latency_timer"
    try:
        return int(entry.read_text())
    except (OSError, ValueError):
        return None


class Marks:
    """How many bytes the next read asks for: more than needed, where answers to earlier ones could pass for its own.

    A status says whose it is, not what it answers: a servo that is two periods late would pass for one that is up to
    date. Where all have answered nothing can come late, and nothing is longer; a request that somebody missed keeps its
    length to itself for the next MARKS - 1 requests.
    """

    def __init__(self) -> None:
        self._number = 0
        self._missed: dict[int, int] = {}  # number of the request by its length

    def choose(self, length: int) -> int:
        """For a request to be sent now, of which ``length`` bytes are needed."""
        self._number += 1
        if not self._missed:
            return length
        self._missed = {asked: number for asked, number in self._missed.items() if self._number - number < MARKS}
        return next(asked for asked in range(length, length + MARKS) if asked not in self._missed)

    def miss(self, asked: int) -> None:
        """Somebody has not answered the request sent last, which was for ``asked`` bytes."""
        self._missed[asked] = self._number


class DynamixelBus:
    """Servos on one port.

    Parameters
    ----------
    port : dynamixel_sdk.PortHandler
        Open; a :class:`SerialPort` or a virtual one.
    latency : float
        What adapter and operating system may add to an answer [s].
    return_delay : float
        Longest return delay of a servo [s].
    """

    def __init__(self, port: Any, *, latency: float = 2e-3, return_delay: float = 508e-6) -> None:
        self.port = port
        self.latency = latency
        self.return_delay = return_delay
        self._library = Protocol2PacketHandler()
        self._marks: dict[tuple[str, int], Marks] = {}  # of sync reads by address, of single reads by ID

    @property
    def longest_pause(self) -> float:
        return float(self.port.longest_pause)

    @property
    def name(self) -> str:
        return str(self.port.getPortName())

    def ping_all(self) -> dict[int, tuple[int, int]]:
        with self._transaction():
            answers, _ = self._library.broadcastPing(self.port)
        return {id_: (model, firmware) for id_, (model, firmware) in answers.items()}

    def read(self, id_: int, field: Field) -> int:
        return field.decode(self.read_block(id_, field.address, field.size).data)

    def read_block(self, id_: int, address: int, length: int) -> ServoReply:
        marks = self._marks.setdefault(("id", id_), Marks())
        for _ in range(RETRIES + 1):
            asked = marks.choose(length)
            with self._transaction():
                result = self._library.readTx(self.port, id_, address, asked)
                self._raise_unsent(result)
                self._wait_at_most(1, asked, max(self.latency, SINGLE_LATENCY))
                answers, others, garbage = self._receive((id_,), asked)
            if id_ in answers:
                packet = answers[id_]
                self._raise_refusal(id_, packet.error)
                return ServoReply(packet.parameters[:length], bool(packet.error & ALERT))
            if id_ in others and not others[id_].parameters:
                self._raise_refusal(id_, others[id_].error)
            marks.miss(asked)
        raise NoAnswer(id_, garbled=bool(others) or garbage > 0)

    def write(self, id_: int, field: Field, value: int) -> None:
        data = list(field.encode(value))
        self._reject_header(bytes([field.address & 0xFF, field.address >> 8, *data]))
        for _ in range(RETRIES + 1):
            with self._transaction():
                self._raise_unsent(self._library.writeTxOnly(self.port, id_, field.address, field.size, data))
                self._wait_at_most(1, 0, max(self.latency, SINGLE_LATENCY))
                answers, others, garbage = self._receive((id_,), 0)
            if id_ in answers:
                self._raise_refusal(id_, answers[id_].error)
                return
        raise NoAnswer(id_, garbled=bool(others) or garbage > 0)

    def sync_write(self, field: Field, values: dict[int, int]) -> None:
        body = b"".join(bytes([id_]) + field.encode(value) for id_, value in values.items())
        head = field.address.to_bytes(2, "little") + field.size.to_bytes(2, "little")
        self._reject_header(head + body)
        with self._transaction():
            result = self._library.syncWriteTxOnly(self.port, field.address, field.size, list(body), len(body))
        self._raise_unsent(result)

    def sync_read(self, ids: Sequence[int], address: int, length: int) -> BlockRead:
        marks = self._marks.setdefault(("address", address), Marks())
        asked = marks.choose(length)
        with self._transaction():
            stray = self.port.getBytesAvailable()
            result = self._library.syncReadTx(self.port, address, asked, list(ids), len(ids), False)
            self._raise_unsent(result)
            self._wait_at_most(len(ids), asked, self.latency)
            answers, others, garbage = self._receive(ids, asked)
        if len(answers) < len(ids):
            marks.miss(asked)
        replies = {
            id_: ServoReply(packet.parameters[:length], bool(packet.error & ALERT)) for id_, packet in answers.items()
        }
        outdated = (id_ for id_, packet in others.items() if length <= len(packet.parameters) < length + MARKS)
        return BlockRead(replies, stray + garbage, frozenset(outdated))

    def _raise_unsent(self, result: int) -> None:
        if result != COMM_SUCCESS:
            raise PortError(f"{self.name}: {self._library.getTxRxResult(result)}")

    def _wait_at_most(self, servos: int, length: int, latency: float) -> None:
        """Set the time-out for answers of so many servos, each with parameters of ``length`` bytes."""
        milliseconds = self.port.tx_time_per_byte * (servos * (STATUS_BYTES + length) + 14 + servos)
        milliseconds += 1e3 * (servos * (self.return_delay + 50e-6) + latency)
        self.port.setPacketTimeoutMillis(milliseconds)

    def _receive(self, ids: Sequence[int], asked: int) -> tuple[dict[int, Packet], dict[int, Packet], int]:
        """Until all have answered, or the time-out: status packets by ID, and bytes of garbage.

        The first ones bring the bytes ``asked`` for; the second ones, the last of every servo, another number of them.
        """
        answers: dict[int, Packet] = {}
        others: dict[int, Packet] = {}
        decoder, asked_of, total = Decoder(), frozenset(ids), len(ids) * (STATUS_BYTES + asked)

        def sort_in(packets: Iterable[Packet]) -> None:
            for packet in packets:
                # Requests echoed by the adapter are no status.
                if packet.instruction == STATUS and packet.id in asked_of:
                    (answers if len(packet.parameters) == asked else others)[packet.id] = packet

        while len(answers) < len(ids) and not self.port.isPacketTimeout():
            sort_in(decoder.feed(self.port.readPort(total)))
        # What came while this process was not running is here, however late it is.
        late = self.port.getBytesAvailable()
        if late:
            sort_in(decoder.feed(self.port.readPort(late)))
        sort_in(decoder.flush())
        return answers, others, decoder.garbage

    def torque_off_all(self) -> None:
        for _ in range(3):
            with self._transaction():
                self._library.write1ByteTxOnly(self.port, BROADCAST_ID, TORQUE_ENABLE, 0)

    def close(self) -> None:
        try:
            self.port.closePort()
        except (OSError, TerminalError):
            # A port that is gone needs no closing.
            return

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self.port.is_using = False
        try:
            yield
        except (serial.SerialException, OSError, TerminalError, TypeError) as error:
            # pyserial raises TypeError where its descriptor was closed under it.
            raise PortError(f"{self.name}: the port died ({error})") from error
        finally:
            self.port.is_using = False

    def _raise_refusal(self, id_: int, error: int) -> None:
        code = error & ~ALERT
        if code != StatusError.NONE:
            raise RequestRefused(id_, code, self._library.getRxPacketError(code))

    @staticmethod
    def _reject_header(body: bytes) -> None:
        if HEADER in body:
            raise ValueError(
                f"a request must not hold FF FF FD, the client library would send it unstuffed: {body.hex(' ')}"
            )
