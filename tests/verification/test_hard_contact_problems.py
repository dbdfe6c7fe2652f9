"""Contact problems that were given up once, and the scratch memory of the solver: tests/data/contact_problems."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from support.cone_checks import violation

from dynsim.dynamics.contact.cone.steps import CONE, CONE_ROOM, approach_or_proximal_point, proximal_point, solve_cones
from dynsim.integrators.stepping import contacts
from dynsim.integrators.stepping import tables as kt
from dynsim.jit.kernel import kernel

FILE = Path(__file__).parents[1] / "data" / "contact_problems" / "hard.npz"


class Problem(NamedTuple):
    """W f + b = u with the last impulses as a start."""

    why: str
    W: np.ndarray
    b: np.ndarray
    kind: np.ndarray
    mu: np.ndarray
    start: np.ndarray


@cache
def problems() -> tuple[Problem, ...]:
    return tuple(read())


def read() -> Iterator[Problem]:
    data, row, square = np.load(FILE), 0, 0
    for p, why in zip(data["p"], data["why"], strict=True):
        rows = slice(row, row + p)
        W = data["W"][square : square + p * p].reshape(p, p)
        kind = data["kind"][rows].astype(np.int64)
        yield Problem(str(why), W, data["b"][rows], kind, data["mu"][rows], data["start"][rows])
        row, square = row + p, square + p * p


@kernel
def as_a_step_does(W, b, kind, mu, p, f, room):
    """The residual after all searches of a step of time stepping."""
    residual = approach_or_proximal_point(W, b, kind, mu, p, f, room, kt.GOOD, kt.LAST_ROUNDS)
    if kt.FAIR < residual <= kt.BAD:
        residual = proximal_point(W, b, kind, mu, p, f, room, kt.GOOD)
    return residual


@kernel
def as_events_do(W, b, kind, mu, p, f, room):
    return solve_cones(W, b, kind, mu, p, f, room, kt.GOOD)


def solved(problem: Problem, solve=as_a_step_does, fill: float = 0.0) -> tuple[float, np.ndarray]:
    p, f = len(problem.b), problem.start.copy()
    room = np.full((CONE_ROOM, p, p), fill)
    return solve(problem.W.copy(), problem.b.copy(), problem.kind, problem.mu.copy(), p, f, room), f


def moving(problem: Problem) -> Problem:
    """The same problem with b projected on the range of W, as a motion of the bodies would be."""
    values, vectors = np.linalg.eigh(problem.W)
    kept = vectors[:, values > 1e-10 * values.max()]
    return problem._replace(b=kept @ (kept.T @ problem.b))


def has_no_solution(problem: Problem) -> bool:
    """Proof for a single cone: it cannot stay off, nor stick, nor slide in any direction."""
    W, b, mu = problem.W, problem.b, problem.mu[0]
    assert list(problem.kind) == [2, 3, 3]
    if b[0] >= 0.0:
        return False
    f, *_ = np.linalg.lstsq(W, -b)
    if np.abs(W @ f + b).max() <= 1e-9 * np.abs(b).max():
        return False
    # Slip along d with u_n = 0: f = f_n (1, −μ d), and u_t is along d for a d between those where it changes sides.
    angle = np.linspace(0.0, 2.0 * np.pi, 200_001)
    d = np.array([np.cos(angle), np.sin(angle)])
    with np.errstate(divide="ignore"):
        normal = -b[0] / (W[0, 0] - mu * (W[0, 1:] @ d))
    slip = b[1:, None] + normal * (W[1:, :1] - mu * (W[1:, 1:] @ d))
    across, along = d[0] * slip[1] - d[1] * slip[0], (d * slip).sum(axis=0)
    may = (normal > 0.0) & (along > 0.0)
    turns = (across[1:] * across[:-1] <= 0.0) & may[1:] & may[:-1]
    return not turns.any()


def unsolved(problem: Problem) -> bool:
    """True for problems without solution, whose only solution is hidden, or with b off the range of W."""
    return problem.why.startswith(("jam", "two contacts", "off range"))


def test_hard_problems_are_solved():
    ordinary = [problem for problem in problems() if not unsolved(problem)]
    assert len(ordinary) == 109
    for problem in ordinary:
        residual, f = solved(problem)
        assert residual <= 1e-10, problem.why
        assert violation(problem.W, problem.b, problem.kind, problem.mu, f) <= 1e-10, problem.why


def test_events_solve_hard_problems():
    """The same search, with a proof before its last resort, but without the second proximal-point search of steps."""
    for problem in problems():
        residual, _ = solved(problem, as_events_do)
        if not unsolved(problem):
            assert 0.0 <= residual <= (1e-9 if problem.why.startswith("bodies") else 1e-10), problem.why


def test_jams_have_no_solution_but_without_the_additions_to_their_rates():
    jams = [problem for problem in problems() if problem.why.startswith("jam")]
    assert len(jams) == 5
    for problem in jams:
        assert has_no_solution(problem)
        assert solved(problem)[0] > kt.BAD
    for problem in problems():
        if unsolved(problem):
            assert not problem.why.startswith("jam") or not has_no_solution(moving(problem))
            assert solved(moving(problem))[0] <= 1e-10


def test_steps_accept_problems_of_bodies_with_b_near_the_range_of_mobilities():
    near = [problem for problem in problems() if problem.why.startswith("off range")]
    assert len(near) == 2
    for problem in near:
        off = np.abs(moving(problem).b - problem.b).max()
        assert 1e-8 < off < 1e-6
        assert kt.FAIR < solved(problem)[0] <= kt.BAD


@pytest.mark.parametrize("fill", [3.0, np.nan])
@pytest.mark.parametrize("solve", [as_a_step_does, as_events_do])
def test_scratch_of_other_problems_changes_no_bit(solve, fill):
    for problem in problems():
        if solve is as_events_do and unsolved(problem):
            continue  # 200 starts each
        clean, dirty = solved(problem, solve), solved(problem, solve, fill)
        assert clean[0] == dirty[0]
        np.testing.assert_array_equal(clean[1], dirty[1])


def test_impulses_that_solve_nothing_take_energy_and_stay_in_their_cones():
    for problem in problems():
        for impulses in (solved(problem)[1], problem.start, 1e6 * problem.start):
            f, w = impulses.copy(), problem.W @ impulses + problem.b
            s = SimpleNamespace(f=f, right=problem.b, w=w)
            contacts.limit_energy(s, problem.W, len(f))
            taken = f @ problem.b + 0.5 * f @ problem.W @ f
            assert taken <= 1e-12 * np.abs(f * problem.b).sum()
            # One factor for all, from 0 to 1.
            factor = np.linalg.norm(f) / max(np.linalg.norm(impulses), 1e-300)
            assert factor <= 1.0 + 1e-12
            np.testing.assert_allclose(f, factor * impulses, rtol=1e-9, atol=1e-300)
            assert np.abs(np.diag(problem.W) * f).max() <= 1.001e3 * np.abs(problem.b).max()


def test_proof_of_no_solution_finds_the_ordinary_ones():
    """The proof itself: a block on a slope sticks or slides, in all its directions."""
    for slope in np.linspace(0.0, 1.2, 7):
        for turn in np.linspace(0.0, 6.0, 7):
            b = np.array([-np.cos(slope), np.sin(slope) * np.cos(turn), np.sin(slope) * np.sin(turn)])
            kind, mu = np.array([CONE, 3, 3]), np.array([0.5, 0.0, 0.0])
            assert not has_no_solution(Problem("block", np.diag([1.0, 1.3, 0.7]), b, kind, mu, np.zeros(3)))
