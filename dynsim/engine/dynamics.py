"""Engine of the multibody plants: integrate the coupled system and collect its record."""

from __future__ import annotations

import logging
import time as clock

from dynsim import interruption
from dynsim.engine import SIMULATION, Progress
from dynsim.engine.compilation import kernels_logged
from dynsim.engine.outcome import raise_stopped
from dynsim.engine.prepare import Prepared, prepare
from dynsim.engine.recording import make_record
from dynsim.engine.start import check
from dynsim.engine.stepped import event_name, own_guards, take_log
from dynsim.engine.stopping import last_state, stopped
from dynsim.errors import SimulationInterrupted, SimulationStopped
from dynsim.kernels.integrate import driver
from dynsim.kernels.integrate import run as ki
from dynsim.record import Event, Record
from dynsim.reuse import Reuse
from dynsim.scenario import Scenario

__all__ = ["Prepared", "check", "prepare", "simulate"]

log = logging.getLogger(__name__)

# Wall time between two looks at progress and Ctrl-C [s].
CHUNK_S = 0.1


class _Pace:
    """How many steps systems of one size and method take between two looks at progress and Ctrl-C."""

    def __init__(self) -> None:
        self.limit, self.known = 1, False

    def took(self, steps: int, seconds: float) -> None:
        """So many steps have taken so long."""
        self.known = True
        if steps > 0:
            self.limit = int(min(max(min(steps * CHUNK_S / max(seconds, 1e-9), 10.0 * self.limit), 1), 1_000_000))


def _tried(run: ki.Run) -> int:
    """Steps accepted and refused."""
    return int(run.count[ki.STEPS] + run.count[ki.REJECTED])


def simulate(
    scenario: Scenario, progress: Progress | None = None, *, pictured: bool = True, reuse: Reuse | None = None
) -> Record:
    """See :func:`dynsim.engine.simulate`."""
    prepared = prepare(scenario, progress, reuse=reuse)
    if prepared.control.operated is not None:
        from dynsim.engine import operated

        return operated.simulate(scenario, progress, pictured=pictured)
    run = prepared.run
    size = prepared.model.n, len(prepared.contacts), len(prepared.stops)
    pace = prepared.reuse.of("pace", _Pace, prepared.choice.method, *size)
    if not pace.known:
        # Loading or compiling the kernels is no integration time.
        with kernels_logged(log, prepared.kind):
            driver.advance(prepared.system, prepared.workspace, run, 0)
    if progress is not None:
        progress(0.0, SIMULATION)
    own = own_guards(prepared)
    happened: list[Event] = []
    started, interrupted = clock.perf_counter(), False
    try:
        log.info("%s: integrating %g s by %s", scenario.title, scenario.duration_s, prepared.choice.method)
        while run.count[ki.STATUS] == ki.RUNNING:
            before, steps = clock.perf_counter(), _tried(run)
            driver.advance(prepared.system, prepared.workspace, run, pace.limit)
            taken = clock.perf_counter() - before
            happened += [Event(time, *(event_name(prepared, e) or own[e])) for time, e in take_log(run)]
            pace.took(_tried(run) - steps, taken)
            if progress is not None:
                progress(float(run.clock[ki.TIME]), SIMULATION)
            interruption.check()
        interruption.keep()
    except KeyboardInterrupt:
        interruption.keep()
        interruption.answered()
        interrupted = True
    wall = clock.perf_counter() - started
    log.info("%s: integrated %g s in %d steps, %.3f s", scenario.title, run.clock[ki.TIME], run.count[ki.STEPS], wall)
    record = make_record(scenario, prepared, wall, happened=happened, pictured=pictured)
    reached = float(run.clock[ki.TIME])
    if interrupted or run.count[ki.STATUS] != ki.FINISHED:
        if interrupted:
            stop: SimulationStopped = SimulationInterrupted(
                f"interrupted at t = {reached:.3f} s of {scenario.duration_s:g} s",
                time=reached,
                state=last_state(prepared, run.y),
            )
        else:
            stop = stopped(scenario, prepared)
        raise_stopped(stop, record)
    return record
