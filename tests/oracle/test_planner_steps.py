"""Steps of the local solver of brace plans: their quadratic programs, solved again by DAQP with all constraints."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from studies.planner_scenes import scene_scenario

import dynsim
from dynsim.jit.kernel import kernel
from dynsim.planner import search as searching
from dynsim.planner.arm import Local, Problem, solve
from dynsim.planner.compiled.geometry import NEARBY
from dynsim.planner.compiled.model import costs, prepare
from dynsim.planner.compiled.solve import step
from dynsim.planner.compiled.statics import statics
from dynsim.planner.problem import Options, task
from dynsim.planner.search import Search
from dynsim.scenario import Scenario
from dynsim.scenario.reading import scenario_from_resolved

daqp = pytest.importorskip("daqp")

pytestmark = pytest.mark.long

# Damping of the tested steps, relative to the cost; the solver's first one, and one that hardly limits the step.
DAMPING = (1e-3, 1e-6)
# Number of steps of the local solver before the tested one: none, few, or nearly all.
TURNS = (0, 1, 3, 10)
# Problems of each plan, and number of local problems after which the next one is tested.
COUNT, EVERY = 50, 5


@kernel
def model(arm, points, course, work, Q, F, min_force, peak, damping):
    """Write the forces of least heat, and matrix and gradient of the model, to the workspace; return its size."""
    statics(arm, points, course, work, Q, F, min_force, True)
    cost, _ = costs(arm, course, work, Q, peak)
    return prepare(arm, points, course, work, Q, damping * max(cost, 0.1) + 1e-6)


@kernel
def stepped(arm, points, course, work, Q, F, min_force, N):
    """Solve the quadratic program of a step; return twice the decrease of the model."""
    return step(arm, points, course, work, Q, F, min_force, N)


def constraints(problem: Problem, Q: np.ndarray, F: np.ndarray, N: int) -> tuple[np.ndarray, np.ndarray]:
    """All constraints A x ≥ b of a step: forces, clearances of nearby points, and joint limits."""
    course, points, work, tables = problem.course, problem.points, problem.work, problem.arm
    rows, bounds = list[np.ndarray](), list[float]()
    n, braces = len(tables.parent), len(points.friction)

    def add(k: int, gradient: np.ndarray, bound: float) -> None:
        row, free = np.zeros(N), work.free[k]
        row[work.start[k] : work.start[k] + free] = gradient @ work.basis[k][:, n - free :]
        rows.append(row)
        bounds.append(bound)

    for e, i in zip(*np.nonzero(course.acting), strict=True):
        rows.append(np.eye(N)[work.pressed[e] + i])
        bounds.append(problem.min_force - F[e, i])
    for k in range(len(Q)):
        for i in range(len(points.body)):
            least = points.margin[i] if i >= braces else -np.inf if course.guided[k, i] else course.apart[k, i]
            if (bound := min(least - work.gap[k, i], 0.0)) >= -NEARBY:
                add(k, work.gap_rate[k, i], bound)
        for j, unit in enumerate(np.eye(n)):
            for sign, room in ((1.0, tables.lower[j] - Q[k, j]), (-1.0, Q[k, j] - tables.upper[j])):
                if np.isfinite(room):
                    add(k, sign * unit, min(room, 0.0))
    return np.reshape(rows, (-1, N)), np.array(bounds)


def compared(problem: Problem, Q: np.ndarray, damping: float) -> bool:
    """Compare a step with DAQP's solution; return False if the step has no room for all of its constraints.

    The step ignores violations of at most 1e-9, and DAQP's tolerance is the same; times multipliers of about 10 W, this
    is the error of the model's value. Only the sign of larger differences is tested: in a few problems with lifted
    braces, whose forces have a weight of 1e-9, DAQP stops up to 5 % above the step, which is feasible.
    """
    F = np.zeros((len(problem.course.knot), len(problem.points.friction)))
    tables = problem.arm, problem.points, problem.course, problem.work
    N = model(*tables, Q, F, problem.min_force, problem.peak, damping)
    lower, g = np.tril(problem.work.H[:N, :N]), problem.work.g[:N].copy()
    H = lower + np.tril(lower, -1).T
    A, b = constraints(problem, Q, F, N)
    problem.work.bound[:] = np.nan
    stepped(*tables, Q, F, problem.min_force, N)
    if np.isfinite(problem.work.bound).all():
        return False
    x = problem.work.step[:N].copy()
    _, value, flag, _ = daqp.solve(H, g, A, np.full(len(b), 1e30), b, primal_tol=1e-9)
    assert flag == 1
    assert (b - A @ x).max(initial=0.0) < 2e-9
    assert 0.5 * x @ H @ x + g @ x <= value + 1e-8 * (1.0 + abs(value))
    return True


class Enough(Exception):
    """All problems of a search were collected."""


def collected(scenario: Scenario, options: Options, monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Compare steps of local problems of a search; with ``phases``, only of problems with braces that change."""
    results = list[bool]()
    calls = iter(range(10**9))

    def watched(problem: Problem, start: np.ndarray, turns: int = 40, **more: Any) -> Local | None:
        changing = len(start) > 1 and not problem.course.guided.all()
        if len(start) > 1 and changing == (options.phases[1] > 1) and (k := next(calls)) % EVERY == 0:
            before = solve(problem, start, TURNS[k // EVERY % len(TURNS)])
            if before is not None:
                results.append(compared(problem, before.Q.copy(), DAMPING[k // EVERY % len(DAMPING)]))
            if len(results) == COUNT:
                raise Enough
        return solve(problem, start, turns, **more)

    monkeypatch.setattr(searching, "solve", watched)
    with suppress(Enough):
        Search(task(scenario, options)).run()
    return results


def with_object() -> Scenario:
    data = scene_scenario(2).resolved
    data["objects"] = {"crate": {"mass_kg": 1.0, "size_m": [0.3, 0.3, 0.3], "position_m": [0.6, 0.1, 0.9]}}
    return scenario_from_resolved(data)


@pytest.mark.parametrize(
    ("scenario", "options"),
    [
        (lambda: scene_scenario(4), {}),
        (lambda: scene_scenario(1), {}),
        (lambda: scene_scenario(2), {}),
        (lambda: scene_scenario(7), {"peak": 0.05}),
        (with_object, {}),
        (lambda: dynsim.load_scenario("pressing"), {}),
        (lambda: dynsim.load_scenario("tall_path"), {"phases": (1, 2)}),
    ],
    ids=["floor", "pipe", "box", "peak", "object", "closed", "phases"],
)
def test_steps_minimise_their_quadratic_programs(scenario, options, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    results = collected(scenario(), Options(count=(0, 3), starts=1, budget_s=0.0, **options), monkeypatch)
    assert len(results) > 25
    # Early steps far from the surfaces may violate more constraints than there is room for.
    assert sum(results) > 0.8 * len(results)
