"""Virtual half-duplex line with servos, its port for the client library, and its pseudo-terminal for other programs.

The line accepts the bytes of requests, and returns the bytes of answers with their arrival times.
:class:`VirtualPort` connects it to the client library, and :class:`PseudoTerminal` makes it available as a serial
device.
"""

from __future__ import annotations

import contextlib
import os
import random
import select
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import serial
from dynamixel_sdk import PortHandler

from dynsim.hardware.bus.control_table import BAUD_RATES, RAD_PER_TICK, RETURN_DELAY_SECONDS_PER_UNIT
from dynsim.hardware.bus.packet import STATUS, Decoder, Packet, crc16
from dynsim.hardware.bus.protocol import Clock, fcntl, require_posix, termios, tty
from dynsim.hardware.errors import PortError
from dynsim.hardware.servo_map import ServoMap
from dynsim.hardware.virtual.faults import FaultScript
from dynsim.hardware.virtual.servos import PHYSICS_STEP, Firmware, ServoRegisters, VirtualServos
from dynsim.hardware.virtual.simulated_plant import ServoPlant

BYTE_TIMEOUT = 5e-3
"""Maximum pause within a packet [s] (unverified)."""
TURNAROUND = 20e-6
"""Time before a servo answers, in addition to its return delay [s] (unverified)."""
ADAPTER_LATENCY = 1e-3
"""Delay from the line to the reader [s], as for a USB adapter with a latency timer of 1 ms."""

Listener = Callable[[float, Packet], None]


class VirtualLine:
    """N servos on one half-duplex line.

    Parameters
    ----------
    servos : mapping of int to ServoRegisters
        Registers of the servos, by ID.
    positions : sequence of float
        Initial servo angles [rad], 0 at tick 0.
    plant : ServoPlant, optional
        Plant that the servos drive; by default, each servo drives a separate inertia.
    script : FaultScript, optional
        Scripted faults.
    listener : callable, optional
        Function that is called with (time, packet) for each valid packet that a servo can receive.
    """

    def __init__(
        self,
        servos: Mapping[int, ServoRegisters],
        *,
        positions: Iterable[float],
        plant: ServoPlant | None = None,
        script: FaultScript | None = None,
        listener: Listener | None = None,
    ) -> None:
        script = script or FaultScript()
        self.servos = VirtualServos(servos, positions=positions, plant=plant, script=script)
        self.listener = listener
        self._random = random.Random(script.seed)
        self._firmware = Firmware(self.servos)
        self._decoders: dict[int, Decoder] = {}
        self._last_byte = 0.0

    @property
    def time(self) -> float:
        """Simulated time of the servos [s]."""
        return self.servos.time

    def advance(self, now: float) -> None:
        """Advance the servos to the time ``now`` [s]."""
        while now - self.servos.time >= PHYSICS_STEP:
            self.servos.step(now)
            self.servos.inject()

    def transmit(self, data: bytes, start: float, baud: int) -> list[tuple[float, bytes]]:
        """Send bytes over the line.

        Parameters
        ----------
        data : bytes
        start : float
            Time of the first byte [s].
        baud : int
            Bit rate [bit/s].

        Returns
        -------
        list of (float, bytes)
            Arrival time of the last byte of each answer at the reader [s], and the bytes of this answer.

        Raises
        ------
        OSError
            If the adapter was unplugged.
        """
        end = start + len(data) * 10 / baud
        self.advance(end)
        if self.servos.unplugged:
            raise serial.SerialException(5, "Input/output error")
        arrivals: list[tuple[float, bytes]] = []
        if any(fault.kind == "echo" for fault in self.servos.active_faults()):
            arrivals.append((end + ADAPTER_LATENCY, data))
        # An incomplete packet is discarded after a pause.
        expired = start - self._last_byte > BYTE_TIMEOUT
        self._last_byte = end
        # For servos with another bit rate, the bytes are noise.
        if baud in self.servos.baud_groups:
            decoder = self._decoders.setdefault(baud, Decoder())
            packets = [*decoder.flush()] if expired else []
            for packet in [*packets, *decoder.feed(data)]:
                if packet.instruction != STATUS and baud in self.servos.baud_groups:
                    arrivals += self._execute(packet, end, baud)
        return arrivals

    def _execute(self, packet: Packet, now: float, baud: int) -> list[tuple[float, bytes]]:
        group = self.servos.baud_groups[baud]
        self.servos.last_packet[group.members] = now
        if self.listener:
            self.listener(now, packet)
        arrivals: list[tuple[float, bytes]] = []
        for answer in self._firmware.answers(packet, group):
            first = answer.servos[0]
            if not answer.chained:
                now += self.servos.registers[first]["return_delay"] * RETURN_DELAY_SECONDS_PER_UNIT + TURNAROUND
            now += len(answer.frame) * 10 / baud
            arrivals += self._disturb(first, answer.frame, now + ADAPTER_LATENCY)
        return arrivals

    def _disturb(self, id_: int, frame: bytes, arrival: float) -> list[tuple[float, bytes]]:
        """Return the arrival time and the bytes of a status packet after the scripted faults; empty if it is lost."""
        chance = self._random.random
        for fault in self.servos.active_faults():
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
                    # Both servos drive the line and a zero bit wins. The frames differ in the measured values only.
                    frame = bytes(a & b for a, b in zip(frame, self._duplicate_frame(frame), strict=True))
        return [(arrival, frame)]

    def _duplicate_frame(self, frame: bytes) -> bytes:
        if len(frame) < 15:
            return frame
        body = bytearray(frame[:-2])
        for k in range(9, len(body)):
            body[k] ^= self._random.randrange(4)
        return bytes(body) + crc16(body).to_bytes(2, "little")


