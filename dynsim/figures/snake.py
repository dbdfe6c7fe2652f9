"""Figures and animation of a snake run, from its record alone.

Postures in top and side view with grounded and lifted wheels and the support polygon; controlled variable against its
target; joint angles with their limits; cost, smallest singular value, support margin, modes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PatchCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon
from numpy.typing import NDArray
from PIL import Image

from dynsim.record import Record
from dynsim.studies.tanaka2019 import COORDINATES, TABLE_III, displacement, table_iii

# Okabe and Ito's palette: distinct for colour-blind readers.
BODY, HEAD, GROUND, LIFT, TARGET, SUPPORT = "#444444", "#D55E00", "#0072B2", "#FFFFFF", "#009E73", "#56B4E9"
CYCLE = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999"]
STYLE: dict[Any, Any] = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "legend.fontsize": 7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": plt.cycler(color=CYCLE),
    "lines.linewidth": 1.1,
    "axes.xmargin": 0.0,
    "savefig.dpi": 200,
    "figure.constrained_layout.use": True,
}
SYMBOLS = {"alpha": "α", "beta": "β", "gamma": "γ"}
FRAMES = 50


def draw(record: Record, folder: Path) -> list[Path]:
    """Write all figures of one run and the animation into ``folder``; returns the files."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with plt.rc_context(STYLE):
        for name, make in (
            ("postures", postures),
            ("overview", overview),
            ("tracking", tracking),
            ("joints", joints),
            ("redundancy", redundancy),
        ):
            figure = make(record)
            path = folder / f"{name}.png"
            figure.savefig(path)
            plt.close(figure)
            written.append(path)
        written.append(animate(record, folder / "animation.gif"))
    return written


