"""Simulation of the kinematic snake: the tick loop between switching times is compiled, mode switching is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dynsim.control import task_space
from dynsim.control.commands import CommandBlock
from dynsim.control.modes import FIXING, NO_REQUEST, SWITCHING, ModeSwitcher
from dynsim.errors import ScenarioError, SimulationInterrupted, SimulationStopped
from dynsim.kernels.jit import reals
from dynsim.kernels.snake import SnakeModel, new_chain, pose_of_point, posture_points
from dynsim.kernels.snake_plant import Rig, State, Trace, new_rig, new_state, new_trace, record_row, run_ticks
from dynsim.plants import snake
from dynsim.record import Record

CHUNK = 2000  # ticks between two looks at Ctrl-C and the progress bar; about 0.1 s
COORDINATES = ("x", "y", "z", "alpha", "beta", "gamma")


class KinematicScenario(Protocol):
    """What is read of a scenario."""

    name: str
    variant: str | None
    duration_s: float
    plant: snake.Config
    controller: task_space.Config
    record: Any  # has rate_hz
    resolved: dict[str, Any]


@dataclass
class _Run:
    """One simulation on its way."""

    model: SnakeModel
    controller: task_space.TaskSpaceController
    state: State
    rig: Rig
    trace: Trace
    stride: int


def simulate_kinematic(scenario: KinematicScenario, progress: Callable[[float], None] | None = None) -> Record:
    """Run a scenario of plant ``snake``, level ``kinematic``, with the controller ``task_space``.

    Parameters
    ----------
    scenario
        See :class:`KinematicScenario`.
    progress
        Called with the fraction done in [0, 1].

    Raises
    ------
    ModelError
        The robot cannot be controlled as configured.
    ScenarioError
        The recording rate does not divide the control rate.
    SimulationStopped
        The state is no longer finite.
    SimulationInterrupted
        Ctrl-C; ``record`` of the exception holds what was simulated.
    """
    description = snake.build(scenario.plant)
    controller = task_space.build(scenario.controller, description)
    model, period = description.arrays(), controller.schedule.period
    ticks = round(scenario.duration_s / period)
    stride = _stride(scenario.record.rate_hz, period)

    state, rig = new_state(model), new_rig(model)
    state.base[:], state.phi[:] = description.initial_base_pose, description.initial_joints
    pose_of_point(model, state.base, state.phi, rig.work.frame, state.w_target)
    state.phi_hat[:], state.w_hat[:] = state.phi, state.w_target
    run = _Run(model, controller, state, rig, new_trace(model, ticks // stride + 1), stride)
    switcher = ModeSwitcher(
        policy=controller.policy,
        fixing_row=controller.fixing_row,
        order=controller.order,
        period_ticks=controller.switch_ticks,
        least_margin=controller.least_margin,
        margin_now=lambda row: _margin_now(run, row),
        predict=lambda row: _predict(run, row, block.velocity[min(int(state.counts[3]), ticks - 1)]),
    )
    block = controller.source.read(0, ticks, period)
    try:
        _advance(run, switcher, block, progress)
    except KeyboardInterrupt:
        stopped = SimulationInterrupted(
            f"interrupted at t = {state.counts[1] * period:g} s", time=float(state.counts[1] * period)
        )
        stopped.record = _record(scenario, description, run, switcher, block)
        stopped.record.complete = False
        raise stopped from None
    except SimulationStopped as stopped:
        stopped.record = _record(scenario, description, run, switcher, block)
        stopped.record.complete = False
        raise
    return _record(scenario, description, run, switcher, block)


def _stride(rate_hz: float, period: float) -> int:
    exact = 1.0 / (rate_hz * period)
    stride = max(1, round(exact))
    if abs(stride - exact) > 1e-6 * exact:
        raise ScenarioError(
            f"record.rate_hz = {rate_hz:g} does not divide the control rate of {1 / period:g} Hz "
            f"(controller.period_s); {1 / (period * stride):g} does"
        )
    return stride


def _advance(run: _Run, switcher: ModeSwitcher, block: CommandBlock, progress: Callable[[float], None] | None) -> None:
    """Run to the end in pieces that no mode request and no switching time divides."""
    state, controller, period = run.state, run.controller, run.controller.schedule.period
    ticks = len(block.request)
    requests = np.flatnonzero(block.request != NO_REQUEST)
    recovering = False
    while (now := int(state.counts[1])) < ticks:
        request = int(block.request[now])
        # At the ends of switching periods only, so that every recovery has at least one.
        if recovering and now >= (switcher.next_event() or 0) and _is_released(run):
            recovering, request = False, FIXING
        state.counts[0] = switcher.at_tick(now, request)
        later = requests[requests > now]
        ends = [ticks, now + CHUNK, *later[:1]]
        if (event := switcher.next_event()) is not None:
            ends.append(event)
        count = int(min(ends)) - now
        done, blocked = run_ticks(
            run.model,
            controller.law,
            controller.schedule,
            state,
            block.velocity,
            count,
            int(not recovering),
            int(controller.when_blocked),
            run.stride,
            run.rig,
            run.trace,
        )
        if done < 0:
            time = float(state.counts[1] * period)
            raise SimulationStopped(
                f"the state is no longer finite at t = {time:g} s: the posture is singular or a gain is too high for "
                f"the control period",
                time=time,
                state={"base_pose": state.base.tolist(), "phi": state.phi.tolist()},
            )
        if blocked and not recovering and controller.when_blocked and not switcher.switching:
            recovering = True
            if state.counts[1] < ticks:
                state.counts[0] = switcher.at_tick(int(state.counts[1]), SWITCHING)
        if progress is not None:
            progress(int(state.counts[1]) / ticks)


def _is_released(run: _Run) -> bool:
    """True when every base joint is well within its limit again ([T] IV.C.5: until the robot becomes operable)."""
    base = slice(run.model.head_joints, None)
    return bool(np.all(np.abs(run.state.phi[base]) < run.controller.release_fraction * run.model.upper[base]))


def _margin_now(run: _Run, row: int) -> float:
    trial, trace = _copy(run.state), new_trace(run.model, 1)
    trial.counts[0] = row
    record_row(run.model, run.controller.law, trial, run.rig, 0, trace)
    return float(trace.margin[0])


def _predict(run: _Run, row: int, velocity: NDArray[np.float64]) -> tuple[float, float]:
    """Cost after one switching period in a mode with the present command held, and the smallest support margin."""
    ticks, law = run.controller.prediction_ticks, run.controller.law
    trial, trace = _copy(run.state), new_trace(run.model, ticks + 1)
    trial.counts[0], trial.counts[1] = row, 0
    trial.counts[3] = 0
    held = np.tile(velocity, (ticks, 1))
    schedule = run.controller.prediction
    done, _ = run_ticks(run.model, law, schedule, trial, held, ticks, 1, 1, 1, run.rig, trace)
    if 0 <= done < ticks:  # blocked: the target waits for the rest of the period
        run_ticks(run.model, law, schedule, trial, held, ticks - done, 0, 0, 1, run.rig, trace)
    record_row(run.model, law, trial, run.rig, ticks, trace)
    return float(trace.cost[-1]), float(trace.margin.min())


def _copy(state: State) -> State:
    return State(*(array.copy() for array in state))


def _wrapped(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return angle - 2.0 * np.pi * np.floor((angle + np.pi) / (2.0 * np.pi))


def attitude(w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices R = Rz(gamma) Ry(beta) Rx(alpha) of poses w, shape (T, 6) -> (T, 3, 3)."""
    (sa, sb, sg), (ca, cb, cg) = np.sin(w[:, 3:]).T, np.cos(w[:, 3:]).T
    return np.array(
        [
            [cg * cb, cg * sb * sa - sg * ca, cg * sb * ca + sg * sa],
            [sg * cb, sg * sb * sa + cg * ca, sg * sb * ca - cg * sa],
            [-sb, cb * sa, cb * ca],
        ]
    ).transpose(2, 0, 1)


