"""Tasks for worker processes of tests, in a module that spawned processes can import."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

from dynsim.engine import Progress
from dynsim.system import interruption


def square(number: int, look: Progress) -> int:
    """The square of a number; ``DEADLY`` kills the process, ``REFUSED`` raises an error."""
    if number == DEADLY:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == REFUSED:
        raise ValueError("no square of this one")
    return number**2


def once_deadly(task: tuple[int, str], look: Progress) -> int:
    """The square of a number; ``DEADLY`` kills the first process that gets it, which leaves a file for the next."""
    number, folder = task
    seen = Path(folder, "seen")
    if number == DEADLY and not seen.exists():
        seen.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2


def warned(number: int, look: Progress) -> bool:
    """Log a warning; return whether its level is enabled."""
    log = logging.getLogger("dynsim.work")
    log.warning("number %d", number)
    return log.isEnabledFor(logging.WARNING)


def hangs(number: int, look: Progress) -> int:
    """One task holds the interpreter's lock for good, as compiled code does that never ends; one stops its process."""
    if number == DEADLY:
        ctypes.PyDLL(None).pause()
    if number == REFUSED:
        os.kill(os.getpid(), signal.SIGSTOP)
    return number**2


def slow(number: int, look: Progress) -> int:
    """Longer than what is taken for silent in its test, half of it at work in Python, half of it asleep."""
    end = time.monotonic() + 1.5
    while time.monotonic() < end:
        pass
    time.sleep(1.5)
    return number**2


def deaf(task: tuple[int, str], look: Progress) -> int:
    """Tells that it has begun, and never looks whether it shall stop."""
    number, folder = task
    Path(folder, f"begun_{number}").touch()
    time.sleep(1000.0)
    return number


def attentive(task: tuple[int, str], look: Progress) -> int:
    """Tells its process that it has begun, and returns the number when it shall stop."""
    number, folder = task
    Path(folder, f"begun_{os.getpid()}").touch()
    try:
        while True:
            look(0.0)
            time.sleep(0.05)
    except KeyboardInterrupt:
        return number


def leaves(number: int, look: Progress) -> int:
    """One task leaves a thread behind that cannot be ended."""
    if number == DEADLY:
        interruption.leave()
    return os.getpid()


def pid(number: int, look: Progress) -> int:
    """Of the process."""
    return os.getpid()


def named(thing: Any, look: Progress) -> str:
    """What a thing is called."""
    return str(thing.name)


def unsendable(thing: Any, look: Progress) -> Any:
    """A result that no other process can have."""
    return open(os.devnull)


def says(number: int, look: Progress) -> str:
    """Prints, and reads what is there to be read."""
    os.write(1, b"printed\n")
    return sys.stdin.read()


DEADLY, REFUSED = 5, 7
