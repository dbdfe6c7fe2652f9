"""The simulated arm on virtual servos: sag by gravity, elbows on a real floor, jams, falls without torque."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.documented_arm import plant
from support.messages import lines_with, raises

import dynsim
from dynsim import cli
from dynsim.errors import ModelError
from dynsim.hardware.bus.control_table import MX_28, MX_106, RAD_PER_TICK
from dynsim.hardware.errors import ServoMapError
from dynsim.hardware.servo_map import load_servo_map
from dynsim.hardware.virtual import simulated_plant
from dynsim.hardware.virtual.line import VirtualLine, line_for_map
from dynsim.hardware.virtual.servos import PHYSICS_STEP
from dynsim.hardware.virtual.simulated_plant import (
    START_CHANGE,
    Drive,
    InertialLoad,
    MotorLaw,
    SimulatedArm,
    _plant_only,
    simulated_arm,
)
from dynsim.model.drives import Servo
from dynsim.record import Record

pytestmark = pytest.mark.long

SCENARIOS = Path(__file__).parents[2] / "scenarios"
ARM = SCENARIOS / "elbow_comparison.yaml"
ARM_MAP = SCENARIOS / "hardware" / "arm.yaml"


GEAR_FRICTION = simulated_plant.GEAR_FRICTION


@pytest.fixture(autouse=True)
def frictionless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gears without friction, so that angles agree with the mechanics to rounding; friction has a separate test."""
    monkeypatch.setattr(simulated_plant, "GEAR_FRICTION", 0.0)


def asked(count: int, *, enabled: bool, at: np.ndarray, voltage: float = 12.0) -> Drive:
    """All servos in position mode, off or at their set points."""
    return Drive(np.full(count, enabled), np.ones(count, dtype=bool), np.array(at), np.zeros(count), voltage)


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
    # They rest: one presses on the floor, and the other is next to it (the servos sag by some millimetres).
    assert min(heights) == pytest.approx(0.0, abs=1e-9)
    assert max(heights) < 5e-3
    assert np.abs(braced.torque).max() < 0.6 * np.abs(free.torque).max()


PLANNED = f"""duration_s: 0.3
{plant("wang_minami")}controller:
  type: joint_pd
  joints:
    joint_1: {{times_s: [0.0, 0.2], angles_deg: [0.0, 0.5]}}
    joint_2: {{times_s: [0.0, 0.2], angles_deg: [47.4168, 47.4168]}}
    joint_3: {{times_s: [0.0, 0.2], angles_deg: [83.2501, 83.2501]}}
    joint_4: {{times_s: [0.0, 0.2], angles_deg: [-40.6669, -40.6669]}}
    joint_5: {{times_s: [0.0, 0.2], angles_deg: [-25.1507, -25.1507]}}
initial: {{on_references: true, on_surface: [link_4, link_5]}}
surfaces: {{floor: {{type: plane}}}}
contacts:
  law: unilateral
  friction: 0.2
  points: {{link_4: {{body: link_4, radius_m: 0.01}}, link_5: {{body: link_5, radius_m: 0.01}}}}
integrator: {{method: time_stepping}}
"""
"""As the planner writes the tutorial's arm: the posture of the plant, before ``initial``, is 10 mm below the floor."""


def test_the_plant_of_a_plan_starts_where_its_servos_are(tmp_path, monkeypatch, capsys) -> None:
    plan, servos = tmp_path / "plan.yaml", tmp_path / "map.yaml"
    plan.write_text(PLANNED)
    servos.write_text(re.sub(r"^  joint_([6-9]|10): .*\n", "", ARM_MAP.read_text(), flags=re.MULTILINE))
    record = dynsim.simulate(dynsim.load_scenario(plan))
    path, out = record.save(tmp_path / "record.h5"), tmp_path / "out"
    options = ["--map", str(servos), "--port", "virtual", "--plant", str(plan), "--out", str(out), "--quiet"]
    monkeypatch.setattr(sys, "argv", ["dynsim", "hw", "replay", str(path), *options])
    with pytest.raises(SystemExit) as leaving:
        cli.main()
    assert not leaving.value.code, capsys.readouterr().err
    measured = Record.load(out / "measured.h5")
    assert measured.complete
    np.testing.assert_allclose(measured["q"][0], record["q"][0], rtol=0, atol=0.05)
    # As by `hw virtual`, which has no record: the scenario's own start.
    plant = simulated_arm(str(plan), None, load_servo_map(servos), {})
    np.testing.assert_allclose(plant.joint_positions, record["q"][0], rtol=0, atol=START_CHANGE)


