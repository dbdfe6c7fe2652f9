"""Servo bus that uses the unmodified Dynamixel client library (dynamixel-sdk 4.1.0), on real and virtual ports.

The library has the following defects, which this module works around. tests/hardware/test_sdk_defects.py reproduces the
defects; if one of its tests fails, the library has been repaired and the workaround can be removed.

- After an interrupted read, ``port.is_using`` remains set, and every later write is dropped. Therefore this flag is
  cleared before each transaction, and signal handlers only set a flag.
- If one status packet is lost, the library waits for the time-out and loses the answers of all later servos; it also
  drops the packet after a truncated packet. Therefore the sync read of this module receives the bytes, decodes all
  packets, and assigns them by ID.
- Group reads drop the error byte. The decoder of this module keeps it.
- The byte stuffing of requests is lost, and some stuffed answers are mangled. Therefore this module rejects a request
  whose body contains FF FF FD, treats an answer with a wrong length as garbled, and never uses Fast Sync Read.
- When the library reads from one servo, it accepts any status of this servo as the answer, whatever its length. When it
  reads from or writes to one servo, it waits 34 ms for the answer, even if the adapter needs more time. Therefore this
  module receives and checks these answers, too.
- ``getData`` never returns a negative number. Therefore fields are decoded in this module.
- A dead port raises termios.error or OSError in addition to SerialException, and a stalled port blocks. This module
  converts these errors to PortError and waits for writes itself, because the write time-out of pyserial includes time
  in which this process was suspended.
"""

from __future__ import annotations

import errno
import os
import select
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import serial
from dynamixel_sdk import COMM_SUCCESS, PortHandler, Protocol2PacketHandler

from dynsim.hardware.bus.control_table import BROADCAST_ID, Field
from dynsim.hardware.bus.packet import ALERT, HEADER, STATUS, Decoder, Packet, StatusError
from dynsim.hardware.bus.protocol import BlockRead, NoAnswer, RequestRefused, ServoReply, TerminalError, require_posix
from dynsim.hardware.errors import PortError

WRITE_TIMEOUT = 0.25
"""Maximum time to wait for a port that does not accept bytes [s]."""
READ_WAIT = 5e-4
"""Maximum time to wait for a byte before time-outs are checked [s]."""
NOTHING_TO_READ = "returned no data"
"""Part of pyserial's error message if a port was ready but a read returned nothing."""
LATE_READS = 16
"""Number of reads after which the late answer to an earlier read is no longer expected."""
RETRIES = 2
"""Number of retries after a failed read or write of a single servo; the timed loop does not use such requests."""
SINGLE_LATENCY = 0.034
"""Minimum time allowed for the answer of a single servo, as in the library [s]."""
STATUS_BYTES = 11
"""Number of bytes of an answer, not including its parameters."""
TORQUE_ENABLE = 64


Answers = tuple[dict[int, Packet], dict[int, Packet], int]
"""Packets with the requested length by ID, other packets by ID, and number of bytes outside packets; see
:meth:`DynamixelBus._receive`."""


class SerialPort(PortHandler):
    """Port for the client library that has a write time-out and, by default, cannot be opened by other processes.

    Attributes
    ----------
    longest_pause : float
        Longest time for which the operating system delayed this process while it waited for a byte [s].
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

    def getCurrentTime(self) -> float:
        # The library uses the wall clock, so that a time-out would end early, or late, if somebody sets it.
        return time.monotonic() * 1e3

    def readPort(self, length: int) -> bytes:
        # Wait instead of polling in a busy loop as the library does, to leave the processor to other processes.
        began = time.monotonic()
        select.select([self.ser.fileno()], [], [], READ_WAIT)
        self.longest_pause = max(self.longest_pause, time.monotonic() - began - READ_WAIT)
        try:
            return self.ser.read(length)
        except serial.SerialException as error:
            # On a shared port, another process may have read the bytes; on an exclusive port, the adapter is gone.
            if self.exclusive or NOTHING_TO_READ not in str(error):
                raise
            return b""

    def writePort(self, packet: Iterable[int]) -> int:
        # Do not use pyserial's time-out: it includes time in which this process was suspended, so that a write could
        # time out although it was finished.
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

    Parameters
    ----------
    name : str
        Serial device.
    baud : int
        Bit rate [bit/s].
    exclusive : bool, optional
        If True (default), other processes cannot use the port.

    Raises
    ------
    PortError
        If the port does not exist, requires a permission that is missing, or is in use by another process, if the
        library does not support the bit rate, or if the system is not POSIX.
    """
    require_posix(name)
    port = SerialPort(name, exclusive=exclusive)
    try:
        opened = port.setBaudRate(baud)
    except (OSError, TerminalError, ValueError) as error:
        raise PortError(f"{name}: {_why_not_opened(error)}") from error
    if not opened:
        raise PortError(f"{name}: the client library does not support {baud} bit/s")
    return port


