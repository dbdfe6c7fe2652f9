"""The mobile base in motion: closed forms, rolling without slip, energy, both solvers, stepped and continued runs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from support.random_robots import CompiledSystem, assemble
from support.real_wheels import MOTOR

import dynsim
from dynsim.model.description import Robot
from dynsim.scenario import scenario_from_resolved
from dynsim.scenario.build import robot as build_robot

R, TRACK = 0.06, 0.32
MASS, WHEEL_MASS = 3.5, 0.4
# The body about its centre of mass, a wheel about its axle and across it.
I_Z, I_AXLE, I_ACROSS = 0.07, 0.5 * WHEEL_MASS * R**2, 0.25 * WHEEL_MASS * R**2
TOTAL = MASS + 2.0 * WHEEL_MASS
# Effective mass for a force ahead at the middle of the axle; effective inertia for a moment about the vertical there;
# both for wheels without motors.
ROLLING_MASS = TOTAL + 2.0 * I_AXLE / R**2
TURNING = I_Z + 2.0 * (I_ACROSS + WHEEL_MASS * (0.5 * TRACK) ** 2) + 2.0 * I_AXLE * (0.5 * TRACK / R) ** 2
START, HEADING = np.array([0.7, -0.4]), 0.6


def robot(ahead: float = 0.0, damping: float = 0.0, motor: Any = None, gravity: Any = (0.0, 0.0, -9.81)) -> Robot:
    """A base whose centre of mass is ``ahead`` of the axle [m]; its arm is a rotor without mass."""
    base = {
        "position_m": START.tolist(),
        "heading_deg": np.degrees(HEADING),
        "mass_kg": MASS,
        "com_m": [ahead, 0.0, 0.1],
        "inertia_kg_m2": [0.04, 0.0, 0.01, 0.05, 0.0, I_Z],
        "wheel": {"mass_kg": WHEEL_MASS, "radius_m": R, "damping_N_m_s_per_rad": damping, "motor": motor},
        "track_m": TRACK,
    }
    arm = {"type": "serial_arm", "gravity_m_s2": list(gravity), "chain": [{"mass_kg": 0.0, "motor": MOTOR}]}
    plant = {"type": "pws_arm", "base": base, "arm": arm}
    return build_robot(scenario_from_resolved({"name": "base", "duration_s": 1.0, "plant": plant}))


def wheel_rates(speed: float, turn: float) -> np.ndarray:
    """φ̇ of left and right wheel, and of the arm, at rest."""
    return np.array([speed - 0.5 * TRACK * turn, speed + 0.5 * TRACK * turn, 0.0]) / R


def speed_and_turn(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """V and ω of rates (T, 3)."""
    return 0.5 * R * (v[:, 0] + v[:, 1]), R * (v[:, 1] - v[:, 0]) / TRACK


def pose(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (T, 2) and headings in the world of coordinates (T, 5)."""
    c, s = np.cos(HEADING), np.sin(HEADING)
    return START + q[:, 2:4] @ np.array([[c, s], [-s, c]]), HEADING + R / TRACK * (q[:, 1] - q[:, 0])


def go(b: CompiledSystem, speed: float, turn: float, times: np.ndarray) -> tuple[np.ndarray, ...]:
    """V, ω, places and headings of a base that starts so."""
    run = b.simulate(b.state(np.zeros(5), wheel_rates(speed, turn)), times, "dopri5", rtol=1e-12)
    return *speed_and_turn(run.states("v")), *pose(run.states("q"))


# ---- free motion


@pytest.mark.parametrize(("speed", "turn"), [(0.8, 0.5), (-0.3, 1.4), (0.5, -0.2)])
def test_a_base_coasts_on_an_arc(speed, turn):
    """Mass above the axle's middle, no losses: constant V and ω, a circle of radius V/ω."""
    times = np.linspace(0.0, 10.0, 41)
    V, w, position, heading = go(assemble(robot()), speed, turn, times)
    np.testing.assert_allclose(V, speed, rtol=1e-12)
    np.testing.assert_allclose(w, turn, rtol=1e-12)
    angle = HEADING + turn * times
    np.testing.assert_allclose(heading, angle, rtol=0, atol=1e-11)
    arc = speed / turn * np.stack([np.sin(angle) - np.sin(HEADING), np.cos(HEADING) - np.cos(angle)], axis=1)
    np.testing.assert_allclose(position, START + arc, rtol=0, atol=1e-10)


