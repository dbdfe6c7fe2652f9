"""Work that processes of tests are given: of a module, so that spawned ones can load it."""

from __future__ import annotations

import logging
import os
import signal
from pathlib import Path

from dynsim.engine import Progress


def square(number: int, look: Progress) -> int:
    """What most tasks do; some end their process, the first of its kind only or always."""
    if number == DEADLY:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == REFUSED:
        raise ValueError("no square of this one")
    return number**2


def once_deadly(task: tuple[int, str], look: Progress) -> int:
    """The first process that meets ``DEADLY`` dies of it; a file tells the next one."""
    number, folder = task
    seen = Path(folder, "seen")
    if number == DEADLY and not seen.exists():
        seen.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2


def warned(number: int, look: Progress) -> bool:
    """Logs a warning; whether it would have been made."""
    log = logging.getLogger("dynsim.work")
    log.warning("number %d", number)
    return log.isEnabledFor(logging.WARNING)


DEADLY, REFUSED = 5, 7
