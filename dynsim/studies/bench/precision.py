"""Work and precision: what each adaptive method takes, and how exact it is, on every shipped scenario it integrates."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynsim.engine.dynamics import prepare
from dynsim.engine.recording import make_record
from dynsim.engine.stepped import take_log
from dynsim.integrators import run as ki
from dynsim.integrators.driver import advance
from dynsim.record.measures import energy_turnover
from dynsim.scenario import load_scenario, shipped_scenarios

METHODS = ("dopri5", "radau5")
RTOLS = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
REFERENCE = "dopri5", 1e-12
ATOL_PER_RTOL = 1e-2
ANGLE_MIN = 1e-3
"""Largest angle of a joint that its error is at least put in relation to [rad, m]."""
EQUAL_ERROR = 1e-6
"""At which the times of methods are set side by side."""
ROUNDS = 3


class _Run(NamedTuple):
    cpu: float  # [s]
    q: NDArray[np.float64]  # (T, nq)
    evaluations: int
    ledger: float  # of the turnover
    finished: bool


def scenarios() -> Iterator[str]:
    """Shipped scenarios that are integrated in time; each with its first variant."""
    for file in shipped_scenarios():
        if load_scenario(file).engine == "dynamics":
            yield file.stem


def measure(name: str, rounds: int = ROUNDS, told: Callable[[float], None] | None = None) -> list[dict[str, Any]]:
    """Time, error and ledger of one shipped scenario by method and tolerance.

    Returns
    -------
    list of dict
        ``scenario``, ``method``, ``rtol``, ``cpu_minimum_s`` (integration only, least of the rounds), ``error`` (the
        largest of any joint over its own largest angle, see ``ANGLE_MIN``, against ``REFERENCE``), ``ledger`` (largest
        residual over the turnover), ``evaluations``, ``finished``.
    """
    reference = _integrate(name, *REFERENCE)
    scale = np.maximum(np.abs(reference.q).max(axis=0), ANGLE_MIN)
    rows: list[dict[str, Any]] = []
    for k, rtol in enumerate(RTOLS):
        # The methods take turns, so that a busy moment of the machine meets all of them.
        by_method: dict[str, list[_Run]] = {method: [] for method in METHODS}
        for _ in range(rounds):
            for method, runs in by_method.items():
                runs.append(_integrate(name, method, rtol))
        for method, runs in by_method.items():
            run = runs[0]
            common = min(len(run.q), len(reference.q))
            rows.append(
                {
                    "scenario": name,
                    "method": method,
                    "rtol": rtol,
                    "cpu_minimum_s": min(one.cpu for one in runs),
                    "error": float((np.abs(run.q[:common] - reference.q[:common]) / scale).max()),
                    "ledger": run.ledger,
                    "evaluations": run.evaluations,
                    "finished": run.finished,
                }
            )
        if told is not None:
            told((k + 1) / len(RTOLS))
    return rows


def _integrate(name: str, method: str, rtol: float) -> _Run:
    scenario = load_scenario(
        name,
        None,
        {"integrator.method": method, "integrator.rtol": rtol, "integrator.atol": ATOL_PER_RTOL * rtol},
    )
    prepared = prepare(scenario)
    run = prepared.run
    advance(prepared.system, prepared.workspace, run, 0)
    started = time.thread_time()
    while run.count[ki.STATUS] == ki.RUNNING:
        advance(prepared.system, prepared.workspace, run, np.iinfo(np.int64).max)
        take_log(run)
    cpu = time.thread_time() - started
    record = make_record(scenario, prepared, cpu, pictured=False)
    residual = float(np.abs(record["energy_residual"]).max())
    return _Run(
        cpu,
        record["q"],
        int(run.count[ki.EVALUATIONS]),
        residual / max(energy_turnover(record), np.finfo(float).tiny),
        bool(run.count[ki.STATUS] == ki.FINISHED),
    )


def work_at_equal_error(rows: list[dict[str, Any]], method: str, other: str, error: float) -> float | None:
    """How many times longer ``other`` takes than ``method`` for the same error, between the tolerances measured.

    Both curves of log time over log error are read at ``error``; None where one of them does not reach so far.
    """
    times = [_time_at(rows, one, error) for one in (method, other)]
    return None if None in times else times[1] / times[0]  # type: ignore[operator]


def _time_at(rows: list[dict[str, Any]], method: str, error: float) -> float | None:
    """CPU seconds for an error, by interpolation; what is better than asked for counts where it is the cheapest."""
    points = sorted((row["error"], row["cpu_minimum_s"]) for row in rows if row["method"] == method and row["error"])
    good = [cpu for reached, cpu in points if reached <= error]
    if not good:
        return None
    cheapest = min(good)
    errors, cpus = np.log(points).T
    if points[-1][0] <= error:
        return cheapest
    return float(min(cheapest, np.exp(np.interp(np.log(error), errors, cpus))))
