"""Task-space control of a snake: wheel lifting, mode changes, commands, states, recorded rows.

It serves kinematic and dynamic snakes. The control law is in :mod:`dynsim.snake.controller`.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynsim.compile.control import JointControl
from dynsim.compile.snake_tree import GROUND, SnakeTree, configuration
from dynsim.engine.saved_state import Stateful
from dynsim.errors import ModelError, ScenarioError, SimulationStopped
from dynsim.jit.kernel import integers, reals
from dynsim.model.description import Array
from dynsim.model.drives import Servo
from dynsim.scenario import Scenario, build
from dynsim.scenario.schema import Integrator, Payload
from dynsim.snake import ticks as ss
from dynsim.snake.description import (
    COORDINATES,
    FIXING,
    NO_REQUEST,
    SWITCHING,
    CommandBlock,
    CommandSource,
    Feedback,
    ModeTable,
    Policy,
    SnakeDescription,
    TaskSpaceController,
)
from dynsim.snake.fold import LiftTables, lift_angles
from dynsim.snake.kinematics import SnakeModel, pose_of_point, zero_arrays
from dynsim.snake.lifting import height_of
from dynsim.snake.ticks import (
    SnakeState,
    SnakeTrace,
    TickWorkspace,
    new_state,
    new_tick_workspace,
    new_trace,
    record_row,
    run_ticks,
)
from dynsim.system.memo import recall

# Lifting of a dynamic snake's wheel pairs as joint angles, and its start: a preliminary run that raises the head.


# Angles by which the head starts below its posture, for its pitch joints in order from the base [rad] (assumed).
LOWERED = (0.10, 0.30, 0.15)
# Times to settle, to raise the head, and to settle again [s] (assumed).
SETTLE, RAISE, SETTLE_AGAIN = 0.5, 1.0, 1.0


class WheelLifter(Stateful):
    """Heights of the wheel pairs over time, and the resulting angles of the pitch joints on their axles.

    Pairs are put down before other pairs are lifted.
    """

    SAVED = ("_grounded", "up", "down")

    def __init__(self, robot: SnakeTree, grounded: Array) -> None:
        d, part, self._lifts = robot.description, robot.base_part, robot.lifts
        self._grounded, pairs = grounded.copy(), len(grounded)
        # Times at which the pairs leave and reach the ground [s].
        self.up, self.down = np.where(grounded == 0, -np.inf, np.inf), np.full(pairs, np.inf)
        servos = {motor.joint: motor for motor in robot.motors}
        chosen = [servo for joint in robot.lifting_joints if isinstance(servo := servos[joint], Servo)]
        stiffness = np.array([servo.k_p * servo.torque_constant / servo.resistance for servo in chosen])
        # Each plate consists of the two links up to the next axle.
        masses = reals(d.link_mass[d.head_joints :]).reshape(pairs - 1, 2)
        self.lifting = zero_arrays(
            LiftTables,
            dict.fromkeys(("yaw", "hinge", "moments"), pairs - 1) | dict.fromkeys(("height", "lower", "tilt"), pairs),
            before=reals(part.before),
            behind=reals(part.behind),
            half_track=reals(part.half_track),
            radius=float(part.radius),
            clearance=1e-3 * robot.lifts.clearance_mm,
            blend=robot.lifts.blend_s,
            weight=float(-robot.gravity[2]) * (masses[:, 0] + masses[:, 1]),
            length=float(d.link_length),
            stiffness=stiffness if robot.sag_compensation else np.full(pairs - 1, np.inf),
        )

    def change(self, time: float, grounded: Array) -> None:
        """Set the grounded pairs, (pairs,) 1 or 0, from a time [s] on."""
        blend = self._lifts.blend_s
        put_down = (grounded == 1) & (self._grounded == 0)
        lifted = (grounded == 0) & (self._grounded == 1)
        self.down[put_down] = np.maximum(time, self.up[put_down] + blend) + blend
        begin = max([time, *self.down[put_down]])
        for pair in np.flatnonzero(lifted):
            landed = self.down[pair] if math.isfinite(self.down[pair]) else -math.inf
            self.up[pair], self.down[pair] = max(begin, landed), math.inf
        self._grounded = grounded.copy()

    def heights(self, time: float) -> Array:
        """Return the heights of the pairs at a time [s], (pairs,) [m]."""
        return height_of(time, self.up, self.down, self._lifts)

    def angles(self, time: float, yaw: Array) -> Array:
        """Return the angles added to the pitch joints on the axles at a time [s] and yaw angles, both (pairs − 1,)
        [rad], including the sag of the servos.

        Raises
        ------
        ArithmeticError
            If a height is out of reach.
        """
        if not lift_angles(self.lifting, self.up, self.down, float(time), reals(yaw)):
            raise ArithmeticError
        return self.lifting.hinge.copy()


def command_angles(robot: SnakeTree, phi: Array, added: Array) -> dict[str, float]:
    """Return the command of each joint servo: phi (n_phi,) plus the lifting angles (pairs − 1,) [rad]."""
    angles = dict(zip(robot.description.joint_names, phi.tolist(), strict=True))
    for joint, angle in zip(robot.lifting_joints, added.tolist(), strict=True):
        angles[joint] = angles.get(joint, 0.0) + angle
    return angles


# End time [s] of a phase, and its servo references: position and rate of each joint.
Phase = tuple[float, Mapping[str, tuple[float, float]]]
# Function that runs a scenario from given coordinates through servo phases and returns the final coordinates, see
# dynsim.engine.prepare.follow_lines.
Follow = Callable[[Scenario, Array, Sequence[Phase]], Array]


def snake_start(scenario: Scenario, robot: SnakeTree, follow: Follow) -> tuple[SnakeTree, JointControl]:
    """Return the robot at the start of a run, and its servo references until a controller changes them.

    ``follow`` simulates the raising of the head.

    Raises
    ------
    ModelError
        See :func:`dynsim.scenario.build.controller`; also if the control period is not a multiple of the step, or a
        mode lifts wheel pair 1.
    """
    d, config = robot.description, scenario.config
    controller = None if scenario.controller is None else build.snake_controller(scenario, d)
    grounded = np.ones(d.pairs)
    if controller is not None:
        grounded = controller.law.grounded[controller.fixing_row].astype(np.float64)
        _check_step(config.integrator, controller.schedule.period)
        _check_modes(controller.modes)
    lifter = WheelLifter(robot, grounded)
    height, phi = lifter.heights(0.0), np.asarray(d.initial_joints)
    added = lifter.angles(0.0, phi[d.head_joints :])
    if robot.raised:
        alone = _alone(scenario)
        parts = alone.config
        errors = parts.surface_error, parts.mass_error
        known = parts.plant, parts.contacts, parts.integrator, parts.surfaces, errors, parts.loads
        own = recall("raised", lambda: _raised(alone, height, added, follow), *known, grounded)
        # Objects start where the scenario places them.
        q = np.concatenate([own, robot.initial[len(own) :]])
    else:
        q = configuration(robot, phi, height)
    robot = replace(robot, q0=q)
    control = JointControl.absent(robot, command_angles(robot, phi, added))
    return robot, replace(control, task_space=controller)


def _check_step(integrator: Integrator, period: float) -> None:
    """Raise ModelError unless the control period [s] is a multiple of the time-stepping step."""
    step = integrator.step_s
    if integrator.method == "time_stepping" and step and abs(period / step - round(period / step)) > 1e-9:
        raise ModelError(
            f"integrator.step_s = {step:g} s does not divide controller.period_s = {period:g} s; "
            f"use {period / math.ceil(period / step):g}",
            keys=("integrator", "step_s"),
        )


def _check_modes(modes: ModeTable) -> None:
    """Raise ModelError if a mode lifts wheel pair 1: it carries the head, and no joint raises it."""
    lifting = [str(number) for number, row in zip(modes.numbers, modes.grounded, strict=True) if row[0] == 0]
    if lifting:
        raise ModelError(
            f"controller.modes: {'mode' if len(lifting) == 1 else 'modes'} {', '.join(lifting)} cannot lift wheel "
            "pair 1 under plant.level: dynamic: it carries the head, and no joint raises it; remove pair 1, or use "
            "plant.level: kinematic",
            keys=("controller", "modes"),
        )


def _alone(scenario: Scenario) -> Scenario:
    """Return the scenario of the preliminary run: the robot and its payloads on the ground.

    Objects, ties and other surfaces are placed for the raised head. A plate just in front of it would push against the
    lowered head and throw the robot back; a tied object would be dragged along.
    """
    config = scenario.config
    dynamics = scenario.plant.dynamics.model_copy(update={"start": "released"})
    points = {
        name: point
        for name, point in config.contacts.points.items()
        # Wheels of an object are called object.wheel.
        if point.surface == GROUND and point.body.partition(".")[0] not in config.objects
    }
    changes = {
        "plant": scenario.plant.model_copy(update={"dynamics": dynamics}),
        "controller": None,
        "initial": None,
        "loads": {name: load for name, load in config.loads.items() if isinstance(load, Payload)},
        "objects": {},
        "ties": {},
        "sensors": None,
        "surfaces": {name: surface for name, surface in config.surfaces.items() if name == GROUND},
        "contacts": config.contacts.model_copy(update={"points": points, "between": []}),
    }
    return replace(scenario, config=config.model_copy(update=changes))


def _raised(alone: Scenario, height: Array, added: Array, follow: Follow) -> Array:
    """Return the coordinates (nq,) of the robot alone after its head was raised into the initial posture."""
    robot = build.robot(alone)
    assert isinstance(robot, SnakeTree)
    d = robot.description
    lowered = np.zeros(len(d.joint_names))
    pitches = np.flatnonzero(d.pitch)[::-1][: len(LOWERED)]
    lowered[pitches] = LOWERED[: len(pitches)]
    below = np.clip(d.initial_joints - lowered, d.lower, d.upper)
    first, last = command_angles(robot, below, added), command_angles(robot, d.initial_joints, added)
    phases: list[Phase] = [
        (SETTLE, {joint: (angle, 0.0) for joint, angle in first.items()}),
        (SETTLE + RAISE, {joint: (angle, (last[joint] - angle) / RAISE) for joint, angle in first.items()}),
        (SETTLE + RAISE + SETTLE_AGAIN, {joint: (angle, 0.0) for joint, angle in last.items()}),
    ]
    return follow(alone, configuration(robot, below, height), phases)


# Mode changes of the snake: which wheel pairs are lifted next, and when ([T] IV.C.5, V.E).


class Refusal(NamedTuple):
    """A requested or candidate mode in which the robot would tip."""

    tick: int
    row: int
    margin: float  # support margin of the mode [m]
    taken: bool  # used anyway, because the present mode would tip more


@dataclass
class ModeSwitcher(Stateful):
    """State machine for modes: follows requests, or picks a mode at every switching time t_k = t_0 + k dT.

    Every mode change is tested by simulating the mode for one period with the present command. The robot tips if the
    support margin is not above ``least_margin`` at any time; such a mode is refused and the present mode stays. If the
    robot tips in the present mode as well, the mode with the largest support margin is used; the fixing mode is also a
    candidate.

    Attributes
    ----------
    policy : str
        "fixed" ignores requests to switch; "cyclic" uses the next mode of ``order`` ([T]'s heuristic); "predictive"
        uses the mode with the lowest cost after a simulated period.
    modes : ModeTable
        Table of the modes; ``fixing_row``, ``order`` and ``row`` are rows of it.
    period_ticks : int
        Switching period dT, in control periods.
    predict : callable
        predict(row) -> (cost after dT, smallest support margin until then [m]).
    row : int
        Present mode.
    switches : int
        Number of mode changes.
    refusals : list of Refusal
        Modes in which the robot would tip, in the order of their tests.
    """

    SAVED = ("row", "switching", "next_switch", "switches", "refusals", "_place")

    policy: Policy
    modes: ModeTable
    fixing_row: int
    order: tuple[int, ...]
    period_ticks: int
    least_margin: float
    predict: Callable[[int], tuple[float, float]]
    row: int = 0
    switching: bool = False
    next_switch: int = 0
    switches: int = 0
    refusals: list[Refusal] = field(default_factory=list)
    _place: int = 0

    def __post_init__(self) -> None:
        self.row = self.fixing_row

    def at_tick(self, tick: int, request: int) -> int:
        """Return the row of the mode from this tick on; ``request`` is a mode number, NO_REQUEST, SWITCHING or FIXING.

        A request for a single mode ends the switching state, whether the mode is used or refused.
        """
        row = self.row
        if request > 0 or request == FIXING:
            row = self.fixing_row if request == FIXING else self.modes.row(request, "mode request")
            row, self.switching = self._asked(tick, row), False
        elif request == SWITCHING and not self.switching and self.policy != "fixed":
            self.switching, self.next_switch, self._place = True, tick, 0
        if self.switching and tick >= self.next_switch:
            row = self._cyclic(tick) if self.policy == "cyclic" else self._predictive(tick)
            self.next_switch = tick + self.period_ticks
        self.switches += row != self.row
        self.row = row
        return row

    def next_event(self) -> int | None:
        """Return the tick of the next switching time, None in the fixing state."""
        return self.next_switch if self.switching else None

    def _asked(self, tick: int, row: int) -> int:
        if row == self.row or (margin := self.predict(row)[1]) > self.least_margin:
            return row
        return self._least_tipping(tick, {row: margin})

    def _cyclic(self, tick: int) -> int:
        tipping: dict[int, float] = {}
        for step in range(len(self.order)):
            position = (self._place + step) % len(self.order)
            row = self.order[position]
            margin = self.predict(row)[1]
            if margin > self.least_margin:
                self._refuse(tick, tipping)
                self._place = (position + 1) % len(self.order)
                return row
            tipping[row] = margin
        return self._least_tipping(tick, tipping)

    def _predictive(self, tick: int) -> int:
        predictions = {row: self.predict(row) for row in self.order}
        tipping = {row: margin for row, (_, margin) in predictions.items() if not margin > self.least_margin}
        standing = {row: cost for row, (cost, _) in predictions.items() if row not in tipping}
        if standing:
            self._refuse(tick, tipping)
            return min(standing, key=lambda row: standing[row])
        return self._least_tipping(tick, tipping)

    def _least_tipping(self, tick: int, tipping: dict[int, float]) -> int:
        """Return the present mode if it is stable, otherwise the mode with the largest margin; all candidates tip.

        The fixing mode is also a candidate: it need not be in the order.
        """
        rows = (self.row, self.fixing_row, *tipping)
        margins = {row: tipping[row] if row in tipping else self.predict(row)[1] for row in rows}
        best = max(margins, key=lambda row: margins[row])
        taken = self.row if margins[self.row] > self.least_margin else best
        self._refuse(tick, tipping, taken)
        return taken

    def _refuse(self, tick: int, tipping: dict[int, float], taken: int = -1) -> None:
        self.refusals += [Refusal(tick, row, margin, row == taken) for row, margin in tipping.items()]


# Reasons why the target waited, in the order of the counters of dynsim.snake.ticks.SnakeState. The last reason applies
# after an obstacle, until switching has brought the joints below switching.release_fraction of their limits.
OBSTACLES = ("joint limit", "rate limit", "singular posture", "attitude at beta = 90 deg", "release of the joints")


@dataclass
class SnakeControl:
    """Robot, controller, known commands, state and recorded samples.

    Attributes
    ----------
    ticks : int
        Number of control periods of the whole run.
    stride : int
        Number of control periods between recorded samples.
    block : CommandBlock
        Commands from tick ``block_start`` on.
    gripper : (ticks,) ndarray of int
        Gripper commands read so far.
    blocked : bool
        True if the last command was not executed.
    recovering : bool
        True while modes are switched until the base joints are released.
    switch_due : bool
        True if switching starts at the next tick.
    """

    description: SnakeDescription
    model: SnakeModel
    controller: TaskSpaceController
    source: CommandSource
    ticks: int
    stride: int
    block: CommandBlock = field(default_factory=lambda: CommandBlock(np.zeros((0, 6)), integers([]), integers([])))
    block_start: int = 0
    blocked: bool = False
    recovering: bool = False
    switch_due: bool = False
    # The block, and the ticks of its requests.
    _requests: tuple[CommandBlock | None, list[int]] = (None, [])

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
        """Number of completed control periods."""
        return int(self.state.counts[ss.TICKS])

    @property
    def time(self) -> float:
        """Time of the present tick [s]."""
        return self.tick * self.controller.schedule.period

    @property
    def mode(self) -> int:
        """Number of the present mode."""
        return self.controller.modes.numbers[self.state.counts[ss.MODE]]

    @property
    def hindrance(self) -> str:
        """Reason why the target waits; empty if it does not."""
        if self.recovering:
            return OBSTACLES[-1]
        return OBSTACLES[int(self.state.counts[ss.STILL_FOR]) - 1] if self.blocked else ""

    def postures(self) -> dict[str, list[float]]:
        """Return base, joint and wheel positions for a message."""
        return {"base_pose": self.state.base.tolist(), "phi": self.state.phi.tolist(), "rho": self.state.rho.tolist()}

    def posture(self) -> tuple[Array, Array, Array]:
        """Return the pose of the controlled point (6,), base pose (3,) and joints (n_phi,) as shown to an operator."""
        state, w = self.state, np.zeros(6)
        pose_of_point(self.model, state.base, state.phi, self.ws.work.frame, w)
        return w, state.base.copy(), state.phi.copy()

    def read_commands(self, waiting: bool) -> None:
        """Read a block of commands from the source, starting at the present tick.

        Velocities of the previous block that had to wait and were not executed are dropped: a script is a single block
        and loses none, and a joystick sends its current command again.

        Raises
        ------
        SimulationStopped
            If the source failed or returned an invalid command after the run had started, so that there are results to
            keep.
        ModelError
            If this happens before the first period.
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
            # Show a ModelError unchanged; wrap other exceptions with the source's class name.
            reason = str(error) if isinstance(error, ModelError) else f"{type(self.source).__name__} failed: {error!r}"
            text = f"command source at t = {feedback.time:g} s: {reason}"
            if first == 0:
                raise ModelError(text) from error
            raise SimulationStopped(text, time=feedback.time, state=self.postures()) from error
        self.block, self.block_start = block, first
        self.gripper[first : first + len(block.request)] = block.gripper
        state.counts[ss.CARRIED_OUT], state.progress[ss.DONE] = 0, 0.0

    def _checked(self, block: CommandBlock, left: int) -> CommandBlock:
        """Return the commands as arrays; raise ModelError for commands that the controller cannot execute."""
        block = CommandBlock(reals(block.velocity), integers(block.request), integers(block.gripper))
        known = len(block.request)
        if not 1 <= known <= left or block.velocity.shape != (known, 6) or block.gripper.shape != (known,):
            raise ModelError(
                f"shapes must be (T, 6), (T,), (T,) with T from 1 to {left}; got velocity {block.velocity.shape}, "
                f"request {block.request.shape}, gripper {block.gripper.shape}"
            )
        if not np.isfinite(block.velocity).all():
            row, column = np.argwhere(~np.isfinite(block.velocity))[0]
            raise ModelError(
                f"the velocity of {COORDINATES[column]} in period {row} of {known} must be finite, "
                f"got {block.velocity[row, column]}"
            )
        for number in set(block.request.tolist()) - {NO_REQUEST, SWITCHING, FIXING}:
            self.controller.modes.row(number, "controller.commands: mode")
        return block

    def begin_period(self) -> None:
        """Set commands and mode for the period that starts.

        Raises
        ------
        SimulationStopped
            If the source failed.
        """
        state, switcher, now = self.state, self.switcher, self.tick
        if self.switch_due:
            self.switch_due = False
            state.counts[ss.MODE] = switcher.at_tick(now, SWITCHING)
        if now == self.block_start + len(self.block.request):
            self.read_commands(waiting=self.blocked or self.recovering)
        request = int(self.block.request[now - self.block_start])
        # A recovery ends only at the end of a switching period, so that it contains at least one.
        if self.recovering and now >= (switcher.next_event() or 0):
            # Until every base joint is well within its limit again ([T] IV.C.5: until the robot becomes operable).
            base = slice(self.model.head_joints, None)
            limit = self.controller.release_fraction * self.model.upper[base]
            if np.all(np.abs(state.phi[base]) < limit):
                self.recovering, request = False, FIXING
        state.counts[ss.MODE] = switcher.at_tick(now, request)

    def periods(self) -> int:
        """Return the number of periods from the present one in which commands and mode cannot change, at least one."""
        now, block = self.tick, self.block
        if self._requests[0] is not block:
            self._requests = block, (self.block_start + np.flatnonzero(block.request != NO_REQUEST)).tolist()
        requests = self._requests[1]
        later = bisect.bisect_right(requests, now)
        ends = [self.block_start + len(block.request), *requests[later : later + 1]]
        if (event := self.switcher.next_event()) is not None:
            ends.append(event)
        return int(min(ends)) - now

    def end_period(self, blocked: bool) -> None:
        """Record whether the last period was blocked, and start switching if necessary."""
        self.blocked = blocked
        if blocked and not self.recovering and self.controller.when_blocked and not self.switcher.switching:
            self.recovering = self.switch_due = True

    def diverged(self) -> SimulationStopped:
        """Return the exception for a state that is no longer finite."""
        return SimulationStopped(
            f"the state is no longer finite at t = {self.time:g} s: the posture is singular, or the gain is too high "
            "for the control period",
            time=self.time,
            state=self.postures(),
        )

    def _predict(self, row: int) -> tuple[float, float]:
        """Return the cost after one switching period in a mode, at constant command, and the least support margin."""
        ticks, law, real = self.controller.prediction_ticks, self.controller.law, self.controller.schedule
        schedule = self.controller.prediction
        waits = (real.null_start_tick - self.tick) * real.period  # time until the null-space motion starts [s]
        schedule = schedule._replace(null_start_tick=round(waits / schedule.period))
        trial, trace = deepcopy(self.state), new_trace(self.model, ticks + 1)
        row_of_block = min(int(trial.counts[ss.CARRIED_OUT]), len(self.block.velocity) - 1)
        lasting = np.tile(self.block.velocity[row_of_block], (ticks, 1))
        trial.counts[[ss.MODE, ss.TICKS, ss.CARRIED_OUT]], trial.progress[ss.DONE] = (row, 0, 0), 0.0
        done, _ = run_ticks(self.model, law, schedule, trial, lasting, ticks, 1, 1, 1, self.ws, trace)
        if done < 0:
            return np.inf, -np.inf  # not finite: this mode cannot be used
        if done < ticks:  # blocked: the target waits for the rest of the period
            run_ticks(self.model, law, schedule, trial, lasting, ticks - done, 0, 0, 1, self.ws, trace)
        record_row(self.model, law, trial, self.ws, ticks, trace)
        return float(trace.cost[-1]), float(trace.margin.min())


def control_periods(scenario: Scenario, period: float) -> tuple[int, int]:
    """Return the number of control periods of a run, and the number between two samples of its record.

    Raises
    ------
    ScenarioError
        If the run is shorter than a period, or the recording rate does not divide the control rate.
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
            f"(controller.period_s); use {1 / (period * stride):g}"
        )
    return ticks, stride