def test_losses_of_the_wheels_slow_it_down_exponentially():
    """M V̇ = −2 D V/r², J ω̇ = −2 D (T/2r)² ω."""
    loss, times = 0.03, np.linspace(0.0, 2.0, 21)
    V, w, _, heading = go(assemble(robot(damping=loss)), 0.9, 1.3, times)
    straight, turning = 2.0 * loss / R**2 / ROLLING_MASS, 2.0 * loss * (0.5 * TRACK / R) ** 2 / TURNING
    np.testing.assert_allclose(V, 0.9 * np.exp(-straight * times), rtol=1e-9)
    np.testing.assert_allclose(w, 1.3 * np.exp(-turning * times), rtol=1e-9)
    np.testing.assert_allclose(heading, HEADING + 1.3 / turning * (1.0 - np.exp(-turning * times)), rtol=0, atol=1e-9)


@pytest.mark.parametrize("ahead", [0.08, -0.05])
def test_mass_off_the_axle_turns_it_round(ahead):
    """A base driven with its mass behind is unstable and comes round, as a caster does.

    M V̇ = m d ω², J ω̇ = −m d V ω: V = A tanh s, ω = ±A √(M/J) sech s, s = m d A (t − t₀)/J, M A² = M V² + J ω².
    """
    J = TURNING + MASS * ahead**2
    backward = -0.6 * np.sign(ahead)
    for turn in (1e-3, -0.02):
        top = np.sqrt(backward**2 + J / ROLLING_MASS * turn**2)
        rate = MASS * ahead * top / J
        middle = -np.arctanh(backward / top) / rate
        times = np.linspace(0.0, 2.0 * middle, 31)
        V, w, *_ = go(assemble(robot(ahead)), backward, turn, times)
        s = rate * (times - middle)
        np.testing.assert_allclose(V, top * np.tanh(s), rtol=0, atol=1e-9)
        np.testing.assert_allclose(w, np.sign(turn) * top * np.sqrt(ROLLING_MASS / J) / np.cosh(s), rtol=0, atol=1e-9)
        # It began going backward and ends going ahead, as fast.
        assert V[-1] == pytest.approx(-backward, rel=1e-9)


@pytest.mark.parametrize("off", [0.0, 0.5, np.pi / 2, 2.5])
def test_a_base_rolls_down_a_slope(off):
    """Heading at an angle to the steepest way down: V̇ = m g sin a cos(angle)/(m + 2 I/r²), and no drift across it."""
    slope, times = 0.2, np.linspace(0.0, 3.0, 13)
    down = 9.81 * np.sin(slope) * np.array([np.cos(HEADING + off), np.sin(HEADING + off)])
    b = assemble(robot(gravity=(*down, -9.81 * np.cos(slope))))
    V, w, position, heading = go(b, 0.0, 0.0, times)
    rate = TOTAL * 9.81 * np.sin(slope) * np.cos(off) / ROLLING_MASS
    np.testing.assert_allclose(V, rate * times, rtol=0, atol=1e-11)
    np.testing.assert_allclose(w, 0.0, rtol=0, atol=1e-11)
    distance = 0.5 * rate * times[:, None] ** 2 * [np.cos(HEADING), np.sin(HEADING)]
    np.testing.assert_allclose(position, START + distance, rtol=0, atol=1e-11)
    np.testing.assert_allclose(heading, HEADING, rtol=0, atol=1e-11)


# ---- driven


