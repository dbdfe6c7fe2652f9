"""Figure of a mobile base from above: path, arm, elbows and hand, supports, and centre of pressure in its frame."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from dynsim.draw.figures import style
from dynsim.draw.figures.hand import edge_on, target_name
from dynsim.draw.figures.posture import ARM_COLOUR
from dynsim.draw.figures.skeleton import Skeleton, skeleton
from dynsim.draw.figures.style import Array
from dynsim.draw.geometry.shapes import outline
from dynsim.draw.geometry.surfaces import box_about
from dynsim.record import Record
from dynsim.record.measures import hand_target
from dynsim.record.poses import point_positions
from dynsim.record.scene import Point

Rows = NDArray[np.intp]

# Height of the panel in the base's frame where it is placed below that in the world [inch].
BELOW = 2.9

# Most support triangles, at even distances along the path, and their least distance in parts of their size.
TRIANGLES, APART = 6, 0.25
ELBOW_COLOURS = (style.ORANGE, style.GREEN, "#8C6D31")
ARM_ABOVE = "#A8A8A8"
TRIANGLE, INSIDE, OUTSIDE = style.SKY, style.PURPLE, style.PULLING


def top_view(record: Record) -> Figure | None:
    """The run from above in the world, and the pressure centre in the base's frame; None without a mobile base."""
    body, _ = skeleton(record)
    if body is None or len(body.scene.supports) != 3 or not {"base_pose", "center_of_pressure"} <= set(record):
        return None
    rows = np.flatnonzero(np.isfinite(record["base_pose"]).all(axis=1))
    if not len(rows):
        return None
    low, high = _extent(body, rows)
    size = high - low
    wide = size[0] > 1.8 * size[1]
    # In a row of its own the world is as high as its width makes it, with 0.6 inch for its labels.
    above = 0.6 + 6.3 * float(size[1] / size[0])
    height = 0.8 + above + BELOW if wide else 0.9 + float(np.clip(3.9 * size[1] / size[0], 3.3, 6.0))
    figure = style.new_figure(height, style.title(record, "base from above"))
    if wide:
        world, own = figure.subplots(2, 1, height_ratios=[above, BELOW])
    else:
        world, own = figure.subplots(1, 2, width_ratios=[1.25, 1.0])
    _draw_world(world, body, rows)
    world.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    _draw_own(own, body, rows)
    for axes in (world, own):
        axes.set_aspect("equal", adjustable="box", anchor="N")
    style.legend_below(figure, [world, own], 4)
    return figure


def support_corners(body: Skeleton, row: int) -> Array:
    """Where the base stands on the ground: left wheel, right wheel, caster, (3, 2) [m]."""
    return np.array([point_positions(body.record, point, row)[:2] for point in body.scene.supports])


def pressure_in_base(record: Record) -> Array:
    """Centre of pressure in the base's frame, (T, 2) [m]."""
    away = record["center_of_pressure"] - record["base_pose"][:, :2]
    c, s = np.cos(record["base_pose"][:, 2]), np.sin(record["base_pose"][:, 2])
    return np.stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]], axis=1)


def _extent(body: Skeleton, rows: Rows) -> tuple[Array, Array]:
    """Corners of what is drawn of the world [m]; a centre of pressure far away is not in it."""
    record = body.record
    points = [record["hand_position"][:, :2]] if "hand_position" in record else []
    if (target := hand_target(record)) is not None:
        points.append(target[:, :2])
    points += [_track(body, point, rows) for point in (*body.scene.contacts, *body.scene.supports)]
    points += [corners[:, :2] for row in rows[[0, -1]] for corners, _ in body.solids(row)]
    return box_about([*points, body.segments(int(rows[-1]))[..., :2]], 0.05)


def _track(body: Skeleton, point: Point, rows: Rows) -> Array:
    """Way of a point over the ground, (rows, 2) [m]."""
    return point_positions(body.record, point)[rows, :2]


def _draw_world(axes: Axes, body: Skeleton, rows: Rows) -> None:
    record, scene = body.record, body.scene
    first, last = int(rows[0]), int(rows[-1])
    _draw_outline(axes, body, first, facecolor="none", linestyle=(0, (3, 2)), label="base at the start")
    _draw_outline(axes, body, last, facecolor="#DDDDDD", linestyle="-", label="base at the end")
    arm = body.segments(last)[:, :, :2]
    for segment in arm:
        axes.plot(*segment.T, color=ARM_ABOVE, lw=1.6, zorder=3)
    axes.plot([], [], color=ARM_ABOVE, lw=1.6, label="arm at the end")
    for row in _spread(record["base_pose"], rows, APART * float(np.ptp(support_corners(body, first), axis=0).max())):
        axes.add_patch(Polygon(support_corners(body, row), facecolor="none", edgecolor=TRIANGLE, lw=0.7, zorder=4))
    axes.plot([], [], color=TRIANGLE, lw=0.7, label="support triangle")
    looks: tuple[dict[str, Any], ...] = (
        {"color": style.BLACK, "lw": 0.9, "label": "wheel tracks"},
        {"color": style.BLACK, "lw": 0.9},
        {"color": style.BLACK, "lw": 0.9, "linestyle": (0, (1, 1)), "label": "caster track"},
    )
    for point, look in zip(scene.supports, looks, strict=True):
        axes.plot(*style.sparse(_track(body, point, rows)).T, zorder=5, **look)
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


