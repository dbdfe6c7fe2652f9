"""Analytical solutions: pendulum, current of a blocked motor, block on an incline, bead on a sphere and a cylinder."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ellipk
from support.random_robots import ADAPTIVE, CompiledSystem, assemble

from dynsim.dynamics import tables as ka
from dynsim.dynamics.state import FRICTION, OUT_FORCE
from dynsim.engine import simulate
from dynsim.integrators.run import DRIFT_MAX
from dynsim.model.description import Contact, Inertia, Link, Quadric, Robot
from dynsim.model.drives import Motor
from dynsim.scenario.reading import scenario_from_resolved

G = 9.81
X, Y, Z = np.eye(3)
PLANE = np.zeros((3, 3))
every_method = pytest.mark.parametrize("method", ADAPTIVE)


def robot(*links: Link, motors: tuple[Motor, ...] = (), gravity: float = G) -> Robot:
    return Robot("case", links, motors, (links[-1].name, np.zeros(3)), gravity=np.array([0.0, 0.0, -gravity]))


def bead(mass: float, surface: Quadric, friction: float = 0.0, v_s: float = 1e-3, gravity: float = G) -> CompiledSystem:
    """A point mass on three slides, held to a surface."""
    links = [
        Link(f"b{k}", f"j{k}", None if k == 0 else f"b{k - 1}", "prismatic", axis, Inertia(mass if k == 2 else 0.0))
        for k, axis in enumerate((X, Y, Z))
    ]
    contact = Contact("bead", "b2", np.zeros(3), surface, friction=friction, slip_smoothing=v_s)
    return assemble(robot(*links, gravity=gravity), [contact])


@pytest.mark.parametrize("amplitude", [0.1, 1.5, 3.0])
@every_method
def test_pendulum_period(amplitude, method):
    """T = 4 √(l/g) K(sin²(θ0/2)), K the complete elliptic integral."""
    length = 0.7
    link = Link("bob", "hinge", None, "revolute", Y, Inertia(0.3, np.array([0.0, 0.0, -length])))
    period = 4.0 * np.sqrt(length / G) * ellipk(np.sin(0.5 * amplitude) ** 2)
    b = assemble(robot(link))
    run = b.simulate(b.state([amplitude], [0.0]), np.array([0.25, 0.5, 1.0]) * period, method, rtol=1e-11)
    # A thousand times the tolerance: near the top the swing magnifies errors.
    np.testing.assert_allclose(run.states("q")[:, 0], [0.0, -amplitude, amplitude], rtol=0, atol=1e-8)


@every_method
def test_current_in_a_blocked_motor_rises_exponentially(method):
    """i = u/R (1 − exp(−R t/L))."""
    heavy = Link("wheel", "shaft", None, "revolute", Z, Inertia(1.0, np.zeros(3), 1e15 * np.eye(3)))
    motor = Motor("shaft", 0.2, resistance=1.1, inductance=1.7e-3, rotor_inertia=0.0, gear_ratio=3.0)
    b = assemble(robot(heavy, motors=(motor,)), held=np.array([0.4]), k_p=30.0, k_d=0.0)
    t = np.linspace(0.0, 8e-3, 9)
    run = b.simulate(b.state([0.0], [0.0]), t, method, rtol=1e-9)
    expected = 30.0 * 0.4 / 1.1 * (1.0 - np.exp(-1.1 / 1.7e-3 * t))
    # 10 rtol |i|.
    np.testing.assert_allclose(run.states("current")[:, 0], expected, rtol=0, atol=1e-7)


@every_method
def test_current_with_a_voltage_limit_rises_as_if_the_limit_were_the_voltage(method):
    heavy = Link("wheel", "shaft", None, "revolute", Z, Inertia(1.0, np.zeros(3), 1e15 * np.eye(3)))
    motor = Motor("shaft", 0.2, 1.1, 1.7e-3, rotor_inertia=0.0, gear_ratio=3.0, voltage_limit=5.0)
    b = assemble(robot(heavy, motors=(motor,)), held=np.array([0.4]), k_p=30.0)
    t = np.array([1e-3, 5e-3])
    run = b.simulate(b.state([0.0], [0.0]), t, method, rtol=1e-9)
    expected = 5.0 / 1.1 * (1.0 - np.exp(-1.1 / 1.7e-3 * t))
    np.testing.assert_allclose(run.states("current")[:, 0], expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("speed", [-2.0, 0.5e-3, 3.0])
def test_block_on_an_incline(speed):
    """f_n = m g cos α and a = g sin α − μ g cos α · v/√(v² + v_s²), down the slope."""
    alpha, mu, v_s, mass = 0.6, 0.25, 1e-3, 1.7
    normal, down = np.array([np.sin(alpha), 0.0, np.cos(alpha)]), np.array([np.cos(alpha), 0.0, -np.sin(alpha)])
    b = bead(mass, Quadric(PLANE, normal, 0.0), friction=mu, v_s=v_s)
    dy = b.derivative(b.state(np.zeros(3), speed * down))
    expected = G * np.sin(alpha) - mu * G * np.cos(alpha) * speed / np.hypot(speed, v_s)
    np.testing.assert_allclose(b.part(dy, "v"), expected * down, rtol=0, atol=1e-13)  # rounding
    assert b.ws.contacts[0, ka.NORMAL_FORCE] == pytest.approx(mass * G * np.cos(alpha), rel=1e-13)


@every_method
def test_block_slides_down_an_incline(method):
    """s = v0 t + (sin α − μ cos α) g t²/2 while v ≫ v_s; friction heat = μ m g cos α s."""
    alpha, mu, mass, v0, v_s = 0.6, 0.25, 1.7, 1.0, 1e-6
    normal, down = np.array([np.sin(alpha), 0.0, np.cos(alpha)]), np.array([np.cos(alpha), 0.0, -np.sin(alpha)])
    b = bead(mass, Quadric(PLANE, normal, 0.0), friction=mu, v_s=v_s)
    t = np.array([0.5, 1.0])
    run = b.simulate(b.state(np.zeros(3), v0 * down), t, method, rtol=1e-9)
    s = v0 * t + 0.5 * G * (np.sin(alpha) - mu * np.cos(alpha)) * t**2
    # v_s²/v² = 1e-12 and the tolerance of the integration.
    np.testing.assert_allclose(run.states("q") @ down, s, rtol=1e-8)
    np.testing.assert_allclose(run.states("ledger")[:, FRICTION], mu * mass * G * np.cos(alpha) * s, rtol=1e-8)


@every_method
def test_bead_on_a_sphere_is_held_by_weight_less_centrifugal_force(method):
    """Frictionless from rest near the top: v² = 2 g ρ (cos θ0 − cos θ), f_n = m (g cos θ − v²/ρ): it pulls past 48°."""
    radius, mass, theta = 0.8, 0.4, 0.2
    b = bead(mass, Quadric(np.eye(3), np.zeros(3), -0.5 * radius**2))
    start = radius * np.array([np.sin(theta), 0.0, np.cos(theta)])
    run = b.simulate(b.state(start, np.zeros(3)), np.linspace(0.1, 1.0, 10), method, rtol=1e-10)
    r, v = run.states("q"), run.states("v")
    square = 2.0 * G * (start[2] - r[:, 2])
    # A hundred times the tolerance of the integration.
    np.testing.assert_allclose((v**2).sum(axis=1), square, rtol=0, atol=1e-8)
    force = mass * (G * r[:, 2] / radius - square / radius)
    np.testing.assert_allclose(run.outputs("contact")[:, 0, OUT_FORCE], force, rtol=0, atol=1e-8)
    assert force.min() < 0.0 < force.max()
    assert 0.0 < run.extremes[0, DRIFT_MAX] <= 1e-9


@every_method
def test_bead_on_a_cylinder_without_weight_runs_along_a_helix(method):
    """Constant speed along and around; f_n = −m v_t²/ρ."""
    radius, mass, around, along = 0.5, 0.3, 1.2, 0.7
    b = bead(mass, Quadric(np.diag([1.0, 1.0, 0.0]), np.zeros(3), -0.5 * radius**2), gravity=0.0)
    t = np.linspace(0.5, 3.0, 6)
    run = b.simulate(b.state([radius, 0.0, 0.0], [0.0, around, along]), t, method, rtol=1e-10)
    angle = around / radius * t
    expected = np.stack([radius * np.cos(angle), radius * np.sin(angle), along * t], axis=1)
    np.testing.assert_allclose(run.states("q"), expected, rtol=0, atol=1e-8)  # a hundred tolerances
    np.testing.assert_allclose(run.outputs("contact")[:, 0, OUT_FORCE], -mass * around**2 / radius, rtol=1e-8)


@pytest.mark.parametrize("apart", [0.004, 0.01, 0.03])
def test_a_torque_reference_passes_through_waypoints_that_are_near_each_other(apart: float) -> None:
    """Nearer than two knots of ``knot_spacing_s`` they came out as 0.4 to 4.9 for 5."""
    times, torques = [0.0, 0.4, 0.4 + apart, 0.4 + 2 * apart, 1.0], [0.0, 0.0, 5.0, 0.0, 0.0]
    data = {
        "name": "pulse",
        "duration_s": 1.0,
        "plant": {
            "type": "serial_arm",
            "gravity_m_s2": [0, 0, 0],
            "chain": [{"axis": "y", "length_m": 0.3, "mass_kg": 1.0, "motor": {"type": "torque"}}],
        },
        "controller": {"type": "joint_pd", "torques": {"joint_1": {"times_s": times, "torques_N_m": torques}}},
        "record": {"rate_hz": 10_000},
    }
    record = simulate(scenario_from_resolved(data))
    assert np.interp(times[1:4], record.time, record["torque"][:, 0]) == pytest.approx([0.0, 5.0, 0.0], abs=0.02)
