"""Snake constraints A(q) ẇ = B(q) u against finite differences of an independent chain of homogeneous transforms.

Geometries, modes and states are random, the base tilted and off the ground, so that an error in any term shows.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.messages import raises
from support.random_snakes import robots

from dynsim.compile.protocols import BuildContext
from dynsim.errors import ModelError
from dynsim.jit.kernel import integers, reals
from dynsim.library.plants.snake import Config, build
from dynsim.snake.kinematics import active_rows, constraint_matrices, new_chain, pose_of_point, walk_chain

seeds = st.integers(0, 2**32 - 1)


def rotation(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    R = np.eye(3)
    R[i, i] = R[j, j] = c
    R[j, i], R[i, j] = s, -s
    return R


def pairs_of(robot, w, phi):
    """(R, p) of every wheel pair, by products of transforms from the controlled point tailward."""
    R = rotation("z", w[5]) @ rotation("y", w[4]) @ rotation("x", w[3])
    p = w[:3] - R[:, 0] * robot.point_offset
    pairs = []
    for j, angle in enumerate(phi):
        p = p - robot.link_length * R[:, 0]
        R = R @ rotation("y" if robot.pitch[j] else "z", angle)
        if j >= robot.head_joints:
            p = p - robot.link_length * R[:, 0]
        if j >= robot.head_joints - 1:
            pairs.append((R, p))
    return pairs


def matrices(robot, w, phi):
    model = robot.arrays()
    chain = new_chain(model)
    walk_chain(model, reals(w), reals(phi), np.zeros((3, 3)), chain)
    rows = model.base_joints + 4 + model.wheels
    A, B = np.zeros((rows, 6)), np.zeros((rows, len(phi) + model.wheels))
    constraint_matrices(model, chain, reals(w), A, B)
    return A, B


@given(robots(), seeds)
@settings(max_examples=40, deadline=None)
def test_rows_are_the_velocities_they_claim_to_be(robot, seed):
    random = np.random.default_rng(seed)
    n_phi = len(robot.joint_names)
    # |beta| < 1.3: the Euler rates themselves are singular at pi/2
    w = np.concatenate([random.normal(size=3), random.uniform(-1.3, 1.3, 3)])
    phi, w_dot = random.uniform(-1.5, 1.5, n_phi), random.normal(size=6)
    phi_dot, rho_dot = random.normal(size=n_phi), random.normal(size=robot.active_wheels)
    A, B = matrices(robot, w, phi)
    velocities = A @ w_dot - B @ np.concatenate([phi_dot, rho_dot])

    h = 1e-5  # central difference: truncation h^2 = 1e-10, rounding 1e-16 / h = 1e-11, times lengths and rates < 100
    plus, minus = (pairs_of(robot, w + s * w_dot, phi + s * phi_dot) for s in (h, -h))
    here = pairs_of(robot, w, phi)
    velocity = [(p1 - p0) / (2 * h) for (_, p1), (_, p0) in zip(plus, minus, strict=True)]
    (R1, _), (R0, _) = plus[-1], minus[-1]
    spin = (R1 - R0) / (2 * h) @ here[-1][0].T
    omega_tail = np.array([spin[2, 1], spin[0, 2], spin[1, 0]])

    expected = [R[:, 1] @ v for (R, _), v in zip(here, velocity, strict=True)]
    expected += [velocity[0][2], here[0][0][:, 0] @ omega_tail, here[0][0][:, 1] @ omega_tail]
    wheel = 0
    for i, (R, _) in enumerate(here):
        if robot.driven_side[i]:
            arm = robot.driven_side[i] * robot.half_track[i]
            centre = [p + arm * Ri[:, 1] for Ri, p in (plus[i], minus[i])]
            rolling = R[:, 0] @ (centre[0] - centre[1]) / (2 * h)
            expected.append(rolling - robot.wheel_radius * rho_dot[wheel])
            wheel += 1
    np.testing.assert_allclose(velocities, expected, atol=1e-7)


@given(robots(), seeds)
@settings(max_examples=30, deadline=None)
def test_a_mode_deletes_both_rows_of_its_lifted_pairs(robot, seed):
    model, grounded = robot.arrays(), np.random.default_rng(seed).integers(0, 2, robot.pairs)
    kept = np.zeros(robot.pairs + 3 + robot.active_wheels, dtype=np.int64)
    kept = kept[: active_rows(model, integers(grounded), kept)].tolist()
    driven = np.flatnonzero(robot.driven_side)
    wheels = [robot.pairs + 3 + k for k, pair in enumerate(driven) if grounded[pair]]
    pairs = [i for i in range(robot.pairs) if grounded[i]]
    assert kept == [*pairs, robot.pairs, robot.pairs + 1, robot.pairs + 2, *wheels]


@given(robots(), seeds)
@settings(max_examples=30, deadline=None)
def test_pose_from_the_base_and_chain_from_the_pose_agree(robot, seed):
    """Walking headward from the base and tailward from the head are two code paths; they must meet."""
    random = np.random.default_rng(seed)
    model, w = robot.arrays(), np.zeros(6)
    base = np.array([random.normal(), random.normal(), random.uniform(-3, 3)])
    phi = random.uniform(-1.2, 1.2, len(robot.joint_names))
    pose_of_point(model, base, phi, np.zeros((3, 3)), w)
    chain = new_chain(model)
    walk_chain(model, w, phi, np.zeros((3, 3)), chain)
    np.testing.assert_allclose(chain.pair_position[0], [base[0], base[1], robot.wheel_radius], atol=1e-12)
    np.testing.assert_allclose(chain.pair_position[:, 2], robot.wheel_radius, atol=1e-12)
    np.testing.assert_allclose(chain.pair_x[0], [np.cos(base[2]), np.sin(base[2]), 0.0], atol=1e-12)
    np.testing.assert_allclose(chain.pair_z, np.tile([0.0, 0.0, 1.0], (robot.pairs, 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        ({"head_joints": 2}, ["plant.head_joints = 2", "([T] eq 1)"]),
        ({"head_joints": 5}, ["plant.head_joints = 5"]),
        ({"yaw_joints": 3, "head_joints": 6}, ["plant", "yaw_joints = 3", "head_joints = 6", "n_b = 0"]),
        ({"yaw_joints": 4, "head_joints": 6, "driven_side": "none"}, ["plant", "1 + 0", "[T] eq 16"]),
        ({"wheel_gap_m": [0.1, 0.2]}, ["plant.wheel_gap_m", "2", "7"]),
        (
            {"initial_joints_rad": [1.2, 0, 0, 0, 0, 0]},
            ["plant.initial_joints_rad", "theta1 = 1.2000 rad", "1.1345 rad"],
        ),
        ({"initial_joints_rad": [0.0]}, ["plant.initial_joints_rad", "1", "n_h = 6", "12"]),
    ],
)
def test_impossible_robots_are_refused_with_the_reason(settings, names):
    with raises(ModelError, *names):
        build(Config(**settings), BuildContext(1.0))
