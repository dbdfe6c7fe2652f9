"""Runs whose references an operator rewrites on the way: by the public stepper, as a live drive is."""

from __future__ import annotations

import math

from dynsim.engine import SIMULATION, Progress
from dynsim.engine.outcome import mark_stopped, raise_stopped
from dynsim.engine.simulation import Simulation
from dynsim.errors import SimulationInterrupted, SimulationStopped
from dynsim.record import Record
from dynsim.scenario import Scenario
from dynsim.system import interruption

# Ticks between two looks at Ctrl-C and the progress bar.
PIECE = 10


def simulate(scenario: Scenario, progress: Progress | None = None, *, pictured: bool = True) -> Record:
    """See :func:`dynsim.engine.simulate`; the record of a live drive and of its script are the same, bit for bit."""
    # Without an end, as a drive: a step that ends at a tick and one at the end of a run need not be the same.
    simulation = Simulation(scenario, duration=math.inf)
    assert simulation.operator is not None
    rate, k = simulation.operator.operated.rate, 0
    interrupted = False
    try:
        while not interrupted and simulation.time < scenario.duration_s:
            k += PIECE
            # A signal within a callback would leave references half written.
            interruption.keep()
            simulation.advance(min(k / rate, scenario.duration_s))
            if progress is not None:
                progress(simulation.time, SIMULATION)
            interruption.heed()
            interruption.check()
    except SimulationStopped as stop:
        interruption.keep()
        raise_stopped(stop, simulation.record(scenario, pictured=pictured))
    except KeyboardInterrupt:
        interrupted = True
        interruption.answered()
    interruption.keep()
    record = simulation.record(scenario, pictured=pictured)
    if interrupted:
        reached = simulation.time
        stopped = SimulationInterrupted(
            f"interrupted at t = {reached:.3f} s of {scenario.duration_s:g} s", time=reached, state={}
        )
        mark_stopped(stopped, record)
        stopped.record = record
        raise stopped
    record.complete = True
    return record
