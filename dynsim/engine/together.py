"""Runs of fixed steps that share lanes: four or eight scenarios of equal structure are integrated at once.

What may differ from lane to lane is what tables of numbers say, see dynsim.dynamics.simd.tables.AXES: masses,
dimensions, gains, motor constants, limits, friction, surfaces, gravity, references. Adaptive methods choose their own
steps, so they never share.
"""

from __future__ import annotations

import logging
import time as clock
from collections.abc import Sequence
from typing import Any

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.simd.system import COMPILED, has_forms, lanes_of_runs
from dynsim.dynamics.simd.tables import AXES, stack_tables
from dynsim.engine import named, note_warnings, simulate
from dynsim.engine.compilation import kernels_logged
from dynsim.engine.prepare import Prepared, prepare
from dynsim.engine.recording import make_record
from dynsim.errors import DynsimError, SimulationInterrupted
from dynsim.integrators import run as ki
from dynsim.integrators.fixed_step import LaneRuns, advance_lanes, lane_runs
from dynsim.record import Record
from dynsim.scenario import Scenario
from dynsim.system import interruption
from dynsim.system.reuse import Reuse

log = logging.getLogger(__name__)

WIDTH = lanes_of_runs()
LANES = len(WIDTH)
# Wall time between two looks for Ctrl-C [s].
CHUNK_S = 0.1


def can_share(scenario: Scenario) -> bool:
    """Whether the scenario may share lanes with others of its structure, as far as it says so itself."""
    options = scenario.integrator
    return (
        scenario.engine == "dynamics"
        and options.method == "rk4"
        and options.solver == "articulated"
        and scenario.config.contacts.law == "bilateral"
        and options.wall_limit_s is None
        and COMPILED
    )


def simulate_together(
    scenarios: Sequence[Scenario], *, pictured: bool = True, reuse: Reuse | None = None
) -> list[Record | DynsimError]:
    """Simulate scenarios, those that can on shared lanes: what :func:`dynsim.simulate` gives of each, or raises.

    A record does not depend on the runs beside it; from that of ``simulate`` it differs by rounding, 1e-15 of the
    largest entry in each right-hand side, times what the system makes of it. A run that cannot be completed on its
    lane is simulated again, alone, and ends as it ends there; so is whatever cannot share. ``pictured``: see there.

    Parameters
    ----------
    scenarios : of any plants and methods
    pictured, reuse : see :func:`dynsim.engine.simulate`

    Returns
    -------
    list of Record or DynsimError
        In the order of ``scenarios``.

    Raises
    ------
    SimulationInterrupted
        Ctrl-C.
    """
    results: dict[int, Record | DynsimError] = {}
    groups: dict[bytes, list[tuple[int, Prepared]]] = {}
    for k, scenario in enumerate(scenarios):
        if not can_share(scenario):
            results[k] = alone(scenario, pictured, reuse)
            continue
        try:
            with named(scenario):
                prepared = prepare(scenario, reuse=reuse)
        except SimulationInterrupted:
            raise
        except DynsimError as error:
            results[k] = error
            continue
        if shareable(prepared):
            groups.setdefault(structure(prepared), []).append((k, prepared))
        else:
            results[k] = alone(scenario, pictured, reuse)
    for group in groups.values():
        for start in range(0, len(group), LANES):
            members = group[start : start + LANES]
            started = clock.perf_counter()
            ended = integrate([prepared for _, prepared in members])
            wall = (clock.perf_counter() - started) / len(members)
            for (k, prepared), done in zip(members, ended, strict=True):
                scenario = scenarios[k]
                results[k] = finish(scenario, prepared, wall, pictured) if done else alone(scenario, pictured, reuse)
    return [results[k] for k in range(len(scenarios))]


def alone(scenario: Scenario, pictured: bool = True, reuse: Reuse | None = None) -> Record | DynsimError:
    """As :func:`dynsim.simulate`, its errors as results."""
    try:
        return simulate(scenario, pictured=pictured, reuse=reuse)
    except SimulationInterrupted:
        raise
    except DynsimError as error:
        return error


