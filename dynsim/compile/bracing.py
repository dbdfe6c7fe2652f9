"""Braces of an arm, and their forces of least motor heat for given motions."""

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
from dynsim.model.description import Array, Robot
from dynsim.model.drives import Motor, Servo, TorqueSource

MIN_N = 0.5


@dataclass(frozen=True)
class Brace:
    """A point of a body that leans on a surface; its arrays are copies that cannot be written to.

    Attributes
    ----------
    body : name of a body or frame
    point : (3,) in its frame [m]
    normal : (3,) of the surface, away from it, in the world
    friction : μ
    min_N : least normal force [N]
    normal_force : [N], commanded; None: whatever gives the least heat
    sliding : (3,) velocity along the surface, of which the direction counts: f_t = μ f_n against it; None: it is held

    Raises
    ------
    ModelError
        No three finite numbers, no direction, a negative friction or least force, or a commanded one that pulls.
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
            raise ModelError(f"brace on {self.body}: normal {self.normal.tolist()} has no direction")
        if not 0.0 <= self.friction < np.inf:
            raise ModelError(f"brace on {self.body}: friction {self.friction} must be zero or positive")
        if not 0.0 <= self.min_N < np.inf:
            raise ModelError(f"brace on {self.body}: min_N {self.min_N} must be zero or positive [N]")
        if self.normal_force is not None and not 0.0 < self.normal_force < np.inf:
            raise ModelError(
                f"brace on {self.body}: normal_force {self.normal_force} must be positive [N]; a brace cannot pull"
            )
        if self.sliding is not None and not _is_along(self.sliding, self.normal):
            raise ModelError(
                f"brace on {self.body}: sliding {self.sliding.tolist()} has no direction along the surface"
            )


def _is_along(sliding: Array, normal: Array) -> bool:
    """Whether a velocity has a part along the surface that is more than rounding."""
    across = np.linalg.norm(np.cross(normal, sliding))
    return bool(across > 1e-12 * np.linalg.norm(normal) * np.linalg.norm(sliding))


def _vector(name: str, value: ArrayLike) -> Array:
    """Three finite numbers, not to be written to."""
    try:
        vector = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelError(f"brace: {name} must be three numbers, not {brief(value)}") from error
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ModelError(f"brace: {name} must be three finite numbers, not {brief(value)}")
    vector.flags.writeable = False
    return vector


@dataclass(frozen=True)
class BraceStatics:
    """What :meth:`dynsim.Model.brace_statics` finds.

    Attributes
    ----------
    feasible : whether any forces and torques fulfil all constraints; if not, all of the others but ``certificate`` are
        NaN or None
    torques : (n,) of the motors, tau = K_m i [N m or N]
    heat : Σ R i² [W]
    forces : by brace, (3,) on the arm in the world [N]
    normal_forces : by brace [N]
    intervals : by brace, least and largest normal force with which the motion is still possible [N]
    certificate : (n,) joint rates ω that show that nothing does: for all torques within their limits and all forces of
        the braces, ω·(tau + Jᵀ f) < ω·(M v̇ + h + g + losses), which would have to be equal; None where feasible
    """

    feasible: bool
    torques: Array
    heat: float
    forces: dict[str, Array]
    normal_forces: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    certificate: Array | None = None


class BracePlanner:
    """Braces of a robot as the tables of the kernels, and room for them.

    Parameters
    ----------
    robot, model : the description and its arrays
    links : (c,) int, the body of each brace
    """

    def __init__(self, robot: Robot, model: ka.ModelArrays, links: Sequence[int]) -> None:
        if robot.couplings:
            raise ModelError("brace_statics: not for robots with coupled joints, which share a motor")
        self._model, self._ws = model, ka.workspace(len(robot.links), 0, 0)
        drives = {motor.joint: motor for motor in robot.motors}
        motors = np.array([_motor_row(drives.get(joint)) for joint in robot.joint_names])
        self.arrays = kb.brace_arrays(integers(links), reals(motors))

    def motion(self, points: Array, q: Array, v: Array) -> tuple[Array, Array]:
        """Positions and velocities of points of the braces' bodies, (c, 3) [m], along a motion, both (T, c, 3)."""
        positions, velocities = np.zeros((2, len(q), len(points), 3))
        self.arrays.table[:, kb.POINT : kb.POINT + 3] = points
        brace_motion(self._model, self._ws, self.arrays, reals(q), reals(v), positions, velocities)
        return positions, velocities

    def least_heat(self, q: Array, v: Array, vdot: Array, tables: Array) -> tuple[Array, Array, int]:
        """Torques (T, n) [N m] and normal forces (T, c) [N] of least heat along a motion, and at how many instants.

        ``tables`` : (T, c, BRACE_SIZE) of :func:`brace_rows`
        """
        torques, normal = np.zeros(v.shape), np.zeros(tables.shape[:2])
        solved = brace_statics(
            self._model, self._ws, self.arrays, reals(q), reals(v), reals(vdot), tables, torques, normal, False
        )
        return torques, normal, int(solved)


class PreparedBraces:
    """Some braces of a robot with all that does not change from one state to the next."""

    def __init__(self, robot: Robot, model: ka.ModelArrays, braces: Mapping[str, Brace]) -> None:
        self.names, self.braces = tuple(braces), tuple(braces.values())
        attached = [robot.attach(brace.body, brace.point) for brace in self.braces]
        self._arrays = BracePlanner(robot, model, [link for link, _ in attached]).arrays
        self._model, self._ws = model, ka.workspace(len(robot.links), 0, 0)
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

    def are(self, braces: Mapping[str, Brace]) -> bool:
        """Whether these are the same objects under the same names, so that nothing of them can have changed."""
        return self.names == tuple(braces) and all(a is b for a, b in zip(self.braces, braces.values(), strict=True))

    def solve(self, q: Array, v: Array, vdot: Array) -> BraceStatics:
        """For one state."""
        arrays = self._arrays
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
    """Rows of the table of the kernels for one brace along a motion, (T, BRACE_SIZE).

    Parameters
    ----------
    point : (3,), or one for each instant (T, 3), on its link [m]
    normals : (T, 3) of any length
    friction : (T,)
    least, commanded : [N], NaN for no commanded force
    sliding : (T, 3), zero where it is held
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
    """A row of the table of motors of the kernels; the limits follow from the rate."""
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
