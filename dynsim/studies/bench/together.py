"""States evaluated together, as lanes of one right-hand side: one right-hand side, and a step of RK4 of a whole run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dynsim.dynamics.simd.system import EIGHT, FOUR, lane_workspace
from dynsim.dynamics.simd.tables import aligned, stack_tables
from dynsim.engine.dynamics import Prepared, prepare
from dynsim.engine.together import LANES, integrate
from dynsim.integrators import run as ki
from dynsim.integrators.driver import advance
from dynsim.scenario import load_scenario
from dynsim.studies.bench.programs import EIGHT_LANES, FOUR_LANES, ONE_STATE, SCENARIO, STEP
from dynsim.studies.bench.right_hand_side import repeat_derivative, repeat_lanes
from dynsim.studies.bench.timing import Timed, take_turns

RUNS_TOGETHER = {len(FOUR): FOUR_LANES, len(EIGHT): EIGHT_LANES}[LANES]
RIGHT_HAND_SIDE, RUN = "right-hand side, 2 contacts", f"RK4 {1e3 * STEP:g} ms, recorded at 200 Hz"


def measure(rounds: int, share: float) -> list[dict[str, Any]]:
    """Microseconds of each state, alone and together; on lanes all parameters are each lane's own."""
    arms = [_arm(friction) for friction in np.linspace(0.0, 0.2, len(EIGHT))]
    rates = [
        Timed(ONE_STATE, _alone(arms[0])),
        Timed(FOUR_LANES, _lanes(arms[:4], FOUR)),
        Timed(EIGHT_LANES, _lanes(arms, EIGHT)),
    ]
    runs = [Timed(ONE_STATE, _run_alone(arms[0])), Timed(RUNS_TOGETHER, _run_together(arms[:LANES]))]
    rows = []
    for task, timed in ((RIGHT_HAND_SIDE, rates), (RUN, runs)):
        samples = take_turns(timed, rounds, share)
        rows.append(
            {
                "task": task,
                "median_us": {name: 1e6 * float(np.median(values)) for name, values in samples.items()},
                "minimum_us": {name: 1e6 * float(np.min(values)) for name, values in samples.items()},
            }
        )
    return rows


def _arm(friction: float) -> Prepared:
    fixed = {"integrator.method": "rk4", "integrator.step_s": STEP, "duration_s": 1, "metrics.settle_s": 0.5}
    return prepare(load_scenario(SCENARIO, "two_elbows", {**fixed, "contacts.friction": float(friction)}))


def _alone(arm: Prepared) -> Callable[[int], int]:
    y, dy = arm.run.y.copy(), np.zeros_like(arm.run.y)

    def call(count: int) -> int:
        repeat_derivative(arm.system, y, arm.workspace, dy, count)
        return count

    return call


def _lanes(arms: list[Prepared], width: tuple[float, ...]) -> Callable[[int], int]:
    lanes = len(width)
    y, dy = aligned(len(arms[0].run.y), lanes), aligned(len(arms[0].run.y), lanes)
    y[:] = arms[0].run.y[:, None]
    system, ws = stack_tables([arm.system for arm in arms]), lane_workspace(arms[0].workspace, width)

    def call(count: int) -> int:
        turns = -(-count // lanes)
        repeat_lanes(width, system, y, ws, dy, turns)
        return turns * lanes

    return call


def _restart(arms: list[Prepared]) -> Callable[[], None]:
    """Sets the runs back to their beginning."""
    tables = [table for arm in arms for table in (arm.run.y, arm.run.clock, arm.run.count, arm.run.extremes)]
    fresh = [table.copy() for table in tables]

    def restart() -> None:
        for table, values in zip(tables, fresh, strict=True):
            table[:] = values

    return restart


def _run_alone(arm: Prepared) -> Callable[[int], int]:
    restart = _restart([arm])

    def call(count: int) -> int:
        restart()
        advance(arm.system, arm.workspace, arm.run, np.iinfo(np.int64).max)
        return int(arm.run.count[ki.STEPS])

    return call


def _run_together(arms: list[Prepared]) -> Callable[[int], int]:
    restart = _restart(arms)

    def call(count: int) -> int:
        restart()
        if not all(integrate(arms)):
            raise RuntimeError("the benchmark runs stopped")
        return LANES * int(arms[0].run.count[ki.STEPS])

    return call