def attitude_distance(w: NDArray[np.float64], w_target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle of the rotation between two attitudes [rad], shape (T,)."""
    # From the Frobenius norm: the arc cosine of a trace loses half the digits near zero.
    norm = np.linalg.norm(attitude(w) - attitude(w_target), axis=(1, 2))
    return 2.0 * np.arcsin(np.clip(norm / np.sqrt(8.0), 0.0, 1.0))


def _record(
    scenario: KinematicScenario,
    description: snake.SnakeDescription,
    run: _Run,
    switcher: ModeSwitcher,
    block: CommandBlock,
) -> Record:
    state, trace, law = run.state, run.trace, run.controller.law
    model, period, ticks = run.model, run.controller.schedule.period, int(run.state.counts[1])
    rows = ticks // run.stride + 1
    if ticks % run.stride == 0:  # the end itself: no control period begins there, rates stay as they were
        record_row(model, law, state, run.rig, rows - 1, trace)
        for array in (trace.u, trace.slip, trace.at_limit, trace.w_hat):
            if rows > 1:
                array[rows - 1] = array[rows - 2]
        trace.w_hat[rows - 1] = state.w_hat
    trace = Trace(*(array[:rows] for array in trace))

    # Angles of w on the branch of the target, so that no curve jumps by 2 pi.
    w = trace.w.copy()
    w[:, 3:] = trace.w_target[:, 3:] + _wrapped(trace.w[:, 3:] - trace.w_target[:, 3:])
    position_error = np.linalg.norm(w[:, :3] - trace.w_target[:, :3], axis=1)
    attitude_error = attitude_distance(w, trace.w_target)
    grounded = law.grounded[trace.mode]
    points = np.zeros((rows, 1 + model.head_joints + 2 * model.base_joints, 3))
    posture_points(
        model, reals(trace.base), reals(trace.phi), run.rig.work.frame, new_chain(model), np.zeros(6), points
    )
    gripper = np.append(block.gripper, block.gripper[-1:])[: ticks + 1 : run.stride][:rows]

    names, wheels = description.joint_names, description.wheel_names
    pairs = tuple(f"pair{i + 1}" for i in range(description.pairs))
    record = Record(
        np.arange(rows) * run.stride * period,
        provenance={"scenario": dict(scenario.resolved), "snake": _geometry(description, run.controller)},
    )
    add = record.add
    add("phi", trace.phi, "rad", labels=names, description="joint angles, head to tail")
    add("rho", trace.rho, "rad", labels=wheels, description="angles of the active wheels")
    joints = len(names)
    add("phi_dot", trace.u[:, :joints], "rad/s", labels=names, description="joint rates held from this time on")
    add("rho_dot", trace.u[:, joints:], "rad/s", labels=wheels, description="wheel rates held from this time on")
    add("w", w, "m, rad", labels=COORDINATES, description="pose of the controlled point")
    add("w_target", trace.w_target, "m, rad", labels=COORDINATES, description="its target")
    add("w_estimate", trace.w_hat, "m, rad", labels=COORDINATES, description="what the controller takes it for")
    add("position_error", position_error, "m", description="distance of the controlled point from its target")
    add("attitude_error", attitude_error, "rad", description="angle between its attitude and the target's")
    add("base_pose", trace.base, "m, rad", labels=("x", "y", "yaw"), description="base part, at wheel pair 1")
    add("mode", np.array(run.controller.modes.numbers)[trace.mode], "1", description="mode number")
    add("grounded", grounded, "1", labels=pairs, description="1 where the wheel pair is on the ground")
    add("gripper", gripper, "1", description="1 closed (hardened), 0 open (soft)")
    add("cost", trace.cost, "1", description="V of the redundancy")
    add("sigma_min", trace.sigma, "1", description="smallest singular value of B~ of the mode, unweighted")
    add("support_margin", trace.margin, "m", description="centre of mass inside the support polygon by this much")
    add("support_area", trace.area, "m^2", description="of the support polygon")
    add("centre_of_mass", trace.centre, "m", labels=("x", "y", "z"))
    add("slip", trace.slip, "m/s", description="largest violation of a wheel row within the period")
    add("at_limit", trace.at_limit, "1", labels=names, description="1 joint out of the allocation, 2 clamped")
    labels = tuple(f"point{i}" for i in range(points.shape[1]))
    add("posture", points, "m", labels=labels, description="polyline: controlled point, joints, axles to the tail")
    record.summary = _summary(description, run, switcher, record)
    return record


def _geometry(description: snake.SnakeDescription, controller: task_space.TaskSpaceController) -> dict[str, Any]:
    """What figures and hardware need besides the signals."""
    return {
        "head_joints": description.head_joints,
        "base_joints": description.base_joints,
        "joint_names": list(description.joint_names),
        "pitch": description.pitch.tolist(),
        "lower_rad": description.lower.tolist(),
        "upper_rad": description.upper.tolist(),
        "wheel_radius_m": description.wheel_radius,
        "half_track_m": description.half_track.tolist(),
        "driven_side": description.driven_side.tolist(),
        "lifted": {
            str(number): [i + 1 for i, down in enumerate(row) if not down]
            for number, row in zip(controller.modes.numbers, controller.modes.grounded.tolist(), strict=True)
        },
    }


def _summary(description: snake.SnakeDescription, run: _Run, switcher: ModeSwitcher, record: Record) -> dict[str, Any]:
    phi, w, at_limit = record["phi"], record["w"], record["at_limit"]
    law = run.controller.law
    beyond = np.maximum(phi - description.upper, description.lower - phi)
    start = {
        str(number): task_space.conditioning(run.model, law, row, record["base_pose"][0], phi[0])._asdict()
        for row, number in enumerate(run.controller.modes.numbers)
    }
    return {
        "final_position_error_m": float(record["position_error"][-1]),
        "final_attitude_error_rad": float(record["attitude_error"][-1]),
        "position_error_max_m": float(record["position_error"].max()),
        "attitude_error_max_rad": float(record["attitude_error"].max()),
        "displacement": (w[-1] - w[0]).tolist(),
        "target_displacement": (record["w_target"][-1] - record["w_target"][0]).tolist(),
        "final_phi_rad": phi[-1].tolist(),
        "final_base_pose": record["base_pose"][-1].tolist(),
        "joint_limit_violation_max_rad": float(max(beyond.max(), 0.0)),
        "joints_taken_out": [description.joint_names[j] for j in np.flatnonzero((at_limit == 1).any(axis=0))],
        "waiting_s": float(run.state.counts[4] * run.controller.schedule.period),
        "clamped_joint_ticks": int(run.state.counts[2]),
        "joint_rate_max_rad_s": float(np.abs(record["phi_dot"]).max()),
        "wheel_rate_max_rad_s": float(np.abs(record["rho_dot"]).max(initial=0.0)),
        "slip_max_m_s": float(record["slip"].max()),
        "cost_initial": float(record["cost"][0]),
        "cost_final": float(record["cost"][-1]),
        "mode_switches": switcher.switches,
        "modes_refused": switcher.refused,
        "sigma_min_min": float(record["sigma_min"].min()),
        "support_margin_min_m": float(record["support_margin"].min()),
        "support_area_initial_m2": float(record["support_area"][0]),
        "support_area_final_m2": float(record["support_area"][-1]),
        "tipping": bool((record["support_margin"] <= 0.0).any()),
        "model": start,
    }
