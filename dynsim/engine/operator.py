"""Operator of a stepped simulation: velocity commands for hand and base become references at every tick.

The hand's target p_d moves with the commanded velocity v in world axes. On a mobile base it moves with the base, and v
is in base axes. Each tick of length h moves the joint references at constant rates to q_d⁺, which puts the hand at p_d
+ h v (damped Gauss–Newton, :func:`dynsim.dynamics.inverse_kinematics.follow_path`):

    q_d(t) = q_d + (q_d⁺ − q_d) (t − t_k)/h

v and the base velocities change from tick to tick by at most their acceleration limits times h, even if joint limits
restrict the hand (:class:`HandGovernor`). Wheels move at the rates (V ∓ ω T/2)/r, at which they roll without slip.

The last part of this module contains the sensors of a sampled controller: sampling, noise, resolution, delay and hold.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.model import Model
from dynsim.compile.reaching import path_arrays
from dynsim.compile.references.splines import wheel_angles
from dynsim.compile.references.teleop import BASE, HAND, VELOCITIES, TeleopOptions, VelocitySource
from dynsim.dynamics import inverse_kinematics as kik
from dynsim.dynamics.tables import workspace
from dynsim.engine.saved_state import Stateful
from dynsim.engine.stepped import State, Touch
from dynsim.jit.kernel import reals
from dynsim.model.base_pose import base_pose, base_row
from dynsim.model.description import Robot
from dynsim.record import Record
from dynsim.scenario.schema import Encoders

# Reference governor of the hand: limits the commanded velocity so that the joints can always stop in time.


HALVINGS = 6
"""Number of bisections of the velocity; each computes one stopping path."""
ROUNDING = 1e-9
"""Tolerance of joint rates and accelerations, relative to their limits."""
TIME_ROUNDING = 1e-9
"""Tolerance of sample times [s]."""


@dataclass(frozen=True)
class StoppingPath:
    """Hand velocities [m/s], hand targets [m] and joint positions at each tick, (T, 3), (T, 3) and (T, c)."""

    velocity: Array
    targets: Array
    joints: Array


class HandGovernor(Stateful):
    """Reference governor: limits the commanded hand velocity so that the hand can always stop in time.

    Attributes
    ----------
    target : (3,) ndarray
        Target of the hand [m].
    velocity : (3,) ndarray
        Velocity of the hand [m/s].
    joints : (c,) ndarray
        Joint positions that put the hand at the target [rad or m].
    rates : (c,) ndarray
        Joint rates in the last tick [rad/s or m/s].
    hindrance : str
        Reason why the hand is slower than commanded; empty if it is not.
    """

    SAVED = ("target", "velocity", "joints", "rates", "hindrance", "_path")

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
        """Start with the joint rates of a state with q, (nq,), and v, (n,), instead of from rest."""
        columns = [self._model.joint_names.index(joint) for joint in self._options.joints]
        self.rates = v[columns].copy()
        jacobian = self._model.point_jacobian(*self._model.robot.hand, q)[:, columns]
        self.velocity = self._axes.T @ jacobian @ self.rates

    def step(self, commanded: Array) -> None:
        """Advance one tick towards a velocity (3,) [m/s] that differs from the last by at most h times its limit."""
        self.hindrance = ""
        if not (commanded.any() or self.velocity.any()):
            self.rates = np.zeros_like(self.rates)
            return
        slower = self._path.velocity[0] if len(self._path.velocity) else np.zeros(3)
        path, why = self._path_to_rest(commanded)
        if path is None:
            self.hindrance = why
            path = self._bisected(slower, commanded)
        self._take(self._path if path is None else path)

    def _bisected(self, slower: Array, commanded: Array) -> StoppingPath | None:
        """Return the stopping path of the fastest admissible velocity between two velocities; None if that is the
        slower one.
        """
        low, high, best = 0.0, 1.0, None
        at_rest, least = not self.velocity.any(), self._options.hand_acceleration / self._options.rate
        for _ in range(HALVINGS):
            part = 0.5 * (low + high)
            velocity = slower + part * (commanded - slower)
            path, _ = self._path_to_rest(velocity)
            creeps = at_rest or float(np.linalg.norm(velocity)) < least
            if path is None or (creeps and not self._slows_down(velocity)):
                high = part
            else:
                low, best = part, path
        return best

    def _slows_down(self, velocity: Array) -> bool:
        """Return whether joints are slower in the second tick than in the first, as on the way out of a singular
        posture.

        The hand may creep only in this case. Otherwise it would creep jerkily to the edge of the workspace and back.
        """
        joints, _ = self._followed(np.array([velocity, velocity]))
        if joints is None:
            return False
        first, second = np.abs(np.diff(np.vstack([self.joints, joints]), axis=0)).max(axis=1)
        return bool(second < first)

    def _take(self, path: StoppingPath) -> None:
        """Apply the first tick of a path, or stop if the path is empty."""
        if not len(path.velocity):
            self.velocity, self.rates = np.zeros(3), np.zeros_like(self.rates)
            return
        self.rates = (path.joints[0] - self.joints) * self._options.rate
        self.velocity, self.target, self.joints = path.velocity[0].copy(), path.targets[0].copy(), path.joints[0].copy()
        self._path = StoppingPath(path.velocity[1:], path.targets[1:], path.joints[1:])

    def _path_to_rest(self, velocity: Array) -> tuple[StoppingPath | None, str]:
        """Return the path to rest that starts with a velocity, or None and the reason."""
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
            or self._first(np.abs(changes) > options.acceleration_limit * (1.0 + ROUNDING), "would accelerate too fast")
        )
        return (None, why) if why else (StoppingPath(velocities, targets, joints), "")

    def _first(self, broken: NDArray[np.bool_], reason: str) -> str:
        """Describe the joint that is the first to violate a limit."""
        ticks, joints = np.nonzero(broken)
        return f"{self._options.joints[joints[0]]} {reason}" if len(ticks) else ""

    def _followed(self, velocities: Array) -> tuple[Array | None, Array]:
        """Return joint positions (T, c) for hand velocities (T, 3), None if out of reach, and the targets (T, 3)."""
        options = self._options
        targets = self.target + np.cumsum(velocities @ self._axes.T, axis=0) / options.rate
        q, joints, count = self._q.copy(), np.zeros((len(targets), len(self.joints))), len(targets)
        q[self._arrays.place] = self.joints
        model, ws, still = self._model.arrays, self._workspace, np.zeros((count, 0))
        ended, _ = kik.follow_path(model, ws, self._arrays, targets, still, 0, 0, count, options.tolerance, q, joints)
        return (joints if ended == count else None), targets


Array = NDArray[np.float64]
# Rounding may make a state at a tick earlier than the tick by up to this [ticks].
TICK_SLACK = 1e-9
# Fraction of the commanded distance that may be lost without a warning: joint limits slow down starts slightly.
MISSED = 0.01


class Referenced(Protocol):
    """A simulation whose state can be read and whose references can be rewritten."""

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


class OperatorPath(Stateful):
    """Commanded path of the hand: straight lines between the ticks."""

    SAVED = ("points",)

    def __init__(self, rate: float, start: Array, time: float = 0.0) -> None:
        self.rate, self.time = rate, time
        self.points = [start.copy()]

    def position(self, t: NDArray[np.float64]) -> Array:
        """Return positions at times t [s], (T,) → (T, 3) [m]."""
        points, ticks = np.array(self.points), self.time + np.arange(len(self.points)) / self.rate
        return np.stack([np.interp(t, ticks, column) for column in points.T], axis=1)


class Operator(Stateful):
    """Tick callback of a simulation that starts from the scenario's start or from the posture of a state."""

    SAVED = ("ticks", "_moving", "_angles", "_base_velocity", "_free", "_commanded", "_missed", "path", "_hand")

    def __init__(
        self, model: Model, options: TeleopOptions, source: VelocitySource | None = None, state: State | None = None
    ) -> None:
        robot = model.robot
        q, time = (robot.initial, 0.0) if state is None else (np.ravel(state.q), state.time)
        self.rate, self.period = options.rate, 1.0 / options.rate
        self.options, self.source = options, options.script if source is None else source
        # When the simulation starts from a state, references are still those of the scenario's start; the first tick
        # writes new ones.
        self.ticks, self._moving = math.floor(time * self.rate + TICK_SLACK), state is not None
        self._model, self._start = model, np.array(model.point_position(*robot.hand, q), dtype=np.float64)
        # On a moving base the target is in base axes and has no path in the world.
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
        # Velocity of the hand without joint and reach limits, and the commanded distance [m].
        self._free, self._commanded = np.zeros(3), 0.0
        # Distance lost [m] and time of the first loss [s], by reason.
        self._missed: dict[str, tuple[float, float]] = {}
        if state is not None:
            self._continue_motion(q, np.ravel(state.v))

    def _continue_motion(self, q: Array, v: Array) -> None:
        """Start the references at the present joint and wheel rates, (n,); with zero rates the drives would brake."""
        if self._hand is not None:
            self._hand.begin(q, v)
            self._free = self._hand.velocity.copy()
        base, joints = self._model.robot.base, self._model.joint_names
        if base is not None and set(base.wheels) <= set(joints):
            rates = wheel_angles(base, np.eye(2)).T
            self._base_velocity = np.linalg.solve(rates, [v[joints.index(wheel)] for wheel in base.wheels])

    @property
    def target(self) -> Array:
        """Target of the hand, (3,) [m]."""
        return self._start if self._hand is None else self._hand.target

    @property
    def hindrance(self) -> str:
        """Reason why the hand is slower than commanded; empty if it is not."""
        return "" if self._hand is None else self._hand.hindrance

    def add_to(self, record: Record) -> None:
        """Add a warning if the hand has moved less than commanded; its actual motion is in the references."""
        missed = sum(distance for distance, _ in self._missed.values())
        if missed > MISSED * self._commanded:
            reason, (_, since) = max(self._missed.items(), key=lambda item: item[1][0])
            record.summary["warnings"].append(
                f"operator: the hand did not execute {missed:.3g} m of the commanded {self._commanded:.3g} m, mostly "
                f"from t = {since:.4g} s on ({reason}); its target waited, and errors refer to the waiting target"
            )

    def __call__(self, simulation: Referenced) -> None:
        """Rewrite the references for the interval up to the next tick."""
        wanted = self.source.read(self.ticks)
        self.ticks += 1
        lines = self._joint_lines(wanted[HAND]) | self._wheel_lines(wanted[BASE])
        moving = any(rate != 0.0 for _, rate in lines.values())
        if moving or self._moving:
            simulation.set_references(lines)
        self._moving = moving

    def _joint_lines(self, wanted: Array) -> dict[str, tuple[float, float]]:
        """Return position and rate of each joint that follows the hand."""
        hand, options = self._hand, self.options
        if hand is None:
            return {}
        begin, change = hand.joints, options.hand_acceleration / options.rate
        hand.step(_limited_change(hand.velocity, wanted, change))
        self._free = _limited_change(self._free, wanted, change)
        self._count(hand)
        if self.path is not None:
            self.path.points.append(hand.target.copy())
        return dict(zip(options.joints, zip(begin.tolist(), hand.rates.tolist(), strict=True), strict=True))

    def _count(self, hand: HandGovernor) -> None:
        """Add a tick to the commanded distance and to the lost distance."""
        self._commanded += float(np.linalg.norm(self._free)) / self.rate
        missed = float(np.linalg.norm(self._free - hand.velocity)) / self.rate
        if missed > 0.0:
            # If there is no hindrance, the hand is still catching up after the last one.
            reason = hand.hindrance or next(reversed(self._missed), "limits")
            before, since = self._missed.get(reason, (0.0, (self.ticks - 1) / self.rate))
            # Keep the latest reason last.
            others = {key: value for key, value in self._missed.items() if key != reason}
            self._missed = others | {reason: (before + missed, since)}

    def _wheel_lines(self, wanted: Array) -> dict[str, tuple[float, float]]:
        """Return position and rate of each wheel of the base."""
        base = self._model.robot.base
        if base is None or not set(base.wheels) <= {motor.joint for motor in self._model.robot.motors}:
            return {}
        most = np.array(self.options.base_acceleration) / self.options.rate
        before = self._base_velocity
        self._base_velocity = np.array(
            [_limited_change(before[k : k + 1], wanted[k : k + 1], most[k])[0] for k in range(2)]
        )
        begin, rates = self._angles.copy(), wheel_angles(base, self._base_velocity[None])[0]
        self._angles = begin + rates / self.options.rate
        return dict(zip(base.wheels, zip(begin.tolist(), rates.tolist(), strict=True), strict=True))


