"""Every intermediate against Pinocchio, an independent code, on random trees."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from hypothesis import assume, given
from hypothesis import strategies as st
from random_robots import bench, random_contacts, random_robot

from dynsim.kernels import arrays as ka
from dynsim.model.description import Robot
from dynsim.model.model import Model

seeds = st.integers(0, 2**32 - 1)


class Oracle:
    """A robot in Pinocchio, with its joints in depth-first order (which Pinocchio's algorithms assume)."""

    def __init__(self, robot: Robot) -> None:
        self.model = pin.Model()
        self.model.gravity = pin.Motion(robot.gravity, np.zeros(3))
        index = {None: 0}
        self.order: list[int] = []
        names = [link.name for link in robot.links]
        kinds = {"prismatic": pin.JointModelPrismaticUnaligned, "revolute": pin.JointModelRevoluteUnaligned}

        def add(parent: str | None) -> None:
            for link in robot.links:
                if link.parent == parent:
                    kind = kinds[link.kind](link.axis)
                    joint = self.model.addJoint(index[parent], kind, pin.SE3(link.R_PJ, link.p_PJ), link.joint)
                    body = pin.Inertia(link.inertia.mass, link.inertia.com, link.inertia.tensor)
                    self.model.appendBodyToJoint(joint, body, pin.SE3.Identity())
                    index[link.name] = joint
                    self.order.append(names.index(link.name))
                    add(link.name)

        add(None)
        self.joint = [index[name] for name in names]
        self.data = self.model.createData()

    def to(self, x: np.ndarray) -> np.ndarray:
        """Joint vector of dynsim in Pinocchio's order."""
        return x[self.order]

    def back(self, x: np.ndarray) -> np.ndarray:
        """Joint vector of Pinocchio in dynsim's order, along the last axis."""
        out = np.empty_like(x)
        out[..., self.order] = x
        return out

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        M = pin.crba(self.model, self.data, self.to(q))
        M = np.triu(M) + np.triu(M, 1).T
        return self.back(self.back(M).T)

    def point(self, body: int, point: np.ndarray, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
        """Position, Jacobian (3, n), velocity and drift acceleration of a body-fixed point."""
        pin.forwardKinematics(self.model, self.data, self.to(q), self.to(v), np.zeros(len(q)))
        pin.computeJointJacobians(self.model, self.data, self.to(q))
        M, j = self.data.oMi[self.joint[body]], self.joint[body]
        arm = M.rotation @ point
        J6 = pin.getJointJacobian(self.model, self.data, j, pin.LOCAL_WORLD_ALIGNED).reshape(6, -1)
        J = J6[:3] - pin.skew(arm) @ J6[3:]
        velocity = pin.getVelocity(self.model, self.data, j, pin.LOCAL_WORLD_ALIGNED)
        acceleration = pin.getClassicalAcceleration(self.model, self.data, j, pin.LOCAL_WORLD_ALIGNED)
        w = velocity.angular
        drift = acceleration.linear + np.cross(acceleration.angular, arm) + np.cross(w, np.cross(w, arm))
        return M.translation + arm, self.back(J), velocity.linear + np.cross(w, arm), drift


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
    b = bench(robot, contacts)
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
    np.testing.assert_allclose(b.ws.contacts[:, ka.FORCE], x[n:], rtol=0, atol=scale)
