"""Interface of a servo bus and of its answers, clocks for a replay, and the POSIX modules for serial ports."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from dynsim.hardware.bus.control_table import Field
from dynsim.hardware.errors import PortError


class ServoReply(NamedTuple):
    """Contents of one status packet.

    Attributes
    ----------
    data : bytes
    alert : bool
        True if the hardware error register of the servo is not zero.
    age : float
        Time from the arrival of the answer to the end of the read [s]; NaN for a read from a single servo.
    """

    data: bytes
    alert: bool
    age: float = math.nan


@dataclass(frozen=True)
class BlockRead:
    """Result of one sync read.

    Attributes
    ----------
    replies : dict[int, ServoReply]
        Answers by servo ID; a servo that did not answer in time is absent.
    stray_bytes : int
        Number of bytes that were received before the request or do not belong to a valid answer.
    outdated : frozenset of int
        IDs of servos whose answer to an earlier request arrived while this request was pending.
    """

    replies: dict[int, ServoReply]
    stray_bytes: int
    outdated: frozenset[int] = frozenset()


class NoAnswer(Exception):
    """A servo did not answer a request, or its answer was garbled.

    Attributes
    ----------
    id : int
    garbled : bool
        True if bytes arrived but did not form a valid packet, for example because two servos have the same ID.
    """

    def __init__(self, id_: int, *, garbled: bool) -> None:
        super().__init__(f"ID {id_}: {'garbled answer' if garbled else 'no answer'}")
        self.id = id_
        self.garbled = garbled


BUSY = 0.02
"""The computer counts as too busy if the operating system delays this process by more than this time [s]."""


def too_busy(bus: Bus) -> str:
    """Return a message if an answer may be missing because the computer is too busy, otherwise an empty string."""
    if bus.longest_pause < BUSY:
        return ""
    return (
        f"the operating system delayed this program by {bus.longest_pause * 1e3:.0f} ms while it waited for answers; "
        "close other programs or increase bus.latency in the servo map"
    )


class RequestRefused(Exception):
    """A servo answered a request with an error code (:class:`dynsim.hardware.bus.packet.StatusError`)."""

    def __init__(self, id_: int, code: int, text: str) -> None:
        super().__init__(f"ID {id_}: {text}")
        self.id = id_
        self.code = code


class Bus(Protocol):
    """Interface of a servo bus. Every method may raise PortError if the port fails.

    Attributes
    ----------
    longest_pause : float
        Longest time for which the operating system delayed this process while it waited for answers [s].
    """

    @property
    def longest_pause(self) -> float: ...

    def ping_all(self) -> dict[int, tuple[int, int]]:
        """Return the model number and firmware version of each servo that answers a broadcast ping, by ID."""

    def read(self, id_: int, field: Field) -> int:
        """Read one register. Raises NoAnswer or RequestRefused."""

    def read_block(self, id_: int, address: int, length: int) -> ServoReply:
        """Read consecutive bytes. Raises NoAnswer or RequestRefused."""

    def write(self, id_: int, field: Field, value: int) -> None:
        """Write one register and wait for the acknowledgement. Raises NoAnswer or RequestRefused."""

    def sync_write(self, field: Field, values: dict[int, int]) -> None:
        """Write one register of many servos at once; the servos do not acknowledge the write."""

    def sync_read(self, ids: Sequence[int], address: int, length: int) -> BlockRead:
        """Read the same bytes from many servos; the result omits servos that do not answer this request in time."""

    def torque_off_all(self) -> None:
        """Broadcast the command "torque off" three times, whatever the state of the port."""

    def close(self) -> None: ...


# Clocks of a replay: wall time for serial ports, and virtual time for virtual servos in this process.


class Clock:
    """Monotonic clock of the computer; it reads zero at the monotonic time ``origin`` [s]."""

    def __init__(self, origin: float = 0.0) -> None:
        self._origin = origin

    def now(self) -> float:
        """Return the time since the origin [s]."""
        return time.monotonic() - self._origin

    def sleep_until(self, deadline: float) -> None:
        """Wait until the time ``deadline`` [s]; return immediately if it has passed."""
        remaining = deadline - self.now()
        if remaining > 0:
            time.sleep(remaining)


class VirtualClock(Clock):
    """Clock that advances only in ``sleep_until``, so that a replay is deterministic and runs as fast as possible."""

    _time = 0.0

    def now(self) -> float:
        return self._time

    def sleep_until(self, deadline: float) -> None:
        self._time = max(self._time, deadline)


CATCH_UP = 0.02
"""Maximum lateness that a :class:`PacedClock` makes up [s]."""


class PacedClock(VirtualClock):
    """Virtual clock that keeps pace with wall time, and slows down if the computer is too slow or too busy.

    Work between two waits takes no time on this clock. A lateness beyond ``CATCH_UP`` is not made up.
    """

    def __init__(self) -> None:
        super().__init__(time.monotonic())

    def sleep_until(self, deadline: float) -> None:
        remaining = deadline - (time.monotonic() - self._origin)
        if remaining > 0:
            time.sleep(remaining)
        self._origin += max(0.0, -remaining - CATCH_UP)
        super().sleep_until(deadline)


# POSIX modules for serial ports and pseudo-terminals; None on systems without them, such as Windows.


try:
    import fcntl
    import termios
    import tty
except ImportError:
    fcntl = termios = tty = None  # type: ignore[assignment]

TerminalError: type[Exception] = OSError if termios is None else termios.error
"""Exception that a serial port raises in addition to OSError."""


def require_posix(user: str) -> None:
    """Check that this is a POSIX system.

    Parameters
    ----------
    user : str
        Operation that requires POSIX, to be named in the message.

    Raises
    ------
    PortError
        If this is not a POSIX system.
    """
    if termios is None:
        raise PortError(f"{user}: this requires a POSIX system, such as Linux or macOS")
