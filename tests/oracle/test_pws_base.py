"""The mobile base against one with real wheels, side slip and rolling as multipliers, in Pinocchio (real_wheels.py)."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline, make_interp_spline
from support.random_robots import CompiledSystem, assemble, random_contacts
from support.real_wheels import MOTOR, WHEELS, RealWheels, random_base, random_serial, random_urdf

from dynsim.compile.model import Model
from dynsim.dynamics import tables as ka
from dynsim.engine import simulate
from dynsim.model.description import Robot
from dynsim.scenario import load_scenario
from dynsim.scenario.build import robot as build_robot

seeds = st.integers(0, 2**32 - 1)
arms = pytest.mark.parametrize("arm", ["serial", "urdf"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pws")


def case(seed: int, arm: str, folder: Path) -> tuple[Robot, RealWheels, np.ndarray, np.ndarray, np.ndarray]:
    """A random mobile arm from a scenario, with its motors mounted, its oracle, coordinates, rates and currents."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 8))
    plant: dict[str, Any] = {"type": "pws_arm", "base": random_base(rng)}
    plant["arm"] = random_serial(rng, n) if arm == "serial" else random_urdf(rng, n, folder / "arm.urdf")
    file = folder / "case.yaml"
    # JSON is YAML.
    file.write_text(json.dumps({"duration_s": 1.0, "plant": plant}))
    robot, oracle = build_robot(load_scenario(file)).with_motors_mounted(), RealWheels(plant)
    assert robot.joint_names == oracle.joints
    q, v = rng.normal(size=robot.nq), rng.normal(size=len(robot.links))
    return robot, oracle, q, v, rng.normal(scale=3.0, size=robot.circuits)


def torques(robot: Robot, oracle: RealWheels, current: np.ndarray) -> np.ndarray:
    """K k i of all motors, at the rates of the oracle."""
    tau = np.zeros(oracle.model.nv)
    for motor, i in zip(robot.motors, current, strict=True):
        tau[oracle.index[robot.joint_names.index(motor.joint)]] = motor.torque_constant * motor.gear_ratio * i
    return tau


@arms
@given(seed=seeds)
def test_accelerations(arm, folder, seed):
    """Of wheels and arm, driven by the currents of their motors; both solvers."""
    robot, oracle, q, v, current = case(seed, arm, folder)
    full, rates = oracle.configuration(q), oracle.rates(q, v)
    A, _ = oracle.rows(full, rates)
    # The rates are those of a base that rolls, and the oracle's accelerations keep it so.
    np.testing.assert_allclose(A @ rates, 0.0, rtol=0, atol=1e-13)
    expected, _, K = oracle.accelerations(full, rates, torques(robot, oracle, current))
    expected, condition = expected[oracle.index], np.linalg.cond(K)
    accelerations: list[np.ndarray] = []
    for m_star in (False, True):
        b: CompiledSystem = assemble(robot, m_star=m_star)
        accelerations.append(b.part(b.derivative(b.state(q, v, current)), "v"))
        np.testing.assert_allclose(accelerations[-1], expected, rtol=0, atol=1e-9 * (1.0 + np.abs(expected).max()))
        # As near as the dense system that the expected values come from can be solved.
        np.testing.assert_allclose(
            accelerations[-1], expected, rtol=0, atol=1e-14 * condition * (1.0 + np.abs(expected).max())
        )
    np.testing.assert_allclose(accelerations[0], accelerations[1], rtol=0, atol=1e-10 * (1.0 + np.abs(expected).max()))


