"""Rotor armature against rotors as bodies, and the mass of motors."""

import numpy as np
import pytest
from support.messages import raises
from support.rotors import rotor_energies, rotor_model

import dynsim
from dynsim.dynamics.derivative import derivative
from dynsim.dynamics.state import ELECTRICAL, block
from dynsim.engine.simulation import prepare
from dynsim.errors import ScenarioError
from dynsim.scenario import build_model, load_scenario

ARM = """
duration_s: 1
plant:
  type: serial_arm
  link: {mass_kg: 0.4, length_m: 0.5, motor: {type: wang_minami, mass_kg: 0.3}}
  chain: [{axis: z, length_m: 0.2}, {axis: y, initial_deg: 90}, {axis: y}]
"""


def test_the_independent_dynamics_are_dynsims_when_rotors_are_armature():
    scenario = load_scenario("elbow_comparison", "two_elbows")
    prepared, model = prepare(scenario), rotor_model(scenario, spinning=False)
    n, rng = 10, np.random.default_rng(1)
    q, v, current, ledger = (block(prepared.system.layout, name) for name in ("q", "v", "current", "ledger"))
    for t in (0.0, 0.013, 3.3):
        y = prepared.run.y.copy()
        y[q] += rng.normal(scale=0.1, size=n)
        y[v], y[current] = rng.normal(size=n), rng.normal(size=n)
        dy = np.zeros_like(y)
        derivative(prepared.system, t, y, prepared.workspace, dy)
        # The model's own state is q, v, i and the electrical energy.
        *mine, power = model.derivative(t, np.concatenate([y[q], y[v], y[current], [0.0]]))
        expected = np.concatenate([dy[q], dy[v], dy[current]])
        # J̇ v there is a central difference.
        np.testing.assert_allclose(mine, expected, rtol=1e-7, atol=1e-7 * np.abs(dy[v]).max())
        assert power == pytest.approx(dy[ledger][ELECTRICAL], rel=1e-12)


def test_a_spinning_rotor_turns_with_its_link_and_its_joint():
    """½ vᵀMv = bodies + Σ ½ I_m (k v + a·ω)² + ½ (I_m/2) |ω across a|², ω of the link before the joint."""
    scenario = load_scenario("elbow_comparison", "two_elbows")
    model, rng = build_model(scenario), np.random.default_rng(2)
    spinning = rotor_model(scenario, spinning=True)
    q, v = rng.normal(size=10), rng.normal(size=10)
    expected, omega = model.kinetic_energy(q, v), np.zeros(3)
    for i, link in enumerate(model.robot.links):
        motor = model.robot.motors[i]
        axis = model.body_pose(link.name, q)[0] @ link.axis
        along = axis @ omega
        expected += 0.5 * motor.rotor_inertia * (motor.gear_ratio * v[i] + along) ** 2
        expected += 0.25 * motor.rotor_inertia * (omega @ omega - along**2)
        omega = omega + axis * v[i]
    assert 0.5 * v @ spinning.mass_matrix(q) @ v == pytest.approx(expected, rel=1e-12)


@pytest.mark.slow
def test_armature_alone_takes_the_documented_share_more():
    """docs/validation/evidence.md: 219.67 J with spinning rotors, 219.75 J with armature."""
    scenario = load_scenario("elbow_comparison", "two_elbows")
    energies = rotor_energies(scenario)
    assert energies["armature"] == pytest.approx(dynsim.simulate(scenario).summary["electrical_energy_J"], abs=2e-3)
    assert energies["spinning"] - energies["armature"] == pytest.approx(-0.08, abs=0.01)


def test_a_motor_weighs_on_the_link_before_its_joint(tmp_path):
    """Stretched out: weights of links at their middles, of motors 2 and 3 at their joints; motor 1 is on the base."""
    path = tmp_path / "arm.yaml"
    path.write_text(ARM)
    model = build_model(load_scenario(path))
    q = model.robot.initial
    g = 9.81
    moment = model.bias_forces(q, np.zeros(3))
    np.testing.assert_allclose(moment[2], -0.4 * g * 0.25, rtol=1e-12)
    np.testing.assert_allclose(moment[1], -g * (0.4 * 0.25 + 0.4 * 0.75 + 0.3 * 0.5), rtol=1e-12)
    assert model.robot.links[0].inertia.mass == pytest.approx(0.7)
    # Joint 2 carries link 2, motor 3 at its end, and link 3: 4/3 of a rod twice as long, and m l².
    assert model.mass_matrix(q)[1, 1] == pytest.approx(0.8 * 1.0**2 / 3 + 0.3 * 0.5**2, rel=1e-3)
    middle = build_model(load_scenario(path, overrides={"plant.chain.2.motor": {
        "type": "wang_minami", "mass_kg": 0.3, "mass_point_m": [0, 0, 0.1]}}))  # fmt: skip
    assert middle.bias_forces(q, np.zeros(3))[1] == pytest.approx(-g * (0.4 * 0.25 + 0.4 * 0.75 + 0.3 * 0.1))
    with raises(ScenarioError, "plant.link.motor.mass_point_m", "mass_kg"):
        load_scenario(path, overrides={"plant.link.motor": {"type": "wang_minami", "mass_point_m": [0, 0, 0.1]}})


def test_motors_of_a_urdf_arm_weigh_too():
    light = build_model(load_scenario("six_axis_arm"))
    heavy = build_model(load_scenario("six_axis_arm", overrides={"plant.motor.mass_kg": 2.0}))
    masses = [[link.inertia.mass for link in model.robot.links] for model in (light, heavy)]
    # The motor of the first joint stands on the base, the last link carries none.
    np.testing.assert_allclose(np.subtract(*masses[::-1]), [2.0] * 5 + [0.0], atol=1e-12)
    assert heavy.robot.motors == light.robot.motors
