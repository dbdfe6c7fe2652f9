"""The diagrams of docs/theory/: ``PYTHONPATH=tests python -m studies.diagrams`` writes docs/images/*.svg.

Poses, axes and forces come from a model and from the laws; they are not drawn by hand.
"""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Polygon, Rectangle

from dynsim.compile.model import Model
from dynsim.draw.figures.style import BLUE, GREEN, GREY, ORANGE, PULLING
from dynsim.model.description import Array, Inertia, Link, Robot

FOLDER = Path(__file__).parents[2] / "docs" / "images"
AXES = (PULLING, GREEN, BLUE)
"""Colours of x, y and z."""
MU = 0.5
MOUNT = np.array([0.3, 0.1, 0.3])
"""Position of the arm in the world [m]."""


def arm() -> Model:
    """Return an arm with a yaw joint at the base and three pitch joints; the third joint is an elbow on the floor."""
    body = Inertia(1.0, np.zeros(3), np.eye(3))
    lengths = (0.0, 0.5, 0.5, 0.4)
    axes = [np.array([0.0, 0.0, 1.0]), *[np.array([0.0, 1.0, 0.0])] * 3]
    places = [MOUNT, *(np.array([0.0, 0.0, length]) for length in lengths[:-1])]
    links = tuple(
        Link(f"link_{i + 1}", f"joint_{i + 1}", f"link_{i}" if i else None, "revolute", axis, body, p_PJ=end)
        for i, (axis, end) in enumerate(zip(axes, places, strict=True))
    )
    return Model(Robot("arm", links, (), ("link_4", np.array([0.0, 0.0, lengths[-1]]))))


def frames() -> Figure:
    """Draw world, bodies and joint axes of an arm in a posture, and the rotation of one joint."""
    figure = Figure(figsize=(9.0, 3.4))
    _posture(figure.add_axes((-0.06, -0.3, 0.72, 1.6), projection="3d", proj_type="ortho", computed_zorder=False))
    _one_joint(figure.add_axes((0.62, 0.02, 0.37, 0.96)))
    return figure


def _posture(ax: Axes) -> None:
    model = arm()
    # The elbow, the third joint, is 0.3 m below the first: cos of the upper link is −0.6.
    down = math.acos(-0.6)
    q = np.array([math.radians(25.0), down, -math.radians(80.0), math.radians(60.0)])
    points = [*model.joint_positions(q), model.point_position("link_4", model.robot.hand[1], q)]
    points = np.array([MOUNT * [1.0, 1.0, 0.0], *points])
    floor = np.array([[-0.15, -0.3, 0.0], [1.45, -0.3, 0.0], [1.45, 0.75, 0.0], [-0.15, 0.75, 0.0]])
    ax.plot_trisurf(*floor.T, triangles=[[0, 1, 2], [0, 2, 3]], color="#EEF2F5", zorder=0, shade=False)
    ax.plot(*points.T, color=GREY, linewidth=5, solid_capstyle="round", alpha=0.55, zorder=2)
    _frame(ax, np.zeros(3), np.eye(3), 0.28, "W")
    for i, link in enumerate(model.robot.links):
        R, p = model.body_pose(link.name, q)
        _frame(ax, p, R, 0.15, "")
        axis = R @ link.axis
        ends = np.array([p - 0.17 * axis, p + 0.27 * axis])
        ax.plot(*ends.T, color="black", linewidth=1.0, linestyle=(0, (4, 2)), zorder=4)
        ax.text(*(p + 0.31 * axis + [0.0, 0.0, 0.02 if i else 0.03]), f"$q_{i + 1}$", fontsize=10, zorder=6)
    elbow, hand = points[3], points[-1]
    ax.plot(*elbow, "o", color=ORANGE, markersize=8, zorder=7)
    ax.text(*(elbow + np.array([0.02, -0.05, -0.13])), "elbow: contact point", fontsize=8.5, color="#8A5A00", zorder=7)
    ax.plot(*hand, "s", color="black", markersize=6, zorder=7)
    ax.text(*(hand + np.array([0.04, 0.0, 0.0])), "hand", fontsize=8.5, zorder=7)
    ax.text(*(0.5 * (points[2] + points[3]) + [-0.04, 0.0, -0.1]), "link_2", fontsize=8, color="#555555", zorder=7)
    ax.set_axis_off()
    ax.view_init(elev=22, azim=-62)
    ax.set(xlim=(-0.15, 1.45), ylim=(-0.3, 0.75), zlim=(0.0, 0.6))
    ax.set_box_aspect((1.6, 1.05, 0.6), zoom=1.0)