def _limited_change(velocity: Array, wanted: Array, allowed: float) -> Array:
    """Return ``velocity``, changed towards ``wanted`` by at most the allowed amount."""
    change = wanted - velocity
    size = float(np.linalg.norm(change))
    # Reach the wanted velocity exactly, because a robot that has to stop must end at zero velocity.
    return wanted.copy() if size <= allowed else velocity + allowed / size * change


# Sensors of a sampled controller: sampling, noise, resolution, delay and hold.


class SampledSensor(Stateful):
    """Sensor callback, called when a sample is due; :meth:`value` returns the last sample that has arrived.

    A sample of x is x + σ ξ with ξ standard normal, rounded to the resolution ρ if it is positive: ρ round(x/ρ).

    Parameters
    ----------
    read : callable
        Returns the true value (k,) for a state.
    period : float
        Sampling period [s].
    delay : float
        Delay between a sample and its arrival [s].
    noise : (k,) ndarray
        Standard deviations σ.
    resolution : (k,) ndarray
        Resolutions ρ; 0 for no rounding.
    seed : list of int
        Seed of the noise.
    """

    SAVED = ("_samples", "_before", "_random")

    def __init__(
        self,
        read: Callable[[State], Array],
        *,
        period: float,
        delay: float,
        noise: Array,
        resolution: Array,
        seed: list[int],
    ) -> None:
        self.period = period
        self._read, self._delay, self._noise, self._resolution = read, delay, noise, resolution
        self._random = np.random.default_rng(seed)
        self._samples: deque[tuple[float, Array]] = deque()
        self._before: Array | None = None

    def __call__(self, simulation: Referenced) -> None:
        """Take a sample."""
        state = simulation.state
        x = self._read(state) + self._noise * self._random.standard_normal(len(self._noise))
        rounded = self._resolution > 0.0
        x[rounded] = self._resolution[rounded] * np.rint(x[rounded] / self._resolution[rounded])
        # The first sample is available from the start.
        delay = self._delay if self._samples else 0.0
        self._samples.append((state.time + delay, x))

    def value(self, time: float) -> Array:
        """Return the last sample that has arrived at a time [s], (k,)."""
        while len(self._samples) > 1 and self._samples[1][0] <= time + TIME_ROUNDING:
            self._before = self._samples.popleft()[1]
        return self._samples[0][1]

    def rate(self, time: float) -> Array:
        """Return the difference of the last two samples divided by the period, (k,); zero before the second sample."""
        value = self.value(time)
        return np.zeros_like(value) if self._before is None else (value - self._before) / self.period