@pytest.mark.parametrize(("asked_for", "step"), [(None, 1e-3), (2e-4, 2e-4), (0.01, PHYSICS_STEP)])
def test_time_stepping_of_the_scenario_is_that_of_the_plant(asked_for: float | None, step: float) -> None:
    options = {"integrator": {"method": "time_stepping", "step_s": asked_for}, "contacts.law": "unilateral"}
    integrator = _plant_only(dynsim.load_scenario("single_pendulum", overrides=options)).integrator
    assert (integrator.method, integrator.step_s) == ("time_stepping", step)
    assert _plant_only(dynsim.load_scenario(ARM, "no_elbow")).integrator.method == "dopri5"


def test_a_limp_arm_falls_and_stays_above_the_floor_with_its_elbows() -> None:
    line, plant, model = armed("two_elbows")
    # It is quite still when the torque goes: nothing but gravity sets it in motion.
    line.advance(line.time + 3.0)
    assert np.abs(plant.velocity).max() < 1e-4
    before = model.point_position(*model.robot.hand, plant.joint_positions)[2]
    for id_ in line.servos.ids:
        line.servos.write(id_, 64, b"\0")
    line.advance(line.time + 0.5)
    assert np.isfinite(plant.position).all()
    elbows = [model.point_position(body, np.zeros(3), plant.joint_positions)[2] for body in ("link_4", "link_7")]
    assert min(elbows) > -1e-9
    assert model.point_position(*model.robot.hand, plant.joint_positions)[2] < before - 0.1


def test_gear_friction_carries_a_part_of_the_weight(monkeypatch: pytest.MonkeyPatch) -> None:
    """At rest the motor and the friction of the gear carry the weight together."""
    monkeypatch.setattr(simulated_plant, "GEAR_FRICTION", GEAR_FRICTION)
    posture = {"joint_1": 0.0} | {f"joint_{k}": 0.02 for k in range(2, 11)}
    line, plant, model = armed("no_elbow", posture)
    line.advance(line.time + 8.0)
    q, law = plant.joint_positions, MotorLaw([servo.model for servo in load_servo_map(ARM_MAP).servos])
    carried = model.bias_forces(q, np.zeros(10)) - law.stiffness * (np.array(list(posture.values())) - q)
    # Half a tick of 1.5 mrad times 41 N·m/rad is 0.03 N·m.
    assert (np.abs(carried) <= law.friction + 0.05).all()
    assert (np.abs(carried) > 0.06).any()
    line.advance(line.time + 0.5)
    assert np.abs(plant.joint_positions - q).max() < 1e-6


def test_it_is_the_simulation_of_the_same_arm_with_position_servos() -> None:
    """Under moving set points and a failing supply: to 1e-9 with the same steps, else to its tolerances."""
    arm = simulated_arm(str(ARM), "no_elbow", load_servo_map(ARM_MAP), {})
    scenario = dynsim.load_scenario(ARM, variant="no_elbow")
    bare = replace(scenario, config=scenario.config.model_copy(update={"controller": None}))
    # Data sheet at 12 V; all zeros are in the middle of the turn.
    damping = MX_106.stall_torque / MX_106.no_load_speed
    per_volt, stiffness = MX_106.stall_torque / 12.0, 41.0
    motors = [
        Servo(
            joint=f"joint_{k}",
            torque_constant=12.0 / MX_106.no_load_speed,
            resistance=12.0 * (12.0 / MX_106.no_load_speed) / MX_106.stall_torque,
            k_p=stiffness / per_volt,
            armature=damping**2 / (4.0 * stiffness),
        )
        for k in range(1, 11)
    ]
    tight = bare.config.integrator.model_copy(update={"method": "dopri5", "rtol": 1e-12, "atol": 1e-12})
    exact = replace(bare, config=bare.config.model_copy(update={"integrator": tight}))
    same, best = (dynsim.Simulation(variant, duration=10.0, trace=0, motors=motors) for variant in (bare, exact))
    # It has stood on its brakes first, which has let the steps grow.
    for mode, closed, until in (("off", True, 0.0), ("position", False, 1e-3)):
        same.advance(until)
        for joint in arm.simulation.robot.joint_names:
            same.set_mode(joint, mode)
            same.set_brake(joint, closed)
    shafts = arm.position.copy()
    drive = asked(10, enabled=True, at=shafts)
    for k in range(1, 301):
        swing = 0.4 * (np.sin(0.02 * k + np.arange(10)) - np.sin(np.arange(10)))
        drive.set_position, drive.voltage = shafts + swing, 12.0 - 0.02 * k
        arm.step(PHYSICS_STEP, drive)
        for simulation in (same, best):
            simulation.set_supply(drive.voltage)
            for j in range(10):
                target = drive.set_position[j] - 2048 * RAD_PER_TICK
                simulation.set_reference(f"joint_{j + 1}", target)
            simulation.advance(simulation.time + PHYSICS_STEP)
        np.testing.assert_allclose(arm.joint_positions, same.state.q, rtol=0, atol=1e-9)
        np.testing.assert_allclose(arm.joint_positions, best.state.q, rtol=0, atol=5e-6)
        np.testing.assert_allclose(arm.velocity, same.state.v, rtol=0, atol=1e-7)
    assert np.abs(arm.joint_positions - shafts + 2048 * RAD_PER_TICK).max() > 0.3
    # What the servos report is their torque at this very state.
    torque = MotorLaw([MX_106] * 10).torque(arm.position, arm.velocity, drive)
    np.testing.assert_allclose(arm.torque, torque, rtol=0, atol=1e-12)
    assert np.abs(torque).max() > 1.0


