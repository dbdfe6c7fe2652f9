"""Braces of an arm, and the brace forces that minimize the motor heat of prescribed motions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.braces import statics as kb
from dynsim.dynamics.contact.braces.statics import brace_motion, brace_statics
from dynsim.errors import ModelError, brief
from dynsim.jit.kernel import integers, reals
from dynsim.model.description import Array, Contact, Robot
from dynsim.model.drives import Motor, Servo, TorqueSource

MIN_N = 0.5
# Time within which the force of a brace rises at the start of an interval, and falls at its end [s].
RAMP = 0.1


@dataclass(frozen=True)
class Brace:
    """Brace contact of a body point on a surface (immutable).

    Parameters
    ----------
    body : str
        Name of a body or frame.
    point : array_like, shape (3,)
        Point in the frame of the body [m].
    normal : array_like, shape (3,)
        Normal of the surface in the world frame, pointing away from the surface; any length.
    friction : float, optional
        Friction coefficient μ ≥ 0.
    min_N : float, optional
        Minimum normal force [N].
    normal_force : float, optional
        Commanded normal force [N]; default: the force that minimizes the motor heat.
    sliding : array_like, shape (3,), optional
        Sliding velocity along the surface in the world frame. Only its direction matters: a friction force f_t = μ f_n
        opposes it. Default: the point does not slide, and |f_t| ≤ μ f_n.

    Raises
    ------
    ModelError
        If a vector does not have three finite numbers, the normal is zero, sliding has no component along the surface,
        a value is negative, or the commanded force would pull.

    Notes
    -----
    Arrays are stored as read-only copies. :meth:`dynsim.Model.brace_statics` uses braces.

    Examples
    --------
    >>> import dynsim
    >>> brace = dynsim.Brace("link_7", point=[0, 0, 0], normal=[0, 0, 1], friction=0.1)
    >>> model = dynsim.build_model(dynsim.load_scenario("elbow_comparison"))
    >>> model.brace_statics(model.robot.initial, [0] * 10, [0] * 10, {"elbow_7": brace}).feasible
    True
    """

    body: str
    point: Array
    normal: Array
    friction: float = 0.0
    min_N: float = MIN_N
    normal_force: float | None = None
    sliding: Array | None = None

    def __post_init__(self) -> None:
        for name in ("point", "normal", "sliding"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, _vector(name, value))
        if not self.normal.any():
            raise ModelError(f"brace on {self.body}: normal must not be the zero vector")
        if not 0.0 <= self.friction < np.inf:
            raise ModelError(f"brace on {self.body}: friction {self.friction} must be zero or positive")
        if not 0.0 <= self.min_N < np.inf:
            raise ModelError(f"brace on {self.body}: min_N {self.min_N} must be zero or positive [N]")
        if self.normal_force is not None and not 0.0 < self.normal_force < np.inf:
            raise ModelError(
                f"brace on {self.body}: normal_force {self.normal_force} must be positive [N]; a brace cannot pull"
            )
        if self.sliding is None:
            return
        # A component along the surface that is larger than rounding.
        along = np.linalg.norm(np.cross(self.normal, self.sliding))
        if not along > 1e-12 * np.linalg.norm(self.normal) * np.linalg.norm(self.sliding):
            raise ModelError(
                f"brace on {self.body}: sliding must have a component along the surface, got {self.sliding.tolist()}"
            )


def _vector(name: str, value: ArrayLike) -> Array:
    """Return three finite numbers as a read-only array."""
    try:
        vector = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelError(f"brace: {name} must be three numbers, got {brief(value)}") from error
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ModelError(f"brace: {name} must be three finite numbers, got {brief(value)}")
    vector.flags.writeable = False
    return vector


@dataclass(frozen=True)
class BraceStatics:
    """Result of :meth:`dynsim.Model.brace_statics`.

    Attributes
    ----------
    feasible : bool
        True if forces and torques exist that satisfy all constraints; otherwise all results except ``certificate`` are
        NaN.
    torques : (n,) ndarray
        Motor torques tau = K_m i [N m or N].
    heat : float
        Motor heat Σ R i² [W].
    forces : dict of str to (3,) ndarray
        Force of each brace on the arm in the world frame [N].
    normal_forces : dict of str to float
        Normal force of each brace [N].
    intervals : dict of str to (float, float)
        Minimum and maximum normal force of each brace for which the motion is possible [N].
    certificate : (n,) ndarray or None
        If infeasible, joint rates ω that prove it: for all torques within their limits and all admissible brace forces,
        ω·(tau + Jᵀ f) < ω·(M v̇ + h + g + losses), although a possible motion requires both sides to be equal.
    """

    feasible: bool
    torques: Array
    heat: float
    forces: dict[str, Array]
    normal_forces: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    certificate: Array | None = None


@dataclass(frozen=True)
class PressingBrace:
    """Contact that presses along references.

    Attributes
    ----------
    contact : Contact
        Contact point and surface.
    force : float or None
        Commanded normal force [N]; None for the force that minimizes the motor heat.
    during : tuple of (float, float) or None
        Intervals in which the brace presses [s]; None for the whole run.
    """

    contact: Contact
    force: float | None = None
    during: tuple[tuple[float, float], ...] | None = None

    def share(self, times: Array) -> Array:
        """Return the share of the brace in the plan at times of the whole run, (T,): 1 if it presses, 0 if not.

        Within ``RAMP`` at the ends of an interval the share is 3 s² − 2 s³ with s from 0 to 1, except for ends that are
        also ends of the run.
        """
        if self.during is None:
            return np.ones(len(times))
        share = np.zeros(len(times))
        for start, end in self.during:
            rise = 1.0 if start <= times[0] else (times - start) / RAMP
            fall = 1.0 if end >= times[-1] else (end - times) / RAMP
            inside = (times >= start) & (times <= end)
            share = np.maximum(share, np.where(inside, np.clip(np.minimum(rise, fall), 0.0, 1.0), 0.0))
        return np.asarray(share**2 * (3.0 - 2.0 * share))


class BracePlanner:
    """Kernel tables for the braces of a robot, including the workspace of the solver.

    Parameters
    ----------
    robot : Robot
        Description of the robot.
    model : ModelArrays
        Kernel tables of the robot.
    links : (c,) sequence of int
        Index of the body of each brace.
    carriers : (c,) sequence of int, optional
        Index of the body that carries the surface of each brace, -1 for the world, the default.
    """

    def __init__(
        self, robot: Robot, model: ka.ModelArrays, links: Sequence[int], carriers: Sequence[int] | None = None
    ) -> None:
        if robot.couplings:
            raise ModelError("brace_statics: coupled joints are not supported, because they share a motor")
        self._model, self._ws = model, ka.workspace(len(robot.links), 0, 0)
        drives = {motor.joint: motor for motor in robot.motors}
        motors = np.array([_motor_row(drives.get(joint)) for joint in robot.joint_names])
        self.arrays = kb.brace_arrays(integers(links), integers(carriers or [-1] * len(links)), reals(motors))

    def motion(self, points: Array, q: Array, v: Array) -> tuple[Array, Array]:
        """Return positions and velocities of points on the braces' bodies along a motion, both (T, c, 3).

        ``points`` has shape (c, 3) [m].
        """
        positions, velocities = np.zeros((2, len(q), len(points), 3))
        self.arrays.table[:, kb.POINT : kb.POINT + 3] = points
        brace_motion(self._model, self._ws, self.arrays, reals(q), reals(v), positions, velocities)
        return positions, velocities

    def least_heat(
        self, q: Array, v: Array, vdot: Array, tables: Array, shares: Array | None = None
    ) -> tuple[Array, Array, int]:
        """Compute the torques and normal forces that minimize the motor heat along a motion.

        Parameters
        ----------
        q : (T, nq) ndarray
            Positions [rad or m].
        v, vdot : (T, n) ndarray
            Rates and accelerations.
        tables : (T, c, BRACE_SIZE) ndarray
            Rows of :func:`brace_rows`.
        shares : (T, c) ndarray, optional
            Shares of the braces, 0 to 1; see Notes. Default: all braces press.

        Returns
        -------
        torques : (T, n) ndarray
            Torques [N m or N].
        normal : (T, c) ndarray
            Normal forces [N].
        solved : int
            Number of samples solved before the first infeasible one.

        Notes
        -----
        Shares mix the solutions of different sets of braces: tau = ∫ tau_S(u) du over u from 0 to 1, where the braces
        of S(u) have shares of at least u, and likewise the forces. Torques are therefore as continuous as the shares.
        All constraints except ``min_N`` are satisfied, because they are convex.
        """
        torques, normal = np.zeros(v.shape), np.zeros(tables.shape[:2])
        if shares is None:
            solved = brace_statics(
                self._model, self._ws, self.arrays, reals(q), reals(v), reals(vdot), tables, torques, normal, False
            )
            return torques, normal, int(solved)
        solved, ends = len(q), np.zeros((len(q), 1))
        edges = np.hstack([ends, np.sort(shares, axis=1), ends + 1.0])
        for m, weight in enumerate(np.diff(edges).T):
            rows = np.flatnonzero(weight)
            part, off = tables[rows], shares[rows] < edges[rows, m + 1, None]
            part[off, kb.COMMANDED] = part[off, kb.FRICTION] = 0.0
            some, forces, done = self.least_heat(q[rows], v[rows], vdot[rows], part)
            torques[rows] += weight[rows, None] * some
            normal[rows] += weight[rows, None] * forces
            if done < len(rows):
                solved = min(solved, int(rows[done]))
        return torques, normal, solved


class PreparedBraces(BracePlanner):
    """Braces of a robot, with all precomputed data that does not depend on the state."""

    def __init__(self, robot: Robot, model: ka.ModelArrays, braces: Mapping[str, Brace]) -> None:
        self.names, self.braces = tuple(braces), tuple(braces.values())
        attached = [robot.attach(brace.body, brace.point) for brace in self.braces]
        super().__init__(robot, model, [link for link, _ in attached])
        self._tables = np.zeros((1, len(braces), kb.BRACE_SIZE))
        for k, (brace, (_, point)) in enumerate(zip(self.braces, attached, strict=True)):
            sliding = np.zeros(3) if brace.sliding is None else brace.sliding
            forces = brace.min_N, np.nan if brace.normal_force is None else brace.normal_force
            self._tables[0, k] = brace_rows(
                point, brace.normal[None], np.array([brace.friction]), *forces, sliding[None]
            )
        n = len(robot.links)
        self._q, self._v, self._vdot = np.zeros((1, robot.nq)), np.zeros((1, n)), np.zeros((1, n))
        self._torques, self._normal = np.zeros((1, n)), np.zeros((1, len(braces)))

    def match(self, braces: Mapping[str, Brace]) -> bool:
        """Return whether these are the prepared braces: the same immutable objects with the same names."""
        return self.names == tuple(braces) and all(a is b for a, b in zip(self.braces, braces.values(), strict=True))

    def solve(self, q: Array, v: Array, vdot: Array) -> BraceStatics:
        """Compute the brace forces for one state."""
        arrays = self.arrays
        self._q[0], self._v[0], self._vdot[0] = q, v, vdot
        solved = brace_statics(
            self._model, self._ws, arrays, self._q, self._v, self._vdot, self._tables, self._torques, self._normal, True
        )
        feasible = solved == 1
        torques, results, forces = self._torques[0].copy(), arrays.results, arrays.forces.copy()
        if not feasible:
            torques[:], results[:], forces[:] = np.nan, np.nan, np.nan
        numbers = results.tolist()
        return BraceStatics(
            feasible=feasible,
            torques=torques,
            heat=float(arrays.motors[:, kb.HEAT] @ torques**2),
            forces=dict(zip(self.names, forces, strict=True)),
            normal_forces={name: row[kb.FORCES] for name, row in zip(self.names, numbers, strict=True)},
            intervals={name: (row[kb.LOW], row[kb.HIGH]) for name, row in zip(self.names, numbers, strict=True)},
            certificate=None if feasible else arrays.certificate.copy(),
        )


def brace_rows(point: Array, normals: Array, friction: Array, least: float, commanded: float, sliding: Array) -> Array:
    """Return the kernel table rows of one brace along a motion, (T, BRACE_SIZE).

    Parameters
    ----------
    point : (3,) or (T, 3) ndarray
        Point in the frame of its link [m].
    normals : (T, 3) ndarray
        Surface normals of any length.
    friction : (T,) ndarray
        Friction coefficients.
    least : float
        Minimum normal force [N].
    commanded : float
        Commanded normal force [N]; NaN if no force is commanded.
    sliding : (T, 3) ndarray
        Slip velocities; zero if the point does not slide.
    """
    rows = np.zeros((len(normals), kb.BRACE_SIZE))
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    tangents = np.stack([first, np.cross(normals, first)], axis=1)
    slip = np.einsum("tij,tj->ti", tangents, sliding)
    speed = np.linalg.norm(slip, axis=1, keepdims=True)
    rows[:, kb.POINT : kb.POINT + 3] = point
    rows[:, kb.AXES : kb.AXES + 3], rows[:, kb.AXES + 3 : kb.AXES + 9] = normals, tangents.reshape(-1, 6)
    rows[:, kb.SLIP : kb.SLIP + 2] = np.divide(slip, speed, out=np.zeros_like(slip), where=speed > 0.0)
    rows[:, kb.FRICTION], rows[:, kb.LEAST], rows[:, kb.COMMANDED] = friction, least, commanded
    return rows


def _motor_row(motor: Motor | Servo | TorqueSource | None) -> Array:
    """Return a motor's row of the kernel table; the kernels compute the torque limits from it and the joint rate."""
    row = np.zeros(kb.MOTOR_SIZE)
    row[kb.CONSTANT] = 1.0
    if isinstance(motor, TorqueSource):
        row[kb.CURRENT_LIMIT] = motor.torque_limit
    elif motor is not None:
        row[kb.CONSTANT], row[kb.RESISTANCE] = motor.joint_constant, motor.resistance
        row[kb.HEAT] = motor.resistance / motor.joint_constant**2
        row[kb.VOLTAGE_LIMIT] = motor.voltage_limit
        row[kb.CURRENT_LIMIT] = motor.greatest_current
    return row
