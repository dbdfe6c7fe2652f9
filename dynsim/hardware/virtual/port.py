"""A port of virtual servos for the client library, on a virtual clock."""

from __future__ import annotations

from collections import deque
from typing import Any

import serial
from dynamixel_sdk import PortHandler

from dynsim.hardware.bus.clock import Clock
from dynsim.hardware.virtual.line import VirtualLine


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