@pytest.mark.parametrize("mode", ["position", "velocity", "off"])
def test_a_gear_and_a_reversed_servo_move_the_joint_as_its_equation_says(mode, tmp_path) -> None:
    """(I + J n²) q̈ = ± n τ(± n q + θ_0, ± n q̇) − g(q), by another integrator."""
    file = tmp_path / "map.yaml"
    text = ARM_MAP.read_text().split("kinds:")[0].replace("robot: arm", "robot: pendulum")
    angles = "" if mode == "velocity" else "position_deg: [-40, 40], "
    file.write_text(
        text
        + f"""
kinds:
  swing:
    model: MX-28
    mode: {"velocity" if mode == "velocity" else "position"}
    gear: 2.0
    follows: {{position: q, velocity: v}}
    limits: {{{angles}velocity: 3.5, torque: 6.0}}
    following_error: 0.25
servos:
  joint_1: {{kind: swing, id: 1, sign: -1, zero_tick: 2048}}
"""
    )
    scale, zero, volts, start = -2.0, 2048 * RAD_PER_TICK, 9.0, np.deg2rad(20.0)
    plant = simulated_arm(str(SCENARIOS / "single_pendulum.yaml"), None, load_servo_map(file), {"joint_1": start})
    assert plant.position == pytest.approx([zero + scale * start])
    law = MotorLaw([MX_28])
    model = dynsim.build_model(dynsim.load_scenario(SCENARIOS / "single_pendulum.yaml"))
    drive = Drive(np.array([mode != "off"]), np.array([mode != "velocity"]), np.array([zero]), np.array([1.5]), volts)

    def rates(_: float, y: np.ndarray) -> list[float]:
        q, v = y[:1], y[1:]
        torque = scale * law.torque(zero + scale * q, scale * v, drive) - model.bias_forces(q, v)
        return [y[1], (torque / (model.mass_matrix(q)[0] + law.inertia * scale**2))[0]]

    # Off from the first step on it would stay on its stand.
    plant.step(PHYSICS_STEP, asked(1, enabled=True, at=plant.position))
    first = [plant.joint_positions[0], plant.velocity[0] / scale]
    for _ in range(150):
        plant.step(PHYSICS_STEP, drive)
    solution = solve_ivp(rates, (0.0, 150 * PHYSICS_STEP), first, rtol=1e-10, atol=1e-12)["y"][:, -1]
    assert plant.joint_positions[0] == pytest.approx(solution[0], abs=1e-6)
    assert plant.velocity[0] == pytest.approx(scale * solution[1], abs=1e-5)
    assert abs(solution[0] - first[0]) > 0.05


