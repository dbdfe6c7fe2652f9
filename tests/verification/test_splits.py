"""Sharing of redundant contact forces (splits), and second-order-cone programs: tests of optimality.

A split has the least norm among the splits in all friction cones; if no split is in all cones, it has the largest worst
margin μ f_n − |f_t|. Results are checked by conditions of optimality and against other solvers.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog, minimize, minimize_scalar

from dynsim.dynamics.contact.cone.program import best_split, cone_program, solve_cone_program, split_sizes
from dynsim.dynamics.contact.delassus import ONE_WAY
from dynsim.dynamics.linear import null_space
from dynsim.jit.kernel import integers, reals

seeds = st.integers(0, 2**32 - 1)


def split_room(r: int, count: int):
    """Scratch for null spaces of up to r columns and ``count`` contacts."""
    return cone_program(*split_sizes(r, count))


def margins(f: np.ndarray, first: np.ndarray, mu: np.ndarray) -> np.ndarray:
    return np.array([m * f[i] - np.hypot(f[i + 1], f[i + 2]) for i, m in zip(first, mu, strict=True)])


def split(f0, N, first, mu) -> tuple[float, np.ndarray]:
    """Margin and forces by the kernel, whose workspace is larger than needed and filled with NaN."""
    r, c = N.shape[1], len(first)
    room = split_room(r + 1, c + 1)
    for table in room:
        if table.dtype == np.float64:
            table[:] = np.nan
    out = np.full(len(f0), np.nan)
    margin = best_split(reals(f0), reals(N), r, integers(first), reals(mu), c, 0, out, room, True)
    return margin, out


def random_split(rng: np.random.Generator, r: int, c: int, feasible: bool):
    """Contacts behind some other rows; with ``feasible`` one split is inside all cones."""
    other = int(rng.integers(0, 3))
    p = other + 3 * c
    first, mu = other + 3 * np.arange(c), rng.uniform(0.1, 1.5, size=c)
    N = rng.normal(size=(p, r)) * 10.0 ** rng.uniform(-1, 1, size=r)
    f = rng.normal(size=p)
    if feasible:
        for i, m in zip(first, mu, strict=True):
            f[i] = rng.uniform(1.05, 3.0) * np.hypot(f[i + 1], f[i + 2]) / m
    scale = 10.0 ** rng.uniform(-3, 4)
    return scale * (f + N @ rng.normal(size=r)), N, first, mu


@given(seeds)
def test_null_spaces_are_orthonormal_and_whole(seed):
    """The null space of B Bᵀ, B (p, rank), has p − rank columns, which W maps to zero; in arrays that are too large."""
    rng = np.random.default_rng(seed)
    p = int(rng.integers(1, 9))
    rank = int(rng.integers(0, p + 1))
    B = rng.normal(size=(p, rank))
    W, N = np.zeros((9, 9)), np.full((9, 9), np.nan)
    W[:p, :p] = B @ B.T
    width = null_space(W, p, N, p)
    assert width == p - rank
    N = N[:p, :width]
    np.testing.assert_allclose(N.T @ N, np.eye(width), atol=1e-14)
    # Squares of rows that are nearly dependent, among some hundred examples, are lost to rounding.
    np.testing.assert_allclose(B.T @ N, 0.0, atol=1e-6)


@given(seeds)
def test_one_direction_against_a_search_along_the_line(seed):
    rng = np.random.default_rng(seed)
    f0, N, first, mu = random_split(rng, 1, int(rng.integers(1, 4)), bool(rng.integers(2)))
    margin, out = split(f0, N, first, mu)
    largest = np.abs(f0).max()
    # The worst margin is concave along the line: a bounded search finds its maximum.
    reach = 200.0 * largest / np.abs(N).max()

    def worst(z: float) -> float:
        return -min(margins(f0 + N[:, 0] * z, first, mu).min(), 10.0 * largest)

    best = -minimize_scalar(worst, bounds=(-reach, reach), method="bounded", options={"xatol": 1e-13 * reach}).fun
    assert margin >= best - 1e-9 * largest
    assert margins(out, first, mu).min() >= min(margin, 0.0) - 1e-9 * largest
    assert margin <= max(10.0 * largest, 0.0) + 1e-9 * largest
    along = (N[:, 0] @ (out - f0)) / (N[:, 0] @ N[:, 0])
    assert np.allclose(out, f0 + N[:, 0] * along, rtol=0, atol=1e-12 * largest)
    if margin < 0.0:
        assert margins(out, first, mu).min() == pytest.approx(margin, abs=1e-9 * largest)


@given(seeds)
def test_margin_has_a_certificate_and_the_force_is_the_least(seed):
    """Conditions of optimality of the margin by its multipliers, those of the least force by nearby splits."""
    rng = np.random.default_rng(seed)
    r, c = int(rng.integers(1, 7)), int(rng.integers(1, 5))
    f0, N, first, mu = random_split(rng, r, c, bool(rng.integers(2)))
    margin, out = split(f0, N, first, mu)
    largest = np.abs(f0).max()
    results = margins(out, first, mu)
    assert results.min() >= min(margin, 0.0) - 1e-9 * largest
    if margin <= 1e-6 * largest:
        return
    # SLSQP from the point found must not get to a smaller norm, from another feasible one neither.
    z = np.linalg.lstsq(N, out - f0, rcond=None)[0]
    assert np.allclose(f0 + N @ z, out, rtol=0, atol=1e-11 * largest)
    scaled, S = f0 / largest, N / largest
    result = minimize(
        lambda z: 0.5 * np.sum((scaled + S @ z) ** 2),
        z * (1.0 + 1e-3 * rng.normal(size=r)),
        jac=lambda z: S.T @ (scaled + S @ z),
        constraints=[{"type": "ineq", "fun": lambda z: margins(scaled + S @ z, first, mu)}],
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 300},
    )
    reached = scaled + S @ result.x
    if margins(reached, first, mu).min() > -1e-9:
        assert np.sum((out / largest) ** 2) <= np.sum(reached**2) * (1.0 + 1e-6) + 1e-9


def test_no_split_and_one_at_the_apex():
    first, mu = np.array([0]), np.array([0.5])
    for f0, expected in (([2.0, 0.6, 0.8], 0.0), ([2.0, 3.0, 4.0], -4.0), ([-1.0, 0.0, 0.0], -0.5)):
        margin, out = split(np.array(f0), np.zeros((3, 0)), first, mu)
        assert margin == pytest.approx(expected, abs=1e-15)
        assert np.array_equal(out, f0)


def test_planar_arm_with_two_elbows_shares_its_lateral_force():
    """Both lateral rows are one. By hand: 3 N and 8 N with μ = 0.1 hold 1.1 N, the margin is shared equally."""
    f0 = np.array([3.0, 0.0, 0.5, 8.0, 0.0, 0.5])
    N = np.array([[0.0, 0.0, 1.0, 0.0, 0.0, -1.0]]).T
    margin, out = split(f0, N, np.array([0, 3]), np.full(2, 0.1))
    assert margin == pytest.approx(0.05, abs=1e-12)  # (0.3 + 0.8 − 1.0) / 2
    assert out == pytest.approx([3.0, 0.0, 0.3, 8.0, 0.0, 0.7], abs=1e-9)  # the nearest to 0.5, 0.5
    f0[[2, 5]] = 0.7
    margin, out = split(f0, N, np.array([0, 3]), np.full(2, 0.1))
    assert margin == pytest.approx(-0.15, abs=1e-12)
    assert out == pytest.approx([3.0, 0.0, 0.45, 8.0, 0.0, 0.95], abs=1e-9)


def test_contact_without_friction_takes_no_tangential_force():
    N = np.array([[0.0, 0.0, 1.0, 0.0, 0.0, -1.0]]).T
    f0, first, mu = np.array([3.0, 0.0, 0.5, 8.0, 0.0, 0.2]), np.array([0, 3]), np.array([0.0, 0.1])
    margin, out = split(f0, N, first, mu)
    assert margin == pytest.approx(0.1, abs=1e-9)
    assert out == pytest.approx([3.0, 0.0, 0.0, 8.0, 0.0, 0.7], abs=1e-9)
    f0[1] = 0.25  # which nothing can take away
    assert split(f0, N, first, mu)[0] == pytest.approx(-0.25, abs=1e-6)


def test_two_walls_may_be_pressed_apart_without_limit():
    """An inner force raises both margins without limit: the margin is cut off, the force is the least that holds."""
    f0, first, mu = np.array([0.0, 1.0, 0.0, 0.0, 1.0, 0.0]), np.array([0, 3]), np.array([0.5, 0.5])
    margin, out = split(f0, np.array([[1.0, 0, 0, 1.0, 0, 0]]).T, first, mu)
    assert margin == pytest.approx(10.0, rel=1e-9)
    assert out == pytest.approx([2.0, 1.0, 0.0, 2.0, 1.0, 0.0], abs=1e-9)


@given(seeds)
def test_conditions_of_optimality(seed):
    """Programs with cones of size 1 and 3 and equations, some of them twice, checked by their own multipliers."""
    rng = np.random.default_rng(seed)
    n, sizes = int(rng.integers(2, 9)), [int(s) for s in rng.choice([1, 3], size=rng.integers(1, 7))]
    rank, rows = int(rng.integers(0, n)), sum(sizes)
    half = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-2, 0, size=n)
    H, g, G = half @ half.T, rng.normal(size=n), rng.normal(size=(rows, n))
    A, x0 = rng.normal(size=(rank, n)), rng.normal(size=n)
    A = np.vstack([A, A[:1] + A[-1:]]) if rank > 1 else A
    inside = np.concatenate([[2.0, *rng.normal(size=s - 1) * 0.5] for s in sizes])
    inside[np.cumsum([0, *sizes[:-1]])] += np.array(
        [np.linalg.norm(inside[a + 1 : a + s]) for a, s in zip(np.cumsum([0, *sizes[:-1]]), sizes, strict=True)]
    )
    h, b = inside - G @ x0, A @ x0
    program = cone_program(n, len(A), len(sizes), rows)
    for table, value in zip(program, (H, g, A, b, G, h, np.cumsum([0, *sizes]), x0), strict=False):
        table[:] = value
    solve_cone_program(program, n, len(A), len(sizes))
    x, y, z = program.x, program.y, program.z
    s, scale = G @ x + h, 1.0 + np.abs(z).max() + np.abs(x).max()
    assert np.abs(H @ x + g + A.T @ y - G.T @ z).max() < 1e-9 * scale
    assert np.abs(A @ x - b).max(initial=0.0) < 1e-9 * scale
    for u in (s, z):
        for a, size in zip(np.cumsum([0, *sizes[:-1]]), sizes, strict=True):
            assert u[a] >= np.linalg.norm(u[a + 1 : a + size]) - 1e-10 * scale
    assert abs(s @ z) < 1e-9 * scale


@pytest.mark.parametrize("seed", range(40))
def test_a_joint_that_carries_nothing_does_not_end_the_search(seed):
    """A step past the apex of its cone goes through it exactly, and rounding may hide that it leaves the cone."""
    rng = np.random.default_rng(seed)
    idle, slide = rng.choice([0.0, -1.7e-17, 3e-17]), rng.uniform(5.0, 30.0)
    f0 = np.array([0.4, -0.4, 1.4, -0.005, -0.15 * slide, idle])
    N = np.array([[0.98854], [0.0], [0.0], [0.0], [0.15094], [0.0]])
    mu, out = reals(np.array([2.88, 0.234, 0.234, 0.002])), np.full(6, np.nan)
    margin = best_split(reals(f0), reals(N), 1, integers(np.array([0, 3, 4, 5])), mu, 1, 3, out, split_room(1, 4), True)
    assert margin == pytest.approx(0.002, abs=1e-9)
    assert abs(out[4]) <= 0.234 * (1.0 + 1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_the_widest_split_has_the_best_margin(seed):
    """Of contacts whose friction all suffices: the least force is on some cone, the widest split far from all."""
    r, c = 3, 3
    f0, N, first, mu = random_split(np.random.default_rng(seed), r, c, True)
    best, least = split(f0, N, first, mu)
    out = np.full(len(f0), np.nan)
    margin = best_split(reals(f0), reals(N), r, integers(first), reals(mu), c, 0, out, split_room(r, c), False)
    assert margin == pytest.approx(best, rel=1e-12)
    assert margins(out, first, mu).min() == pytest.approx(margin, rel=1e-5)
    assert margins(least, first, mu).min() <= margin * (1.0 + 1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_joints_that_rub_share_their_forces_as_a_linear_programme_has_it(seed):
    """max_z min_j (τ_j − |f_j|), some of the bounds so low that no split holds; of stops f_j is the margin."""
    rng = np.random.default_rng(seed)
    p, r = int(rng.integers(2, 8)), int(rng.integers(1, 4))
    stops = int(rng.integers(0, p))
    f0, N, bound = rng.normal(size=p), np.linalg.qr(rng.normal(size=(p, r)))[0], rng.uniform(0.05, 2.0, size=p)
    bound[p - stops :], f0[p - stops :] = 0.0, 2.0 + f0[p - stops :]
    out, joints = np.full(p, np.nan), p - stops
    mu = np.append(bound[:joints], np.full(stops, ONE_WAY))
    margin = best_split(
        reals(f0),
        reals(N),
        N.shape[1],
        integers(np.arange(p)),
        reals(mu),
        0,
        p,
        out,
        split_room(r, p),
        True,
    )
    ones = np.ones((p, 1))
    rows, limits = (
        np.vstack([np.hstack([N, ones])[:joints], np.hstack([-N, ones])]),
        np.hstack([(bound - f0)[:joints], bound + f0]),
    )
    best = linprog(np.append(np.zeros(N.shape[1]), -1.0), rows, limits, bounds=(None, None)).x[-1]
    assert margin == pytest.approx(best, abs=1e-7)
    assert (bound - np.abs(out))[:joints].min() >= min(best, 0.0) - 1e-7
    assert out[joints:].min(initial=0.0) >= min(best, 0.0) - 1e-7
    assert np.abs((out - f0) - N @ (N.T @ (out - f0))).max() < 1e-9
