"""An operator at a stepped simulation: velocities of hand and base become references, rewritten at every tick.

The hand's target p_d moves with the velocity v that is asked for, in axes of the world; on a mobile base in those of
the base, which carries it. Each tick of length h takes the joints to where the hand is at p_d + h v, at constant rates
(damped Gauss–Newton, :func:`dynsim.kernels.inverse_kinematics.follow_path`):

    q_d(t) = q_d + (q_d⁺ − q_d) (t − t_k)/h

v and the velocities of the base change from tick to tick by no more than their accelerations times h. Where a joint
would be too fast or pass its limit, the hand gets a part of v, down to an eighth, and then waits. Wheels get the rates
(V ∓ ω T/2)/r of what they roll without slip.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dynsim.kernels import inverse_kinematics as ki
from dynsim.kernels.arrays import workspace
from dynsim.kernels.jit import reals
from dynsim.model.mobile_base import base_pose, base_row
from dynsim.model.model import Model
from dynsim.model.operated import BASE, HAND, VELOCITIES, Operated, VelocitySource
from dynsim.model.reaching import path_arrays
from dynsim.model.rolling import wheel_angles

if TYPE_CHECKING:
    from dynsim.engine.simulation import Simulation

Array = NDArray[np.float64]

PARTS = (1.0, 0.5, 0.25, 0.125)
"""Of the hand's velocity, of which the first that the joints can follow is taken."""


_BASE = tuple(slice(k, k + 1) for k in range(BASE.start, BASE.stop))


class OperatorPath:
    """Where the hand was asked to be: straight lines between the ticks."""

    def __init__(self, rate: float, start: Array) -> None:
        self.rate = rate
        self.points = [start.copy()]

    def position(self, t: NDArray[np.float64]) -> Array:
        """At times t [s], (T,) → (T, 3) [m]."""
        points, ticks = np.array(self.points), np.arange(len(self.points)) / self.rate
        return np.stack([np.interp(t, ticks, column) for column in points.T], axis=1)


class Operator:
    """Called at the ticks of a simulation; ``waiting`` where the hand could not do what was asked for."""

    def __init__(self, model: Model, operated: Operated, source: VelocitySource | None = None) -> None:
        robot = model.robot
        self.operated, self.source = operated, operated.script if source is None else source
        self.ticks, self.waiting = 0, False
        self._model, self._moving = model, False
        self.target = np.array(model.point_position(*robot.hand, robot.initial), dtype=np.float64)
        # On a base that drives the target is in the axes of the base, where it has no path in the world.
        self.path = OperatorPath(operated.rate, self.target) if robot.base is None and operated.joints else None
        self._q, self._angles, self._axes = reals(robot.initial), np.zeros(2), np.eye(3)
        self._velocity = np.zeros(VELOCITIES)
        if robot.base is not None:
            first, _ = base_row(robot)
            self._angles = robot.initial[first : first + 2].copy()
            heading = float(base_pose(robot, robot.initial[None])[0, 2])
            c, s = math.cos(heading), math.sin(heading)
            self._axes = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        if operated.joints:
            self._arrays = path_arrays(model, operated.joints, operated.braces)
            self._workspace = workspace(model.n, 0, 0)
            links = {link.joint: link for link in robot.links}
            self._low = np.array([links[joint].lower for joint in operated.joints])
            self._high = np.array([links[joint].upper for joint in operated.joints])

    def state(self) -> dict[str, Any]:
        """What the future depends on."""
        points = None if self.path is None else list(self.path.points)
        kept = {"ticks": self.ticks, "waiting": self.waiting, "_moving": self._moving, "points": points}
        return kept | {name: getattr(self, name).copy() for name in ("target", "_q", "_angles", "_velocity")}

    def restore(self, state: dict[str, Any]) -> None:
        """Go back to a state of this operator."""
        for name, value in state.items():
            if name != "points":
                setattr(self, name, value.copy() if isinstance(value, np.ndarray) else value)
            elif self.path is not None:
                self.path.points = list(value)

    def __call__(self, simulation: Simulation) -> None:
        """Rewrite the references for the time up to the next tick."""
        velocity = self._eased(self.source.read(self.ticks))
        self.ticks += 1
        lines = self._joint_lines(velocity[HAND]) | self._wheel_lines(velocity[BASE])
        moving = any(rate != 0.0 for _, rate in lines.values())
        if moving or self._moving:
            for joint, (position, rate) in lines.items():
                simulation.set_reference(joint, position, rate)
        self._moving = moving

    def _eased(self, wanted: Array) -> Array:
        """Velocities that have come as near to those that are wanted as accelerations allow."""
        base = self.operated.base_acceleration
        for part, most in ((HAND, self.operated.hand_acceleration), *zip(_BASE, base, strict=True)):
            change = wanted[part] - self._velocity[part]
            size = float(np.linalg.norm(change))
            allowed = most / self.operated.rate
            # What is reached is exact: a robot that is to rest rests.
            self._velocity[part] = wanted[part] if size <= allowed else self._velocity[part] + allowed / size * change
        return self._velocity

    def _joint_lines(self, velocity: Array) -> dict[str, tuple[float, float]]:
        """Position and rate of each joint that follows the hand."""
        operated = self.operated
        if not operated.joints:
            return {}
        place, found = self._arrays.place, None
        begin = self._q[place]
        if velocity.any():
            step = self._axes @ velocity / operated.rate
            found = next((one for part in PARTS if (one := self._reached(self.target + part * step)) is not None), None)
        self.waiting = found is None and bool(velocity.any())
        if found is not None:
            self._q, self.target = found
        else:
            self._velocity[HAND] = 0.0
        if self.path is not None:
            self.path.points.append(self.target.copy())
        rates = (self._q[place] - begin) * operated.rate
        return dict(zip(operated.joints, zip(begin.tolist(), rates.tolist(), strict=True), strict=True))

    def _reached(self, target: Array) -> tuple[Array, Array] | None:
        """Coordinates with the hand at a target, and it; None where joints cannot go there within a tick."""
        operated, arrays, q = self.operated, self._arrays, self._q.copy()
        place = arrays.place
        result, nothing = np.zeros((1, len(place))), np.zeros((1, 0))
        targets, model, ws = target[None].copy(), self._model.arrays, self._workspace
        ended, _ = ki.follow_path(model, ws, arrays, targets, nothing, 0, 0, 1, operated.tolerance, q, result)
        change = np.abs(q[place] - self._q[place]).max() * operated.rate
        within = bool((q[place] >= self._low).all() and (q[place] <= self._high).all())
        return (q, target) if ended == 1 and within and change <= operated.rate_limit else None

    def _wheel_lines(self, velocity: Array) -> dict[str, tuple[float, float]]:
        """Position and rate of each wheel of the base."""
        base = self._model.robot.base
        if base is None or not set(base.wheels) <= {motor.joint for motor in self._model.robot.motors}:
            return {}
        begin, rates = self._angles.copy(), wheel_angles(base, velocity[None])[0]
        self._angles = begin + rates / self.operated.rate
        return dict(zip(base.wheels, zip(begin.tolist(), rates.tolist(), strict=True), strict=True))