class EncodedCommands(Stateful):
    """Sampled controller that reads its joints through encoders and computes all commands at its ticks.

    q̂ is the last sample that has arrived. v̂ is its difference from the previous sample divided by their period, as in
    servo drives. With encoders of resolution ρ and period T, v̂ changes in steps of ρ/T.

    Parameters
    ----------
    encoders : Encoders
        Encoder configuration.
    seed : int
        Seed of the noise.
    robot : Robot
        Robot with motors.
    period : float
        Controller period [s].
    take : callable
        Computes the commands from measured positions and rates of the motors' joints, (na,) [rad or m, rad/s or m/s].
    """

    SAVED = ("sensor", "_measured")

    def __init__(
        self, encoders: Encoders, seed: int, robot: Robot, period: float, take: Callable[[Array, Array], None]
    ) -> None:
        self.period, self._take = period, take
        places = dict(zip(robot.joint_names, robot.position_index, strict=True))
        at = np.array([places[motor.joint] for motor in robot.motors], dtype=np.int64)
        turns = {link.joint: link.units[0] == "rad" for link in robot.links}
        revolute = np.array([turns[motor.joint] for motor in robot.motors], dtype=np.bool_)
        self._joints, self._unit = (
            tuple(motor.joint for motor in robot.motors),
            " or ".join(unit for unit, there in (("rad", revolute.any()), ("m", not revolute.all())) if there),
        )
        self.sensor = SampledSensor(
            lambda state: state.q[at],
            period=period if encoders.rate_hz is None else 1.0 / encoders.rate_hz,
            delay=encoders.delay_s,
            noise=np.where(revolute, np.radians(encoders.noise_deg), encoders.noise_m),
            resolution=np.where(revolute, np.radians(encoders.resolution_deg), encoders.resolution_m),
            seed=[seed],
        )
        self._measured: list[tuple[float, Array]] = []

    def __call__(self, simulation: Referenced) -> None:
        """Run one controller tick."""
        time = simulation.state.time
        measured = self.sensor.value(time)
        self._measured.append((time, measured))
        self._take(measured, self.sensor.rate(time))

    def add_to(self, record: Record) -> None:
        """Add the measured joint positions, held from tick to tick."""
        times = np.array([time for time, _ in self._measured]) - TIME_ROUNDING
        rows = np.searchsorted(times, record.time, side="right") - 1
        # The run may have stopped before its first tick.
        readings = np.reshape([positions for _, positions in self._measured], (len(times), len(self._joints)))
        text = "joint positions measured by the controller's encoders"
        record.add("q_measured", readings[rows], self._unit, labels=self._joints, description=text)
