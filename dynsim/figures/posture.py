"""The arm as a picture: 3D view and side view with elbows, surfaces, target and hand path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection  # type: ignore[import-untyped]

from dynsim.errors import DynsimError
from dynsim.figures import style
from dynsim.figures.hand import edge_on
from dynsim.figures.style import Array
from dynsim.model.description import Contact, Quadric
from dynsim.model.model import Model
from dynsim.record import Record
from dynsim.scenario import build, build_model, scenario_from_resolved

# Postures drawn faintly, evenly over the run, besides the last one.
FAINT = 6
# An axis of the 3D view shorter than this share of the longest has two ticks.
SHORT_AXIS = 0.45
# Joints are dots up to this many.
DOTS = 40
ARM_COLOUR = "#444444"
# Text at the contacts: size and height of its two lines [point].
LABEL_SIZE, LABEL_HEIGHT = 7.0, 19.0
# Width of a side view in a figure of one column, and of two [point].
FULL, HALF = 440.0, 205.0


@dataclass(frozen=True)
class Body:
    """What a posture is drawn from.

    Attributes
    ----------
    model : Model
    parents : for each body the index of its parent, −1 for the world; last: the hand's body
    """

    model: Model
    contacts: Sequence[Contact]
    surfaces: Mapping[str, Quadric]
    parents: tuple[int, ...]

    def segments(self, q: Array) -> Array:
        """From each body's parent to the body, and from its body to the hand, (m, 2, 3) [m]."""
        points = self.model.joint_positions(q)
        base = [k for k, parent in enumerate(self.parents) if parent < 0]
        # A sliding joint at the root moves its body away from where it is mounted.
        roots = [np.stack([self.model.robot.links[k].p_PJ, points[k]]) for k in base]
        inner = [np.stack([points[p], points[k]]) for k, p in enumerate(self.parents) if p >= 0]
        return np.stack(roots + inner)

    def contact_position(self, contact: Contact, q: Array) -> Array:
        """World position of a contact point, (3,) [m]."""
        return self.model.point_position(contact.body, contact.point, q)


@dataclass(frozen=True)
class SidePlane:
    """A vertical plane through ``origin`` along the horizontal unit vector ``direction``."""

    origin: Array
    direction: Array

    def project(self, points: Array) -> Array:
        """(…, 3) world → (…, 2): along the plane and z [m]."""
        return np.stack([(points - self.origin) @ self.direction, points[..., 2]], axis=-1)

    def world(self, along: Array, z: Array) -> Array:
        """Points in the plane, (…, 3) [m]."""
        points = self.origin * np.array([1.0, 1.0, 0.0]) + along[..., None] * self.direction
        points[..., 2] = z
        return points

    @property
    def label(self) -> str:
        """Label of the plane's horizontal axis."""
        azimuth = np.degrees(np.arctan2(self.direction[1], self.direction[0]))
        return f"distance from the base, azimuth {azimuth:.0f}° [m]"


def posture(record: Record) -> Figure | None:
    """The arm at the end of the run and, faintly, before; None for a record without a hand.

    Where the plant cannot be built again (its file is gone) only paths are drawn, with a note.
    """
    if "hand_position" not in record or "q" not in record:
        return None
    body, note = _body(record)
    drawn = [] if body is None else [body.segments(record["q"][k]) for k in _moments(record)]
    plane = _side_plane(record, drawn)
    low, high = _bounds([record], drawn)
    wide = np.hypot(high[0] - low[0], high[1] - low[1]) > 2.2 * (high[2] - low[2])
    extent = _extent(plane, drawn, [record])
    size = extent[1] - extent[0]
    # What the side view needs at the width that it has, and the labels of its axis, title and legend.
    height = 5.6 if wide else 1.15 + float(np.clip(HALF / 72.0 * size[1] / size[0], 1.5, 3.4))
    scale = (FULL if wide else min(HALF, 72.0 * (height - 1.15) * size[0] / size[1])) / size[0]
    extent = _with_labels(extent, _labels(record, body, plane, scale), scale)
    figure = style.new_figure(height, style.title(record, f"posture at {record.time[-1]:.4g} s, and before (faint)"))
    # Side by side, the labels of the 3D view need some room to their right.
    grid = figure.add_gridspec(2, 1, height_ratios=[1.25, 1.0]) if wide else figure.add_gridspec(1, 2, wspace=0.15)
    space: Any = figure.add_subplot(grid[0], projection="3d")
    side = figure.add_subplot(grid[1])
    _space_view(space, record, body, drawn, (low, high), zoom=1.65 if wide else 1.15)
    _side_view(side, record, body, drawn, plane, scale, colour=ARM_COLOUR)
    _frame_side(side, plane, extent, [] if body is None else list(body.surfaces.values()))
    if note:
        side.set_title(note, color=style.PULLING)
    _legend(figure, [side])
    return figure


