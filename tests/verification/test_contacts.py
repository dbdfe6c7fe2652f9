"""Bilateral contacts: agreement of both solvers, constraint, friction, dependent rows, gaps, number of contacts."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.messages import raises
from support.random_robots import assemble, random_contacts, random_robot, surface_through

from dynsim.compile.model import Model
from dynsim.dynamics import tables as ka
from dynsim.dynamics.state import FRICTION
from dynsim.engine import check
from dynsim.errors import ScenarioError
from dynsim.model.description import Contact, Quadric, Robot
from dynsim.model.drives import TorqueSource
from dynsim.scenario import load_scenario

seeds = st.integers(0, 2**32 - 1)


def random_case(seed: int, most: int = 3) -> tuple[Robot, list[Contact], np.ndarray, np.ndarray, np.ndarray]:
    """Robot, contacts, q, v and motor currents."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 13))
    robot = random_robot(rng, n)
    q, v, current = rng.normal(scale=2.0, size=n), rng.normal(size=n), rng.normal(size=len(robot.motors))
    return robot, random_contacts(rng, robot, q, int(rng.integers(1, most + 1))), q, v, current


def rows(robot: Robot, contacts: list[Contact], q: np.ndarray) -> np.ndarray:
    """J, one normal row per contact, (c, n)."""
    model, J = Model(robot), []
    for contact in contacts:
        r = model.point_position(contact.body, contact.point, q)
        gradient = contact.surface.Q @ r + contact.surface.b
        J.append(gradient / np.linalg.norm(gradient) @ model.point_jacobian(contact.body, contact.point, q))
    return np.array(J)


@given(seeds)
def test_articulated_and_m_star_agree(seed):
    robot, contacts, q, v, current = random_case(seed)
    J = rows(robot, contacts, q)
    assume(np.linalg.matrix_rank(J, tol=1e-2) == len(contacts))
    fast, dense = assemble(robot, contacts), assemble(robot, contacts, m_star=True)
    y = fast.state(q, v, current)
    a, b = fast.derivative(y), dense.derivative(y)
    assume(fast.ws.counts[ka.CONTRADICTORY] == 0)
    # The promise of both solvers, per unit of the largest rate; rounding grows with the
    # condition of M*, up to 1e5 here.
    assert np.abs(a - b).max() <= 1e-10 * (1.0 + np.abs(b).max())
    fa, fb = fast.ws.contacts[:, ka.NORMAL_FORCE], dense.ws.contacts[:, ka.NORMAL_FORCE]
    assert np.abs(fa - fb).max() <= 1e-10 * (1.0 + np.abs(fb).max())
    assert (fast.ws.counts[ka.DEPENDENT :] == 0).all()
    assert (dense.ws.counts[ka.DEPENDENT :] == 0).all()


@pytest.mark.parametrize("seed", range(6))
def test_both_solvers_agree_on_torques_that_have_no_circuit(seed):
    robot, contacts, q, v, _ = random_case(seed)
    robot = replace(robot, motors=tuple(TorqueSource(motor.joint) for motor in robot.motors))
    fast, dense = assemble(robot, contacts), assemble(robot, contacts, m_star=True)
    y = fast.state(q, v)
    a, b = fast.derivative(y), dense.derivative(y)
    assert np.abs(a - b).max() <= 1e-9 * (1.0 + np.abs(b).max())


@given(seeds)
def test_accelerations_keep_every_contact_on_its_surface(seed):
    """d²C/dt² = 0 along q + v t + v̇ t²/2, the level set C of the surface: J v̇ + J̇ v = 0."""
    robot, contacts, q, v, current = random_case(seed)
    J = rows(robot, contacts, q)
    assume(np.linalg.matrix_rank(J, tol=1e-2) == len(contacts))
    b, model, eps = assemble(robot, contacts), Model(robot), 1e-4
    vdot = b.part(b.derivative(b.state(q, v, current)), "v")
    assume(np.isfinite(vdot).all())
    for contact in contacts:
        values = []
        for t in (-eps, 0.0, eps):
            r = model.point_position(contact.body, contact.point, q + v * t + 0.5 * vdot * t * t)
            values.append(0.5 * r @ contact.surface.Q @ r + contact.surface.b @ r + contact.surface.c)
        second = (values[0] - 2.0 * values[1] + values[2]) / eps**2
        # Second difference: truncation eps² times the fourth derivative, rounding 1e-15/eps² = 1e-7, against the
        # accelerations that have to cancel.
        assert abs(second) <= 1e-5 * (1.0 + np.abs(vdot).max() ** 2)


@given(seeds)
def test_a_contact_given_twice_shares_one_force(seed):
    """Least norm: equal rows carry equal parts, the motion is that of one contact, and the counter tells."""
    robot, contacts, q, v, current = random_case(seed, most=1)
    J = rows(robot, contacts, q)
    assume(np.abs(J).max() > 1e-2)
    contact = replace(contacts[0], pulling_friction="signed")
    for m_star in (False, True):
        single, two = (
            assemble(robot, [contact], m_star=m_star),
            assemble(robot, [contact, contact], m_star=m_star),
        )
        rates = [x.derivative(x.state(q, v, current)) for x in (single, two)]
        a, b = (
            np.concatenate([x.part(dy, name) for name in ("q", "v", "current")])
            for x, dy in zip((single, two), rates, strict=True)
        )
        scale = 1.0 + np.abs(a).max()
        # The singular system is solved to rounding; squares of singular values enter the least-norm solution.
        assert np.abs(a - b).max() <= 1e-9 * scale
        force, halves = single.ws.contacts[0, ka.NORMAL_FORCE], two.ws.contacts[:, ka.NORMAL_FORCE]
        assert np.abs(halves - 0.5 * force).max() <= 1e-9 * (1.0 + abs(force))
        assert single.ws.counts[ka.DEPENDENT] == 0
        assert two.ws.counts[ka.DEPENDENT] >= 1