def draw_comparison(records: Mapping[str, Record], folder: Path) -> list[Path]:
    """Variants over each other and their final postures; Table III of [T] where its manoeuvres were run."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    makers = {"comparison": comparison, "final_postures": final_postures}
    written = []
    names = {record.summary.get("scenario") for record in records.values()}
    if names == {"snake_positioning"} and set(records) & set(TABLE_III):
        makers["table_iii"] = positioning
        path = folder / "table_iii.csv"
        path.write_text("\n".join(",".join(row) for row in table_iii(records)) + "\n", encoding="utf-8")
        written.append(path)
    with plt.rc_context(STYLE):
        for name, make in makers.items():
            figure = make(records)
            path = folder / f"{name}.png"
            figure.savefig(path)
            plt.close(figure)
            written.append(path)
    return written


def comparison(records: Mapping[str, Record]) -> Figure:
    """Cost, largest joint angle in parts of its limit, support margin and head error of all variants."""
    figure, axes = plt.subplots(4, 1, figsize=(7.2, 7.0), sharex=True)
    for name, record in records.items():
        upper = np.array(record.provenance["snake"]["upper_rad"])
        axes[0].plot(record.time, record["cost"], label=name)
        axes[1].plot(record.time, np.abs(record["phi"] / upper).max(axis=1), label=name)
        axes[2].plot(record.time, 1e3 * record["support_margin"], label=name)
        axes[3].semilogy(record.time, np.maximum(record["position_error"], 1e-16), label=name)
    axes[1].axhline(1.0, color="black", ls="-.", lw=0.8)
    axes[2].axhline(0.0, color="black", ls="-.", lw=0.8)
    axes[0].set_ylim(bottom=0)
    for axis, label in zip(
        axes, ("cost V", "largest |φ| / limit", "support margin [mm]", "position error [m]"), strict=True
    ):
        axis.set_ylabel(label)
    axes[0].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    axes[-1].set_xlabel("t [s]")
    return figure


def final_postures(records: Mapping[str, Record]) -> Figure:
    """Initial posture and the final one of every variant, top view."""
    first = next(iter(records.values()))
    views = {"start": _View(first, 0)} | {name: _View(r, len(r.time) - 1) for name, r in records.items()}
    x0, x1, y0, y1 = _limits([view.outline() for view in views.values()], 0.06)
    columns = min(4, len(views))
    lines = -(-len(views) // columns)
    size = 8.0 / columns
    height = max(size * (y1 - y0) / (x1 - x0), 0.35 * size) + 0.45
    figure, axes = plt.subplots(
        lines, columns, figsize=(8.0, lines * height + 0.5), squeeze=False, sharex=True, sharey=True
    )
    for axis in axes.ravel()[len(views) :]:
        axis.set_visible(False)
    for axis, (name, view) in zip(axes.ravel(), views.items(), strict=False):
        view.draw_top(axis)
        axis.set(xlim=(x0, x1), ylim=(y0, y1), title=f"{name}, mode {view.mode}")
        axis.set_aspect("equal", adjustable="box")
    figure.supxlabel("x [m]", fontsize=8)
    figure.supylabel("y [m]", fontsize=8)
    figure.legend(handles=_legend(), loc="outside upper center", ncols=6, frameon=False)
    return figure


def positioning(records: Mapping[str, Record]) -> Figure:
    """Table III of [T]: deviation from the target displacement, measured there and simulated here."""
    moved = [name for name in TABLE_III if name in records]
    figure, axes = plt.subplots(2, 1, figsize=(7.2, 4.4), sharex=True)
    width = 0.8 / 3
    for axis, part, unit in ((axes[0], range(3), "mm"), (axes[1], range(3, 6), "rad")):
        scale = 1e3 if unit == "mm" else 1.0
        for k, i in enumerate(part):
            place = np.arange(len(moved)) + (k - 1) * width
            published = [TABLE_III[m] for m in moved]
            off = [scale * (p.mean[i] - p.target[i]) for p in published]
            spread = [scale * p.deviation[i] for p in published]
            name = SYMBOLS.get(COORDINATES[i], COORDINATES[i])
            axis.bar(place, off, 0.9 * width, yerr=spread, capsize=2, color=CYCLE[k], alpha=0.6, label=f"Δ{name}, [T]")
            ours = [scale * (displacement(records[m])[i] - TABLE_III[m].target[i]) for m in moved]
            axis.plot(place, ours, "D", color="black", ms=3, label="simulated, no slip" if k == 2 else None)
        axis.axhline(0.0, color="black", lw=0.6)
        axis.set_ylabel(f"off target [{unit}]")
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    axes[1].set_xticks(range(len(moved)), [f"moving {SYMBOLS.get(m, m)}" for m in moved])
    axes[1].set_xlim(-0.6, len(moved) - 0.4)
    return figure


def postures(record: Record, count: int = 6) -> Figure:
    """Strip of postures: top view above, side view along the base's heading below."""
    rows = _moments(record, count)
    views = [_View(record, row) for row in rows]
    top = _limits([view.outline() for view in views], 0.08)
    side = _limits([np.vstack([view.side, view.side * [1, 0]]) for view in views], 0.08)
    tall, low = top[3] - top[2], side[3] - side[2]
    width = 9.0
    column = width / len(rows)
    height = column * (tall / (top[1] - top[0]) + low / (side[1] - side[0])) + 1.1
    figure, axes = plt.subplots(
        2, len(rows), figsize=(width, max(height, 2.6)), squeeze=False, height_ratios=[tall, max(low, 0.35 * tall)]
    )
    for view, above, below in zip(views, *axes, strict=True):
        view.draw_top(above)
        view.draw_side(below)
        above.set(xlim=top[:2], ylim=top[2:], title=f"t = {view.time:.1f} s, mode {view.mode}")
        below.set(xlim=side[:2], ylim=(min(side[2], -0.02), side[3]))
        for axis in (above, below):
            axis.set_aspect("equal", adjustable="box")
            if axis is not axes[0, 0] and axis is not axes[1, 0]:
                axis.tick_params(labelleft=False)
            axis.tick_params(axis="x", labelrotation=45)
    axes[0, 0].set(ylabel="y [m]")
    axes[1, 0].set(ylabel="height [m]")
    figure.supxlabel("above: x [m]; below: along the heading of the base part [m]", fontsize=8)
    figure.legend(handles=_legend(), loc="outside upper center", ncols=6, frameon=False)
    return figure


def overview(record: Record, count: int = 7) -> Figure:
    """Top view of the whole run in one picture: postures over time, path of the controlled point and its target."""
    figure, axis = plt.subplots(figsize=(5.2, 4.2))
    rows = _moments(record, count)
    colour = plt.get_cmap("viridis")
    for row in rows:
        shade = colour(0.9 * record.time[row] / max(record.time[-1], 1e-9))
        points = record["posture"][row]
        axis.plot(points[:, 0], points[:, 1], "-", color=shade, lw=2.2, solid_capstyle="round")
        axis.plot(*points[0, :2], "o", color=shade, ms=4)
        # Runs that return put several labels on one spot: spread them over the directions.
        turn = 2 * np.pi * list(rows).index(row) / len(rows)
        axis.annotate(
            f"{record.time[row]:.0f} s",
            points[0, :2],
            xytext=(14 * np.cos(turn), 14 * np.sin(turn)),
            textcoords="offset points",
            ha="center",
            va="center",
            color=shade,
            fontsize=7,
        )
    axis.plot(*record["w"][:, :2].T, color=HEAD, lw=1.0, label="controlled point")
    axis.plot(*record["w_target"][:, :2].T, "--", color=TARGET, lw=1.0, label="target")
    axis.plot(*record["base_pose"][:, :2].T, color=GROUND, lw=0.8, label="wheel pair 1")
    axis.set(xlabel="x [m]", ylabel="y [m]")
    axis.set_aspect("equal", adjustable="datalim")
    axis.legend(loc="best", frameon=False)
    return figure