def test_joints_stay_on_their_stand_until_they_are_switched_on() -> None:
    arm = simulated_arm(str(ARM), "no_elbow", load_servo_map(ARM_MAP), {})
    start, drive = arm.position.copy(), asked(10, enabled=False, at=arm.position)
    drive.enabled[6] = True
    drive.set_position[6] += 0.3
    for _ in range(500):
        arm.step(PHYSICS_STEP, drive)
    assert arm.position[6] - start[6] == pytest.approx(0.3, abs=0.1)
    others = np.arange(10) != 6
    np.testing.assert_allclose(arm.position[others], start[others], rtol=0, atol=1e-9)
    # Once on, a joint that goes limp falls.
    drive.enabled[1] = True
    arm.step(PHYSICS_STEP, drive)
    drive.enabled[1] = False
    for _ in range(100):
        arm.step(PHYSICS_STEP, drive)
    assert arm.position[1] - start[1] > 0.05


@pytest.mark.parametrize("kind", ["arm", "own inertia"])
def test_a_jam_holds_one_shaft_for_a_step_and_then_lets_go(kind: str) -> None:
    arm = simulated_arm(str(ARM), "no_elbow", load_servo_map(ARM_MAP), {})
    plant = arm if kind == "arm" else InertialLoad([MX_106] * 10, arm.position)
    drive = asked(10, enabled=True, at=plant.position + 0.2)
    for _ in range(20):
        plant.step(PHYSICS_STEP, drive)
    assert abs(plant.velocity[4]) > 0.1
    plant.stop(4)
    at = plant.position.copy()
    for _ in range(20):
        plant.stop(4)
        assert abs(plant.velocity[4]) < 1e-12
        plant.step(PHYSICS_STEP, drive)
        assert plant.position[4] == pytest.approx(at[4], abs=1e-12)
    assert np.abs(plant.position - at)[5:].min() > 1e-3
    for _ in range(10):
        plant.step(PHYSICS_STEP, drive)
    assert abs(plant.position[4] - at[4]) > 1e-3


def heights(model: dynsim.Model, q: np.ndarray) -> np.ndarray:
    """Of the two elbows above the floor [m]."""
    return np.array([model.point_position(body, np.zeros(3), q)[2] for body in ("link_4", "link_7")])


def floor_forces(model: dynsim.Model, q: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, float]:
    """Forces on the elbows that touch, (2, 3), from g(q) − τ = Jᵀ f at rest, and what is left of that equation."""
    touching = np.abs(heights(model, q)) < 1e-6
    forces = np.zeros((2, 3))
    bodies = [body for body, there in zip(("link_4", "link_7"), touching, strict=True) if there]
    J = np.vstack([model.point_position_and_jacobian(body, np.zeros(3), q)[1] for body in bodies])
    needed = model.bias_forces(q, np.zeros(10)) - torque
    solved = np.linalg.lstsq(J.T, needed, rcond=1e-9)[0]
    forces[touching] = solved.reshape(-1, 3)
    return forces, float(np.abs(J.T @ solved - needed).max())


def test_a_braced_arm_at_rest_stands_on_the_floor_and_not_in_it() -> None:
    """τ + Jᵀ f = g(q) with forces that press and lie in their cones; no sinking, no creeping."""
    line, plant, model = armed("two_elbows")
    line.advance(line.time + 20.0)
    q = plant.joint_positions.copy()
    assert heights(model, q).min() == pytest.approx(0.0, abs=1e-9)
    forces, left = floor_forces(model, q, plant.torque)
    assert left < 1e-6
    assert forces[:, 2].max() > 1.0
    assert (forces[:, 2] > -1e-6).all()
    assert (np.hypot(forces[:, 0], forces[:, 1]) <= 0.1 * forces[:, 2] + 1e-6).all()
    line.advance(line.time + 20.0)
    np.testing.assert_allclose(plant.joint_positions, q, rtol=0, atol=1e-8)


def test_the_floor_does_not_pull() -> None:
    """Raised by its servos, an arm that was braced stands as one does that never had a floor."""
    servo_map = load_servo_map(ARM_MAP)
    plant = simulated_arm(str(ARM), "two_elbows", servo_map, {})
    model = dynsim.build_model(dynsim.load_scenario(ARM, variant="two_elbows"))
    drive = asked(10, enabled=True, at=plant.position)
    for k in range(10000):
        # Up at the shoulder and at the first elbow.
        drive.set_position[[1, 3]] -= [4e-4, 6e-4] if k < 1000 else 0.0
        plant.step(PHYSICS_STEP, drive)
    q = plant.joint_positions
    assert heights(model, q).min() > 0.02
    free = simulated_arm(str(ARM), "no_elbow", servo_map, dict(zip(model.robot.joint_names, q, strict=True)))
    for _ in range(500):
        free.step(PHYSICS_STEP, drive)
    np.testing.assert_allclose(free.joint_positions, q, rtol=0, atol=1e-3)
    np.testing.assert_allclose(plant.torque, model.bias_forces(q, np.zeros(10)), rtol=0, atol=1e-2)