def posture_comparison(records: Mapping[str, Record]) -> Figure | None:
    """Side views of all variants at one scale; None where no arm can be drawn."""
    bodies = {name: _body(record)[0] for name, record in records.items() if "hand_position" in record}
    shown = {name: body for name, body in bodies.items() if body is not None}
    if not shown:
        return None
    some = [records[name] for name in shown]
    drawn = {
        name: [body.segments(records[name]["q"][k]) for k in _moments(records[name])] for name, body in shown.items()
    }
    everything = [segments for one in drawn.values() for segments in one]
    plane = _side_plane(some[0], everything)
    columns = 2 if len(shown) > 1 else 1
    lines = -(-len(shown) // columns)
    low, high = _extent(plane, everything, some)
    scale = (FULL if columns == 1 else HALF) / (high[0] - low[0])
    scale = min(scale, 72.0 * 3.2 / (high[1] - low[1]))
    labels = [label for name, body in shown.items() for label in _labels(records[name], body, plane, scale)]
    low, high = _with_labels((low, high), labels, scale)
    height = 0.9 + lines * (0.3 + np.clip(3.2 * (high[1] - low[1]) / (high[0] - low[0]), 0.8, 3.2))
    figure = style.new_figure(height, style.comparison_title(some, "postures at the end, and before (faint)"))
    grid = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    styles = style.variant_styles(list(records))
    for axes, (name, body) in zip(grid.ravel(), shown.items(), strict=False):
        colour = str(styles[name]["color"])
        _side_view(axes, records[name], body, drawn[name], plane, scale, colour=colour, path=style.GREY)
        _frame_side(axes, plane, (low, high), list(body.surfaces.values()))
        axes.set_title(name, color=styles[name]["color"], fontweight="bold")
        axes.label_outer()
    for axes in grid.ravel()[len(shown) :]:
        axes.set_axis_off()
    _legend(figure, list(grid.ravel()))
    return figure


@dataclass(frozen=True)
class Label:
    """What is written at a contact: at (x, z) [m] in the side plane, ``level`` labels away from it."""

    text: str
    x: float
    z: float
    below: bool
    level: int

    @property
    def offset(self) -> float:
        """Distance of the text from the contact [point]."""
        return 7.0 + LABEL_HEIGHT * self.level


def _labels(record: Record, body: Body | None, plane: SidePlane, scale: float) -> list[Label]:
    """Names and forces of the contacts, on the far side of the surface, where there is no arm.

    Labels that would overprint each other at ``scale`` [point/m] are moved away from the surface.
    """
    found: list[Label] = []
    ends: dict[tuple[bool, int], float] = {}
    points = [(contact, position, plane.project(position), f) for contact, position, f in _contact_points(record, body)]
    for contact, position, at, force in sorted(points, key=lambda one: float(one[2][0])):
        below = bool((contact.surface.Q @ position + contact.surface.b)[2] >= 0.0)
        text = f"{contact.name}\n{style.number(force, 3)} N"
        half = 0.5 * LABEL_SIZE * 0.65 * max(len(line) for line in text.splitlines())
        level, place = 0, float(at[0]) * scale
        while place - half < ends.get((below, level), -np.inf):
            level += 1
        ends[below, level] = place + half + 2.0
        found.append(Label(text, float(at[0]), float(at[1]), below, level))
    return found


def _with_labels(extent: tuple[Array, Array], labels: Sequence[Label], scale: float) -> tuple[Array, Array]:
    """The extent with room for the labels."""
    low, high = extent[0].copy(), extent[1].copy()
    for label in labels:
        room = (label.offset + LABEL_HEIGHT + 3.0) / scale
        if label.below:
            low[1] = min(low[1], label.z - room)
        else:
            high[1] = max(high[1], label.z + room)
    return low, high


def _body(record: Record) -> tuple[Body | None, str]:
    """The plant of a record, or why there is none."""
    try:
        scenario = scenario_from_resolved(record.provenance["scenario"])
        model = build_model(scenario)
        if record["q"].shape[1] != model.n:
            return None, "posture not drawn: the plant has changed since the run"
        links = model.robot.links
        index = {link.name: k for k, link in enumerate(links)}
        parents = [-1 if link.parent in (None, "world") else index[str(link.parent)] for link in links]
        parents.append(model.body_index(model.robot.hand[0]))
        return Body(model, build.contacts(scenario), build.surfaces(scenario), tuple(parents)), ""
    except (DynsimError, KeyError, OSError) as error:
        return None, f"posture not drawn: {str(error).splitlines()[0][:90]}"


def _moments(record: Record) -> list[int]:
    """Indices of the drawn postures, the last one last; a run that diverged may end in some that are not finite."""
    rows = np.flatnonzero(np.isfinite(record["q"]).all(axis=1))
    if not len(rows):
        return []
    return list(dict.fromkeys(rows[np.linspace(0, len(rows) - 1, FAINT + 1).astype(int)].tolist()))


def _points(records: Sequence[Record], drawn: Sequence[Array]) -> Array:
    """Everything that must be in the picture, (N, 3)."""
    names = ("hand_position", "target_position")
    points = [record[name] for record in records for name in names if name in record]
    points += [segments.reshape(-1, 3) for segments in drawn]
    everything = np.concatenate(points)
    return everything[np.isfinite(everything).all(axis=1)]


def _bounds(records: Sequence[Record], drawn: Sequence[Array]) -> tuple[Array, Array]:
    points = _points(records, drawn)
    if not len(points):
        return np.zeros(3), np.ones(3)
    low, high = points.min(axis=0), points.max(axis=0)
    # A flat picture still needs some depth to stand in.
    extra = np.maximum(0.15 * float((high - low).max() or 1.0) - 0.5 * (high - low), 0.0)
    return low - extra, high + extra


def _side_plane(record: Record, drawn: Sequence[Array]) -> SidePlane:
    """The vertical plane that the arm spans: from the base in the horizontal direction of its greatest extent."""
    points = drawn[0].reshape(-1, 3) if drawn else record["hand_position"]
    origin = points[0]
    spread = (points - origin)[:, :2]
    spread = spread[np.isfinite(spread).all(axis=1)]
    if not len(spread) or np.abs(spread).max() < 1e-9:
        # It stands upright at first; where does it go from there?
        spread = np.concatenate([segments.reshape(-1, 3) for segments in drawn] or [points])[:, :2] - origin[:2]
    if np.abs(spread).max(initial=0.0) < 1e-9:
        return SidePlane(origin, np.array([1.0, 0.0, 0.0]))
    first = np.linalg.svd(spread, full_matrices=False)[2][0]
    if (spread @ first).sum() < 0.0:
        first = -first
    return SidePlane(origin, np.array([*first, 0.0]))


def _extent(plane: SidePlane, drawn: Sequence[Array], records: Sequence[Record]) -> tuple[Array, Array]:
    flat = plane.project(_points(records, drawn))
    low, high = flat.min(axis=0), flat.max(axis=0)
    span = float((high - low).max() or 1.0)
    # An upright arm would leave no width for the axis.
    extra = np.maximum(np.array([0.3, 0.05]) * span - 0.5 * (high - low), 0.0) + 0.05 * span
    return low - extra, high + extra


def _legend(figure: Figure, panels: Sequence[Axes]) -> None:
    """One legend for all panels; the arm itself needs no entry."""
    known: dict[str, Any] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        known.update(dict(zip(labels, handles, strict=True)))
    figure.legend(known.values(), known.keys(), loc="outside lower center", ncols=len(known))


def _frame_side(axes: Axes, plane: SidePlane, extent: tuple[Array, Array], surfaces: Sequence[Quadric]) -> None:
    """Limits, labels, and where surfaces are: grey inside (C < 0), a line where the plane cuts them."""
    low, high = extent
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_xlabel(plane.label)
    axes.set_ylabel("z [m]")
    along, z = np.meshgrid(np.linspace(low[0], high[0], 160), np.linspace(low[1], high[1], 120))
    points = plane.world(along, z)
    for surface in surfaces:
        value = 0.5 * np.einsum("...i,ij,...j", points, surface.Q, points) + points @ surface.b + surface.c
        if value.min() < 0.0 < value.max():
            axes.contourf(along, z, value, levels=[-np.inf, 0.0], colors=["#ECECEC"], zorder=0)
            axes.contour(along, z, value, levels=[0.0], colors=[style.GREY], linewidths=1.0, zorder=1)


def _side_view(
    axes: Axes,
    record: Record,
    body: Body | None,
    drawn: Sequence[Array],
    plane: SidePlane,
    scale: float,
    *,
    colour: str,
    path: str = style.BLUE,
) -> None:
    for k, segments in enumerate(drawn):
        last = k == len(drawn) - 1
        flat = plane.project(segments)
        lines = LineCollection(
            list(flat),
            colors=colour,
            linewidths=2.4 if last else 1.2,
            alpha=1.0 if last else 0.22,
            # Round ends of faint segments would overlap to dark dots.
            capstyle="round" if last else "butt",
            zorder=3 if last else 2,
        )
        axes.add_collection(lines)
        if last and len(flat) <= DOTS:
            axes.plot(*flat[:-1, 1].T, "o", color="white", markeredgecolor=colour, markersize=4, zorder=4)
    if "target_position" in record:
        target = edge_on(plane.project(record["target_position"]))
        axes.plot(*target.T, color=style.BLACK, linestyle=(0, (3, 2)), lw=0.9, zorder=5, label="target")
    axes.plot(*plane.project(style.sparse(record["hand_position"])).T, color=path, lw=1.0, zorder=4, label="hand path")
    for _, position, force in _contact_points(record, body):
        axes.plot(*plane.project(position), zorder=6, linestyle="none", **_contact_mark(force))
    for label in _labels(record, body, plane, scale):
        axes.annotate(
            label.text,
            (label.x, label.z),
            xytext=(0, -label.offset if label.below else label.offset),
            textcoords="offset points",
            ha="center",
            va="top" if label.below else "bottom",
            fontsize=LABEL_SIZE,
            linespacing=1.1,
            # A label further away says with a line where it belongs.
            arrowprops={"arrowstyle": "-", "color": style.GREY, "lw": 0.5, "shrinkB": 4} if label.level else None,
        )


def _space_view(
    axes: Axes3D, record: Record, body: Body | None, drawn: Sequence[Array], bounds: tuple[Array, Array], zoom: float
) -> None:
    low, high = bounds
    # The order of drawing is given: by depth, the floor would hide the contacts that lie on it.
    axes.computed_zorder = False
    for surface in () if body is None else body.surfaces.values():
        _draw_surface(axes, surface, low, high)
    for k, segments in enumerate(drawn):
        last = k == len(drawn) - 1
        lines = Line3DCollection(
            list(segments),
            colors=ARM_COLOUR,
            linewidths=2.4 if last else 1.0,
            alpha=1.0 if last else 0.2,
            zorder=3 if last else 2,
        )
        axes.add_collection3d(lines, autolim=False)
        if last and len(segments) <= DOTS:
            axes.plot(*segments[:-1, 1].T, "o", color="white", markeredgecolor=ARM_COLOUR, markersize=3, zorder=4)
    if "target_position" in record:
        target = style.sparse(record["target_position"])
        axes.plot(*target.T, color=style.BLACK, linestyle=(0, (3, 2)), lw=0.9, zorder=6)
    axes.plot(*style.sparse(record["hand_position"]).T, color=style.BLUE, lw=1.0, zorder=5)
    for _, position, force in _contact_points(record, body):
        axes.plot(*position[:, None], linestyle="none", zorder=7, **_contact_mark(force))
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_zlim(low[2], high[2])
    # The square of the axes is smaller than the room that a long arm has: fill it, and do not clip at the square.
    axes.set_box_aspect(tuple(high - low), zoom=zoom)
    for artist in axes.get_children():
        artist.set_clip_on(False)
        artist.set_in_layout(False)
    axes.set_xlabel("x [m]", labelpad=-2)
    axes.set_ylabel("y [m]", labelpad=-3)
    axes.set_zlabel("z [m]", labelpad=-3)
    axes.tick_params(pad=-1)
    for axis, a, b, share in zip(
        (axes.xaxis, axes.yaxis, axes.zaxis), low, high, (high - low) / (high - low).max(), strict=True
    ):
        ticks = MaxNLocator(2 + int(3 * share), steps=[1, 2, 5, 10]).tick_values(a, b)
        ticks = ticks[(ticks >= a) & (ticks <= b)]
        # On a short axis only the outer ones have room.
        axis.set_ticks(ticks[[0, -1]] if share < SHORT_AXIS and len(ticks) > 2 else ticks)
    axes.view_init(elev=22, azim=-70)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))


