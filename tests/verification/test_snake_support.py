"""Support polygon, static margin and gradients of the cost functions of the snake."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from dynsim.compile.protocols import BuildContext
from dynsim.jit.kernel import reals
from dynsim.library.controllers.task_space import TABLE_II
from dynsim.library.plants.snake import Config, build
from dynsim.snake.description import ModeTable
from dynsim.snake.kinematics import new_chain, pose_of_point, walk_chain
from dynsim.snake.support import (
    Cost,
    cost_gradient,
    cost_value,
    new_support,
    polygon_area,
    smooth_margin,
    support_polygon,
)

seeds = st.integers(0, 2**32 - 1)
ROBOT = build(Config(), BuildContext(1.0))
MODEL = ROBOT.arrays()
MODES = ModeTable.from_lifted(TABLE_II, 7)
K_V = reals([15, 0.015] * 3 + [9.6, 4.8, 2.4, 1.2, 0.6, 0.3])


def posture(phi, base=(0.3, -0.2, 0.7)):
    w, chain = np.zeros(6), new_chain(MODEL)
    pose_of_point(MODEL, reals(base), reals(phi), np.zeros((3, 3)), w)
    walk_chain(MODEL, w, reals(phi), np.zeros((3, 3)), chain)
    return chain


def cost_at(cost, phi, grounded):
    support = new_support(MODEL)
    sides, margin = support_polygon(MODEL, posture(phi), grounded, support)
    return cost_value(cost, reals(phi), sides, support, margin)


@given(seeds, st.integers(0, 5))
@settings(max_examples=40, deadline=None)
def test_polygon_is_the_convex_hull_and_margin_the_nearest_side(seed, row):
    phi = np.random.default_rng(seed).uniform(-1.1, 1.1, 12)
    chain, support, grounded = posture(phi), new_support(MODEL), MODES.grounded[row]
    sides, margin = support_polygon(MODEL, chain, grounded, support)
    down = grounded.astype(bool)
    offset = MODEL.half_track[down, None] * chain.pair_y[down, :2]
    points = np.concatenate([chain.pair_position[down, :2] - offset, chain.pair_position[down, :2] + offset])
    hull = ConvexHull(points)
    assert polygon_area(support, sides) == pytest.approx(hull.volume, rel=1e-10)
    centre = np.average(chain.link_centre, axis=0, weights=MODEL.link_mass)
    np.testing.assert_allclose(support.centre, centre, atol=1e-14)
    # scipy's planes point outward: minus the largest of n . p + d is the signed distance to the nearest side
    assert margin == pytest.approx(-(hull.equations @ [*centre[:2], 1.0]).max(), abs=1e-12)


@pytest.mark.parametrize("kind", [0, 1, 2])
@given(seed=seeds, row=st.integers(0, 5))
@settings(max_examples=25, deadline=None)
def test_gradient_of_the_cost(kind, seed, row):
    """Analytic eta (eq 17) against central differences."""
    phi, grounded = np.random.default_rng(seed).uniform(-1.0, 1.0, 12), MODES.grounded[row]
    cost = Cost(kind, K_V, 0.7, 1.3, 1e-3, 1e-3)
    support, eta = new_support(MODEL), np.zeros(19)
    cost_gradient(MODEL, cost, posture(phi), reals(phi), grounded, support, eta)
    _, margin = support_polygon(MODEL, posture(phi), grounded, support)
    assume(kind != 2 or margin >= 5e-3)  # not the clipped tipping side
    h, steps = 1e-6, np.eye(12) * 1e-6
    numeric = np.array([(cost_at(cost, phi + s, grounded) - cost_at(cost, phi - s, grounded)) / (2 * h) for s in steps])
    corners = {tuple(sorted(hull_of(phi + s, grounded))) for s in (*steps, *-steps)}
    assume(len(corners) == 1)  # where a corner joins or leaves the hull, V of eq 20 is not smooth
    np.testing.assert_allclose(eta[:12], numeric, rtol=1e-5, atol=1e-5 * np.abs(eta).max())
    assert not eta[12:].any()


def hull_of(phi, grounded):
    support = new_support(MODEL)
    sides, _ = support_polygon(MODEL, posture(phi), grounded, support)
    return support.hull[:sides].tolist()


@given(seeds, st.integers(0, 5))
@settings(max_examples=25, deadline=None)
def test_smoothed_margin_is_near_the_margin_and_has_no_jump_where_a_corner_joins(seed, row):
    """margin <= smoothed <= margin + s ln(L / L_nearest); walking through postures, corners come and go."""
    random, s, grounded = np.random.default_rng(seed), 1e-3, MODES.grounded[row]
    start, direction = random.uniform(-1.0, 1.0, (2, 12))
    support, differences = new_support(MODEL), []
    for step in np.linspace(0.0, 0.2, 201):
        sides, margin = support_polygon(MODEL, posture(start + step * direction), grounded, support)
        smooth, _, perimeter = smooth_margin(support, sides, s, margin)
        nearest = support.distance[:sides].argmin()
        assert -1e-15 <= smooth - margin <= s * np.log(perimeter / support.length[nearest]) + 1e-15
        differences.append(smooth)
    # second differences: (change of d in a step of 1e-3 rad)^2 / s = 1e-4 m; a jump would be s ln 2 = 7e-4 m
    assert np.abs(np.diff(differences, 2)).max() < 3e-4


def test_fewer_than_three_contacts_cannot_stand():
    support = new_support(MODEL)
    assert support_polygon(MODEL, posture(np.zeros(12)), np.array([0, 0, 0, 1, 0, 0, 0]), support) == (0, -np.inf)


def test_margin_does_not_depend_on_where_the_robot_stands():
    phi, support = ROBOT.initial_joints, new_support(MODEL)
    margins = [support_polygon(MODEL, posture(phi, base), MODES.grounded[0], support)[1]
               for base in ((0, 0, 0), (5, -3, 2.0))]  # fmt: skip
    assert margins[0] == pytest.approx(margins[1], abs=1e-12)
