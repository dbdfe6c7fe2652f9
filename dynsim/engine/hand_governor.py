"""Reference governor of the hand: limits its commanded velocity so that the joints can always stop in time.

The state is the target p_d of the hand, its velocity v and the joint positions that reach p_d. v is admissible if the
hand can come to rest along a straight line with the deceleration a. With ticks of length h, the points of that line

    p_d + h v,  p_d + h v + h (v − a h v/|v|),  …,  rest

must be within reach, and the joints must get there within their ranges, rates and accelerations. From an admissible
velocity the first tick of this stopping path is always possible, and the rest of it is again a stopping path. So each
tick takes

    v⁺ = v_rest + λ (v_wish − v_rest),   0 ≤ λ ≤ 1

with v_rest the next velocity of the stopping path, v_wish the commanded velocity with its change limited to a h, and λ
the largest admissible value found: 1, or by bisection. v_rest and v_wish differ from v by at most a h, hence v⁺ does.
At the edge of reach, where joint rates would be unbounded, the limit on joint accelerations ends the path in time.

Source: E. Gilbert, I. Kolmanovsky, "Nonlinear tracking control in the presence of state and control constraints: a
generalized reference governor", Automatica 38 (2002); λ and the admissible way to rest are theirs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.model import Model
from dynsim.compile.reaching import path_arrays
from dynsim.compile.references.teleop import TeleopOptions
from dynsim.dynamics import inverse_kinematics as kik
from dynsim.dynamics.tables import workspace
from dynsim.jit.kernel import reals

Array = NDArray[np.float64]

HALVINGS = 6
"""Bisections of λ; each computes one stopping path."""
ROUNDING = 1e-9
"""Tolerance of joint rates and accelerations, relative to their limits."""
_STATE = ("target", "velocity", "joints", "rates", "hindrance", "_path")


@dataclass(frozen=True)
class StoppingPath:
    """Hand velocities [m/s], hand targets [m] and joint positions of each tick, (T, 3), (T, 3) and (T, c)."""

    velocity: Array
    targets: Array
    joints: Array

    def remainder(self) -> StoppingPath:
        """What is left of it after a tick."""
        return StoppingPath(self.velocity[1:], self.targets[1:], self.joints[1:])


class HandGovernor:
    """Takes a hand along velocities, as far as it can stop in time.

    Attributes
    ----------
    target : (3,) of the hand [m]; velocity : (3,) [m/s]; joints : (c,) that have it there [rad or m]
    rates : (c,) of the joints in the last tick [rad/s or m/s]
    hindrance : why the hand is slower than it was asked to be; empty where it is not
    """

    def __init__(self, model: Model, options: TeleopOptions, q: Array, axes: Array) -> None:
        self._options, self._model, self._axes = options, model, axes
        self._arrays = path_arrays(model, options.joints, options.braces)
        self._workspace = workspace(model.n, 0, 0)
        self._q = reals(q)
        links = {link.joint: link for link in model.robot.links}
        self._low = np.array([links[joint].lower for joint in options.joints])
        self._high = np.array([links[joint].upper for joint in options.joints])
        self.target = np.array(model.point_position(*model.robot.hand, q), dtype=np.float64)
        self.velocity = np.zeros(3)
        self.joints = self._q[self._arrays.place].copy()
        self.rates, self.hindrance = np.zeros(len(self.joints)), ""
        self._path = StoppingPath(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, len(self.joints))))

    def begin(self, q: Array, v: Array) -> None:
        """Begin with the rates that the joints have at coordinates q, (nq,), with rates v, (n,), instead of at rest."""
        columns = [self._model.joint_names.index(joint) for joint in self._options.joints]
        self.rates = v[columns].copy()
        jacobian = self._model.point_jacobian(*self._model.robot.hand, q)[:, columns]
        self.velocity = self._axes.T @ jacobian @ self.rates

    def state(self) -> dict[str, Any]:
        """What the future depends on: values that are replaced, and never written to."""
        return {name: getattr(self, name) for name in _STATE}

    def restore(self, state: dict[str, Any]) -> None:
        """Go back to a state of this governor."""
        for name, value in state.items():
            setattr(self, name, value)

    def go(self, wish: Array) -> None:
        """A tick towards a velocity (3,) [m/s] that differs from the last by no more than a h."""
        self.hindrance = ""
        if not (wish.any() or self.velocity.any()):
            self.rates = np.zeros_like(self.rates)
            return
        slower = self._path.velocity[0] if len(self._path.velocity) else np.zeros(3)
        path, why = self._path_to_rest(wish)
        if path is None:
            self.hindrance = why
            path = self._bisected(slower, wish)
        self._take(self._path if path is None else path)

    def _bisected(self, slower: Array, wish: Array) -> StoppingPath | None:
        """The way from the fastest admissible velocity between those two; None where it is the slower one."""
        low, high, best = 0.0, 1.0, None
        at_rest, least = not self.velocity.any(), self._options.hand_acceleration / self._options.rate
        for _ in range(HALVINGS):
            part = 0.5 * (low + high)
            velocity = slower + part * (wish - slower)
            path, _ = self._path_to_rest(velocity)
            creeps = at_rest or float(np.linalg.norm(velocity)) < least
            if path is None or (creeps and not self._gets_easier(velocity)):
                high = part
            else:
                low, best = part, path
        return best

    def _gets_easier(self, velocity: Array) -> bool:
        """Joints are slower in the second tick than in the first, as on the way out of a singular posture.

        A hand creeps only then. To an edge it would creep by jerks, and so near that it would creep back, too.
        """
        joints, _ = self._followed(np.array([velocity, velocity]))
        if joints is None:
            return False
        first, second = np.abs(np.diff(np.vstack([self.joints, joints]), axis=0)).max(axis=1)
        return bool(second < first)

    def _take(self, path: StoppingPath) -> None:
        """The first tick of a way, or rest where none is left."""
        if not len(path.velocity):
            self.velocity, self.rates = np.zeros(3), np.zeros_like(self.rates)
            return
        self.rates = (path.joints[0] - self.joints) * self._options.rate
        self.velocity, self.target, self.joints = path.velocity[0].copy(), path.targets[0].copy(), path.joints[0].copy()
        self._path = path.remainder()

    def _path_to_rest(self, velocity: Array) -> tuple[StoppingPath | None, str]:
        """The way to rest that begins with a velocity, or None and what is against it."""
        options = self._options
        speed, lost = float(np.linalg.norm(velocity)), options.hand_acceleration / options.rate
        if speed == 0.0:
            return StoppingPath(np.zeros((1, 3)), self.target[None].copy(), self.joints[None].copy()), ""
        parts = np.maximum(1.0 - lost / speed * np.arange(max(1, math.ceil(speed / lost - ROUNDING))), 0.0)
        velocities = parts[:, None] * velocity
        joints, targets = self._followed(velocities)
        if joints is None:
            return None, "out of reach"
        rates = np.diff(np.vstack([self.joints, joints]), axis=0) * options.rate
        changes = np.diff(np.vstack([self.rates, rates, np.zeros_like(self.rates)]), axis=0) * options.rate
        why = (
            self._first((joints < self._low) | (joints > self._high), "is at its limit")
            or self._first(np.abs(rates) > options.rate_limit * (1.0 + ROUNDING), "would be too fast")
            or self._first(np.abs(changes) > options.acceleration_limit * (1.0 + ROUNDING), "would speed up too fast")
        )
        return (None, why) if why else (StoppingPath(velocities, targets, joints), "")

    def _first(self, broken: NDArray[np.bool_], reason: str) -> str:
        """The joint that is the first to break a limit."""
        ticks, joints = np.nonzero(broken)
        return f"{self._options.joints[joints[0]]} {reason}" if len(ticks) else ""

    def _followed(self, velocities: Array) -> tuple[Array | None, Array]:
        """Joints (T, c) with the hand where velocities (T, 3) take it, None out of reach; and the targets (T, 3)."""
        options = self._options
        targets = self.target + np.cumsum(velocities @ self._axes.T, axis=0) / options.rate
        q, joints, count = self._q.copy(), np.zeros((len(targets), len(self.joints))), len(targets)
        q[self._arrays.place] = self.joints
        ended, _ = kik.follow_path(
            self._model.arrays,
            self._workspace,
            self._arrays,
            targets,
            np.zeros((count, 0)),
            0,
            0,
            count,
            options.tolerance,
            q,
            joints,
        )
        return (joints if ended == count else None), targets
