"""The record of a run of the kinematic snake: signals, summary, warnings."""

from __future__ import annotations

import numpy as np

from dynsim._version import __version__
from dynsim.compile.scene import snake_scene
from dynsim.engine.gripper import gripper_summary
from dynsim.engine.kinematic_run import SnakeRun
from dynsim.engine.provenance import provenance
from dynsim.engine.snake_record import add_task, hold_last, task_summary, task_warnings
from dynsim.jit.kernel import reals
from dynsim.record import Record
from dynsim.record.poses import add_body_poses
from dynsim.scenario import Scenario
from dynsim.scenario.effect import without_effect
from dynsim.snake import state as ss
from dynsim.snake.kinematics import new_chain, posture_points
from dynsim.snake.state import SnakeTrace
from dynsim.snake.ticks import record_row


def make_record(run: SnakeRun, scenario: Scenario, wall: float, pictured: bool = True) -> Record:
    """Signals, units, summary and provenance of a run, finished or not.

    Parameters
    ----------
    run : after its last tick; the state at the end becomes the last sample.
    wall : time that the ticks took [s].
    pictured : with the scene and the poses of its bodies.
    """
    description, state, law = run.description, run.state, run.controller.law
    model, period, ticks = run.model, run.controller.schedule.period, run.tick
    rows = -(-ticks // run.stride) + 1
    trace = SnakeTrace(*(array[:rows] for array in run.trace))
    record_row(model, law, state, run.ws, rows - 1, trace)
    hold_last(trace)
    trace.w_hat[-1] = state.w_hat
    time = np.append(np.arange(rows - 1) * run.stride, ticks) * period
    points = np.zeros((rows, 1 + model.head_joints + 2 * model.base_joints, 3))
    posture_points(model, reals(trace.base), reals(trace.phi), run.ws.work.frame, new_chain(model), np.zeros(6), points)
    names, wheels, joints = description.joint_names, description.wheel_names, len(description.joint_names)
    record = Record(time, provenance=provenance(scenario))
    add = record.add
    add("phi", trace.phi, "rad", labels=names, description="joint angles, head to tail")
    add("rho", trace.rho, "rad", labels=wheels, description="angles of the active wheels")
    add("phi_dot", trace.u[:, :joints], "rad/s", labels=names, description="joint rates held from this time on")
    add("rho_dot", trace.u[:, joints:], "rad/s", labels=wheels, description="wheel rates held from this time on")
    add_task(record, run, trace, trace.w, points)
    if run.objects is not None:
        run.objects.add_to(record, trace.w, np.rint(time / period).astype(np.int64))
    if pictured:
        scene = snake_scene(description)
        record.scene = scene if run.objects is None else run.objects.beside(scene)
        add_body_poses(record)
    summary = {
        "scenario": scenario.name,
        "variant": scenario.variant,
        "dynsim_version": __version__,
        "duration_s": float(record.time[-1]),
        "integration_wall_s": wall,
        "real_time_factor": float(record.time[-1]) / wall if wall > 0.0 else 0.0,
        "steps": int(state.counts[ss.TICKS]),
        **task_summary(run, record),
    }
    warnings = [*task_warnings(run, record, summary), *_passed_limits(run, record)]
    if run.objects is not None and run.objects.graspable:
        summary["gripper"] = gripper_summary(record, run.objects.graspable)
    summary["warnings"] = [*warnings, *without_effect(scenario)]
    record.summary = summary
    return record


def _passed_limits(run: SnakeRun, record: Record) -> list[str]:
    """Warn of the joint that passes its limit furthest: this level has no stops, as the dynamic one has."""
    d = run.description
    beyond = np.maximum(record["phi"] - d.upper, d.lower - record["phi"]).max(axis=0)
    worst = int(beyond.argmax())
    if beyond[worst] <= 1e-9:  # rounding
        return []
    return [
        f"{d.joint_names[worst]} passes its limit by {beyond[worst]:.3f} rad; a real one would stop "
        "(controller.limit_policy: allocate)"
    ]