def _why_not_opened(error: Exception) -> str:
    text = str(error).lower()
    number = getattr(error, "errno", None)
    if "exclusively lock" in text or number == errno.EAGAIN:
        return "in use by another process, perhaps a replay (`dynsim hw stop` works even then)"
    if number == errno.ENOENT or "no such file" in text:
        return "no such port; is the adapter plugged in?"
    if number == errno.EACCES or "permission denied" in text:
        return "permission denied; on Linux, add your user to the group dialout"
    return f"cannot be opened ({error})"


def latency_timer(port_name: str) -> int | None:
    """Return the latency timer of a USB serial adapter [ms]; None if unknown (only the Linux FTDI driver shows it)."""
    entry = Path("/sys/bus/usb-serial/devices") / Path(port_name).resolve().name / "latency_timer"
    try:
        return int(entry.read_text())
    except (OSError, ValueError):
        return None


class RequestLengths:
    """Chooser of the number of bytes for each read, so that a late answer to an earlier read can be recognised.

    A status packet contains the ID of the servo but not of the request, so the answer of a servo that is two periods
    late would look like the answer to the current request. If a servo does not answer a request, the next
    ``LATE_READS - 1`` requests use a different length, that is, they read more bytes than needed. As long as all servos
    answer, no extra bytes are read.
    """

    def __init__(self) -> None:
        self._number = 0
        self._missed: dict[int, int] = {}  # length of each request that was missed → number of the request

    def choose(self, length: int) -> int:
        """Return the number of bytes to read with the next request if ``length`` bytes are needed."""
        self._number += 1
        if not self._missed:
            return length
        self._missed = {asked: number for asked, number in self._missed.items() if self._number - number < LATE_READS}
        return next(asked for asked in range(length, length + LATE_READS) if asked not in self._missed)

    def miss(self, asked: int) -> None:
        """Record that a servo did not answer the last request, which asked for ``asked`` bytes."""
        self._missed[asked] = self._number