def _frame(ax: Axes, p: Array, R: Array, size: float, name: str) -> None:
    for k, letter in enumerate("xyz"):
        ends = np.array([p, p + size * R[:, k]])
        ax.plot(*ends.T, color=AXES[k], linewidth=2.0, zorder=5)
        if name:
            ax.text(*(p + 1.15 * size * R[:, k]), letter, color=AXES[k], fontsize=10, zorder=6)
    if name:
        ax.text(*(p - 0.22 * size * (R[:, 0] + R[:, 1])), name, fontsize=11, fontweight="bold", zorder=6)


def _one_joint(ax: Axes) -> None:
    """Draw the parent's frame P, the joint's frame J in it, and the body's frame B after a turn by q about axis a."""
    turn, q = math.radians(20.0), math.radians(50.0)
    P, J = np.array([0.0, 0.0]), np.array([1.5, 0.9])
    _flat_frame(ax, P, 0.0, "P", 0.62)
    _flat_frame(ax, J, turn, "J", 0.62, faint=True)
    _flat_frame(ax, J, turn + q, "B", 0.62)
    ax.annotate("", J, P, arrowprops={"arrowstyle": "-|>", "color": "black", "shrinkA": 0, "shrinkB": 4})
    ax.text(0.78, 0.28, r"$p_{PJ},\ R_{PJ}$", fontsize=11)
    ax.add_patch(Arc(J, 1.7, 1.7, theta1=math.degrees(turn), theta2=math.degrees(turn + q), color="black"))
    middle = turn + 0.5 * q
    ax.text(J[0] + 0.94 * math.cos(middle), J[1] + 0.94 * math.sin(middle), r"$q > 0$", fontsize=11)
    ax.plot(*J, "o", markersize=9, color="white", markeredgecolor="black", zorder=6)
    ax.plot(*J, ".", markersize=4, color="black", zorder=7)
    ax.text(J[0] + 0.12, J[1] - 0.18, "axis a, towards the reader:\nright-handed", fontsize=8.5, va="top")
    ax.set(xlim=(-0.35, 3.4), ylim=(-0.5, 2.1), aspect="equal")
    ax.set_axis_off()


def _flat_frame(ax: Axes, p: Array, angle: float, name: str, size: float, faint: bool = False) -> None:
    """Draw a frame whose third axis points at the reader: x and z of the arm's links."""
    for k, letter in enumerate("xy"):
        tip = p + size * np.array([math.cos(angle + k * math.pi / 2), math.sin(angle + k * math.pi / 2)])
        look = {"arrowstyle": "-|>", "color": AXES[k], "linewidth": 1.8, "shrinkA": 0, "shrinkB": 0}
        ax.annotate("", tip, p, arrowprops={**look, "alpha": 0.35 if faint else 1.0})
        ax.text(*(p + 1.18 * (tip - p)), f"${letter}_{name}$", color=AXES[k], fontsize=10, ha="center", va="center")