def per_wheel(sign: float, rotor: float) -> float:
    """Inertia that a wheel feels when the other one turns as much, alike (1) or against it (−1)."""
    base = TOTAL * R**2 / 2.0
    if sign < 0.0:
        spin = I_Z + 2.0 * (I_ACROSS + WHEEL_MASS * (0.5 * TRACK) ** 2)
        base = 0.5 * spin * (2.0 * R / TRACK) ** 2
    return base + I_AXLE + rotor


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["straight", "pivot"])
def test_torques_speed_up_the_wheels(sign):
    """φ̈ = τ/J − D φ̇/J: φ̇ = τ (1 − exp(−D t/J))/D."""
    loss, torque, times = 0.04, 0.3, np.linspace(0.0, 1.5, 16)
    b = assemble(robot(damping=loss, motor={"type": "torque"}), held=np.array([sign * torque, torque, 0.0]))
    run = b.simulate(b.state(np.zeros(5), np.zeros(3)), times, "dopri5", rtol=1e-12)
    rate = torque / loss * (1.0 - np.exp(-loss * times / per_wheel(sign, 0.0)))
    np.testing.assert_allclose(run.states("v")[:, :2], np.stack([sign * rate, rate], axis=1), rtol=0, atol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["straight", "pivot"])
def test_motors_turn_the_wheels_to_their_angles(sign):
    """Voltage PD, circuit, rotor and losses of both wheels: one linear system of angle, rate and current."""
    loss, goal, k_p, k_d, times = 0.04, 2.0, 30.0, 1.0, np.linspace(0.0, 1.5, 16)
    b = assemble(robot(damping=loss, motor=MOTOR), held=np.array([sign * goal, goal, 0.0]), k_p=k_p, k_d=k_d)
    run = b.simulate(b.state(np.zeros(5), np.zeros(3)), times, "dopri5", rtol=1e-12)
    K, k, L = 0.203 * 3.0, 3.0, 0.0017
    J, D = per_wheel(sign, 1.64e-4 * k**2), loss + 0.01 * k**2
    A = np.array([[0.0, 1.0, 0.0], [0.0, -D / J, K / J], [-k_p / L, -(k_d + K) / L, -1.1 / L]])
    final = np.array([goal, 0.0, 0.0])
    expected = np.array([final - expm(A * t) @ final for t in times])
    for name, column in (("q", 0), ("v", 1), ("current", 2)):
        both = np.stack([sign * expected[:, column], expected[:, column]], axis=1)
        np.testing.assert_allclose(run.states(name)[:, :2], both, rtol=0, atol=1e-8)


# ---- a whole mobile arm

MOBILE: dict[str, Any] = {
    "name": "mobile",
    "duration_s": 1.0,
    "plant": {
        "type": "pws_arm",
        "base": {
            "position_m": [0.4, -0.3],
            "heading_deg": 35.0,
            "com_m": [0.05, 0.02, 0.08],
            "wheel": {"motor": MOTOR, "damping_N_m_s_per_rad": 0.05},
            "mount": {"position_m": [0.02, 0.01, 0.12], "yaw_deg": 20.0},
        },
        "arm": {
            "type": "serial_arm",
            "chain": [
                {"axis": axis, "mass_kg": 0.4, "damping_N_m_s_per_rad": 0.1, "motor": MOTOR, "initial_deg": angle}
                for axis, angle in (("z", 0.0), ("y", 30.0), ("y", 60.0), ([0.6, 0.0, 0.8], -20.0))
            ],
        },
    },
    "controller": {
        "type": "joint_pd",
        "joints": {
            "base.left": {"times_s": [0, 1], "angles_deg": [0, 300]},
            "base.right": {"times_s": [0, 0.5, 1], "angles_deg": [0, 250, 90]},
            "joint_2": {"times_s": [0, 1], "angles_deg": [30, 80]},
        },
    },
}


def mobile(**sections: Any) -> dynsim.Scenario:
    return scenario_from_resolved({**MOBILE, **sections})


# Of a central difference of eighth order, for the neighbours on one side.
EIGHTH = np.array([4.0 / 5.0, -1.0 / 5.0, 4.0 / 105.0, -1.0 / 280.0])


