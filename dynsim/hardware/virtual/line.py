"""A virtual half-duplex line with servos: takes the bytes of requests, returns those of answers with arrival times.

:class:`dynsim.hardware.virtual.line.VirtualPort` puts a line under the client library on a virtual clock,
:mod:`dynsim.hardware.virtual.line` behind a serial device.
"""

from __future__ import annotations

import contextlib
import os
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
from dynsim.hardware.bus.packet import STATUS, Decoder, Packet
from dynsim.hardware.bus.protocol import Clock, fcntl, require_posix, termios, tty
from dynsim.hardware.errors import PortError
from dynsim.hardware.servo_map import ServoMap
from dynsim.hardware.virtual.faults import FaultScript
from dynsim.hardware.virtual.injection import Injection
from dynsim.hardware.virtual.servos import PHYSICS_STEP, Firmware, ServoRegisters, VirtualServos
from dynsim.hardware.virtual.simulated_plant import ServoPlant

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
    listener : callable, optional
        Called with (time, packet) for every valid packet that a servo can hear.
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
        self._faults = Injection(self.servos, script)
        self._firmware = Firmware(self.servos)
        self._decoders: dict[int, Decoder] = {}
        self._heard = 0.0
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
        """What the first servo is set to [bit/s]."""
        return next(iter(self.servos.registers.values())).baud

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
        # A packet that stopped half-way is given up after a while.
        given_up = start - self._heard > BYTE_TIMEOUT
        self._heard = end
        # To servos at another bit rate this is noise.
        if baud in self.servos.hearing:
            decoder = self._decoders.setdefault(baud, Decoder())
            packets = [*decoder.flush()] if given_up else []
            for packet in [*packets, *decoder.feed(data)]:
                if packet.instruction != STATUS and baud in self.servos.hearing:
                    arrivals += self._execute(packet, end, baud)
        return arrivals

    def _execute(self, packet: Packet, now: float, baud: int) -> list[tuple[float, bytes]]:
        hearing = self.servos.hearing[baud]
        self.servos.hear(hearing, now)
        if self.listener:
            self.listener(now, packet)
        arrivals: list[tuple[float, bytes]] = []
        for answer in self._firmware.answers(packet, hearing):
            first = answer.servos[0]
            if not answer.chained:
                now += self.servos.registers[first]["return_delay"] * RETURN_DELAY_SECONDS_PER_UNIT + TURNAROUND
            now += len(answer.frame) * 10 / baud
            arrivals += self._faults.disturb(first, answer.frame, now + ADAPTER_LATENCY)
        return arrivals


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


# A port of virtual servos for the client library, on a virtual clock.


class VirtualPort(PortHandler):
    """The client library's port on a :class:`VirtualLine` and a clock that begins at 0.

    On a virtual clock nothing here waits: a read without waiting bytes advances the clock to the next byte or the
    time-out.
    """

    POLL = 1e-5

    def __init__(self, line: VirtualLine, clock: Clock, *, baud: int) -> None:
        super().__init__("virtual")
        self.line = line
        self.clock = clock
        self.baudrate = baud
        self.is_open = True
        self.longest_pause = 0.0
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
            until = min(soon, self._arriving[0][0]) if self._arriving else soon
            self.clock.sleep_until(until)
            self.longest_pause = max(self.longest_pause, self.clock.now() - until)
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


# Virtual servos behind a pseudo-terminal, which programs open as a serial device.


_BAUD_BY_CODE = {
    getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()
}
_TCGETS2 = 0x802C542A
"""Linux request for the settings of a terminal with the bit rate as a number: clients set rates that have no code."""
_OUTPUT_SPEED = slice(40, 44)
IDLE = 1e-3
"""Longest wait for bytes before the motion of the servos is computed further [s]; short, so that a request needs little
of it."""


STALL = 10e-3
"""Longest pause of this process that the servos take into account; of longer ones this part [s]."""


class PseudoTerminal:
    """Serves a :class:`VirtualLine` in wall time.

    Attributes
    ----------
    device : str
        Path of the serial device to open.
    """

    def __init__(self, line: VirtualLine, link: Path | None = None) -> None:
        """Open the terminal, and name it by the symbolic link ``link`` if given.

        Raises
        ------
        PortError
            The link exists as something else, leads to a device that is there, or cannot be made; or a system without
            pseudo-terminals.
        """
        require_posix("virtual servos behind a pseudo-terminal")
        self.line = line
        self._master, self._slave = os.openpty()
        # Kept open: without a holder of the slave end the master reads end-of-file between two clients.
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
                raise PortError(f"{link}: cannot be made a link to {self.device} ({error.strerror})") from error

    def _refuse_device_in_use(self, link: Path) -> None:
        """What a process that was killed has left leads nowhere, or by chance to the own device."""
        if link.exists() and os.readlink(link) != self.device:
            there = os.readlink(link)
            self._link = None
            self.close()
            raise PortError(f"{link}: leads to {there}, which is in use (other virtual servos?); give another link")

    def serve(self, keep_on: Callable[[], bool]) -> None:
        """Answer until ``keep_on`` says no, or the scripted adapter is pulled out."""
        origin = last = time.monotonic()
        outgoing: deque[tuple[float, bytes]] = deque()
        while keep_on() and not self.line.unplugged:
            now = time.monotonic() - origin
            wait = min(IDLE, max(0.0, outgoing[0][0] - now)) if outgoing else IDLE
            readable, _, _ = select.select([self._master], [], [], wait)
            # When the computer did not run this process the servos stood still too: real ones would not have been late.
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
        # The client's own write time has passed already when the bytes are here; the USB adapter's has too.
        baud = self.baud
        arrivals = self.line.transmit(data, now - len(data) * 10 / baud, baud)
        return [(arrival - ADAPTER_LATENCY, frame) for arrival, frame in arrivals]

    @property
    def baud(self) -> int:
        """What the client has set [bit/s]; what the servos have where the system does not say."""
        with contextlib.suppress(OSError):
            settings = fcntl.ioctl(self._slave, _TCGETS2, bytes(44))
            return int.from_bytes(settings[_OUTPUT_SPEED], sys.byteorder)
        return _BAUD_BY_CODE.get(termios.tcgetattr(self._slave)[5], self.line.baud)

    def _send(self, data: bytes) -> None:
        # A client that does not read loses bytes, as with a real adapter.
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)

    def close(self) -> None:
        """Hang up and remove the link, where it is still the own one."""
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self.device:
            self._link.unlink()
        for descriptor in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(descriptor)
