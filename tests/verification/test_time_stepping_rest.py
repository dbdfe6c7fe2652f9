"""Bodies at rest on more points than needed: their forces are those of least norm, and stay so without an event."""

from __future__ import annotations

import numpy as np
import pytest
from support.random_robots import CompiledSystem, assemble
from support.stepping_systems import plane, stepped

from dynsim.dynamics.contact.cone.program import select_least_norm
from dynsim.dynamics.contact.cone.steps import BOX, CONE, CONE_ROOM, ONE_WAY, TANGENT
from dynsim.dynamics.state import FRICTION, IMPACT_LOSS, OUT_FORCE
from dynsim.integrators.run import LOGGED
from dynsim.jit.kernel import integers, kernel
from dynsim.model.description import Contact, Inertia, Link, Robot
from dynsim.model.joints.ball import floating

G, Z = 9.81, np.eye(3)[2]
MASS, WIDTH, DEPTH, HEIGHT = 5.0, 0.4, 0.3, 0.7
LEGS = [np.array([x * WIDTH, y * DEPTH, -HEIGHT]) for x in (1, -1) for y in (1, -1)]


def body(points: list[np.ndarray], friction: float = 0.6) -> CompiledSystem:
    """A free body with points on a floor."""
    inertia = Inertia(MASS, np.zeros(3), np.diag([0.3, 0.4, 0.6]))
    links = tuple(floating(Link("body", "root", None, "floating", np.eye(3)[0], inertia)))
    contacts = [Contact(f"foot_{k}", "body", p, plane(Z), friction=friction) for k, p in enumerate(points)]
    return assemble(Robot("body", links, (), ("body", np.zeros(3))), contacts, real=True).with_shapes()


def released(b: CompiledSystem, seconds: float, samples: int = 201, first: float = 0.0):
    """From rest at HEIGHT; ``first``: all weight on legs 1 and 3 as a start of the contact problem [N]."""
    y = b.state(np.r_[0.0, 0.0, HEIGHT, 1.0, 0.0, 0.0, 0.0], np.zeros(6))
    run = b.new_run(y, np.linspace(0.0, seconds, samples), "time_stepping", step=1e-3)
    run.stepping.impulse[[3, 9]] = first * 1e-3
    b.finish(run)
    return run


def stays(run) -> np.ndarray:
    """Its forces, (feet,) [N]; they, and it, have not changed."""
    force = run.outputs("contact")[1:, :, OUT_FORCE]
    assert np.ptp(force, axis=0).max() < 1e-6
    assert np.abs(np.diff(run.states("q"), axis=0)).max() < 1e-10
    assert run.count[LOGGED] == 0
    np.testing.assert_allclose(force.sum(axis=1), MASS * G, rtol=1e-8)
    return force[-1]


@pytest.mark.parametrize("seconds", [20.0, pytest.param(1000.0, marks=pytest.mark.slow)])
def test_a_table_stands_evenly_on_four_legs(seconds):
    """Also where the solution was begun from a corner of what is admissible: 0, 24.5, 0, 24.5 N."""
    run = released(body(LEGS), seconds, first=24.525)
    np.testing.assert_allclose(stays(run), MASS * G / 4.0, atol=1e-6)


@pytest.mark.parametrize("seconds", [20.0, pytest.param(1000.0, marks=pytest.mark.slow)])
def test_a_box_stands_on_eight_points(seconds):
    """Corners and the middles of edges, the weight off their centre: forces that are linear in the place."""
    grid = [(x, y) for x in (-0.45, -0.05, 0.35) for y in (-0.32, -0.02, 0.28)]
    points = [np.array([x, y, -HEIGHT]) for x, y in grid if (x, y) != (-0.05, -0.02)]
    force = stays(released(body(points), seconds))
    xy = np.array(points)[:, :2]
    # Least norm of f with Σ f = m g and Σ f x = Σ f y = 0.
    balance = np.vstack([np.ones(len(xy)), xy.T])
    np.testing.assert_allclose(force, np.linalg.pinv(balance) @ [MASS * G, 0.0, 0.0], atol=1e-6)


def test_a_table_that_is_dropped_rocks_to_rest():
    tilt = np.r_[np.cos(0.02), 0.8 * np.sin(0.02), 0.6 * np.sin(0.02), 0.0]
    b = body(LEGS)
    run = stepped(b, b.state(np.r_[0.0, 0.0, 0.75, tilt], np.zeros(6)), np.arange(3001) * 1e-3, 1e-3, 0.5)
    np.testing.assert_allclose(run.outputs("contact")[-1, :, OUT_FORCE], MASS * G / 4.0, atol=2e-3)
    assert np.abs(run.states("v")[-1]).max() < 1e-9
    lost = run.states("loss")[-1, IMPACT_LOSS] + run.states("ledger")[-1, FRICTION] + run.states("scheme")[-1, 0]
    np.testing.assert_allclose(lost, MASS * G * (0.75 - HEIGHT - run.states("q")[-1, 2] + HEIGHT), atol=1e-6)
    assert run.states("scheme")[-1, 0] < 2e-3 * lost