def _draw_surface(axes: Axes3D, surface: Quadric, low: Array, high: Array) -> None:
    """The part of a quadric next to the arm: over its tangent plane, along the normal to the nearest root of C."""
    anchor = 0.5 * (low + high)
    normal = np.zeros(3)
    for _ in range(20):
        slope = surface.Q @ anchor + surface.b
        if not np.linalg.norm(slope) > 1e-12:
            return
        normal = slope / np.linalg.norm(slope)
        anchor = anchor - surface.gap(anchor) * normal
    # Along the axes of the world where that is possible.
    across = np.eye(3)[:2] if abs(normal[2]) > 0.99 else np.linalg.svd(normal[None])[2][1:]
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    reach = (corners - anchor) @ across.T
    # A flat surface is one polygon: seams between many would show.
    count = 41 if np.any(surface.Q) else 2
    u, v = np.meshgrid(*(np.linspace(reach[:, k].min(), reach[:, k].max(), count) for k in (0, 1)))
    start = anchor + u[..., None] * across[0] + v[..., None] * across[1]
    a = 0.5 * float(normal @ surface.Q @ normal)
    b = start @ surface.Q @ normal + float(surface.b @ normal)
    c = 0.5 * np.einsum("...i,ij,...j", start, surface.Q, start) + start @ surface.b + surface.c
    inside = b * b - 4.0 * a * c
    # The smaller root, in the form that also holds for a = 0.
    step = -2.0 * c / (b + np.copysign(np.sqrt(np.where(inside >= 0.0, inside, np.nan)), b))
    points = start + step[..., None] * normal
    points[np.abs(step) > float((high - low).max())] = np.nan
    quads = np.stack([points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]], axis=2).reshape(-1, 4, 3)
    quads = quads[np.isfinite(quads).all(axis=(1, 2))]
    if len(quads):
        axes.add_collection3d(
            Poly3DCollection(list(quads), facecolors="#BBBBBB", alpha=0.25, linewidths=0, zorder=0, antialiased=False),
            autolim=False,
        )


def _contact_points(record: Record, body: Body | None) -> list[tuple[Contact, Array, float]]:
    """Contact, position at the end and normal force at the end of every contact."""
    if body is None or "contact_normal_force" not in record or not np.isfinite(record["q"][-1]).all():
        return []
    last = dict(zip(record.labels["contact_normal_force"], record["contact_normal_force"][-1], strict=True))
    return [
        (contact, body.contact_position(contact, record["q"][-1]), float(last[contact.name]))
        for contact in body.contacts
        if contact.name in last
    ]


def _contact_mark(force: float) -> dict[str, Any]:
    """A blue triangle up where the surface pushes, a red one down where it would have to pull, a grey dot if open."""
    if force < 0.0:
        marker, colour, label = "v", style.PULLING, "contact, surface pulls"
    elif force > 0.0:
        marker, colour, label = "^", style.BLUE, "contact, surface pushes"
    else:
        marker, colour, label = "o", style.GREY, "contact, open"
    return {"marker": marker, "color": colour, "label": label, "markersize": 7, "markeredgecolor": "white"}
