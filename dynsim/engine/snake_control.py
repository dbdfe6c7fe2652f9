"""A run of the snake's task-space control, kinematic or dynamic: commands, modes, estimated states, recorded rows.

The control law: :mod:`dynsim.snake.controller`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dynsim.engine.mode_switching import ModeSwitcher
from dynsim.errors import ModelError, ScenarioError, SimulationStopped
from dynsim.jit.kernel import integers, reals
from dynsim.scenario import Scenario
from dynsim.snake import state as ss
from dynsim.snake.description import (
    COORDINATES,
    FIXING,
    NO_REQUEST,
    SWITCHING,
    CommandBlock,
    CommandSource,
    Feedback,
    SnakeDescription,
    TaskSpaceController,
)
from dynsim.snake.kinematics import SnakeModel, pose_of_point
from dynsim.snake.state import SnakeState, SnakeTrace, TickWorkspace, new_state, new_tick_workspace, new_trace
from dynsim.snake.ticks import record_row, run_ticks

Array = NDArray[np.float64]

# Why the target waited, in the order of the counters of dynsim.snake.state.SnakeState; the last is the rest: after
# an obstacle, until switching has brought the joints below switching.release_fraction of their limits.
OBSTACLES = ("joint limit", "rate limit", "singular posture", "attitude at beta = 90 deg", "release of the joints")


def _no_commands() -> CommandBlock:
    return CommandBlock(np.zeros((0, 6)), integers([]), integers([]))


@dataclass
class SnakeControl:
    """The robot, its controller, the commands known now, the state, and what was recorded.

    Attributes
    ----------
    ticks : control periods of the whole run; stride : of those that are recorded
    block : commands from tick ``block_start`` on; gripper : (ticks,) as far as they were read
    blocked : the last command was not carried out
    recovering : switching modes until the base joints are released; switch_due : and begins to at the next tick
    """

    description: SnakeDescription
    model: SnakeModel
    controller: TaskSpaceController
    source: CommandSource
    ticks: int
    stride: int
    block: CommandBlock = field(default_factory=_no_commands)
    block_start: int = 0
    blocked: bool = False
    recovering: bool = False
    switch_due: bool = False

    def __post_init__(self) -> None:
        model, description, controller = self.model, self.description, self.controller
        self.state: SnakeState = new_state(model)
        self.ws: TickWorkspace = new_tick_workspace(model)
        self.trace: SnakeTrace = new_trace(model, -(-self.ticks // self.stride) + 1)
        self.gripper: NDArray[np.int64] = np.zeros(self.ticks, dtype=np.int64)
        state = self.state
        state.base[:], state.phi[:] = description.initial_base_pose, description.initial_joints
        pose_of_point(model, state.base, state.phi, self.ws.work.frame, state.w_target)
        state.phi_hat[:], state.w_hat[:] = state.phi, state.w_target
        state.counts[ss.MODE] = controller.fixing_row
        self.switcher = ModeSwitcher(
            policy=controller.policy,
            modes=controller.modes,
            fixing_row=controller.fixing_row,
            order=controller.order,
            period_ticks=controller.switch_ticks,
            least_margin=controller.least_margin,
            predict=self._predict,
        )

    @property
    def tick(self) -> int:
        """Control periods so far."""
        return int(self.state.counts[ss.TICKS])

    @property
    def time(self) -> float:
        """[s]."""
        return self.tick * self.controller.schedule.period

    @property
    def mode(self) -> int:
        """Number of the present mode."""
        return self.controller.modes.numbers[self.state.counts[ss.MODE]]

    def postures(self) -> dict[str, list[float]]:
        """Base, joints and wheels by name, for a message."""
        return {"base_pose": self.state.base.tolist(), "phi": self.state.phi.tolist(), "rho": self.state.rho.tolist()}

    def posture(self) -> tuple[Array, Array, Array]:
        """Pose of the controlled point (6,), base pose (3,) and joints (n_phi,) as an operator sees them."""
        state, w = self.state, np.zeros(6)
        pose_of_point(self.model, state.base, state.phi, self.ws.work.frame, w)
        return w, state.base.copy(), state.phi.copy()

    def read_commands(self, waiting: bool) -> None:
        """Ask the source for the commands from the present tick on; it answers as far as it knows them.

        Velocities that had to wait in the block before this one and were not carried out there are dropped: a script
        is one block and loses none, a joystick says anew what it wants.

        Raises
        ------
        SimulationStopped
            The source failed, or gave what is no command, after the run had begun: there is something to keep.
        ModelError
            The same before the first period.
        """
        state, period, first = self.state, self.controller.schedule.period, self.tick
        w, base, phi = self.posture()
        feedback = Feedback(
            time=first * period,
            w=w,
            w_target=state.w_target.copy(),
            base_pose=base,
            phi=phi,
            mode=self.mode,
            waiting=waiting,
        )
        left = self.ticks - first
        try:
            block = self._checked(self.source.read(first, left, period, feedback), left)
        except (SimulationStopped, ScenarioError):
            raise
        except Exception as error:
            # What is no fault of the source's code is said as it is.
            reason = str(error) if isinstance(error, ModelError) else f"{type(self.source).__name__} failed: {error!r}"
            text = f"command source at t = {feedback.time:g} s: {reason}"
            if first == 0:
                raise ModelError(text) from error
            raise SimulationStopped(text, time=feedback.time, state=self.postures()) from error
        self.block, self.block_start = block, first
        self.gripper[first : first + len(block.request)] = block.gripper
        state.counts[ss.CARRIED_OUT], state.progress[ss.DONE] = 0, 0.0

    def _checked(self, block: CommandBlock, left: int) -> CommandBlock:
        """The commands as arrays; raises ModelError for what the controller cannot be asked."""
        block = CommandBlock(reals(block.velocity), integers(block.request), integers(block.gripper))
        known = len(block.request)
        if not 1 <= known <= left or block.velocity.shape != (known, 6) or block.gripper.shape != (known,):
            raise ModelError(
                f"velocity {block.velocity.shape}, request {block.request.shape}, gripper {block.gripper.shape}; give "
                f"(T, 6), (T,), (T,) with T from 1 to {left}"
            )
        if not np.isfinite(block.velocity).all():
            row, column = np.argwhere(~np.isfinite(block.velocity))[0]
            raise ModelError(
                f"the velocity of {COORDINATES[column]} in period {row} of {known} is {block.velocity[row, column]}"
            )
        for number in set(block.request.tolist()) - {NO_REQUEST, SWITCHING, FIXING}:
            self.controller.modes.row(number, "controller.commands: mode")
        return block

    def begin_period(self) -> None:
        """Take commands and mode of the period that begins.

        Raises
        ------
        SimulationStopped
            The source failed.
        """
        state, switcher, now = self.state, self.switcher, self.tick
        if self.switch_due:
            self.switch_due = False
            state.counts[ss.MODE] = switcher.at_tick(now, SWITCHING)
        if now == self.block_start + len(self.block.request):
            self.read_commands(waiting=self.blocked or self.recovering)
        request = int(self.block.request[now - self.block_start])
        # At the ends of switching periods only, so that every recovery has at least one.
        if self.recovering and now >= (switcher.next_event() or 0) and self._is_released():
            self.recovering, request = False, FIXING
        state.counts[ss.MODE] = switcher.at_tick(now, request)

    def periods(self) -> int:
        """Periods from the present one on in which commands and mode cannot change, at least one."""
        now = self.tick
        ahead = self.block.request[now - self.block_start :]
        later = 1 + np.flatnonzero(ahead[1:] != NO_REQUEST)
        ends = [now + len(ahead), *(now + later[:1])]
        if (event := self.switcher.next_event()) is not None:
            ends.append(event)
        return int(min(ends)) - now

    def end_period(self, blocked: bool) -> None:
        """Take over whether the last period was blocked: switching may have to begin."""
        self.blocked = blocked
        if blocked and not self.recovering and self.controller.when_blocked and not self.switcher.switching:
            self.recovering = self.switch_due = True

    def diverged(self) -> SimulationStopped:
        """What to raise when the state is no longer finite."""
        return SimulationStopped(
            f"the state is no longer finite at t = {self.time:g} s: a singular posture, or a gain too high "
            "for the control period",
            time=self.time,
            state=self.postures(),
        )

    def _is_released(self) -> bool:
        """True when every base joint is well within its limit again ([T] IV.C.5: until the robot becomes operable)."""
        base = slice(self.model.head_joints, None)
        limit = self.controller.release_fraction * self.model.upper[base]
        return bool(np.all(np.abs(self.state.phi[base]) < limit))

    def _predict(self, row: int) -> tuple[float, float]:
        """Cost after one switching period in a mode with the present command held, and the smallest support margin."""
        ticks, law, real = self.controller.prediction_ticks, self.controller.law, self.controller.schedule
        schedule = self.controller.prediction
        waits = (real.null_start_tick - self.tick) * real.period  # until the null space comes on [s]
        schedule = schedule._replace(null_start_tick=round(waits / schedule.period))
        trial, trace = copy_of(self.state), new_trace(self.model, ticks + 1)
        row_of_block = min(int(trial.counts[ss.CARRIED_OUT]), len(self.block.velocity) - 1)
        lasting = np.tile(self.block.velocity[row_of_block], (ticks, 1))
        trial.counts[[ss.MODE, ss.TICKS, ss.CARRIED_OUT]], trial.progress[ss.DONE] = (row, 0, 0), 0.0
        done, _ = run_ticks(self.model, law, schedule, trial, lasting, ticks, 1, 1, 1, self.ws, trace)
        if done < 0:
            return np.inf, -np.inf  # no longer finite: no mode to take
        if done < ticks:  # blocked: the target waits for the rest of the period
            run_ticks(self.model, law, schedule, trial, lasting, ticks - done, 0, 0, 1, self.ws, trace)
        record_row(self.model, law, trial, self.ws, ticks, trace)
        return float(trace.cost[-1]), float(trace.margin.min())


def copy_of(state: SnakeState) -> SnakeState:
    """The state with arrays of its own."""
    return SnakeState(*(array.copy() for array in state))


def control_periods(scenario: Scenario, period: float) -> tuple[int, int]:
    """Control periods [s] of a run, and how many of them go by between two samples of its record.

    Raises
    ------
    ScenarioError
        The run is shorter than a period, or the recording rate does not divide the control rate.
    """
    ticks = round(scenario.duration_s / period)
    if ticks < 1:
        raise ScenarioError(f"duration_s = {scenario.duration_s:g} is shorter than controller.period_s = {period:g}")
    rate_hz = scenario.record.rate_hz
    exact = 1.0 / (rate_hz * period)
    stride = max(1, round(exact))
    if abs(stride - exact) > 1e-6 * exact:
        raise ScenarioError(
            f"record.rate_hz = {rate_hz:g} does not divide the control rate of {1 / period:g} Hz "
            f"(controller.period_s); {1 / (period * stride):g} does"
        )
    return ticks, stride
