"""Motors of stepped simulations: modes of servos, supply voltage, brakes, and motors that replace the plant's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.messages import raises

import dynsim
from dynsim.engine.recording import energy_residual
from dynsim.errors import ModelError
from dynsim.model.drives import Servo

K_M, R, ARMATURE = 1.9, 2.3, 0.02


def servo(joint: str, **keys: float) -> Servo:
    return Servo(joint, **{"torque_constant": K_M, "resistance": R, "k_p": 40.0, "armature": ARMATURE, **keys})  # type: ignore[arg-type]


def pendulum(**keys: float) -> dynsim.Simulation:
    """The shipped pendulum at 60° from straight down, with a servo at its joint."""
    return dynsim.Simulation(dynsim.load_scenario("single_pendulum"), motors=[servo("joint_1", **keys)])


def arm(**keys: float) -> dynsim.Simulation:
    """The published arm without braces on servos that hold where it starts."""
    scenario = dynsim.load_scenario("elbow_comparison", variant="no_elbow")
    tight = scenario.config.integrator.model_copy(update={"method": "dopri5", "rtol": 1e-10, "atol": 1e-12})
    scenario = replace(scenario, config=scenario.config.model_copy(update={"controller": None, "integrator": tight}))
    motors = [servo(f"joint_{k}", **{"k_p": 5.0, **keys}) for k in range(1, 11)]
    return dynsim.Simulation(scenario, duration=3.0, motors=motors)


def vdot(simulation: dynsim.Simulation) -> float:
    """Acceleration now, from a small step."""
    state, step = simulation.state, 1e-6
    return float((simulation.advance(state.time + step).v[0] - state.v[0]) / step)


def test_modes_and_supply_are_those_of_the_servos_law() -> None:
    simulation = pendulum(k_v=3.0, free_drag=0.4)
    simulation.advance(0.2)
    simulation.set_reference("joint_1", 2.0, 0.7)
    model = simulation.model
    inertia = model.mass_matrix([0.0])[0, 0] + ARMATURE

    def expected(volts: float | None, drag: float = 0.0) -> float:
        state = simulation.state
        torque = 0.0 if volts is None else K_M * (volts - K_M * state.v[0]) / R
        return float((torque - drag * state.v[0] - model.bias_forces(state.q, state.v)[0]) / inertia)

    state = simulation.state
    for mode, wanted in {
        "position": expected(40.0 * (2.0 - state.q[0])),
        "velocity": expected(3.0 * (0.7 - state.v[0]) + K_M * state.v[0]),
        "off": expected(None, 0.4),
    }.items():
        here = simulation.snapshot()
        simulation.set_mode("joint_1", mode)
        assert vdot(simulation) == pytest.approx(wanted, rel=1e-4), mode
        simulation.restore(here)
    error = 40.0 * (2.0 - state.q[0])
    assert abs(error) > 2.5
    simulation.set_supply(2.5)
    assert vdot(simulation) == pytest.approx(expected(2.5 * np.sign(error)), rel=1e-3)
    simulation.set_supply(0.0)
    assert vdot(simulation) == pytest.approx(expected(0.0), rel=1e-3)


def test_a_closed_brake_holds_a_joint_and_lets_it_go_where_it_was() -> None:
    simulation = pendulum()
    simulation.set_mode("joint_1", "off")
    simulation.set_brake("joint_1", True)
    start = simulation.state
    held = simulation.advance(5.0)
    np.testing.assert_allclose(held.q, start.q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(held.v, 0.0, rtol=0, atol=1e-10)
    simulation.set_brake("joint_1", False)
    fallen = simulation.advance(5.8)
    fresh = pendulum()
    fresh.set_mode("joint_1", "off")
    np.testing.assert_allclose(fallen.q, fresh.advance(0.8).q, rtol=0, atol=1e-7)
    assert abs(fallen.q[0] - start.q[0]) > 0.5


def test_closing_a_brake_is_an_impulse_on_its_joint_alone_and_its_loss_is_accounted_for() -> None:
    """M Δv has an entry at the braked joint only; the energy balance of the record stays closed."""
    simulation, joint = arm(), 4
    before = simulation.advance(0.4)
    model = simulation.model
    M = model.mass_matrix(before.q) + np.diag(model.armature)
    simulation.set_brake("joint_5", True)
    after = simulation.state
    # Before is from dense output, after from a step that ends there.
    np.testing.assert_allclose(after.q, before.q, rtol=0, atol=1e-10)
    assert after.v[joint] == 0.0
    impulse = M @ (after.v - before.v)
    assert abs(impulse[joint]) > 1e-3
    np.testing.assert_allclose(np.delete(impulse, joint), 0.0, rtol=0, atol=1e-8)
    lost = 0.5 * before.v @ M @ before.v - 0.5 * after.v @ M @ after.v
    assert lost > 1e-4
    held = simulation.advance(1.0)
    assert held.q[joint] == pytest.approx(after.q[joint], abs=1e-9)
    assert np.abs(held.q - after.q)[5:].max() > 1e-3
    simulation.set_brake("joint_5", False)
    simulation.advance(3.0)
    residual = energy_residual(simulation.record())
    assert np.abs(residual).max() < 1e-4 * lost


def test_snapshots_bring_back_modes_supply_and_brakes() -> None:
    simulation = arm()
    simulation.advance(0.2)
    simulation.set_brake("joint_3", True)
    simulation.set_mode("joint_4", "off")
    simulation.set_supply(1.5)
    here = simulation.snapshot()
    first = simulation.advance(0.7)
    simulation.set_brake("joint_3", False)
    simulation.set_brake("joint_6", True)
    simulation.set_mode("joint_4", "position")
    simulation.set_supply(12.0)
    assert np.abs(simulation.advance(1.0).q - first.q).max() > 1e-2
    simulation.restore(here)
    second = simulation.advance(0.7)
    np.testing.assert_array_equal(second.q, first.q)
    np.testing.assert_array_equal(second.v, first.v)


@pytest.mark.parametrize(
    ("call", "names"),
    [
        (lambda s: s.set_mode("joint_1", "torque"), ["'torque'", "position, velocity, off"]),
        (lambda s: s.set_mode("joint_1", "velocity"), ["joint_1", "velocity"]),
        (lambda s: s.set_mode("joint_2", "off"), ["'joint_2'", "joint_1"]),
        (lambda s: s.set_supply(-1.0), ["-1 V"]),
        (lambda s: s.set_supply(float("nan")), ["[nan]"]),
        (lambda s: s.set_brake("joint_2", True), ["'joint_2'", "joint_1"]),
    ],
)
def test_what_cannot_be_set_is_refused(call, names) -> None:
    with raises(ModelError, *names):
        call(pendulum())


def test_only_servos_have_modes_and_motors_need_joints() -> None:
    wound = dynsim.Simulation(dynsim.load_scenario("elbow_comparison", variant="no_elbow"))
    with raises(ModelError, "joint_1"):
        wound.set_mode("joint_1", "off")
    with raises(ModelError, "'joint_7'", "joint_1"):
        dynsim.Simulation(dynsim.load_scenario("single_pendulum"), motors=[servo("joint_7")])
