"""Poses, Jacobians, mass matrix, forces, energies and accelerations against Pinocchio, on random trees."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from hypothesis import assume, given
from hypothesis import strategies as st
from support.pinocchio_oracle import Oracle
from support.random_robots import assemble, random_contacts, random_robot

from dynsim.compile.model import Model
from dynsim.dynamics import tables as ka
from dynsim.model.description import Robot

seeds = st.integers(0, 2**32 - 1)


def case(seed: int, largest: int = 12) -> tuple[np.random.Generator, Robot, Oracle, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, int(rng.integers(1, largest + 1)))
    n = len(robot.links)
    return rng, robot, Oracle(robot), rng.normal(scale=2.0, size=n), rng.normal(size=n)


# All tolerances here: rounding of two codes that do some hundred operations per link in different order.


@given(seeds)
def test_poses(seed):
    _, robot, oracle, q, v = case(seed)
    model = Model(robot)
    pin.forwardKinematics(oracle.model, oracle.data, oracle.to(q), oracle.to(v))
    for i in range(model.n):
        R, p = model.body_pose(i, q)
        expected = oracle.data.oMi[oracle.joint[i]]
        np.testing.assert_allclose(R, expected.rotation, rtol=0, atol=1e-13)
        np.testing.assert_allclose(p, expected.translation, rtol=0, atol=1e-12)


@given(seeds)
def test_point_positions_and_jacobians(seed):
    rng, robot, oracle, q, v = case(seed)
    model, body, point = Model(robot), int(rng.integers(len(q))), rng.normal(size=3)
    position, J, _, _ = oracle.point(body, point, q, v)
    np.testing.assert_allclose(model.point_position(body, point, q), position, rtol=0, atol=1e-12)
    np.testing.assert_allclose(model.point_jacobian(body, point, q), J, rtol=0, atol=1e-12)


@given(seeds)
def test_mass_matrix(seed):
    _, robot, oracle, q, _ = case(seed)
    expected = oracle.mass_matrix(q)
    np.testing.assert_allclose(
        Model(robot).mass_matrix(q), expected, rtol=0, atol=1e-13 * np.abs(expected).max() * len(q)
    )


@given(seeds)
def test_bias_forces_and_inverse_dynamics(seed):
    rng, robot, oracle, q, v = case(seed)
    model, vdot = Model(robot), rng.normal(size=len(q))
    bias = oracle.back(pin.nonLinearEffects(oracle.model, oracle.data, oracle.to(q), oracle.to(v)))
    tau = oracle.back(pin.rnea(oracle.model, oracle.data, oracle.to(q), oracle.to(v), oracle.to(vdot)))
    np.testing.assert_allclose(model.bias_forces(q, v), bias, rtol=0, atol=1e-12 * (1.0 + np.abs(bias).max()))
    np.testing.assert_allclose(model.inverse_dynamics(q, v, vdot), tau, rtol=0, atol=1e-12 * (1.0 + np.abs(tau).max()))


@given(seeds)
def test_kinetic_and_potential_energy(seed):
    _, robot, oracle, q, v = case(seed)
    model = Model(robot)
    kinetic = pin.computeKineticEnergy(oracle.model, oracle.data, oracle.to(q), oracle.to(v))
    potential = pin.computePotentialEnergy(oracle.model, oracle.data, oracle.to(q))
    np.testing.assert_allclose(model.kinetic_energy(q, v), kinetic, rtol=1e-12)
    np.testing.assert_allclose(model.potential_energy(q), potential, rtol=0, atol=1e-11 * (1.0 + abs(potential)))


@given(seeds)
def test_forward_dynamics(seed):
    rng, robot, oracle, q, v = case(seed)
    tau = rng.normal(size=len(q))
    expected = oracle.back(pin.aba(oracle.model, oracle.data, oracle.to(q), oracle.to(v), oracle.to(tau)))
    condition = np.linalg.cond(oracle.mass_matrix(q))
    scale = 1.0 + np.abs(expected).max()
    # Rounding times the condition of M.
    np.testing.assert_allclose(
        Model(robot).forward_dynamics(q, v, tau), expected, rtol=0, atol=1e-14 * condition * scale
    )


@given(seeds)
def test_constrained_dynamics_without_friction(seed):
    """[M + J_m, −Jᵀ; J, 0] [v̇; f] = [tau − bias; −J̇ v], all blocks from Pinocchio; motors, up to three contacts."""
    rng, robot, oracle, q, v = case(seed)
    n, na = len(q), len(robot.motors)
    contacts = random_contacts(rng, robot, q, int(rng.integers(1, 4)))
    contacts = [type(c)(**{**vars(c), "friction": 0.0}) for c in contacts]
    current = rng.normal(size=na)
    b = assemble(robot, contacts)
    dy = b.derivative(b.state(q, v, current))

    p = len(contacts)
    J, target = np.zeros((p, n)), np.zeros(p)
    for k, contact in enumerate(contacts):
        body = [link.name for link in robot.links].index(contact.body)
        r, Jp, velocity, drift = oracle.point(body, contact.point, q, v)
        gradient = contact.surface.Q @ r + contact.surface.b
        slope = np.linalg.norm(gradient)
        J[k] = gradient / slope @ Jp
        target[k] = -(gradient @ drift + velocity @ contact.surface.Q @ velocity) / slope
    assume(np.linalg.matrix_rank(J, tol=1e-3) == p)
    body_table, motor = b.system.model.body, b.system.drives.motor
    tau = -(body_table[:, ka.DAMPING] + body_table[:, ka.GEAR_DAMPING]) * v
    np.add.at(tau, b.system.drives.table[:, ka.DRIVEN], motor[:, ka.K_M] * current)
    bias = oracle.back(pin.nonLinearEffects(oracle.model, oracle.data, oracle.to(q), oracle.to(v)))
    M = oracle.mass_matrix(q) + np.diag(body_table[:, ka.ARMATURE])
    K = np.block([[M, -J.T], [J, np.zeros((p, p))]])
    x = np.linalg.solve(K, np.concatenate([tau - bias, target]))
    scale = 1e-14 * np.linalg.cond(K) * (1.0 + np.abs(x).max())
    np.testing.assert_allclose(b.part(dy, "v"), x[:n], rtol=0, atol=scale)
    np.testing.assert_allclose(b.ws.contacts[:, ka.NORMAL_FORCE], x[n:], rtol=0, atol=scale)
