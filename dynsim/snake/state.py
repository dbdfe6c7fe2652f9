"""Data of the tick loop: schedule, state of plant and controller, workspace, recorded rows.

The state of the plant is the pose of the base part, the joint angles and the wheel angles. The pose of the controlled
point follows from them and is not integrated, so that its error contains no drift.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dynsim.snake.controller import ControlWork, new_work
from dynsim.snake.kinematics import SnakeModel

# Source of the state that the controller believes; GIVEN: the caller that moves the robot writes it.
MEASURED, ESTIMATED, FEEDFORWARD, GIVEN = 0, 1, 2, 3
# Why a command cannot be carried out.
NO_OBSTACLE, JOINT_LIMIT, RATE_LIMIT, SINGULAR, ATTITUDE = 0, 1, 2, 3, 4
# State.counts
MODE = 0  # row of the mode in ControlLaw.grounded
TICKS = 1  # run
CLAMPED = 2  # joint-ticks clamped at a limit
CARRIED_OUT = 3  # commands carried out of the present block
WAITED = 4  # ticks in which the command could not be carried out and the target waited
SLOWED = 5  # ticks slowed down
NULL_REDUCED = 6  # ticks with less null-space motion
WAITED_FOR = 6  # + JOINT_LIMIT … ATTITUDE: ticks that waited for it
PATH_SLOWED = WAITED_FOR + ATTITUDE + 1  # ticks in which the target moved slower than commanded
STILL = PATH_SLOWED + 1  # ticks for which the target has now waited without a break
STILL_FOR = STILL + 1  # what it waited for last
COUNTS_SIZE = STILL_FOR + 1
# State.progress
DONE = 0  # part of the present row of commands that is carried out, 0 to 1
LATE = 1  # control periods that a slower target has lost


class Schedule(NamedTuple):
    """Sampling of the controller."""

    period: float  # control period [s]
    midpoint: int  # 1: the held rates are those of the predicted middle of the period; 0: those of its beginning
    substeps: int  # integration steps of the plant in one control period
    state_source: int  # MEASURED, ESTIMATED, FEEDFORWARD or GIVEN
    null_start_tick: int


class SnakeState(NamedTuple):
    """Everything that changes from tick to tick."""

    base: np.ndarray  # (3,) x, y, yaw at wheel pair 1
    phi: np.ndarray  # (n_phi,)
    rho: np.ndarray  # (n_w,)
    w_target: np.ndarray  # (6,) w_d, integrated from the commanded velocity
    w_hat: np.ndarray  # (6,) what the controller believes of w
    phi_hat: np.ndarray  # (n_phi,) what the controller believes of phi
    counts: np.ndarray  # (COUNTS_SIZE,) int
    progress: np.ndarray  # (2,)


class TickWorkspace(NamedTuple):
    """Workspace of the tick loop."""

    work: ControlWork
    base_rate: np.ndarray  # (3,)
    base_sum: np.ndarray  # (3,)
    base_stage: np.ndarray  # (3,)
    phi_stage: np.ndarray  # (n_phi,)
    normal: np.ndarray  # (3, 4)
    px: np.ndarray  # (n_b,) base joint positions relative to pair 1
    py: np.ndarray
    pose: np.ndarray  # (6,)
    target: np.ndarray  # (6,)
    rate: np.ndarray  # (6,) rate of the target that is carried out
    origin: np.ndarray  # (3,)


class SnakeTrace(NamedTuple):
    """Recorded rows; row r belongs to tick r * stride."""

    base: np.ndarray  # (R, 3)
    phi: np.ndarray  # (R, n_phi)
    rho: np.ndarray  # (R, n_w)
    u: np.ndarray  # (R, n_phi + n_w)
    w: np.ndarray  # (R, 6)
    w_target: np.ndarray  # (R, 6)
    w_hat: np.ndarray  # (R, 6)
    mode: np.ndarray  # (R,) row of ControlLaw.grounded
    cost: np.ndarray  # (R,)
    sigma: np.ndarray  # (R,)
    margin: np.ndarray  # (R,)
    area: np.ndarray  # (R,) of the support polygon
    slip: np.ndarray  # (R,)
    at_limit: np.ndarray  # (R, n_phi)
    centre: np.ndarray  # (R, 3)


def new_state(model: SnakeModel) -> SnakeState:
    """Zero state."""
    joints = model.head_joints + model.base_joints
    return SnakeState(
        base=np.zeros(3),
        phi=np.zeros(joints),
        rho=np.zeros(model.wheels),
        w_target=np.zeros(6),
        w_hat=np.zeros(6),
        phi_hat=np.zeros(joints),
        counts=np.zeros(COUNTS_SIZE, dtype=np.int64),
        progress=np.zeros(2),
    )


def new_tick_workspace(model: SnakeModel) -> TickWorkspace:
    """Empty workspace of :func:`run_ticks`."""
    joints = model.head_joints + model.base_joints
    return TickWorkspace(
        work=new_work(model),
        base_rate=np.zeros(3),
        base_sum=np.zeros(3),
        base_stage=np.zeros(3),
        phi_stage=np.zeros(joints),
        normal=np.zeros((3, 4)),
        px=np.zeros(model.base_joints),
        py=np.zeros(model.base_joints),
        pose=np.zeros(6),
        target=np.zeros(6),
        rate=np.zeros(6),
        origin=np.zeros(3),
    )


def new_trace(model: SnakeModel, rows: int) -> SnakeTrace:
    """Empty recording of ``rows`` samples."""
    joints = model.head_joints + model.base_joints
    return SnakeTrace(
        base=np.zeros((rows, 3)),
        phi=np.zeros((rows, joints)),
        rho=np.zeros((rows, model.wheels)),
        u=np.zeros((rows, joints + model.wheels)),
        w=np.zeros((rows, 6)),
        w_target=np.zeros((rows, 6)),
        w_hat=np.zeros((rows, 6)),
        mode=np.zeros(rows, dtype=np.int64),
        cost=np.zeros(rows),
        sigma=np.zeros(rows),
        margin=np.zeros(rows),
        area=np.zeros(rows),
        slip=np.zeros(rows),
        at_limit=np.zeros((rows, joints), dtype=np.int64),
        centre=np.zeros((rows, 3)),
    )
