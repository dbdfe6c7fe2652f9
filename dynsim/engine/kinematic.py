"""Engine of the kinematic snake: preparation, check and simulation of a scenario."""

from __future__ import annotations

import logging
import time as clock
from collections.abc import Callable

from dynsim.compile.scene import snake_scene
from dynsim.engine import Progress, Start
from dynsim.engine.compilation import kernels_logged
from dynsim.engine.kinematic_objects import CarriedObjects
from dynsim.engine.kinematic_record import make_record
from dynsim.engine.kinematic_run import SnakeRun
from dynsim.engine.outcome import check_size, interrupted, raise_stopped
from dynsim.engine.snake_control import control_periods
from dynsim.errors import ModelError, SimulationStopped
from dynsim.library.families import member
from dynsim.record import Record
from dynsim.record.poses import pose_columns
from dynsim.scenario import Scenario, build
from dynsim.scenario.effect import without_effect
from dynsim.snake.description import CommandSource, SnakeDescription
from dynsim.snake.state import new_trace
from dynsim.system import interruption

log = logging.getLogger(__name__)


def prepare(scenario: Scenario, source: CommandSource | None = None) -> SnakeRun:
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
    ticks, stride = control_periods(scenario, period)
    rows, bodies = -(-ticks // stride) + 1, len(snake_scene(description).bodies)
    check_size(scenario, rows, sum(array[0].size for array in new_trace(model, 1)) + pose_columns(bodies))
    run = SnakeRun(description, model, controller, controller.source if source is None else source, ticks, stride)
    if scenario.config.objects:
        plant = scenario.plant
        ahead = plant.gripper_length_m - description.point_offset
        run.objects = CarriedObjects(scenario, plant.gripper.gripper(plant.gripper_length_m), ahead, period)
    run.read_commands(waiting=False)
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
    with kernels_logged(log, "kinematic snakes"):
        run.load_kernels()
    stop: SimulationStopped | None = None
    started = clock.perf_counter()
    try:
        log.info("%s: integrating %g s in %d control periods", scenario.title, scenario.duration_s, run.ticks)
        while run.tick < run.ticks:
            _check_wall(run, clock.perf_counter() - started, scenario.integrator.wall_limit_s)
            run.advance()
            if progress is not None:
                progress(run.time)
            interruption.check()
        interruption.keep()
    except SimulationStopped as stopped:
        interruption.keep()
        stop = stopped
    except KeyboardInterrupt:
        interruption.keep()
        interruption.answered()
        stop = interrupted(scenario, run.time, run.postures())
    wall = clock.perf_counter() - started
    log.info("%s: integrated %d control periods in %.3f s", scenario.title, run.tick, wall)
    record = make_record(run, scenario, wall, pictured)
    if stop is not None:
        raise_stopped(stop, record)
    return record


def _check_wall(run: SnakeRun, spent: float, limit: float | None) -> None:
    """SimulationStopped when the wall limit [s] is over."""
    if limit is not None and spent > limit:
        raise SimulationStopped(
            f"stopped at t = {run.time:g} s: the wall limit, integrator.wall_limit_s = {limit:g} s, is over, "
            f"in mode {run.mode}",
            time=run.time,
            state=run.postures(),
        )
