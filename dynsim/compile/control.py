"""Joint control as data for the simulation: references, feed-forward voltages, gains, hand and base paths."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dynsim.compile.references.splines import coordinates, quintic_coefficients, rolled
from dynsim.compile.references.teleop import TeleopOptions
from dynsim.config.base import StrictConfig, Vector3, default
from dynsim.dynamics import tables as ka
from dynsim.dynamics.tables import ReferenceArrays
from dynsim.errors import ModelError
from dynsim.jit.kernel import integers, reals
from dynsim.model.base_pose import base_pose, base_row
from dynsim.model.description import Robot
from dynsim.model.drives import TorqueSource
from dynsim.system.memo import recall

if TYPE_CHECKING:
    from dynsim.snake.description import TaskSpaceController

# Samples per segment of the reference splines, and number of segments that are sampled at once.
_PER_SEGMENT = 4
_PIECE = 4096
# Number of knots that the longest steps of an implicit method span (20 ms; 55 ms for the published arm).
_STRADDLED = 3.0

# Times within this distance of the end of the references, relative to the end time, count as the end.
END_SLACK = 1e-12

# Controller keys that prescribe a whole run in advance and are not available with an operator.
PLANNED = ("hand", "base", "joints", "torques", "feed_forward", "brace")

# Positions of a joint: samples, (T,) [rad or m], or a function of times, (T,) [s].
JointMotion = ArrayLike | Callable[[NDArray[np.float64]], ArrayLike]


@runtime_checkable
class HandPath(Protocol):
    """A path of the hand in space."""

    def position(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return positions at times t [s], shape (T,) → (T, 3) [m]."""


class HandPathConfig(StrictConfig):
    """Keys of all kinds of hand paths: the origin of their coordinates, whose axes are always the axes of the world."""

    frame: Literal["world", "start"] = default(
        "world", "origin of the coordinates: the origin of the `world`, or the hand at the `start` of the run"
    )
    origin_m: Vector3 = default([0.0, 0.0, 0.0], "offset that is added to all coordinates of the path")


