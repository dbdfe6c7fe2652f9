"""Contact rows in the modes open, sliding and sticking, where the test sets the mode by hand.

Forces at rest, second derivatives of the gaps, runs before and after a change of mode, and no leftovers of the previous
mode.
"""

from __future__ import annotations

import numpy as np
import pytest
from support.random_robots import CompiledSystem, assemble, random_contacts, random_robot, surface_through

from dynsim.compile.model import Model
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.rows import force_vectors, set_modes
from dynsim.dynamics.state import CONSTRAINT, FRICTION, OUT_FORCE, OUT_VECTOR
from dynsim.jit.kernel import integers
from dynsim.model.description import Contact, Inertia, Link, Quadric, Robot, vector

G = 9.81


def switch(b: CompiledSystem, y: np.ndarray, *modes: int) -> None:
    b.derivative(y)
    set_modes(b.system.contacts, b.system.couplings, b.system.unilateral, b.ws, integers(modes))


def block(mass: float) -> Robot:
    """A body that translates freely and does not rotate."""
    links = []
    for k, name in enumerate("xyz"):
        inertia = Inertia(mass if name == "z" else 0.0)
        links.append(Link(name, f"joint_{name}", "wxyz"[k] if k else None, "prismatic", np.eye(3)[k], inertia))
    return Robot("block", tuple(links), (), ("z", np.zeros(3)))


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
@pytest.mark.parametrize("alpha", [0.1, 0.7, 1.3])
def test_a_block_sticks_to_an_incline(method, alpha):
    """Friction is m g sin α up the slope, the normal force m g cos α, and nothing moves."""
    mass, normal = 3.0, np.array([np.sin(alpha), 0.0, np.cos(alpha)])
    point = vector(0.1, -0.2, 0.0)
    floor = Quadric(np.zeros((3, 3)), normal, -float(normal @ point))
    b = assemble(block(mass), [Contact("foot", "z", point, floor, friction=0.1)])
    y = b.state(np.zeros(3), np.zeros(3))
    switch(b, y, ka.STICKING)
    run = b.simulate(y, np.linspace(0.0, 2.0, 5), method)
    assert np.abs(run.states("q")).max() <= 1e-12
    output = run.outputs("contact")[:, 0]
    np.testing.assert_allclose(output[:, OUT_FORCE], mass * G * np.cos(alpha), rtol=1e-12)
    friction = output[:, OUT_VECTOR : OUT_VECTOR + 3] - output[:, OUT_FORCE, None] * normal
    np.testing.assert_allclose(np.linalg.norm(friction, axis=1), mass * G * np.sin(alpha), rtol=1e-12)
    uphill = np.array([-np.cos(alpha), 0.0, np.sin(alpha)])
    assert (friction @ uphill > 0.0).all()
    assert np.abs(run.states("ledger")[:, [FRICTION, CONSTRAINT]]).max() < 1e-12


def residual_of_second_derivatives(kind: str, seed: int) -> float:
    """d²/dt² of C(r) and of t·(r − anchor) along q + v t + v̇ t²/2, for a point that sticks while it still moves."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, 6)
    q, v = rng.normal(size=(2, 6))
    contact = random_contacts(rng, robot, q, 1)[0]
    contact = Contact("c", "body_5", contact.point, surface_through(rng, kind, position(robot, contact.point, q)))
    b, eps = assemble(robot, [contact]), 1e-4
    y = b.state(q, v, np.zeros(len(robot.motors)))
    switch(b, y, ka.STICKING)
    vdot = b.part(b.derivative(y), "v")
    state = b.ws.contacts[0]
    tangents = state[ka.FIRST_TANGENT : ka.SECOND_TANGENT + 3].reshape(2, 3)
    anchor = state[ka.ANCHOR : ka.ANCHOR + 3]
    values = []
    for t in (-eps, 0.0, eps):
        r = position(robot, contact.point, q + v * t + 0.5 * vdot * t * t)
        surface = contact.surface
        values.append([0.5 * r @ surface.Q @ r + surface.b @ r + surface.c, *(tangents @ (r - anchor))])
    values = np.array(values)
    second = (values[0] - 2.0 * values[1] + values[2]) / eps**2
    return float(np.abs(second).max() / (1.0 + np.abs(vdot).max() ** 2))


def position(robot: Robot, point: np.ndarray, q: np.ndarray) -> np.ndarray:
    return Model(robot).point_position("body_5", point, q)


@pytest.mark.parametrize("kind", ["plane", "sphere", "cylinder"])
def test_rows_of_a_sticking_point_are_second_derivatives_of_their_gaps(kind):
    # Second difference: truncation eps² times the fourth derivative, rounding 1e-15/eps² = 1e-7.
    assert max(residual_of_second_derivatives(kind, seed) for seed in range(10)) < 1e-5


@pytest.mark.parametrize("kind", ["plane", "sphere", "cylinder"])
def test_modes_change_in_a_run(kind):
    """Slides, sticks where it is, slides on and leaves: on the surface while it is held, still while it sticks."""
    rng = np.random.default_rng(8)
    robot = random_robot(rng, 6, motors=False)
    q = rng.normal(size=6)
    point = rng.normal(scale=0.3, size=3)
    contact = Contact("c", "body_5", point, surface_through(rng, kind, position(robot, point, q)), friction=0.2)
    b = assemble(robot, [contact])
    y, times = b.state(q, np.zeros(6)), np.linspace(0.0, 0.1, 6)

    def go(*modes: int) -> np.ndarray:
        nonlocal y
        if modes:
            switch(b, y, *modes)
        run = b.simulate(y, times, rtol=1e-8)
        y = b.state(run.states("q")[-1], run.states("v")[-1])
        return np.array([position(robot, point, q) for q in run.states("q")])

    slid = go()
    assert np.abs(contact.surface.gaps(slid)).max() <= 1e-9
    assert np.ptp(slid, axis=0).max() > 1e-3
    stuck = go(ka.STICKING)
    assert np.abs(contact.surface.gaps(stuck)).max() <= 1e-9
    np.testing.assert_allclose(stuck, np.tile(slid[-1], (6, 1)), rtol=0, atol=1e-9)
    again = go(ka.SLIDING)
    assert np.abs(contact.surface.gaps(again)).max() <= 1e-9
    assert np.ptp(again, axis=0).max() > 1e-4
    force_vectors(b.ws)
    assert np.abs(b.ws.contacts[0, ka.FORCE_VECTOR : ka.FORCE_VECTOR + 3]).max() > 0.0
    left = go(ka.OPEN)
    assert np.abs(contact.surface.gaps(left)).max() > 1e-6
    assert b.ws.contacts[0, ka.NORMAL_FORCE] == 0.0


def test_a_change_of_modes_leaves_nothing_of_the_rows_before():
    """The same bits after STICKING and back as in a workspace that has always slid."""
    rng = np.random.default_rng(2)
    robot = random_robot(rng, 8)
    q, v = rng.normal(size=(2, 8))
    contacts = random_contacts(rng, robot, q, 3)
    b, fresh = assemble(robot, contacts), assemble(robot, contacts)
    y = b.state(q, v, np.zeros(len(robot.motors)))
    expected = fresh.derivative(y)
    for modes in ((ka.STICKING, ka.OPEN, ka.SLIDING), (ka.OPEN, ka.STICKING, ka.STICKING)):
        switch(b, y, *modes)
        b.derivative(y)
    switch(b, y, *[ka.SLIDING] * 3)
    np.testing.assert_array_equal(b.derivative(y), expected)
