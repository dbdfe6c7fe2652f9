"""Figures of a plan of braces from their data."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from dynsim.draw.figures.plan import PlanPicture, Pose, posture


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


@pytest.mark.parametrize(("aside", "views"), [(0.0, 1), (0.3, 2)])
def test_an_arm_that_leaves_its_plane_is_drawn_from_above_too(aside: float, views: int) -> None:
    figure = figure_of(picture(aside))
    assert [axes.get_ylabel() for axes in figure.axes] == ["up [m]", "left [m]"][:views]
    for axes in figure.axes:
        assert [text.get_text() for text in axes.texts if text.get_text()] == ["elbow on floor"]
    assert figure.axes[0].get_xlabel() == ("along the heading [m]" if views == 1 else "")


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
