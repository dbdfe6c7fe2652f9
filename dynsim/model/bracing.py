"""Statics and dynamics of a braced arm: the forces of its braces that realise a motion with the least heat."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dynsim.errors import ModelError
from dynsim.kernels import arrays as ka
from dynsim.kernels.constraint import bracing as kb
from dynsim.kernels.jit import integers, reals
from dynsim.model.description import Array, Robot
from dynsim.model.drives import Motor, Servo, TorqueSource

MIN_N = 0.5


@dataclass(frozen=True)
class Brace:
    """A point of a body that leans on a surface.

    Attributes
    ----------
    body : name of a body or frame
    point : (3,) in its frame [m]
    normal : (3,) of the surface, away from it, in the world
    friction : μ
    min_N : least normal force [N]
    normal_force : [N], commanded; None: whatever gives the least heat
    sliding : (3,) velocity along the surface, of which the direction counts: f_t = μ f_n against it; None: it is held
    """

    body: str
    point: Array
    normal: Array
    friction: float = 0.0
    min_N: float = MIN_N
    normal_force: float | None = None
    sliding: Array | None = None


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
    """Room for one robot with one set of braces, whose points, normals and forces may change from call to call."""

    def __init__(self, robot: Robot, model: ka.ModelArrays, braces: Mapping[str, Brace]) -> None:
        if robot.couplings:
            raise ModelError("brace_statics: not for robots with coupled joints, which share a motor")
        self._robot, self._model, self.names = robot, model, tuple(braces)
        self._drives = {motor.joint: motor for motor in robot.motors}
        motors = reals(np.zeros((len(robot.links), kb.MOTOR_LIMITS)))
        for j, joint in enumerate(robot.joint_names):
            motor = self._drives.get(joint)
            if motor is not None and not isinstance(motor, TorqueSource):
                motors[j, kb.HEAT] = motor.resistance / motor.joint_constant**2
        link = integers([robot.attach(brace.body, brace.point)[0] for brace in braces.values()])
        self._arrays = kb.brace_arrays(link, reals(np.zeros((len(braces), kb.BRACE_SIZE))), motors)

    def solve(self, ws: ka.Workspace, v: Array, braces: Mapping[str, Brace]) -> BraceStatics:
        """For the q, v and vdot in ``ws.joints`` and these braces, of the names and bodies of the planner."""
        arrays, joints = self._arrays, self._robot.joint_names
        for k, (name, brace) in enumerate(braces.items()):
            arrays.table[k] = _brace_row(self._robot, name, brace)
        for j, joint in enumerate(joints):
            arrays.motors[j, kb.LOWER], arrays.motors[j, kb.UPPER] = _torque_limits(self._drives.get(joint), v[j])
        feasible = bool(kb.brace_statics(self._model, ws, arrays))
        found, heat = arrays.found.copy(), arrays.motors[:, kb.HEAT]
        axes = arrays.table[:, kb.AXES : kb.AXES + 9].reshape(-1, 3, 3)
        if not feasible:
            found[:] = np.nan
        torques = arrays.torques.copy() if feasible else np.full(len(joints), np.nan)
        return BraceStatics(
            feasible=feasible,
            torques=torques,
            heat=float(heat @ torques**2),
            forces={name: found[k, :3] @ axes[k] for k, name in enumerate(self.names)},
            normal_forces={name: float(found[k, 0]) for k, name in enumerate(self.names)},
            intervals={name: (float(found[k, kb.LOW]), float(found[k, kb.HIGH])) for k, name in enumerate(self.names)},
            certificate=None if feasible else arrays.certificate.copy(),
        )


def _brace_row(robot: Robot, name: str, brace: Brace) -> Array:
    """A row of the table of the kernels."""
    row = np.zeros(kb.BRACE_SIZE)
    normal, force = np.asarray(brace.normal, dtype=np.float64), brace.normal_force
    length = float(np.linalg.norm(normal)) if normal.shape == (3,) else np.nan
    if not (np.isfinite(length) and length > 0.0):
        raise ModelError(f"brace {name}: normal {brace.normal} must be a direction in the world, (3,)")
    if not (np.isfinite(brace.friction) and brace.friction >= 0.0):
        raise ModelError(f"brace {name}: friction {brace.friction} must be zero or positive")
    if not (np.isfinite(brace.min_N) and brace.min_N >= 0.0):
        raise ModelError(f"brace {name}: min_N {brace.min_N} must be zero or positive [N]")
    if force is not None and not (np.isfinite(force) and force > 0.0):
        raise ModelError(f"brace {name}: normal_force {force} must be positive [N]; a brace cannot pull")
    normal = normal / length
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    tangents = np.array([first, np.cross(normal, first)])
    row[kb.POINT : kb.POINT + 3] = robot.attach(brace.body, np.asarray(brace.point, dtype=np.float64))[1]
    row[kb.AXES : kb.AXES + 9] = np.concatenate([normal, tangents.ravel()])
    row[kb.FRICTION], row[kb.LEAST] = brace.friction, brace.min_N
    row[kb.COMMANDED] = np.nan if force is None else force
    if brace.sliding is not None:
        slip = tangents @ np.asarray(brace.sliding, dtype=np.float64)
        speed = float(np.linalg.norm(slip))
        if not (np.isfinite(speed) and speed > 0.0):
            raise ModelError(f"brace {name}: sliding {brace.sliding} has no direction along the surface")
        row[kb.SLIP : kb.SLIP + 2] = slip / speed
    return row


def _torque_limits(motor: Motor | Servo | TorqueSource | None, v: float) -> tuple[float, float]:
    """Least and largest torque of a motor at a steady current and a rate v: |R i + K_m v| ≤ U, |i| ≤ I."""
    if motor is None:
        return 0.0, 0.0
    if isinstance(motor, TorqueSource):
        return -motor.torque_limit, motor.torque_limit
    constant = motor.joint_constant
    current = motor.greatest_current if isinstance(motor, Servo) else np.inf
    low = max(-current, (-motor.voltage_limit - constant * v) / motor.resistance)
    high = min(current, (motor.voltage_limit - constant * v) / motor.resistance)
    # A motor that is driven faster than its voltage allows brakes with all it has.
    return constant * min(low, current), constant * max(high, -current)