def line_for_map(servo_map: ServoMap, **options: Any) -> VirtualLine:
    """Build a line with the servos of a map, which are configured as the map requires.

    Parameters
    ----------
    servo_map : ServoMap
    **options
        ``posture`` contains initial angles by joint [rad]; the default is the fixed angle in the map, or zero. All
        other options are passed to :class:`VirtualLine`.
    """
    posture = options.pop("posture", {})
    angles, servos = [], {}
    for servo in servo_map.servos:
        start = posture.get(servo.axle, servo.hold_at or 0.0)
        low, high = servo.position_limits
        angles.append(servo.to_ticks(min(max(start, low), high)) * RAD_PER_TICK)
        registers = ServoRegisters(servo.model, servo.id, BAUD_RATES.index(servo_map.bus.baud))
        registers["operating_mode"] = servo.operating_mode
        registers["return_delay"] = int(servo_map.bus.return_delay / RETURN_DELAY_SECONDS_PER_UNIT)
        if servo.counts_turns:
            mark = servo.model.turn_mark
            registers.write(mark.address, mark.encode(mark.default - 1))
        servos[servo.id] = registers
    return VirtualLine(servos, positions=angles, **options)


# Port through which the client library communicates with virtual servos.


class VirtualPort(PortHandler):
    """Port that connects the client library to a :class:`VirtualLine`; its clock starts at 0.

    With a virtual clock, the port never waits: if no bytes are available, a read advances the clock to the next byte or
    to the time-out.
    """

    POLL = 1e-5

    def __init__(self, line: VirtualLine, clock: Clock, *, baud: int) -> None:
        super().__init__("virtual")
        self.line = line
        self.clock = clock
        self.baudrate = baud
        self.setupPort(baud)
        self.longest_pause = 0.0
        self._arriving: deque[tuple[float, bytes]] = deque()
        self._input = bytearray()

    def closePort(self) -> None:
        self.is_open = False

    def setupPort(self, cflag_baud: int) -> bool:
        self.is_open = True
        self.tx_time_per_byte = 1e3 / self.baudrate * 10.0
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
            until = min(soon, self._arriving[0][0]) if self._arriving else soon
            self.clock.sleep_until(until)
            self.longest_pause = max(self.longest_pause, self.clock.now() - until)
            self._receive()
        data = bytes(self._input[:length])
        del self._input[:length]
        return data

    def _receive(self) -> None:
        self.line.advance(self.clock.now())
        if self.line.servos.unplugged:
            raise serial.SerialException(5, "Input/output error")
        while self._arriving and self._arriving[0][0] <= self.clock.now() + 1e-12:
            self._input += self._arriving.popleft()[1]


# Virtual servos on a pseudo-terminal, which other programs can open like a serial device.


