"""A whole run, 10 s of the published arm: its time in several programs, and how exact it is."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.dynamics.simd.system import has_forms
from dynsim.dynamics.state import block
from dynsim.engine.dynamics import Prepared, prepare
from dynsim.integrators import run as ki
from dynsim.integrators.driver import advance
from dynsim.scenario import build, load_scenario
from dynsim.studies.bench import mujoco_peer
from dynsim.studies.bench.programs import (
    DYNSIM_DOPRI5,
    DYNSIM_RADAU5,
    MUJOCO_EULER,
    MUJOCO_IMPLICIT,
    SCENARIO,
    STEP,
)
from dynsim.studies.bench.timing import Timed

Array = NDArray[np.float64]

SPHERE_RADIUS = 100.0  # of the surfaces that stand for the floor where MuJoCo holds points by tendons [m]


@dataclass(frozen=True)
class Case:
    """One whole run that several programs do.

    Attributes
    ----------
    variant : str
        Of elbow_comparison.
    mujoco_contacts : str
        ``contacts`` of :func:`dynsim.studies.bench.mujoco_peer.build_mujoco`.
    same_physics : bool
        Whether the programs solve the same equations; where not, MuJoCo's rows are marked and no ratio is given.
    note : str
    """

    variant: str
    mujoco_contacts: str
    same_physics: bool
    note: str


CASES = {
    "free arm": Case("no_elbow", "none", True, "same equations in both"),
    "two elbows held, no friction": Case(
        "two_elbows", "equality", True, f"both hold the elbows to spheres of {SPHERE_RADIUS:g} m radius; MuJoCo softly"
    ),
    "two elbows, friction": Case(
        "two_elbows", "soft", False, "dynsim: the paper's bilateral law; MuJoCo: its soft unilateral contact"
    ),
}
_METHODS = {DYNSIM_DOPRI5: "dopri5", DYNSIM_RADAU5: "radau5"}
_RTOL, _ATOL = 1e-6, 1e-8
_TIGHT = {"integrator.method": "dopri5", "integrator.rtol": 1e-11, "integrator.atol": 1e-13}


def measure_job(case_name: str, rounds: int, *, with_mujoco: bool) -> list[dict[str, Any]]:
    """Wall time and error of the 10 s run for every program; the reference is dynsim at rtol 1e-11."""
    case = CASES[case_name]
    reference = prepare_case(case, _TIGHT)
    _advance(reference)
    run = reference.run
    q, i = run.states("q"), run.states("current")
    hand = _hand_path(reference, q)

    paths: dict[str, tuple[Array, Array]] = {}
    timed: list[Timed] = []
    for name in _METHODS:
        timed.append(Timed(name, _dynsim_job(name, reference, paths)))
    if with_mujoco:
        for name, integrator in ((MUJOCO_EULER, "euler"), (MUJOCO_IMPLICIT, "implicitfast")):
            timed.append(Timed(name, _mujoco_job(name, case, integrator, reference, paths)))
    walls: dict[str, list[float]] = {job.name: [] for job in timed}
    cores: dict[str, list[float]] = {job.name: [] for job in timed}
    for job in timed:
        job.call(1)
    for _ in range(rounds):
        for job in timed:
            started, started_cpu = time.perf_counter(), time.thread_time()
            job.call(1)
            walls[job.name].append(time.perf_counter() - started)
            cores[job.name].append(time.thread_time() - started_cpu)
    rows = []
    for job in timed:
        positions, currents = paths[job.name]
        distance = np.linalg.norm(_hand_path(reference, positions) - hand, axis=1)
        rows.append(
            {
                "case": case_name,
                "note": case.note,
                "program": job.name,
                "wall_median_s": float(np.median(walls[job.name])),
                "wall_minimum_s": float(np.min(walls[job.name])),
                "cpu_median_s": float(np.median(cores[job.name])),
                "cpu_minimum_s": float(np.min(cores[job.name])),
                "same_physics": case.same_physics or job.name.startswith("dynsim"),
                "hand_error_max_m": float(distance.max()),
                "hand_error_rms_m": float(np.sqrt((distance**2).mean())),
                "current_error_max_A": float(np.abs(currents - i).max()),
            }
        )
    return rows


def prepare_case(case: Case, options: dict[str, Any]) -> Prepared:
    """The case compiled for dynsim at its initial state; ``options`` are overrides of the scenario."""
    overrides = dict(options)
    if case.mujoco_contacts == "equality":
        model = load_scenario(SCENARIO, case.variant)
        overrides["contacts.friction"] = 0.0
        built = prepare(model)
        for contact in build.contacts(model):
            x, y, z = built.model.point_position(contact.body, contact.point, built.model.robot.initial)
            overrides[f"surfaces.under_{contact.name}"] = {
                "type": "sphere",
                "center_m": [float(x), float(y), float(z) - SPHERE_RADIUS],
                "radius_m": SPHERE_RADIUS,
            }
            overrides[f"contacts.points.{contact.name}.surface"] = f"under_{contact.name}"
    return prepare(load_scenario(SCENARIO, case.variant, overrides))


def _advance(prepared: Prepared) -> None:
    advance(prepared.system, prepared.workspace, prepared.run, np.iinfo(np.int64).max)
    if prepared.run.count[ki.STATUS] != ki.FINISHED:
        raise RuntimeError(f"the benchmark run stopped at t = {prepared.run.clock[ki.TIME]:.3f} s")


def _dynsim_job(name: str, reference: Prepared, paths: dict[str, tuple[Array, Array]]) -> Callable[[int], int]:
    n, na, c = reference.model.n, len(reference.system.drives.table), len(reference.contacts)
    y = np.zeros_like(reference.run.y)
    y[block(reference.run.layout, "q")] = reference.model.robot.initial
    run = ki.new_run(
        ki.METHODS[_METHODS[name]],
        y,
        reference.run.layout,
        reference.run.columns,
        n=n,
        na=na,
        c=c,
        sample_time=reference.run.sample_time,
        hand=(reference.run.hand_link, reference.run.hand_point),
        end=float(reference.run.clock[ki.END]),
        step=0.0,
        step_max=np.inf,
        rtol=_RTOL,
        atol=_ATOL,
        lanes=has_forms(reference.system),
    )
    prepared = replace(reference, run=run)
    fresh = [(table, table.copy()) for table in (run.y, run.clock, run.count, run.extremes)]
    if run.newton is not None:
        fresh += [(table, table.copy()) for table in (run.newton.clock, run.newton.count)]

    def call(count: int) -> int:
        for table, values in fresh:
            table[:] = values
        _advance(prepared)
        paths[name] = prepared.run.states("q"), prepared.run.states("current")
        return 1

    return call


def _mujoco_job(
    name: str, case: Case, integrator: str, reference: Prepared, paths: dict[str, tuple[Array, Array]]
) -> Callable[[int], int]:
    import mujoco

    times = reference.run.sample_time
    model = mujoco_peer.build_mujoco(
        reference.system,
        step=STEP,
        integrator=integrator,  # type: ignore[arg-type]
        contacts=case.mujoco_contacts,  # type: ignore[arg-type]
    )
    data = mujoco.MjData(model)
    start = mujoco_peer.state_of(model, reference.model.robot.initial)
    controls = mujoco_peer.setpoints(reference.system, np.arange(round(times[-1] / STEP)) * STEP)
    rows = np.round(times[1:] / STEP).astype(int) - 1

    def call(count: int) -> int:
        q, _, i = mujoco_peer.roll_out(model, data, start, controls)
        first = start[1 : 1 + model.nq], np.zeros(i.shape[1])
        paths[name] = np.vstack([first[0], q[rows]]), np.vstack([first[1], i[rows]])
        return 1

    return call


def _hand_path(prepared: Prepared, q: Array) -> Array:
    """Hand positions for joint positions q, (T, n) → (T, 3) [m]."""
    model = prepared.model
    return np.array([model.point_position(*model.robot.hand, row) for row in q])
