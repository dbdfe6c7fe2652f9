"""Benchmark of a whole run (10 s of the published arm): time and accuracy in several programs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynsim.engine.simulation import Prepared, prepare
from dynsim.engine.stepped import take_log
from dynsim.integrators import run as ki
from dynsim.integrators.driver import advance
from dynsim.scenario import build, load_scenario, variant_names
from studies.bench import mujoco_peer
from studies.bench.programs import DYNSIM_RADAU5, MUJOCO_EULER, MUJOCO_IMPLICIT, SCENARIO, STEP

Array = NDArray[np.float64]

SPHERE_RADIUS = 100.0  # radius of the spheres that replace the floor if MuJoCo holds points by tendons [m]


@dataclass(frozen=True)
class Case:
    """One whole run that several programs simulate.

    Attributes
    ----------
    variant : str
        Variant of elbow_comparison.
    mujoco_contacts : str
        ``contacts`` of :func:`studies.bench.mujoco_peer.build_mujoco`.
    same_physics : bool
        Whether the programs solve the same equations; if not, the rows of MuJoCo are marked.
    """

    variant: str
    mujoco_contacts: Literal["none", "soft", "equality"]
    same_physics: bool = True


CASES = {
    "free arm": Case("no_elbow", "none"),
    # Both hold the elbows on spheres; MuJoCo with soft constraints.
    "two elbows held, no friction": Case("two_elbows", "equality"),
    # dynsim: the paper's bilateral law; MuJoCo: its soft unilateral contact.
    "two elbows, friction": Case("two_elbows", "soft", same_physics=False),
}
RADAU5 = {"integrator.method": "radau5", "integrator.rtol": 1e-6, "integrator.atol": 1e-8}
_TIGHT = {"integrator.method": "dopri5", "integrator.rtol": 1e-11, "integrator.atol": 1e-13}


class Outcome(NamedTuple):
    """CPU time [s], joint positions (T, n) and motor currents (T, na)."""

    cpu: float
    q: Array
    current: Array


def measure(case_name: str, rounds: int, *, with_mujoco: bool) -> list[dict[str, Any]]:
    """Measure CPU time and error of the 10 s run for every program; the reference is dynsim at rtol 1e-11."""
    case = CASES[case_name]
    reference = prepare_case(case, _TIGHT)
    exact = _run_dynsim(reference)
    hand = _hand_path(reference, exact.q)
    programs: dict[str, Callable[[], Outcome]] = {DYNSIM_RADAU5: lambda: _run_dynsim(prepare_case(case, RADAU5))}
    if with_mujoco:
        programs[MUJOCO_EULER] = partial(_run_mujoco, case, "euler", reference)
        programs[MUJOCO_IMPLICIT] = partial(_run_mujoco, case, "implicitfast", reference)
    # They take turns, so that other load on the machine affects all of them; the first runs warm the caches.
    outcomes = {name: run() for name, run in programs.items()}
    cpu: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(rounds):
        for name, run in programs.items():
            cpu[name].append(run().cpu)
    rows = []
    for name, outcome in outcomes.items():
        distance = np.linalg.norm(_hand_path(reference, outcome.q) - hand, axis=1)
        rows.append(
            {
                "case": case_name,
                "program": name,
                "cpu_median_s": median(cpu[name]),
                "same_physics": case.same_physics or name == DYNSIM_RADAU5,
                "hand_error_max_m": float(distance.max()),
                "hand_error_rms_m": float(np.sqrt((distance**2).mean())),
                "current_error_max_A": float(np.abs(outcome.current - exact.current).max()),
            }
        )
    return rows


def measure_variants(rounds: int) -> list[dict[str, Any]]:
    """Return the minimum CPU time of each shipped variant, for dynsim only."""
    return [
        {
            "variant": variant,
            "cpu_minimum_s": min(integrate(prepare(load_scenario(SCENARIO, variant, RADAU5))) for _ in range(rounds)),
        }
        for variant in variant_names(SCENARIO)
    ]


def prepare_case(case: Case, options: dict[str, Any]) -> Prepared:
    """Return the case compiled for dynsim at its initial state; ``options`` are overrides of the scenario."""
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


def integrate(prepared: Prepared) -> float:
    """Integrate from start to end; return the CPU seconds of the integration only."""
    run = prepared.run
    # Loading the kernels does not count as integration time.
    advance(prepared.system, prepared.workspace, run, 0)
    started = time.thread_time()
    while run.count[ki.STATUS] == ki.RUNNING:
        advance(prepared.system, prepared.workspace, run, np.iinfo(np.int64).max)
        take_log(run)
    return time.thread_time() - started


def _run_dynsim(prepared: Prepared) -> Outcome:
    cpu, run = integrate(prepared), prepared.run
    if run.count[ki.STATUS] != ki.FINISHED:
        raise RuntimeError(f"the benchmark run stopped at t = {run.clock[ki.TIME]:.3f} s")
    return Outcome(cpu, run.states("q"), run.states("current"))


def _run_mujoco(case: Case, integrator: Literal["euler", "implicitfast"], reference: Prepared) -> Outcome:
    import mujoco

    times = reference.run.sample_time
    model = mujoco_peer.build_mujoco(reference.system, step=STEP, integrator=integrator, contacts=case.mujoco_contacts)
    data = mujoco.MjData(model)
    start = mujoco_peer.state_of(model, reference.model.robot.initial)
    controls = mujoco_peer.setpoints(reference.system, np.arange(round(times[-1] / STEP)) * STEP)
    started = time.thread_time()
    q, _, i = mujoco_peer.roll_out(model, data, start, controls)
    cpu = time.thread_time() - started
    sampled = np.round(times[1:] / STEP).astype(int) - 1
    first = start[1 : 1 + model.nq], np.zeros(i.shape[1])
    return Outcome(cpu, np.vstack([first[0], q[sampled]]), np.vstack([first[1], i[sampled]]))


def _hand_path(prepared: Prepared, q: Array) -> Array:
    """Return hand positions for joint positions q, (T, n) → (T, 3) [m]."""
    model = prepared.model
    return np.array([model.point_position(*model.robot.hand, row) for row in q])