@pytest.mark.parametrize("m_star", [False, True], ids=["articulated", "m_star"])
@arms
@given(seed=seeds)
def test_braced_on_surfaces(arm, m_star, folder, seed):
    """One or two points of base or arm held to curved surfaces, so that what braces the arm reacts on the wheels."""
    robot, oracle, q, v, current = case(seed, arm, folder)
    rng = np.random.default_rng(seed + 2)
    contacts = [replace(contact, friction=0.0) for contact in random_contacts(rng, robot, q, int(rng.integers(1, 3)))]
    full, rates = oracle.configuration(q), oracle.rates(q, v)
    T = np.column_stack([oracle.rates(q, unit) for unit in np.eye(len(v))])
    J, target = np.zeros((len(contacts), oracle.model.nv)), np.zeros(len(contacts))
    model, joints = Model(robot), {link.name: link.joint for link in robot.links} | {"base": "heading"}
    for k, contact in enumerate(contacts):
        position = model.point_position(contact.body, contact.point, q)
        Jp, velocity, drift = oracle.point(joints[contact.body], contact.point, full, rates)
        gradient = contact.surface.Q @ position + contact.surface.b
        slope = np.linalg.norm(gradient)
        J[k] = gradient / slope @ Jp
        target[k] = -(gradient @ drift + velocity @ contact.surface.Q @ velocity) / slope
    # Rows that depend on each other, or feel no joint, have no single solution.
    if np.linalg.svd(J @ T)[1].min() < 1e-3:
        return
    expected, multipliers, K = oracle.accelerations(full, rates, torques(robot, oracle, current), J, target)
    b = assemble(robot, contacts, m_star=m_star)
    vdot = b.part(b.derivative(b.state(q, v, current)), "v")
    scale = 1e-14 * np.linalg.cond(K) * (1.0 + max(np.abs(expected).max(), np.abs(multipliers).max()))
    np.testing.assert_allclose(vdot, expected[oracle.index], rtol=0, atol=scale)
    np.testing.assert_allclose(b.ws.contacts[:, ka.FORCE], multipliers[3:], rtol=0, atol=scale)


@arms
@given(seed=seeds)
def test_torques_of_the_motors(arm, folder, seed):
    """What wheels and joints need for given accelerations, rotors and losses paid."""
    robot, oracle, q, v, _ = case(seed, arm, folder)
    model = Model(robot)
    vdot = np.random.default_rng(seed + 1).normal(size=model.n)
    expected = oracle.forces(oracle.configuration(q), oracle.rates(q, v), vdot)
    ours = model.inverse_dynamics(q, v, vdot) + model.armature * vdot + model.damping * v
    np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-9 * (1.0 + np.abs(expected).max()))


@arms
@given(seed=seeds)
def test_mass_matrix_and_energy(arm, folder, seed):
    """Of the rates of wheels and arm: Tᵀ M T of the real wheels, v = T v_wheels."""
    robot, oracle, q, v, _ = case(seed, arm, folder)
    model, full = Model(robot), oracle.configuration(q)
    T = np.column_stack([oracle.rates(q, unit) for unit in np.eye(model.n)])
    expected = T.T @ oracle.mass_matrix(full) @ T
    ours = model.mass_matrix(q) + np.diag(model.armature)
    np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    b = assemble(robot)
    assert b.system.model.body[:2, ka.ARMATURE].min() > 0.0
    kinetic = model.kinetic_energy(q, v) + 0.5 * model.armature @ v**2
    rates = oracle.rates(q, v)
    assert kinetic == pytest.approx(0.5 * rates @ oracle.mass_matrix(full) @ rates, rel=1e-12)


@arms
@given(seed=seeds)
def test_points_and_their_rates(arm, folder, seed):
    """Places of points on every body, their Jacobians against those of the oracle and against differences of places."""
    robot, oracle, q, v, _ = case(seed, arm, folder)
    model, full = Model(robot), oracle.configuration(q)
    point, h = np.random.default_rng(seed).normal(size=3), 1e-5
    T = np.column_stack([oracle.rates(q, unit) for unit in np.eye(model.n)])
    b = assemble(robot)
    qdot = b.part(b.derivative(b.state(q, v)), "q")
    joints = {"base": "heading"} | {link.name: link.joint for link in robot.links[2:]}
    for name, joint in joints.items():
        J, velocity, _ = oracle.point(joint, point, full, oracle.rates(q, v))
        placement = oracle.data.oMi[oracle.model.getJointId(joint)]
        position, ours = model.point_position_and_jacobian(name, point, q)
        np.testing.assert_allclose(position, placement.act(point), rtol=0, atol=1e-12)
        np.testing.assert_allclose(ours, J @ T, rtol=0, atol=1e-12)
        np.testing.assert_allclose(ours @ v, velocity, rtol=0, atol=1e-11)
        ends = [model.point_position(name, point, q + sign * h * qdot) for sign in (1.0, -1.0)]
        np.testing.assert_allclose((ends[0] - ends[1]) / (2.0 * h), ours @ v, rtol=0, atol=1e-6)