@pytest.mark.parametrize("limp", [range(10), range(1, 3)])
def test_an_arm_that_goes_limp_falls_on_its_contact_points_and_gains_no_energy(limp: range) -> None:
    """Whole, it goes on folding slowly for minutes; limp at its shoulder alone it comes to rest."""
    arm = simulated_arm(str(ARM), "two_elbows", load_servo_map(ARM_MAP), {"joint_2": 0.3})
    model = dynsim.build_model(dynsim.load_scenario(ARM, variant="two_elbows"))
    law = MotorLaw([MX_106] * 10)
    held = np.array([k not in limp for k in range(10)])
    drive = asked(10, enabled=True, at=arm.position)
    arm.step(PHYSICS_STEP, drive)
    drive.enabled[:] = held
    energies, lowest = [], 0.0
    for _ in range(6000):
        arm.step(PHYSICS_STEP, drive)
        q, v = arm.joint_positions, arm.velocity  # no gears, no reversed servos
        lowest = min(lowest, heights(model, q).min())
        springs = 0.5 * law.stiffness @ (held * (drive.set_position - arm.position) ** 2)
        energies.append(model.kinetic_energy(q, v) + 0.5 * law.inertia @ v**2 + model.potential_energy(q) + springs)
    assert energies[0] - energies[-1] > 1.0
    assert np.diff(energies).max() < 1e-6 * (energies[0] - energies[-1])
    assert lowest > -1e-9
    if held.any():
        assert np.abs(arm.velocity).max() < 1e-4
        forces, left = floor_forces(model, arm.joint_positions, arm.torque * held)
        assert forces[:, 2].sum() > 1.0
        assert left < 1e-3
    else:
        np.testing.assert_allclose(heights(model, arm.joint_positions), 0.0, rtol=0, atol=1e-9)


def test_a_braced_arm_bears_jams_and_servos_without_power() -> None:
    """Brakes close and open with elbows on the floor: forces stay finite, the floor firm, shafts where they are."""
    _, plant, model = armed("two_elbows")
    held = plant.joint_positions.copy()
    drive = asked(10, enabled=True, at=plant.position)
    rng = np.random.default_rng(4)
    for _ in range(40):
        for _ in range(rng.integers(1, 6)):
            plant.stop(int(rng.integers(10)))
        drive.enabled[:] = True
        drive.enabled[rng.integers(10, size=2)] = False
        for _ in range(5):
            plant.step(PHYSICS_STEP, drive)
            assert heights(model, plant.joint_positions).min() > -1e-9
            assert np.isfinite(plant.torque).all()
    drive.enabled[:], drive.voltage = True, 12.0
    for _ in range(3000):
        plant.step(PHYSICS_STEP, drive)
    # Servos and friction: not the same place, but near it.
    np.testing.assert_allclose(plant.joint_positions, held, rtol=0, atol=0.1)
    # All jammed for a long time, an arm on the floor neither sinks nor rises.
    for k in range(10):
        plant.stop(k)
    at = plant.joint_positions.copy()
    drive.enabled[:] = False
    for _ in range(300):
        plant.step(PHYSICS_STEP, drive)
        for k in range(10):
            plant.stop(k)
    # Whoever is below the floor by a rounding is brought onto it, against brakes too.
    np.testing.assert_allclose(plant.joint_positions, at, rtol=0, atol=1e-11)


