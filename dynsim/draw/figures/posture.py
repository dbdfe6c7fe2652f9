"""Figures of an arm's posture: 3D and side views with elbows, surfaces, target and hand path; comparisons."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection  # type: ignore[import-untyped]

from dynsim.draw.figures import style
from dynsim.draw.figures.energy import edge_on, target_name
from dynsim.draw.figures.style import Array
from dynsim.draw.geometry.meshes import Meshes
from dynsim.draw.geometry.projection import UP, Projection
from dynsim.draw.geometry.robot import penetrations, placed
from dynsim.draw.geometry.shapes import (
    Faces,
    box_about,
    corners_of,
    drawn_shapes,
    grid_faces,
    outline,
    round_patch,
    solid,
    surface_grids,
)
from dynsim.record import Record
from dynsim.record.measures import hand_target
from dynsim.record.poses import NORMAL, POSITION, contact_positions, point_positions
from dynsim.record.scene import WORLD, Point, Scene, SceneSurface

# Number of postures, evenly spaced in time, that are drawn faintly in addition to the last one.
FAINT = 3
# Labels of contacts: font size, and height of two lines [point].
LABEL_SIZE, LABEL_HEIGHT = 7.0, 19.0
# Maximum number of contacts of the robot with labels.
LABELLED = 8
# A target with an extent below this [point] is drawn as a cross.
SHORT = 12.0
# Size of the symbol of a mount, relative to the extent of the view.
MOUNT = 0.02
# Distance from the centre of a contact mark to its label [point].
NEAR_CONTACT = 7.0
# Sine of the angle between a plane and the view below which they are parallel; depth below which points count as
# outside [m].
PARALLEL, INSIDE = 0.7, 0.01
# Radius of the smallest contact sphere that is visible around a joint [point].
SPHERE = 4.0
# Extents below this [m] count as zero, because body poses are stored in single precision.
NOTHING = 1e-6


@dataclass(frozen=True)
class Skeleton:
    """Robot of a record with the poses of its bodies over time."""

    record: Record
    scene: Scene

    def segments(self, row: int) -> Array:
        """Return lines from each parent to its child body, and from the hand's body to the hand, (m, 2, 3) [m].

        No line leads to a body that moves freely relative to its parent or the world.
        """
        points, base = self.record[POSITION][row].astype(np.float64), (*self.scene.base, *self.objects)
        lines = []
        for k, body in enumerate(self.scene.bodies):
            # A translation of a floating, planar or rolling joint separates two bodies.
            separates = bool(body.joint.part_of) and body.joint.kind in ("prismatic", "planar")
            # A mobile base and objects are drawn as solids, see :meth:`solids`.
            if k in base or body.parent in base or separates:
                continue
            # A prismatic joint at the root moves its body away from its mount.
            start = np.array(body.joint.position) if body.parent == WORLD else points[body.parent]
            lines.append((start, points[k]))
        hand = self.scene.hand
        if hand is not None and hand.body != WORLD:
            lines.append((points[hand.body], point_positions(self.record, hand, row)))
        return np.array(lines).reshape(-1, 2, 3)

    def solids(self, row: int) -> list[tuple[Array, Faces]]:
        """Return corners, (n, 3) [m], and faces of the shapes of a base, its wheels, objects, and surfaces on links."""
        drawn = {*self.scene.base, *self.objects}
        # The root of a floating robot, to which no line leads.
        drawn |= {k for k, body in enumerate(self.scene.bodies) if body.joint.part_of and body.shapes}
        solids = [solid for body in sorted(drawn) for solid in corners_of(self.record, self.scene, body, row)]
        # Surfaces on other bodies are the last shapes of these.
        names, touched = {body.name for body in self.scene.bodies}, dict[int, set[str]]()
        for point in self.scene.points:
            if point.carrier != WORLD and point.carrier not in drawn and point.surface not in names:
                touched.setdefault(point.carrier, set()).add(point.surface)
        for carrier, surfaces in touched.items():
            solids += corners_of(self.record, self.scene, carrier, row)[-len(surfaces) :]
        return solids

    def bases(self) -> list[list[Array]]:
        """Return the corners of the solids of a mobile base and objects for the first and the last posture."""
        rows = self.rows_shown
        return [[corners for corners, _ in self.solids(k)] for k in dict.fromkeys([*rows[:1], *rows[-1:]])]

    def named_objects(self) -> list[tuple[str, Array]]:
        """Return the name and the corners, (n, 3) [m], of each object at the end."""
        names = {k: self.scene.bodies[k].name for k in self.objects if self.scene.bodies[k].shapes}
        return [
            (name, np.concatenate([corners for corners, _ in corners_of(self.record, self.scene, k, row)]))
            for row in self.rows_shown[-1:]
            for k, name in names.items()
            if name in self.scene.objects
        ]

    @cached_property
    def objects(self) -> tuple[int, ...]:
        """Indices of the bodies of objects, see :attr:`Scene.bodies_of_objects`; empty if they have no shapes."""
        known = self.scene.bodies_of_objects
        return tuple(sorted(known)) if any(self.scene.bodies[k].shapes for k in known) else ()

    def fixed(self) -> list[tuple[Array, Faces]]:
        """Return corners, (n, 3) [m], and faces of the shapes that are fixed in the world, without meshes."""
        return [solid(shape, []) for shape in drawn_shapes(self.scene.fixed, Meshes())]

    def mounts(self) -> Array:
        """Return lines from the fixed frame of the robot to each joint on it, (m, 2, 3) [m]."""
        bodies, base = self.scene.bodies, (*self.scene.base, *self.objects)
        frames = [np.array(frame.position) for frame in self.scene.frames if frame.body == WORLD]
        lines = []
        for k, body in enumerate(bodies):
            kinds = {body.joint.kind, *(child.joint.kind for child in bodies if child.parent == k)}
            if body.parent == WORLD and k not in base and not body.joint.part_of and "revolute" in kinds:
                end = np.array(body.joint.position)
                lines.append((min(frames, key=lambda frame: float(np.linalg.norm(frame - end)), default=end), end))
        return np.array(lines).reshape(-1, 2, 3)

    def pads(self, row: int) -> list[tuple[Array, float]]:
        """Return the centre [m] and radius [m] of each sphere with which the robot touches surfaces."""
        return [
            (point_positions(self.record, point, row), point.radius)
            for point in self.scene.contacts
            if point.radius > 0.0 and point.tip is None and point.body not in self.objects
        ]

    def extra(self) -> list[Array]:
        """Return points of solids, mounts and pads, (…, 3) [m], which the views must contain."""
        rows = self.rows_shown
        around = [
            centre + sign * radius * np.eye(3)
            for row in rows[-1:]
            for centre, radius in self.pads(row)
            for sign in (-1.0, 1.0)
        ]
        solids = [corners for base in self.bases() for corners in base]
        return [*solids, *(corners for corners, _ in self.fixed()), *around, *self.mounts()]

    def postures(self) -> list[Array]:
        """Return the segments at the samples of :attr:`rows_shown`; the last sample comes last."""
        return [self.segments(k) for k in self.rows_shown]

    @cached_property
    def rows_shown(self) -> list[int]:
        """Samples at which the robot is drawn, in order of time; empty if it never had a finite pose."""
        if not self.scene.bodies:
            return []
        rows = np.flatnonzero(np.isfinite(self.record[POSITION]).all(axis=(1, 2)))
        if not len(rows):
            return []
        return list(dict.fromkeys(rows[np.linspace(0, len(rows) - 1, FAINT + 1).astype(int)].tolist()))

    def contacts(self) -> list[tuple[Point, Array, Array, float]]:
        """Return point, normal, position and normal force (NaN if unknown) of each contact at the end of the run.

        If a force acts, the position is on the surface. Under the unilateral law, only contacts that touched are
        returned.
        """
        record = self.record
        if not self.scene.bodies or not np.isfinite(record[POSITION][-1]).all():
            return []
        forces: dict[str, float] = {}
        if "contact_normal_force" in record:
            forces = dict(zip(record.labels["contact_normal_force"], record["contact_normal_force"][-1], strict=True))
        untouched: set[str] = set()
        if "contact_mode" in record:
            open_always = (record["contact_mode"] == 0.0).all(axis=0)
            untouched = {
                name for name, always in zip(record.labels["contact_mode"], open_always, strict=True) if always
            }
        contacts = []
        for point in self.scene.contacts:
            surface, normals = self.scene.surface(point.surface), record.labels.get(NORMAL, ())
            if (surface is None and point.name not in normals) or point.name in untouched:
                continue
            position, force = contact_positions(record, point, len(record) - 1), float(forces.get(point.name, np.nan))
            if point.name in normals:
                normal = record[NORMAL][-1, normals.index(point.name)]
            else:
                assert surface is not None
                normal = surface.normal(position)
                if abs(force) > 0.0:
                    position = position - surface.gap(position) * normal
            contacts.append((point, normal, position, force))
        return contacts


def skeleton(record: Record) -> tuple[Skeleton, str]:
    """Return the robot of a record, or one without bodies and the reason why it cannot be drawn."""
    scene, lacking = placed(record)
    return Skeleton(record, scene or Scene()), f"posture not drawn: {lacking}" if lacking else ""


@dataclass(frozen=True)
class SidePlane(Projection):
    """Vertical plane through its origin, described by ``where``; coordinates are along a horizontal line, and z [m]."""

    where: str = "the base"

    @property
    def label(self) -> str:
        """Label of the horizontal axis of the plane."""
        # Round first; adding 0 removes the sign of a negative zero.
        azimuth = round(float(np.degrees(np.arctan2(self.axes[0, 1], self.axes[0, 0])))) + 0
        return f"distance from {self.where} [m], azimuth {style.number(azimuth)}°"


def side_plane(record: Record, drawn: Sequence[Array]) -> SidePlane:
    """Return the vertical plane of the arm: through the base, along the horizontal direction of its largest extent."""
    points = drawn[0].reshape(-1, 3) if drawn else record["hand_position"]
    origin = points[0]
    where = "the start of the arm" if record.scene is not None and record.scene.base else "the base"
    spread = (points - origin)[:, :2]
    spread = spread[np.isfinite(spread).all(axis=1)]
    if not len(spread) or np.abs(spread).max() < NOTHING:
        # The arm starts upright, so use its later postures.
        spread = np.concatenate([segments.reshape(-1, 3) for segments in drawn] or [points])[:, :2] - origin[:2]
    first = np.array([1.0, 0.0])
    if np.abs(spread).max(initial=0.0) >= NOTHING:
        first = np.linalg.svd(spread, full_matrices=False)[2][0]
    if (spread @ first).sum() < -NOTHING:
        first = -first
    return SidePlane(np.array([*origin[:2], 0.0]), np.array([[*first, 0.0], UP]), where)


@dataclass(frozen=True)
class Label:
    """Label of a contact at ``place`` (x, z) [m] in the side plane, on the given ``side``, ``level`` labels away."""

    text: str
    place: Array
    side: tuple[int, int]
    level: int

    @property
    def half(self) -> Array:
        """Half the width and height of the label [point]."""
        size = np.array([LABEL_SIZE * 0.65 * max(map(len, self.text.splitlines())), LABEL_HEIGHT])
        return 0.5 * style.letters(1.0) * size

    @property
    def offset(self) -> Array:
        """Offset from the contact to the centre of the label [point]."""
        half = float(self.half @ np.abs(self.side))
        return np.array(self.side) * (NEAR_CONTACT + (2 * self.level + 1) * half)

    def middle(self, scale: float) -> Array:
        """Return the centre of the label in the side plane at a scale [point/m]."""
        return scale * self.place + self.offset

    def overprints(self, other: Label, scale: float) -> bool:
        """Return whether two labels would overlap."""
        apart = np.abs(self.middle(scale) - other.middle(scale))
        return bool((apart < self.half + other.half + [2.0, 0.0]).all())


def contact_labels(body: Skeleton, plane: SidePlane, scale: float) -> list[Label]:
    """Return labels with names and forces of the contacts, inside the surface and away from the arm.

    Labels that would overlap at ``scale`` [point/m], and labels of surfaces that are too small for them, are moved away
    from the contact.
    """
    labels: list[Label] = []
    points = [(*contact, plane.project(contact[2])) for contact in body.contacts()]
    # A narrow figure has no space for labels of open contacts, which the legend explains.
    points = [
        point for point in points if point[0].body not in body.objects and not (style.narrow() and point[3] == 0.0)
    ]
    if len(points) > LABELLED:
        return []
    largest = max((abs(force) for *_, force, _ in points if not np.isnan(force)), default=0.0)
    for contact, normal, position, force, at in sorted(points, key=lambda entry: float(entry[4][0])):
        along, up = plane.axes @ normal
        steep = abs(along) > abs(up)
        side = (-1 if along > 0.0 else 1, 0) if steep else (0, 1 if up < 0.0 else -1)
        # Less than a thousandth of the largest force is printed as 0.
        value = style.number(0.0 if abs(force) < 1e-3 * largest else force, 3)
        text = contact.name if np.isnan(force) else f"{contact.name}\n{value} N"
        label, surface = Label(text, at, side, 0), body.scene.surface(contact.surface)
        size = NEAR_CONTACT + 2.0 * float(label.half @ np.abs(side))
        depth = np.linspace(0.0, 1.1 * size / scale, 50)
        if surface is not None and (inside := surface.gap(position - depth[:, None] * normal) < 0.0).any():
            thick = scale * float(depth[inside][-1])
            level = math.ceil((thick - NEAR_CONTACT) / (size - NEAR_CONTACT))
            label = replace(label, level=max(level, 0) * (not inside[-1]))
        while any(label.overprints(other, scale) for other in labels):
            label = replace(label, level=label.level + 1)
        labels.append(label)
    return labels


def with_labels(extent: tuple[Array, Array], labels: Sequence[Label], scale: float) -> tuple[Array, Array]:
    """Return the extent with space for the labels."""
    low, high = extent
    for label in labels:
        middle, room = label.middle(scale) / scale, (label.half + 3.0) / scale
        low, high = np.minimum(low, middle - room), np.maximum(high, middle + room)
    return low, high


def bounds(records: Sequence[Record], drawn: Sequence[Array]) -> tuple[Array, Array]:
    """Return the corners of the box of a 3D view [m]."""
    low, high = box_about(_clouds(records, drawn))
    # Even a flat scene needs some depth.
    extra = np.maximum(0.15 * _span(low, high) - 0.5 * (high - low), 0.0)
    return low - extra, high + extra


def extent_of(plane: SidePlane, drawn: Sequence[Array], records: Sequence[Record]) -> tuple[Array, Array]:
    """Return the corners of a side view [m]."""
    low, high = box_about([plane.project(points) for points in _clouds(records, drawn)])
    span = _span(low, high)
    # The extent of an upright arm alone would leave no width for the axis.
    extra = np.maximum(np.array([0.3, 0.05]) * span - 0.5 * (high - low), 0.0) + 0.05 * span
    return low - extra, high + extra


def _span(low: Array, high: Array) -> float:
    """Return the largest side of a box [m], or 1 m for a point."""
    span = float((high - low).max())
    return span if span > NOTHING else 1.0


def _clouds(records: Sequence[Record], drawn: Sequence[Array]) -> list[Array]:
    """Return all points that must be in the view, (…, 3) each."""
    targets = [target for record in records if (target := hand_target(record)) is not None]
    return [*(record["hand_position"] for record in records), *targets, *drawn]


# An axis of the 3D view that is shorter than this fraction of the longest axis gets two ticks.
SHORT_AXIS = 0.45
# Maximum number of joints that are drawn as dots.
DOTS = 40
ARM_COLOUR = "#444444"
BASE_COLOUR = "#D5D5D5"
PAD_COLOUR = "#F1E3C6"
# Space for the labels of a side view on its left and right, alone and next to another view [inch].
FULL, HALF = 1.1, 0.75


def posture(record: Record) -> Figure | None:
    """Draw the arm at the end of the run and, faintly, at earlier times; return None for a record without a hand.

    If the record does not describe the arm, only paths are drawn, with a note.
    """
    if "hand_position" not in record:
        return None
    body, note = skeleton(record)
    drawn = body.postures()
    plane = side_plane(record, drawn)
    everything = [*drawn, *body.extra()]
    low, high = bounds([record], everything)
    # The side view is below the 3D view if the arm is long. A narrow figure has no space for a 3D view.
    wide = style.narrow() or np.hypot(high[0] - low[0], high[1] - low[1]) > 2.2 * (high[2] - low[2])
    extent = extent_of(plane, everything, [record])
    size = extent[1] - extent[0]
    across = style.width() - FULL if wide else 0.5 * style.width() - HALF
    tall = float(np.clip(across * size[1] / size[0], 1.2 if wide else 1.5, 3.4))
    above = 3.0 * (wide and not style.narrow())
    room = 72.0 * np.array([across, tall if not wide else np.inf])
    extent, scale = _with_labels(extent, [body], plane, room)
    size = extent[1] - extent[0]
    tall = min(float(across * size[1] / size[0]), 3.4) if wide else tall
    figure = style.new_figure(1.2 + tall + above, style.title(record, f"posture at {record.time[-1]:.4g} s"))
    # If the views are side by side, the labels of the 3D view need some space to their right.
    if style.narrow():
        grid = figure.add_gridspec(1, 1)
    elif wide:
        grid = figure.add_gridspec(2, 1, height_ratios=[above, tall + 0.5])
    else:
        grid = figure.add_gridspec(1, 2, wspace=0.15)
    if not style.narrow():
        _space_view(figure.add_subplot(grid[0], projection="3d"), body, (low, high), wide)
        figure.axes[0].set_label("view in space")
    side = figure.add_subplot(grid[-1], label="side view")
    _side_view(side, body, plane, scale, colour=ARM_COLOUR)
    _frame_side(side, plane, extent, body.scene.surfaces)
    if note:
        side.set_title(style.broken(note, across), color=style.PULLING)
    style.legend_below(figure, [side], 5)
    if before := ", ".join(style.number(float(record.time[row]), 2) for row in body.rows_shown[:-1]):
        solids = f" Dashed: base and objects at {style.number(float(record.time[body.rows_shown[0]]), 2)} s."
        figure.note(f"Faint: posture at {before} s.{solids if any(body.bases()) else ''}")
    return figure


def posture_comparison(records: Mapping[str, Record]) -> Figure | None:
    """Draw side views of all variants at one scale; return None if no arm can be drawn."""
    bodies = {name: skeleton(record)[0] for name, record in records.items() if "hand_position" in record}
    shown = {name: body for name, body in bodies.items() if body.scene.bodies}
    if not shown:
        return None
    some = [records[name] for name in shown]
    everything = [segments for body in shown.values() for segments in body.postures()]
    plane = side_plane(some[0], everything)
    everything += [points for body in shown.values() for points in body.extra()]
    low, high = extent_of(plane, everything, some)
    size = high - low
    # Upright arms are drawn next to each other.
    most = (2 if style.narrow() else 4) if size[1] > size[0] else 1 + (len(shown) > 4) + (not style.narrow())
    columns = min(len(shown), most)
    lines = -(-len(shown) // columns)
    across = style.width() - FULL if columns == 1 else (style.width() - 0.65) / columns - 0.15
    framed, scale = _with_labels((low, high), list(shown.values()), plane, 72.0 * np.array([across, 3.2]))
    size = framed[1] - framed[0]
    each = float(np.clip(across * size[1] / size[0], 0.8, 3.2))
    figure = style.new_figure(
        0.9 + 0.85 * (len(shown) % columns > 0) + (0.3 + each) * lines,
        style.comparison_title(some, "postures at the end"),
    )
    grid = figure.subplots(lines, columns, sharex=True, sharey="row", squeeze=False)
    styles = style.variant_styles(list(records))
    for axes, (name, body) in zip(grid.ravel(), shown.items(), strict=False):
        _side_view(axes, body, plane, scale, colour=styles[name]["color"], path=style.GREY, named=False)
        _frame_side(axes, plane, framed, body.scene.surfaces)
        axes.set_title(name, color=styles[name]["color"], fontweight="bold")
        label = axes.get_xlabel()
        axes.label_outer(remove_inner_ticks=False)
    for axes in grid.ravel()[len(shown) :]:
        axes.set_axis_off()
    for k, axes in enumerate(grid.ravel()[: len(shown)]):
        if k + columns >= len(shown):
            axes.tick_params(labelbottom=True)
            axes.set_xlabel(label)
    # The axis labels of narrow panels would overlap, so only one panel has a label, and a panel alone in its row.
    for axes in grid[:, [k for k in range(columns) if columns > 2 and k != columns // 2]].ravel():
        if axes is not grid[-1, 0] or len(shown) % columns != 1:
            axes.set_xlabel("")
    style.legend_below(figure, list(grid.ravel()), 5)
    dashed = any(any(body.bases()) for body in shown.values())
    figure.note("Faint: earlier postures." + " Dashed: base and objects at the start." * dashed)
    return figure


def _with_labels(
    extent: tuple[Array, Array], bodies: Sequence[Skeleton], plane: SidePlane, room: Array
) -> tuple[tuple[Array, Array], float]:
    """Return the extent with space for contact labels, and the scale [point/m] at which it fits ``room`` [point]."""
    wide, scale = extent, float((room / (extent[1] - extent[0])).min())
    for _ in range(3):  # repeat, because a smaller picture needs more room for labels
        labels = [label for body in bodies for label in contact_labels(body, plane, scale)]
        wide = with_labels(extent, labels, scale)
        scale = float((room / (wide[1] - wide[0])).min())
    return wide, scale


def _frame_side(axes: Axes, plane: SidePlane, extent: tuple[Array, Array], surfaces: Sequence[SceneSurface]) -> None:
    """Set limits and labels, and draw surfaces: grey inside (C < 0), with a line at the cut with the side plane."""
    low, high = extent
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    is_x = not plane.origin.any() and np.abs(plane.axes[0] - [1.0, 0.0, 0.0]).max() < NOTHING
    across = axes.get_window_extent().width / axes.figure.dpi
    axes.set_xlabel("$x$ [m]" if is_x else style.broken(plane.label, across))
    axes.set_ylabel("$z$ [m]")
    draw_cuts(axes, plane, surfaces)


def draw_cuts(axes: Axes, plane: Projection, surfaces: Sequence[SceneSurface], body: Array | None = None) -> None:
    """Draw surfaces within the limits of the axes: grey inside (C < 0), with a line at the cut with the plane.

    A surface without extent in the model, inside of which points of the ``body``, (n, 3) [m], are, is only a line. A
    plane that is nearly parallel to the view is not drawn, because projected points may be on either side of its cut.
    """
    along, up = np.meshgrid(np.linspace(*axes.get_xlim(), 160), np.linspace(*axes.get_ylim(), 120))
    points = plane.world(np.stack([along, up], axis=-1))
    for surface in surfaces:
        if surface.kind == "plane" and np.linalg.norm(plane.axes @ surface.b) < PARALLEL * np.linalg.norm(surface.b):
            continue
        value = surface.value(points)
        if value.min() < 0.0 < value.max():
            if body is None or surface.gap(body).min() > -INSIDE:
                axes.contourf(along, up, value, levels=[-np.inf, 0.0], colors=["#ECECEC"], zorder=0)
            axes.contour(along, up, value, levels=[0.0], colors=[style.GREY], linewidths=1.0, zorder=1)


def _side_view(
    axes: Axes,
    body: Skeleton,
    plane: SidePlane,
    scale: float,
    *,
    colour: str,
    path: str = style.BLUE,
    named: bool = True,
) -> None:
    """Draw the side view; if ``named`` is set, the legend states the depth and surface of penetrations."""
    look: dict[str, Any]
    record, drawn = body.record, body.postures()
    if drawn:
        flat = plane.project(np.concatenate(drawn))
        size = MOUNT * float(np.ptp(flat.reshape(-1, 2), axis=0).max(initial=0.0))
        for mount in plane.project(body.mounts()):
            _draw_mount(axes, mount, size, down=bool(flat[..., 1].mean() > mount[1, 1] - 4.0 * size))
    fixed = [plane.project(corners) for corners, _ in body.fixed()]
    add_outlines(axes, fixed, edgecolor=style.GREY, facecolor=BASE_COLOUR, lw=0.8, zorder=1.5)
    for centre, radius in body.pads(body.rows_shown[-1]) if drawn else []:
        look = {"facecolor": PAD_COLOUR, "edgecolor": colour, "lw": 0.8, "zorder": 2.8}
        look["label"] = style.UNLISTED * (scale * radius < SPHERE) + "contact sphere"
        axes.add_patch(Circle(tuple(plane.project(centre)), radius, **look))
    for base in (bases := body.bases()):
        last = base is bases[-1]
        look = {"facecolor": BASE_COLOUR, "zorder": 2.5} if last else {"facecolor": "none", "linestyle": (0, (3, 2))}
        add_outlines(axes, map(plane.project, base), edgecolor=colour if last else style.GREY, lw=0.8, **look)
    for name, corners in body.named_objects() if named else []:
        low, high = (getattr(plane.project(corners), side)(axis=0) for side in ("min", "max"))
        look = {"xytext": (0, 1.5), "textcoords": "offset points", "fontsize": style.letters(LABEL_SIZE)}
        axes.annotate(name, (0.5 * float(low[0] + high[0]), float(high[1])), ha="center", va="bottom", **look)
    for k, segments in enumerate(drawn):
        last = k == len(drawn) - 1
        flat = plane.project(segments)
        lines = LineCollection(
            list(flat),
            colors=colour,
            linewidths=2.4 if last else 1.2,
            alpha=_opacity(k, len(drawn)),
            # If faint segments had round ends, these would overlap and form dark dots.
            capstyle="round" if last else "butt",
            zorder=3 if last else 2,
        )
        axes.add_collection(lines)
        if last and len(flat) <= DOTS:
            axes.plot(*flat[:-1, 1].T, "o", color="white", markeredgecolor=colour, markersize=4, zorder=4)
    if (wanted := hand_target(record)) is not None:
        target = edge_on(plane.project(wanted))
        # A short target is a cross, because its dashes could not be recognised.
        short = scale * float(np.ptp(target, axis=0).max()) < SHORT
        look = {"marker": "x", "markersize": 7, "linestyle": "none"} if short else {"linestyle": (0, (3, 2)), "lw": 0.9}
        axes.plot(*target[: 1 if short else None].T, color=style.BLACK, zorder=5, label=target_name(record), **look)
    axes.plot(*plane.project(style.sparse(record["hand_position"])).T, color=path, lw=1.0, zorder=4, label="hand path")
    for _, _, position, force in body.contacts():
        axes.plot(*plane.project(position), zorder=6, linestyle="none", **_contact_mark(force))
    labels = contact_labels(body, plane, scale)
    rows = np.array(body.rows_shown, dtype=np.intp)
    if body.scene.bodies and (below := penetrations(record, body.scene, rows)):
        ring: dict[str, Any] = {"markersize": 9, "markerfacecolor": "none", "color": style.DEEP, "zorder": 5}
        for point_below in below:
            point = Point(point_below.name, "hand", point_below.body, point_below.position)
            # A second ring at the same joint would look like another point.
            at = rows[point_below.depth > point_below.least][-1]
            axes.plot(*plane.project(point_positions(record, point, at)), "o", **ring)
        deepest = max(below, key=lambda point_below: float(point_below.depth.max()))
        text = f"below {deepest.surface}, up to {style.number(1e3 * float(deepest.depth.max()), 3)} mm"
        axes.plot([], [], "o", label=text if named else "below a surface", **ring)
    for label in labels:  # without a box, which would hide outlines of surfaces
        axes.annotate(
            label.text,
            tuple(label.place),
            xytext=tuple(label.offset),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=style.letters(LABEL_SIZE),
            linespacing=1.1,
            # A line connects a distant label with its contact.
            arrowprops={"arrowstyle": "-", "color": style.GREY, "lw": 0.5, "shrinkB": 4} if label.level else None,
        )


def _draw_mount(axes: Axes, line: Array, size: float, *, down: bool) -> None:
    """Draw the link from the ground to the first joint, (2, 2) [m], and the hatched ground below or above it."""
    x, z = line[0]
    axes.plot(*line.T, color=style.GREY, lw=5.0, solid_capstyle="butt", zorder=1.6)
    low = z - size if down else z
    look: dict[str, Any] = {"facecolor": "white", "edgecolor": style.GREY, "hatch": "//////", "lw": 0.0, "zorder": 1.4}
    axes.add_patch(Rectangle((x - 2.0 * size, low), 4.0 * size, size, label=f"{style.UNLISTED}ground", **look))
    axes.plot([x - 2.0 * size, x + 2.0 * size], [z, z], color=style.GREY, lw=1.2, zorder=1.5)


def add_outlines(axes: Axes, solids: Iterable[Array], label: str = "", **look: Any) -> None:
    """Draw the convex hulls of projected solids, (n, 2) each, with one legend entry."""
    for corners in solids:
        axes.add_patch(Polygon(outline(corners), label=label, **look))
        label = ""


def _opacity(k: int, count: int) -> float:
    """Return the opacity of the k-th posture, which increases with time up to 1."""
    return 1.0 if k == count - 1 else 0.12 + 0.2 * k / count


def _space_view(axes: Any, body: Skeleton, bounds: tuple[Array, Array], wide: bool) -> None:
    (low, high), record, drawn = bounds, body.record, body.postures()
    # Use a fixed drawing order; if objects were sorted by depth, the floor would hide the contacts on it.
    axes.computed_zorder = False
    for surface in body.scene.surfaces:
        _draw_surface(axes, surface, low, high)
    base = [*body.fixed(), *(body.solids(body.rows_shown[-1]) if drawn else [])]
    size = MOUNT * float((high - low).max())
    for start, end in body.mounts():
        axes.plot(*np.array([start, end]).T, color=style.GREY, lw=4.0, zorder=1.6)
        corners = start + 2.0 * size * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]])
        ground = Poly3DCollection([corners], facecolors=BASE_COLOUR, edgecolors=style.GREY, linewidths=0.8, zorder=1.5)
        axes.add_collection3d(ground, autolim=False)
    for centre, radius in body.pads(body.rows_shown[-1]) if drawn else []:
        angle = np.linspace(0.0, 2.0 * np.pi, 49)
        for u, v in ((0, 1), (0, 2), (1, 2)):
            circle = np.tile(centre, (len(angle), 1))
            circle[:, u] += radius * np.cos(angle)
            circle[:, v] += radius * np.sin(angle)
            axes.plot(*circle.T, color=ARM_COLOUR, lw=0.5, zorder=2.6)
    if base:
        # Draw all faces in one collection, because a collection sorts its faces by depth.
        shown = np.concatenate([corners[faces] for corners, faces in base])
        solid = Poly3DCollection(shown, facecolors=BASE_COLOUR, linewidths=0, shade=True, antialiased=False, zorder=2.5)
        axes.add_collection3d(solid, autolim=False)
    for k, segments in enumerate(drawn):
        last = k == len(drawn) - 1
        lines = Line3DCollection(
            list(segments),
            colors=ARM_COLOUR,
            linewidths=2.4 if last else 1.0,
            alpha=_opacity(k, len(drawn)),
            zorder=3 if last else 2,
        )
        axes.add_collection3d(lines, autolim=False)
        if last and len(segments) <= DOTS:
            axes.plot(*segments[:-1, 1].T, "o", color="white", markeredgecolor=ARM_COLOUR, markersize=3, zorder=4)
    if (wanted := hand_target(record)) is not None:
        target = style.sparse(wanted)
        axes.plot(*target.T, color=style.BLACK, linestyle=(0, (3, 2)), lw=0.9, zorder=6)
    axes.plot(*style.sparse(record["hand_position"]).T, color=style.BLUE, lw=1.0, zorder=5)
    for _, _, position, force in body.contacts():
        axes.plot(*position[:, None], linestyle="none", zorder=7, **_contact_mark(force))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    # The square of the axes is smaller than the space available for a long arm. Fill the space without clipping.
    # Seen along this direction (elevation 22°, azimuth −70°), a high scene must not extend into the view below.
    sides = high - low
    tall = float(0.93 * sides[2] + 0.37 * (0.34 * sides[0] + 0.94 * sides[1])) / float(np.hypot(*sides[:2]))
    axes.set_box_aspect(tuple(sides), zoom=float(np.clip(2.6 - 2.0 * tall, 1.05, 1.65)) if wide else 1.15)
    for artist in axes.get_children():
        artist.set_clip_on(False)
        artist.set_in_layout(False)
    axes.set_xlabel("$x$ [m]", labelpad=-2)
    axes.set_ylabel("$y$ [m]", labelpad=-3)
    axes.set_zlabel("$z$ [m]", labelpad=-3)
    axes.tick_params(pad=-1)
    for axis, a, b, share in zip(
        (axes.xaxis, axes.yaxis, axes.zaxis), low, high, (high - low) / (high - low).max(), strict=True
    ):
        ticks = MaxNLocator(2 + int(3 * share), steps=[1, 2, 5, 10]).tick_values(a, b)
        ticks = ticks[(ticks >= a) & (ticks <= b)]
        # A short axis has space only for its outer ticks; a short y axis, which begins at the end of the x axis, has
        # space only for its far tick.
        short = share < SHORT_AXIS and len(ticks) > (1 if axis is axes.yaxis else 2)
        axis.set_ticks((ticks[-1:] if axis is axes.yaxis else ticks[[0, -1]]) if short else ticks)
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
    axes.view_init(elev=22, azim=-70)


def _draw_surface(axes: Axes3D, surface: SceneSurface, low: Array, high: Array) -> None:
    """Draw the part of a surface near the arm."""
    if surface.kind in ("sphere", "cylinder"):
        grids = [round_patch(surface, low, high)]
    else:
        grids = surface_grids(surface, low, high)
    if surface.kind in ("height_field", "box"):
        grids = [_within(grid, low, high) for grid in grids]
    # A flat face is one polygon, because the edges of its cells would form a pattern.
    flat = surface.kind in ("plane", "box")
    grids = [
        grid[:: len(grid) - 1, :: grid.shape[1] - 1] if flat and np.isfinite(grid).all() else grid for grid in grids
    ]
    quads = np.concatenate([corners[faces] for corners, faces in map(grid_faces, grids)])
    if len(quads):
        axes.add_collection3d(
            Poly3DCollection(list(quads), facecolors="#BBBBBB", alpha=0.25, linewidths=0, zorder=0, antialiased=False),
            autolim=False,
        )


def _within(grid: Array, low: Array, high: Array) -> Array:
    """Return the points of a grid with NaN in place of all points that are not near the arm."""
    room = 0.1 * float((high - low).max())
    near = ((grid >= low - room) & (grid <= high + room)).all(axis=-1, keepdims=True)
    return np.where(near, grid, np.nan)


def _contact_mark(force: float) -> dict[str, Any]:
    """Return the marker of a contact: blue triangle up if pushed, red triangle down if pulled, otherwise grey dot."""
    if force < 0.0:
        marker, colour, label = "v", style.PULLING, "surface pulls"
    elif force > 0.0:
        marker, colour, label = "^", style.BLUE, "surface pushes"
    else:
        marker, colour, label = "o", style.GREY, "contact, open" if force == 0.0 else "contact"
    return {"marker": marker, "color": colour, "label": label, "markersize": 7, "markeredgecolor": "white"}