# ---- runs

# A base of 4 kg whose mass is off the axle and off its middle, with an arm on it that reaches over its side.
PLANT: dict[str, Any] = {
    "type": "pws_arm",
    "base": {
        "position_m": [0.4, -0.3],
        "heading_deg": 35.0,
        "mass_kg": 4.0,
        "com_m": [0.05, 0.02, 0.08],
        "inertia_kg_m2": [0.03, 0.002, -0.004, 0.05, 0.003, 0.06],
        "wheel": {"mass_kg": 0.25, "radius_m": 0.05, "damping_N_m_s_per_rad": 0.05},
        "track_m": 0.3,
        "mount": {"position_m": [0.02, 0.01, 0.12], "yaw_deg": 20.0},
    },
    "arm": {
        "type": "serial_arm",
        # The floor is not quite level.
        "gravity_m_s2": [0.3, -0.2, -9.8],
        "link": {"mass_kg": 0.4, "length_m": 0.3, "radius_m": 0.02, "damping_N_m_s_per_rad": 0.1, "motor": MOTOR},
        "chain": [{"axis": "z", "length_m": 0.1}, {"axis": "y"}, {"axis": "y"}, {"axis": [0.6, 0.0, 0.8]}],
        "initial_deg": [0.0, 30.0, 60.0, -20.0],
    },
}
TURNS = {
    "joint_1": ([0, 2, 5, 8], [0, 70, -50, 20]),
    "joint_2": ([0, 3, 6, 9], [30, 70, 10, 40]),
    "joint_4": ([0, 1, 4, 7], [-20, 60, -60, 0]),
}
ROLLS = {"base.left": ([0, 3, 7, 10], [0, 200, 500, 350]), "base.right": ([0, 3, 7, 10], [0, 420, 180, 500])}
PUSHES = {"base.left": ([0, 2, 4, 7], [0, 0.5, -0.6, 0.3]), "base.right": ([0, 1, 4, 8], [0, 0.7, 0.2, -0.5])}
K_P, K_D, SPACING = 60.0, 3.0, 0.02


def scenario_of(drive: str, duration: float) -> dict[str, Any]:
    """Wheels on motors that follow angles, or on torques."""
    motor = MOTOR if drive == "voltage" else {"type": "torque"}
    plant = {**PLANT, "base": {**PLANT["base"], "wheel": {**PLANT["base"]["wheel"], "motor": motor}}}
    turned = TURNS | (ROLLS if drive == "voltage" else {})
    controller: dict[str, Any] = {
        "type": "joint_pd",
        "k_p_V_per_rad": K_P,
        "k_d_V_s_per_rad": K_D,
        "knot_spacing_s": SPACING,
        "joints": {name: {"times_s": t, "angles_deg": a} for name, (t, a) in turned.items()},
    }
    if drive == "torque":
        controller["torques"] = {name: {"times_s": t, "torques_N_m": a} for name, (t, a) in PUSHES.items()}
    return {
        "duration_s": duration,
        "plant": plant,
        "controller": controller,
        "integrator": {"method": "dopri5", "rtol": 1e-12, "atol": 1e-13},
        "record": {"rate_hz": 10},
    }