def test_a_posture_in_ticks_starts_on_the_floor_and_a_deeper_one_is_refused(caplog) -> None:
    scenario = dynsim.load_scenario(ARM, variant="two_elbows")
    model, servo_map = dynsim.build_model(scenario), load_servo_map(ARM_MAP)
    names, start = model.robot.joint_names, model.robot.initial
    rng, deepest = np.random.default_rng(1), 0.0
    for _ in range(5):
        seen = RAD_PER_TICK * np.round(start / RAD_PER_TICK + rng.uniform(-1.0, 1.0, 10))
        with caplog.at_level("INFO"):
            arm = simulated_arm(str(ARM), "two_elbows", servo_map, dict(zip(names, seen, strict=True)))
        gap = heights(model, seen)
        deepest = min(deepest, gap.min())
        after = heights(model, arm.joint_positions)
        # What was below lies on the floor, what was above is where it was to first order.
        np.testing.assert_allclose(after[gap < 0.0], 0.0, rtol=0, atol=1e-9)
        assert (after > -1e-9).all()
        assert np.abs(arm.joint_positions - seen).max() < START_CHANGE
        assert bool(lines_with(caplog.text, "rad")) == bool((gap < 0.0).any())
        caplog.clear()
    assert deepest < -1e-4
    with raises(ModelError, "elbow_4", re.compile(r"-0\.0\d+ m\b"), "floor"):
        simulated_arm(str(ARM), "two_elbows", servo_map, {"joint_2": float(start[1]) + 0.05})


def test_a_map_of_other_joints_is_refused(rig) -> None:
    with raises(ServoMapError, "shoulder, elbow, wheel", "joint_1"):
        simulated_arm(str(SCENARIOS / "elbow_comparison.yaml"), "two_elbows", rig.map, {})


def test_servos_that_get_the_goals_of_a_dynamic_snake_go_its_way() -> None:
    """The plant of `hw virtual --plant`, told every 4 ms what the controller of a run tells its own servos.

    With the servo law of the bridge in both. Goals are held here and lines there, and steps are 2 ms: at 0.3 rad/s the
    two are a milliradian apart, wheels by what they turn in a period.
    """
    servo_map = load_servo_map(SCENARIOS / "hardware" / "snake.yaml")
    period, law = 0.004, MotorLaw([MX_106, MX_28])
    joint, wheel = law.servos(["joint", "wheel"], np.ones(2))

    def motor(servo: Servo, stall: float, **gains: Any) -> dict[str, Any]:
        constant = servo.torque_constant
        return {
            "type": "servo",
            "voltage_V": 12.0,
            "stall_torque_N_m": stall,
            "no_load_speed_rad_per_s": 12.0 / constant,
            "rotor_inertia_kg_m2": servo.armature,
            **gains,
        }

    overrides = {
        "plant.level": "dynamic",
        "plant.dynamics.start": "released",
        "plant.dynamics.joint_servo": motor(joint, float(law.stall_torque[0]), k_p_V_per_rad=joint.k_p),
        "plant.dynamics.wheel_servo": motor(
            wheel, float(law.stall_torque[1]), mode="velocity", k_v_V_s_per_rad=wheel.k_v
        ),
        "controller.modes": {1: []},
        "controller.switching": {"order": [1]},
        "controller.period_s": period,
        "integrator.step_s": 0.002,
        "record.rate_hz": 1.0 / period,
        "duration_s": 3.0,
    }
    scenario = dynsim.load_scenario(SCENARIOS / "snake_positioning.yaml", "gamma", overrides)
    record = dynsim.simulate(scenario)
    plant = SimulatedArm(scenario, servo_map, np.array([*record["phi_command"][0], *np.zeros(5 + 7)]))
    names = [servo.label for servo in servo_map.servos]
    commands = {name: record["phi_command"][:, k] for k, name in enumerate(record.labels["phi_command"])}
    rates = {name: record["rho_dot_command"][:, k] for k, name in enumerate(record.labels["rho_dot_command"])}
    still = np.zeros(len(record))
    zero = np.array([servo.zero_tick * RAD_PER_TICK for servo in servo_map.servos])
    sense = np.array([servo.sign for servo in servo_map.servos])
    in_position = np.array([not name.startswith("rho") for name in names])
    reached = []
    for k in range(len(record) - 1):
        positions = zero + sense * np.array([commands.get(name, still)[k] for name in names])
        velocities = sense * np.array([rates.get(name, still)[k] for name in names])
        reached.append(plant.joint_positions[: len(record.labels["phi"])])
        for _ in range(2):
            plant.step(PHYSICS_STEP, Drive(np.ones(len(names), dtype=bool), in_position, positions, velocities, 12.0))
    assert np.abs(record["phi"] - record["phi"][0]).max() > 0.1  # it sags, and it turns its head
    np.testing.assert_allclose(reached, record["phi"][:-1], rtol=0, atol=5e-3)
    np.testing.assert_allclose(plant.simulation.state.q[:2], record["base_pose"][-1, :2], rtol=0, atol=2e-3)
