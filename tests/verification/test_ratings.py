"""Ratings of motors: the peak current limits the current; runs warn where rms values exceed the nominal ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.messages import check_message, lines_with, mentions, raises

from dynsim import load_scenario, simulate
from dynsim.engine.kinematic import effort
from dynsim.errors import ScenarioError
from dynsim.model.drives import Servo

ARM = """
duration_s: 1
plant:
  type: serial_arm
  link:
    mass_kg: 0.4
    length_m: 0.4
    damping_N_m_s_per_rad: 0.3
    motor: {type: wang_minami, nominal_current_A: 6, peak_current_A: 12, nominal_torque_N_m: 5}
  chain:
    - {axis: y, initial_deg: 60}
    - {axis: y, initial_deg: 60}
    - {axis: y, initial_deg: -75}
controller: {type: joint_pd}
"""


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text(ARM, encoding="utf-8")
    return path


# A program of its own to compile; its right-hand sides are compared in tests/oracle.
M_STAR = pytest.param({"method": "dopri5", "solver": "m_star"}, marks=pytest.mark.long)


@pytest.mark.parametrize("integrator", [{"method": "radau5"}, {"method": "dopri5"}, M_STAR])
def test_the_peak_current_is_a_limit(arm, integrator):
    """No sample passes it, the arm sags for it, and the ledger closes; all methods and solvers agree."""
    tight = {"integrator.rtol": 1e-9, "integrator.atol": 1e-11, "plant.link.motor.peak_current_A": 7}
    options = {f"integrator.{key}": value for key, value in integrator.items()}
    record = simulate(load_scenario(arm, overrides={**options, **tight}))
    current = np.abs(record["current"])
    # Samples are of dense output, to the tolerance.
    assert 7.0 * (1.0 - 1e-3) < current.max() <= 7.0 * (1.0 + 1e-9)
    # R I is what is left of the voltage there, within rounding.
    held = current[:, 0] > 7.0 * (1.0 - 1e-9)
    assert held.any()
    back = 3.0 * 0.203 * record["v"][held, 0]
    np.testing.assert_allclose(np.abs(record["voltage"][held, 0] - back), 1.1 * 7.0, rtol=1e-9)
    free = simulate(load_scenario(arm, overrides={**options, **tight, "plant.link.motor.peak_current_A": None}))
    assert np.abs(free["current"]).max() > 12.0
    assert record["hand_position"][-1, 2] < free["hand_position"][-1, 2] - 0.01
    assert record.summary["energy_residual_relative"] < 1e-7
    assert lines_with(record.summary["warnings"], "joint_1", "current", "7 A")
    reference = simulate(load_scenario(arm, overrides={"integrator.method": "dopri5", **tight}))
    np.testing.assert_allclose(record["q"][-1], reference["q"][-1], rtol=0, atol=2e-6)


def test_a_limit_out_of_reach_changes_nothing(arm):
    """Without a limit, and with one that is never near."""
    none, far = (
        simulate(load_scenario(arm, overrides={"plant.link.motor.peak_current_A": limit})) for limit in (None, 1e6)
    )
    np.testing.assert_allclose(far["q"], none["q"], rtol=0, atol=1e-12)


def test_rms_stands_beside_nominal_and_is_warned_of(arm):
    record = simulate(load_scenario(arm))
    motors = {motor["joint"]: motor for motor in record.summary["motors"]}
    assert list(motors) == ["joint_1", "joint_2", "joint_3"]
    shoulder = motors["joint_1"]
    squares = record["current"][:, 0] ** 2
    mean = np.trapezoid(squares, record.time) / record.time[-1]
    assert shoulder["current_rms_A"] == pytest.approx(np.sqrt(mean), rel=1e-12)
    assert shoulder["current_max_A"] == np.abs(record["current"][:, 0]).max()
    assert (shoulder["nominal_current_A"], shoulder["peak_current_A"], shoulder["nominal_torque_N_m"]) == (6, 12, 5)
    # Σ R i² T is the Joule heat of the ledger, which the integrator has carried.
    heat = sum(1.1 * motor["current_rms_A"] ** 2 for motor in motors.values()) * record.time[-1]
    assert heat == pytest.approx(record.summary["joule_heat_J"], rel=2e-3)
    warned = lines_with(record.summary["warnings"], phrase="overload")
    assert len(warned) == 2
    assert mentions(warned[0], "joint_1", f"{shoulder['current_rms_A']:.3g}", "6 A")
    assert "joint_3" not in warned[0]


def test_a_peak_below_nominal_is_refused(arm):
    with raises(ScenarioError, "peak_current_A = 5", "nominal_current_A = 6"):
        load_scenario(arm, overrides={"plant.link.motor.peak_current_A": 5})


def test_battery_and_worst_joint_of_a_snake():
    """A fifth of the stall torque is what ROBOTIS lets a servo hold for long: ψ2 under the raised head holds more."""
    summary = simulate(load_scenario("snake_positioning_dynamic", "x", {"duration_s": 0.5})).summary
    assert summary["battery_energy_Wh"] == pytest.approx(summary["electrical_energy_supply_J"] / 3600.0, rel=1e-15)
    worst = summary["worst_joint"]
    assert worst == max(summary["motors"], key=lambda motor: motor["torque_rms_N_m"] / motor["nominal_torque_N_m"])
    assert worst["joint"] == "psi2"
    expected = {"nominal_torque_N_m": 1.68, "stall_torque_N_m": 8.4, "gear_friction_N_m": 0.8}
    assert {key: worst[key] for key in expected} == pytest.approx(expected)
    (warned,) = lines_with(summary["warnings"], phrase="overload")
    check_message(warned, "psi2", f"{worst['torque_rms_N_m']:.3g}", "1.68 N m")


def test_the_worst_joint_is_that_of_the_largest_part_of_its_rating():
    """Nominal torque counts before stall torque; what is rated by neither does not."""
    motors = [
        {"joint": "strong", "torque_rms_N_m": 3.0, "stall_torque_N_m": 10.0},
        {"joint": "weak", "torque_rms_N_m": 1.0, "stall_torque_N_m": 10.0, "nominal_torque_N_m": 2.0},
        {"joint": "unknown", "torque_rms_N_m": 9.0},
    ]
    summary = effort({"electrical_energy_supply_J": 7200.0, "motors": motors})
    assert summary == {"battery_energy_Wh": 2.0, "worst_joint": motors[1]}
    assert "worst_joint" not in effort({"electrical_energy_supply_J": 0.0, "motors": motors[2:]})


def test_stall_torque_is_at_the_lower_limit_of_voltage_and_current():
    """K U / R = 2 · 12 / 3, or K I."""
    servo = Servo("joint", torque_constant=2.0, resistance=3.0, k_p=1.0, voltage_limit=12.0)
    assert servo.stall_torque == pytest.approx(8.0)
    assert replace(servo, current_limit=3.0).stall_torque == pytest.approx(6.0)
    assert replace(servo, torque_limit=5.0).stall_torque == pytest.approx(5.0)
