"""Filled faces with exact visibility: a depth buffer decides which face each pixel shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dynsim.jit.kernel import kernel


@kernel
def fill(
    image: NDArray[np.uint8], depth: NDArray[np.float64], corners: NDArray[np.float64], colours: NDArray[np.uint8]
) -> None:
    """Fill faces in an image; each pixel shows the face that is nearest to the viewer.

    Parameters
    ----------
    image : (height, width, 3) ndarray of uint8
        Image, changed in place.
    depth : (height, width) ndarray
        Coordinate towards the viewer of the face in each pixel [m], changed in place; −inf where there is no face.
    corners : (n, 4, 3) ndarray
        x and y [pixel] and the coordinate towards the viewer [m] of plane faces; a triangle repeats a corner.
    colours : (n, 3) ndarray of uint8
        Colours of the faces.
    """
    height, width = depth.shape
    for k in range(corners.shape[0]):
        for j in range(1, 3):
            # Triangles of the corners 0, 1, 2 and 0, 2, 3.
            ax, ay, az = corners[k, 0]
            bx, by, bz = corners[k, j]
            cx, cy, cz = corners[k, j + 1]
            area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
            if area == 0.0:
                continue
            # Limit the rows and columns before they become integers: corners may be far outside the image.
            left, right = max(min(ax, bx, cx), 0.0), min(max(ax, bx, cx), width - 1.0)
            top, bottom = max(min(ay, by, cy), 0.0), min(max(ay, by, cy), height - 1.0)
            if not (left <= right and top <= bottom):
                continue
            for y in range(int(top), int(bottom) + 1):
                for x in range(int(left), int(right) + 1):
                    v = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area
                    w = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area
                    if v < 0.0 or w < 0.0 or v + w > 1.0:
                        continue
                    z = az + v * (bz - az) + w * (cz - az)
                    if z > depth[y, x]:
                        depth[y, x] = z
                        for channel in range(3):
                            image[y, x, channel] = colours[k, channel]