def tracking(record: Record) -> Figure:
    """Six coordinates of the controlled point with their targets, and the errors."""
    figure, axes = plt.subplots(4, 2, figsize=(7.2, 6.0), sharex=True)
    labels = record.labels["w"]
    for i, (name, axis) in enumerate(zip(labels, axes[:3].T.ravel(), strict=True)):
        axis.plot(record.time, record["w"][:, i], color=GROUND, label="controlled point")
        axis.plot(record.time, record["w_target"][:, i], "--", color=HEAD, lw=0.9, label="target")
        _relax(axis, 1e-3)
        axis.set_ylabel(f"{SYMBOLS.get(name, name)} [{'m' if i < 3 else 'rad'}]")
    axes[0, 0].legend(frameon=False)
    tiny = 1e-16  # an error of exactly zero has no place on a logarithmic axis
    axes[3, 0].semilogy(record.time, np.maximum(record["position_error"], tiny), color=BODY)
    axes[3, 0].set_ylabel("position error [m]")
    axes[3, 1].semilogy(record.time, np.maximum(record["attitude_error"], tiny), color=BODY)
    axes[3, 1].set_ylabel("attitude error [rad]")
    for axis in axes[3]:
        axis.set_xlabel("t [s]")
    return figure


def joints(record: Record) -> Figure:
    """Joint angles of head and base part with their limits; marks show where a joint left the allocation."""
    geometry = record.provenance["snake"]
    n_h, pitch = geometry["head_joints"], np.array(geometry["pitch"])
    upper, lower = np.array(geometry["upper_rad"]), np.array(geometry["lower_rad"])
    phi, labels = record["phi"], record.labels["phi"]
    parts = [
        ("head yaw", np.flatnonzero(~pitch[:n_h])),
        ("head pitch", np.flatnonzero(pitch[:n_h])),
        ("base yaw", np.arange(n_h, len(labels))),
    ]
    figure, axes = plt.subplots(3, 1, figsize=(7.2, 5.6), sharex=True)
    for axis, (title, group) in zip(axes, parts, strict=True):
        for j in group:
            (line,) = axis.plot(record.time, phi[:, j], label=_greek(labels[j]))
            out = record["at_limit"][:, j] > 0
            axis.plot(record.time[out], phi[out, j], ".", color=line.get_color(), ms=3)
        for limit in {*upper[group], *lower[group]}:
            axis.axhline(limit, color="black", ls="-.", lw=0.8)
        axis.set_ylabel(f"{title} [rad]")
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    axes[-1].set_xlabel("t [s]      (dash-dotted: limits; dots: joint out of the allocation at its limit)")
    return figure


def redundancy(record: Record) -> Figure:
    """Modes (grounded wheels), cost, smallest singular value and support margin over time."""
    figure, axes = plt.subplots(4, 1, figsize=(7.2, 6.4), sharex=True, height_ratios=[1.3, 1, 1, 1])
    _mode_chart(axes[0], record)
    axes[1].plot(record.time, record["cost"], color=GROUND)
    axes[1].set_ylabel("cost V")
    axes[1].set_ylim(bottom=0)
    axes[2].plot(record.time, record["sigma_min"], color=GROUND)
    axes[2].set_ylabel("σ_min of B̃")
    axes[2].set_ylim(bottom=0)
    axes[3].plot(record.time, 1e3 * record["support_margin"], color=GROUND)
    axes[3].axhline(0.0, color=HEAD, ls="-.", lw=0.8)
    axes[3].set_ylabel("support margin [mm]")
    axes[3].set_ylim(bottom=min(0.0, 1e3 * float(record["support_margin"].min())) - 4)
    axes[3].set_xlabel("t [s]      (margin below zero: the robot tips)")
    return figure


