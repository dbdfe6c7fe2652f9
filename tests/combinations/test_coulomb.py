"""The exact decision whether Coulomb forces exist, against closed forms and enumeration."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from combinations.accelerations import State, _violation
from combinations.coulomb import Point, Rest, forces_exist, parts


def _one_contact(coupling: float, friction: float) -> tuple[np.ndarray, Point]:
    """Return a point that slides along its first tangent, with A = 1 − μ coupling."""
    W = np.eye(3)
    W[0, 1] = W[1, 0] = coupling
    return W, Point(0, friction, np.array([1.0, 0.0]))


@pytest.mark.parametrize(("friction", "b", "some"), [(1.0, -1.0, True), (3.0, -1.0, False), (3.0, 1.0, True)])
def test_painleve_of_one_contact(friction: float, b: float, some: bool) -> None:
    """Without a force a = b, with a force A f + b = 0: for A < 0 no solution if b < 0, two if b > 0."""
    W, point = _one_contact(0.5, friction)
    assert forces_exist(W, np.array([b, 0.3, -0.2]), [point], []) is some


def test_any_right_side_has_forces_at_rest() -> None:
    """The paradox of a sliding point disappears at rest: it sticks, or slips the other way."""
    W, _ = _one_contact(0.5, 3.0)
    for angle in np.linspace(0.0, 2.0 * np.pi, 9):
        assert forces_exist(W, np.array([-1.0, 5.0 * np.cos(angle), 5.0 * np.sin(angle)]), [Point(0, 3.0)], [])


def test_a_point_at_rest_that_can_only_slip() -> None:
    """With a bound 0.1 f_n and a pull of 10 along one tangent it slips, in a direction inside a sector."""
    b = np.array([-1.0, 10.0 * np.cos(0.3), 10.0 * np.sin(0.3)])
    assert forces_exist(np.eye(3), b, [Point(0, 0.1)], [])


def test_sliding_contacts_as_by_enumeration() -> None:
    """Enumerate sets of contacts with forces: f = −A⁻¹ b there, not negative, and A f + b elsewhere."""
    random = np.random.default_rng(3)
    exist = []
    for _ in range(60):
        J = random.normal(size=(9, 12))
        W, b = J @ J.T / 12.0, random.normal(size=9)
        angles = random.uniform(0.0, 2.0 * np.pi, 3)
        directions = [np.array([np.cos(angle), np.sin(angle)]) for angle in angles]
        points = [Point(3 * k, 2.5, direction) for k, direction in enumerate(directions)]
        F = np.zeros((9, 3))
        for k, direction in enumerate(directions):
            F[3 * k, k], F[3 * k + 1 : 3 * k + 3, k] = 1.0, -2.5 * direction
        A, c, some = (W @ F)[::3], b[::3], False
        for carries in itertools.product((False, True), repeat=3):
            f, on = np.zeros(3), np.array(carries)
            f[on] = np.linalg.solve(A[np.ix_(on, on)], -c[on])
            some = some or bool((f >= 0.0).all() and ((A @ f + c)[~on] >= 0.0).all())
        assert forces_exist(W, b, points, []) is some
        exist.append(some)
    assert 5 < sum(exist) < 55


def test_joints_at_rest_and_stops() -> None:
    """A joint of unit inertia holds up to its bound or moves; between two closing stops there is no solution."""
    unit = np.ones((1, 1))
    assert forces_exist(unit, np.array([0.5]), [], [Rest(0, 1.0)])
    assert forces_exist(unit, np.array([-3.0]), [], [Rest(0, 1.0)])
    both = np.array([[1.0, -1.0], [-1.0, 1.0]])
    assert forces_exist(both, np.array([-1.0, 1.0]), [Point(0, 0.0), Point(1, 0.0)], [])
    assert not forces_exist(both, np.array([-1.0, -1.0]), [Point(0, 0.0), Point(1, 0.0)], [])


def test_parts_that_do_not_act_on_each_other() -> None:
    W = np.eye(5)
    W[0, 4] = W[4, 0] = 0.1
    assert sorted(parts(W, [[0, 1], [2], [3, 4]])) == [[0, 2], [1]]


def test_an_iteration_that_overflows_has_found_no_forces() -> None:
    state = State(
        *(np.zeros(1),) * 3, np.eye(1), ["foot"], [np.ones((3, 1))], [0.0], [np.zeros(2)], [0.5], [0.0], [0.5], [], [],
        np.zeros(1), [],
    )  # fmt: skip
    assert _violation(state, np.eye(3), np.zeros(3), np.full(3, np.nan)) == np.inf
