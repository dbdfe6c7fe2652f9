"""Kinds of drives: closed forms, limits, the ledger, and linear blocks against complex-step derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from support.messages import lines_with
from support.random_robots import CompiledSystem, assemble

from dynsim import load_scenario, simulate
from dynsim.dynamics import tables as ka
from dynsim.dynamics.drive.law import (
    clipped,
    dc_balance,
    dc_command,
    dc_torque,
    drive_block,
    open_torque,
    segment_of,
    servo_command,
    servo_torque,
    take_commands,
    within_current,
)
from dynsim.dynamics.state import GEAR
from dynsim.model.description import Inertia, Link, Robot, vector
from dynsim.model.drives import Drive, Motor, Servo, TorqueSource

INERTIA = 0.3  # of the wheel and of what turns with it [kg m²]
K_M, R = 1.9, 2.3  # [V s/rad], [Ω]
STEP = 1e-100  # of the complex step, which has no cancellation


def wheel(motor: Drive) -> Robot:
    """A wheel about the vertical, which gravity does not turn, on a motor."""
    tensor = np.diag([INERTIA, INERTIA, INERTIA - getattr(motor, "armature", 0.0)])
    link = Link("wheel", "shaft", None, "revolute", vector(0, 0, 1), Inertia(1.0, tensor=tensor))
    return Robot("wheel", (link,), (motor,), hand=("wheel", vector(0, 0, 0)))


def servo(**keys: float | bool) -> Servo:
    return Servo("shaft", **{"torque_constant": K_M, "resistance": R, "k_p": 40.0, "armature": 0.01, **keys})  # type: ignore[arg-type]


def turned(b: CompiledSystem, times: np.ndarray, q: float = 0.0, v: float = 0.0, method: str = "dopri5"):
    """Angle and rate at times, (T,) each."""
    y = b.state(np.array([q]), np.array([v]))
    run = b.simulate(y, times, method, rtol=1e-11, atol=1e-12)
    return run.states("q")[:, 0], run.states("v")[:, 0]


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
@pytest.mark.parametrize(("k_p", "k_d"), [(40.0, 0.0), (40.0, 3.0), (4.0, 20.0)])
def test_servo_step_response(method, k_p, k_d):
    """I q̈ = K_m/R (k_p (r − q) − (k_d + K_m) q̇) − D_m q̇, under- and overdamped, from rest to r."""
    loss, r, times = 0.2, 0.8, np.linspace(0.0, 3.0, 31)
    b = assemble(wheel(servo(k_p=k_p, k_d=k_d, reflected_damping=loss)), held=np.array([r]))
    square = K_M / R * k_p / INERTIA
    half = 0.5 * (K_M / R * (k_d + K_M) + loss) / INERTIA
    root = np.sqrt(complex(half**2 - square))
    assert (root.imag > 0.0) == (k_d < 10.0)  # both regimes are here
    fast, slow = -half - root, -half + root
    expected = r * (1.0 + (slow * np.exp(fast * times) - fast * np.exp(slow * times)) / (fast - slow)).real
    q, _ = turned(b, times, method=method)
    np.testing.assert_allclose(q, expected, rtol=0, atol=1e-8)


def test_servo_in_velocity_mode_reaches_its_rate_exponentially():
    """I v̇ = K_m k_v/R (v_d − v): back-EMF is compensated. The reference is a line that somebody has rewritten."""
    b = assemble(wheel(servo(k_p=0.0, k_v=5.0, velocity_mode=True)))
    b.system.reference.spline[0] = ka.REWRITTEN
    b.system.drives.input[0, ka.LINE_RATE] = 1.7
    times = np.linspace(0.0, 1.0, 11)
    _, v = turned(b, times)
    np.testing.assert_allclose(v, 1.7 * (1.0 - np.exp(-K_M * 5.0 / R / INERTIA * times)), rtol=0, atol=1e-8)


def test_a_rewritten_reference_is_a_line_in_time():
    """Followed with the lag K_m v_d / k_p, once transients are gone."""
    b = assemble(wheel(servo(k_p=40.0, k_d=3.0)))
    b.system.reference.spline[0] = ka.REWRITTEN
    b.system.drives.input[0, [ka.LINE_START, ka.LINE_RATE, ka.LINE_SINCE]] = 0.4, 0.6, -1.0
    q, v = turned(b, np.array([0.0, 10.0]))
    assert q[-1] == pytest.approx(0.4 + 0.6 * 11.0 - K_M * 0.6 / 40.0, abs=1e-8)
    assert v[-1] == pytest.approx(0.6, abs=1e-8)


def test_servo_at_its_voltage_limit():
    """v = U/K_m (1 − exp(−t K_m²/(R I))) while the target is far."""
    b = assemble(wheel(servo(voltage_limit=5.0)), held=np.array([1e3]))
    times = np.linspace(0.0, 2.0, 11)
    _, v = turned(b, times)
    np.testing.assert_allclose(v, 5.0 / K_M * -np.expm1(-(K_M**2) / R / INERTIA * times), rtol=0, atol=1e-8)


@pytest.mark.parametrize("limit", [{"current_limit": 0.7}, {"torque_limit": 0.7 * K_M}])
def test_servo_at_its_current_limit(limit):
    """q = ½ K_m I/inertia t² while the target is far, with the terminal voltage that drives that current."""
    b = assemble(wheel(servo(**limit)), held=np.array([-1e3]))
    times = np.linspace(0.0, 2.0, 5)
    q, _ = turned(b, times)
    np.testing.assert_allclose(q, -0.5 * K_M * 0.7 / INERTIA * times**2, rtol=0, atol=1e-8)
    b.derivative(b.state(np.zeros(1), np.array([0.3])))
    assert b.ws.motors[0, ka.CURRENT] == pytest.approx(-0.7, abs=1e-15)
    assert b.ws.motors[0, ka.VOLTAGE] == pytest.approx(-0.7 * R + 0.3 * K_M, abs=1e-14)


def test_coulomb_friction_stops_a_servo_that_is_off():
    """I v̇ = −τ_c v/√(v² + v_s²): F(v₀) − F(v) = τ_c t/I with F = √(v² + v_s²) − v_s asinh(v_s/v)."""
    friction, smoothing, v0 = 0.5, 0.05, 2.0
    b = assemble(wheel(servo(coulomb_friction=friction, coulomb_speed=smoothing)))
    b.system.drives.table[0, ka.SERVO_MODE] = ka.OFF

    def left(v: float) -> float:
        return np.hypot(v, smoothing) - smoothing * np.arcsinh(smoothing / v)

    times = np.array([0.0, 0.5, 1.0, 1.2, 1.25, 4.0])
    run = b.simulate(b.state(np.zeros(1), np.array([v0])), times, rtol=1e-11, atol=1e-12)
    v = run.states("v")[:, 0]
    for t, rate in zip(times[:-1], v[:-1], strict=True):
        exact = brentq(lambda x, t=t: left(v0) - left(x) - friction * t / INERTIA, 1e-9, v0 + 1.0, xtol=1e-14)
        assert rate == pytest.approx(exact, abs=1e-8)
    assert abs(v[-1]) < 1e-8
    # What the wheel has lost, the gear has taken.
    gear = run.states("ledger")[:, GEAR]
    np.testing.assert_allclose(gear, 0.5 * INERTIA * (v0**2 - v**2), rtol=0, atol=1e-8)


@pytest.mark.parametrize(("torque", "limit", "acts"), [(0.4, np.inf, 0.4), (-3.0, 1.1, -1.1)])
def test_open_torque(torque, limit, acts):
    """q = ½ τ/I t² with the torque that is asked for, within the limit."""
    b = assemble(wheel(TorqueSource("shaft", limit)), held=np.array([torque]))
    times = np.linspace(0.0, 2.0, 5)
    q, _ = turned(b, times)
    np.testing.assert_allclose(q, 0.5 * acts / INERTIA * times**2, rtol=0, atol=1e-8)


MOTOR = Motor("shaft", 0.21, 1.3, 0.02, 1e-4, 7.0, 1e-3, voltage_limit=20.0)
# Name → motor, position and rate of the joint: one case for each regime.
REGIMES: dict[str, tuple[Drive, float, float]] = {
    "motor": (MOTOR, 0.3, 0.4),
    "motor, voltage limit": (MOTOR, -2.0, 0.4),
    "motor, current limit": (replace(MOTOR, current_limit=0.7), -2.0, 0.4),
    "motor, current limit, not reached": (replace(MOTOR, current_limit=9.0), 0.99, 0.4),
    "servo": (servo(k_d=1.0, coulomb_friction=0.3), 0.9, 0.004),
    "servo, voltage limit": (servo(k_d=1.0, coulomb_friction=0.3, voltage_limit=3.0), 0.2, 0.02),
    "servo, current limit": (servo(coulomb_friction=0.3, current_limit=0.2), 0.2, 0.02),
    "servo, voltage and current limit": (servo(voltage_limit=3.0, current_limit=0.2), 0.2, 0.02),
    "servo, velocity": (servo(k_v=2.0, velocity_mode=True, coulomb_friction=0.3), 0.2, 0.5),
    "servo, velocity, voltage limit": (servo(k_v=9.0, velocity_mode=True, voltage_limit=2.0), 0.2, 3.0),
    "servo, off": (servo(coulomb_friction=0.3, free_drag=0.07), 0.2, 0.01),
    "torque": (TorqueSource("shaft"), 0.2, 0.1),
    "torque, limit": (TorqueSource("shaft", 0.5), 0.2, 0.1),
}


def law(motor: Drive, drives: ka.DriveArrays, q_ref: float, sampled: bool):
    """(q, v, i) → (torque, di/dt) from the source of the kernels; complex numbers pass."""
    table, mode, held = drives.motor, drives.table[0, ka.SERVO_MODE], drives.input[0, ka.COMMAND]

    def dc(q, v, i):
        drop = table[0, ka.RESISTANCE] * table[0, ka.I_MAX]
        asked = held if sampled else dc_command(table, 0, q_ref, 0.0, q, v)
        u = within_current(clipped(asked, table[0, ka.U_MAX]), v, table[0, ka.K_M], drop)
        return dc_torque(table, 0, i), dc_balance(table, 0, u, v, i) / table[0, ka.INDUCTANCE]

    def of_servo(q, v, i):
        asked = held if sampled else servo_command(table, 0, mode, q_ref, 0.0, q, v)
        return servo_torque(table, 0, mode, asked, v), 0.0 * i

    def source(q, v, i):
        return open_torque(table, 0, held if sampled else q_ref) + 0.0 * v, 0.0 * i

    return {Motor: dc, Servo: of_servo, TorqueSource: source}[type(motor)]


@pytest.mark.parametrize("sampled", [False, True])
@pytest.mark.parametrize("name", REGIMES)
def test_linear_blocks_equal_complex_step_derivatives(name, sampled):
    motor, q, v = REGIMES[name]
    b = assemble(wheel(motor), held=np.array([1.0]))
    drives = b.system.drives
    if name == "servo, off":
        drives.table[0, ka.SERVO_MODE] = ka.OFF
    drives.table[0, ka.SAMPLED] = sampled
    drives.input[0, ka.COMMAND] = 0.8
    current = 0.6
    b.derivative(b.state(np.array([q]), np.array([v]), np.full(b.robot.circuits, current)))
    block = np.full(ka.BLOCK_SIZE, np.nan)
    drive_block(drives, b.ws, 0, segment_of(drives, b.system.reference, 0.0, b.ws, 0), block)
    f = law(motor, drives, 1.0, sampled)
    expected = np.zeros((2, 3))
    for k in range(3):
        x = np.array([q, v, current], dtype=complex)
        x[k] += 1j * STEP
        torque, rate = f(*x)
        expected[:, k] = np.imag(torque) / STEP, np.imag(rate) / STEP
    np.testing.assert_allclose(block.reshape(2, 3), expected, rtol=1e-10, atol=1e-12)
    # The source is that of the compiled kernel too: same torque, same rate of current.
    torque, rate = f(q, v, current)
    loss = getattr(motor, "reflected_damping", 0.0) * v
    assert b.ws.joints[0, ka.APPLIED] == pytest.approx(torque - loss, rel=1e-13)
    assert b.ws.motors[0, ka.DIDT] == pytest.approx(rate, rel=1e-13)


@pytest.mark.parametrize("name", ["motor", "servo", "torque"])
def test_a_sampled_command_is_held_between_ticks(name):
    """Taken at one state, it acts at all others; away from it the continuous law differs."""
    motor, q, v = REGIMES[name]
    b = assemble(wheel(motor), held=np.array([1.0]))
    at, away = b.state(np.array([q]), np.array([v])), b.state(np.array([q + 0.1]), np.array([v]))
    b.derivative(at)
    continuous = b.ws.motors[0, ka.VOLTAGE], b.ws.motors[0, ka.CURRENT]
    take_commands(b.system.drives, b.system.reference, 0.0, b.ws)
    assert b.system.drives.input[0, ka.COMMAND] == 0.0  # not a sampled one
    b.system.drives.table[0, ka.SAMPLED] = 1
    take_commands(b.system.drives, b.system.reference, 0.0, b.ws)
    for y in (at, away):
        b.derivative(y)
        assert (b.ws.motors[0, ka.VOLTAGE], b.ws.motors[0, ka.CURRENT]) == pytest.approx(continuous, rel=1e-13)
    b.system.drives.table[0, ka.SAMPLED] = 0
    b.derivative(away)
    differs = (b.ws.motors[0, ka.VOLTAGE], b.ws.motors[0, ka.CURRENT]) != pytest.approx(continuous, rel=1e-6)
    assert differs == (name != "torque")


SCENARIO = """
duration_s: 1.5
plant:
  type: serial_arm
  link: {mass_kg: 0.4, length_m: 0.3}
  chain:
    - {axis: y, initial_deg: 40, motor: {type: wang_minami, voltage_limit_V: 30}}
    - axis: y
      initial_deg: -30
      motor: {type: servo, voltage_V: 12, stall_torque_N_m: 8.4, no_load_speed_rad_per_s: 4.7, k_p_V_per_rad: 60,
        current_limit_A: 1.5, coulomb_friction_N_m: 0.2, coulomb_speed_rad_per_s: 0.05,
        gear_damping_N_m_s_per_rad: 0.1, rotor_inertia_kg_m2: 0.01}
    - {axis: x, initial_deg: 10, motor: {type: torque, limit_N_m: 0.5}}
