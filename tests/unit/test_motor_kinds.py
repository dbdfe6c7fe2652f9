"""Kinds of motors in scenarios: their keys, the gains that apply, and errors that name the fix."""

from __future__ import annotations

import numpy as np
import pytest
from support.messages import raises

from dynsim import load_scenario
from dynsim.dynamics import tables as ka
from dynsim.engine.simulation import prepare
from dynsim.errors import DynsimError

SERVO = {
    "type": "servo",
    "voltage_V": 12,
    "stall_torque_N_m": 8.4,
    "no_load_speed_rad_per_s": 4.8,
    "k_p_V_per_rad": 60,
}
TORQUE = {"type": "torque", "limit_N_m": 2}
PENDULUM = """
duration_s: 0.2
plant:
  type: serial_arm
  chain:
    - {axis: y, initial_deg: 30, motor: {type: wang_minami}}
    - {axis: y, initial_deg: 20, motor: {type: wang_minami}}
controller: {type: joint_pd}
"""


@pytest.fixture
def scenario(tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text(PENDULUM, encoding="utf-8")

    def load(first, second, **controller):
        overrides = {"plant.chain.0.motor": first, "plant.chain.1.motor": second}
        overrides |= {f"controller.{key}": value for key, value in controller.items()}
        return load_scenario(path, overrides=overrides)

    return load


def test_servo_parameters_follow_from_its_data_sheet(scenario):
    limits = {"current_limit_A": 3.0, "torque_limit_N_m": 5.0}
    drives = prepare(scenario({**SERVO, **limits}, TORQUE)).system.drives
    np.testing.assert_array_equal(drives.table[:, ka.DRIVE_KIND], [ka.POSITION_SERVO, ka.OPEN_TORQUE])
    servo = drives.motor[0]
    # At stall U drives τ_stall, at ω_0 the back-EMF is U.
    assert servo[ka.K_M] * 12 / servo[ka.RESISTANCE] == pytest.approx(8.4)
    assert servo[ka.K_M] * 4.8 == pytest.approx(12)
    assert servo[ka.I_MAX] == pytest.approx(2.0)  # the torque limit is the lower one
    assert drives.motor[1, ka.I_MAX] == 2.0


def test_gains_of_the_controller_are_for_dc_motors(scenario):
    dc = {"type": "wang_minami"}
    drives = prepare(scenario(SERVO, dc, k_p_V_per_rad=[70], k_d_V_s_per_rad=3)).system.drives
    assert drives.motor[:, ka.K_P].tolist() == [60.0, 70.0]
    assert drives.motor[:, ka.K_D].tolist() == [0.0, 3.0]
    assert drives.table[:, ka.CIRCUIT].tolist() == [-1, 0]


def test_without_a_controller_servos_hold_and_torque_sources_rest(scenario, tmp_path):
    prepared = prepare(
        load_scenario(
            tmp_path / "arm.yaml",
            overrides={
                "plant.chain.0.motor": SERVO,
                "plant.chain.1.motor": TORQUE,
                "controller": None,
            },
        )
    )
    np.testing.assert_allclose(prepared.control.reference.held, [np.deg2rad(30), 0.0], rtol=1e-15)


JOINT_2 = {"times_s": [0, 1], "angles_deg": [0, 1]}


@pytest.mark.parametrize(
    ("first", "second", "controller", "names"),
    [
        (SERVO, TORQUE, {"k_p_V_per_rad": 3}, "k_p_V_per_rad DC"),
        (SERVO, {"type": "wang_minami"}, {"k_p_V_per_rad": [3, 4]}, "k_p_V_per_rad 2 1 DC"),
        (SERVO, TORQUE, {"joints": {"joint_2": JOINT_2}}, "joint_2 torque controller.torques.joint_2"),
        (SERVO, TORQUE, {"torques": {"joint_1": {"times_s": [0, 1], "torques_N_m": [0, 1]}}}, "torques.joint_1 torque"),
        (
            SERVO,
            TORQUE,
            {"torques": {"joint_2": {"times_s": [0, 1], "torques_N_m": [0, 1, 2]}}},
            "controller.torques.joint_2 2 times_s 3 torques_N_m",
        ),
        ({**SERVO, "mode": "velocity"}, TORQUE, {}, "plant.chain.0.motor.k_v_V_s_per_rad velocity"),
        ({**SERVO, "k_p_V_per_rad": 0}, TORQUE, {}, "plant.chain.0.motor.k_p_V_per_rad 0 position"),
        ({**SERVO, "k_v_V_s_per_rad": 1}, TORQUE, {}, "plant.chain.0.motor.k_v_V_s_per_rad 1 position"),
    ],
)
def test_what_makes_no_sense_is_refused(scenario, first, second, controller, names):
    with raises(DynsimError, *names.split()):
        prepare(scenario(first, second, **controller))


def test_a_servo_does_not_slide(scenario, tmp_path):
    with raises(DynsimError, "joint_1", "prismatic"):
        prepare(
            load_scenario(
                tmp_path / "arm.yaml",
                overrides={
                    "plant.chain.0": {"axis": "z", "kind": "prismatic", "motor": SERVO},
                },
            )
        )
