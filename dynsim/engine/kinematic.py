"""Engine of the kinematic snake: ticks between switching times are compiled, mode switching is not."""

from __future__ import annotations

import logging
import time as clock
from collections.abc import Callable

import numpy as np

from dynsim.compile.scene import snake_scene
from dynsim.engine import Progress, Start
from dynsim.engine.compilation import kernels_logged
from dynsim.engine.kinematic_record import COORDINATES, make_record
from dynsim.engine.kinematic_run import Run
from dynsim.engine.mode_switching import ModeSwitcher
from dynsim.engine.outcome import check_size, interrupted, raise_stopped
from dynsim.engine.provenance import provenance
from dynsim.errors import ModelError, ScenarioError, SimulationStopped
from dynsim.jit.kernel import integers, reals
from dynsim.library.families import member
from dynsim.record import Record
from dynsim.record.poses import pose_columns
from dynsim.scenario import Scenario, build
from dynsim.scenario.effect import without_effect
from dynsim.snake import state as ss
from dynsim.snake.description import (
    FIXING,
    NO_REQUEST,
    SWITCHING,
    CommandBlock,
    CommandSource,
    Feedback,
    SnakeDescription,
)
from dynsim.snake.kinematics import pose_of_point
from dynsim.snake.state import State, new_rig, new_state, new_trace
from dynsim.snake.ticks import record_row, run_ticks
from dynsim.system import interruption

log = logging.getLogger(__name__)

CHUNK = 500  # ticks between two looks at signals and the progress bar: about 25 ms, at worst ten times as long