class DynamixelBus:
    """Bus with the servos on one port.

    Parameters
    ----------
    port : dynamixel_sdk.PortHandler
        Open port: a :class:`SerialPort` or a virtual port.
    latency : float
        Maximum delay of an answer that is caused by the adapter and the operating system [s].
    return_delay : float
        Maximum return delay time of a servo [s].
    """

    def __init__(self, port: Any, *, latency: float = 2e-3, return_delay: float = 508e-6) -> None:
        self.port = port
        self.latency = latency
        self.return_delay = return_delay
        self._library = Protocol2PacketHandler()
        # The keys are ("address", address of the registers) for sync reads and ("id", ID) for reads from one servo.
        self._lengths: dict[tuple[str, int], RequestLengths] = {}
        self._arrivals: dict[int, float] = {}  # time at which the last packet of each servo arrived [ms], by ID

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
        lengths = self._lengths.setdefault(("id", id_), RequestLengths())
        for _ in range(RETRIES + 1):
            asked = lengths.choose(length)
            answers, others, garbage = self._ask(id_, asked, self._library.readTx, address, asked)
            if id_ in answers:
                packet = answers[id_]
                self._raise_refusal(id_, packet.error)
                return ServoReply(packet.parameters[:length], bool(packet.error & ALERT))
            if id_ in others and not others[id_].parameters:
                self._raise_refusal(id_, others[id_].error)
            lengths.miss(asked)
        raise NoAnswer(id_, garbled=bool(others) or garbage > 0)

    def write(self, id_: int, field: Field, value: int) -> None:
        data = list(field.encode(value))
        self._reject_header(bytes([field.address & 0xFF, field.address >> 8, *data]))
        for _ in range(RETRIES + 1):
            answers, others, garbage = self._ask(id_, 0, self._library.writeTxOnly, field.address, field.size, data)
            if id_ in answers:
                self._raise_refusal(id_, answers[id_].error)
                return
        raise NoAnswer(id_, garbled=bool(others) or garbage > 0)

    def _ask(self, id_: int, asked: int, send: Callable[..., int], *request: Any) -> Answers:
        """Send a request to one servo and receive its answer with ``asked`` bytes of parameters."""
        with self._transaction():
            self._raise_unsent(send(self.port, id_, *request))
            self._wait_at_most(1, asked, max(self.latency, SINGLE_LATENCY))
            return self._receive((id_,), asked)

    def sync_write(self, field: Field, values: dict[int, int]) -> None:
        body = b"".join(bytes([id_]) + field.encode(value) for id_, value in values.items())
        head = field.address.to_bytes(2, "little") + field.size.to_bytes(2, "little")
        self._reject_header(head + body)
        with self._transaction():
            result = self._library.syncWriteTxOnly(self.port, field.address, field.size, list(body), len(body))
        self._raise_unsent(result)

    def sync_read(self, ids: Sequence[int], address: int, length: int) -> BlockRead:
        lengths = self._lengths.setdefault(("address", address), RequestLengths())
        asked = lengths.choose(length)
        with self._transaction():
            stray = self.port.getBytesAvailable()
            result = self._library.syncReadTx(self.port, address, asked, list(ids), len(ids), False)
            self._raise_unsent(result)
            self._wait_at_most(len(ids), asked, self.latency)
            answers, others, garbage = self._receive(ids, asked)
        if len(answers) < len(ids):
            lengths.miss(asked)
        now = self.port.getCurrentTime()
        replies = {
            id_: ServoReply(packet.parameters[:length], bool(packet.error & ALERT), (now - self._arrivals[id_]) * 1e-3)
            for id_, packet in answers.items()
        }
        outdated = (id_ for id_, packet in others.items() if length <= len(packet.parameters) < length + LATE_READS)
        return BlockRead(replies, stray + garbage, frozenset(outdated))

    def _raise_unsent(self, result: int) -> None:
        if result != COMM_SUCCESS:
            raise PortError(f"{self.name}: {self._library.getTxRxResult(result)}")

    def _wait_at_most(self, servos: int, length: int, latency: float) -> None:
        """Set the time-out for answers from ``servos`` servos, each with ``length`` bytes of parameters."""
        milliseconds = self.port.tx_time_per_byte * (servos * (STATUS_BYTES + length) + 14 + servos)
        milliseconds += 1e3 * (servos * (self.return_delay + 50e-6) + latency)
        self.port.setPacketTimeoutMillis(milliseconds)

    def _receive(self, ids: Sequence[int], asked: int) -> Answers:
        """Receive answers until all servos have answered or the time-out has passed.

        Returns
        -------
        answers : dict
            Status packets with ``asked`` bytes of parameters, by ID.
        others : dict
            Last status packet with a different number of bytes, by ID.
        garbage : int
            Number of bytes outside packets.
        """
        answers: dict[int, Packet] = {}
        others: dict[int, Packet] = {}
        decoder, asked_of, total = Decoder(), frozenset(ids), len(ids) * (STATUS_BYTES + asked)

        def sort_in(packets: Iterable[Packet]) -> None:
            for packet in packets:
                # Skip requests echoed by the adapter.
                if packet.instruction == STATUS and packet.id in asked_of:
                    (answers if len(packet.parameters) == asked else others)[packet.id] = packet
                    self._arrivals[packet.id] = self.port.getCurrentTime()

        while len(answers) < len(ids) and not self.port.isPacketTimeout():
            sort_in(decoder.feed(self.port.readPort(total)))
        # Also read the bytes that arrived while this process was suspended, even after the time-out.
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
        # A port that is gone need not be closed.
        with suppress(OSError, TerminalError):
            self.port.closePort()

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self.port.is_using = False
        try:
            yield
        except (serial.SerialException, OSError, TerminalError, TypeError) as error:
            # pyserial raises TypeError if its descriptor was closed in the meantime.
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
                f"a request must not contain FF FF FD, which the client library does not stuff, got {body.hex(' ')}"
            )
