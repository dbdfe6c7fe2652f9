"""Messages about the compilation of kernels: which kernels, why they are compiled again, and for how long.

Each compilation gives one line in the log. On a terminal without progress bars, lines on stderr mark its begin and its
end. Commands show it in their progress bars, also that of worker processes, which mark it by a file beside the kernels.
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

# File beside the folders of kernels: duration of the last compilation of each kind [s].
LAST = "compiled_in_s.json"
# Suffix of the file that marks a compilation under way; its name is the process id.
MARK = ".compiling"
# Expected duration, in words, where no earlier one is known.
USUAL = "seconds to two minutes on two cores"
# Interval at which a display reads those files [s].
LOOK_S = 0.5

# False where a command shows progress bars of its own.
_on_terminal = True


@dataclass(frozen=True)
class Compilation:
    """A compilation that is under way.

    Attributes
    ----------
    text : kernels, reason and expected duration
    since : time of the clock at its beginning [s]
    expected : how long the last one of this kind took [s]; None: there was none
    """

    text: str
    since: float
    expected: float | None

    @property
    def elapsed(self) -> float:
        """[s]"""
        return max(clock.time() - self.since, 0.0)


def shown_by_caller() -> None:
    """From now on nothing of this process is written to stderr: its caller has bars."""
    global _on_terminal
    _on_terminal = False


@contextmanager
def kernels_logged(log: logging.Logger, kind: str = "", loads: bool = True) -> Iterator[None]:
    """Log the time in which kernels are loaded, or compiled.

    kind : of what system they are
    loads : also say how long it took when none had to be compiled
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
    """How long the last compilation of each kind took [s]; of a file that cannot be read none."""
    with suppress(OSError, ValueError, TypeError, AttributeError):
        known = json.loads((cache_folder().parent / LAST).read_text())
        return {kind: float(seconds) for kind, seconds in known.items()}
    return {}


def _beginning(kind: str) -> Compilation:
    folder = cache_folder()
    others = any(folder.glob("*.kernel"))
    why = (
        "the first of this kind since dynsim was installed, updated or edited"
        if others
        else "the first since dynsim, numba or numpy were installed, updated or edited"
    )
    expected = _durations().get(kind)
    last = USUAL if expected is None else f"the last time took {expected:.0f} s"
    purpose = f" for {kind}" if kind else ""
    return Compilation(f"compiling the kernels{purpose}, {why}: {last}, later runs load them", clock.time(), expected)


@contextmanager
def _marked(compilation: Compilation) -> Iterator[None]:
    """What is compiled is written where displays look for it, within."""
    path = cache_folder() / f"{os.getpid()}{MARK}"
    with suppress(OSError):
        path.write_text(json.dumps([_group(), compilation.text, compilation.since, compilation.expected]))
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink()


def _group() -> int:
    """Number of this process's group; of a system without groups that of the process."""
    return os.getpgrp() if hasattr(os, "getpgrp") else os.getpid()


def under_way() -> Compilation | None:
    """What this process or one of its group compiles, the one that began first; None: nothing."""
    running = []
    for path in cache_folder().glob(f"*{MARK}"):
        with suppress(OSError, ValueError, TypeError):
            group, text, since, expected = json.loads(path.read_text())
            if hasattr(os, "getpgrp"):  # elsewhere signal 0 would end it
                os.kill(int(path.name.removesuffix(MARK)), 0)  # of a process that died it stays
            if group == _group():
                running.append(Compilation(str(text), float(since), expected))
    return min(running, key=lambda compilation: compilation.since, default=None)


@contextmanager
def watched(show: Callable[[Compilation | None], None]) -> Iterator[None]:
    """Call ``show`` now and then while something is compiled, and once with None when that is over."""
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
