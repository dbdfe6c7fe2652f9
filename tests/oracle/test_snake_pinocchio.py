"""Oracle: every row of A and B from Pinocchio's frame Jacobians, at random non-level states.

Pinocchio walks the chain from the controlled point tailward, the six coordinates of w as three prismatic joints and
three revolute ones in the order of Rz(gamma) Ry(beta) Rx(alpha), so its Jacobian columns are those of w and phi.
"""

import numpy as np
import pinocchio as pin
from hypothesis import given, settings
from hypothesis import strategies as st
from support.random_snakes import robots

from dynsim.jit.kernel import integers, reals
from dynsim.snake.kinematics import active_rows, constraint_matrices, new_chain, walk_chain

LOCAL_ALIGNED = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


def pinocchio_model(robot):
    model = pin.Model()
    parent, here = 0, pin.SE3.Identity()
    for joint in (pin.JointModelPX, pin.JointModelPY, pin.JointModelPZ, pin.JointModelRZ, pin.JointModelRY,
                  pin.JointModelRX):  # fmt: skip
        parent = model.addJoint(parent, joint(), pin.SE3.Identity(), f"w{parent}")
    back = pin.SE3(np.eye(3), np.array([-robot.link_length, 0, 0]))
    here = pin.SE3(np.eye(3), np.array([-robot.point_offset, 0, 0]))
    frames = []
    for j, name in enumerate(robot.joint_names):
        joint = pin.JointModelRY() if robot.pitch[j] else pin.JointModelRZ()
        parent = model.addJoint(parent, joint, here * back, name)
        here = back if j >= robot.head_joints else pin.SE3.Identity()
        if j >= robot.head_joints - 1:
            placed = here if j >= robot.head_joints else pin.SE3.Identity()
            frames.append(model.addFrame(pin.Frame(f"pair{len(frames)}", parent, placed, pin.FrameType.OP_FRAME)))
    return model, frames


def jacobians(robot, w, phi):
    """Jacobian (6, 6 + n_phi) and rotation of every pair, columns ordered x, y, z, alpha, beta, gamma, phi."""
    model, frames = pinocchio_model(robot)
    data = model.createData()
    q = np.concatenate([w[:3], [w[5], w[4], w[3]], phi])
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    order = [0, 1, 2, 5, 4, 3, *range(6, 6 + len(phi))]
    blocks = []
    for frame in frames:
        J = pin.getFrameJacobian(model, data, frame, LOCAL_ALIGNED)[:, order]
        blocks.append((J, data.oMf[frame].rotation, data.oMf[frame].translation))
    return blocks


@given(robots(), st.integers(0, 2**32 - 1))
@settings(max_examples=60)
def test_constraint_rows_are_pinocchio_jacobians(robot, seed):
    """Random geometry (n, n_h, lengths, radius, gaps, sides), state and mode."""
    random = np.random.default_rng(seed)
    n_h, n_b = robot.head_joints, robot.base_joints
    grounded = random.integers(0, 2, robot.pairs)
    n_phi = n_h + n_b
    w = np.concatenate([random.normal(size=3), random.uniform(-1.2, 1.2, 3)])
    phi = random.uniform(-1.5, 1.5, n_phi)
    model, chain = robot.arrays(), new_chain(robot.arrays())
    walk_chain(model, reals(w), reals(phi), np.zeros((3, 3)), chain)
    A, B = np.zeros((n_b + 4 + model.wheels, 6)), np.zeros((n_b + 4 + model.wheels, n_phi + model.wheels))
    constraint_matrices(model, chain, reals(w), A, B)

    pairs = jacobians(robot, w, phi)
    for i, (_, R, p) in enumerate(pairs):
        np.testing.assert_allclose(chain.pair_position[i], p, atol=1e-13)
        np.testing.assert_allclose(np.stack([chain.pair_x[i], chain.pair_y[i], chain.pair_z[i]]).T, R, atol=1e-13)
    rows = [R[:, 1] @ J[:3] for J, R, _ in pairs]
    rows += [pairs[0][0][2]] + [pairs[0][1][:, k] @ pairs[-1][0][3:] for k in (0, 1)]
    for (J, R, _), side, half in zip(pairs, robot.driven_side, robot.half_track, strict=True):
        if side:
            rows.append(R[:, 0] @ J[:3] - side * half * (R[:, 2] @ J[3:]))
    # the mode deletes the side-slip and the rolling row of every lifted pair ([T] eqs 7, 8)
    kept = np.zeros(len(rows), dtype=np.int64)
    kept = kept[: active_rows(model, integers(grounded), kept)]
    driven = robot.driven_side != 0
    stays = np.concatenate([grounded, np.ones(3, dtype=int), grounded[driven]]).astype(bool)
    A, B, expected = A[kept], B[kept], np.array(rows)[stays]
    np.testing.assert_allclose(A, expected[:, :6], atol=1e-13)
    np.testing.assert_allclose(B[:, :n_phi], -expected[:, 6:], atol=1e-13)
    wheels = np.zeros((len(rows), model.wheels))
    wheels[n_b + 4 :] = robot.wheel_radius * np.eye(model.wheels)
    np.testing.assert_array_equal(B[:, n_phi:], wheels[stays])
