"""Engine of the multibody plants: integrate the coupled system and collect its record."""

from __future__ import annotations

import logging
import time as clock
from functools import partial

from dynsim.engine import SIMULATION, Progress, attended
from dynsim.engine.outcome import raise_stopped
from dynsim.engine.prepare import Prepared, prepare
from dynsim.engine.recording import make_record
from dynsim.engine.start import check
from dynsim.engine.stepped import event_name, own_guards, take_log
from dynsim.engine.stopping import last_state, stopped
from dynsim.errors import SimulationInterrupted, SimulationStopped
from dynsim.integrators import run as ki
from dynsim.record import Event, Record
from dynsim.scenario import Scenario
from dynsim.system import interruption
from dynsim.system.memo import recall

__all__ = ["Prepared", "check", "prepare", "simulate"]

log = logging.getLogger(__name__)

# More steps than any run takes.
_ALL = 1 << 62


def simulate(scenario: Scenario, progress: Progress | None = None, *, pictured: bool = True) -> Record:
    """See :func:`dynsim.engine.simulate`."""
    prepared = prepare(scenario, progress)
    if prepared.control.operated is not None:
        from dynsim.engine import operated

        return operated.simulate(scenario, progress, pictured=pictured)
    size = prepared.model.n, len(prepared.contacts), len(prepared.stops)
    # Loading or compiling the kernels is no integration time.
    recall("kernels", partial(attended.load, prepared), prepared.choice.method, *size)
    watch, run = attended.WallWatch(scenario.integrator.wall_limit_s), prepared.run

    def look() -> None:
        if progress is not None:
            progress(float(run.clock[ki.TIME]), SIMULATION)
        interruption.check()

    own = own_guards(prepared)
    happened: list[Event] = []
    started, interrupted = clock.perf_counter(), False
    try:
        look()
        log.info("%s: integrating %g s by %s", scenario.title, scenario.duration_s, prepared.choice.method)
        while run.count[ki.STATUS] == ki.RUNNING:
            prepared, raised = attended.advance(prepared, _ALL, watch, look)
            run = prepared.run
            happened += [Event(time, *(event_name(prepared, e) or own[e])) for time, e in take_log(run)]
            if raised is not None:
                raise raised
            look()
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
