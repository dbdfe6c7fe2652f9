"""Splines and banded systems against scipy's, and hand paths against the surfaces that braces are to stay on."""

import re

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, make_interp_spline
from support.messages import raises

from dynsim.compile.model import Model
from dynsim.compile.references.inverse_kinematics import follow
from dynsim.compile.references.splines import clamped_cubic, quintic_coefficients, quintic_rates
from dynsim.draw.geometry.shapes import outline
from dynsim.dynamics.banded import solve_banded
from dynsim.errors import UnreachableReference
from dynsim.model.description import Contact
from dynsim.model.surfaces import Box, Quadric
from dynsim.scenario import build_model, load_scenario


@pytest.mark.parametrize(("lower", "upper"), [(0, 2), (1, 1), (2, 0), (3, 5)])
def test_banded_systems_with_pivots_that_vanish(lower: int, upper: int) -> None:
    random = np.random.default_rng(lower)
    n = 12
    band = np.zeros((n, 2 * lower + upper + 1))
    matrix = np.zeros((n, n))
    for i in range(n):
        for j in range(max(0, i - lower), min(n, i + upper + 1)):
            # Rows must be exchanged where there is something to exchange them for.
            matrix[i, j] = 0.0 if i == j and lower and upper else random.normal()
            band[i, lower + j - i] = matrix[i, j]
    x = random.normal(size=(n, 2))
    right = matrix @ x
    solve_banded(band, lower, upper, right)
    assert right == pytest.approx(x, rel=1e-12 * np.linalg.cond(matrix), abs=1e-12 * np.linalg.cond(matrix))


@pytest.mark.parametrize("count", [6, 7, 8, 9, 40, 501])
def test_quintics_are_those_of_scipy(count: int) -> None:
    h = 2.0**-7  # knots that are numbers, as scipy is told each of them
    times = 0.5 + h * np.arange(count)
    values = np.stack([np.sin(2.0 * times), np.random.default_rng(count).normal(size=count)], axis=1)
    expected = make_interp_spline(times, values, k=5)
    slope, curvature = quintic_rates(h, values)
    size = np.abs(values).max()
    for ours, theirs, scale in (
        (slope, expected(times, 1), size / h),  # the rounding of samples counts by 1/h, in curvatures by 1/h²
        (curvature, expected(times, 2), size / h**2),
    ):
        assert ours == pytest.approx(theirs, rel=0.0, abs=1e-13 * max(scale, np.abs(theirs).max()))
    between = np.einsum("scp,p->sc", quintic_coefficients(h, values), (0.3 * h) ** np.arange(6))
    assert between == pytest.approx(expected(times[:-1] + 0.3 * h), rel=0.0, abs=1e-13 * size)


def test_samples_that_hold_at_an_end_are_held() -> None:
    """A motion from 0.1 s to 0.7 s of 0.8 s: the kinks at its ends do not ring into the holds, nor reach t = 0."""
    times = np.linspace(0.0, 0.8, 41)
    spacing = float(times[1])
    moves, begins = (clamped_cubic([at, 0.7], np.array([[0.5], [0.7]]), times) for at in (0.1, 0.0))
    slope, curvature = quintic_rates(spacing, np.hstack([moves, begins, np.full_like(moves, 0.3)]))
    assert not slope[:6, 0].any()
    assert not slope[35:, :2].any()
    assert not curvature[:6, 0].any()
    assert not curvature[35:, :2].any()
    # The motion keeps the speed of its cubic, to what a quintic spline makes of the kinks in its curvature.
    peak = 1.5 * 0.2 / 0.6
    assert slope[20, 0] == pytest.approx(peak, rel=1e-3)
    # Between the knots it is as still, and it goes through all samples.
    pieces = quintic_coefficients(spacing, moves)
    assert not pieces[:5, 0, 1:].any()
    assert np.einsum("scp,p->sc", pieces, spacing ** np.arange(6)) == pytest.approx(moves[1:], rel=0.0, abs=1e-14)
    # Kinks that are far off reach neither end: the spline is the interpolating one, to the last bit.
    late = clamped_cubic([0.3, 0.5], np.array([[0.5], [0.7]]), times)
    expected = make_interp_spline(times, late, k=5)(times, 1)
    assert quintic_rates(spacing, late)[0] == pytest.approx(expected, rel=0.0, abs=1e-11)


