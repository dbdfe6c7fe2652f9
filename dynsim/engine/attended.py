"""Loading and running of compiled code in a thread; the calling thread handles signals and the wall-time limit.

Compiled code neither receives signals nor reads a clock, and a single step may take a minute where a contact problem
has no solution. So it runs in another thread, without the interpreter's lock. The calling thread wakes up for a signal,
and checks ten times a second for other reasons to end the run. To end it, it asks compiled code to return after the
present step. Code that does not return in time is left running; the samples so far are in its arrays. The compiler runs
in the same way.
"""

from __future__ import annotations

import logging
import threading
import time as clock
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.engine.compilation import kernels_logged
from dynsim.engine.prepare import Prepared, right_hand_side
from dynsim.integrators import driver
from dynsim.integrators import run as ki
from dynsim.integrators.stepping import tables as kt
from dynsim.system import interruption

log = logging.getLogger(__name__)

# Interval of the checks, and how long to wait for compiled code that was asked to return [s].
LOOK_S, PATIENCE_S = 0.1, 0.5
# A run whose present step takes longer than this is stuck [s]. The longest step observed took 80 s: of 24 contacts
# whose forces no method of the solver finds.
STUCK_S = 600.0
# Most steps of time stepping in the caller's own thread: contacts may close within them.
MOST_SHORT = 50
# Time of one iteration of the contact solver, divided by the cube of the number of rows [s].
ROUND = 2e-9


def attend(
    work: Callable[[], None], ask: Callable[[], None], look: Callable[[], None]
) -> tuple[bool, BaseException | None]:
    """Do ``work`` in a thread of its own; meanwhile handle signals and call ``look``.

    Parameters
    ----------
    work : that releases the interpreter's lock
    ask : asks the work to end soon
    look : called every LOOK_S; what it raises, as what signals raise here, asks the work to end

    Returns
    -------
    ended : False when the work was left alone: it may go on for a while, and write to its arrays
    raised : by ``look``, or by a signal

    Raises
    ------
    Exception
        That of the work.
    """
    done, failure = threading.Event(), list[BaseException]()

    def run() -> None:
        try:
            work()
        except BaseException as raised:
            failure.append(raised)
        done.set()

    ended, request = False, None
    try:
        try:
            threading.Thread(target=run, name="compiled code", daemon=True).start()
            while not (ended := done.wait(LOOK_S)):
                look()
        except BaseException as raised:
            request = raised
            ask()
            ended = done.wait(PATIENCE_S)
    finally:
        # Also after a second signal.
        if not ended:
            interruption.leave()
    if ended and failure:
        raise failure[0]
    return ended, request


class OutOfTime(Exception):
    """Whoever listens has seen a run for too long; ``status`` is what it has come to."""

    def __init__(self, status: int) -> None:
        super().__init__(status)
        self.status = status


class WallWatch:
    """Looks at the clock: for the wall limit of a run, and for one step that does not end.

    Parameters
    ----------
    limit : wall time that the integration may take [s]; None: any
    """

    def __init__(self, limit: float | None) -> None:
        self._limit, self._spent = limit, 0.0
        self._looked = clock.monotonic()
        self._seen, self._still = -1, 0.0

    @property
    def over(self) -> bool:
        """The limit is."""
        return self._limit is not None and self._spent > self._limit

    def begin(self) -> None:
        """A piece begins; what was between pieces counts as nothing."""
        self._looked, self._seen, self._still = clock.monotonic(), -1, 0.0

    def spend(self) -> float:
        """Count the time since the last look, and return it [s]."""
        now = clock.monotonic()
        passed, self._looked = now - self._looked, now
        self._spent += passed
        return passed

    def look(self, run: ki.Run) -> None:
        """Raise :class:`OutOfTime` where there is a reason."""
        passed = self.spend()
        if self.over:
            raise OutOfTime(ki.OUT_OF_TIME)
        seen = int(run.count.sum()) + (0 if run.newton is None else int(run.newton.count.sum()))
        # A process that was stopped for a while has not looked either.
        self._still = self._still + min(passed, 10.0 * LOOK_S) if seen == self._seen else 0.0
        self._seen = seen
        if self._still > STUCK_S:
            raise OutOfTime(ki.STUCK)


