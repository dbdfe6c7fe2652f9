"""MuJoCo as a second oracle: accelerations, the arm with its motors, held braces and soft contacts.

MuJoCo's motor state and its semi-implicit Euler method are of first order in the step h. Trajectories and held forces
agree to O(h): halving the step halves the error; for the free arm, Richardson extrapolation leaves less than 5 % of it.
The force of a soft contact differs by O(h²) without friction, by less than 0.2 % with friction at one step.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

mujoco = pytest.importorskip("mujoco", minversion="4.0")

from studies.bench.job import CASES, prepare_case  # noqa: E402
from studies.bench.mujoco_peer import build_mujoco, roll_out, setpoints, state_of  # noqa: E402

from dynsim.compile.model import Model  # noqa: E402
from dynsim.compile.tables import compile_contacts, compile_drives, compile_loads  # noqa: E402
from dynsim.dynamics import tables as ka  # noqa: E402
from dynsim.dynamics.derivative import System  # noqa: E402
from dynsim.dynamics.state import OUT_FORCE, OUT_SLIP, OUT_VECTOR, state_layout  # noqa: E402
from dynsim.engine.simulation import (  # noqa: E402
    Prepared,
    prepare,
)
from dynsim.integrators import run as ki  # noqa: E402
from dynsim.integrators.driver import advance  # noqa: E402
from dynsim.jit.kernel import integers, reals  # noqa: E402
from dynsim.model.description import Inertia, Link, Robot  # noqa: E402
from dynsim.scenario import load_scenario  # noqa: E402

TIGHT = {"integrator.rtol": 1e-11, "integrator.atol": 1e-13}


def random_tree(seed: int, n: int) -> Robot:
    """Revolute and prismatic joints on random axes, random placements, inertia tensors of random point clouds."""
    rng = np.random.default_rng(seed)
    links = []
    for i in range(n):
        cloud, masses = 0.2 * rng.normal(size=(5, 3)), rng.uniform(0.1, 1.0, 5)
        com = masses @ cloud / masses.sum()
        tensor = sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, cloud - com, strict=True))
        axis = rng.normal(size=3) if rng.random() < 0.5 else np.eye(3)[rng.integers(3)]
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        links.append(
            Link(
                name=f"body_{i}",
                joint=f"joint_{i}",
                parent=None if i == 0 else f"body_{rng.integers(max(0, i - 3), i)}",
                kind="prismatic" if rng.random() < 0.3 else "revolute",
                axis=axis / np.linalg.norm(axis),
                inertia=Inertia(float(masses.sum()), com, tensor),
                R_PJ=turn * np.linalg.det(turn),
                p_PJ=0.3 * rng.normal(size=3),
                damping=float(rng.uniform()),
            )
        )
    return Robot("random tree", tuple(links), (), (links[-1].name, np.zeros(3)))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 15))
def test_accelerations_of_random_trees(seed: int, n: int) -> None:
    """v̇ of mj_forward under random torques; MuJoCo's inertias pass through a diagonalisation, hence 1e-9."""
    robot = random_tree(seed, n)
    model = Model(robot)
    nothing = ka.ReferenceArrays(integers([]), reals([]), reals([0, 1]), reals(np.zeros((1, 0, 6))))
    drives, contacts = compile_drives(robot, k_p=[], k_d=[]), compile_contacts(robot, [])
    system = System(
        state_layout(n, n, 0, 0), model.arrays, drives, nothing, contacts, compile_loads(model.robot, ()), None
    )
    peer = build_mujoco(system, step=1e-3, motors=False)
    # MuJoCo numbers joints depth first, dynsim in the order of the description.
    order = [mujoco.mj_name2id(peer, mujoco.mjtObj.mjOBJ_JOINT, f"joint_{i}") for i in range(n)]
    rng = np.random.default_rng(seed)
    q, v, tau = rng.uniform(-2, 2, (3, n))
    data = mujoco.MjData(peer)
    data.qpos[order], data.qvel[order], data.qfrc_applied[order] = q, v, tau
    mujoco.mj_forward(peer, data)
    acceleration = model.forward_dynamics(q, v, tau - model.damping * v)
    scale = max(1.0, float(np.abs(acceleration).max()))
    np.testing.assert_allclose(data.qacc[order], acceleration, rtol=0, atol=1e-9 * scale)


def integrate(prepared: Prepared) -> ki.Run:
    advance(prepared.system, prepared.workspace, prepared.run, 10**9)
    assert prepared.run.count[ki.STATUS] == ki.FINISHED
    return prepared.run


