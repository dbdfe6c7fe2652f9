"""Pose of a mobile base in the world, from the coordinates q of its robot."""

from __future__ import annotations

import numpy as np

from dynsim.model.description import Array, Link, Robot


def base_row(robot: Robot) -> tuple[int, Link]:
    """Return the index in q at which the base's coordinates (left, right, x, y) begin, and its first row."""
    assert robot.base is not None
    i = robot.joint_names.index(robot.base.wheels[0])
    return robot.position_index[i], robot.links[i]


def base_pose(robot: Robot, q: Array) -> Array:
    """Return x, y [m] and heading [rad, not wrapped] of the base in the world at coordinates q, (T, nq) → (T, 3).

    heading = heading_0 + r (φ_r − φ_l)/T ([WM] II.E: ω_0 T = r (φ̇_r − φ̇_l)).
    """
    k, link = base_row(robot)
    left, right, x, y = q[:, k : k + 4].T
    position = link.p_PJ[:, None] + link.R_PJ @ np.stack([x, y, np.zeros_like(x)])
    start = np.arctan2(link.R_PJ[1, 0], link.R_PJ[0, 0])
    return np.stack([position[0], position[1], start + link.parameter * (right - left)], axis=1)


def base_coordinates(robot: Robot, pose: Array) -> tuple[float, Array]:
    """Return φ_r − φ_l [rad] and the coordinates x, y, (2,) [m], at which the base has a pose of :func:`base_pose`."""
    _, link = base_row(robot)
    x, y, heading = pose
    turn = (heading - np.arctan2(link.R_PJ[1, 0], link.R_PJ[0, 0])) / link.parameter
    return float(turn), (link.R_PJ.T @ (np.array([x, y, link.p_PJ[2]]) - link.p_PJ))[:2]