def load(prepared: Prepared) -> None:
    """Load the kernels of a run, or compile them, and log that.

    Raises
    ------
    KeyboardInterrupt
        The compiler goes on alone.
    """
    with kernels_logged(log, prepared.kind):
        compiled = partial(driver.advance, prepared.system, prepared.workspace, prepared.run, -1)
        _, raised = attend(compiled, lambda: None, interruption.check)
    if raised is not None:
        raise raised


def _short_steps(prepared: Prepared) -> int:
    """How many steps are over before anybody would have looked, whatever happens within them.

    They are taken in the caller's own thread: to hand a short run to another one costs some hundredths of its time.
    None under the unilateral law, where one step may take a minute; but steps of one length, whose contact problems
    are given up after so many rounds: as many as take no longer than code that was asked to return, with the rows of
    the last step. So many rounds are hardly ever needed, and a thread for each tick of a controller would double the
    time of a snake.
    """
    if prepared.system.unilateral is not None:
        rows = max(int(prepared.workspace.counts[ka.ROWS]), 1)
        few = min(int(PATIENCE_S / (kt.MOST_ROUNDS * ROUND * rows**3)), MOST_SHORT)
        return few if prepared.run.stepping is not None else 0
    n, p = len(prepared.workspace.joints), prepared.workspace.small.shape[1]
    seconds = right_hand_side(n, p, dense=prepared.system.dense is not None)
    # Of RADAU5 with a Jacobian and its factors.
    step = (2 * n + 60) * seconds + 3e-9 * n**3 if prepared.run.newton is not None else 6.0 * seconds
    return int(LOOK_S / step)


def advance(
    prepared: Prepared,
    limit: int,
    watch: WallWatch,
    look: Callable[[], None],
    kernel: Callable[..., None] | None = None,
) -> tuple[Prepared, BaseException | None]:
    """One piece of up to ``limit`` steps, see :func:`dynsim.integrators.driver.advance`.

    STATUS may be OUT_OF_TIME or STUCK besides what the kernels make of it.

    Parameters
    ----------
    kernel : what takes the steps, of :func:`dynsim.integrators.driver.direct`; default: that of the driver

    Returns
    -------
    prepared : the same, or a copy where the piece was left alone; that one cannot go on
    raised : what ``look`` has raised, or a signal
    """
    run, few, kernel = prepared.run, min(_short_steps(prepared), limit), kernel or driver.advance
    ended, raised = True, None

    def ask() -> None:
        run.count[ki.ASKED] = 1

    def both() -> None:
        look()
        watch.look(run)

    watch.begin()
    due = few == 0
    if not due:
        kernel(prepared.system, prepared.workspace, run, few)
        # Not where it has come to what its caller is to look at. (A pending step at the begin is to be accepted.)
        count = run.count
        due = count[ki.STATUS] == ki.RUNNING and count[ki.PENDING] == count[ki.TICKED] == count[ki.LOGGED] == 0
    if due and limit > few:
        remainder = partial(kernel, prepared.system, prepared.workspace, run, limit - few)
        ended, raised = attend(remainder, ask, both)
    watch.spend()
    if not ended:
        prepared = copied(prepared)
    count = prepared.run.count
    count[ki.ASKED] = 0
    if not ended or count[ki.STATUS] == ki.RUNNING:
        if isinstance(raised, OutOfTime):
            count[ki.STATUS] = raised.status
        elif not ended:
            count[ki.STATUS] = ki.STUCK
        elif watch.over:
            count[ki.STATUS] = ki.OUT_OF_TIME
    return prepared, None if isinstance(raised, OutOfTime) else raised


def copied(value: Any) -> Any:
    """Tables and arrays of their own, in which nothing moves any more."""
    if isinstance(value, Prepared):
        return replace(value, run=copied(value.run), workspace=copied(value.workspace), system=copied(value.system))
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, tuple):
        parts = map(copied, value)
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value
