"""Wheels and compliant ground in scenarios: closed forms of rolling, bearings, soft ground and springs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.messages import raises

from dynsim import Record, load_scenario, simulate
from dynsim.errors import ModelError, ScenarioError
from dynsim.scenario import Scenario, ScenarioConfig

G = 9.81
RADIUS, WHEEL, BODY = 0.05, 0.4, 2.0
PLACES = {"fl": (0.2, 0.15), "fr": (0.2, -0.15), "rl": (-0.2, 0.15), "rr": (-0.2, -0.15)}
# Of a cart on four discs that roll: m + 4 I/r² with I = m_w r²/2.
MASS, MOVED = BODY + 4 * WHEEL, BODY + 4 * 1.5 * WHEEL


def cart(height: float = RADIUS, **wheel: Any) -> dict[str, Any]:
    wheels = {
        name: {"position_m": [*position, -0.02], "radius_m": RADIUS, "mass_kg": WHEEL, **wheel}
        for name, position in PLACES.items()
    }
    return {"mass_kg": BODY, "size_m": [0.5, 0.2, 0.04], "position_m": [0, 0, height + 0.02], "wheels": wheels}


def run(slope: float = 0.0, duration: float = 1.0, **changes: Any) -> Record:
    """A run on a plane; gravity is inclined by the slope [rad] towards x."""
    config = {
        "name": "scene",
        "duration_s": duration,
        "plant": {
            "type": "serial_arm",
            "chain": [{"axis": "y"}],
            "base": {"position_m": [0, 5, 0]},
            "gravity_m_s2": [G * np.sin(slope), 0, -G * np.cos(slope)],
        },
        "surfaces": {"floor": {"type": "plane"}},
        "contacts": {"law": "unilateral", "friction": 0.7},
        "integrator": {"method": "time_stepping", "step_s": 0.001},
        "record": {"rate_hz": 1000},
        **changes,
    }
    return simulate(Scenario("scene", "", ScenarioConfig.model_validate(config)))


def column(record: Record, name: str, signal: str = "q") -> np.ndarray:
    return np.asarray(record[signal][:, record.labels[signal].index(name)])


@pytest.mark.parametrize("share", [0.0, 0.6, 1.1])
def test_a_cart_rolls_down_a_slope_against_its_bearings(share):
    """(m + 4 I/r²) a = m g sin α − 4 τ/r; bearings that hold more than its pull keep it where it is."""
    slope = 0.1
    drag = share * MASS * G * np.sin(slope) * RADIUS / 4.0
    record = run(slope, objects={"cart": cart(friction_N_m=drag)}, contacts={"law": "unilateral", "friction": 0.7})
    a = max(1.0 - share, 0.0) * MASS * G * np.sin(slope) / MOVED
    x, turned = column(record, "cart.x"), column(record, "cart.fl")
    np.testing.assert_allclose(x, 0.5 * a * record.time**2, rtol=0, atol=1e-4 * 0.5 * a + 1e-9)
    np.testing.assert_allclose(x, RADIUS * turned, rtol=0, atol=1e-9)
    assert np.abs(column(record, "cart.y")).max() < 1e-9
    np.testing.assert_allclose(record["contact_normal_force"][-1].sum(), MASS * G * np.cos(slope), rtol=1e-6)


def test_driven_wheels_take_a_cart_where_they_turn():
    """Servos follow their rates: v = ω r; with both axles driven on one side faster than on the other it turns."""
    motor = {
        "type": "servo",
        "voltage_V": 12,
        "stall_torque_N_m": 3,
        "no_load_speed_rad_per_s": 30,
        "mode": "velocity",
        "k_v_V_s_per_rad": 20,
    }
    waypoints = {"times_s": [0, 1], "angles_deg": [0, 90]}
    controller = {"type": "joint_pd", "joints": {f"cart.{name}": waypoints for name in PLACES}}
    record = run(duration=1.5, objects={"cart": cart(motor=motor)}, controller=controller)
    assert column(record, "cart.x")[-1] == pytest.approx(RADIUS * 0.5 * np.pi, rel=2e-3)
    assert {f"cart.{name}" for name in PLACES} <= set(record.labels["current"])
    assert record.summary["energy_residual_relative"] < 1e-9


def test_a_mass_on_soft_ground_swings_and_decays():
    """x = −m g/k (1 − e^(−d t)(cos w t + d/w sin w t)) from the first touch at rest, by keys of the contacts."""
    stiffness, damping, mass = 2e4, 40.0, 2.0
    contacts = {"law": "unilateral", "stiffness_N_per_m": stiffness, "damping_N_s_per_m": damping}
    ball = {"mass_kg": mass, "shape": "sphere", "radius_m": 0.05, "position_m": [0, 0, 0.05]}
    record = run(duration=0.5, objects={"ball": ball}, contacts=contacts)
    decay = damping / (2.0 * mass)
    pulsation = np.sqrt(stiffness / mass - decay**2)
    swing = np.cos(pulsation * record.time) + decay / pulsation * np.sin(pulsation * record.time)
    expected = -mass * G / stiffness * (1.0 - np.exp(-decay * record.time) * swing)
    deep = column(record, "ball.z") - 0.05
    np.testing.assert_allclose(deep, expected, rtol=0, atol=0.02 * mass * G / stiffness)
    finer = run(
        duration=0.5,
        objects={"ball": ball},
        contacts=contacts,
        integrator={"method": "time_stepping", "step_s": 0.0005},
    )
    errors = [np.abs(column(r, "ball.z") - 0.05 - expected).max() for r in (record, finer)]
    assert errors[1] < 0.27 * errors[0]


@pytest.mark.parametrize("share", [1.0 - 1e-6, 1.0 + 1e-4])
def test_a_block_on_a_spring_is_held_by_friction_up_to_its_bound(share):
    """A tie stretched by μ m g/k and a little less holds for ever; a little more, and it slides."""
    mass, friction, stiffness = 1.0, 0.4, 200.0
    bound = friction * mass * G / stiffness
    block = {"mass_kg": mass, "size_m": [0.2, 0.2, 0.02], "position_m": [0, 0, 0.01]}
    anchor = {"mass_kg": 1e3, "size_m": [0.1, 0.1, 0.1], "position_m": [0.5, 0, 0.01]}
    anchor["hinge"] = {"axis": [1, 0, 0]}
    spring = {
        "type": "linear",
        "body": "block",
        "other": "anchor",
        "axis": [1, 0, 0],
        "stiffness_N_per_m": stiffness,
        "rest_m": -0.5 + share * bound,
    }
    record = run(
        duration=2.0,
        objects={"block": block, "anchor": anchor},
        ties={"spring": spring},
        contacts={"law": "unilateral", "friction": friction},
    )
    moved = np.abs(column(record, "block.x")).max()
    if share < 1.0:
        assert moved < 1e-10
        assert record["tie_force"][-1, 0] == pytest.approx(share * friction * mass * G, rel=1e-9)
    else:
        # Half a swing about the place where spring and friction balance.
        assert moved == pytest.approx(2.0 * (share - 1.0) * bound, rel=0.05)


def test_two_objects_on_a_torsion_tie_swing_with_their_reduced_inertia():
    """About the axis of two balls without weight: w² = k (1/I_1 + 1/I_2)."""
    ball = {"shape": "sphere", "radius_m": 0.1, "position_m": [0, 0, 1]}
    objects = {"one": ball | {"mass_kg": 1.0}, "two": ball | {"mass_kg": 3.0, "position_m": [0.5, 0, 1]}}
    tie = {"type": "torsion", "body": "one", "other": "two", "axis": [1, 0, 0], "stiffness_N_m_per_rad": 0.5}
    kick = {"type": "samples", "body": "one", "times_s": [0, 0.02], "torque_N_m": [[0.1, 0, 0], [0.1, 0, 0]]}
    record = run(
        duration=1.0,
        objects=objects,
        ties={"twist": tie},
        loads={"kick": kick},
        plant={"type": "serial_arm", "chain": [{"axis": "y"}], "gravity_m_s2": [0, 0, 0]},
    )
    force, inertia = record["tie_force"][:, 0], 0.4 * 0.1**2 * np.array([1.0, 3.0])
    pulsation = np.sqrt(0.5 * (1.0 / inertia).sum())
    after = record.time > 0.02
    falls = np.flatnonzero(np.diff(np.sign(force[after])) > 0)
    period = np.diff(record.time[after][falls]).mean()
    assert period == pytest.approx(2.0 * np.pi / pulsation, rel=1e-2)
    assert record["loss_damper"][-1] == pytest.approx(0.0, abs=1e-12)


SCENE = """
duration_s: 0.1
plant: {type: serial_arm, chain: [{axis: y}]}
contacts: {law: unilateral}
integrator: {method: METHOD}
objects:
  box: {mass_kg: 1, size_m: [0.1, 0.1, 0.1], position_m: [1, 0, 0]}
  valve:
    {mass_kg: 1, size_m: [0.1, 0.1, 0.1], position_m: [2, 0, 0], hinge: {}, WHEELS}