def animate(record: Record, path: Path, frames: int | None = None) -> Path:
    """Animated GIF: top view and side view with grounded and lifted wheels."""
    rows = _moments(record, frames or FRAMES)
    views = [_View(record, row) for row in rows]
    top = _limits([view.outline() for view in views], 0.08)
    side = _limits([np.vstack([view.side, view.side * [1, 0]]) for view in views], 0.08)
    with plt.rc_context({"figure.constrained_layout.use": False, "font.size": 8}):
        figure, (above, below) = plt.subplots(2, 1, figsize=(4.8, 4.8), dpi=90, height_ratios=[2.2, 1])
        canvas = FigureCanvasAgg(figure)
        figure.subplots_adjust(left=0.12, right=0.97, top=0.93, bottom=0.1, hspace=0.3)

        above.set(xlim=top[:2], ylim=top[2:], xlabel="x [m]", ylabel="y [m]")
        below.set(xlim=side[:2], ylim=(min(side[2], -0.02), side[3]), ylabel="height [m]")
        below.set_xlabel("along the heading of the base part [m]")
        for axis in (above, below):
            axis.set_aspect("equal", adjustable="box")
        above.plot(*record["w_target"][:, :2].T, "--", color=TARGET, lw=0.7)
        canvas.draw()  # axes and target once; every frame adds only the robot
        background = canvas.copy_from_bbox(figure.bbox)
        images = []
        for view in views:
            drawn = [*view.draw_top(above), *view.draw_side(below)]
            drawn += above.plot(*record["w"][: view.row + 1, :2].T, color=HEAD, lw=0.8, zorder=2)
            drawn.append(above.set_title(f"t = {view.time:.1f} s, mode {view.mode}"))
            canvas.restore_region(background)
            for artist in sorted(drawn, key=lambda a: a.get_zorder()):
                figure.draw_artist(artist)
            image = Image.frombuffer("RGBA", canvas.get_width_height(), canvas.buffer_rgba(), "raw", "RGBA", 0, 1)
            images.append(image.convert("RGB").quantize(32, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE))
            for artist in drawn[:-1]:
                artist.remove()
        images[0].save(path, save_all=True, append_images=images[1:], duration=100, loop=0)
        plt.close(figure)
    return path


class _View:
    """One posture, ready to be drawn."""

    def __init__(self, record: Record, row: int) -> None:
        geometry = record.provenance["snake"]
        self.row, self.time, self.mode = row, float(record.time[row]), int(record["mode"][row])
        self.points: NDArray[np.float64] = record["posture"][row]
        self.centre = record["centre_of_mass"][row]
        self.grounded = record["grounded"][row].astype(bool)
        self.radius = geometry["wheel_radius_m"]
        half = np.array(geometry["half_track_m"])
        n_h = geometry["head_joints"]
        self.axles = self.points[n_h::2]
        x, y, yaw = record["base_pose"][row]
        headings = yaw + np.concatenate([[0.0], np.cumsum(record["phi"][row, n_h:])])
        self.along = np.stack([np.cos(headings), np.sin(headings)], axis=1)
        self.across = np.stack([-np.sin(headings), np.cos(headings)], axis=1) * half[:, None]
        self.driven = np.array(geometry["driven_side"])
        # Side view: along the heading of the base part, from wheel pair 1.
        forward = np.array([np.cos(yaw), np.sin(yaw)])
        self.side = np.stack([(self.points[:, :2] - [x, y]) @ forward, self.points[:, 2]], axis=1)

    def outline(self) -> NDArray[np.float64]:
        """Everything that a top view must show, (k, 2)."""
        wheels = [self.axles[:, :2] + s * self.across + f * self.radius * self.along for s in (-1, 1) for f in (-1, 1)]
        return np.vstack([self.points[:, :2], *wheels])

    def support(self) -> NDArray[np.float64]:
        """Corners of the support polygon, (k, 2)."""
        from scipy.spatial import ConvexHull, QhullError

        down = self.grounded
        feet = np.vstack([self.axles[down, :2] + s * self.across[down] for s in (-1, 1)])
        try:
            return feet[ConvexHull(feet).vertices]
        except (QhullError, ValueError):
            return feet  # fewer than three contacts: no polygon

    def draw_top(self, axis: Axes) -> list[Artist]:
        drawn: list[Artist] = [
            axis.add_patch(Polygon(self.support(), color=SUPPORT, alpha=0.25, lw=0, zorder=1)),
            *axis.plot(*self.points[:, :2].T, "-", color=BODY, lw=1.8, zorder=3, solid_capstyle="round"),
            *axis.plot(*self.points[0, :2], "o", color=HEAD, ms=4, zorder=5),
            *axis.plot(*self.centre[:2], "x", color="black", ms=4, mew=1.0, zorder=6),
        ]
        for down in (True, False):
            corners = []
            for i in np.flatnonzero(self.grounded == down):
                length = self.radius * self.along[i]
                width = 0.24 * self.radius * self.across[i] / np.linalg.norm(self.across[i])
                for s in (-1, 1):
                    middle = self.axles[i, :2] + s * self.across[i]
                    corners.append([middle + f * length + g * width for f, g in ((1, 1), (1, -1), (-1, -1), (-1, 1))])
            face = GROUND if down else LIFT
            wheels = PolyCollection(corners, facecolors=face, edgecolors=GROUND, linewidths=0.7, zorder=4)
            drawn.append(axis.add_collection(wheels, autolim=False))
        return drawn

    def draw_side(self, axis: Axes) -> list[Artist]:
        drawn: list[Artist] = [
            axis.axhline(0.0, color="#BBBBBB", lw=0.8, zorder=0),
            *axis.plot(*self.side.T, "-", color=BODY, lw=1.8, zorder=3, solid_capstyle="round"),
            *axis.plot(*self.side[0], "o", color=HEAD, ms=4, zorder=5),
        ]
        n_h = len(self.points) - 2 * len(self.axles) + 1
        for down in (True, False):
            # A lifted pair is drawn a little above the ground: the model has no height for it ([T] II.A).
            raised = 0.0 if down else 0.35 * self.radius
            wheels = [
                Circle((self.side[n_h + 2 * i, 0], self.side[n_h + 2 * i, 1] + raised), self.radius)
                for i in np.flatnonzero(self.grounded == down)
            ]
            face = GROUND if down else LIFT
            collection = PatchCollection(wheels, facecolors=face, edgecolors=GROUND, linewidths=0.7, zorder=2)
            drawn.append(axis.add_collection(collection, autolim=False))
        return drawn


