"""Joints with several rows against Pinocchio's spherical, free-flyer and planar joints, on random trees.

Pinocchio's free flyer and planar joint have their rates in the axes of the body, dynsim's translations in those of the
joint's frame: v_P = T(q) v, v̇_P = T v̇ + Ṫ v, so M = Tᵀ M_P T and tau = Tᵀ tau_P. Pinocchio has no rolling base; here it
is two sliding joints and a turning one with the rolling condition as a constraint, eliminated with its multiplier.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.random_robots import assemble, random_contacts, random_positions, random_robot_of

from dynsim.compile.model import Model
from dynsim.dynamics import tables as ka
from dynsim.model.description import Link, Robot

seeds = st.integers(0, 2**32 - 1)
HOLONOMIC = ("revolute", "prismatic", "ball", "floating", "planar")
# All tolerances here: rounding of two codes that do some hundred operations per link in different order.
ROUNDING = 1e-12


def kinds_of(rng: np.random.Generator, rolling: bool) -> list[str]:
    """Up to seven joints; half of the trees begin with a joint that a mobile robot has."""
    kinds = [str(kind) for kind in rng.choice(HOLONOMIC, size=rng.integers(1, 8))]
    if rolling:
        kinds[rng.integers(len(kinds))] = "rolling"
    elif rng.random() < 0.5:
        kinds[0] = "floating"
    return kinds


class Oracle:
    """A robot in Pinocchio at one state: coordinates q, and the transformation of the rates."""

    def __init__(self, robot: Robot, q: np.ndarray, v: np.ndarray) -> None:
        self.robot, self.model = robot, pin.Model()
        self.model.gravity = pin.Motion(robot.gravity, np.zeros(3))
        self.joints: dict[str, list[int]] = {}
        for i, link in enumerate(robot.links):
            self.joints.setdefault(link.joint_of_rows or link.joint, []).append(i)
        # Pinocchio's joint, and dynsim's body in the frame of that joint.
        self.places: dict[str | None, tuple[int, pin.SE3]] = {None: (0, pin.SE3.Identity())}
        self.kinds: dict[str, str] = {}
        self.add(None)
        self.data = self.model.createData()
        n = len(robot.links)
        self.q, self.v = pin.neutral(self.model), np.zeros(self.model.nv)
        self.T, self.bias_rate = np.zeros((self.model.nv, n)), np.zeros(self.model.nv)
        # Rolling: rows A v_P = 0, A v̇_P = drift.
        rows, drifts = [], []
        for name, group in self.joints.items():
            k, x = robot.position_index[group[0]], v[group]
            own = [self.model.joints[self.model.getJointId(j)] for j in self.model.names if j.split("/")[0] == name]
            iq, iv, kind = own[0].idx_q, own[0].idx_v, self.kinds[name]
            if kind in ("ball", "floating"):
                first = 3 if kind == "floating" else 0
                w, a, b, c = q[k + first : k + first + 4]
                self.q[iq : iq + first] = q[k : k + first]
                self.q[iq + first : iq + first + 4] = a, b, c, w
                self.T[iv + first : iv + first + 3, group[first:]] = np.eye(3)
                if first:
                    R = pin.Quaternion(w, a, b, c).matrix()
                    self.T[iv : iv + 3, group[:3]] = R.T
                    self.bias_rate[iv : iv + 3] = -np.cross(x[3:], R.T @ x[:3])
            elif kind == "planar":
                c, s = np.cos(q[k + 2]), np.sin(q[k + 2])
                self.q[iq : iq + 4] = q[k], q[k + 1], c, s
                turn = np.array([[c, s], [-s, c]])
                self.T[iv : iv + 2, group[:2]], self.T[iv + 2, group[2]] = turn, 1.0
                self.bias_rate[iv : iv + 2] = x[2] * np.array([[-s, c], [-c, -s]]) @ x[:2]
            elif kind == "rolling":
                c, s = np.cos(q[k + 2]), np.sin(q[k + 2])
                self.q[iq : iq + 3] = q[k : k + 3]
                self.T[iv : iv + 2, group[0]], self.T[iv + 2, group[1]] = (c, s), 1.0
                self.bias_rate[iv : iv + 2] = x[0] * x[1] * np.array([-s, c])
                row = np.zeros(self.model.nv)
                row[iv : iv + 2] = -s, c
                rows.append(row)
                drifts.append(x[0] * x[1])
            else:
                self.q[iq], self.T[iv, group[0]] = q[k], 1.0
        self.A, self.drift = np.array(rows).reshape(len(rows), self.model.nv), np.array(drifts)
        self.v = self.T @ v

    def add(self, parent: str | None) -> None:
        """The joints on a body, each followed by what it carries: Pinocchio's algorithms assume this order."""
        links = self.robot.links
        for name, group in self.joints.items():
            first, last = links[group[0]], links[group[-1]]
            if first.parent != parent:
                continue
            kind = {"ball_x": "ball", "roll": "rolling"}.get(first.kind, first.kind)
            if first.joint_of_rows and kind == "prismatic":
                kind = "floating" if len(group) == 6 else "planar"
            self.kinds[name] = kind
            above, offset = self.places[parent]
            at = offset * pin.SE3(first.R_PJ, first.p_PJ)
            inside = pin.SE3.Identity()
            if kind == "planar":
                # Its plane is that of x and y.
                axes = pin.SE3(np.stack([links[i].axis for i in group], axis=1), np.zeros(3))
                at, inside = at * axes, axes.inverse()
            for suffix, model in self.joint_models(kind, first):
                above = self.model.addJoint(above, model, at, name + suffix)
                at = pin.SE3.Identity()
            body = pin.Inertia(last.inertia.mass, last.inertia.com, last.inertia.tensor)
            self.model.appendBodyToJoint(above, body, inside)
            self.places[last.name] = above, inside
            self.add(last.name)

    @staticmethod
    def joint_models(kind: str, link: Link) -> list[tuple[str, object]]:
        if kind == "rolling":
            return [("/x", pin.JointModelPX()), ("/y", pin.JointModelPY()), ("/turn", pin.JointModelRZ())]
        single = {"revolute": pin.JointModelRevoluteUnaligned, "prismatic": pin.JointModelPrismaticUnaligned}
        several = {"ball": pin.JointModelSpherical, "floating": pin.JointModelFreeFlyer, "planar": pin.JointModelPlanar}
        return [("", single[kind](link.axis) if kind in single else several[kind]())]

    def mass_matrix(self) -> np.ndarray:
        """Of Pinocchio's rates."""
        M = pin.crba(self.model, self.data, self.q)
        return np.triu(M) + np.triu(M, 1).T

    def inverse_dynamics(self, vdot: np.ndarray) -> np.ndarray:
        return self.T.T @ pin.rnea(self.model, self.data, self.q, self.v, self.T @ vdot + self.bias_rate)

    def accelerations(self, tau: np.ndarray, J: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, float]:
        """v̇, and forces of rows J v̇_P = target, with the rolling condition as further rows; condition of the system.

        tau: forces on dynsim's rates; some force on Pinocchio's that does the same work.
        """
        rows = np.vstack([J, self.A])
        m, p = self.model.nv, len(rows)
        K = np.block([[self.mass_matrix(), -rows.T], [rows, np.zeros((p, p))]])
        bias = pin.nonLinearEffects(self.model, self.data, self.q, self.v)
        force = np.linalg.pinv(self.T.T) @ tau
        # The rolling condition: −s ẍ + c ÿ = (c ẋ + s ẏ) ω.
        x = np.linalg.solve(K, np.concatenate([force - bias, target, self.drift]))
        vdot = np.linalg.pinv(self.T) @ (x[:m] - self.bias_rate)
        return np.concatenate([vdot, x[m : m + len(J)]]), float(np.linalg.cond(K))

    def point(self, body: str, point: np.ndarray) -> tuple[np.ndarray, ...]:
        """Position, Jacobian to Pinocchio's rates (3, nv), velocity and drift acceleration of a body-fixed point."""
        j, inside = self.places[body]
        pin.forwardKinematics(self.model, self.data, self.q, self.v, np.zeros(self.model.nv))
        pin.computeJointJacobians(self.model, self.data, self.q)
        M = self.data.oMi[j]
        arm = M.rotation @ inside.act(point)
        J6 = pin.getJointJacobian(self.model, self.data, j, pin.LOCAL_WORLD_ALIGNED).reshape(6, -1)
        J = J6[:3] - pin.skew(arm) @ J6[3:]
        velocity = pin.getVelocity(self.model, self.data, j, pin.LOCAL_WORLD_ALIGNED)
        acceleration = pin.getClassicalAcceleration(self.model, self.data, j, pin.LOCAL_WORLD_ALIGNED)
        w = velocity.angular
        drift = acceleration.linear + np.cross(acceleration.angular, arm) + np.cross(w, np.cross(w, arm))
        return M.translation + arm, J, velocity.linear + np.cross(w, arm), drift