@kernel
def _selected(W, w, kind, mu, p, f, room):
    select_least_norm(W, w, kind, mu, p, f, room)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 4e-6, 4e-4, 1e-2])
def test_least_norm_leaves_the_motion_as_it_is(angle):
    """Two one-way rows at a small angle, and a joint that only turns when their forces differ."""
    J = np.array([[1.0, 0.0], [1.0, angle], [0.0, 1.0]])
    W, kind, f = J @ J.T, integers([ONE_WAY, ONE_WAY, BOX]), np.array([2.0, 0.0, 0.1])
    before = f.copy()
    _selected(W, np.zeros(3), kind, np.ones(3), 3, f, np.zeros((CONE_ROOM, 3, 3)))
    np.testing.assert_allclose(W @ f, W @ before, rtol=0.0, atol=1.01e-9)
    if angle == 0.0:
        np.testing.assert_allclose(f, [1.0, 1.0, 0.1], atol=1e-6)


def test_least_norm_ends_at_the_cones():
    """Three sticking points on one line of a rigid bar: the motion is the same, the forces are nearer to least."""
    rng = np.random.default_rng(0)
    kind, mu = integers([CONE, TANGENT, TANGENT] * 3), np.zeros(9)
    places = np.array([-1.0, 0.0, 1.0])
    J = np.zeros((9, 5))
    for k, x in enumerate(places):
        J[3 * k, [0, 1]], J[3 * k + 1, 2], J[3 * k + 2, [3, 4]] = [1.0, x], 1.0, [1.0, x]
    W = J @ np.diag([1.0, 3.0, 1.0, 1.0, 3.0]) @ J.T
    ended = 0
    for trial in range(50):
        mu[::3] = 0.4 if trial % 2 else 5.0
        f = np.zeros(9)
        f[::3] = rng.uniform(0.5, 3.0, size=3)
        for k in range(3):
            f[3 * k + 1 : 3 * k + 3] = rng.normal(size=2)
            size = np.linalg.norm(f[3 * k + 1 : 3 * k + 3])
            f[3 * k + 1 : 3 * k + 3] *= min(1.0, 0.95 * mu[3 * k] * f[3 * k] / size)
        before, motion = f.copy(), W @ f
        _selected(W, np.zeros(9), kind, mu, 9, f, np.zeros((CONE_ROOM, 9, 9)))
        np.testing.assert_allclose(W @ f, motion, atol=1e-9)
        least = J @ np.linalg.lstsq(J, before, rcond=None)[0]
        assert np.linalg.norm(f) <= np.linalg.norm(before) + 1e-12
        slack = [mu[3 * k] * f[3 * k] - np.linalg.norm(f[3 * k + 1 : 3 * k + 3]) for k in range(3)]
        assert min(slack) > -1e-9
        reached = np.abs(f - least).max() < 1e-6
        ended += not reached
        # It ends short of the least norm at a cone, and nowhere else.
        assert reached or min(slack) < 1e-6
    assert 0 < ended < 50


def test_least_norm_keeps_friction_in_the_cone_of_a_point_that_slides_slowly():
    """Slip that is not far above the residual of the problem has a direction a little off that of friction."""
    rng = np.random.default_rng(1)
    kind, mu = integers([CONE, TANGENT, TANGENT] * 4), np.zeros(12)
    mu[::3] = 0.4
    J = np.zeros((12, 5))
    for k, x in enumerate([-1.0, -0.3, 0.4, 1.0]):
        J[3 * k, [0, 1]], J[3 * k + 1, 2], J[3 * k + 2, [3, 4]] = [1.0, x], 1.0, [1.0, x]
    W = J @ np.diag([1.0, 3.0, 1.0, 1.0, 3.0]) @ J.T
    moved = 0
    for _ in range(50):
        f, w = np.zeros(12), np.zeros(12)
        f[::3] = rng.uniform(0.5, 3.0, size=4)
        angle = rng.uniform(0.0, 2.0 * np.pi)
        f[1:3] = mu[0] * f[0] * np.array([np.cos(angle), np.sin(angle)])
        w[1:3] = -2e-9 * np.array([np.cos(angle + 0.05), np.sin(angle + 0.05)])
        for k in range(1, 4):
            f[3 * k + 1 : 3 * k + 3] = rng.uniform(-0.25, 0.25, size=2) * f[3 * k]
        before, motion = f.copy(), W @ f
        _selected(W, w, kind, mu, 12, f, np.zeros((CONE_ROOM, 12, 12)))
        np.testing.assert_allclose(W @ f, motion, atol=1e-9)
        assert np.linalg.norm(f) <= np.linalg.norm(before) + 1e-12
        assert min(mu[3 * k] * f[3 * k] - np.linalg.norm(f[3 * k + 1 : 3 * k + 3]) for k in range(4)) > -1e-9
        moved += np.abs(f - before).max() > 1e-3
    assert moved
