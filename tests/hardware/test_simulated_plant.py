"""The simulated arm behind virtual servos: gravity sags it, the floor holds its elbows up, and limp it falls."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import dynsim
from dynsim.hardware.errors import ServoMapError
from dynsim.hardware.servo_map import load_servo_map
from dynsim.hardware.virtual.line import VirtualLine, line_for_map
from dynsim.hardware.virtual.servo_plant import MotorLaw
from dynsim.hardware.virtual.simulated_plant import CONTACT_STIFFNESS, SimulatedArm, simulated_arm

SCENARIOS = Path(__file__).parents[2] / "scenarios"


def armed(variant: str, posture: dict[str, float] | None = None) -> tuple[VirtualLine, SimulatedArm, dynsim.Model]:
    """The published arm on servos, holding a posture (its initial one) for two seconds."""
    servo_map = load_servo_map(SCENARIOS / "hardware" / "arm.yaml")
    plant = simulated_arm(str(SCENARIOS / "elbow_comparison.yaml"), variant, servo_map, posture or {})
    line = line_for_map(servo_map, plant=plant)
    for id_ in servo_map.ids:
        assert not line.servos.write(id_, 64, b"\1")
        line.advance(line.time + 0.01)
    line.advance(line.time + 2.0)
    model = dynsim.build_model(dynsim.load_scenario(SCENARIOS / "elbow_comparison.yaml", variant=variant))
    return line, plant, model


def test_a_held_posture_sags_by_gravity_torque_over_stiffness() -> None:
    """At rest k (θ_set − θ) = g(q): what the servos measure is the load of the model."""
    posture = {"joint_1": 0.0} | {f"joint_{k}": 0.02 for k in range(2, 11)}
    line, plant, model = armed("no_elbow", posture)
    # Upright, gravity takes away most of the stiffness: it takes its time to come to rest.
    line.advance(line.time + 8.0)
    q = plant.joint_positions
    sag = np.array(list(posture.values())) - q
    load = model.bias_forces(q, np.zeros(10))
    stiffness = MotorLaw(
        [servo.model for servo in load_servo_map(SCENARIOS / "hardware" / "arm.yaml").servos]
    ).stiffness
    # The posture is taken over in whole ticks: half a tick of 1.5 mrad times 41 N·m/rad is 0.03 N·m.
    assert stiffness * sag == pytest.approx(load, abs=0.05)
    assert np.abs(load).max() > 1.0


def test_braced_elbows_rest_on_the_floor_and_unload_the_servos() -> None:
    _, free, _ = armed("no_elbow")
    _, braced, model = armed("two_elbows")
    q = braced.joint_positions
    heights = [model.point_position(body, np.zeros(3), q)[2] for body in ("link_4", "link_7")]
    total_weight = 10 * 0.1 * 9.81
    assert min(heights) > -3 * total_weight / CONTACT_STIFFNESS - 1e-3
    # They rest: one presses into the floor, and the other is next to it (the servos sag by some millimetres).
    assert min(heights) < 0.0
    assert max(heights) < 5e-3
    assert np.abs(braced.torque).max() < 0.6 * np.abs(free.torque).max()


def test_a_limp_arm_falls_and_stays_above_the_floor_with_its_elbows() -> None:
    line, plant, model = armed("two_elbows")
    before = model.point_position(*model.robot.hand, plant.joint_positions)[2]
    for id_ in line.servos.ids:
        line.servos.write(id_, 64, b"\0")
    line.advance(line.time + 0.5)
    assert np.isfinite(plant.position).all()
    elbows = [model.point_position(body, np.zeros(3), plant.joint_positions)[2] for body in ("link_4", "link_7")]
    assert min(elbows) > -3 * 10 * 0.1 * 9.81 / CONTACT_STIFFNESS - 1e-3
    assert model.point_position(*model.robot.hand, plant.joint_positions)[2] < before - 0.1


def test_a_map_of_other_joints_is_refused(rig) -> None:
    with pytest.raises(ServoMapError, match="has servos for shoulder, elbow, wheel; the plant's joints are joint_1"):
        simulated_arm(str(SCENARIOS / "elbow_comparison.yaml"), "two_elbows", rig.map, {})
