"""Engine of the multibody plants: integrate the coupled system and collect its record."""

from __future__ import annotations

import logging
import time as clock
from collections.abc import Sequence

import numpy as np

from dynsim import interruption
from dynsim.engine import SIMULATION, Progress, Start
from dynsim.engine.outcome import kernels_logged, raise_stopped
from dynsim.engine.prepare import Prepared, prepare
from dynsim.engine.recording import make_record
from dynsim.engine.uniqueness import paradox
from dynsim.errors import SimulationInterrupted, SimulationStopped
from dynsim.kernels import arrays as ka
from dynsim.kernels.integrate import driver
from dynsim.kernels.integrate import run as ki
from dynsim.kernels.state import block
from dynsim.record import Record
from dynsim.scenario import Scenario

__all__ = ["Prepared", "prepare", "simulate", "start"]

log = logging.getLogger(__name__)

# Wall time between two looks at progress and Ctrl-C [s].
CHUNK_S = 0.1


def start(prepared: Prepared) -> Start:
    """Positions of the hand and of the contact points at t = 0."""
    model, q = prepared.model, prepared.model.robot.initial
    contacts = {contact.name: model.point_position(contact.body, contact.point, q) for contact in prepared.contacts}
    return Start(model.point_position(*model.robot.hand, q), contacts)


def simulate(scenario: Scenario, progress: Progress | None = None) -> Record:
    """See :func:`dynsim.engine.simulate`."""
    prepared = prepare(scenario, progress)
    run = prepared.run
    # Loading or compiling the kernels is no integration time.
    with kernels_logged(log):
        driver.advance(prepared.system, prepared.workspace, run, 0)
    if progress is not None:
        progress(0.0, SIMULATION)
    started, limit, interrupted = clock.perf_counter(), 1, False
    try:
        log.info("%s: integrating %g s by %s", scenario.title, scenario.duration_s, scenario.integrator.method)
        while run.count[ki.STATUS] == ki.RUNNING:
            before = clock.perf_counter()
            driver.advance(prepared.system, prepared.workspace, run, limit)
            taken = clock.perf_counter() - before
            limit = int(min(max(limit * min(CHUNK_S / max(taken, 1e-9), 10.0), 1), 1_000_000))
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
    record = make_record(scenario, prepared, wall)
    status, reached = int(run.count[ki.STATUS]), float(run.clock[ki.TIME])
    if interrupted or status != ki.FINISHED:
        if interrupted:
            stop: SimulationStopped = SimulationInterrupted(
                f"interrupted at t = {reached:.3f} s of {scenario.duration_s:g} s",
                time=reached,
                state=_last_state(prepared, run.y),
            )
        elif found := paradox(prepared.system, prepared.workspace, run, prepared.contacts):
            reached, y, words = found
            if scenario.integrator.method == "rk4":
                words += "; a shorter integrator.step_s or an adaptive method (rk43) tells whether the step is to blame"
            stop = SimulationStopped(
                f"stopped at t = {reached:.6g} s: {words}", time=reached, state=_last_state(prepared, y)
            )
        else:
            stop = SimulationStopped(
                _reason(status, scenario, prepared), time=reached, state=_last_state(prepared, run.y)
            )
        raise_stopped(stop, record)
    return record


def _last_state(prepared: Prepared, y: np.ndarray) -> dict[str, Sequence[float]]:
    return {name: y[block(prepared.system.layout, name)].tolist() for name in ("q", "v", "current")}


def _reason(status: int, scenario: Scenario, prepared: Prepared) -> str:
    run = prepared.run
    t, method = float(run.clock[ki.TIME]), scenario.integrator.method
    where = f"stopped at t = {t:.6g} s"
    if status == ki.NOT_FINITE:
        advice = (
            f"take a smaller integrator.step_s than {run.clock[ki.STEP]:g}, or an adaptive method (rk43, rodas4)"
            if method == "rk4"
            else "look at the last state for a joint that runs away"
        )
        return f"{where}: the state is no longer finite (divergence); {advice}"
    if status == ki.NO_FORCES:
        names = ", ".join(contact.name for contact in prepared.contacts)
        return (
            f"{where}: no signs of the normal forces at {names} agree with dissipative friction (Painlevé's paradox); "
            "lower contacts.friction, or take contacts.pulling_friction: signed"
        )
    if status == ki.STEP_TOO_SMALL:
        return (
            f"{where}: the step size fell to {run.clock[ki.STEP]:.1e} s; try integrator.method rodas4 or a larger rtol"
        )
    gaps = prepared.workspace.contacts[:, ka.GAP]
    worst = int(np.argmax(np.abs(gaps)))
    return (
        f"{where}: contact {prepared.contacts[worst].name} cannot be kept on its surface (gap {gaps[worst]:+.2e} m); "
        "the contacts contradict each other or the arm is singular here"
        + (", or integrator.step_s is too long (try integrator.method: rk43)" if method == "rk4" else "")
    )