@pytest.mark.parametrize("count", [2, 3, 9])
def test_level_cubics_are_those_of_scipy(count: int) -> None:
    random = np.random.default_rng(count)
    knots = np.cumsum(random.uniform(0.1, 2.0, count))
    values = random.normal(size=(count, 3))
    times = np.linspace(knots[0] - 1.0, knots[-1] + 1.0, 200)
    expected = CubicSpline(knots, values, bc_type="clamped")(np.clip(times, knots[0], knots[-1]))
    assert clamped_cubic(knots, values, times) == pytest.approx(expected, rel=0.0, abs=1e-13)
    assert clamped_cubic(list(knots), values[:, 0], times) == pytest.approx(expected[:, 0], rel=0.0, abs=1e-13)


@pytest.fixture(scope="module")
def arm() -> Model:
    return build_model(load_scenario("six_axis_arm"))


def path_of(arm: Model) -> tuple[np.ndarray, np.ndarray]:
    """A small circle from where the hand is, (T,) and (T, 3)."""
    hand = arm.point_position(*arm.robot.hand, arm.robot.initial)
    angle = np.linspace(0.0, 2.0 * np.pi, 41)
    off = np.stack([np.cos(angle) - 1.0, np.sin(angle), 0.0 * angle], axis=1)
    return np.linspace(0.0, 4.0, 41), hand + 0.01 * off


def touching(arm: Model, kind: str) -> Contact:
    """A ball on a link in the middle of the arm that touches a surface of a kind."""
    link, radius = arm.robot.links[3].name, 0.0 if kind == "quadric" else 0.01
    point = np.array([0.0, 0.02, 0.03])
    at, normal = arm.point_position(link, point, arm.robot.initial), np.array([0.0, 0.0, 1.0])
    below = at - radius * normal
    if kind == "box":
        surface = Box(below - 0.5 * normal, np.eye(3), np.ones(3), 0.05)
    elif kind == "sphere":
        centre = below - 0.4 * normal
        surface = Quadric(np.eye(3), -centre, 0.5 * float(centre @ centre) - 0.5 * 0.4**2)
    else:
        Q = np.diag([1.0, 2.0, 3.0])
        b = normal - Q @ at  # the gradient at the point is the normal
        surface = Quadric(Q, b, -float(0.5 * at @ Q @ at + b @ at))
    return Contact("brace", link, point, surface, radius=radius)


@pytest.mark.parametrize("kind", [None, "quadric", "sphere", "box"])
def test_hand_on_its_path_and_braces_on_their_surfaces(arm: Model, kind: str | None) -> None:
    times, targets = path_of(arm)
    contacts = [] if kind is None else [touching(arm, kind)]
    motion = follow(arm, times, targets, arm.joint_names, arm.robot.initial, 1e-6, braces=contacts)
    assert np.abs(np.diff(motion, axis=0)).max() > 1e-3
    for q, target in zip(motion, targets, strict=True):
        assert arm.point_position(*arm.robot.hand, q) == pytest.approx(target, abs=1e-9)
        for contact in contacts:
            position = arm.point_position(contact.body, contact.point, q)
            assert contact.surface.gap(position) == pytest.approx(contact.radius, abs=1e-9)


def test_what_cannot_be_reached_is_said_with_its_time(arm: Model) -> None:
    times, targets = path_of(arm)
    targets[30:] += 10.0
    with raises(UnreachableReference, "3.000 s", "controller.hand.path", re.compile(r"[\d.]+ m\b")):
        follow(arm, times, targets, arm.joint_names, arm.robot.initial, 1e-6)


def test_outlines_are_convex_hulls() -> None:
    random = np.random.default_rng(2)
    points = random.normal(size=(60, 2))
    hull = outline(points)
    edges = np.roll(hull, -1, axis=0) - hull
    for corner, (ex, ey) in zip(hull, edges, strict=True):
        off = points - corner
        assert (ex * off[:, 1] - ey * off[:, 0] >= -1e-12).all()
    assert {tuple(corner) for corner in hull} <= {tuple(point) for point in points}
    assert outline(np.array([[1.0, 1.0], [0.0, 0.0], [2.0, 2.0]])).tolist() == [[0.0, 0.0], [2.0, 2.0]]
    assert outline(np.ones((3, 2))).tolist() == [[1.0, 1.0], [1.0, 1.0]]