def test_friction_takes_energy_where_the_surface_pushes_and_always_when_dissipative():
    pulled = taken = 0
    for seed in range(60):
        robot, contacts, q, v, current = random_case(seed, most=1)
        if np.abs(rows(robot, contacts, q)).max() < 1e-2:
            continue
        for law in ("signed", "dissipative"):
            b = assemble(robot, [replace(contacts[0], pulling_friction=law)])
            y = b.state(q, v, current)
            power = b.part(b.derivative(y), "ledger")[FRICTION]
            if b.ws.counts[ka.CONTRADICTORY]:
                continue
            force = b.ws.contacts[0, ka.NORMAL_FORCE]
            pulled += force < 0.0
            row = b.ws.contacts[0]
            slip = row[ka.SLIP_VELOCITY : ka.SLIP_VELOCITY + 3] @ row[ka.TANGENT : ka.TANGENT + 3]
            expected = contacts[0].friction * slip * (force if law == "signed" else abs(force))
            assert power == pytest.approx(expected, rel=1e-10, abs=1e-12)  # rounding
            if force > 0.0 or law == "dissipative":
                assert power >= -1e-12
                taken += power > 1e-6
    assert pulled > 20
    assert taken > 20


def test_no_consistent_friction_is_said_and_not_papered_over():
    """With large μ some states allow neither a pushing nor a pulling force (Painlevé): NaN and a count."""
    refused = consistent = 0
    for seed in range(200):
        robot, contacts, q, v, current = random_case(seed, most=2)
        b = assemble(robot, [replace(c, friction=5.0, pulling_friction="dissipative") for c in contacts])
        y = b.state(q, v, current)
        dy = b.derivative(y)
        if b.ws.counts[ka.CONTRADICTORY] > 0:
            refused += 1
            assert np.isnan(b.part(dy, "v")).any()
        elif b.ws.counts[ka.DEPENDENT] == 0:
            force, sign = b.ws.contacts[:, ka.NORMAL_FORCE], b.ws.rows[: b.sizes[2], ka.SIGN]
            assert (force * sign >= -1e-9 * (1.0 + np.abs(force).max())).all()
            consistent += 1
    assert refused > 0
    assert consistent > 50


@pytest.mark.parametrize("kind", ["plane", "sphere", "cylinder"])
def test_gap_is_the_distance_from_the_surface(kind):
    rng = np.random.default_rng(3)
    for _ in range(20):
        foot = rng.normal(size=3)
        surface = surface_through(rng, kind, foot)
        gradient = surface.Q @ foot + surface.b
        normal = gradient / np.linalg.norm(gradient)
        for distance in (-0.1, 0.0, 1e-9, 0.3, 5.0):
            # Rounding of the squares of some metres that the level set is made of.
            assert surface.gap(foot + distance * normal) == pytest.approx(distance, abs=1e-13)


def test_gap_of_a_scaled_level_set_is_the_same_length():
    rng = np.random.default_rng(4)
    s = surface_through(rng, "sphere", np.ones(3))
    scaled = Quadric(7.0 * s.Q, 7.0 * s.b, 7.0 * s.c)
    point = rng.normal(size=3)
    assert scaled.gap(point) == pytest.approx(s.gap(point), rel=1e-13)


@given(seeds)
def test_a_scaled_plane_is_the_same_contact(seed):
    """The kernels take ∇C of a plane for its unit normal; a level set 7 C must not change anything."""
    rng = np.random.default_rng(seed)
    robot, contacts, q, v, current = random_case(seed, most=1)
    body, point = contacts[0].body, contacts[0].point
    plane = surface_through(rng, "plane", Model(robot).point_position(body, point, q) + rng.normal(size=3))
    scaled = Quadric(7.0 * plane.Q, 7.0 * plane.b, 7.0 * plane.c)
    results = []
    for surface in (plane, scaled):
        b = assemble(robot, [replace(contacts[0], surface=surface)])
        results.append((b.derivative(b.state(q, v, current)).copy(), b.ws.contacts.copy(), b.ws.counts.copy()))
    for first, second in zip(*results, strict=True):
        # Where friction is contradictory both are NaN.
        np.testing.assert_allclose(first, second, rtol=1e-9, atol=1e-9 * np.nanmax(np.abs(first)))
    assert np.isnan(results[0][0]).any() == (results[0][2][ka.CONTRADICTORY] > 0)
    assert results[0][1][0, ka.GAP] == pytest.approx(plane.gap(Model(robot).point_position(body, point, q)), abs=1e-12)


def test_more_contacts_than_a_machine_can_carry_are_refused_with_an_estimate():
    """The work of a right-hand side grows with p² n and p³."""
    points = {f"c{k}": {"body": "link_1"} for k in range(1000)}
    size = {"plant.chain.0.initial_deg": 90, "plant.chain.0.axis": "y", "duration_s": 100, "contacts.points": points}
    overrides = {**size, "surfaces.floor.type": "plane", "integrator.wall_limit_s": 3600, "record.rate_hz": 50}
    with raises(ScenarioError, "1", "1000", re.compile(r"[\d.]+e\+\d+ s"), "3600 s", "integrator.wall_limit_s"):
        check(load_scenario("single_pendulum", overrides=overrides))
    check(load_scenario("single_pendulum", overrides={**overrides, "integrator.wall_limit_s": 1e5}))
