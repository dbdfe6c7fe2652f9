"""Revolute joint: one angle about an axis. Kernels have faster code for axes x, y and z of the joint's frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.model.joints import ANGLE, Array, Row, turned

if TYPE_CHECKING:
    from dynsim.model.description import Link


def motion(link: Link, q: Array) -> tuple[Array, Array]:
    """Return rotation and origin, see :class:`dynsim.model.joints.Row`."""
    return turned(link.axis, q[0]), np.zeros((3, q.shape[1]))


ROWS = {"revolute": Row(ka.REVOLUTE, ANGLE, drawn="revolute", motion=motion)}
