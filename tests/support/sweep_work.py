"""Tasks for worker processes of tests, in a module that spawned processes can import."""

from __future__ import annotations

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
    """Return the square of a number; ``DEADLY`` kills the process, ``REFUSED`` raises an error."""
    if number == DEADLY:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == REFUSED:
        raise ValueError("no square of this one")
    return number**2


def once_deadly(task: tuple[int, str], look: Progress) -> int:
    """Return the square; ``DEADLY`` kills the first process that gets it, which leaves a file for the next process."""
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


def deaf(task: tuple[int, str], look: Progress) -> int:
    """Leave a file to show that the task has begun, and never check for a stop."""
    number, folder = task
    Path(folder, f"begun_{number}").touch()
    time.sleep(1000.0)
    return number


def attentive(task: tuple[int, str], look: Progress) -> int:
    """Leave a file with the process id when the task has begun, and return the number on a stop."""
    number, folder = task
    Path(folder, f"begun_{os.getpid()}").touch()
    try:
        while True:
            look(0.0)
            time.sleep(0.05)
    except KeyboardInterrupt:
        return number


def leaves(number: int, look: Progress) -> int:
    """Report, for ``DEADLY``, a remaining thread that cannot be ended; return the process id."""
    if number == DEADLY:
        interruption.leave()
    return os.getpid()


def pid(number: int, look: Progress) -> int:
    """Return the process id."""
    return os.getpid()


def busy(duration: float, look: Progress) -> int:
    """Use the processor for a time [s], and return the process id."""
    begun = time.process_time()
    while time.process_time() < begun + duration:
        look(0.0)
    return os.getpid()


def named(thing: Any, look: Progress) -> str:
    """Return the name of an object."""
    return str(thing.name)


def unsendable(thing: Any, look: Progress) -> Any:
    """Return a result that cannot be sent to another process."""
    return open(os.devnull)


def says(number: int, look: Progress) -> str:
    """Print a line, and return the content of standard input."""
    os.write(1, b"printed\n")
    return sys.stdin.read()


DEADLY, REFUSED = 5, 7
