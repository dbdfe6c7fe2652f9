"""POSIX modules for serial ports and pseudo-terminals; None where the system lacks them, as on Windows.

Servos in memory need none of them.
"""

from __future__ import annotations

from dynsim.hardware.errors import PortError

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
