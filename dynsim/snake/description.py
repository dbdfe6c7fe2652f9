"""Description of an articulated mobile robot, its modes, commands and task-space controller, and its conditioning."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import ModelError
from dynsim.jit.kernel import integers, reals
from dynsim.snake.controller import ControlLaw
from dynsim.snake.kinematics import SnakeModel, active_rows, constraint_matrices, new_chain, pose_of_point, walk_chain
from dynsim.snake.ticks import Schedule

Policy = Literal["fixed", "cyclic", "predictive"]

COORDINATES = ("x", "y", "z", "alpha", "beta", "gamma")

# Mode requests of an operator; a positive one is the number of a mode.
NO_REQUEST, SWITCHING, FIXING = 0, -1, -2
# A singular value below this part of the largest one is a lost rank, not just a small value.
SINGULAR = 1e-9


@dataclass(frozen=True)
class SnakeDescription:
    """An articulated mobile robot in SI units; n_phi = head_joints + base_joints joints, base_joints + 1 wheel pairs.

    Attributes
    ----------
    joint_names : theta1, psi1, ..., then theta of the base part.
    pitch : (n_phi,) bool
    lower, upper : (n_phi,) joint limits [rad]
    half_track : (pairs,) axle middle to wheel [m]
    driven_side : (pairs,) +1 left, -1 right, 0 passive pair
    link_mass : (head_joints + 2 base_joints,) [kg]
    point_offset : controlled point ahead of the head point [m]
    initial_joints : (n_phi,) [rad]
    initial_base_pose : (3,) x [m], y [m], yaw [rad]
    """

    head_joints: int
    base_joints: int
    link_length: float
    wheel_radius: float
    point_offset: float
    reference_joints: NDArray[np.float64]  # (n_phi,) head raised, base straight: where damping takes its scale
    joint_names: tuple[str, ...]
    pitch: NDArray[np.bool_]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    half_track: NDArray[np.float64]
    driven_side: NDArray[np.int64]
    link_mass: NDArray[np.float64]
    initial_joints: NDArray[np.float64]
    initial_base_pose: NDArray[np.float64]

    @property
    def pairs(self) -> int:
        """Wheel pairs of the base part."""
        return self.base_joints + 1

    @property
    def active_wheels(self) -> int:
        """n_w."""
        return int(np.count_nonzero(self.driven_side))

    @property
    def wheel_names(self) -> tuple[str, ...]:
        """rho1, rho2, ... numbered like the active wheels."""
        return tuple(f"rho{i + 1}" for i in range(self.active_wheels))

    def arrays(self) -> SnakeModel:
        """The description as the kernels want it."""
        driven = self.driven_side != 0
        return SnakeModel(
            head_joints=self.head_joints,
            base_joints=self.base_joints,
            wheels=self.active_wheels,
            link_length=self.link_length,
            wheel_radius=self.wheel_radius,
            point_offset=self.point_offset,
            pitch=integers(self.pitch),
            lower=reals(self.lower),
            upper=reals(self.upper),
            half_track=reals(self.half_track),
            wheel=integers(np.where(driven, np.cumsum(driven) - 1, -1)),
            side=reals(self.driven_side),
            link_mass=reals(self.link_mass),
        )


@dataclass(frozen=True)
class ModeTable:
    """Modes by number; row i of ``grounded`` is mode ``numbers[i]``.

    Attributes
    ----------
    numbers : (modes,) mode numbers as written in the scenario
    grounded : (modes, pairs) 1 where a wheel pair is on the ground
    """

    numbers: tuple[int, ...]
    grounded: NDArray[np.int64]

    @classmethod
    def from_lifted(cls, lifted: Mapping[int, tuple[int, ...] | list[int]], pairs: int) -> ModeTable:
        """Table from the lifted pairs (counted from 1) of each mode.

        Raises
        ------
        ModelError
            No modes, a mode number below 1, or a pair that the robot does not have.
        """
        if not lifted:
            raise ModelError("controller.modes is empty: give at least one mode, e.g. {1: [3, 6]}")
        grounded = np.ones((len(lifted), pairs), dtype=np.int64)
        for row, (number, away) in enumerate(lifted.items()):
            if number < 1:
                raise ModelError(f"controller.modes: mode number {number}; modes are numbered 1, 2, ...")
            for pair in away:
                if not 1 <= pair <= pairs:
                    raise ModelError(f"controller.modes: mode {number} lifts pair {pair}; the pairs are 1 to {pairs}")
                grounded[row, pair - 1] = 0
        return cls(tuple(lifted), grounded)

    def row(self, number: int, key: str) -> int:
        """Row of a mode number; ``key`` is the scenario key to blame when there is none."""
        if number not in self.numbers:
            raise ModelError(f"{key}: no mode {number}; the table has {', '.join(map(str, self.numbers))}")
        return self.numbers.index(number)


class CommandBlock(NamedTuple):
    """Commands of T control periods.

    velocity : (T, 6) mean rate of the target x, y, z [m/s], alpha, beta, gamma [rad/s] in each period
    request : (T,) mode request at its beginning: NO_REQUEST, SWITCHING, FIXING, or a mode number
    gripper : (T,) 1 closed (hardened), 0 open (soft)
    """

    velocity: NDArray[np.float64]
    request: NDArray[np.int64]
    gripper: NDArray[np.int64]


class Feedback(NamedTuple):
    """What an operator sees of the robot at the beginning of a control period.

    time : [s]
    w, w_target : (6,) pose of the controlled point, and its target [m, rad]
    base_pose : (3,) x [m], y [m], yaw [rad]
    phi : (n_phi,) [rad]
    mode : number of the present mode
    waiting : the last command was not carried out, the target waits
    """

    time: float
    w: NDArray[np.float64]
    w_target: NDArray[np.float64]
    base_pose: NDArray[np.float64]
    phi: NDArray[np.float64]
    mode: int
    waiting: bool


class CommandSource(Protocol):
    """What a scripted list and a joystick have in common."""

    def read(self, first: int, count: int, period: float, feedback: Feedback) -> CommandBlock:
        """Commands from control period ``first`` on, as far as they are known now: of 1 to ``count`` periods.

        The engine asks again when they are used up. A script answers with ``count``, a joystick with one.

        Parameters
        ----------
        first, count : the present period (from 0) and how many are left
        period : their length [s]
        feedback : state at the beginning of period ``first``
        """
        ...


class Conditioning(NamedTuple):
    """Ranks of the model of one mode at one posture ([T] eqs 9-11)."""

    rows: int
    rank_A: int  # of A~, full: 6 + m
    rank_B: int  # of B~, full: rows
    redundancy: int  # inputs - rank of B~
    sigma_min_A: float
    sigma_min_B: float
    condition_B: float


@dataclass(frozen=True)
class TaskSpaceController:
    """Everything that the tick loop and the mode switcher need.

    ``prediction`` is the schedule of a predicted period: coarser steps, ``prediction_ticks`` of them.
    """

    law: ControlLaw
    schedule: Schedule
    prediction: Schedule
    prediction_ticks: int
    modes: ModeTable
    fixing_row: int
    order: tuple[int, ...]
    switch_ticks: int
    policy: Policy
    least_margin: float
    when_blocked: bool
    release_fraction: float
    source: CommandSource


def conditioning(
    model: SnakeModel, law: ControlLaw, row: int, base: NDArray[np.float64], phi: NDArray[np.float64]
) -> Conditioning:
    """Ranks and singular values of A~ and B~ ([T] eqs 10, 11) of one mode at a posture on the ground."""
    chain, w, frame = new_chain(model), np.zeros(6), np.zeros((3, 3))
    pose_of_point(model, reals(base), reals(phi), frame, w)
    walk_chain(model, w, reals(phi), frame, chain)
    all_rows, m = model.base_joints + 4 + model.wheels, len(law.shape_joints)
    A, B = np.zeros((all_rows, 6)), np.zeros((all_rows, len(law.root_weight_inverse)))
    constraint_matrices(model, chain, w, A, B)
    kept = np.zeros(all_rows, dtype=np.int64)
    kept = kept[: active_rows(model, law.grounded[row], kept)]
    S = np.zeros((m, B.shape[1]))
    S[np.arange(m), law.shape_joints] = 1.0
    A_shape = np.block([[A[kept], np.zeros((len(kept), m))], [np.zeros((m, 6)), np.eye(m)]])
    B_shape = np.vstack([B[kept], S])
    sa, sb = np.linalg.svd(A_shape, compute_uv=False), np.linalg.svd(B_shape, compute_uv=False)
    rank_b = int(np.sum(sb > SINGULAR * sb[0]))
    full = len(B_shape) <= B_shape.shape[1]
    return Conditioning(
        rows=len(B_shape),
        rank_A=int(np.sum(sa > SINGULAR * sa[0])),
        rank_B=rank_b,
        redundancy=B_shape.shape[1] - rank_b,
        sigma_min_A=float(sa[-1]) if len(A_shape) >= A_shape.shape[1] else 0.0,
        sigma_min_B=float(sb[-1]) if full else 0.0,
        condition_B=float(sb[0] / sb[-1]) if full and sb[-1] > 0 else float("inf"),
    )
