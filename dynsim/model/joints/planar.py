"""Planar joints: a body that slides in a plane and turns about its normal, or rolls in it without side slip."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.model.joints import ANGLE, DISTANCE, Array, Row, turned

if TYPE_CHECKING:
    from dynsim.model.description import Link


def motion(link: Link, q: Array) -> tuple[Array, Array]:
    """Return rotation and origin, see :class:`dynsim.model.joints.Row`."""
    return turned(np.array([0.0, 0.0, 1.0]), q[2]), np.stack([q[0], q[1], np.zeros(q.shape[1])])


ROWS = {
    "roll": Row(ka.ROLL, DISTANCE, (0.0, 0.0, 0.0), ("x", "y", "heading"), drawn="planar", motion=motion),
    "turn": Row(ka.TURN, ANGLE, (), offset=2, drawn="fixed"),
}


def planar(link: Link) -> tuple[Link, ...]:
    """Return the links of a body in the plane with normal ``link.axis`` (unit): two distances and one angle."""
    from dynsim.model.description import in_rows

    normal = np.asarray(link.axis, dtype=np.float64)
    # The axes of the plane are x and y after the shortest rotation of z to the normal; for +z they are x and y
    # themselves.
    z = np.array([0.0, 0.0, 1.0])
    cosine, v = float(normal[2]), np.cross(z, normal)
    square = float(v @ v)
    if cosine < 0.0 and square < 1e-30:
        R = np.diag([1.0, -1.0, -1.0])
    else:
        K = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
        # This is 1/(1 + cosine), rewritten because the denominator would cancel near -z.
        R = np.eye(3) + K + K @ K * ((1.0 - cosine) / square if cosine < 0.0 else 1.0 / (1.0 + cosine))
    return in_rows(link, [("x", "prismatic", R[:, 0]), ("y", "prismatic", R[:, 1]), ("angle", "revolute", normal)])


def rolling(link: Link) -> tuple[Link, ...]:
    """Return the links of a body that rolls on the plane z = 0 of the joint's frame like a wheelset with axle along y.

    The coordinates are x and y of the centre of the axle, and the heading. The rates are the speed along the heading
    and the turning rate. The body cannot move sideways.
    """
    from dynsim.model.description import in_rows

    x, z = np.eye(3)[0], np.eye(3)[2]
    return in_rows(link, [("roll", "roll", x), ("turn", "turn", z)])
