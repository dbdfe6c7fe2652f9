"""Interface of a servo bus: the calls that the replay makes, and the answers of a servo."""

from __future__ import annotations

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
        The servo's hardware error register is not zero.
    """

    data: bytes
    alert: bool


@dataclass(frozen=True)
class BlockRead:
    """Result of one sync read.

    Attributes
    ----------
    replies : dict[int, ServoReply]
        By ID; a servo that did not answer in time is absent.
    stray_bytes : int
        Bytes that were already waiting before the request, and garbage between the answers.
    outdated : frozenset of int
        Who answered an earlier request while the answer to this one was awaited.
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
        Something came, but no valid packet: two servos with one ID look like this.
    """

    def __init__(self, id_: int, *, garbled: bool) -> None:
        super().__init__(f"ID {id_}: {'garbled answer' if garbled else 'no answer'}")
        self.id = id_
        self.garbled = garbled


BUSY = 0.02
"""A process that is run later than this while it waits is on a computer that is too busy [s]."""


def too_busy(bus: Bus) -> str:
    """What else than a servo may be the reason for a missing answer; empty where nothing shows it."""
    if bus.longest_pause < BUSY:
        return ""
    return (
        f"this program was run {bus.longest_pause * 1e3:.0f} ms too late while it waited for answers: the computer is "
        "too slow or too busy; close other programs, or give the map a longer bus.latency"
    )


class RequestRefused(Exception):
    """A servo answered with an error code (:class:`dynsim.hardware.bus.packet.StatusError`)."""

    def __init__(self, id_: int, code: int, text: str) -> None:
        super().__init__(f"ID {id_}: {text}")
        self.id = id_
        self.code = code


class Bus(Protocol):
    """A line with servos. Every method may raise PortError when the port itself is gone.

    Attributes
    ----------
    longest_pause : float
        By which the system has run this process too late while it waited for answers [s].
    """

    @property
    def longest_pause(self) -> float: ...

    def ping_all(self) -> dict[int, tuple[int, int]]:
        """Model number and firmware by ID of everything that answers a broadcast ping."""
        ...

    def read(self, id_: int, field: Field) -> int:
        """One item. Raises NoAnswer or RequestRefused."""
        ...

    def read_block(self, id_: int, address: int, length: int) -> ServoReply:
        """Consecutive bytes. Raises NoAnswer or RequestRefused."""
        ...

    def write(self, id_: int, field: Field, value: int) -> None:
        """Write one item and wait for the acknowledgement. Raises NoAnswer or RequestRefused."""
        ...

    def sync_write(self, field: Field, values: dict[int, int]) -> None:
        """Write one item of many servos at once; nobody acknowledges."""
        ...

    def sync_read(self, ids: Sequence[int], address: int, length: int) -> BlockRead:
        """Read the same bytes of many servos; whoever does not answer this very request in time is absent."""
        ...

    def torque_off_all(self) -> None:
        """Broadcast torque off, three times, whatever the state of the port."""
        ...

    def close(self) -> None: ...


# Clocks of a replay: their interface, wall time for serial ports, virtual time for servos in memory.


class Clock(Protocol):
    """Monotonic time."""

    def now(self) -> float:
        """Seconds since an arbitrary origin [s]."""
        ...

    def sleep_until(self, deadline: float) -> None:
        """Return at ``deadline`` [s], at once if it has passed."""
        ...


class WallClock:
    """The computer's monotonic clock, from an ``origin`` of it on [s]."""

    def __init__(self, origin: float = 0.0) -> None:
        self._origin = origin

    def now(self) -> float:
        return time.monotonic() - self._origin

    def sleep_until(self, deadline: float) -> None:
        remaining = deadline - self.now()
        if remaining > 0:
            time.sleep(remaining)


class VirtualClock:
    """Time that passes only when somebody waits: a replay on it is deterministic and as fast as the computer allows."""

    def __init__(self) -> None:
        self._now = 0.0

    def now(self) -> float:
        return self._now

    def sleep_until(self, deadline: float) -> None:
        self._now = max(self._now, deadline)


# POSIX modules for serial ports and pseudo-terminals; None where the system lacks them, as on Windows.


try:
    import fcntl
    import termios
    import tty
except ImportError:
    fcntl = termios = tty = None  # type: ignore[assignment]

TerminalError: type[Exception] = OSError if termios is None else termios.error
"""Exception that a serial port raises beside OSError."""


def require_posix(user: str) -> None:
    """Refuse an operation that needs POSIX, named ``user`` in the message.

    Raises
    ------
    PortError
        This system is another one.
    """
    if termios is None:
        raise PortError(f"{user}: needs a POSIX system such as Linux or macOS, which this is not")