def prepare(scenario: Scenario, source: CommandSource | None = None) -> Run:
    """Build robot and controller and the initial state, and read the first commands.

    ``source`` replaces the commands and paths of the scenario.

    Raises
    ------
    ModelError
        The robot cannot be controlled as configured, the scenario has what this engine does not know, or a command
        asks for a mode that does not exist.
    ScenarioError
        The recording rate does not divide the control rate, or the record would be too large.
    """
    if scenario.controller is None or member("controller", scenario.controller.type).ENGINE != "kinematic":
        raise ModelError(f"plant {scenario.plant.type!r} (kinematic) needs controller.type: task_space")
    if scenario.config.contacts.points:
        raise ModelError(f"plant {scenario.plant.type!r} (kinematic) takes no contacts.points: it stands on its wheels")
    if scenario.config.loads:
        raise ModelError(f"plant {scenario.plant.type!r} (kinematic) takes no loads: it has no forces", keys=("loads",))
    description = build.machine(scenario)
    assert isinstance(description, SnakeDescription)
    controller = build.controller(scenario, description)
    model, period = description.arrays(), controller.schedule.period
    ticks = round(scenario.duration_s / period)
    if ticks < 1:
        raise ScenarioError(f"duration_s = {scenario.duration_s:g} is shorter than controller.period_s = {period:g}")
    stride = _stride(scenario.record.rate_hz, period)
    rows = -(-ticks // stride) + 1
    bodies = len(snake_scene(description).bodies)
    check_size(scenario, rows, sum(array[0].size for array in new_trace(model, 1)) + pose_columns(bodies))

    state, rig = new_state(model), new_rig(model)
    state.base[:], state.phi[:] = description.initial_base_pose, description.initial_joints
    pose_of_point(model, state.base, state.phi, rig.work.frame, state.w_target)
    state.phi_hat[:], state.w_hat[:] = state.phi, state.w_target
    state.counts[ss.MODE] = controller.fixing_row
    run = Run(
        description=description,
        model=model,
        controller=controller,
        source=controller.source if source is None else source,
        ticks=ticks,
        block=CommandBlock(np.zeros((0, 6)), integers([]), integers([])),
        block_start=0,
        gripper=np.zeros(ticks, dtype=np.int64),
        state=state,
        rig=rig,
        trace=new_trace(model, rows),
        stride=stride,
    )
    read_commands(run, waiting=False)
    return run


def check(scenario: Scenario, started: Callable[[Start], None]) -> Start:
    """See :func:`dynsim.engine.check`: the controlled point at t = 0; a snake has no contact points."""
    start = Start(prepare(scenario).state.w_target[:3].copy(), {}, warnings=without_effect(scenario))
    started(start)
    return start


def simulate(
    scenario: Scenario,
    progress: Progress | None = None,
    source: CommandSource | None = None,
    *,
    pictured: bool = True,
) -> Record:
    """See :func:`dynsim.engine.simulate`; also raises what :func:`prepare` raises.

    A live ``source`` (joystick) replaces the commands and paths of the scenario. It is asked in every control period,
    with what the robot has done; to run in real time it waits in ``read`` until the period has come.
    """
    run = prepare(scenario, source)
    controller, switcher = run.controller, mode_switcher(run)
    with kernels_logged(log, "kinematic snakes"):
        load_kernels(run)
    stop: SimulationStopped | None = None
    started = clock.perf_counter()
    try:
        log.info("%s: integrating %g s in %d control periods", scenario.title, scenario.duration_s, run.ticks)
        _advance(run, switcher, progress, scenario.integrator.wall_limit_s)
        interruption.keep()
    except SimulationStopped as stopped:
        interruption.keep()
        stop = stopped
    except KeyboardInterrupt:
        interruption.keep()
        interruption.answered()
        reached = float(run.state.counts[ss.TICKS] * controller.schedule.period)
        stop = interrupted(scenario, reached, _named(run.state))
    wall = clock.perf_counter() - started
    log.info("%s: integrated %d control periods in %.3f s", scenario.title, run.state.counts[ss.TICKS], wall)
    record = make_record(run, scenario, provenance(scenario), switcher, wall, pictured)
    if stop is not None:
        raise_stopped(stop, record)
    return record


def mode_switcher(run: Run) -> ModeSwitcher:
    """Who chooses the modes of a run."""
    controller = run.controller
    return ModeSwitcher(
        policy=controller.policy,
        modes=controller.modes,
        fixing_row=controller.fixing_row,
        order=controller.order,
        period_ticks=controller.switch_ticks,
        least_margin=controller.least_margin,
        predict=lambda row: _predict(run, row),
    )


def _named(state: State) -> dict[str, list[float]]:
    return {"base_pose": state.base.tolist(), "phi": state.phi.tolist(), "rho": state.rho.tolist()}


def load_kernels(run: Run) -> None:
    """Compile or load the kernels: that is no simulation time."""
    trial, trace = _copy(run.state), new_trace(run.model, 1)
    run_ticks(
        run.model, run.controller.law, run.controller.schedule, trial, run.block.velocity, 0, 1, 1, 1, run.rig, trace
    )
    record_row(run.model, run.controller.law, trial, run.rig, 0, trace)


def _stride(rate_hz: float, period: float) -> int:
    exact = 1.0 / (rate_hz * period)
    stride = max(1, round(exact))
    if abs(stride - exact) > 1e-6 * exact:
        raise ScenarioError(
            f"record.rate_hz = {rate_hz:g} does not divide the control rate of {1 / period:g} Hz "
            f"(controller.period_s); {1 / (period * stride):g} does"
        )
    return stride


def read_commands(run: Run, waiting: bool) -> None:
    """Ask the source for the commands from the present tick on; it answers as far as it knows them.

    Velocities that had to wait in the block before this one and were not carried out there are dropped: a script is
    one block and loses none, a joystick says anew what it wants.

    Raises
    ------
    SimulationStopped
        The source failed, or gave what is no command, after the run had begun: there is something to keep.
    ModelError
        The same before the first period.
    """
    state, period, first = run.state, run.controller.schedule.period, int(run.state.counts[ss.TICKS])
    w = np.zeros(6)
    pose_of_point(run.model, state.base, state.phi, run.rig.work.frame, w)
    feedback = Feedback(
        time=first * period,
        w=w,
        w_target=state.w_target.copy(),
        base_pose=state.base.copy(),
        phi=state.phi.copy(),
        mode=run.controller.modes.numbers[state.counts[ss.MODE]],
        waiting=waiting,
    )
    try:
        block = _checked(run, run.source.read(first, run.ticks - first, period, feedback), run.ticks - first)
    except (SimulationStopped, ScenarioError):
        raise
    except Exception as error:
        # What is no fault of the source's code is said as it is.
        what = str(error) if isinstance(error, ModelError) else f"{type(run.source).__name__} failed: {error!r}"
        text = f"command source at t = {feedback.time:g} s: {what}"
        if first == 0:
            raise ModelError(text) from error
        raise SimulationStopped(text, time=feedback.time, state=_named(state)) from error
    run.block, run.block_start = block, first
    run.gripper[first : first + len(block.request)] = block.gripper
    state.counts[ss.PLACE], state.progress[ss.DONE] = 0, 0.0


def _checked(run: Run, block: CommandBlock, left: int) -> CommandBlock:
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
        run.controller.modes.row(number, "controller.commands: mode")
    return block


def _advance(run: Run, switcher: ModeSwitcher, progress: Progress | None, wall_limit: float | None) -> None:
    """Run to the end in pieces that no mode request, no switching time and no end of known commands divides.

    Raises
    ------
    SimulationStopped
        See :func:`advance_piece`; also when the wall limit [s] is over.
    """
    begun = clock.perf_counter()
    while run.state.counts[ss.TICKS] < run.ticks:
        if wall_limit is not None and clock.perf_counter() - begun > wall_limit:
            time = float(run.state.counts[ss.TICKS] * run.controller.schedule.period)
            raise SimulationStopped(
                f"stopped at t = {time:g} s: the wall limit, integrator.wall_limit_s = {wall_limit:g} s, is over, "
                f"in mode {run.controller.modes.numbers[run.state.counts[ss.MODE]]}",
                time=time,
                state=_named(run.state),
            )
        advance_piece(run, switcher)
        if progress is not None:
            progress(float(run.state.counts[ss.TICKS] * run.controller.schedule.period))
        interruption.check()


def advance_piece(run: Run, switcher: ModeSwitcher) -> None:
    """Run the control periods up to the next one in which something may change: one, of a source that knows one.

    Raises
    ------
    SimulationStopped
        The state is no longer finite, or the source failed.
    """
    state, controller, period = run.state, run.controller, run.controller.schedule.period
    now = int(state.counts[ss.TICKS])
    if run.switch_due:
        run.switch_due = False
        state.counts[ss.MODE] = switcher.at_tick(now, SWITCHING)
    if now == run.block_start + len(run.block.request):
        read_commands(run, waiting=run.blocked or run.recovering)
    ahead = run.block.request[now - run.block_start :]
    request = int(ahead[0])
    # At the ends of switching periods only, so that every recovery has at least one.
    if run.recovering and now >= (switcher.next_event() or 0) and _is_released(run):
        run.recovering, request = False, FIXING
    state.counts[ss.MODE] = switcher.at_tick(now, request)
    later = 1 + np.flatnonzero(ahead[1:] != NO_REQUEST)
    ends = [now + len(ahead), now + CHUNK, *(now + later[:1])]
    if (event := switcher.next_event()) is not None:
        ends.append(event)
    count = int(min(ends)) - now
    done, run.blocked = run_ticks(
        run.model,
        controller.law,
        controller.schedule,
        state,
        run.block.velocity,
        count,
        int(not run.recovering),
        int(controller.when_blocked),
        run.stride,
        run.rig,
        run.trace,
    )
    if done < 0:
        time = float(state.counts[ss.TICKS] * period)
        raise SimulationStopped(
            f"the state is no longer finite at t = {time:g} s: a singular posture, or a gain too high "
            "for the control period",
            time=time,
            state={"base_pose": state.base.tolist(), "phi": state.phi.tolist()},
        )
    if run.blocked and not run.recovering and controller.when_blocked and not switcher.switching:
        run.recovering = run.switch_due = True


def _is_released(run: Run) -> bool:
    """True when every base joint is well within its limit again ([T] IV.C.5: until the robot becomes operable)."""
    base = slice(run.model.head_joints, None)
    return bool(np.all(np.abs(run.state.phi[base]) < run.controller.release_fraction * run.model.upper[base]))


def _predict(run: Run, row: int) -> tuple[float, float]:
    """Cost after one switching period in a mode with the present command held, and the smallest support margin."""
    ticks, law, real = run.controller.prediction_ticks, run.controller.law, run.controller.schedule
    schedule = run.controller.prediction
    waits = (real.null_start_tick - int(run.state.counts[ss.TICKS])) * real.period  # until the null space comes on [s]
    schedule = schedule._replace(null_start_tick=round(waits / schedule.period))
    trial, trace = _copy(run.state), new_trace(run.model, ticks + 1)
    place = min(int(trial.counts[ss.PLACE]), len(run.block.velocity) - 1)
    held = np.tile(run.block.velocity[place], (ticks, 1))
    trial.counts[ss.MODE], trial.counts[ss.TICKS], trial.counts[ss.PLACE], trial.progress[ss.DONE] = row, 0, 0, 0.0
    done, _ = run_ticks(run.model, law, schedule, trial, held, ticks, 1, 1, 1, run.rig, trace)
    if done < 0:
        return np.inf, -np.inf  # no longer finite: no mode to take
    if done < ticks:  # blocked: the target waits for the rest of the period
        run_ticks(run.model, law, schedule, trial, held, ticks - done, 0, 0, 1, run.rig, trace)
    record_row(run.model, law, trial, run.rig, ticks, trace)
    return float(trace.cost[-1]), float(trace.margin.min())


def _copy(state: State) -> State:
    return State(*(array.copy() for array in state))
