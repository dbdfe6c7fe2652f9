"""Figures of a plan of braces from their data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from support.messages import mentions

from dynsim.draw.figures.plan import (
    CornerRun,
    PlanPicture,
    Pose,
    VariedPlans,
    heat_by_set,
    posture,
    robustness,
    single_braces,
    varied,
)
from dynsim.record.quantities import Quantity, rounded


def picture(aside: float) -> PlanPicture:
    """An arm of two links whose elbow leans on the floor and goes so far aside [m]."""
    bend = np.array([1.0, aside, 0.0])
    lines = [np.array([[0.0, 0.0, 0.5], bend]), np.array([bend, [2.0, 0.0, 0.4]])]
    pose = Pose(0.0, lines, bend[None], np.array([[0.0, 0.0, 4.0]]), bend[None] + [0.0, 0.0, 0.05])
    along, up = np.linspace(-0.2, 2.2, 5), np.linspace(-0.2, 0.7, 4)
    return PlanPicture(
        "arm", [pose, pose], np.array([[2.0, 0.0, 0.4], [2.1, 0.0, 0.4]]), ["elbow on floor"],
        (along, up, np.repeat(up[:, None], len(along), axis=1)), None, [], {}, {}, {}, {}, {},
    )  # fmt: skip


def figure_of(shown: PlanPicture) -> Figure:
    figure = posture(shown)
    assert figure is not None
    figure.draw_without_rendering()
    return figure


def names_of(axes: Axes) -> list[str]:
    """Texts of the legend of the figure or of the axes."""
    assert axes.figure is not None
    legends = [*axes.figure.get_figure(root=True).legends, *filter(None, [axes.get_legend()])]
    return [text.get_text() for legend in legends for text in legend.get_texts()]


@pytest.mark.parametrize(("aside", "views"), [(0.0, 1), (0.3, 2)])
def test_an_arm_that_leaves_its_plane_is_drawn_from_above_too(aside: float, views: int) -> None:
    figure = figure_of(picture(aside))
    assert [axes.get_ylabel() for axes in figure.axes] == ["height [m]", "to the left [m]"][:views]
    for axes in figure.axes:
        assert [text.get_text() for text in axes.texts if text.get_text()] == ["1"]
    assert "elbow on floor: 4.0 N" in names_of(figure.axes[0])
    assert bool(figure.axes[0].get_xlabel()) is (views == 1)


def test_arrows_of_forces_and_their_numbers_are_within_the_view() -> None:
    """Only the last pose has arrows: those of all poses would be crowded."""
    shown = picture(0.3)
    first, last = shown.poses
    pushed = np.array([[0.0, 0.0, 2.0], [-4.0, 0.0, 0.0]])
    points = np.array([[1.0, 0.3, 0.0], [2.0, 0.0, 0.4]])
    last = replace(last, points=points, forces=pushed, centres=points)
    figure = figure_of(replace(shown, poses=[first, last], braces=["elbow on floor", "hand on wall"]))
    axes = figure.axes[0]
    arrows = [text for text in axes.texts if not text.get_text()]
    assert len(arrows) == 2
    lengths = [np.linalg.norm(np.subtract(arrow.xy, arrow.xyann)) for arrow in arrows]
    assert lengths[1] == pytest.approx(2.0 * lengths[0])
    for arrow, point, name in zip(arrows, points, ("1", "2"), strict=True):
        np.testing.assert_allclose(arrow.xy, point[[0, 2]])
        (number,) = [text for text in axes.texts if text.get_text() == name]
        assert axes.bbox.containsx(number.get_window_extent().x1)
        assert axes.bbox.containsy(number.get_window_extent().y0)


def test_an_arm_without_braces_has_no_forces() -> None:
    shown = picture(0.0)
    bare = Pose(0.0, shown.poses[0].lines, *np.zeros((3, 0, 3)))
    figure = figure_of(PlanPicture(**{**vars(shown), "poses": [bare], "braces": []}))
    assert not figure.axes[0].texts
    assert mentions(figure.get_suptitle(), "without braces")
    assert not mentions(figure.get_suptitle(), "forces")


def compared() -> PlanPicture:
    """Plans of no brace and of one that does not survive, with two corners."""
    corners = {
        0: [CornerRun("as planned", 1.0, np.nan, 0.1, 5.0), CornerRun("up", 1.0, 1.5, 0.1, 10.0)],
        1: [CornerRun("as planned", 1.0, np.nan, 0.2, 5.0), CornerRun("up", 18.0, 1.5, 12.0, 10.0, "too hot")],
    }
    return replace(
        picture(0.0),
        sets={0: [("none", 50.0)], 1: [("a on floor", 0.5), ("b on floor", 2.0)]},
        survives={0: True, 1: False},
        singles={"a on floor": 0.3, "b on floor": 9.0},
        corners=corners,
        simulated={0: 50.0, 1: 0.4},
    )


def test_heat_is_dots_with_the_simulated_heat_of_the_answers() -> None:
    """Bars on a logarithmic axis begin anywhere: the least would hardly be seen."""
    for make, heats, labels, runs in (
        (heat_by_set, [50.0, 0.5, 2.0], ["no braces", "a", "b"], [50.0, 0.4]),
        (single_braces, [0.3, 9.0], ["a", "b"], []),
    ):
        figure = make(compared())
        assert figure is not None
        (axes,) = figure.axes
        assert axes.get_xscale() == "log"
        assert not axes.patches
        assert mentions(figure.get_suptitle(), "on floor")
        assert [text.get_text() for text in axes.get_yticklabels()] == labels
        assert [text.get_text() for text in axes.texts] == [f"{rounded(heat, 3, '#')} W" for heat in heats]
        drawn = [(line.get_marker(), line.get_xdata()[0]) for line in axes.lines if line.get_label()[0] != "_"]
        assert [x for marker, x in drawn if marker != "|"] == pytest.approx(heats)
        assert [x for marker, x in drawn if marker == "|"] == pytest.approx(runs)
        assert ("X" in dict(drawn)) is bool(runs)


def test_limits_and_rejected_runs_of_robustness_are_drawn() -> None:
    figure = robustness(compared())
    assert figure is not None
    heats, errors = figure.axes
    assert names_of(heats) == ["no braces: survives", "1 brace: rejected", "limit", "rejects the plan"]
    for axes, limits, rejected in ((heats, [1.5], 18.0), (errors, [5.0, 10.0], 12.0)):
        (dashed,) = axes.collections
        assert [segment[0, 0] for segment in dashed.get_segments()] == pytest.approx(limits)
        crosses = [x for line in axes.lines if line.get_marker() == "x" for x in line.get_xdata()]
        assert crosses == [rejected]
        assert axes.get_xlim()[1] > max(rejected, *limits)
    assert [text.get_text() for text in heats.get_yticklabels()] == ["as planned", "up"]
    assert mentions(figure.caption, "survives", "limit", "too hot")


def test_hand_errors_without_a_limit_are_drawn() -> None:
    shown = compared()
    free = {count: [replace(run, error_limit=np.nan) for run in runs] for count, runs in shown.corners.items()}
    figure = robustness(replace(shown, corners=free))
    assert figure is not None
    assert not figure.axes[1].collections[0].get_segments()
    assert figure.axes[1].get_xlim()[1] > 12.0


def test_run_that_ended_early_is_a_cross_at_the_edge() -> None:
    shown = compared()
    lost = replace(shown.corners[1][1], heat=np.nan, error=np.nan, reason="tips over")
    figure = robustness(replace(shown, corners={**shown.corners, 1: [shown.corners[1][0], lost], 2: [lost]}))
    assert figure is not None
    for axes in figure.axes:
        (cross,) = [x for line in axes.lines if line.get_marker() == "x" for x in line.get_xdata()]
        assert cross == axes.get_xlim()[1]
    assert mentions(figure.caption, "ended early", "Rejected as planned, and so not drawn (2 braces): tips over")


def test_a_single_brace_set_has_no_comparison() -> None:
    assert heat_by_set(replace(compared(), sets={0: [("none", 50.0)]})) is None


def test_base_and_spheres_of_braces_are_drawn() -> None:
    box = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (0.0, 0.2)])
    views = figure_of(replace(picture(0.3), base=[box])).axes
    for axes in views:
        (base,) = [patch for patch in axes.patches if isinstance(patch, Polygon)]
        assert np.ptp(base.get_xy(), axis=0) == pytest.approx([0.2, 0.2])
        assert [patch.radius for patch in axes.patches if isinstance(patch, Circle)] == pytest.approx([0.05, 0.05])
    # The column from the base to the first joint, 0.5 m high.
    assert any(np.allclose(line.get_xydata(), [[0.0, 0.2], [0.0, 0.5]]) for line in views[0].lines)


def test_plans_for_several_values_show_limits_and_rejections() -> None:
    """A panel for heat and for each requirement; a value without a plan leaves a gap, a rejected plan is hollow."""
    rows = [
        {"height_m": 0.1, "heat_W": 2.0, "hand_sag_m": 0.0005, "survives": True},
        {"height_m": 0.2, "heat_W": 1.0, "hand_sag_m": 0.002, "survives": False},
        {"height_m": 0.3, "reason": "out of reach"},
    ]
    plans = VariedPlans(
        "height_m", Quantity("height", unit="m"), {"pad 0.1 m": rows, "pad 0.2 m": rows[:2]}, {"hand_sag_m": 0.001}
    )
    assert varied(picture(0.0)) is None
    figure = varied(replace(picture(0.0), varied=plans))
    assert figure is not None
    heat, sag = figure.axes
    assert (heat.get_ylabel(), sag.get_ylabel(), sag.get_xlabel()) == ("heat [W]", "hand sag [mm]", "height [m]")
    assert {"pad 0.1 m", "pad 0.2 m", "limit"} == set(names_of(sag))
    first, hollow = sag.lines[:2]
    assert np.array_equal(first.get_ydata(), [0.5, 2.0, np.nan], equal_nan=True)
    assert (list(hollow.get_xdata()), hollow.get_markerfacecolor()) == ([0.2], "white")
    assert any(np.allclose(line.get_ydata(), 1.0) for line in sag.lines if line.get_label() == "limit")
