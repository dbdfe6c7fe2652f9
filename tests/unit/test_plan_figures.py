"""Figures of a plan of braces from their data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from support.messages import mentions, says

from dynsim.draw.figures.plan import PlanPicture, Pose, heat_by_set, posture, robustness, single_braces


def picture(aside: float) -> PlanPicture:
    """An arm of two links whose elbow leans on the floor and goes so far aside [m]."""
    bend = np.array([1.0, aside, 0.0])
    lines = [np.array([[0.0, 0.0, 0.5], bend]), np.array([bend, [2.0, 0.0, 0.4]])]
    pose = Pose(0.0, lines, bend[None], np.array([[0.0, 0.0, 4.0]]))
    along, up = np.linspace(-0.2, 2.2, 5), np.linspace(-0.2, 0.7, 4)
    return PlanPicture(
        "arm", [pose, pose], np.array([[2.0, 0.0, 0.4], [2.1, 0.0, 0.4]]), ["elbow on floor"],
        (along, up, np.repeat(up[:, None], len(along), axis=1)), {}, {}, {}, {},
    )  # fmt: skip


def figure_of(shown: PlanPicture) -> Figure:
    figure = posture(shown)
    assert figure is not None
    figure.draw_without_rendering()
    return figure


def names_of(axes: Axes) -> list[str]:
    """Texts of the legend."""
    legend = axes.get_legend()
    assert legend is not None
    return [text.get_text() for text in legend.get_texts()]


@pytest.mark.parametrize(("aside", "views"), [(0.0, 1), (0.3, 2)])
def test_an_arm_that_leaves_its_plane_is_drawn_from_above_too(aside: float, views: int) -> None:
    figure = figure_of(picture(aside))
    assert [axes.get_ylabel() for axes in figure.axes] == ["up [m]", "left [m]"][:views]
    for axes in figure.axes:
        assert [text.get_text() for text in axes.texts if text.get_text()] == ["1"]
    assert "elbow on floor" in names_of(figure.axes[0])
    assert bool(figure.axes[0].get_xlabel()) is (views == 1)


def test_arrows_of_forces_end_at_the_braces_and_stay_in_the_picture() -> None:
    figure = figure_of(picture(0.3))
    low = figure.axes[0].get_ylim()[0]
    arrows = [text for text in figure.axes[0].texts if not text.get_text()]
    assert len(arrows) == 2
    for arrow in arrows:
        np.testing.assert_allclose(arrow.xy, [1.0, 0.0])
        assert low <= arrow.xyann[1] < 0.0


def test_an_arm_without_braces_has_no_names() -> None:
    shown = picture(0.0)
    bare = Pose(0.0, shown.poses[0].lines, np.zeros((0, 3)), np.zeros((0, 3)))
    figure = figure_of(PlanPicture(**{**vars(shown), "poses": [bare], "braces": []}))
    assert not figure.axes[0].texts


def compared() -> PlanPicture:
    """Plans of no brace and of one that does not survive, with two corners."""
    corners = {
        0: (50.0, [("as planned", 50.0, 0.1), ("up", 50.0, 0.1)]),
        1: (0.5, [("as planned", 0.4, 0.2), ("up", 9.0, 5.0)]),
    }
    return replace(
        picture(0.0),
        sets={0: [("none", 50.0)], 1: [("a on floor", 0.5), ("b on floor", 2.0)]},
        survives={0: True, 1: False},
        singles={"a on floor": 0.3, "b on floor": 9.0},
        corners=corners,
    )


def test_heat_is_dots_with_the_simulated_heat_of_the_answers() -> None:
    """Bars on a logarithmic axis begin anywhere: the least would hardly be seen."""
    for make, names in (
        (heat_by_set, [("50 W",), ("0.5 W", "0.4 W"), ("2 W",)]),
        (single_braces, [("0.3 W",), ("9 W",)]),
    ):
        figure = make(compared())
        assert figure is not None
        (axes,) = figure.axes
        assert axes.get_xscale() == "log"
        assert not axes.patches
        texts = [text.get_text() for text in axes.texts]
        assert all(mentions(text, *some) for text, some in zip(texts, names, strict=True))
        assert [says(text, "fails") for text in texts] == [some == ("0.5 W", "0.4 W") for some in names]
        assert len(axes.lines) == len(texts)


def test_the_legend_of_robustness_stands_above_the_bars() -> None:
    figure = robustness(compared())
    assert figure is not None
    figure.draw_without_rendering()
    upper = figure.axes[0]
    assert names_of(upper) == ["0 braces", "1 brace"]
    assert upper.get_legend().get_window_extent().y0 >= upper.get_window_extent().y1  # type: ignore[union-attr]
