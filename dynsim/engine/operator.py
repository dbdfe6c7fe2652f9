"""Operator of a stepped simulation: commanded velocities of hand and base become references at every tick.

The hand's target p_d moves with the commanded velocity v, in axes of the world; on a mobile base it moves with that,
and v is in the base's axes. Each tick of length h takes the joint references at constant rates to q_d⁺, which puts the
hand at p_d + h v (damped Gauss–Newton, :func:`dynsim.dynamics.inverse_kinematics.follow_path`):

    q_d(t) = q_d + (q_d⁺ − q_d) (t − t_k)/h

v and the velocities of the base change from tick to tick by no more than their acceleration limits times h, also where
joint limits restrict the hand (:mod:`dynsim.engine.hand_governor`). Wheels get the rates (V ∓ ω T/2)/r, at which they
roll without slip.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.model import Model
from dynsim.compile.references.teleop import BASE, HAND, VELOCITIES, TeleopOptions, VelocitySource
from dynsim.compile.rolling import wheel_angles
from dynsim.engine.hand_governor import HandGovernor
from dynsim.engine.stepped import State, Touch
from dynsim.model.base_pose import base_pose, base_row
from dynsim.record import Record

Array = NDArray[np.float64]
# A state at a tick may be a rounding before it [ticks].
TICK_SLACK = 1e-9
# Part of the commanded way that may be lost without a warning: limits of joints make starts a little slower.
MISSED = 0.01
_STATE = ("ticks", "_moving", "_angles", "_base_velocity", "_free", "_commanded", "_missed")


class Referenced(Protocol):
    """A simulation whose references can be rewritten."""

    @property
    def state(self) -> State:
        """See :attr:`dynsim.engine.simulation.Simulation.state`."""
        ...

    @property
    def touching(self) -> dict[str, Touch]:
        """See :attr:`dynsim.engine.simulation.Simulation.touching`."""
        ...

    @property
    def tie_force(self) -> dict[str, float]:
        """See :attr:`dynsim.engine.simulation.Simulation.tie_force`."""
        ...

    @property
    def tie_slip(self) -> dict[str, float]:
        """See :attr:`dynsim.engine.simulation.Simulation.tie_slip`."""
        ...

    def set_references(self, lines: Mapping[str, tuple[float, float]]) -> None:
        """See :meth:`dynsim.engine.simulation.Simulation.set_references`."""

    def set_tie(
        self, name: str, *, holds: bool | None = None, stiffness: float | None = None, damping: float | None = None
    ) -> None:
        """See :meth:`dynsim.engine.simulation.Simulation.set_tie`."""

    def set_lines(self, motors: NDArray[np.int64], lines: Array) -> None:
        """See :meth:`dynsim.engine.simulation.Simulation.set_lines`."""


class OperatorPath:
    """Where the hand was asked to be: straight lines between the ticks."""

    def __init__(self, rate: float, start: Array, time: float = 0.0) -> None:
        self.rate, self.time = rate, time
        self.points = [start.copy()]

    def position(self, t: NDArray[np.float64]) -> Array:
        """At times t [s], (T,) → (T, 3) [m]."""
        points, ticks = np.array(self.points), self.time + np.arange(len(self.points)) / self.rate
        return np.stack([np.interp(t, ticks, column) for column in points.T], axis=1)


class Operator:
    """Called at the ticks of a simulation, from the scenario's start or from a state, whose posture it takes over."""

    def __init__(
        self, model: Model, options: TeleopOptions, source: VelocitySource | None = None, state: State | None = None
    ) -> None:
        robot = model.robot
        q, time = (robot.initial, 0.0) if state is None else (np.ravel(state.q), state.time)
        self.rate, self.period = options.rate, 1.0 / options.rate
        self.options, self.source = options, options.script if source is None else source
        # At a state references are still those of the scenario's start: the first tick writes them.
        self.ticks, self._moving = math.floor(time * self.rate + TICK_SLACK), state is not None
        self._model, self._start = model, np.array(model.point_position(*robot.hand, q), dtype=np.float64)
        # On a base that drives the target is in the axes of the base, where it has no path in the world.
        self.path = OperatorPath(options.rate, self._start, time) if robot.base is None and options.joints else None
        self._angles, axes = np.zeros(2), np.eye(3)
        self._base_velocity = np.zeros(VELOCITIES)[BASE]
        if robot.base is not None:
            first, _ = base_row(robot)
            self._angles = q[first : first + 2].copy()
            heading = float(base_pose(robot, q[None])[0, 2])
            c, s = math.cos(heading), math.sin(heading)
            axes = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self._hand = HandGovernor(model, options, q, axes) if options.joints else None
        # What the hand would do without limits of its joints and its reach: its velocity, and the way that this is [m].
        self._free, self._commanded = np.zeros(3), 0.0
        # How much of the way it has not gone, and since when, by what was in the way.
        self._missed: dict[str, tuple[float, float]] = {}
        if state is not None:
            self._go_on(q, np.ravel(state.v))

    def _go_on(self, q: Array, v: Array) -> None:
        """Let references begin with the rates that joints and wheels have, (n,): at rest their drives would brake."""
        if self._hand is not None:
            self._hand.begin(q, v)
            self._free = self._hand.velocity.copy()
        base, joints = self._model.robot.base, self._model.joint_names
        if base is not None and set(base.wheels) <= set(joints):
            rates = wheel_angles(base, np.eye(2)).T
            self._base_velocity = np.linalg.solve(rates, [v[joints.index(wheel)] for wheel in base.wheels])

    @property
    def target(self) -> Array:
        """Where the hand is to be, (3,) [m]."""
        return self._start if self._hand is None else self._hand.target

    @property
    def hindrance(self) -> str:
        """Why the hand is slower than it was asked to be; empty where it is not."""
        return "" if self._hand is None else self._hand.hindrance

    def remembered(self) -> dict[str, Any]:
        """What the future depends on: values that are replaced, and never written to."""
        points = None if self.path is None else list(self.path.points)
        hand = None if self._hand is None else self._hand.state()
        return {name: getattr(self, name) for name in _STATE} | {"points": points, "hand": hand}

    def add_to(self, record: Record) -> None:
        """Add a warning if the hand has not moved as far as it was commanded; the remainder is in the references."""
        missed = sum(distance for distance, _ in self._missed.values())
        if missed > MISSED * self._commanded:
            reason, (_, since) = max(self._missed.items(), key=lambda item: item[1][0])
            record.summary["warnings"].append(
                f"operator: {missed:.3g} m of the {self._commanded:.3g} m that the hand was commanded to go were not "
                f"carried out, mostly from t = {since:.4g} s on ({reason}); its target waited, and its errors are "
                "against that"
            )

    def restore(self, state: dict[str, Any]) -> None:
        """Go back to a state of this operator."""
        for name in _STATE:
            setattr(self, name, state[name])
        if self.path is not None:
            self.path.points = list(state["points"])
        if self._hand is not None:
            self._hand.restore(state["hand"])

    def __call__(self, simulation: Referenced) -> None:
        """Rewrite the references for the time up to the next tick."""
        wanted = self.source.read(self.ticks)
        self.ticks += 1
        lines = self._joint_lines(wanted[HAND]) | self._wheel_lines(wanted[BASE])
        moving = any(rate != 0.0 for _, rate in lines.values())
        if moving or self._moving:
            simulation.set_references(lines)
        self._moving = moving

    def _joint_lines(self, wanted: Array) -> dict[str, tuple[float, float]]:
        """Position and rate of each joint that follows the hand."""
        hand, options = self._hand, self.options
        if hand is None:
            return {}
        begin, change = hand.joints, options.hand_acceleration / options.rate
        hand.go(_eased(hand.velocity, wanted, change))
        self._free = _eased(self._free, wanted, change)
        self._count(hand)
        if self.path is not None:
            self.path.points.append(hand.target.copy())
        return dict(zip(options.joints, zip(begin.tolist(), hand.rates.tolist(), strict=True), strict=True))

    def _count(self, hand: HandGovernor) -> None:
        """Add a tick to the commanded way, and to what of it was not gone."""
        self._commanded += float(np.linalg.norm(self._free)) / self.rate
        missed = float(np.linalg.norm(self._free - hand.velocity)) / self.rate
        if missed > 0.0:
            # Without a hindrance it is still catching up after the last one.
            reason = hand.hindrance or next(reversed(self._missed), "limits")
            before, since = self._missed.get(reason, (0.0, (self.ticks - 1) / self.rate))
            # The latest last.
            others = {key: value for key, value in self._missed.items() if key != reason}
            self._missed = others | {reason: (before + missed, since)}

    def _wheel_lines(self, wanted: Array) -> dict[str, tuple[float, float]]:
        """Position and rate of each wheel of the base."""
        base = self._model.robot.base
        if base is None or not set(base.wheels) <= {motor.joint for motor in self._model.robot.motors}:
            return {}
        most = np.array(self.options.base_acceleration) / self.options.rate
        before = self._base_velocity
        self._base_velocity = np.array([_eased(before[k : k + 1], wanted[k : k + 1], most[k])[0] for k in range(2)])
        begin, rates = self._angles.copy(), wheel_angles(base, self._base_velocity[None])[0]
        self._angles = begin + rates / self.options.rate
        return dict(zip(base.wheels, zip(begin.tolist(), rates.tolist(), strict=True), strict=True))


def _eased(velocity: Array, wanted: Array, allowed: float) -> Array:
    """A velocity that has come as near to another as the change that is allowed takes it."""
    change = wanted - velocity
    size = float(np.linalg.norm(change))
    # What is reached is exact: a robot that is to rest rests.
    return wanted.copy() if size <= allowed else velocity + allowed / size * change
