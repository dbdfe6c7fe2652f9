"""Teleoperation of a snake by head or gripper: target velocities, modes and gripper ([T] IV.C)."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from dynsim.engine.compilation import kernels_logged
from dynsim.engine.kinematic import prepare
from dynsim.engine.kinematic_record import make_record
from dynsim.engine.simulation import Simulation
from dynsim.engine.snake_control import OBSTACLES, SnakeControl
from dynsim.engine.snake_pilot import SnakePilot
from dynsim.engine.stepped import Touch
from dynsim.record import Record
from dynsim.record.poses import poses_at
from dynsim.record.scene import Scene
from dynsim.scenario import Scenario
from dynsim.snake import state as ss
from dynsim.snake.description import COORDINATES, FIXING, NO_REQUEST, SWITCHING, CommandBlock, Feedback
from dynsim.teleop.session import Array, Command, LiveFrame, PilotAxis, SpeedLimits, with_controller

log = logging.getLogger(__name__)

REQUESTS = {SWITCHING: "switching", FIXING: "fixing"}


class SnakeSession:
    """See :class:`dynsim.teleop.session.Session`; ``longest`` is the time that it may take [s].

    It is the :class:`~dynsim.snake.description.CommandSource` of its own run.
    """

    has_gripper = True

    def __init__(self, scenario: Scenario, limits: SpeedLimits, longest: float) -> None:
        controller = scenario.resolved["controller"] | {"commands": [], "paths": [], "commands_wait": False}
        self._scenario, self._controller = scenario, controller
        self._command = Command((0.0,) * 6)
        self._commands: list[dict[str, Any]] = []
        self._begin(with_controller(scenario, longest, controller))
        group = "gripper" if self._run.description.point_offset > 0.0 else "head"
        self.axes = tuple(
            PilotAxis(name, group, *(("m/s", limits.hand) if k < 3 else ("rad/s", limits.turn)))
            for k, name in enumerate(COORDINATES)
        )
        self.modes = self._run.controller.modes.numbers
        self.period = self._run.controller.schedule.period

    _run: SnakeControl

    def _begin(self, scenario: Scenario) -> None:
        """The run, its kernels loaded, and a moment of it."""
        run = self._kinematic = prepare(scenario, self)
        run.load_kernels()
        self._run = run
        self.still = make_record(run, self._scenario, 0.0)
        assert self.still.scene is not None
        self._scene: Scene = self.still.scene

    @property
    def ticks(self) -> int:
        """Control periods so far."""
        return self._run.tick

    @property
    def time(self) -> float:
        """[s]."""
        return self._run.time

    @property
    def finished(self) -> bool:
        """The longest time is over."""
        return self.ticks >= self._run.ticks

    def read(self, first: int, count: int, period: float, feedback: Feedback) -> CommandBlock:
        """The command of the moment, for one period."""
        command = self._command
        # As a script has it: no negative zeros.
        velocity = np.zeros((1, 6)) + np.array(command.velocity)
        return CommandBlock(velocity, np.array([command.request]), np.array([int(command.closed)]))

    def tick(self, command: Command) -> None:
        """One control period."""
        before, self._command = self._command, command
        entry: dict[str, Any] = {}
        if command.velocity != before.velocity:
            entry["velocity"] = [value + 0.0 for value in command.velocity]
        if command.request != NO_REQUEST:
            entry["mode"] = REQUESTS.get(command.request, command.request)
        if command.closed != before.closed:
            entry["gripper"] = "closed" if command.closed else "open"
        if entry:
            self._commands.append({"at_s": self.ticks * self.period, **entry})
        if self.ticks == 0:
            # What was known when the run was prepared is not what is commanded now.
            self._run.read_commands(waiting=False)
        self._advance()

    def _advance(self) -> None:
        self._kinematic.advance()

    def frame(self) -> LiveFrame:
        """The posture now."""
        run, state = self._run, self._run.state
        row = int(state.counts[ss.MODE])
        return LiveFrame(
            time=self.time,
            poses=poses_at(self._scene, self._positions()),
            hand=state.w_target[:3].copy(),
            hindrance=self._hindrance(),
            extra={
                "wheels": run.controller.law.grounded[row].tolist(),
                "gripper": int(self._command.closed),
                "mode": run.mode,
                **self._grip(),
            },
            touching=self._touching(),
        )

    def _positions(self) -> Mapping[str, Mapping[str, float]]:
        """Positions of the joints of the scene, by signal and label."""
        run, state = self._run, self._run.state
        objects = (
            {}
            if self._kinematic.objects is None
            else {"q": self._kinematic.objects.positions(run.tick, run.posture()[0])}
        )
        return objects | {
            "base_pose": dict(zip(("x", "y", "yaw"), state.base.tolist(), strict=True)),
            "phi": dict(zip(run.description.joint_names, state.phi.tolist(), strict=True)),
            "rho": dict(zip(run.description.wheel_names, state.rho.tolist(), strict=True)),
        }

    def _grip(self) -> dict[str, str]:
        """State of the gripper in words, where there are objects that it can hold."""
        objects = self._kinematic.objects
        return {} if objects is None else {"grip": objects.state_in_words(self.ticks)}

    def _touching(self) -> Mapping[str, Touch]:
        return {}

    def _hindrance(self) -> str:
        """What the target waits for."""
        run = self._run
        if run.recovering:
            return OBSTACLES[-1]
        return OBSTACLES[int(run.state.counts[ss.STILL_FOR]) - 1] if run.blocked else ""

    def joints(self) -> Mapping[str, Array]:
        """Joints and wheels; rates are held from period to period, so that they are differences of these."""
        run, state = self._run, self._run.state
        grounded = run.controller.law.grounded[int(state.counts[ss.MODE])]
        return {"phi": state.phi.copy(), "rho": state.rho.copy(), "grounded": grounded}

    def record(self) -> Record:
        """The record of all ticks so far; its scenario is the script."""
        duration = max(self.ticks, 1) * self.period
        script = with_controller(self._scenario, duration, {**self._controller, "commands": self._commands})
        return self._record(script)

    def _record(self, script: Scenario) -> Record:
        return make_record(self._kinematic, script, 0.0)


class DynamicSnakeSession(SnakeSession):
    """The same of a snake with servos and wheels that can slip: its simulation asks the session at its ticks."""

    def _begin(self, scenario: Scenario) -> None:
        with kernels_logged(log):
            trial = Simulation(scenario, duration=math.inf, operator=self)
            trial.advance(2.0 * self._pilot(trial).period)
        self.still = trial.record(self._scenario)
        self.still.complete = True
        self._simulation = Simulation(scenario, duration=math.inf, operator=self)
        self._run = self._pilot(self._simulation)
        assert self.still.scene is not None
        self._scene = self.still.scene

    @staticmethod
    def _pilot(simulation: Simulation) -> SnakePilot:
        assert isinstance(simulation.operator, SnakePilot)
        return simulation.operator

    @property
    def time(self) -> float:
        """Half a tick behind the last one [s]."""
        return self._simulation.time

    def _advance(self) -> None:
        self._simulation.advance((self.ticks + 0.5) * self.period)

    def _positions(self) -> Mapping[str, Mapping[str, float]]:
        q = self._simulation.state.q.tolist()
        return {"q": dict(zip(self._simulation.robot.position_names, q, strict=True))}

    def _grip(self) -> dict[str, str]:
        grip = self._pilot(self._simulation).grip
        return {} if grip is None else {"grip": grip.state_in_words}

    def _touching(self) -> Mapping[str, Touch]:
        return self._simulation.touching

    def _record(self, script: Scenario) -> Record:
        simulation = self._simulation
        before, longest = simulation.snapshot(), self._run.ticks
        # As a run that ends here: the command at this tick is yet to come.
        self._run.ticks = self.ticks
        simulation.end_samples(self.ticks * self.period)
        simulation.advance(self.ticks * self.period)
        record = simulation.record(script)
        self._run.ticks = longest
        simulation.restore(before)
        record.complete = "stopped" not in record.provenance
        return record
