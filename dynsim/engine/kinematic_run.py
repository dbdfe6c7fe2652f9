"""Run of the kinematic snake: control periods in compiled code, mode switches between them in Python."""

from __future__ import annotations

import numpy as np

from dynsim.engine.kinematic_objects import CarriedObjects
from dynsim.engine.snake_control import SnakeControl, copy_of
from dynsim.snake.state import new_trace
from dynsim.snake.ticks import record_row, run_ticks

CHUNK = 500  # ticks between two checks for signals and updates of the bar: about 25 ms, at worst ten times as long


class SnakeRun(SnakeControl):
    """The control of a snake whose joints follow their rates exactly, and whose base moves as its wheels roll."""

    objects: CarriedObjects | None = None

    def load_kernels(self) -> None:
        """Compile or load the kernels: that is no simulation time."""
        law, schedule, trial = self.controller.law, self.controller.schedule, copy_of(self.state)
        trace = new_trace(self.model, 1)
        run_ticks(self.model, law, schedule, trial, self.block.velocity, 0, 1, 1, 1, self.ws, trace)
        record_row(self.model, law, trial, self.ws, 0, trace)

    def advance(self) -> None:
        """Run the control periods up to the next one in which something may change: one, of a source that knows one.

        Raises
        ------
        SimulationStopped
            The state is no longer finite, or the source failed.
        """
        self.begin_period()
        periods = min(self.periods(), CHUNK)
        if self.objects is not None:
            now, block = self.tick, self.block.gripper[self.tick - self.block_start :]
            w, _, _ = self.posture()
            self.objects.release(now, w)
            self.objects.command(now, bool(block[0]), w)
            changes = np.flatnonzero(block != block[0])
            periods = int(min([periods, self.objects.due(now), *changes[:1].tolist()]))
        done, blocked = run_ticks(
            self.model,
            self.controller.law,
            self.controller.schedule,
            self.state,
            self.block.velocity,
            periods,
            int(not self.recovering),
            int(self.controller.when_blocked),
            self.stride,
            self.ws,
            self.trace,
        )
        if done < 0:
            raise self.diverged()
        self.end_period(blocked)
