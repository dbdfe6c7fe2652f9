"""Virtual servos behind a pseudo-terminal, which programs open as a serial device."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from dynsim.hardware.errors import PortError
from dynsim.hardware.posix import fcntl, require_posix, termios, tty
from dynsim.hardware.virtual.line import ADAPTER_LATENCY, VirtualLine

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