def contact_modes() -> Figure:
    """Draw the modes of a contact with their forces."""
    figure = Figure(figsize=(9.0, 5.2), layout="constrained")
    grid = figure.subplots(2, 3)
    panels = (
        ("open", "gap > 0: no force", 0.45, None, (0.55, -0.35)),
        ("sticks", r"$v_t = 0$,  $|f_t| \leq \mu_s f_n$", 0.0, (0.26, 1.1), None),
        ("slides", r"$f_t = -\mu f_n\, v_t/|v_t|$: on the cone's edge", 0.0, (-MU * 1.0, 1.0), (0.75, 0.0)),
        ("lifts off", r"where $f_n$ reaches 0: an event", 0.0, (0.0, 0.0), (0.25, 0.5)),
        (
            "lands",
            "where the gap reaches 0: an impact,\nwith its impulse P in the cone",
            0.0,
            (-0.2, 1.0),
            (0.45, -0.6),
        ),
        ("glued (bilateral law)", r"gap = 0 always; $f_n < 0$: the surface pulls", 0.0, (-MU * 0.7, -0.7), (0.75, 0.0)),
    )
    for ax, (name, text, gap, force, velocity) in zip(grid.flat, panels, strict=True):
        _contact(ax, gap, force, velocity, cone=name in ("sticks", "slides", "lands"))
        ax.set_title(name, fontsize=10, fontweight="bold")
        ax.text(0.0, -0.5 if force is None or force[1] >= 0.0 else -1.0, text, ha="center", va="top", fontsize=9)
    grid[0, 0].annotate("", (-0.62, 0.0), (-0.62, 0.45), arrowprops={"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0})
    grid[0, 0].text(-0.68, 0.22, "gap", ha="right", va="center", fontsize=9)
    grid[0, 0].text(-0.8, -0.2, r"surface $C(r) = 0$", ha="center", va="center", fontsize=8.5)
    return figure


def _contact(ax: Axes, gap: float, force: tuple[float, float] | None, velocity: Array | None, cone: bool) -> None:
    p = np.array([0.0, gap])
    ax.add_patch(Rectangle((-1.6, -0.42), 3.2, 0.42, color="#DDE3E8", zorder=0))
    ax.plot([-1.6, 1.6], [0.0, 0.0], color=GREY, linewidth=1.5)
    if cone:
        edges = np.array([[0.0, 0.0], [-MU * 1.45, 1.45], [MU * 1.45, 1.45]])
        ax.add_patch(Polygon(edges, closed=True, color=BLUE, alpha=0.12, linewidth=0))
        ax.text(-0.5, 1.5, "cone", color=BLUE, fontsize=8.5, ha="center", va="bottom")
    ax.plot([-0.9, 0.0], [1.1 + gap, gap], color=GREY, linewidth=6, alpha=0.5, solid_capstyle="round", zorder=1)
    ax.annotate("", (1.25, 0.75), (1.25, 0.0), arrowprops={"arrowstyle": "-|>", "shrinkA": 0, "shrinkB": 0})
    ax.text(1.33, 0.6, "n", fontsize=10)
    if force is not None and any(force):
        _arrow(ax, p, force, PULLING, "P" if cone and velocity is not None and velocity[1] < 0.0 else "f")
    if velocity is not None and cone and velocity[1] < 0.0:  # velocity before the impact
        _arrow(ax, p - np.asarray(velocity) * 1.6, np.asarray(velocity) * 1.5, GREEN, "")
        ax.text(*(p - np.asarray(velocity) * 1.6 + [-0.05, 0.15]), r"$\dot r$", color=GREEN, fontsize=11, ha="center")
    elif velocity is not None:
        _arrow(ax, p, velocity, GREEN, "" if velocity[1] == 0.0 else r"$\dot r$")
        if velocity[1] == 0.0:
            ax.text(*(p + velocity + [0.0, 0.13]), r"$v_t$", color=GREEN, fontsize=11, ha="center")
    ax.plot(*p, "o", color=ORANGE, markersize=8, zorder=6)
    ax.set(xlim=(-1.6, 1.6), ylim=(-1.25, 1.75), aspect="equal")
    ax.set_axis_off()


def _arrow(ax: Axes, p: Array, vector: Array, colour: str, name: str) -> None:
    tip = p + np.asarray(vector)
    look = {"arrowstyle": "-|>", "color": colour, "linewidth": 2.2, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 13}
    ax.annotate("", tip, p, arrowprops=look, zorder=5)
    aside = np.asarray(vector) / np.linalg.norm(vector)
    ax.text(*(tip + 0.17 * aside), name, color=colour, fontsize=11, ha="center", va="center")


def mobile_base() -> Figure:
    """Draw the base from above, with its coordinates, rates and margin."""
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    ax = figure.add_subplot()
    psi, track, radius, caster = math.radians(25.0), 1.2, 0.3, 1.1
    R = np.array([[math.cos(psi), -math.sin(psi)], [math.sin(psi), math.cos(psi)]])
    middle = np.array([1.1, 0.9])
    left, right, front = (middle + R @ np.array(p) for p in ((0.0, track / 2), (0.0, -track / 2), (caster, 0.0)))
    ax.add_patch(Polygon([left, right, front], closed=True, color=BLUE, alpha=0.12, linewidth=0))
    for wheel in (left, right):
        corners = [wheel + R @ np.array([x * radius, y * 0.07]) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        ax.add_patch(Polygon(corners, closed=True, color=GREY))
    ax.plot(*np.array([left, right]).T, color=GREY, linewidth=2)
    ax.plot(*front, "o", color="white", markeredgecolor=GREY, markersize=9, markeredgewidth=2)
    ax.text(*(front + np.array([0.1, 0.02])), "caster", fontsize=9)
    ax.text(*(left + np.array([-0.1, 0.36])), r"left wheel: $\varphi_l$, radius r", fontsize=9, ha="center")
    ax.text(*(right + R @ np.array([0.25, -0.27])), r"right wheel: $\varphi_r$", fontsize=9, ha="left")
    _arrow(ax, middle, R @ np.array([0.62, 0.0]), GREEN, "V")
    bend = {"arrowstyle": "-|>", "color": GREEN, "linewidth": 1.8, "connectionstyle": "arc3,rad=0.6"}
    ax.annotate("", middle + R @ np.array([-0.14, -0.24]), middle + R @ np.array([-0.14, 0.24]), arrowprops=bend)
    ax.text(*(middle + R @ np.array([-0.38, 0.0])), r"$\omega$", color=GREEN, fontsize=12, ha="center", va="center")
    ax.plot([middle[0], middle[0] + 0.95], [middle[1]] * 2, color="black", linewidth=0.8, linestyle="--")
    ax.add_patch(Arc(middle, 1.5, 1.5, theta1=0, theta2=math.degrees(psi)))
    ax.text(middle[0] + 0.8, middle[1] + 0.13, r"$\psi$", fontsize=11)
    ends = np.array([left, right]) + R @ np.array([-0.5, 0.0])
    ax.annotate("", ends[0], ends[1], arrowprops={"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0})
    ax.text(*(ends.mean(axis=0) + R @ np.array([-0.1, 0.0])), "T", fontsize=11, ha="center", va="center")
    centre = middle + R @ np.array([0.3, 0.12])
    ax.plot(*centre, "x", color=PULLING, markersize=8, markeredgewidth=2)
    ax.annotate(
        "centre of pressure:\nits distance to the nearest side,\nby the inradius, is the tip margin",
        centre, (1.9, 1.85), fontsize=8.5, color=PULLING,
        arrowprops={"arrowstyle": "-", "color": PULLING, "linewidth": 0.8},
    )  # fmt: skip
    for k, (letter, along) in enumerate((("x", (1.0, 0.0)), ("y", (0.0, 1.0)))):
        _arrow(ax, np.zeros(2), 0.45 * np.array(along), AXES[k], letter)
    ax.text(-0.12, -0.14, "W", fontsize=11, fontweight="bold")
    ax.set(xlim=(-0.3, 3.3), ylim=(-0.25, 2.4), aspect="equal")
    ax.set_axis_off()
    return figure


def main() -> None:
    # Texts as outlines, so that they look the same everywhere; identical bytes in each run.
    with matplotlib.rc_context({"svg.hashsalt": "dynsim", "svg.fonttype": "path"}):
        for draw in (frames, contact_modes, mobile_base):
            draw().savefig(FOLDER / f"{draw.__name__}.svg", facecolor="white", metadata={"Date": None})


if __name__ == "__main__":
    main()
