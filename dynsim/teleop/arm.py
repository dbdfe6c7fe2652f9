"""A pilot drives the hand of an arm, and its mobile base: velocities that become references at every tick."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from dynsim.compile.control import PLANNED
from dynsim.compile.references.operated import BASE, HAND, VELOCITIES
from dynsim.engine.compilation import kernels_logged
from dynsim.engine.simulation import Simulation
from dynsim.errors import ScenarioError
from dynsim.model.base_pose import base_pose
from dynsim.model.drives import TorqueSource
from dynsim.record import Record
from dynsim.record.poses import poses_at
from dynsim.scenario import Scenario, build
from dynsim.teleop.driven import Array, Axis, Order, Pace, Shown, changed

log = logging.getLogger(__name__)

_NAMES = ("x", "y", "z", "ahead", "turn")


class _Newest:
    """A source that tells the order of the moment."""

    def __init__(self) -> None:
        self.velocity = np.zeros(VELOCITIES)

    def read(self, tick: int) -> Array:
        return self.velocity


class DrivenArm:
    """See :class:`dynsim.teleop.driven.Driven`; ``limit`` is the longest drive [s]."""

    modes: tuple[int, ...] = ()
    has_gripper = False

    def __init__(self, scenario: Scenario, pace: Pace, limit: float) -> None:
        controller = scenario.resolved["controller"]
        if "operator" not in type(scenario.controller).model_fields:
            raise ScenarioError(f"controller {scenario.controller.type!r} follows no operator; joint_pd does")
        operator = controller.get("operator") or _followers(scenario, controller)
        self._controller = {key: value for key, value in controller.items() if key not in PLANNED}
        self._operator = {**operator, "commands": []}
        self._scenario = scenario
        begun = changed(scenario, limit, {**self._controller, "operator": self._operator})
        self._source, self._limit = _Newest(), limit
        self.simulation = Simulation(begun, duration=math.inf, operator=self._source)
        robot = self.simulation.robot
        self._still = _tried(begun, log)
        scene = self._still.scene
        assert scene is not None
        self._scene = scene
        self._rate = float(self._operator.get("rate_hz", 100.0))
        self.period, self.ticks = 1.0 / self._rate, 0
        self._commands: list[dict[str, Any]] = []
        self._last = np.zeros(VELOCITIES)
        limits = {"ahead": ("m/s", pace.base), "turn": ("rad/s", pace.turn)}
        driven = {motor.joint for motor in robot.motors}
        parts = list(range(VELOCITIES))[HAND] if self._operator.get("joints") else []
        if robot.base is not None and driven.issuperset(robot.base.wheels):
            parts += list(range(VELOCITIES))[BASE]
        if not parts:
            raise ScenarioError(
                "there is nothing to drive: name joints that follow the hand, controller.operator.joints "
                f"(joints with a motor: {', '.join(sorted(driven)) or 'none'})"
            )
        self._parts = parts
        self.axes = tuple(
            Axis(_NAMES[k], "hand" if k < BASE.start else "base", *limits.get(_NAMES[k], ("m/s", pace.speed)))
            for k in parts
        )

    @property
    def time(self) -> float:
        """Half a tick behind the last one, whose order is yet to come [s]."""
        return self.simulation.time

    @property
    def finished(self) -> bool:
        """The longest drive is over, or the run ended by itself."""
        return self.simulation.finished or self.ticks >= self._limit * self._rate

    def tick(self, order: Order) -> None:
        """Up to just before the next tick, at which the next order is read."""
        velocity = np.zeros(VELOCITIES)
        velocity[self._parts] = order.velocity
        velocity += 0.0
        command: dict[str, Any] = {}
        for name, part in (("hand", HAND), ("base", BASE)):
            if not np.array_equal(velocity[part], self._last[part]):
                command[name] = velocity[part].tolist()
        if command:
            self._commands.append({"at_s": self.ticks / self._rate, **command})
        self._source.velocity = self._last = velocity
        self.ticks += 1
        self.simulation.advance((self.ticks - 0.5) / self._rate)

    def shown(self) -> Shown:
        """The posture now."""
        simulation = self.simulation
        robot, operator = simulation.robot, simulation.operator
        assert operator is not None
        q = simulation.state.q
        positions = {"q": dict(zip(robot.position_names, q.tolist(), strict=True))}
        if robot.base is not None:
            place = base_pose(robot, q[None])[0].tolist()
            positions["base_pose"] = dict(zip(("x", "y", "heading"), place, strict=True))
        return Shown(
            time=simulation.time,
            poses=poses_at(self._scene, positions),
            hand=operator.target.copy(),
            hindrance=operator.hindrance,
            extra={},
            touching=simulation.touching,
        )

    def joints(self) -> Mapping[str, Array]:
        """Of all rows of the tree."""
        state = self.simulation.state
        return {"q": state.q, "v": state.v}

    def still(self) -> Record:
        """A moment of the same robot at its start, for a page to be made of."""
        return self._still

    def record(self) -> Record:
        """The record of the drive; its scenario is the script."""
        before = self.simulation.snapshot()
        if not self.simulation.finished:
            self.simulation.advance(self.ticks * self.period)
        # As ticks are counted: a step that ends a rounding before one would not be that of a run which ends there.
        duration = max(self.ticks, 1) * self.period
        script = changed(
            self._scenario, duration, {**self._controller, "operator": {**self._operator, "commands": self._commands}}
        )
        record = self.simulation.record(script)
        # The order at this tick is yet to come.
        self.simulation.restore(before)
        record.complete = "stopped" not in record.provenance
        return record


def _tried(scenario: Scenario, log: logging.Logger) -> Record:
    """Two ticks of another simulation, by which the kernels are loaded, or compiled."""
    source = _Newest()
    source.velocity[HAND] = 1e-6
    with kernels_logged(log):
        trial = Simulation(scenario, duration=math.inf, operator=source)
        trial.advance(2.0 / trial.operator.operated.rate if trial.operator is not None else 0.0)
    moment = trial.record()
    moment.complete = True
    return moment


def _followers(scenario: Scenario, controller: dict[str, Any]) -> dict[str, Any]:
    """Joints that follow the hand: those of its path, else all that follow a position, unless contacts hold them."""
    if (hand := controller.get("hand")) is not None:
        return {key: hand[key] for key in ("joints", "braces", "tolerance_m") if key in hand}
    robot, touching = build.robot_and_contacts(scenario)
    if touching and scenario.config.contacts.law != "unilateral":
        return {}
    wheels = () if robot.base is None else robot.base.wheels
    return {"joints": [m.joint for m in robot.motors if not isinstance(m, TorqueSource) and m.joint not in wheels]}