def test_free_arm_with_motors_converges_to_dynsim() -> None:
    """Angles and currents of the whole start transient: error ∝ h, and nothing left at h → 0."""
    prepared = prepare(load_scenario("elbow_comparison", "no_elbow", {**TIGHT, "duration_s": 0.5}))
    run = integrate(prepared)
    q, i = run.states("q")[1:], run.states("current")[1:]
    angle_errors, current_errors = [], []
    for step in (4e-5, 2e-5, 1e-5):
        peer = build_mujoco(prepared.system, step=step)
        controls = setpoints(prepared.system, np.arange(round(0.5 / step)) * step)
        start = state_of(peer, prepared.model.robot.initial)
        peer_q, _, peer_i = roll_out(peer, mujoco.MjData(peer), start, controls)
        rows = np.round(run.sample_time[1:] / step).astype(int) - 1
        angle_errors.append(peer_q[rows] - q)
        current_errors.append(peer_i[rows] - i)
    for errors in (angle_errors, current_errors):
        size = [float(np.abs(error).max()) for error in errors]
        assert 1.9 < size[0] / size[1] < 2.1
        assert 1.9 < size[1] / size[2] < 2.1
        # First order cancelled: what is left is of second order, fastest pole × h = 0.02 smaller.
        left = float(np.abs(2.0 * errors[2] - errors[1]).max())
        assert left < 0.05 * size[2]
    assert float(np.abs(angle_errors[2]).max()) < 1e-4


def test_force_of_two_braces_held_by_equality_constraints() -> None:
    """Both elbows on spheres, without friction: MuJoCo's equality on a tendon is the same one-row constraint."""
    prepared = prepare_case(CASES["two elbows held, no friction"], {**TIGHT, "duration_s": 1.0})
    run = integrate(prepared)
    force = run.outputs("contact")[:, :, OUT_FORCE]
    worst = []
    for step in (5e-4, 2.5e-4):
        peer = build_mujoco(prepared.system, step=step, contacts="equality")
        samples = _forces(peer, prepared, step, 1.0, lambda peer, data: data.efc_force[:2].copy())
        rows = np.round(run.sample_time[20:-1] / step).astype(int)
        worst.append(float(np.abs(samples[rows] - force[20:-1]).max()))
        # Settled: constraint impedance 0.9999 leaves 1e-4 of the force to softness, the step far less.
        np.testing.assert_allclose(samples[-1], force[-1], rtol=1e-5)
    # From 0.1 s on the arm still swings: O(h).
    assert worst[0] < 0.01 * np.abs(force).max()
    assert 1.7 < worst[0] / worst[1] < 2.3
    assert force[-1, 0] < 0.0 < force[-1, 1]  # elbow 4 is pulled, elbow 7 pushed


def test_force_of_a_soft_contact_without_friction() -> None:
    """Elbow 7 alone presses on the floor: MuJoCo's contact gives the force of the hard one, its softness ∝ h²."""
    options = {**TIGHT, "duration_s": 2.0, "contacts.friction": 0.0}
    prepared = prepare(load_scenario("elbow_comparison", "elbow_7", options))
    run = integrate(prepared)
    force = run.outputs("contact")[:, 0, OUT_FORCE]
    errors = []
    for step in (1e-3, 5e-4):
        peer = build_mujoco(prepared.system, step=step, contacts="soft")
        samples = _forces(peer, prepared, step, 2.0, _contact_force)
        rows = np.round(run.sample_time[200:-1] / step).astype(int)
        errors.append(float(np.abs(samples[rows, 0] - force[200:-1]).max()))
    assert force[200:].min() > 7.0
    assert errors[0] < 1e-3
    assert errors[0] / errors[1] > 3.0


def test_force_of_a_soft_contact_with_friction() -> None:
    """Elbow 4 alone presses and slides: the normal force within 0.2 %, friction on the cone.

    dynsim's smoothed friction is μ f_n |v_t|/√(|v_t|² + v_s²), MuJoCo's μ f_n once it slides.
    """
    prepared = prepare(load_scenario("elbow_comparison", "elbow_4", {**TIGHT, "duration_s": 3.0}))
    run = integrate(prepared)
    peer = build_mujoco(prepared.system, step=1e-3, contacts="soft", cone="elliptic")
    sample = _forces(peer, prepared, 1e-3, 3.0, _contact_force)[-1]
    touch = run.outputs("contact")[-1, 0]
    f, (fx, fy, fz), slip = touch[OUT_FORCE], touch[OUT_VECTOR : OUT_VECTOR + 3], touch[OUT_SLIP : OUT_SLIP + 3]
    assert sample[0] == pytest.approx(f, rel=2e-3)
    assert np.hypot(sample[1], sample[2]) == pytest.approx(0.1 * sample[0], rel=1e-4)
    speed = float(np.linalg.norm(slip))
    assert np.hypot(fx, fy) == pytest.approx(0.1 * f * speed / np.hypot(speed, 1e-3), rel=1e-9)
    assert fz == pytest.approx(f, rel=1e-12)


def _contact_force(peer, data):
    """Normal and two tangential forces of the only contact [N]; zero while it is open."""
    wrench = np.zeros(6)
    if data.ncon:
        mujoco.mj_contactForce(peer, data, 0, wrench)
    return wrench[:3].copy()


def _forces(peer, prepared: Prepared, step: float, duration: float, read) -> np.ndarray:
    """What ``read`` finds in each step; row k belongs to time k h, because a step ends by moving the state on."""
    data = mujoco.MjData(peer)
    data.qpos[:] = prepared.model.robot.initial
    rows = []
    for control in setpoints(prepared.system, np.arange(round(duration / step) + 1) * step):
        data.ctrl[:] = control
        mujoco.mj_step(peer, data)
        rows.append(read(peer, data))
    return np.array(rows)