def _draw_own(axes: Axes, body: Skeleton, rows: Rows) -> None:
    """The base from above, in its own frame: ahead is to the right."""
    record = body.record
    x, y, heading = record["base_pose"][rows[-1]]
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    parts = [(solid[:, :2] - [x, y]) @ turn for solid, _ in body.solids(int(rows[-1]))]
    for part in parts:
        axes.add_patch(Polygon(outline(part), facecolor="#EEEEEE", edgecolor=style.GREY, lw=0.7, zorder=1))
    corners = (support_corners(body, int(rows[-1])) - [x, y]) @ turn
    axes.add_patch(Polygon(corners, facecolor=TRIANGLE, alpha=0.2, lw=0, zorder=2))
    axes.add_patch(Polygon(corners, facecolor="none", edgecolor=TRIANGLE, lw=1.0, zorder=3))
    middle = corners.mean(axis=0)
    for point, corner in zip(body.scene.supports, corners, strict=True):
        axes.plot(*corner, "o", color=ARM_COLOUR, markersize=3, zorder=6)
        # Towards the middle, where there is room.
        away = 16.0 * (middle - corner) / np.linalg.norm(middle - corner)
        axes.annotate(
            point.name,
            corner,
            xytext=away,
            textcoords="offset points",
            fontsize=7,
            ha="center",
            va="center",
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.5},
            zorder=11,
        )
    path = pressure_in_base(record)
    _draw_pressure(axes, body, path)
    # The path may go far; what it does within a base's length of the base is in the picture.
    drawn = np.concatenate([corners, *parts])
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    reach = 0.75 * float((high - low).max())
    known = path[np.isfinite(path).all(axis=1)]
    near = known[((known >= low - reach) & (known <= high + reach)).all(axis=1)]
    low, high = box_about([drawn, near], 0.06)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    lost = 1.0 - len(near) / max(len(path), 1)
    axes.set_title("in the base's frame" + (f"; {100 * lost:.2g} % of the path is farther off" if lost > 0.0 else ""))
    axes.set_xlabel("ahead [m]")
    axes.set_ylabel("to the left [m]")


def _draw_outline(axes: Axes, body: Skeleton, row: int, *, label: str, **look: Any) -> None:
    for k, (solid, _) in enumerate(body.solids(row)):
        patch = Polygon(outline(solid[:, :2]), edgecolor=ARM_COLOUR, lw=0.8, zorder=2, **look)
        patch.set_label(label if k == 0 else "_")
        axes.add_patch(patch)


def _draw_pressure(axes: Axes, body: Skeleton, path: Array) -> None:
    """The centre of pressure, (T, 2) in the axes drawn: inside the support triangle, and outside."""
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
    at : (m,) samples, and fractions of samples at which it is cut
    outside : (m - 1,) whether the piece that follows lies outside the triangle
    """
    kept = np.linspace(0, len(path) - 1, min(len(path), style.LINE_POINTS)).astype(int)
    path, side = path[kept], np.roll(corners, -1, axis=0) - corners
    normal = np.stack([-side[:, 1], side[:, 0]], axis=1)
    normal *= np.sign((normal * (corners.mean(axis=0) - corners)).sum(axis=1))[:, None]
    # Distances from the sides, positive inside, by the sides' lengths: linear along each piece.
    distance = ((path[:, None] - corners) * normal).sum(axis=2)
    a, b = distance[:-1], distance[1:]
    row, crossed = np.nonzero(a * b < 0.0)
    share = a[row, crossed] / (a[row, crossed] - b[row, crossed])
    at = np.union1d(np.arange(len(path)), row + share)
    middle = 0.5 * (at[:-1] + at[1:])
    between = np.stack([np.interp(middle, np.arange(len(path)), column) for column in distance.T], axis=1)
    return np.interp(at, np.arange(len(kept)), kept), between.min(axis=1) < 0.0


def _spread(pose: Array, rows: Rows, apart: float) -> list[int]:
    """Rows at which the base has gone on by at least ``apart`` [m], the first and the last among them."""
    distance = np.append(0.0, np.cumsum(np.hypot(*np.diff(pose[rows, :2], axis=0).T)))
    count = int(np.clip(distance[-1] / max(apart, 1e-9), 1, TRIANGLES - 1)) + 1
    return [
        int(rows[np.searchsorted(distance, share).clip(max=len(rows) - 1)])
        for share in np.linspace(0.0, distance[-1], count)
    ]
