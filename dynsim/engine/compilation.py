"""Messages about kernel compilation: which kernels, the reason, and the expected duration.

Each compilation writes one log line. On a terminal without progress bars, lines on stderr mark its start and end.
Commands show compilations in their progress bars, including compilations in worker processes, which announce them in a
file next to the kernels.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
import time as clock
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from dynsim.jit.kernel import cache_folder, on_compilation

# File next to the kernel folders: duration of the last compilation of each kind [s].
LAST = "compiled_in_s.json"
# Suffix of the file that announces a compilation in progress; the file name is the process id.
MARK = ".compiling"
# Expected duration as text if no earlier compilation is known.
USUAL = "a few seconds to two minutes on two cores"
# Interval at which displays read these files [s].
LOOK_S = 0.5

# False if the command shows its own progress bars.
_on_terminal = True


@dataclass(frozen=True)
class Compilation:
    """A compilation in progress.

    Attributes
    ----------
    text : str
        Kernels, reason and expected duration.
    since : float
        Clock time of the start [s].
    expected : float or None
        Duration of the last compilation of this kind [s]; None if unknown.
    """

    text: str
    since: float
    expected: float | None

    @property
    def elapsed(self) -> float:
        """Time since the start [s]."""
        return max(clock.time() - self.since, 0.0)


def shown_by_caller() -> None:
    """Write nothing more to stderr in this process, because the caller shows progress bars."""
    global _on_terminal
    _on_terminal = False


@contextmanager
def kernels_logged(log: logging.Logger, kind: str = "", loads: bool = True) -> Iterator[None]:
    """Log how long it takes to load or compile kernels.

    Parameters
    ----------
    log : logging.Logger
        Logger to write to.
    kind : str, optional
        Kind of system for which the kernels are compiled.
    loads : bool, optional
        If False, log nothing when the kernels were only loaded.
    """
    started, compiling, marks = clock.perf_counter(), False, ExitStack()
    on_terminal = _on_terminal and sys.stderr is not None and sys.stderr.isatty()

    def begin() -> None:
        nonlocal compiling
        compiling, compilation = True, _beginning(kind)
        log.info(compilation.text)
        marks.enter_context(_marked(compilation))
        if on_terminal:
            print(f"dynsim: {compilation.text}", file=sys.stderr, flush=True)

    with marks, on_compilation(begin):
        yield
    taken = clock.perf_counter() - started
    if compiling:
        with suppress(OSError):
            (cache_folder().parent / LAST).write_text(json.dumps(_durations() | {kind: round(taken)}))
        if on_terminal:
            print(f"dynsim: compiled the kernels in {taken:.0f} s", file=sys.stderr, flush=True)
    if compiling or loads:
        log.info("%s the kernels in %.1f s", "compiled" if compiling else "loaded", taken)


def _durations() -> dict[str, float]:
    """Return the duration of the last compilation of each kind [s]; empty if the file cannot be read."""
    with suppress(OSError, ValueError, TypeError, AttributeError):
        known = json.loads((cache_folder().parent / LAST).read_text())
        return {kind: float(seconds) for kind, seconds in known.items()}
    return {}


def _beginning(kind: str) -> Compilation:
    folder = cache_folder()
    others = any(folder.glob("*.kernel"))
    why = (
        "the first compilation of this kind since dynsim was installed, updated or edited"
        if others
        else "the first compilation since dynsim, numba or numpy was installed, updated or edited"
    )
    expected = _durations().get(kind)
    last = USUAL if expected is None else f"the last compilation took {expected:.0f} s"
    purpose = f" for {kind}" if kind else ""
    return Compilation(f"compiling the kernels{purpose}, {why}: {last}; later runs load them", clock.time(), expected)


@contextmanager
def _marked(compilation: Compilation) -> Iterator[None]:
    """Announce a compilation in the file that displays read, until the block ends."""
    path = cache_folder() / f"{os.getpid()}{MARK}"
    with suppress(OSError):
        path.write_text(json.dumps([_group(), compilation.text, compilation.since, compilation.expected]))
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink()


def _group() -> int:
    """Return the process group id, or the process id on systems without process groups."""
    return os.getpgrp() if hasattr(os, "getpgrp") else os.getpid()


def under_way() -> Compilation | None:
    """Return the oldest compilation in progress in this process group, or None."""
    running = []
    for path in cache_folder().glob(f"*{MARK}"):
        with suppress(OSError, ValueError, TypeError):
            group, text, since, expected = json.loads(path.read_text())
            if hasattr(os, "getpgrp"):  # without process groups, signal 0 would end the process
                os.kill(int(path.name.removesuffix(MARK)), 0)  # the file of a dead process remains
            if group == _group():
                running.append(Compilation(str(text), float(since), expected))
    return min(running, key=lambda compilation: compilation.since, default=None)


@contextmanager
def watched(show: Callable[[Compilation | None], None]) -> Iterator[None]:
    """Call ``show`` at regular intervals while a compilation is in progress, and once with None when it ends."""
    shown_by_caller()
    over, folder = threading.Event(), Path(cache_folder())

    def look() -> None:
        last: Compilation | None = None
        while not over.wait(LOOK_S):
            now = under_way() if folder.is_dir() else None
            if now is not None or last is not None:
                show(now)
            last = now
        if last is not None:
            show(None)

    thread = threading.Thread(target=look, name="compiling", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