def case(seed: int, rolling: bool) -> tuple[np.random.Generator, Robot, Oracle, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    robot = random_robot_of(rng, kinds_of(rng, rolling))
    q, v = random_positions(rng, robot), rng.normal(size=len(robot.links))
    return rng, robot, Oracle(robot, q, v), q, v


both = pytest.mark.parametrize("rolling", [False, True], ids=["holonomic", "rolling"])


@both
@given(seeds)
def test_poses_and_jacobians_of_points(rolling, seed):
    rng, robot, oracle, q, v = case(seed, rolling)
    model = Model(robot)
    for link in robot.links:
        if link.inertia.mass > 0.0:
            point = rng.normal(size=3)
            position, J, velocity, _ = oracle.point(link.name, point)
            np.testing.assert_allclose(model.point_position(link.name, point, q), position, rtol=0, atol=ROUNDING * 30)
            ours = model.point_jacobian(link.name, point, q)
            np.testing.assert_allclose(ours, J @ oracle.T, rtol=0, atol=ROUNDING * 30)
            np.testing.assert_allclose(ours @ v, velocity, rtol=0, atol=ROUNDING * 100)


@both
@given(seeds)
def test_mass_matrix_and_energies(rolling, seed):
    _, robot, oracle, q, v = case(seed, rolling)
    model, expected = Model(robot), oracle.T.T @ oracle.mass_matrix() @ oracle.T
    np.testing.assert_allclose(model.mass_matrix(q), expected, rtol=0, atol=ROUNDING * np.abs(expected).max())
    kinetic = pin.computeKineticEnergy(oracle.model, oracle.data, oracle.q, oracle.v)
    potential = pin.computePotentialEnergy(oracle.model, oracle.data, oracle.q)
    np.testing.assert_allclose(model.kinetic_energy(q, v), kinetic, rtol=ROUNDING)
    np.testing.assert_allclose(model.potential_energy(q), potential, rtol=0, atol=1e-11 * (1.0 + abs(potential)))


@both
@given(seeds)
def test_bias_forces_and_inverse_dynamics(rolling, seed):
    rng, robot, oracle, q, v = case(seed, rolling)
    model, vdot = Model(robot), rng.normal(size=len(v))
    for ours, accelerations in ((model.bias_forces(q, v), np.zeros_like(v)), (None, vdot)):
        expected = oracle.inverse_dynamics(accelerations)
        ours = model.inverse_dynamics(q, v, vdot) if ours is None else ours
        np.testing.assert_allclose(ours, expected, rtol=0, atol=ROUNDING * (1.0 + np.abs(expected).max()))


@both
@given(seeds)
def test_forward_dynamics(rolling, seed):
    rng, robot, oracle, q, v = case(seed, rolling)
    model, tau = Model(robot), rng.normal(size=len(v))
    none = np.zeros((0, oracle.model.nv))
    expected, condition = oracle.accelerations(tau, none, np.zeros(0))
    if not rolling:
        force = np.linalg.solve(oracle.T.T, tau)
        aba = pin.aba(oracle.model, oracle.data, oracle.q, oracle.v, force)
        expected = np.linalg.solve(oracle.T, aba - oracle.bias_rate)
    ours = model.forward_dynamics(q, v, tau)
    # Rounding times the condition of the system that the expected values come from.
    np.testing.assert_allclose(ours, expected, rtol=0, atol=3e-14 * condition * (1.0 + np.abs(expected).max()))
    back = model.inverse_dynamics(q, v, ours)
    scale = np.abs(model.mass_matrix(q)).max() * np.abs(ours).max() + np.abs(model.bias_forces(q, v)).max()
    np.testing.assert_allclose(back, tau, rtol=0, atol=ROUNDING * (1.0 + scale))


@pytest.mark.parametrize("m_star", [False, True], ids=["articulated", "m_star"])
@both
@given(seeds)
def test_constrained_dynamics_without_friction(rolling, m_star, seed):
    """Up to three contacts, on curved surfaces too: accelerations and normal forces of both solvers."""
    rng, robot, oracle, q, v = case(seed, rolling)
    contacts = random_contacts(rng, robot, q, int(rng.integers(1, 4)))
    contacts = [type(c)(**{**vars(c), "friction": 0.0}) for c in contacts]
    b = assemble(robot, contacts, m_star=m_star)
    dy = b.derivative(b.state(q, v))
    J, target = np.zeros((len(contacts), oracle.model.nv)), np.zeros(len(contacts))
    for k, contact in enumerate(contacts):
        r, Jp, velocity, drift = oracle.point(contact.body, contact.point)
        gradient = contact.surface.Q @ r + contact.surface.b
        slope = np.linalg.norm(gradient)
        J[k] = gradient / slope @ Jp
        target[k] = -(gradient @ drift + velocity @ contact.surface.Q @ velocity) / slope
    # Rows that depend on each other have no single solution.
    if np.linalg.matrix_rank(J @ oracle.T, tol=1e-3) < len(contacts):
        return
    tau = -b.system.model.body[:, ka.DAMPING] * v
    expected, condition = oracle.accelerations(tau, J, target)
    n, scale = len(v), 1e-14 * condition * (1.0 + np.abs(expected).max())
    np.testing.assert_allclose(b.part(dy, "v"), expected[:n], rtol=0, atol=scale)
    np.testing.assert_allclose(b.ws.contacts[:, ka.FORCE], expected[n:], rtol=0, atol=scale)


@given(seeds)
def test_rates_of_the_coordinates(seed):
    """q̇ = N(q) v: the pose after a short time is that which Pinocchio's integration on the group gives."""
    _, robot, oracle, q, v = case(seed, False)
    b = assemble(robot)
    h = 1e-4

    def pose(rates: float) -> np.ndarray:
        q_after = q + rates * b.part(b.derivative(b.state(q, v)), "q")
        model = Model(robot)
        return np.array([np.column_stack(model.body_pose(i, q_after)) for i in range(model.n)])

    expected = []
    for link in robot.links:
        j, inside = oracle.places.get(link.name, (None, None))
        if j is not None:
            ends = []
            for sign in (1.0, -1.0):
                pin.forwardKinematics(
                    oracle.model, oracle.data, pin.integrate(oracle.model, oracle.q, sign * h * oracle.v)
                )
                ends.append((oracle.data.oMi[j] * inside).homogeneous[:3])
            expected.append((ends[0] - ends[1]) / (2.0 * h))
    bodies = [i for i, link in enumerate(robot.links) if link.name in oracle.places]
    ours = (pose(h) - pose(-h))[bodies] / (2.0 * h)
    # Two central differences of order h², of motions with rates of some 10/s.
    np.testing.assert_allclose(ours, expected, rtol=0, atol=1e4 * h**2)