controller:
  type: joint_pd
  k_p_V_per_rad: [300]
  k_d_V_s_per_rad: 10
  joints:
    joint_1: {times_s: [0, 1], angles_deg: [40, 0]}
    joint_2: {times_s: [0, 1], angles_deg: [-30, 60]}
  torques:
    joint_3: {times_s: [0, 0.5, 1], torques_N_m: [0, 0.8, 0]}
"""


@pytest.fixture
def mixed(tmp_path):
    path = tmp_path / "mixed.yaml"
    path.write_text(SCENARIO, encoding="utf-8")
    return path


# A program of its own to compile; its right-hand sides are compared in tests/oracle.
M_STAR = pytest.param({"method": "dopri5", "solver": "m_star"}, marks=pytest.mark.long)


@pytest.mark.parametrize("integrator", [{"method": "dopri5"}, {"method": "radau5"}, M_STAR])
def test_the_ledger_closes_with_all_kinds_of_drives(mixed, integrator):
    overrides = {f"integrator.{key}": value for key, value in integrator.items()}
    record = simulate(load_scenario(mixed, overrides={**overrides, "integrator.rtol": 1e-10, "integrator.atol": 1e-12}))
    assert record.summary["energy_residual_relative"] < 1e-8
    current, voltage, v = record["current"], record["voltage"], record["v"]
    assert np.abs(current[:, 1]).max() == 1.5  # at the limit
    assert np.abs(current[:, 2]).max() == 0.5
    np.testing.assert_array_equal(voltage[:, 2], v[:, 2])  # power τ v
    warnings = record.summary["warnings"]
    assert lines_with(warnings, "joint_2", "current", "1.5 A")
    assert lines_with(warnings, "joint_3", "torque", "0.5 N m")


@pytest.mark.parametrize("integrator", [{"method": "radau5"}, M_STAR])
def test_all_methods_and_solvers_move_all_kinds_of_drives_alike(mixed, integrator):
    tight = {"rtol": 1e-10, "atol": 1e-12}
    first, other = (
        simulate(load_scenario(mixed, overrides={f"integrator.{key}": value for key, value in options.items()}))["q"]
        for options in ({**tight, "method": "dopri5"}, tight | integrator)
    )
    np.testing.assert_allclose(other, first, rtol=0, atol=1e-7)


def test_a_force_at_its_limit_is_in_newtons(tmp_path):
    """Of a motor that pushes a prismatic joint, within its limit and where a start in equilibrium jumps."""
    path = tmp_path / "pushed.yaml"
    path.write_text(
        """
duration_s: 0.5
plant:
  type: serial_arm
  chain: [{kind: prismatic, axis: x, length_m: 0.1, mass_kg: 1, motor: {type: torque, limit_N_m: 0.5}}]
controller: {type: joint_pd, torques: {joint_1: {times_s: [0, 0.5], torques_N_m: [2, 2]}}}
initial: {equilibrium: true}
"""
    )
    warnings = simulate(load_scenario(path)).summary["warnings"]
    assert lines_with(warnings, "joint_1", "force", "0.5 N")
    assert lines_with(warnings, "joint_1", "force", "2 N", "0")
