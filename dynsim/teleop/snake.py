"""A pilot drives a snake by its head or gripper: velocities of the target, modes and gripper ([T] IV.C)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dynsim.compile.scene import snake_scene
from dynsim.engine.kinematic import advance_piece, load_kernels, mode_switcher, prepare, read_commands
from dynsim.engine.kinematic_record import COORDINATES, OBSTACLES, make_record
from dynsim.engine.provenance import provenance
from dynsim.record import Record
from dynsim.record.poses import poses_at
from dynsim.scenario import Scenario
from dynsim.snake import state as ss
from dynsim.snake.description import FIXING, SWITCHING, CommandBlock, Feedback
from dynsim.teleop.driven import NO_REQUEST, Array, Axis, Order, Pace, Shown, changed

REQUESTS = {SWITCHING: "switching", FIXING: "fixing"}


class _Newest:
    """A source that tells the order of the moment."""

    def __init__(self) -> None:
        self.order = Order((0.0,) * 6)
        self.feedback: Feedback | None = None

    def read(self, first: int, count: int, period: float, feedback: Feedback) -> CommandBlock:
        self.feedback = feedback
        order = self.order
        # As a script has it: no negative zeros.
        velocity = np.zeros((1, 6)) + np.array(order.velocity)
        return CommandBlock(velocity, np.array([order.request]), np.array([int(order.closed)]))


class DrivenSnake:
    """See :class:`dynsim.teleop.driven.Driven`; ``limit`` is the longest drive [s]."""

    has_gripper = True

    def __init__(self, scenario: Scenario, pace: Pace, limit: float) -> None:
        controller = scenario.resolved["controller"] | {"commands": [], "paths": [], "commands_wait": False}
        self._scenario, self._controller = scenario, controller
        self._source = _Newest()
        self._run = prepare(changed(scenario, limit, controller), self._source)
        self._switcher = mode_switcher(self._run)
        load_kernels(self._run)
        self._still = make_record(self._run, scenario, provenance(scenario), self._switcher, 0.0)
        self._scene = snake_scene(self._run.description)
        self._commands: list[dict[str, Any]] = []
        self._last = Order((0.0,) * 6)
        group = "gripper" if self._run.description.point_offset > 0.0 else "head"
        self.axes = tuple(
            Axis(name, group, *(("m/s", pace.speed) if k < 3 else ("rad/s", pace.turn)))
            for k, name in enumerate(COORDINATES)
        )
        self.modes = self._run.controller.modes.numbers
        self.period = self._run.controller.schedule.period

    @property
    def ticks(self) -> int:
        """Control periods so far."""
        return int(self._run.state.counts[ss.TICKS])

    @property
    def time(self) -> float:
        """[s]."""
        return self.ticks * self.period

    @property
    def finished(self) -> bool:
        """The longest drive is over."""
        return self.ticks >= self._run.ticks

    def tick(self, order: Order) -> None:
        """One control period."""
        self._source.order = order
        before, self._last = self._last, order
        command: dict[str, Any] = {}
        if order.velocity != before.velocity:
            command["velocity"] = [value + 0.0 for value in order.velocity]
        if order.request != NO_REQUEST:
            command["mode"] = REQUESTS.get(order.request, order.request)
        if order.closed != before.closed:
            command["gripper"] = "closed" if order.closed else "open"
        if command:
            self._commands.append({"at_s": self.ticks * self.period, **command})
        if self.ticks == 0:
            # What was known when the run was prepared is not what is asked for now.
            read_commands(self._run, waiting=False)
        advance_piece(self._run, self._switcher)

    def shown(self) -> Shown:
        """The posture now."""
        run, state = self._run, self._run.state
        signals = {
            "base_pose": dict(zip(("x", "y", "yaw"), state.base.tolist(), strict=True)),
            "phi": dict(zip(run.description.joint_names, state.phi.tolist(), strict=True)),
            "rho": dict(zip(run.description.wheel_names, state.rho.tolist(), strict=True)),
        }
        row = int(state.counts[ss.MODE])
        return Shown(
            time=self.time,
            poses=poses_at(self._scene, signals),
            hand=state.w_target[:3].copy(),
            hindrance=self._hindrance(),
            extra={
                "wheels": run.controller.law.grounded[row].tolist(),
                "gripper": int(self._last.closed),
                "mode": run.controller.modes.numbers[row],
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

    def still(self) -> Record:
        """A moment of the same robot at its start, for a page to be made of."""
        return self._still

    def record(self) -> Record:
        """The record of the drive; its scenario is the script."""
        duration = max(self.ticks, 1) * self.period
        script = changed(self._scenario, duration, {**self._controller, "commands": self._commands})
        return make_record(self._run, script, provenance(script), self._switcher, 0.0)
