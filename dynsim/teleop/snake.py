"""A pilot commands a snake by its head or gripper: velocities of the target, modes and gripper ([T] IV.C)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dynsim.compile.scene import snake_scene
from dynsim.engine.kinematic import prepare
from dynsim.engine.kinematic_record import make_record
from dynsim.engine.snake_control import OBSTACLES
from dynsim.record import Record
from dynsim.record.poses import poses_at
from dynsim.scenario import Scenario
from dynsim.snake import state as ss
from dynsim.snake.description import COORDINATES, FIXING, SWITCHING, CommandBlock, Feedback
from dynsim.teleop.session import NO_REQUEST, Array, Command, LiveFrame, PilotAxis, SpeedLimits, with_controller

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
        self._run = prepare(with_controller(scenario, longest, controller), self)
        self._run.load_kernels()
        self.still = make_record(self._run, scenario, 0.0)
        self._scene = snake_scene(self._run.description)
        group = "gripper" if self._run.description.point_offset > 0.0 else "head"
        self.axes = tuple(
            PilotAxis(name, group, *(("m/s", limits.hand) if k < 3 else ("rad/s", limits.turn)))
            for k, name in enumerate(COORDINATES)
        )
        self.modes = self._run.controller.modes.numbers
        self.period = self._run.controller.schedule.period

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
        self._run.advance()

    def frame(self) -> LiveFrame:
        """The posture now."""
        run, state = self._run, self._run.state
        signals = {
            "base_pose": dict(zip(("x", "y", "yaw"), state.base.tolist(), strict=True)),
            "phi": dict(zip(run.description.joint_names, state.phi.tolist(), strict=True)),
            "rho": dict(zip(run.description.wheel_names, state.rho.tolist(), strict=True)),
        }
        row = int(state.counts[ss.MODE])
        return LiveFrame(
            time=self.time,
            poses=poses_at(self._scene, signals),
            hand=state.w_target[:3].copy(),
            hindrance=self._hindrance(),
            extra={
                "wheels": run.controller.law.grounded[row].tolist(),
                "gripper": int(self._command.closed),
                "mode": run.mode,
            },
            touching={},
        )

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
        return make_record(self._run, script, 0.0)
