"""Linear systems A f = b of constraint forces, of full rank or with dependent rows, against numpy's SVD."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.delassus import solve_dependent, solve_small
from dynsim.dynamics.linear import RANK_TOLERANCE

seeds = st.integers(0, 2**32 - 1)


def solve(A: np.ndarray, b: np.ndarray, room: int = 0, solver=solve_small) -> tuple[np.ndarray, bool]:
    """Forces and whether rows depended on each other, with room for more rows than there are."""
    p = len(b)
    ws = ka.workspace(1, 0, 0, p + room)
    ws.small[:], ws.rows[:] = np.nan, np.nan
    ws.small[0, :p, :p], ws.rows[:p, ka.RHS] = A, b
    dependent = solver(ws.small, ws.rows, p)
    assert np.array_equal(ws.small[0, :p, :p], A, equal_nan=True)
    assert np.isnan(ws.rows[p:, ka.FORCE]).all()
    return ws.rows[:p, ka.FORCE].copy(), bool(dependent)


def random_rank(rng: np.random.Generator, p: int, rank: int, spread: float) -> np.ndarray:
    """A (p, p) of this rank whose singular values spread over ``spread`` decades."""
    left, right = (np.linalg.qr(rng.normal(size=(p, p)))[0][:, :rank] for _ in range(2))
    return (left * 10.0 ** rng.uniform(-spread, 0.0, size=rank)) @ right.T


# Examples: pivots that are the largest of their columns alone, which cost up to ten digits of a null space.
@given(seeds)
@example(12374)
@example(12685)
def test_least_norm_least_squares_of_any_rank(seed):
    """Neither symmetric nor consistent systems; residual and null-space part agree with the pseudo-inverse."""
    rng = np.random.default_rng(seed)
    p = int(rng.integers(1, 43))
    A, b = random_rank(rng, p, int(rng.integers(0, p + 1)), 3.0), rng.normal(size=p)
    x, dependent = solve(A, b, room=int(rng.integers(0, 3)))
    expected, _, rank, _ = np.linalg.lstsq(A, b, rcond=1e-10)
    assert dependent == (rank < p)
    # Singular values down to 1e-3: some 1e5 roundings.
    assert np.abs(x - expected).max() <= 1e-10 * (1e-12 + np.abs(expected).max())


@given(seeds)
@example(16964)
@example(16028)
def test_contacts_given_twice_and_nearly_twice(seed):
    """J M⁻¹ F of more rows than joints, with friction; the first two rows all but one, where a first pivot is poor."""
    rng = np.random.default_rng(seed)
    n, p = int(rng.integers(1, 8)), int(rng.integers(3, 22))
    J = rng.normal(size=(p, n))
    J[1] = J[0] + 1e-4 * rng.normal(size=n)
    J[2] = J[0]
    F = J + 0.3 * rng.normal(size=(p, n)) * rng.uniform(size=(p, 1))
    F[2] = F[0]
    A = J @ F.T
    b = A @ rng.normal(size=p) + (rng.normal(size=p) if rng.random() < 0.5 else 0.0)
    x, dependent = solve(A, b)
    U, s, Vt = np.linalg.svd(A)
    kept = s > 1e-10 * s[0]
    expected = Vt[kept].T @ ((U.T @ b)[kept] / s[kept])
    assert dependent
    # The answer to a change of A by rounding: the square of the condition where b is not in the range.
    condition = s[0] / s[kept][-1]
    assert np.abs(x - expected).max() <= 1e-9 * np.abs(expected).max() + 1e-14 * condition**2 * np.abs(b).max() / s[0]


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1e4, 1e12])
def test_rows_of_unequal_scale(scale):
    """Equal rows among others a thousand times as heavy; the whole in any unit."""
    rng = np.random.default_rng(5)
    J = rng.normal(size=(5, 8)) * np.array([1.0, 1e-3, 30.0, 1.0, 1.0])[:, None]
    J[4] = J[0]
    A = scale * (J @ J.T)
    b = scale * J @ rng.normal(size=8)
    x, dependent = solve(A, b)
    assert dependent
    assert x[0] == pytest.approx(x[4], rel=1e-9)
    np.testing.assert_allclose(A @ x, b, rtol=0, atol=1e-12 * np.abs(b).max())


def test_nothing_moves():
    """Rows that no joint can move have no force, and are reported as dependent."""
    for p in (1, 2, 3, 5):
        force, dependent = solve(np.zeros((p, p)), np.ones(p))
        assert dependent
        np.testing.assert_array_equal(force, 0.0)


def test_what_is_not_a_number_is_no_dependence():
    for p in (1, 2, 4):
        force, dependent = solve(np.full((p, p), np.nan), np.ones(p))
        assert np.isnan(force).all()
        assert not dependent


def test_a_small_pivot_above_the_tolerance_is_independent():
    A = np.diag([1.0, 1.0, 10.0 * RANK_TOLERANCE])
    force, dependent = solve(A, np.array([1.0, 2.0, RANK_TOLERANCE]))
    assert not dependent
    np.testing.assert_allclose(force, [1.0, 2.0, 0.1], rtol=1e-14)


@given(seeds)
def test_rows_that_are_known_to_depend_are_solved_whatever_the_order_of_pivots(seed):
    """The last pivot is 1/(A⁻¹)_pp, which a null vector with a small last entry makes large."""
    rng = np.random.default_rng(seed)
    p = int(rng.integers(3, 9))
    basis = np.linalg.qr(rng.normal(size=(p, p)))[0]
    basis[-1, -1] = 1e-3 * rng.normal()
    basis[:, -1] /= np.linalg.norm(basis[:, -1])
    null = basis[:, -1:]
    others = np.linalg.qr(np.hstack([null, basis[:, :-1]]))[0][:, 1:]
    least = 10.0 ** rng.uniform(-15.0, -5.0)
    A = (others * 10.0 ** rng.uniform(-2.0, 0.0, size=p - 1)) @ others.T + least * null @ null.T
    share = least / np.abs(A).max()
    force, dependent = solve(A, rng.normal(size=p), solver=solve_dependent)
    if share < 0.1 * RANK_TOLERANCE:
        assert dependent
        assert np.abs(force).max() < 1e6
    elif share > 100.0 * RANK_TOLERANCE:
        assert not dependent