class Driven:
    """The oracle under the controller of a scenario, as an ordinary differential equation written apart.

    State: coordinates, rates, and the current of every DC motor. References are quintic splines through samples of the
    clamped cubic ones that the scenario names (docs/scenarios/control.md).
    """

    def __init__(self, scenario: dict[str, Any], q: np.ndarray) -> None:
        self.oracle = RealWheels(scenario["plant"])
        self.controller, self.duration = scenario["controller"], scenario["duration_s"]
        nv = self.oracle.model.nv
        self.joints = [name for name in self.oracle.joints if self.oracle.motor[name]["type"] == "dc"]
        self.index = self.oracle.index[[self.oracle.joints.index(name) for name in self.joints]]
        start = self.oracle.configuration(q)
        self.start = np.concatenate([start, np.zeros(nv + len(self.joints))])
        grid = np.linspace(0.0, self.duration, max(int(np.ceil(self.duration / SPACING)), 6) + 1)

        def through(times: list[float], values: Any) -> np.ndarray:
            return CubicSpline(times, values, bc_type="clamped")(np.clip(grid, times[0], times[-1]))

        angles, torques = self.controller["joints"], self.controller.get("torques", {})
        columns = [
            through(angles[name]["times_s"], np.deg2rad(angles[name]["angles_deg"]))
            if name in angles
            else np.full(len(grid), start[i])
            for name, i in zip(self.joints, self.index, strict=True)
        ]
        columns += [through(command["times_s"], command["torques_N_m"]) for command in torques.values()]
        self.pushed = self.oracle.index[[WHEELS.index(name) for name in torques]]
        self.wanted = make_interp_spline(grid, np.stack(columns, axis=1), k=5)
        self.slope = self.wanted.derivative()
        of = [self.oracle.motor[name] for name in self.joints]
        self.R, self.L = (np.array([motor[key] for motor in of]) for key in ("resistance_ohm", "inductance_H"))
        self.K = np.array([motor["torque_constant_N_m_per_A"] * motor["gear_ratio"] for motor in of])

    def __call__(self, t: float, y: np.ndarray) -> np.ndarray:
        nv = self.oracle.model.nv
        q, v, i = y[:nv], y[nv : 2 * nv], y[2 * nv :]
        count, wanted = len(i), self.wanted(t)
        u = K_P * (wanted[:count] - q[self.index]) + K_D * (self.slope(t)[:count] - v[self.index])
        tau = np.zeros(nv)
        tau[self.index], tau[self.pushed] = self.K * i, wanted[count:]
        vdot, _, _ = self.oracle.accelerations(q, v, tau)
        return np.concatenate([v, vdot, (u - self.R * i - self.K * v[self.index]) / self.L])


@pytest.mark.long
@pytest.mark.parametrize("drive", ["voltage", "torque"])
@pytest.mark.parametrize("duration", [0.25, pytest.param(10.0, marks=pytest.mark.slow)])
def test_a_run_is_that_of_real_wheels(drive, duration, tmp_path):
    """Base, arm and currents to 1e-8 over 10 s, both at rtol 1e-12, by another method and another formulation."""
    scenario = scenario_of(drive, duration)
    (tmp_path / "case.yaml").write_text(json.dumps(scenario))
    record = simulate(load_scenario(tmp_path / "case.yaml"))
    driven = Driven(scenario, record["q"][0])
    expected = solve_ivp(
        driven, (0.0, duration), driven.start, "DOP853", t_eval=record.time, rtol=1e-12, atol=1e-13
    ).y.T
    nv, index = driven.oracle.model.nv, driven.oracle.index
    pose = [driven.oracle.x, driven.oracle.y, driven.oracle.heading]
    np.testing.assert_allclose(record["base_pose"], expected[:, pose], rtol=0, atol=1e-8)
    np.testing.assert_allclose(record["q"][:, [0, 1, *range(4, 8)]], expected[:, index], rtol=0, atol=1e-8)
    np.testing.assert_allclose(record["v"], expected[:, nv + index], rtol=0, atol=1e-8)
    np.testing.assert_allclose(record["current"][:, -len(driven.joints) :], expected[:, 2 * nv :], rtol=0, atol=1e-7)
    # It went somewhere.
    assert np.ptp(record["base_pose"], axis=0).min() > (0.1 if duration == 10.0 else 1e-4)