ties:
  spring:
    {type: linear, body: link_1, other: OTHER, axis: [0, 0, 1], STIFF}
"""


@pytest.mark.parametrize(
    ("changes", "line", "names"),
    [
        ({"METHOD": "radau5"}, 11, ["ties.spring", "integrator.method: time_stepping", "radau5"]),
        ({"WHEELS": "wheels: {a: {position_m: [0, 0, 0], radius_m: 1, mass_kg: 1}}"}, 9, ["objects.valve.wheels"]),
        ({"STIFF": "bound_N: 3"}, 11, ["ties.spring.stiffness_N_per_m", "damping_N_s_per_m"]),
        ({"OTHER": "link_1"}, 12, ["ties.spring.other = 'link_1'", "body"]),
        ({"OTHER": "bax"}, 12, ["ties.spring.other", "'bax'", "'box'"]),
        ({"STIFF": "stiffness_N_per_m: 1, pushes: true, bound_N: 2"}, 12, ["ties.spring.bound_N = 2"]),
    ],
)
def test_what_cannot_be_is_refused_where_it_stands(tmp_path, changes, line, names):
    usual = {"METHOD": "time_stepping", "OTHER": "box", "STIFF": "stiffness_N_per_m: 1"}
    text = SCENE if "WHEELS" in changes else SCENE.replace(", WHEELS", "")
    for word, value in (usual | changes).items():
        text = text.replace(word, value)
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    with raises((ScenarioError, ModelError), f"scene.yaml:{line}", *names):
        simulate(load_scenario(path))
