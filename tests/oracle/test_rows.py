"""Rows of contacts, of pairs of bodies and joints, and of couplings against dense systems of Pinocchio's quantities."""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import files
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.pinocchio_oracle import Oracle
from support.random_robots import CompiledSystem, assemble, random_contacts, random_robot, random_unit

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.rows import force_vectors, set_modes
from dynsim.jit.kernel import integers
from dynsim.model.description import Contact, Coupling, Robot
from dynsim.model.urdf.reader import read_urdf

seeds = st.integers(0, 2**32 - 1)


def stick(b: CompiledSystem, y: np.ndarray, *modes: int) -> None:
    """Give the candidates these modes at the state y."""
    b.derivative(y)
    set_modes(b.system.contacts, b.system.couplings, b.system.unilateral, b.ws, integers(modes))


def free_motion(
    b: CompiledSystem, oracle: Oracle, q: np.ndarray, v: np.ndarray, current: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Mass matrix with armature, and joint forces of motors and losses minus the bias."""
    body, motor = b.system.model.body, b.system.drives.motor
    tau = -(body[:, ka.DAMPING] + body[:, ka.GEAR_DAMPING]) * v
    np.add.at(tau, b.system.drives.table[:, ka.DRIVEN], motor[:, ka.K_M] * current)
    bias = oracle.back(pin.nonLinearEffects(oracle.model, oracle.data, oracle.to(q), oracle.to(v)))
    return oracle.mass_matrix(q) + np.diag(body[:, ka.ARMATURE]), tau - bias


def saddle(M: np.ndarray, tau: np.ndarray, J: np.ndarray, F: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, ...]:
    """v̇ and f of [M, −Fᵀ; J, 0] [v̇; f] = [tau; target], and the rounding to allow for."""
    K = np.block([[M, -F.T], [J, np.zeros((len(J), len(J)))]])
    x = np.linalg.solve(K, np.concatenate([tau, target]))
    return x[: len(M)], x[len(M) :], 1e-13 * np.linalg.cond(K) * (1.0 + np.abs(x).max())


def random_case(seed: int, least: int = 1) -> tuple[np.random.Generator, Robot, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(least, 12))
    robot = random_robot(rng, n)
    return rng, robot, rng.normal(scale=2.0, size=n), rng.normal(size=n), rng.normal(size=len(robot.motors))


@given(seeds, st.booleans())
def test_a_sticking_point_does_not_move(seed, m_star):
    """A point at rest on a plane, sphere or cylinder: Jp v̇ = −J̇p v in three dimensions, whatever the surface."""
    rng, robot, q, v, current = random_case(seed, least=4)
    contact = random_contacts(rng, robot, q, 1)[0]
    oracle, b = Oracle(robot), assemble(robot, [contact], m_star=m_star)
    body = int(contact.body.removeprefix("body_"))
    _, Jp, _, _ = oracle.point(body, contact.point, q, v)
    assume(np.linalg.svd(Jp)[1][-1] > 1e-2)
    v = v - np.linalg.pinv(Jp) @ (Jp @ v)
    _, Jp, velocity, drift = oracle.point(body, contact.point, q, v)
    assert np.abs(velocity).max() < 1e-12
    y = b.state(q, v, current)
    stick(b, y, ka.STICKING)
    vdot = b.part(b.derivative(y), "v")
    M, tau = free_motion(b, oracle, q, v, current)
    expected, force, scale = saddle(M, tau, Jp, Jp, -drift)
    np.testing.assert_allclose(vdot, expected, rtol=0, atol=scale)
    force_vectors(b.ws)
    np.testing.assert_allclose(b.ws.contacts[0, ka.FORCE_VECTOR : ka.FORCE_VECTOR + 3], force, rtol=0, atol=scale)
    normal = b.ws.contacts[0, ka.NORMAL : ka.NORMAL + 3]
    assert b.ws.contacts[0, ka.NORMAL_FORCE] == pytest.approx(normal @ force, abs=scale)


@given(seeds, st.booleans())
def test_rows_between_bodies_and_between_joints(seed, m_star):
    """Points of two bodies held to each other along one direction, beside couplings and contacts that slide."""
    rng, robot, q, v, current = random_case(seed, least=5)
    n = len(q)
    joints = rng.permutation(n)[:2]
    coupling = Coupling(f"joint_{joints[0]}", f"joint_{joints[1]}", float(rng.normal()), 0.1)
    contacts = [replace(c, pulling_friction="signed") for c in random_contacts(rng, robot, q, 1)]
    q[joints[0]] = coupling.ratio * q[joints[1]] + coupling.offset
    robot = replace(robot, couplings=(coupling,), q0=q)
    oracle, b = Oracle(robot), assemble(robot, contacts, m_star=m_star)
    y = b.state(q, v, current)
    b.derivative(y)
    J, F, target = np.zeros((4, n)), np.zeros((4, n)), np.zeros(4)
    J[0, joints[0]], J[0, joints[1]] = 1.0, -coupling.ratio
    F[0] = J[0]
    touched, point = int(contacts[0].body.removeprefix("body_")), contacts[0].point
    Jp = oracle.point(touched, point, q, v)[1]
    J[1], F[1] = b.ws.rows[1, ka.ROW + 3 : ka.ROW + 6] @ Jp, b.ws.rows[1, ka.DIRECTION + 3 : ka.DIRECTION + 6] @ Jp
    target[1] = b.ws.rows[1, ka.TARGET]
    for r in (2, 3):
        first, second = (int(k) for k in rng.permutation(n)[:2])
        d, anchor = random_unit(rng), rng.normal(size=3)
        wrench = np.concatenate([np.cross(anchor, d), d])
        b.ws.rows[r, ka.ROW : ka.ROW + 6] = wrench
        b.ws.rows[r, ka.DIRECTION : ka.DIRECTION + 6] = wrench
        b.ws.rows[r, ka.TARGET] = target[r] = rng.normal()
        b.ws.active[r] = 0
        b.ws.active[r, [ka.ROW_KIND, ka.BODY_A, ka.BODY_B]] = ka.BODY_ROW, first, second
        for body, sign in ((first, 1.0), (second, -1.0)):
            position, R = b.ws.links[body, ka.P : ka.P + 3], b.ws.links[body, ka.R : ka.R + 9].reshape(3, 3)
            J[r] += sign * d @ oracle.point(body, R.T @ (anchor - position), q, v)[1]
        F[r] = J[r]
    assume(np.linalg.svd(J)[1][-1] > 1e-2)
    b.ws.counts[ka.ROWS] = 4
    vdot = b.part(b.derivative(y), "v")
    M, tau = free_motion(b, oracle, q, v, current)
    A = J @ np.linalg.solve(M, F.T)
    assume(np.linalg.cond(A) < 1e6)
    expected, force, scale = saddle(M, tau, J, F, target)
    np.testing.assert_allclose(vdot, expected, rtol=0, atol=scale)
    np.testing.assert_allclose(b.ws.rows[:4, ka.FORCE], force, rtol=0, atol=scale)


def known(file: str) -> Path:
    """A file of the package example-robot-data."""
    return next(Path(str(f.locate())) for f in files("example-robot-data") or () if f.name == file)


@pytest.mark.parametrize(("file", "couplings"), [("panda.urdf", 1), ("talos_full_v2.urdf", 12)])
@pytest.mark.parametrize("m_star", [False, True])
def test_mimic_joints_move_as_those_of_the_reduced_system(file, couplings, m_star):
    """With v = G w, G from the followers' multipliers: Gᵀ M G ẇ = Gᵀ (tau − bias), M and bias those of Pinocchio."""
    robot = read_urdf(known(file))
    assert len(robot.couplings) == couplings
    b = assemble(robot, m_star=m_star)
    model = pin.buildModelFromUrdf(str(known(file)))
    data = model.createData()
    n = len(robot.links)
    order = [model.joints[model.getJointId(name)].idx_v for name in robot.joint_names]
    index = {name: i for i, name in enumerate(robot.joint_names)}
    rng = np.random.default_rng(3)
    followers = {coupling.joint for coupling in robot.couplings}
    leaders = [name for name in robot.joint_names if name not in followers]
    G = np.array([robot.configuration({name: 1.0}) - robot.configuration({}) for name in leaders]).T
    for _ in range(3):
        q = robot.configuration({name: float(rng.uniform(-1, 1)) for name in leaders})
        v = G @ rng.normal(size=len(leaders))
        q_theirs, v_theirs = np.zeros((2, n))
        q_theirs[order], v_theirs[order] = q, v
        q_theirs = pin.integrate(model, pin.neutral(model), q_theirs)
        M = pin.crba(model, data, q_theirs)
        M = (np.triu(M) + np.triu(M, 1).T)[np.ix_(order, order)]
        bias = pin.nonLinearEffects(model, data, q_theirs, v_theirs)[order]
        damping = b.system.model.body[:, ka.DAMPING]
        expected = G @ np.linalg.solve(G.T @ M @ G, G.T @ (-damping * v - bias))
        vdot = b.part(b.derivative(b.state(q, v)), "v")
        np.testing.assert_allclose(vdot, expected, rtol=0, atol=1e-9 * (1.0 + np.abs(expected).max()))
        for coupling in robot.couplings:
            follower, leader = vdot[index[coupling.joint]], vdot[index[coupling.leader]]
            assert follower == pytest.approx(coupling.ratio * leader, abs=1e-9 * (1.0 + np.abs(expected).max()))


def test_an_open_contact_is_seen_and_carries_nothing():
    """OPEN: no row, no force, the free motion; the geometry is still there."""
    rng, robot, q, v, current = random_case(4)
    contacts: list[Contact] = random_contacts(rng, robot, q, 2)
    b, free = assemble(robot, contacts), assemble(robot)
    y = b.state(q, v, current)
    stick(b, y, ka.OPEN, ka.OPEN)
    b.ws.contacts[:] = 0.0
    vdot = b.part(b.derivative(y), "v")
    np.testing.assert_array_equal(vdot, free.part(free.derivative(free.state(q, v, current)), "v"))
    assert b.ws.counts[ka.ROWS] == 0
    np.testing.assert_array_equal(b.ws.contacts[:, ka.NORMAL_FORCE], 0.0)
    assert np.abs(b.ws.contacts[:, ka.GAP]).max() < 1e-12
    np.testing.assert_allclose(np.linalg.norm(b.ws.contacts[:, ka.NORMAL : ka.NORMAL + 3], axis=1), 1.0, rtol=1e-14)
