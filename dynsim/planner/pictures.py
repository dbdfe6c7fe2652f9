"""Figures of a plan, and a 3D page that shows the best plan next to the unbraced arm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dynsim.draw.figures import style
from dynsim.draw.figures.look import Look
from dynsim.draw.figures.plan import CornerRun, PlanPicture, Pose, VariedPlans, draw_plan_figures
from dynsim.draw.figures.style import spaced
from dynsim.draw.geometry.meshes import Meshes
from dynsim.draw.geometry.projection import UP, Array, Projection
from dynsim.draw.geometry.robot import placed
from dynsim.draw.geometry.shapes import corners_of, drawn_shapes, solid
from dynsim.errors import ModelError, SimulationStopped
from dynsim.planner.answer import BracePlan, Size
from dynsim.planner.arm import axis_lines
from dynsim.planner.problem import Task
from dynsim.planner.vary import Variation
from dynsim.planner.verify import Corner, Tolerances
from dynsim.record import Record
from dynsim.scenario import build
from dynsim.scenario.quantities import quantity

# Number of instants of the first pass at which the arm is drawn.
POSES = 3
# Number of grid points per axis for drawing surfaces, and margin of the grid around the arm, relative to its length.
GRID, BEYOND = 240, 0.3
# Depth below the braces at which surfaces are cut for the view from above, and distance of ends of a closed path [m].
INSIDE, CLOSED = 1e-3, 1e-6


def draw_plan(
    plan: BracePlan, folder: Path, kind: str, look: Look | None = None, variation: Variation | None = None
) -> None:
    """Draw the figures to ``figures/``, and write ``view.html``."""
    shown = _records(plan)
    best = plan.best
    drawn = picture(plan, shown.get(best.variant) if best else None)
    if variation is not None:
        drawn = replace(drawn, varied=_varied(variation))
    draw_plan_figures(drawn, folder / "figures", kind, look)
    from dynsim.draw.page import content

    if shown:
        content.write(shown, folder / "view.html")


def _varied(variation: Variation) -> VariedPlans:
    """Return the data for the figure of plans for several values."""
    first, *others = variation.axes
    series: dict[str, list[Mapping[str, Any]]] = {}
    for row in variation.table:
        known = [(quantity(axis.key, variation.scenario).fitted(axis.values), row[axis.key]) for axis in others]
        label = ", ".join(f"{q.name} {style.number(q.scale * value)} {q.unit}".strip() for q, value in known)
        series.setdefault(label, []).append(row)
    axis = quantity(first.key, variation.scenario).fitted(first.values)
    return VariedPlans(first.key, axis, series, variation.limits)


def _records(plan: BracePlan) -> dict[str, Record]:
    """Simulate the best and the unbraced plan; return their records, including the records of stopped runs."""
    shown: dict[str, Record] = {}
    best = plan.best
    for size in plan.answered:
        if not (size is best or size.count == 0):
            continue
        try:
            shown[size.variant] = plan.record(size.count)
        except ModelError:
            # The verification reports why the plan cannot be simulated.
            continue
        except SimulationStopped as stop:
            if stop.record is not None:
                shown[size.variant] = stop.record
    return shown


def picture(plan: BracePlan, record: Record | None = None) -> PlanPicture:
    """Return the data for the figures of a plan; the record of the best plan shows its base."""
    task, best = plan.task, plan.best
    assert best is not None
    view = _view(task)
    poses = _poses(task, best, view)
    path = view.project(task.targets(np.linspace(0.0, task.duration, 200)))
    base = _base(record, view)
    points = np.vstack([path, *(line for pose in poses for line in pose.lines), *base])
    beyond = BEYOND * float(np.ptp(points, axis=0).max())
    low, high = points.min(axis=0) - beyond, points.max(axis=0) + beyond
    along, left, up = np.linspace(low, high, GRID).T
    touched = np.vstack([pose.points for pose in poses])
    depth = float(touched[:, 2].mean()) - INSIDE if len(touched) else 0.0
    along_arm = {c.label: (c.joint, float(np.linalg.norm(c.on_joint))) for c in task.candidates}
    answered = {size.count: size for size in plan.answered}
    return PlanPicture(
        title=task.scenario.title.replace(task.scenario.name, spaced(task.scenario.name), 1),
        poses=poses,
        path=path,
        braces=[brace.label for brace in best.braces],
        ground=(along, up, _gaps(task, view, *np.meshgrid(along, 0.0, up, indexing="ij"))),
        tops=(along, left, _gaps(task, view, *np.meshgrid(along, left, depth, indexing="ij")))
        if len(touched)
        else None,
        base=base,
        sets={count: plan.ranked[count] for count in answered},
        survives={count: size.survives for count, size in answered.items()},
        singles=dict(sorted(plan.singles.items(), key=lambda single: along_arm[single[0]])),
        corners={
            count: [_corner(c, size.expected, plan.tolerances) for c in size.verdict.corners]
            for count, size in answered.items()
            if size.verdict is not None
        },
        simulated={count: size.nominal.heat_W for count, size in answered.items() if size.nominal is not None},
    )


def _gaps(task: Task, view: Projection, along: Array, left: Array, up: Array) -> Array:
    """Return the distance from the nearest surface on a plane grid, transposed for contours, (GRID, GRID) [m]."""
    grid = view.world(np.stack([along, left, up], axis=-1)).reshape(-1, 3)
    gaps = [surface.gaps(grid) for surface in build.surfaces(task.scenario).values()]
    return np.min(gaps, axis=0).reshape(GRID, GRID).T


def _base(record: Record | None, view: Projection) -> list[Array]:
    """Return the corners of the solids of a fixed or mobile base at the start, in the coordinates of a view."""
    scene = None if record is None else placed(record)[0]
    if record is None or scene is None:
        return []
    meshes = Meshes()
    meshes.of_robot(scene)
    solids = [solid(shape, meshes.unique) for shape in drawn_shapes(scene.fixed, meshes)]
    solids += [part for body in scene.base for part in corners_of(record, scene, body, 0)]
    return [view.project(corners) for corners, _ in solids]


def _corner(corner: Corner, nominal: float, tolerances: Tolerances) -> CornerRun:
    """Return a run with the limits that it must meet, relative to the heat of the nominal run; NaN: no limit."""
    label = corner.label.replace("-", "−")
    most = np.nan if label == "as planned" else tolerances.heat
    allowed = np.nan if tolerances.hand_m is None else 1e3 * tolerances.hand_limit(corner)
    return CornerRun(label, corner.heat_W / nominal, most, 1e3 * corner.hand_rms_m, allowed, corner.reason)


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
    # The last posture on a closed path is the first.
    open_path = not np.ptp(task.targets(np.array([0.0, task.span])), axis=0).max() < CLOSED
    for t in np.linspace(0, min(last, len(dense.times) - 1), POSES, endpoint=open_path).astype(int):
        q = arm.coordinates(dense.q[t : t + 1])[0]
        lines = list(view.project(axis_lines(arm, dense.q[t])))
        centres, points, forces = np.zeros((3, len(size.braces), 3))
        now = dense.sample(t)
        for k, brace in enumerate(size.braces):
            centres[k] = model.point_position(brace.body, np.array(brace.point_m), q)
            normal = surfaces[brace.surface].normal(centres[k])
            points[k], forces[k] = centres[k] - brace.radius * normal, dense.forces[now, k] * normal
        projected = (view.project(part) for part in (points, forces, centres))
        poses.append(Pose(float(dense.times[t]), lines, *projected))
    return poses