_BAUD_BY_CODE = {
    getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()
}
_TCGETS2 = 0x802C542A
"""Linux request for terminal settings with a numeric bit rate; clients may use bit rates that have no code."""
_OUTPUT_SPEED = slice(40, 44)
IDLE = 1e-3
"""Maximum time to wait for bytes before the servos are advanced [s]; if it is short, requests are answered quickly."""


STALL = 10e-3
"""Maximum pause of this process for which the time of the servos advances [s]; the rest of a pause is ignored."""


class PseudoTerminal:
    """Pseudo-terminal through which other programs access a :class:`VirtualLine` in real time.

    Attributes
    ----------
    device : str
        Path of the serial device to open.
    """

    def __init__(self, line: VirtualLine, link: Path | None = None) -> None:
        """Open the terminal and, if ``link`` is set, create a symbolic link with this path to the terminal.

        Raises
        ------
        PortError
            If the link cannot be created, if another kind of file exists at its path, if an existing link points to an
            existing device, or if the system has no pseudo-terminals.
        """
        require_posix("virtual servos on a pseudo-terminal")
        self.line = line
        self._master, self._slave = os.openpty()
        # Keep the slave end open; otherwise the master would read end-of-file between two clients.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.device = os.ttyname(self._slave)
        self._link = link
        if link is not None:
            try:
                if link.is_symlink():
                    self._refuse_device_in_use(link)
                    link.unlink()
                link.symlink_to(self.device)
            except OSError as error:
                self.close()
                raise PortError(f"{link}: cannot be linked to {self.device} ({error.strerror})") from error

    def _refuse_device_in_use(self, link: Path) -> None:
        """Raise PortError unless the link was left by a killed process: it is broken, or points to this device."""
        if link.exists() and os.readlink(link) != self.device:
            there = os.readlink(link)
            self._link = None
            self.close()
            raise PortError(f"{link}: points to {there}, which is in use (by other virtual servos?); use another link")

    def serve(self, keep_on: Callable[[], bool]) -> None:
        """Answer requests until ``keep_on`` returns False or a scripted fault unplugs the adapter."""
        origin = last = time.monotonic()
        outgoing: deque[tuple[float, bytes]] = deque()
        while keep_on() and not self.line.servos.unplugged:
            now = time.monotonic() - origin
            wait = min(IDLE, max(0.0, outgoing[0][0] - now)) if outgoing else IDLE
            readable, _, _ = select.select([self._master], [], [], wait)
            # Do not count the time in which this process was suspended, because real servos would not be late.
            origin += max(0.0, time.monotonic() - last - STALL)
            last = time.monotonic()
            now = last - origin
            if readable:
                with contextlib.suppress(BlockingIOError, OSError):
                    data = os.read(self._master, 4096)
                    arrivals = self._answer(data, now)
                    outgoing = deque(sorted([*outgoing, *arrivals], key=lambda arrival: arrival[0]))
            self.line.advance(now)
            while outgoing and outgoing[0][0] <= time.monotonic() - origin:
                self._send(outgoing.popleft()[1])

    def _answer(self, data: bytes, now: float) -> list[tuple[float, bytes]]:
        # When the bytes arrive, the client and the USB adapter have already taken the time that writing them requires.
        baud = self.baud
        arrivals = self.line.transmit(data, now - len(data) * 10 / baud, baud)
        return [(arrival - ADAPTER_LATENCY, frame) for arrival, frame in arrivals]

    @property
    def baud(self) -> int:
        """Bit rate set by the client [bit/s]; if the system does not report it, the bit rate of the servos."""
        with contextlib.suppress(OSError):
            settings = fcntl.ioctl(self._slave, _TCGETS2, bytes(44))
            return int.from_bytes(settings[_OUTPUT_SPEED], sys.byteorder)
        first = next(iter(self.line.servos.registers.values()))
        return _BAUD_BY_CODE.get(termios.tcgetattr(self._slave)[5], first.baud)

    def _send(self, data: bytes) -> None:
        # As with a real adapter, bytes are lost if the client does not read them.
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)

    def close(self) -> None:
        """Close the terminal, and remove the link if it still points to this device."""
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self.device:
            self._link.unlink()
        for descriptor in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(descriptor)
