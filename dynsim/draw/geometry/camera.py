"""The camera of a film: a parallel projection, so that the scale does not depend on the distance; named views."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
View = Literal["side", "top", "iso"]
# Directions from the robot to the camera, in axes whose x is the robot's longest horizontal extent.
FROM: dict[str, tuple[float, float, float]] = {
    "side": (0.0, -1.0, 0.0),
    "top": (0.0, 0.0, 1.0),
    "iso": (-0.5, -1.0, 0.55),
}


@dataclass(frozen=True)
class Camera:
    """A parallel projection: p = scale · (right, −up) · (r − centre) + middle.

    Attributes
    ----------
    axes : (3, 3) unit vectors in the world: right, up and towards the viewer
    centre : (3,) the point r that is shown in the middle [m]
    scale : [pixel/m]
    middle : (2,) of the picture [pixel]; y is down
    """

    axes: Array
    centre: Array
    scale: float
    middle: Array

    @classmethod
    def fitted(cls, axes: Array, low: Array, high: Array, area: tuple[float, float, float, float]) -> Camera:
        """See a box along the axes of a view from ``low`` to ``high`` in an area (left, top, right, bottom) [pixel]."""
        left, top, right, bottom = area
        size = np.maximum(high - low, 1e-9)
        scale = float(min((right - left) / size[0], (bottom - top) / size[1]))
        middle = np.array([0.5 * (left + right), 0.5 * (top + bottom)])
        return cls(axes, 0.5 * (low + high) @ axes, scale, middle)

    def project(self, points: Array) -> Array:
        """(…, 3) world [m] → (…, 3): x and y [pixel], and how near to the viewer [m]."""
        seen = (points - self.centre) @ self.axes.T
        seen[..., :2] = self.middle + seen[..., :2] * np.array([self.scale, -self.scale])
        return np.asarray(seen)


def view_axes(view: View, azimuth: float) -> Array:
    """Unit vectors to the right, up and towards the viewer, (3, 3)."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    back = np.array(FROM[view])
    back = turn @ (back / np.linalg.norm(back))
    right = turn[:, 0] if view == "top" else np.cross([0.0, 0.0, 1.0], back)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])
