"""Figures of a mobile base: loads, tip margin, traction and tracking over time, and the view from above."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from dynsim.draw.figures import contacts, style
from dynsim.draw.figures.energy import edge_on, target_name
from dynsim.draw.figures.posture import ARM_COLOUR, Skeleton, add_outlines, skeleton
from dynsim.draw.figures.style import Array
from dynsim.draw.geometry.shapes import box_about
from dynsim.record import Record
from dynsim.record.measures import TIP_OVER, hand_target, overturns_settled, percent
from dynsim.record.poses import point_positions
from dynsim.record.scene import Point

LOADS, MARGIN, TRACTION = "wheel_load", "tip_margin", "traction_demand"
# Axis limits: the traction demand is unbounded for a wheel without load, and the tip margin is unbounded if the ground
# carries almost no load.
TRACTION_TOP, MARGIN_LOW = 2.5, -2.0
# Tracking: minimum ranges of the axes, so that rounding errors are not magnified.
MIN_RANGES = {"position [m]": 1e-3, "heading [°]": 0.1, "error [mm]": 5e-3, "heading error [°]": 5e-3}
MILLI = 1e3
# Fraction of the time axis above which a band is visible.
VISIBLE = 2e-3
# Values over time, and how they are drawn.
Curve = tuple[Array, dict[str, Any]]


def overturning(record: Record) -> Figure | None:
    """Draw wheel and caster loads, tip margin and traction demand over time; return None without a mobile base."""
    if not {LOADS, MARGIN, TRACTION} <= set(record):
        return None
    figure = style.new_figure(6.2, style.title(record, "loads and stability of the base"))
    loads, margin = record[LOADS], record[MARGIN]
    # The traction demand is undefined for a wheel without load.
    traction = np.where(np.isfinite(record[TRACTION]), record[TRACTION], np.nan)
    bare = np.asarray(np.isnan(traction).any(axis=1))
    demanded = np.minimum(traction, TRACTION_TOP)
    series = [loads, np.maximum(margin, MARGIN_LOW), demanded]
    rows = style.time_rows(figure, [[(record.time, values)] for values in series], record.settle_time)
    for axes in rows[0]:
        _lines(axes, record, LOADS, "min {} N", np.nanmin)
        style.shade_below_zero(axes, "wheel pulls on the ground")
    for axes in rows[1]:
        style.line(axes, record.time, margin, color=style.BLUE, label=_margin_label("margin", record))
        _frame_margin(axes)
    for axes in rows[2]:
        _lines(axes, record, TRACTION, "max {}", np.nanmax)
        none = f"a wheel has no load: {percent(float(bare.mean()))}"
        style.shade(axes, record.time, bare & (bare.mean() > VISIBLE), "#EFEFEF", none)
        axes.axhline(1.0, color=style.PULLING, linewidth=0.8, label="slips above 1")
        axes.set_ylim(0.0, min(max(axes.get_ylim()[1], 1.15), TRACTION_TOP))
    contacts.mark_all(figure, rows, record)
    for panels, label in zip(rows, ("load [N]", "tip margin", "traction demand\n/ friction limit"), strict=True):
        style.label_row(panels, label)
        style.legend_above(panels[-1], columns=4)
    note = ["Extremes in the legends: whole run, if no time is given."]
    if np.nanmax(traction, initial=0.0) > TRACTION_TOP <= max(axes.get_ylim()[1] for axes in rows[2]):
        note.append(f"Traction demand: not drawn above {TRACTION_TOP:g}, which a wheel with almost no load exceeds.")
    figure.note(*note)
    return figure


def margin_comparison(records: Mapping[str, Record]) -> Figure | None:
    """Overlay the tip margins of all variants; return None if no variant has a mobile base."""
    shown = {name: record for name, record in records.items() if MARGIN in record}
    if not shown:
        return None
    some = list(shown.values())
    title = style.comparison_title(some, "tip margin (1: safest, 0: tips over)")
    figure = style.new_figure(3.4 + len(shown) * style.legend_row() / 72.0, title)
    series = [(record.time, np.maximum(record[MARGIN], MARGIN_LOW)) for record in some]
    (panels,) = style.time_rows(figure, [series], max(record.settle_time for record in some))
    styles = style.variant_styles(list(records))
    for axes in panels:
        for name, record in shown.items():
            style.line(axes, record.time, record[MARGIN], label=_margin_label(name, record), **styles[name])
        _frame_margin(axes)
    style.label_row(panels, "tip margin")
    style.legend_below(figure, panels[-1:], 1)
    return figure


def tracking(record: Record) -> Figure | None:
    """Draw the reference and actual pose of a mobile base and their difference; return None without a reference.

    For a stationary base, only the difference is drawn.
    """
    if not {"base_pose", "base_target"} <= set(record):
        return None
    pose, target = record["base_pose"], record["base_target"]
    error = base_error(record)
    heading = np.degrees(np.stack([target[:, 2], pose[:, 2]], axis=1))
    is_stationary = (
        _spread(np.hstack([target[:, :2], pose[:, :2]])) < MIN_RANGES["position [m]"]
        and _spread(heading) < MIN_RANGES["heading [°]"]
    )
    away, turned = MILLI * error[:, :2], np.degrees(error[:, 2])
    # A hundredth of the smallest range is the smallest number that is printed.
    rms = [style.number(round(_rms(values), 4), 3) for values in (*away.T, turned)]
    curves: dict[str, list[Curve]] = {}
    if not is_stationary:
        # One of the lines is dashed, because x and y may coincide.
        x = _pair(target[:, 0], pose[:, 0], "x", style.AXIS_COLOURS["x"], "-")
        curves["position [m]"] = x + _pair(target[:, 1], pose[:, 1], "y", style.AXIS_COLOURS["y"], (0, (5, 4)))
        curves["heading [°]"] = _pair(heading[:, 0], heading[:, 1], "heading", style.PURPLE, "-")
    curves["error [mm]"] = [
        (away[:, 0], {"color": style.BLUE, "label": f"ahead: rms {rms[0]} mm"}),
        (away[:, 1], {"color": style.GREEN, "linestyle": style.DASHES[1], "label": f"to the left: rms {rms[1]} mm"}),
    ]
    curves["heading error [°]"] = [(turned, {"color": style.PURPLE, "label": f"rms {rms[2]}°"})]
    subject = "stationary base: actual − reference" if is_stationary else "base, reference and actual"
    figure = style.new_figure(0.6 + 1.5 * len(curves), style.title(record, subject))
    series = [[(record.time, values) for values, _ in drawn] for drawn in curves.values()]
    rows = style.time_rows(figure, series, record.settle_time)
    for (name, drawn), panels in zip(curves.items(), rows, strict=True):
        for axes in panels:
            axes.ticklabel_format(axis="y", useOffset=False)
            for curve, look in drawn:
                style.line(axes, record.time, curve, **look)
            style.at_least(axes, 2.0 * MIN_RANGES[name])
            if "error" in name:
                axes.axhline(0.0, color=style.GREY, linewidth=0.6)
        style.label_row(panels, name)
    contacts.mark_all(figure, rows, record)
    for panels in rows:
        style.legend_above(panels[-1], columns=4)
    figure.align_ylabels([panels[0] for panels in rows])
    return figure


def _spread(values: Array) -> float:
    """Return the largest range of any column."""
    known = values[np.isfinite(values).all(axis=1)]
    return float(np.ptp(known, axis=0).max()) if len(known) else 0.0


def base_error(record: Record) -> Array:
    """Return the pose error (actual minus reference) of a base, (T, 3): forward and to the left [m], heading [rad]."""
    target = record["base_target"]
    error = record["base_pose"] - target
    return np.column_stack([_ahead_and_left(error[:, :2], target[:, 2]), error[:, 2]])


def _ahead_and_left(points: Array, heading: Array) -> Array:
    """Return horizontal vectors, (T, 2), in the axes of a base with a heading, () or (T,) [rad]."""
    x, y = points.T
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([c * x + s * y, c * y - s * x], axis=1)


def tipping_times(record: Record) -> list[float]:
    """Return the times at which the base tips over [s], in order."""
    return [event.time for event in record.events if event.kind == TIP_OVER]


def _verdict(record: Record) -> str:
    times = tipping_times(record)
    if not times:
        return "never tips over"
    more = f"{len(times)} times, first " if len(times) > 1 else ""
    settle = record.settle_time
    if record.time[-1] > settle and overturns_settled(record, settle) is None:
        return f"below 0 only at the start, {more}at {style.number(times[0], 3)} s"
    return f"tips over {more}at {style.number(times[0], 3)} s"


def _margin_label(name: str, record: Record) -> str:
    """Return a label with the minimum margin of the whole run and after the start, and whether the base tips."""
    settle = record.settle_time
    whole, late = (_least(record[MARGIN][record.time >= begin]) for begin in (-np.inf, settle))
    # Between samples, the margin may be lower.
    texts = [] if whole > 0.0 and tipping_times(record) else [_limited(whole)]
    if record.time[-1] > settle and (not texts or late > whole):
        texts.append(f"from {settle:g} s on {_limited(late)}")
    return f"{name}: {'min ' * bool(texts)}{', '.join(texts)}{'; ' * bool(texts)}{_verdict(record)}"


def _least(margin: Array) -> float:
    return float(np.nanmin(margin, initial=1.0))


def _limited(margin: float) -> str:
    return style.number(margin, 3) if margin >= MARGIN_LOW else f"below {style.number(MARGIN_LOW)}"


def _lines(axes: Axes, record: Record, signal: str, note: str, extreme: Callable[[Array], Any]) -> None:
    """Draw a line for each column, with its extreme value in the legend."""
    for values, (name, look) in zip(record[signal].T, style.variant_styles(record.labels[signal]).items(), strict=True):
        known = np.isfinite(values).any()
        values = np.where(np.isfinite(values), values, np.nan)
        label = f"{name}: {note.format(style.number(float(extreme(values)), 3))}" if known else f"{name}: no values"
        style.line(axes, record.time, values, label=label, **look)


def _pair(target: Array, actual: Array, name: str, colour: str, dashes: Any) -> list[Curve]:
    """Return the actual values over their reference, which is wide and pale so that both are visible if they agree."""
    return [
        (target, {"color": colour, "linewidth": 4.0, "alpha": 0.3, "label": f"{name}, reference"}),
        (actual, {"color": colour, "linestyle": dashes, "label": f"{name}, actual"}),
    ]


def _frame_margin(axes: Axes) -> None:
    low, high = axes.get_ylim()
    axes.set_ylim(max(min(low, -0.05), MARGIN_LOW), max(high, 0.1))
    style.shade_below_zero(axes, "outside the support triangle")


def _rms(values: Array) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


# View from above: path, arm, elbows, hand and supports; and centre of pressure in the frame of the base.
Rows = NDArray[np.intp]

# Height of the base-frame panel if it is placed below the world panel [inch].
BELOW = 2.6

# Maximum number of support triangles, evenly spaced along the path, and minimum distance between them, relative to
# their size.
TRIANGLES, APART = 6, 0.25
ELBOW_COLOURS = (style.ORANGE, style.GREEN, "#8C6D31")
ARM_ABOVE = "#B8B8B8"
TRIANGLE, INSIDE, OUTSIDE = style.SKY, style.PURPLE, style.PULLING


def top_view(record: Record) -> Figure | None:
    """Draw the run from above in the world, and the centre of pressure in the base frame; return None if no base."""
    body, _ = skeleton(record)
    if len(body.scene.supports) != 3 or not {"base_pose", "center_of_pressure"} <= set(record):
        return None
    rows = np.flatnonzero(np.isfinite(record["base_pose"]).all(axis=1))
    if not len(rows):
        return None
    figure, (low, high) = style.new_figure(0.9, style.title(record, "base from above")), _extent(body, rows)
    world, own = figure.subplots(*((2, 1) if style.narrow() else (1, 2)))
    _draw_world(world, body, rows)
    world.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    _draw_base_frame(own, body, rows)
    for axes in (world, own):
        axes.set_aspect("equal", adjustable="box", anchor="N")
    # Panels of different scales have the same height if they are next to each other.
    shapes = [float(np.ptp(axes.get_ylim()) / np.ptp(axes.get_xlim())) for axes in (world, own)]
    grid: Any = world.get_gridspec()
    if style.narrow():
        heights = [0.6 + (style.width() - 0.9) * shapes[0], BELOW]
        grid.set_height_ratios(heights)
        figure.grow(72.0 * sum(heights))
    else:
        grid.set_width_ratios([1.0 / shape for shape in shapes])
        figure.grow(72.0 * (0.6 + (style.width() - 2.0) / sum(1.0 / shape for shape in shapes)))
    style.legend_below(figure, [world, own], 4)
    figure.note("Circles: centre of pressure at the start (white) and at the end (black).")
    return figure


def support_corners(body: Skeleton, row: int) -> Array:
    """Return the ground contacts of the base: left wheel, right wheel, caster, (3, 2) [m]."""
    return np.array([point_positions(body.record, point, row)[:2] for point in body.scene.supports])


def pressure_in_base(record: Record) -> Array:
    """Return the centre of pressure in the base frame, (T, 2) [m]."""
    pose = record["base_pose"]
    return _ahead_and_left(record["center_of_pressure"] - pose[:, :2], pose[:, 2])


def _extent(body: Skeleton, rows: Rows) -> tuple[Array, Array]:
    """Return the corners of the world panel [m]; a distant centre of pressure may be outside the panel."""
    record = body.record
    points = [record["hand_position"][:, :2]] if "hand_position" in record else []
    if (target := hand_target(record)) is not None:
        points.append(target[:, :2])
    points += [_track(body, point, rows) for point in (*body.scene.contacts, *body.scene.supports)]
    points += [corners[:, :2] for row in rows[[0, -1]] for corners, _ in body.solids(row)]
    return box_about([*points, body.segments(int(rows[-1]))[..., :2]], 0.05)


def _track(body: Skeleton, point: Point, rows: Rows) -> Array:
    """Return the path of a point over the ground, (rows, 2) [m]."""
    return point_positions(body.record, point)[rows, :2]


def _draw_world(axes: Axes, body: Skeleton, rows: Rows) -> None:
    record, scene = body.record, body.scene
    first, last = int(rows[0]), int(rows[-1])
    for row, name, face, dashes in ((first, "start", "none", (0, (3, 2))), (last, "end", "#DDDDDD", "-")):
        look: dict[str, Any] = {"facecolor": face, "linestyle": dashes, "label": f"base at the {name}"}
        solids = (solid[:, :2] for solid, _ in body.solids(row))
        add_outlines(axes, solids, edgecolor=ARM_COLOUR, lw=0.8, zorder=2, **look)
    arm = body.segments(last)[:, :, :2]
    for segment in arm:
        axes.plot(*segment.T, color=ARM_ABOVE, lw=4.0, zorder=3)
    axes.plot([], [], color=ARM_ABOVE, lw=4.0, label="arm at the end")
    apart = APART * float(np.ptp(support_corners(body, first), axis=0).max())
    for row in _rows_along_path(record["base_pose"], rows, apart):
        axes.add_patch(Polygon(support_corners(body, row), facecolor="none", edgecolor=TRIANGLE, lw=0.7, zorder=4))
    axes.plot([], [], color=TRIANGLE, lw=0.7, label="support triangle")
    tracks: Any = (("-", "wheel tracks"), ("-", None), ((0, (1, 1)), "caster track"))
    for point, (dashes, label) in zip(scene.supports, tracks, strict=True):
        track = style.sparse(_track(body, point, rows))
        axes.plot(*track.T, color=style.BLACK, lw=0.9, linestyle=dashes, label=label, zorder=5)
    for k, contact in enumerate(scene.contacts):
        path = style.sparse(_track(body, contact, rows))
        colour = ELBOW_COLOURS[k % len(ELBOW_COLOURS)]
        axes.plot(*path.T, color=colour, lw=1.4, zorder=6, label=contact.name)
        axes.plot(*path[-1], "o", color=colour, markersize=4, zorder=6)
    if (wanted := hand_target(record)) is not None:
        flat = edge_on(wanted[:, :2])
        axes.plot(*flat.T, color=style.BLACK, linestyle=(0, (3, 2)), lw=0.9, zorder=8, label=target_name(record))
    if "hand_position" in record:
        hand = style.sparse(record["hand_position"][:, :2])
        axes.plot(*hand.T, color=style.BLUE, lw=1.0, zorder=7, label="hand path")
    _draw_pressure(axes, body, record["center_of_pressure"])
    axes.set_title("in the world")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def _draw_base_frame(axes: Axes, body: Skeleton, rows: Rows) -> None:
    """Draw the base from above in its own frame, with its heading to the right."""
    record = body.record
    pose = record["base_pose"][rows[-1]]
    parts = [_ahead_and_left(solid[:, :2] - pose[:2], pose[2]) for solid, _ in body.solids(int(rows[-1]))]
    add_outlines(axes, parts, facecolor="#EEEEEE", edgecolor=style.GREY, lw=0.7, zorder=1)
    corners = _ahead_and_left(support_corners(body, int(rows[-1])) - pose[:2], pose[2])
    axes.add_patch(Polygon(corners, facecolor=TRIANGLE, alpha=0.2, lw=0, zorder=2))
    axes.add_patch(Polygon(corners, facecolor="none", edgecolor=TRIANGLE, lw=1.0, zorder=3))
    middle, outer = corners.mean(axis=0), np.concatenate([corners, *parts])
    for point, corner in zip(body.scene.supports, corners, strict=True):
        axes.plot(*corner, "o", color=ARM_COLOUR, markersize=3, zorder=6)
        # Place the label outside of the base, where there is space.
        over = abs(corner[1] - middle[1]) > abs(corner[0] - middle[0])
        side = np.sign(corner - middle)
        edge = np.array([corner[0], side[1] * np.abs(outer[:, 1]).max()] if over else [outer[:, 0].max(), corner[1]])
        look: dict[str, Any] = {"ha": "center", "va": "bottom" if side[1] > 0 else "top"}
        look = look if over else {"ha": "left", "va": "center"}
        axes.annotate(
            point.name,
            tuple(edge),
            xytext=3.0 * (side * [0, 1] if over else side * [1, 0]),
            textcoords="offset points",
            fontsize=style.letters(7.0),
            **look,
        )
    path = pressure_in_base(record)
    _draw_pressure(axes, body, path)
    # The path may be long; only the part within about one length of the base is shown.
    drawn = np.concatenate([corners, *parts])
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    reach = 0.75 * float((high - low).max())
    known = path[np.isfinite(path).all(axis=1)]
    near = known[((known >= low - reach) & (known <= high + reach)).all(axis=1)]
    low, high = box_about([drawn, near], 0.06)
    # The names of the wheels need some space.
    aside = 0.08 * (high[1] - low[1])
    axes.set(xlim=(low[0], high[0]), ylim=(low[1] - aside, high[1] + aside))
    lost = 1.0 - len(near) / max(len(path), 1)
    axes.set_title("in the base frame" + (f"; {100 * lost:.2g} % of the path is outside" if lost > 0.0 else ""))
    axes.set_xlabel("ahead [m]")
    axes.set_ylabel("to the left [m]")


def _draw_pressure(axes: Axes, body: Skeleton, path: Array) -> None:
    """Draw the path of the centre of pressure, (T, 2), in different colours inside and outside the support triangle."""
    corners = np.array([point.position[:2] for point in body.scene.supports])
    at, outside = pressure_pieces(pressure_in_base(body.record), corners)
    points = np.stack([np.interp(at, np.arange(len(path)), column) for column in path.T], axis=1)
    pieces = np.stack([points[:-1], points[1:]], axis=1)
    for those, colour, label in ((~outside, INSIDE, "centre of pressure"), (outside, OUTSIDE, "outside the triangle")):
        if those.any():
            axes.add_collection(
                LineCollection(list(pieces[those]), colors=colour, linewidths=1.1, capstyle="round", zorder=9)
            )
            axes.plot([], [], color=colour, lw=1.1, label=label)
    known = np.flatnonzero(np.isfinite(path).all(axis=1))
    for ends, face in ((known[:1], "white"), (known[-1:], style.BLACK)):
        axes.plot(*path[ends].T, "o", markersize=4, color=style.BLACK, markerfacecolor=face, zorder=10)


def pressure_pieces(path: Array, corners: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Cut a path, (T, 2), where it crosses a side of a triangle, (3, 2).

    Returns
    -------
    at : (m,) ndarray
        Sample indices, with fractions at the cuts.
    outside : (m - 1,) ndarray of bool
        Whether the following piece is outside the triangle.
    """
    kept = np.linspace(0, len(path) - 1, min(len(path), style.LINE_POINTS)).astype(int)
    path, side = path[kept], np.roll(corners, -1, axis=0) - corners
    normal = np.stack([-side[:, 1], side[:, 0]], axis=1)
    normal *= np.sign((normal * (corners.mean(axis=0) - corners)).sum(axis=1))[:, None]
    # Distances from the sides times the lengths of the sides; they are positive inside and linear along each piece.
    distance = ((path[:, None] - corners) * normal).sum(axis=2)
    a, b = distance[:-1], distance[1:]
    row, crossed = np.nonzero(a * b < 0.0)
    share = a[row, crossed] / (a[row, crossed] - b[row, crossed])
    at = np.union1d(np.arange(len(path)), row + share)
    middle = 0.5 * (at[:-1] + at[1:])
    between = np.stack([np.interp(middle, np.arange(len(path)), column) for column in distance.T], axis=1)
    return np.interp(at, np.arange(len(kept)), kept), between.min(axis=1) < 0.0


def _rows_along_path(pose: Array, rows: Rows, apart: float) -> list[int]:
    """Return rows between which the base travels at least ``apart`` [m], including the first and last rows."""
    distance = np.append(0.0, np.cumsum(np.hypot(*np.diff(pose[rows, :2], axis=0).T)))
    count = int(np.clip(distance[-1] / max(apart, 1e-9), 1, TRIANGLES - 1)) + 1
    return [
        int(rows[np.searchsorted(distance, share).clip(max=len(rows) - 1)])
        for share in np.linspace(0.0, distance[-1], count)
    ]
