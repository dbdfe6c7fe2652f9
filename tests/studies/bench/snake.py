"""Benchmark of the dynamic snake against MuJoCo: time, and agreement with Table III of [T].

MuJoCo gets the exported tree of bodies, the voltage laws of the servos, and the piecewise linear references that the
controller produced in dynsim's run. The commands are therefore the same; MuJoCo computes forces, friction and contacts.
dynsim runs with its controller, and also with the recorded commands alone, so that both programs do the same work.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynsim.dynamics import tables as ka
from dynsim.engine.prepare import EVERY_STEP
from dynsim.engine.simulation import Prepared, Simulation, prepare
from dynsim.engine.snake_pilot import roll_pitch_yaw
from dynsim.engine.stopping import copied
from dynsim.integrators import driver
from dynsim.integrators import run as ki
from dynsim.model.description import Robot
from dynsim.record import Record
from dynsim.scenario import Scenario, load_scenario
from dynsim.snake.description import COORDINATES
from dynsim.snake.published import TABLE_III, displacement
from studies.bench.mujoco_peer import STIFFEST, roll_out, state_of

Array = NDArray[np.float64]

SCENARIO = "snake_positioning_dynamic"
DYNSIM = "dynsim 2.5 ms, with its controller"
COMMANDED = "dynsim 2.5 ms, commands given"
# Step [s], and whether dry friction has the maximum stiffness that MuJoCo accepts; at 2.5 ms it is unstable.
MUJOCO = {
    "MuJoCo 2.5 ms": (2.5e-3, False),
    "MuJoCo 2 ms, stiff friction": (2e-3, True),
    "MuJoCo 1 ms, stiff friction": (1e-3, True),
}
SNAKES = (DYNSIM, COMMANDED, *MUJOCO)
Z, BETA = 2, 4
# MuJoCo's default softness of limits and friction: solref and solimp.
SOFT = [0.02, 1.0], [0.9, 0.95, 0.001, 0.5, 2.0]


class Manoeuvre(NamedTuple):
    """CPU seconds of a run, its steps, and the displacement of the head, (6,) [m, rad]."""

    seconds: float
    steps: int
    displacement: Array


class Commands(NamedTuple):
    """System that dynsim ran, its initial coordinates, and lines of all motors from each tick on, (T, na, 2)."""

    prepared: Prepared
    q: Array
    period: float
    lines: Array


def build_snake(prepared: Prepared, step: float, stiff: bool = False) -> Any:
    """Return a compiled scenario of the dynamic snake as a ``mujoco.MjModel``, with servos and a floor.

    The export contains the servos, with the same voltage law, fully implicit. MuJoCo's ``frictionloss`` is the friction
    of gears: it is soft, and less so with ``stiff``. Wheels touch the floor as stiffly as the step allows.
    """
    import mujoco

    robot = prepared.model.robot
    spec = mujoco.MjSpec.from_string(prepared.model.to_mjcf())
    spec.option.timestep, spec.option.integrator = step, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    for joint in spec.joints:
        joint.solref_limit, joint.solimp_limit = SOFT
        joint.solref_friction, joint.solimp_friction = ([2.0 * step, 1.0], STIFFEST) if stiff else SOFT
    touch = {"contype": 0, "conaffinity": 0}
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[10, 10, 1], **touch)
    for k, foot in enumerate(robot.feet):
        mu = prepared.system.contacts.law[k, ka.MU]
        name, sphere = f"foot_{foot.name}", mujoco.mjtGeom.mjGEOM_SPHERE
        spec.body(foot.body).add_geom(
            name=name, type=sphere, size=[foot.radius, 0, 0], pos=foot.point, mass=0.0, **touch
        )
        pair = spec.add_pair(geomname1="floor", geomname2=name, condim=3, solref=[2.0 * step, 1.0])
        pair.friction = [mu, mu, 0.0, 0.0, 0.0]
    return spec.compile()


def positions(model: Any, robot: Robot, q: Array) -> Array:
    """MuJoCo's coordinates of dynsim's (nq,): joints in the order of its tree."""
    own = np.zeros(model.nq)
    own[:7] = q[:7]
    for joint, at in zip(robot.joint_names[6:], robot.position_index[6:], strict=True):
        own[model.joint(joint).qposadr[0]] = q[at]
    return own


def measure(rounds: int, *, with_mujoco: bool) -> list[dict[str, Any]]:
    """Measure time and distance from the paper by program, over the six manoeuvres of Table III.

    Returns
    -------
    list of dict
        ``program``, ``us_per_step`` and ``times_real_time`` (minimum CPU time of the rounds), ``z_rms_m`` and
        ``beta_rms_rad`` (rms deviation of Δz and Δβ of the head from the paper's means), ``displacements`` (6, 6)
    """
    outcomes: dict[str, list[Manoeuvre]] = {}
    duration = 0.0
    for name in TABLE_III:
        scenario = load_scenario(SCENARIO, name)
        commands, own = run_dynsim(scenario)
        duration += scenario.duration_s
        programs = {DYNSIM: lambda scenario=scenario, own=own: own._replace(seconds=time_dynsim(scenario))}
        programs[COMMANDED] = partial(run_commands, commanded(scenario, commands))
        for program, (step, stiff) in MUJOCO.items() if with_mujoco else ():
            model = build_snake(commands.prepared, step, stiff)
            programs[program] = partial(run_mujoco, model, commands, scenario.duration_s)
        # The programs take turns, so that other processes slow all of them down.
        turns = [{program: run() for program, run in programs.items()} for _ in range(rounds)]
        for program in programs:
            outcomes.setdefault(program, []).append(min((turn[program] for turn in turns), key=lambda run: run.seconds))
    published = np.array([moved.mean for moved in TABLE_III.values()])
    rows = []
    for program, runs in outcomes.items():
        seconds, moves = sum(run.seconds for run in runs), np.array([run.displacement for run in runs])
        off = np.sqrt(np.mean((moves - published) ** 2, axis=0))
        rows.append(
            {
                "program": program,
                "us_per_step": 1e6 * seconds / sum(run.steps for run in runs),
                "times_real_time": duration / seconds,
                "z_rms_m": float(off[Z]),
                "beta_rms_rad": float(off[BETA]),
                "displacements": moves.tolist(),
            }
        )
    return rows


def run_dynsim(scenario: Scenario) -> tuple[Commands, Manoeuvre]:
    """Run a scenario in dynsim; return its commands, and its result without a time."""
    simulation = Simulation(scenario, duration=math.inf)
    assert simulation.operator is not None
    q, lines, period = simulation.state.q, [], simulation.operator.period
    for k in range(round(scenario.duration_s / period)):
        # After the tick; steps are not cut at this time.
        simulation.advance((k + 0.5) * period)
        lines.append(simulation._prepared.system.drives.input[:, ka.LINE_START : ka.LINE_RATE + 1].copy())
    simulation.advance(scenario.duration_s)
    steps = int(simulation._prepared.run.count[ki.STEPS])
    own = Manoeuvre(math.inf, steps, displacement(simulation.record(scenario, pictured=False)))
    return Commands(simulation._prepared, q, period, np.array(lines)), own


def time_dynsim(scenario: Scenario) -> float:
    """Return the CPU seconds of a run in dynsim with its controller."""
    simulation = Simulation(scenario, duration=math.inf)
    started = time.thread_time()
    simulation.advance(scenario.duration_s)
    return time.thread_time() - started


def commanded(scenario: Scenario, commands: Commands) -> Prepared:
    """Return the scenario prepared with the commands as planned references, without its controller."""
    prepared = prepare(scenario)
    ticks, motors, _ = commands.lines.shape
    coefficients = np.zeros((ticks, motors, 6))
    coefficients[:, :, :2] = commands.lines
    reference = prepared.system.reference._replace(
        spline=np.arange(motors), grid=np.array([0.0, commands.period]), coefficients=coefficients
    )
    return replace(prepared, system=prepared.system._replace(reference=reference))


def run_commands(prepared: Prepared) -> Manoeuvre:
    """Run the same commands in dynsim, in one compiled call."""
    prepared, model, (body, point) = copied(prepared), prepared.model, prepared.model.robot.hand
    run = prepared.run
    # Load the kernel.
    driver.advance(prepared.system, prepared.workspace, run, -1)
    started = time.thread_time()
    driver.advance(prepared.system, prepared.workspace, run, EVERY_STEP)
    seconds = time.thread_time() - started
    poses = [model.body_pose(body, q) for q in run.states("q")]
    return _manoeuvre(seconds, int(run.count[ki.STEPS]), run.sample_time, [(p + R @ point, R) for R, p in poses])


def run_mujoco(model: Any, commands: Commands, duration: float) -> Manoeuvre:
    """Run the same commands in MuJoCo, from the same posture at rest."""
    import mujoco

    step = model.opt.timestep
    # In the middle of each step, as in dynsim.
    at = (np.arange(round(duration / step)) + 0.5) * step
    k = (at / commands.period).astype(int)
    controls = commands.lines[k, :, 0] + commands.lines[k, :, 1] * (at - k * commands.period)[:, None]
    rates = commands.prepared.system.drives.table[:, ka.SERVO_MODE] == ka.VELOCITY_MODE
    controls[:, rates] = commands.lines[k][:, rates, 1]
    data, start = mujoco.MjData(model), state_of(model, positions(model, commands.prepared.model.robot, commands.q))
    started = time.thread_time()
    path, _, _ = roll_out(model, data, start, controls)
    seconds, poses = time.thread_time() - started, []
    for q in path:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        hand = data.site("hand")
        poses.append((hand.xpos.copy(), hand.xmat.reshape(3, 3).copy()))
    return _manoeuvre(seconds, len(path), (np.arange(len(path)) + 1) * step, poses)


def _manoeuvre(seconds: float, steps: int, times: Array, poses: list[tuple[Array, Array]]) -> Manoeuvre:
    """Return the result of a run with positions and rotations of the controlled point."""
    record = Record(times)
    w = np.array([np.concatenate([p, roll_pitch_yaw(R)]) for p, R in poses])
    record.add("w", w, "m, rad", labels=COORDINATES)
    return Manoeuvre(seconds, steps, displacement(record))
