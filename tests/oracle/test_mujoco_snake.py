"""The dynamic snake in the MuJoCo model of the benchmark: mass matrix, servo torques and one manoeuvre."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", minversion="4.0")

from studies.bench.snake import BETA, SCENARIO, Z, build_snake, positions, run_dynsim, run_mujoco  # noqa: E402

from dynsim.dynamics import tables as ka  # noqa: E402
from dynsim.dynamics.drive.law import (  # noqa: E402
    servo_command,
    servo_torque,
)
from dynsim.engine.simulation import (  # noqa: E402
    Prepared,
    prepare,
)
from dynsim.scenario import load_scenario  # noqa: E402


@pytest.fixture(scope="module")
def snake() -> tuple[Prepared, Any]:
    prepared = prepare(load_scenario(SCENARIO, "x", {"plant.dynamics.start": "released"}))
    return prepared, build_snake(prepared, 2.5e-3)


def random_state(prepared: Prepared, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    q = prepared.model.robot.initial.copy()
    q[:7], q[7:] = rng.normal(size=7), rng.uniform(-1.0, 1.0, len(q) - 7)
    q[3:7] /= np.linalg.norm(q[3:7])
    return q, rng.uniform(-2.0, 2.0, prepared.model.n)


@pytest.mark.parametrize("seed", range(5))
def test_mass_matrix(snake: tuple[Prepared, Any], seed: int) -> None:
    prepared, peer = snake
    data, (q, _) = mujoco.MjData(peer), random_state(prepared, seed)
    data.qpos[:] = positions(peer, prepared.model.robot, q)
    mujoco.mj_forward(peer, data)
    M = np.zeros((peer.nv, peer.nv))
    mujoco.mj_fullM(peer, data, M)
    order = [*range(6), *(peer.joint(joint).dofadr[0] for joint in prepared.model.joint_names[6:])]
    own = prepared.model.mass_matrix(q) + np.diag(prepared.model.armature)
    assert np.abs(M[np.ix_(order, order)] - own).max() < 1e-9 * np.abs(own).max()


@pytest.mark.parametrize("seed", range(5))
def test_torques_of_servos(snake: tuple[Prepared, Any], seed: int) -> None:
    """By dynsim's law of each, within limits of the voltage and at them, with the losses of its joint."""
    prepared, peer = snake
    data, (q, v) = mujoco.MjData(peer), random_state(prepared, seed)
    robot, drives, damping = prepared.model.robot, prepared.system.drives, prepared.model.damping
    data.qpos[:] = positions(peer, robot, q)
    expected, dofs, limited = [], [], 0
    for a, (motor, x) in enumerate(zip(robot.motors, np.random.default_rng(seed).uniform(-1.0, 1.0, 24), strict=True)):
        i, mode = robot.joint_names.index(motor.joint), drives.table[a, ka.SERVO_MODE]
        rates, dof = mode == ka.VELOCITY_MODE, peer.joint(motor.joint).dofadr[0]
        angle = q[robot.position_index[i]]
        reference = (0.0, v[i] + x) if rates else (angle + 0.3 * x, 0.0)
        command = servo_command(drives.motor, a, mode, *reference, angle, v[i])
        limited += abs(command) > drives.motor[a, ka.U_MAX]
        expected.append(servo_torque(drives.motor, a, mode, command, v[i]) - damping[i] * v[i])
        data.qvel[dof], data.ctrl[a] = v[i], reference[1] if rates else reference[0]
        dofs.append(dof)
    mujoco.mj_forward(peer, data)
    assert 3 <= limited <= 21
    np.testing.assert_allclose((data.qfrc_actuator + data.qfrc_passive)[dofs], expected, rtol=0, atol=1e-12)


@pytest.mark.long
def test_a_manoeuvre() -> None:
    """Sag and friction of the raised head that nods by 30 degrees: MuJoCo's friction is soft, but hardly so here."""
    scenario = load_scenario(SCENARIO, "beta")
    commands, own = run_dynsim(scenario)
    peer = run_mujoco(build_snake(commands.prepared, 1e-3, stiff=True), commands, scenario.duration_s)
    off = np.abs(peer.displacement - own.displacement)
    assert off[Z] < 0.5e-3
    assert off[BETA] < 2e-3
    soft = run_mujoco(build_snake(commands.prepared, 1e-3), commands, scenario.duration_s)
    assert abs(soft.displacement[Z] - own.displacement[Z]) > 5e-3
