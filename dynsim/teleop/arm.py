"""Teleoperation of an arm: a pilot's velocities of hand and mobile base become references at every tick."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from dynsim.compile.control import PLANNED
from dynsim.compile.references.teleop import BASE, HAND, VELOCITIES
from dynsim.engine.compilation import kernels_logged
from dynsim.engine.operator import Operator
from dynsim.engine.simulation import Simulation
from dynsim.errors import ScenarioError
from dynsim.model.base_pose import base_pose
from dynsim.model.drives import TorqueSource
from dynsim.record import Record
from dynsim.record.poses import poses_at
from dynsim.scenario import Scenario, build
from dynsim.teleop.session import Array, Command, LiveFrame, PilotAxis, SpeedLimits, with_controller

log = logging.getLogger(__name__)

_NAMES = ("x", "y", "z", "ahead", "turn")
# Velocity of the trial ticks that load the kernels [m/s].
_SMALL = 1e-6


class ArmSession:
    """See :class:`dynsim.teleop.session.Session`; ``longest`` is the time that it may take [s].

    It is the :class:`~dynsim.compile.references.teleop.VelocitySource` of its own simulation.
    """

    modes: tuple[int, ...] = ()
    has_gripper = False

    def __init__(self, scenario: Scenario, limits: SpeedLimits, longest: float) -> None:
        controller = scenario.resolved["controller"]
        if "operator" not in type(scenario.controller).model_fields:
            raise ScenarioError(f"controller {scenario.controller.type!r} follows no operator; joint_pd does")
        operator = controller.get("operator") or _followers(scenario, controller)
        self._controller = {key: value for key, value in controller.items() if key not in PLANNED}
        self._operator = {**operator, "commands": []}
        self._scenario, self._longest = scenario, longest
        self._velocity, self._last = np.zeros(VELOCITIES), np.zeros(VELOCITIES)
        self._velocity[HAND] = _SMALL
        begun = with_controller(scenario, longest, {**self._controller, "operator": self._operator})
        # Two ticks of another simulation, by which the kernels are loaded, or compiled.
        with kernels_logged(log):
            trial = Simulation(begun, duration=math.inf, operator=self)
            trial.advance(2.0 / trial.operator.rate if trial.operator is not None else 0.0)
        self.still = trial.record()
        self.still.complete = True
        self._velocity = np.zeros(VELOCITIES)
        self.simulation = Simulation(begun, duration=math.inf, operator=self)
        self._rate = float(self._operator.get("rate_hz", 100.0))
        self.period, self.ticks = 1.0 / self._rate, 0
        self._commands: list[dict[str, Any]] = []
        robot = self.simulation.robot
        units = {"ahead": ("m/s", limits.base), "turn": ("rad/s", limits.turn)}
        driven = {motor.joint for motor in robot.motors}
        self._parts = list(range(VELOCITIES))[HAND] if self._operator.get("joints") else []
        if robot.base is not None and driven.issuperset(robot.base.wheels):
            self._parts += list(range(VELOCITIES))[BASE]
        if not self._parts:
            raise ScenarioError(
                "there is nothing to drive: name joints that follow the hand, controller.operator.joints "
                f"(joints with a motor: {', '.join(sorted(driven)) or 'none'})"
            )
        self.axes = tuple(
            PilotAxis(_NAMES[k], "hand" if k < BASE.start else "base", *units.get(_NAMES[k], ("m/s", limits.hand)))
            for k in self._parts
        )

    @property
    def time(self) -> float:
        """Half a tick behind the last one, whose command is yet to come [s]."""
        return self.simulation.time

    @property
    def finished(self) -> bool:
        """The longest time is over, or the run ended by itself."""
        return self.simulation.finished or self.ticks >= self._longest * self._rate

    def read(self, tick: int) -> Array:
        """The command of the moment, whatever tick it is."""
        return self._velocity

    def tick(self, command: Command) -> None:
        """Up to just before the next tick, at which the next command is read."""
        velocity = np.zeros(VELOCITIES)
        velocity[self._parts] = command.velocity
        velocity += 0.0
        entry: dict[str, Any] = {}
        for name, part in (("hand", HAND), ("base", BASE)):
            if not np.array_equal(velocity[part], self._last[part]):
                entry[name] = velocity[part].tolist()
        if entry:
            self._commands.append({"at_s": self.ticks / self._rate, **entry})
        self._velocity = self._last = velocity
        self.ticks += 1
        self.simulation.advance((self.ticks - 0.5) / self._rate)

    def frame(self) -> LiveFrame:
        """The posture now."""
        simulation, scene = self.simulation, self.still.scene
        robot, operator = simulation.robot, simulation.operator
        assert isinstance(operator, Operator)
        assert scene is not None
        q = simulation.state.q
        positions = {"q": dict(zip(robot.position_names, q.tolist(), strict=True))}
        if robot.base is not None:
            pose = base_pose(robot, q[None])[0].tolist()
            positions["base_pose"] = dict(zip(("x", "y", "heading"), pose, strict=True))
        return LiveFrame(
            time=simulation.time,
            poses=poses_at(scene, positions),
            hand=operator.target.copy(),
            hindrance=operator.hindrance,
            extra={},
            touching=simulation.touching,
        )

    def joints(self) -> Mapping[str, Array]:
        """Of all rows of the tree."""
        state = self.simulation.state
        return {"q": state.q, "v": state.v}

    def record(self) -> Record:
        """The record of all ticks so far; its scenario is the script."""
        before = self.simulation.snapshot()
        if not self.simulation.finished:
            self.simulation.end_samples(self.ticks * self.period)
            self.simulation.advance(self.ticks * self.period)
        # As ticks are counted: a step that ends a rounding before one would not be that of a run which ends there.
        duration = max(self.ticks, 1) * self.period
        operator = {**self._operator, "commands": self._commands}
        record = self.simulation.record(
            with_controller(self._scenario, duration, {**self._controller, "operator": operator})
        )
        # The command at this tick is yet to come.
        self.simulation.restore(before)
        record.complete = "stopped" not in record.provenance
        return record


def _followers(scenario: Scenario, controller: dict[str, Any]) -> dict[str, Any]:
    """Joints that follow the hand: those of its path, else all that follow a position, unless contacts hold them."""
    if (hand := controller.get("hand")) is not None:
        return {key: hand[key] for key in ("joints", "braces", "tolerance_m") if key in hand}
    robot, touching = build.robot_and_contacts(scenario)
    if touching and scenario.config.contacts.law != "unilateral":
        return {}
    wheels = () if robot.base is None else robot.base.wheels
    return {"joints": [m.joint for m in robot.motors if not isinstance(m, TorqueSource) and m.joint not in wheels]}
