"""Engine of the multibody plants: integrates the coupled system and makes the record of the run."""

from __future__ import annotations

import logging
import math
import time as clock
from functools import partial

from dynsim.engine import SIMULATION, Progress, attended
from dynsim.engine.outcome import interrupted, raise_stopped
from dynsim.engine.prepare import Prepared, prepare, sample_times
from dynsim.engine.recording import make_record
from dynsim.engine.soundness import unstable_loop
from dynsim.engine.start import check, commanded_by_python
from dynsim.engine.stepped import event_name, own_guards, take_log
from dynsim.engine.stopping import last_state, stopped
from dynsim.errors import SimulationStopped
from dynsim.integrators import run as ki
from dynsim.record import Event, Record
from dynsim.scenario import Scenario
from dynsim.system import interruption
from dynsim.system.memo import recall

__all__ = ["Prepared", "check", "prepare", "simulate"]

log = logging.getLogger(__name__)

# More steps than any run takes.
_ALL = 1 << 62
# Ticks between two checks for Ctrl-C, at which the progress bar is updated.
TICKS = 10


def simulate(scenario: Scenario, progress: Progress | None = None, *, pictured: bool = True) -> Record:
    """See :func:`dynsim.engine.simulate`."""
    if scenario.controller is not None and scenario.controller.type == "task_space":
        # Not prepared twice: that raises the head of a snake.
        return _stepped(scenario, progress, pictured)
    prepared = prepare(scenario, progress)
    if commanded_by_python(scenario, prepared.control):
        return _stepped(scenario, progress, pictured)
    size = prepared.model.n, len(prepared.contacts), len(prepared.stops)
    # Loading or compiling the kernels is no integration time.
    recall("kernels", partial(attended.load, prepared), prepared.choice.method, *size)
    if (unstable := unstable_loop(scenario, prepared)) is not None:
        log.warning("%s: %s", scenario.title, unstable[0])
    watch, run = attended.WallWatch(scenario.integrator.wall_limit_s), prepared.run

    def look() -> None:
        if progress is not None:
            progress(float(run.clock[ki.TIME]), SIMULATION)
        interruption.check()

    own = own_guards(prepared)
    happened: list[Event] = []
    stop: SimulationStopped | None = None
    started = clock.perf_counter()
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
        stop = interrupted(scenario, float(run.clock[ki.TIME]), last_state(prepared, run.y))
    wall = clock.perf_counter() - started
    log.info("%s: integrated %g s in %d steps, %.3f s", scenario.title, run.clock[ki.TIME], run.count[ki.STEPS], wall)
    record = make_record(scenario, prepared, wall, happened=happened, pictured=pictured)
    if stop is None and run.count[ki.STATUS] != ki.FINISHED:
        stop = stopped(scenario, prepared)
    if stop is not None:
        raise_stopped(stop, record)
    return record


def _stepped(scenario: Scenario, progress: Progress | None, pictured: bool) -> Record:
    """A run with ticks of an operator, a snake's script or encoders: by the public stepper, bit for bit its record."""
    from dynsim.engine.simulation import Simulation

    # Without an end, as a session: a step that ends at a tick and one at the end of a run need not be the same.
    simulation = Simulation(scenario, duration=math.inf)
    simulation.end_samples(scenario.duration_s)
    prepared, operator, k = simulation._prepared, simulation.operator, 0
    # It has times of its own; a record that is too large is refused before it begins.
    sample_times(scenario, prepared.run.layout, prepared.run.columns, len(prepared.model.robot.links))
    rate = operator.rate if operator is not None else 1.0 / (prepared.control.sample_time or 1.0)
    stop: SimulationStopped | None = None
    try:
        while simulation.time < scenario.duration_s:
            k += TICKS
            # A signal within a callback would leave references half written.
            interruption.keep()
            simulation.advance(min(k / rate, scenario.duration_s))
            if progress is not None:
                progress(simulation.time, SIMULATION)
            interruption.heed()
            interruption.check()
    except SimulationStopped as ended:
        stop = ended
    except KeyboardInterrupt:
        interruption.answered()
        stop = interrupted(scenario, simulation.time, {})
    interruption.keep()
    record = simulation.record(scenario, pictured=pictured)
    if stop is not None:
        raise_stopped(stop, record)
    record.complete = True
    return record
