"""Work–precision benchmark: time and error of each adaptive method on the shipped scenarios."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynsim.engine.recording import make_record
from dynsim.engine.simulation import prepare
from dynsim.integrators import run as ki
from dynsim.record.measures import energy_turnover
from dynsim.scenario import load_scenario, shipped_scenarios
from studies.bench.job import integrate

METHODS = ("dopri5", "radau5")
RTOLS = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
REFERENCE = "dopri5", 1e-12
ATOL_PER_RTOL = 1e-2
ANGLE_MIN = 1e-3
"""Errors of a joint are relative to its largest position, or to this value if that is smaller [rad, m]."""


class _Run(NamedTuple):
    cpu: float  # [s]
    q: NDArray[np.float64]  # (T, nq)
    evaluations: int
    ledger: float  # relative to the turnover
    finished: bool


def scenarios() -> Iterator[str]:
    """Yield the shipped scenarios of arms that are integrated in time; each with its first variant."""
    for file in shipped_scenarios():
        scenario = load_scenario(file)
        if scenario.engine == "dynamics" and scenario.plant.type != "snake":
            yield file.stem


def measure(name: str, rounds: int) -> list[dict[str, Any]]:
    """Measure time, error and ledger of one shipped scenario by method and tolerance.

    Returns
    -------
    list of dict
        ``scenario``, ``method``, ``rtol``, ``cpu_minimum_s`` (integration only, minimum of the rounds), ``error`` (the
        largest of any joint over its largest angle, see ``ANGLE_MIN``, against ``REFERENCE``), ``ledger`` (largest
        residual over the turnover), ``evaluations``, ``finished``.
    """
    reference = _integrate(name, *REFERENCE)
    scale = np.maximum(np.abs(reference.q).max(axis=0), ANGLE_MIN)
    rows: list[dict[str, Any]] = []
    for rtol in RTOLS:
        # The methods take turns, so that other load on the machine affects all of them.
        runs = [(method, _integrate(name, method, rtol)) for _ in range(rounds) for method in METHODS]
        for method, run in runs[: len(METHODS)]:
            common = min(len(run.q), len(reference.q))
            rows.append(
                {
                    "scenario": name,
                    "method": method,
                    "rtol": rtol,
                    "cpu_minimum_s": min(attempt.cpu for by, attempt in runs if by == method),
                    "error": float((np.abs(run.q[:common] - reference.q[:common]) / scale).max()),
                    "ledger": run.ledger,
                    "evaluations": run.evaluations,
                    "finished": run.finished,
                }
            )
    return rows


def _integrate(name: str, method: str, rtol: float) -> _Run:
    scenario = load_scenario(
        name,
        None,
        {"integrator.method": method, "integrator.rtol": rtol, "integrator.atol": ATOL_PER_RTOL * rtol},
    )
    prepared = prepare(scenario)
    run, cpu = prepared.run, integrate(prepared)
    record = make_record(scenario, prepared, cpu, pictured=False)
    residual = float(np.abs(record["energy_residual"]).max())
    return _Run(
        cpu,
        record["q"],
        int(run.count[ki.EVALUATIONS]),
        residual / max(energy_turnover(record), np.finfo(float).tiny),
        bool(run.count[ki.STATUS] == ki.FINISHED),
    )