def finish(scenario: Scenario, prepared: Prepared, wall: float, pictured: bool) -> Record | DynsimError:
    """The record of a run that is complete."""
    try:
        with named(scenario):
            record = make_record(scenario, prepared, wall, pictured=pictured)
    except SimulationInterrupted:
        raise
    except DynsimError as error:
        return error
    note_warnings(scenario, record)
    return record


def shareable(prepared: Prepared) -> bool:
    """True where nothing but steps happens: no events, ticks, breaks, operator or ground that carries a base.

    Steps too short to come anywhere end a run that is alone.
    """
    run = prepared.run
    return (
        has_forms(prepared.system)
        and prepared.system.unilateral is None
        and run.support is None
        and not (len(run.event) or len(run.tick) or len(run.breaks))
        and run.newton is None
        and ki.MOST_TRIALS * run.clock[ki.STEP] > run.clock[ki.LEAST_PROGRESS]
        and prepared.control.operated is None
    )


def structure(prepared: Prepared) -> bytes:
    """What must be equal for runs to share lanes: shapes of all tables, and what those without lanes say."""
    run = prepared.run
    times = run.clock[[ki.STEP, ki.END]], run.sample_time, run.columns, run.hand_link, len(run.y)
    return repr(_plain((prepared.system, prepared.workspace, times))).encode()


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if isinstance(value, tuple):
        names = getattr(value, "_fields", range(len(value)))
        axes = AXES.get(type(value), {})
        # Of tables with lanes the shape alone.
        return [
            np.shape(part) if name in axes and part is not None else _plain(part)
            for name, part in zip(names, value, strict=True)
        ]
    return value


def integrate(group: Sequence[Prepared]) -> list[bool]:
    """Bring runs of equal structure, LANES or fewer, to their end; False for those that must be run alone."""
    # What is left over does again what the last one does.
    filled = [*group, *[group[-1]] * (LANES - len(group))]
    system = stack_tables([one.system for one in filled])
    width = len(group[0].workspace.joints)
    # Sines are computed a lane at a time, without padding.
    ws: ka.Workspace = stack_tables([one.workspace._replace(trig=one.workspace.trig[:, :width]) for one in filled])
    ws = ws._replace(active=ws.active.copy(), counts=ws.counts.copy())
    runs = lane_runs([one.run for one in filled])
    with kernels_logged(log):
        advance_lanes(WIDTH, system, ws, runs, 0)
    limit = 1
    try:
        while runs.count[ki.STATUS] == ki.RUNNING:
            before = clock.perf_counter()
            advance_lanes(WIDTH, system, ws, runs, limit)
            taken = clock.perf_counter() - before
            limit = int(min(max(limit * min(CHUNK_S / max(taken, 1e-9), 10.0), 1), 1_000_000))
            interruption.check()
    except KeyboardInterrupt:
        interruption.answered()
        raise SimulationInterrupted(f"interrupted at t = {runs.clock[ki.TIME]:.3f} s of {len(group)} runs") from None
    # Dependent rows are counted for all lanes together, so whose they are is not known.
    doubtful = ws.counts[ka.DEPENDENT] > 0 or ws.counts[ka.CONTRADICTORY] > 0
    for k, prepared in enumerate(group):
        take_lane(prepared.run, runs, k)
    return [not (doubtful or runs.failed[k]) for k in range(len(group))]


def take_lane(run: ki.Run, runs: LaneRuns, k: int) -> None:
    """What a lane has come to, as if the run had come there by itself."""
    for name in AXES[LaneRuns]:
        getattr(run, name)[...] = getattr(runs, name)[..., k]
    run.clock[:], run.count[:] = runs.clock, runs.count
    # As many as the run takes alone: one for each stage, sample and projection, and for what is off its surfaces.
    steps, samples = int(runs.count[ki.STEPS]), int(runs.count[ki.SAMPLE])
    run.count[ki.PROJECTIONS] = runs.projections[k]
    run.count[ki.EVALUATIONS] = 1 + 4 * steps + samples + runs.projections[k] + runs.settled[k]
