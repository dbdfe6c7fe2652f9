"""Description of an articulated mobile robot: geometry, modes, commands, task-space controller and conditioning."""

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

# Mode requests of an operator; a positive request is the number of a mode.
NO_REQUEST, SWITCHING, FIXING = 0, -1, -2
# Fraction of the largest singular value below which a singular value counts as zero.
SINGULAR = 1e-9


@dataclass(frozen=True)
class SnakeDescription:
    """Articulated mobile robot with n_phi = head_joints + base_joints joints and base_joints + 1 wheel pairs.

    Attributes
    ----------
    head_joints, base_joints : int
        Number of joints of the head part and of the base part.
    link_length, wheel_radius : float
        Distance between neighbouring joint axes and radius of the wheels [m].
    point_offset : float
        Distance of the controlled point ahead of the head point [m].
    reference_joints : (n_phi,) ndarray
        Joint angles with the head raised and the base straight, the reference for damping [rad].
    joint_names : tuple of str
        theta1, psi1, ..., then theta of the base part.
    pitch : (n_phi,) ndarray of bool
        True for pitch joints.
    lower, upper : (n_phi,) ndarray
        Joint limits [rad].
    half_track : (pairs,) ndarray
        Distance from the middle of the axle to a wheel [m].
    driven_side : (pairs,) ndarray of int
        Side of the active wheel: +1 left, -1 right, 0 passive pair.
    link_mass : (head_joints + 2 base_joints,) ndarray
        Masses of the links [kg].
    initial_joints : (n_phi,) ndarray
        Initial joint angles [rad].
    initial_base_pose : (3,) ndarray
        Initial x [m], y [m] and yaw [rad] of the base part.
    """

    head_joints: int
    base_joints: int
    link_length: float
    wheel_radius: float
    point_offset: float
    reference_joints: NDArray[np.float64]
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
        """Number of wheel pairs of the base part."""
        return self.base_joints + 1

    @property
    def active_wheels(self) -> int:
        """Number n_w of active wheels."""
        return int(np.count_nonzero(self.driven_side))

    @property
    def wheel_names(self) -> tuple[str, ...]:
        """Names of the active wheels: rho1, rho2, ..."""
        return tuple(f"rho{i + 1}" for i in range(self.active_wheels))

    def arrays(self) -> SnakeModel:
        """Return the parameters for the kernels."""
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
    """Modes of the robot; row i of ``grounded`` is mode ``numbers[i]``.

    Attributes
    ----------
    numbers : tuple of int
        Mode numbers in the scenario.
    grounded : (modes, pairs) ndarray of int
        1 for wheel pairs on the ground.
    """

    numbers: tuple[int, ...]
    grounded: NDArray[np.int64]

    @classmethod
    def from_lifted(cls, lifted: Mapping[int, tuple[int, ...] | list[int]], pairs: int) -> ModeTable:
        """Build the table from the lifted pairs (numbered from 1) of each mode.

        Raises
        ------
        ModelError
            If the table has no modes, a mode number is below 1, or a pair does not exist.
        """
        if not lifted:
            raise ModelError("controller.modes must have at least one mode, e.g. {1: [3, 6]}")
        grounded = np.ones((len(lifted), pairs), dtype=np.int64)
        for row, (number, away) in enumerate(lifted.items()):
            if number < 1:
                raise ModelError(f"controller.modes: mode numbers must be positive, got {number}")
            for pair in away:
                if not 1 <= pair <= pairs:
                    raise ModelError(f"controller.modes: mode {number} lifts unknown pair {pair} (pairs: 1 to {pairs})")
                grounded[row, pair - 1] = 0
        return cls(tuple(lifted), grounded)

    def row(self, number: int, key: str) -> int:
        """Return the row of a mode number; ``key`` is the scenario key for an error message."""
        if number not in self.numbers:
            raise ModelError(f"{key}: unknown mode {number} (modes: {', '.join(map(str, self.numbers))})")
        return self.numbers.index(number)


class CommandBlock(NamedTuple):
    """Commands of T control periods.

    Attributes
    ----------
    velocity : (T, 6) ndarray
        Mean rates of the target in each period: x, y, z [m/s] and alpha, beta, gamma [rad/s].
    request : (T,) ndarray of int
        Mode request at the beginning of each period: NO_REQUEST, SWITCHING, FIXING, or a mode number.
    gripper : (T,) ndarray of int
        1: closed (hardened), 0: open (soft).
    """

    velocity: NDArray[np.float64]
    request: NDArray[np.int64]
    gripper: NDArray[np.int64]


class Feedback(NamedTuple):
    """State of the robot that an operator receives at the beginning of a control period.

    Attributes
    ----------
    time : float
        Time [s].
    w, w_target : (6,) ndarray
        Pose of the controlled point and its target [m, rad].
    base_pose : (3,) ndarray
        x [m], y [m] and yaw [rad] of the base part.
    phi : (n_phi,) ndarray
        Joint angles [rad].
    mode : int
        Number of the current mode.
    waiting : bool
        Whether the target waits because the last command was not executed.
    """

    time: float
    w: NDArray[np.float64]
    w_target: NDArray[np.float64]
    base_pose: NDArray[np.float64]
    phi: NDArray[np.float64]
    mode: int
    waiting: bool


class CommandSource(Protocol):
    """Source of commands, such as a script or a joystick."""

    def read(self, first: int, count: int, period: float, feedback: Feedback) -> CommandBlock:
        """Return the commands of 1 to ``count`` control periods, starting at period ``first``.

        The engine calls again when these commands are used up. A script returns ``count`` periods, and a joystick
        returns one period.

        Parameters
        ----------
        first : int
            Current period, from 0.
        count : int
            Number of remaining periods.
        period : float
            Length of a period [s].
        feedback : Feedback
            State at the beginning of period ``first``.
        """
        ...


class Conditioning(NamedTuple):
    """Ranks and singular values of the model for one mode in one posture ([T] eqs 9-11)."""

    rows: int
    rank_A: int  # rank of A~; full rank: 6 + m
    rank_B: int  # rank of B~; full rank: rows
    redundancy: int  # number of inputs minus rank of B~
    sigma_min_A: float
    sigma_min_B: float
    condition_B: float


@dataclass(frozen=True)
class TaskSpaceController:
    """Parameters of the tick loop and the mode switcher.

    ``prediction`` is the schedule for predicting a switching period with ``prediction_ticks`` coarser steps.
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
    """Compute the ranks and singular values of A~ and B~ ([T] eqs 10, 11) for one mode in a posture on the ground."""
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
