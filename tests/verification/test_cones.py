"""The contact problem: closed forms, and random problems whose conditions are checked by independent code."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from support.cone_checks import violation

from dynsim.dynamics.contact.cone.steps import (
    BOTH_WAYS,
    BOX,
    CONE,
    CONE_ROOM,
    NO_SOLUTION,
    ONE_WAY,
    TANGENT,
    solve_block,
    solve_cones,
)

BLOCK = [CONE, TANGENT, TANGENT]


def solve(W, b, kind, mu=0.0, start=None, tolerance=1e-12):
    """Residual and forces; mu: one number, or one for each row."""
    W, b = np.array(W, dtype=float), np.array(b, dtype=float)
    p = len(b)
    f = np.zeros(p) if start is None else np.array(start, dtype=float)
    kind = np.array(kind, dtype=np.int64)
    room = np.zeros((CONE_ROOM, p, p))
    residual = solve_cones(W, b, kind, np.zeros(p) + mu, p, f, room, tolerance)
    return residual, f


def test_no_rows_are_solved_by_no_forces():
    """Compiled and as Python, which would raise an error if it read from an empty workspace."""
    no = np.zeros(0)
    for solve_them in (solve_cones, getattr(solve_cones, "py_func", solve_cones)):
        room = np.zeros((CONE_ROOM, 0, 0))
        assert solve_them(np.zeros((0, 0)), no, np.zeros(0, dtype=np.int64), no, 0, no, room, 1e-12) == 0.0


def test_a_block_on_a_slope_sticks_below_its_friction_angle_and_slides_beyond():
    mass, g = 2.0, 9.81
    for slope in (0.1, 0.29, 0.31, 0.9):
        b = [-g * np.cos(slope), 0.6 * g * np.sin(slope), 0.8 * g * np.sin(slope)]
        residual, f = solve(np.eye(3) / mass, b, BLOCK, mu=0.3)
        normal = mass * g * np.cos(slope)
        tangential = min(mass * g * np.sin(slope), 0.3 * normal)
        assert residual <= 1e-12
        np.testing.assert_allclose(f, [normal, -0.6 * tangential, -0.8 * tangential], rtol=1e-12)


def test_what_leaves_the_surface_has_no_force():
    residual, f = solve(np.eye(3), [1.0, -3.0, 2.0], BLOCK, mu=1.0, start=[5.0, 1.0, 1.0])
    assert residual == 0.0
    assert (f == 0.0).all()


def test_normal_and_tangent_that_are_coupled():
    # u_n = 2 f_n + f_x − 1, u_x = f_n + f_x + 1 with sliding towards +x: f_x = −μ f_n, f_n = 1 / (2 − μ).
    mu, W = 0.5, [[2.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    residual, f = solve(W, [-1.0, 1.0, 0.0], BLOCK, mu=mu)
    assert residual <= 1e-12
    np.testing.assert_allclose(f, [1 / (2 - mu), -mu / (2 - mu), 0.0], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("mu", [0.0, 0.3, 2.0])
def test_one_block_alone_has_the_forces_of_its_law(mu):
    """Off, or no normal motion; sticks within the cone, else on its edge, against the slip."""
    rng, outcomes = np.random.default_rng(5), set()
    for _ in range(60):
        half = rng.normal(size=(3, 3))
        W, free, f = half @ half.T + 0.3 * np.eye(3), rng.normal(size=3), np.zeros(3)
        W[0, 1:] *= 0.3
        W[1:, 0] = W[0, 1:]
        solve_block(W, 0, *free, mu, f, 1e-14)
        motion, edge = W @ f + free, mu * f[0]
        if free[0] >= 0.0:
            outcomes.add("off")
            assert not f.any()
            continue
        assert f[0] > 0.0
        assert abs(motion[0]) <= 1e-12
        size, slip = np.hypot(*f[1:]), np.hypot(*motion[1:])
        if size < edge * (1.0 - 1e-9):
            outcomes.add("sticks")
            assert slip <= 1e-12
        else:
            outcomes.add("slides")
            assert size == pytest.approx(edge, rel=1e-9, abs=1e-15)
            assert f[1:] @ motion[1:] == pytest.approx(-size * slip, rel=1e-7, abs=1e-12)
    assert outcomes == {"off", "slides"} | ({"sticks"} if mu else set())


def test_directed_friction_makes_a_problem_of_one_way_rows_that_every_start_solves():
    random = np.random.default_rng(4)
    for _ in range(300):
        p = random.integers(1, 9)
        # Strictly diagonally dominant with positive diagonal: a P-matrix, so that the solution is unique.
        W = random.normal(size=(p, p))
        np.fill_diagonal(W, np.abs(W).sum(axis=1) * random.uniform(1.0, 1.5))
        b = random.normal(size=p)
        solutions = []
        for start in (np.zeros(p), 10.0 * random.normal(size=p)):
            residual, f = solve(W, b, [ONE_WAY] * p, start=start)
            assert residual <= 1e-12
            assert violation(W, b, [ONE_WAY] * p, np.zeros(p), f) <= 1e-11
            solutions.append(f)
        np.testing.assert_allclose(*solutions, atol=1e-11)


def random_contacts(seed):
    """Jacobian, inverse masses, velocity, kinds and friction of random contacts, with more or fewer rows than rates."""
    random = np.random.default_rng(seed)
    cones = int(random.integers(1, 15)) if random.random() < 0.7 else int(random.integers(1, 4))
    blocks = [BLOCK] * cones + [[ONE_WAY]] * random.integers(0, 4) + [[BOTH_WAYS]] * random.integers(0, 4)
    random.shuffle(blocks)
    kind = np.concatenate(blocks)
    p = len(kind)
    n = int(random.integers(max(1, np.sum(kind == BOTH_WAYS)), p + 6))
    inverse_mass = 10.0 ** -random.uniform(0.0, random.uniform(0.0, 6.0), n)
    J = random.normal(size=(p, n))
    if random.random() < 0.3:
        J *= random.random(J.shape) < 0.4
    first = np.flatnonzero(kind == CONE)
    if random.random() < 0.3 and len(first) > 1:  # the same point twice
        index, other = random.choice(first, 2, replace=False)
        J[other : other + 3] = J[index : index + 3]
    mu = np.where(kind == CONE, random.choice([0.0, 0.05, 0.3, 0.8, 1.5, 2.0], size=p), 0.0)
    return J, inverse_mass, random.normal(size=n), kind, mu


def random_problem(seed):
    """A contact problem of mechanics: W = J M⁻¹ Jᵀ of any rank, b = J v."""
    J, inverse_mass, v, kind, mu = random_contacts(seed)
    return J @ (inverse_mass * J).T, J @ v, kind, mu


@pytest.mark.parametrize(
    "seeds", [range(2000), pytest.param(range(2000, 10000), marks=pytest.mark.slow)], ids=["2000", "8000 more"]
)
def test_random_problems(seeds):
    unsolved = []
    for seed in seeds:
        W, b, kind, mu = random_problem(seed)
        scale = np.abs(b).max()
        residual, f = solve(W, b, kind, mu, tolerance=1e-10 * scale)
        if not (0.0 <= residual <= 1e-9 * scale and violation(W, b, kind, mu, f) <= 3e-9 * scale):
            unsolved.append((seed, residual / scale, violation(W, b, kind, mu, f) / scale))
    assert not unsolved


@pytest.mark.parametrize("seeds", [range(1000), pytest.param(range(1000, 5000), marks=pytest.mark.slow)])
def test_random_problems_with_bounded_rows(seeds):
    """Contacts of bodies whose joints rub, with bounds of any size; some of those rows give way."""
    unsolved = []
    for seed in seeds:
        W, b, kind, mu = random_problem(seed)
        random = np.random.default_rng(seed)
        rubs = (kind == BOTH_WAYS) | (kind == ONE_WAY)
        kind[rubs] = BOX
        mu[rubs] = (
            random.choice([0.0, 0.1, 1.0, 10.0, 1e6], size=rubs.sum()) * np.abs(b).max() / max(np.diag(W).max(), 1e-9)
        )
        W += np.diag(np.where(rubs, random.choice([0.0, 0.3], size=len(b)), 0.0) * np.diag(W))
        scale = np.abs(b).max()
        residual, f = solve(W, b, kind, mu, tolerance=1e-10 * scale)
        if not (0.0 <= residual <= 1e-9 * scale and violation(W, b, kind, mu, f) <= 3e-9 * scale):
            unsolved.append((seed, residual / scale, violation(W, b, kind, mu, f) / scale))
    assert not unsolved


def test_bounded_rows_are_a_quadratic_problem():
    """Without cones f is the least of f·W f/2 + b·f within the bounds."""
    rng = np.random.default_rng(1)
    for _ in range(10):
        A, b, mu = rng.normal(size=(6, 6)), rng.normal(size=6), rng.uniform(0.05, 0.5, size=6)
        expected = lsq_linear(A.T, -np.linalg.solve(A, b), (-mu, mu), tol=1e-14).x
        residual, f = solve(A @ A.T, b, [BOX] * 6, mu)
        assert residual <= 1e-12
        np.testing.assert_allclose(f, expected, rtol=0, atol=1e-7)


def test_the_residual_is_that_of_the_forces_returned():
    W, b, kind, mu = random_problem(5)
    residual, f = solve(W, b, kind, mu, tolerance=np.inf, start=np.ones(len(b)))
    assert (f == 1.0).all()
    assert residual >= 1e-3
    assert violation(W, b, kind, mu, f) >= 1e-3


def test_walls_that_close_in_from_both_sides_have_a_certificate():
    """A body between two walls that come towards it: nothing keeps both off; nor does friction."""
    random = np.random.default_rng(11)
    for _ in range(100):
        n = random.integers(4, 9)
        inverse_mass = 10.0 ** -random.uniform(0.0, 3.0, n)
        point = random.normal(size=(3, n))
        J = np.vstack([point, [[-1.0], [1.0], [1.0]] * point])
        b, W = J @ random.normal(size=n), J @ (inverse_mass * J).T
        for friction in (0.0, 0.7):
            # The other wall comes, or goes away.
            residual, _ = solve(W, b - np.eye(6)[3], [*BLOCK, *BLOCK], friction, tolerance=1e-10)
            assert residual == NO_SOLUTION
            residual, _ = solve(W, b + np.eye(6)[3], [*BLOCK, *BLOCK], friction, tolerance=1e-10)
            assert 0.0 <= residual <= 1e-10
