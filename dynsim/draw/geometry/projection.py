"""Parallel projections of robots: on a plane for figures, or with depth for films and plans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
View = Literal["side", "top", "iso"]
# Directions from the robot to the viewer; the x axis is the longest horizontal extent of the robot.
FROM: dict[str, tuple[float, float, float]] = {
    "side": (0.0, -1.0, 0.0),
    "top": (0.0, 0.0, 1.0),
    "iso": (-0.5, -1.0, 0.55),
}
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Projection:
    """Coordinates of world points along ``axes``, unit vectors (k, 3), from ``origin``, (3,) [m]."""

    origin: Array
    axes: Array

    def project(self, points: Array) -> Array:
        """Return the coordinates of world points, (…, 3) → (…, k) [m]."""
        return np.asarray((points - self.origin) @ self.axes.T)

    def world(self, coordinates: Array) -> Array:
        """Return the world points in the plane of the axes with these coordinates, (…, k) → (…, 3) [m]."""
        return np.asarray(self.origin + coordinates @ self.axes)


ABOVE = Projection(np.zeros(3), np.eye(3)[:2])


def view_axes(view: View, azimuth: float) -> Array:
    """Return the unit vectors right, up and towards the viewer, (3, 3)."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    back = np.array(FROM[view])
    back = turn @ (back / np.linalg.norm(back))
    right = turn[:, 0] if view == "top" else np.cross(UP, back)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])