@dataclass(frozen=True)
class MovedPath:
    """A path of the hand whose coordinates count from ``origin``, (3,) [m], in axes of the world."""

    path: HandPath
    origin: NDArray[np.float64]

    def position(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return positions in the world at times t [s], shape (T,) → (T, 3) [m]."""
        return self.origin + self.path.position(t)


@runtime_checkable
class BasePath(Protocol):
    """A motion of a mobile base without side slip: distance and turn, which determine its position."""

    def motion(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return distance forward [m] and turn to the left [rad] since the start, at times t [s], (T,) → (T, 2)."""


def held_values(robot: Robot) -> NDArray[np.float64]:
    """Return references, (na,), with which the motors hold: initial joint positions, or zero for torque sources."""
    initial = dict(zip(robot.joint_names, robot.initial[list(robot.position_index)], strict=True))
    return np.array([0.0 if isinstance(m, TorqueSource) else initial[m.joint] for m in robot.motors])


@dataclass(frozen=True)
class JointControl:
    """Gains of the voltage PD controller per motor, joint references, and the path of the hand.

    Attributes
    ----------
    k_p, k_d : (na,) ndarray
        Gains [V/rad, V s/rad]. Only DC motors use them, but the ``k_p`` of a servo shows whether it controls position.
    reference : ReferenceArrays
        Joint references; for a torque source, its commanded torques [N m].
    path : HandPath or None
        Path that the hand is to follow.
    sample_time : float or None
        Period at which commands are computed and then held [s]; None: they follow the state continuously.
    teleop : TeleopOptions or None
        If set, an operator rewrites the references during the run.
    orientation : (3, 3) ndarray or None
        Rotation of the hand in the world along ``path``; None: any.
    task_space : TaskSpaceController or None
        If set, the controller of a snake rewrites the references during the run.
    """

    k_p: NDArray[np.float64]
    k_d: NDArray[np.float64]
    reference: ReferenceArrays
    path: HandPath | None
    sample_time: float | None = None
    teleop: TeleopOptions | None = None
    orientation: NDArray[np.float64] | None = None
    task_space: TaskSpaceController | None = None

    @classmethod
    def absent(cls, robot: Robot, targets: Mapping[str, float] | None = None) -> JointControl:
        """Return the control if no controller is set: zero voltages and torques; servos hold their initial positions.

        ``targets`` replaces the references of some joints [rad or m].
        """
        motors, values = len(robot.motors), held_values(robot)
        for a, motor in enumerate(robot.motors):
            values[a] = (targets or {}).get(motor.joint, values[a])
        return cls(np.zeros(motors), np.zeros(motors), _reference(values), None)

    @classmethod
    def following(
        cls,
        robot: Robot,
        k_p: ArrayLike,
        k_d: ArrayLike,
        times: ArrayLike = (),
        positions: Mapping[str, JointMotion] | None = None,
        path: HandPath | None = None,
        sample_time: float | None = None,
        voltages: ArrayLike | None = None,
    ) -> JointControl:
        """Return the voltage PD controller u = k_p (q_d − q) + k_d (v_d − v) for prescribed joint positions.

        The positions are samples or functions. q_d is a quintic spline through the samples, and v_d is its derivative.
        Joints without positions keep their initial positions.

        Parameters
        ----------
        robot : Robot
            Robot with the motors.
        k_p, k_d : array_like, shape () or (na,)
            One gain for all motors, or one per motor [V/rad, V s/rad; V/m, V s/m at prismatic joints].
        times : array_like, shape (T,), optional
            Equally spaced times from 0 to the end of the run [s], T ≥ 6.
        positions : mapping of str to array_like or callable, optional
            Positions, (T,) [rad or m], for each joint, or a function that returns them for ``times``.
        path : HandPath, optional
            Path of the hand, used for tracking errors in the summary and figures.
        sample_time : float, optional
            Period of a zero-order hold of the voltages [s]; default: continuous.
        voltages : array_like, shape (T, na), optional
            Planned voltages added to the voltages of DC motors [V].

        Raises
        ------
        ModelError
            If a joint has no motor, or the shape or values of the samples, times or gains are invalid.
        """
        positions = positions or {}
        driven = [motor.joint for motor in robot.motors]
        values = held_values(robot)
        gains = _gains("k_p", k_p, len(driven)), _gains("k_d", k_d, len(driven))
        for name in positions:
            if name not in driven:
                raise ModelError(f"joint {name!r} has no motor; joints with a motor: {', '.join(driven) or 'none'}")
        if not positions and voltages is None:
            return cls(*gains, _reference(values), path, sample_time)
        grid = np.asarray(times, dtype=np.float64)
        if grid.ndim != 1 or len(grid) < 6 or not np.allclose(np.diff(grid), grid[1] - grid[0], rtol=1e-6, atol=0.0):
            raise ModelError("times must be six or more equally spaced times [s]")
        if not grid[1] > grid[0]:
            raise ModelError("times must increase")
        columns = []
        for name, motion in positions.items():
            column = np.asarray(motion(grid) if callable(motion) else motion, dtype=np.float64)
            if column.shape != grid.shape or not np.isfinite(column).all():
                raise ModelError(f"the reference of {name} must be {len(grid)} finite positions, one for each time")
            columns.append(column)
        spline = np.full(len(driven), ka.HELD_POSITION)
        for k, name in enumerate(positions):
            spline[driven.index(name)] = k
        spacing = float(grid[1]) - float(grid[0])
        coefficients = np.zeros((len(grid) - 1, 0, 6))
        if columns:
            samples = np.stack(columns, axis=1)
            coefficients = recall("splines", lambda: quintic_coefficients(spacing, samples), spacing, samples)
        reference = _reference(values, spline, (float(grid[0]), spacing), coefficients)
        if voltages is not None:
            planned = np.asarray(voltages, dtype=np.float64)
            if planned.shape != (len(grid), len(driven)) or not np.isfinite(planned).all():
                raise ModelError(f"voltages must be finite with shape ({len(grid)}, {len(driven)}): times, motors")
            reference = reference._replace(voltage=quintic_coefficients(spacing, planned))
        return cls(*gains, reference, path, sample_time)

    @property
    def end(self) -> float:
        """Time up to which the moving references are defined [s]; infinite if no reference moves."""
        begin, spacing = self.reference.grid
        moving = bool((self.reference.spline >= 0).any())
        return float(begin + spacing * len(self.reference.coefficients)) if moving else np.inf

    def bends(self, rtol: float, atol: float) -> NDArray[np.float64]:
        """Return the times of knots [s], increasing, where references bend too sharply for the longest steps.

        The samples of error control are too coarse to detect these bends. The fifth derivative jumps at such a knot:
        three knots later, the polynomials of the adjacent segments differ by more than ``atol`` + ``rtol`` × the span
        of the spline. Sampled commands have no such knots.
        """
        spacing, times = float(self.reference.grid[1]), []
        for splines in (self.reference.coefficients, self.reference.voltage):
            if self.sample_time is not None or len(splines) < 2:
                continue
            jumps = np.abs(np.diff(splines[:, :, 5], axis=0))  # (segments - 1, splines)
            departure = jumps * (_STRADDLED * spacing) ** 5
            values = splines[:, :, 0]  # at the knots
            span = values.max(axis=0) - values.min(axis=0)
            times.append((departure > atol + rtol * span).any(axis=1).nonzero()[0])
        knots = np.unique(np.concatenate(times)) if times else np.zeros(0)
        return np.asarray(self.reference.grid[0] + spacing * (knots + 1.0))

    def positions(self, robot: Robot) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Yield times, (T,) [s], and coordinates, (T, nq), of the references, in pieces of a few thousand samples.

        The samples are at the knots and at three times between adjacent knots. Joints without a moving reference keep
        their initial positions; a mobile base moves as its wheels roll.

        Parameters
        ----------
        robot : Robot
            Robot whose motors follow the references.
        """
        reference, q, start = self.reference, robot.initial, None
        begin, spacing = reference.grid
        places = dict(zip(robot.joint_names, robot.position_index, strict=True))
        moved = np.array([places[motor.joint] for motor in robot.motors])[reference.spline >= 0]
        segments, columns = len(reference.coefficients), reference.spline[reference.spline >= 0]
        x = spacing * np.arange(_PER_SEGMENT + 1) / _PER_SEGMENT
        powers = x[:, None] ** np.arange(6)
        for first in range(0, segments, _PIECE):
            piece = reference.coefficients[first : first + _PIECE, columns]
            times = begin + spacing * np.arange(first, first + len(piece))[:, None] + x
            positions = np.tile(q, (times.size, 1))
            positions[:, moved] = np.einsum("scp,xp->sxc", piece, powers).reshape(times.size, len(columns))
            if robot.base is not None:
                k, _ = base_row(robot)
                angles = self._wheels(robot, slice(first, first + _PIECE))
                poses = rolled(robot.base, q[k + 2 : k + 4] if start is None else start, angles, spacing, _PER_SEGMENT)
                positions[:, k + 2 : k + 4], start = poses.reshape(-1, 2), poses[-1, -1]
            yield times.ravel(), positions

    def _wheels(self, robot: Robot, segments: slice) -> NDArray[np.float64]:
        """Return the wheel references of a mobile base as splines, (segments, 2, 6); constant for a wheel at rest."""
        assert robot.base is not None
        k, _ = base_row(robot)
        driven = [motor.joint for motor in robot.motors]
        pieces = self.reference.coefficients[segments]
        angles = np.zeros((len(pieces), 2, 6))
        angles[:, :, 0] = robot.initial[k : k + 2]
        for wheel, joint in enumerate(robot.base.wheels):
            column = self.reference.spline[driven.index(joint)] if joint in driven else ka.HELD_POSITION
            if column >= 0:
                angles[:, wheel] = pieces[:, column]
        return angles

    def base_target(self, robot: Robot, t: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the target of a mobile base from its wheel references: x, y [m], heading [rad] at times t [s], (T, 3).

        Returns None without a base, or if a wheel has no reference.
        """
        follows = {motor.joint for motor, k_p in zip(robot.motors, self.k_p, strict=True) if k_p > 0.0}
        if robot.base is None or not follows.issuperset(robot.base.wheels):
            return None
        k, _ = base_row(robot)
        q = np.tile(robot.initial, (len(t), 1))
        wheels = self._wheels(robot, slice(None))
        begin, spacing = self.reference.grid
        q[:, k : k + 4] = coordinates(robot.base, robot.initial[k + 2 : k + 4], wheels, spacing, t - begin)
        return base_pose(robot, q)

    def target(self, t: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the target of the hand at times t, (T, 3) [m]; None without a path.

        After the end of the references the target is constant.
        """
        if self.path is None:
            return None
        end = self.end
        # Because of rounding, the references may end just before the end of the run. The target then stays at the
        # target of their last sample.
        ended = t > end + END_SLACK * max(1.0, abs(end))
        return targets_on(self.path, np.where(ended, end, t) if ended.any() else t)


def targets_on(path: HandPath, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return positions on a path at times t [s], (T,) → (T, 3) [m]; repeated calls return a cached result."""
    return recall("targets", lambda: path.position(t), path, t)


def _gains(name: str, value: ArrayLike, motors: int) -> NDArray[np.float64]:
    """Return one gain per motor, (na,)."""
    gains = np.asarray(value, dtype=np.float64)
    if gains.shape not in ((), (motors,)) or not (np.isfinite(gains).all() and (gains >= 0.0).all()):
        raise ModelError(f"{name} must be one non-negative finite gain, or one per motor ({motors})")
    return np.full(motors, gains) if gains.ndim == 0 else gains


def _reference(
    values: NDArray[np.float64],
    spline: NDArray[np.int64] | None = None,
    grid: tuple[float, float] = (0.0, 1.0),
    coefficients: NDArray[np.float64] | None = None,
) -> ReferenceArrays:
    """Return references for the kernels: for each motor its value in ``values`` or the spline in this column.

    ``spline`` contains the column of each motor, or HELD_POSITION for a constant reference.
    """
    return ReferenceArrays(
        spline=integers(np.full(len(values), ka.HELD_POSITION) if spline is None else spline),
        held=reals(values),
        grid=reals(grid),
        coefficients=reals(np.zeros((1, 0, 6)) if coefficients is None else coefficients),
    )