def _mode_chart(axis: Axes, record: Record) -> None:
    """Grounded (filled) and lifted (white) wheel pairs over time, with the mode numbers."""
    grounded, time, mode = record["grounded"], record.time, record["mode"]
    starts = np.flatnonzero(np.diff(mode, prepend=mode[0] - 1))
    ends = np.append(starts[1:], len(time) - 1)
    for start, end in zip(starts, ends, strict=True):
        for i in range(grounded.shape[1]):
            axis.broken_barh(
                [(time[start], time[end] - time[start])],
                (i + 0.6, 0.8),
                facecolors=GROUND if grounded[start, i] else LIFT,
                edgecolors="white",
                linewidth=0.4,
            )
        if len(starts) <= 30:
            axis.text((time[start] + time[end]) / 2, 0.2, str(mode[start]), ha="center", va="center", fontsize=7)
    axis.set_ylim(grounded.shape[1] + 0.6, -0.2)
    axis.set_yticks(range(1, grounded.shape[1] + 1))
    axis.set_ylabel("wheel pair")
    axis.set_title("mode, and the wheel pairs on the ground (blue) or lifted (white)", loc="left")


def _moments(record: Record, count: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, len(record.time) - 1, min(count, len(record.time))).round().astype(np.int64))


def _limits(clouds: list[NDArray[np.float64]], margin: float) -> tuple[float, float, float, float]:
    points = np.vstack(clouds)
    (x0, y0), (x1, y1) = points.min(axis=0) - margin, points.max(axis=0) + margin
    return float(x0), float(x1), float(y0), float(y1)


def _relax(axis: Axes, least: float) -> None:
    """Do not blow a constant up to rounding noise."""
    low, high = axis.get_ylim()
    if high - low < 2 * least:
        middle = (low + high) / 2
        axis.set_ylim(middle - least, middle + least)


def _greek(name: str) -> str:
    return name.replace("theta", "θ").replace("psi", "ψ")


def _legend() -> list[Any]:
    return [
        Line2D([], [], color=HEAD, marker="o", ls="", ms=4, label="controlled point"),
        Line2D([], [], color=BODY, lw=1.8, label="body"),
        Patch(facecolor=GROUND, edgecolor=GROUND, label="wheel on the ground"),
        Patch(facecolor=LIFT, edgecolor=GROUND, label="wheel lifted"),
        Patch(facecolor=SUPPORT, alpha=0.25, label="support polygon"),
        Line2D([], [], color="black", marker="x", ls="", ms=4, label="centre of mass"),
    ]
