"""Figures of a plan, and a 3D page that shows the best plan next to the unbraced arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dynsim.draw.figures.look import Look
from dynsim.draw.figures.plan import PlanPicture, Pose, draw_plan_figures
from dynsim.draw.geometry.projection import UP, Projection
from dynsim.errors import SimulationStopped
from dynsim.planner.answer import BracePlan, Size
from dynsim.planner.arm import axis_lines
from dynsim.planner.problem import Task
from dynsim.record import Record
from dynsim.scenario import build

# Number of instants of the first pass at which the arm is drawn.
POSES = 4
# Number of grid points per axis for drawing surfaces, and margin of the grid around the arm [m].
GRID, BEYOND = 160, 0.15


def draw_plan(plan: BracePlan, folder: Path, kind: str, look: Look | None = None) -> None:
    """Draw the figures to ``figures/``, and write ``view.html``."""
    draw_plan_figures(picture(plan), folder / "figures", kind, look)
    from dynsim.draw.page import content

    shown = _records(plan)
    if shown:
        content.write(shown, folder / "view.html")


def _records(plan: BracePlan) -> dict[str, Record]:
    """Simulate the best and the unbraced plan; return their records, including the records of stopped runs."""
    shown: dict[str, Record] = {}
    best = plan.best
    for size in plan.answered:
        if not (size is best or size.count == 0):
            continue
        try:
            shown[size.variant] = plan.record(size.count)
        except SimulationStopped as stop:
            if stop.record is not None:
                shown[size.variant] = stop.record
    return shown


def picture(plan: BracePlan) -> PlanPicture:
    """Return the data for the figures of a plan."""
    task, best = plan.task, plan.best
    assert best is not None
    view = _view(task)
    poses = _poses(task, best, view)
    path = view.project(task.targets(np.linspace(0.0, task.duration, 200)))
    points = np.vstack([path, *(line for pose in poses for line in pose.lines)])[:, [0, 2]]
    low, high = points.min(axis=0) - BEYOND, points.max(axis=0) + BEYOND
    along, up = np.linspace(low[0], high[0], GRID), np.linspace(low[1], high[1], GRID)
    ahead, height = np.meshgrid(along, up)
    grid = view.world(np.stack([ahead, 0.0 * ahead, height], axis=-1)).reshape(-1, 3)
    gaps = [surface.gaps(grid) for surface in build.surfaces(task.scenario).values()]
    ground = np.min(gaps, axis=0).reshape(GRID, GRID) if gaps else np.ones((GRID, GRID))
    answered = {size.count: size for size in plan.answered}
    return PlanPicture(
        title=task.scenario.title,
        poses=poses,
        path=path,
        braces=[brace.label for brace in best.braces],
        ground=(along, up, ground),
        sets={count: plan.ranked[count] for count in answered},
        survives={count: size.survives for count, size in answered.items()},
        singles=plan.singles,
        corners={
            count: (size.heat, [(c.label, c.heat_W, 1e3 * c.hand_rms_m) for c in size.verdict.corners])
            for count, size in answered.items()
            if size.verdict is not None
        },
    )


def _view(task: Task) -> Projection:
    """Return the coordinates along the heading, to its left, and up; the heading is from the arm's base to its path."""
    middle = task.targets(np.array([0.5 * task.span]))[0] - task.arm.tables.origin[0]
    middle[2] = 0.0
    size = float(np.linalg.norm(middle))
    heading = middle / size if size > 1e-9 else np.array([1.0, 0.0, 0.0])
    return Projection(np.zeros(3), np.array([heading, np.cross(UP, heading), UP]))


def _poses(task: Task, size: Size, view: Projection) -> list[Pose]:
    """Return the poses of the arm at several instants of the first pass."""
    arm, model, dense = task.arm, task.arm.model, size.dense
    surfaces = build.surfaces(task.scenario)
    poses = []
    last = int(np.searchsorted(dense.times, task.span))
    for t in np.linspace(0, min(last, len(dense.times) - 1), POSES).astype(int):
        q = arm.coordinates(dense.q[t : t + 1])[0]
        lines = list(view.project(axis_lines(arm, dense.q[t])))
        points, forces = np.zeros((len(size.braces), 3)), np.zeros((len(size.braces), 3))
        now = min(round(dense.times[t] / dense.fine[1]), len(dense.fine) - 1)
        for k, brace in enumerate(size.braces):
            centre = model.point_position(brace.body, np.array(brace.point_m), q)
            normal = surfaces[brace.surface].normal(centre)
            points[k], forces[k] = centre - brace.radius * normal, dense.forces[now, k] * normal
        poses.append(Pose(float(dense.times[t]), lines, view.project(points), view.project(forces)))
    return poses
