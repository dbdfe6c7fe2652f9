"""Where a drawn arm lies below a surface that only its contact points are held by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dynsim.draw.figures.skeleton import Skeleton
from dynsim.draw.figures.style import Array
from dynsim.record.scene import NOT_BELOW

COLOUR = "#882255"
# Parts into which a segment is cut to find what of it lies below a surface.
PARTS = 24


@dataclass(frozen=True)
class Below:
    """Parts of a posture below surfaces, of bodies that are below by more than their radius.

    Attributes
    ----------
    pieces : (m, 2, 3) [m]
    depth : largest depth of an axis below its surface [m]; 0 where there is none
    surface : name of the surface it is below
    """

    pieces: Array
    depth: float
    surface: str


def below_surfaces(body: Skeleton, row: int) -> Below:
    """What of the segments at a sample lies below a surface."""
    pieces, deepest, name = [np.zeros((0, 2, 3))], 0.0, ""
    share = np.linspace(0.0, 1.0, PARTS + 1)[:, None]
    for (start, end), radius in zip(body.segments(row), _radii(body), strict=True):
        points = start + share * (end - start)
        if not np.isfinite(points).all():
            continue
        for surface in body.scene.surfaces:
            depth = np.maximum(-surface.gap(points), 0.0)
            if not depth.max() > radius + NOT_BELOW:
                continue
            below = depth > NOT_BELOW
            # A piece is drawn where both of its ends lie below.
            pieces.append(np.stack([points[:-1], points[1:]], axis=1)[below[:-1] & below[1:]])
            if depth.max() > deepest:
                deepest, name = float(depth.max()), surface.name
    return Below(np.concatenate(pieces), deepest, name)


def _radii(body: Skeleton) -> list[float]:
    """Radius of the body that each segment belongs to [m]; 0 where it is not known."""
    return [0.0 if k is None else body.scene.bodies[k].radius for k in body.carriers()]