def test_lowest_points_of_the_wheels_are_at_rest():
    """Rim points followed through recorded poses and wheel angles, by differences over time alone."""
    exact = {"method": "dopri5", "rtol": 1e-12, "atol": 1e-13}
    record = dynsim.simulate(mobile(integrator=exact, record={"rate_hz": 2000}))
    (x, y, heading), angles = record["base_pose"].T, record["q"][:, :2].T
    r, track, h = 0.05, 0.3, 5e-4
    np.testing.assert_allclose(np.diff(record.time), h, rtol=1e-9)
    count = len(x) - 8
    for angle, side in ((angles[0], 0.5 * track), (angles[1], -0.5 * track)):

        def rim(k: int, angle: np.ndarray = angle, side: float = side) -> np.ndarray:
            """Points, (3, count), of the wheel at sample 4 + k that are its lowest at sample 4; angle about +y."""
            now = slice(4 + k, 4 + k + count)
            turned = angle[now] - angle[4 : 4 + count]
            ahead, up = -r * np.sin(turned), r - r * np.cos(turned)
            c, s = np.cos(heading[now]), np.sin(heading[now])
            return np.stack([x[now] + c * ahead - s * side, y[now] + s * ahead + c * side, up])

        velocity = sum(w * (rim(k) - rim(-k)) for k, w in enumerate(EIGHTH, 1)) / h
        np.testing.assert_allclose(velocity, 0.0, rtol=0, atol=1e-9)
    # They did roll, and turn.
    assert np.ptp(angles) > 3.0
    assert np.ptp(heading) > 0.5


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
# M* of wheels and a support polygon is a program of its own to compile.
@pytest.mark.parametrize("solver", ["articulated", pytest.param("m_star", marks=pytest.mark.slow)])
def test_the_ledger_closes(method, solver):
    """Circuits, gears and losses of wheels and arm, on a floor that is not level."""
    tilted = {**MOBILE["plant"], "arm": {**MOBILE["plant"]["arm"], "gravity_m_s2": [1.0, 0.5, -9.7]}}
    record = dynsim.simulate(mobile(plant=tilted, integrator={"method": method, "solver": solver}))
    assert record.summary["energy_residual_relative"] < 1e-6
    assert record["heat_joule"][-1] > 0.1
    assert np.ptp(record["energy_kinetic"]) > 0.1


@pytest.mark.slow  # a program of its own to compile; right-hand sides of both are compared in tests/oracle
def test_both_solvers_are_one():
    """O(n) and M* over a run."""
    exact = {"method": "dopri5", "rtol": 1e-12, "atol": 1e-13}
    first, other = (dynsim.simulate(mobile(integrator={**exact, "solver": s})) for s in ("articulated", "m_star"))
    for name in ("q", "v", "base_pose"):
        np.testing.assert_allclose(first[name], other[name], rtol=0, atol=1e-10)


# ---- in pieces


def same(a: dynsim.Record, b: dynsim.Record) -> bool:
    return set(a) == set(b) and all(a[name].tobytes() == b[name].tobytes() for name in a)


def test_a_stepper_is_the_run_bit_for_bit_and_goes_back():
    scenario = mobile()
    whole, simulation = dynsim.simulate(scenario), dynsim.Simulation(scenario)
    simulation.advance(0.237)
    snapshot = simulation.snapshot()
    simulation.set_wrench("base", force=[20.0, 5.0, 0.0])
    simulation.set_reference("base.left", -1.0)
    away = simulation.advance(0.6)
    simulation.restore(snapshot)
    simulation.advance(scenario.duration_s)
    assert np.abs(away.q[:4] - whole["q"][60][:4]).max() > 1e-2
    np.testing.assert_array_equal(simulation.record()["q"], whole["q"])
    plain = dynsim.Simulation(scenario)
    for t in np.linspace(0.0, 1.0, 30):
        plain.advance(float(t))
    assert same(plain.record(), whole)


def test_going_on_from_a_record_is_going_on():
    exact = {"method": "dopri5", "rtol": 1e-12, "atol": 1e-13}
    scenario = mobile(integrator=exact)
    whole = dynsim.simulate(scenario)
    continued = dynsim.Simulation(scenario, state=dynsim.State.of(whole, len(whole) // 2))
    np.testing.assert_allclose(continued.advance(1.0).q, whole["q"][-1], rtol=0, atol=1e-9)
