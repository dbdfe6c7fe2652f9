"""Mobile base with two wheels on one axle that roll without slip; its rates are the wheel rates ([WM] II.E)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.model.joints import ANGLE, Array, Row, turned

if TYPE_CHECKING:
    from dynsim.model.description import Link


def motion(link: Link, q: Array) -> tuple[Array, Array]:
    """Return rotation and origin, see :class:`dynsim.model.joints.Row`."""
    left, right, x, y = q
    return turned(np.array([0.0, 0.0, 1.0]), link.parameter * (right - left)), np.stack([x, y, np.zeros_like(x)])


ROWS = {
    "left_wheel": Row(
        ka.LEFT_WHEEL,
        ANGLE,
        (0.0, 0.0, 0.0, 0.0),
        ("left", "right", "x", "y"),
        own_position=True,
        drawn="planar",
        motion=motion,
    ),
    "right_wheel": Row(ka.RIGHT_WHEEL, ANGLE, (), offset=1, own_position=True, drawn="fixed"),
}


def wheeled(link: Link, radius: float, track: float) -> tuple[Link, ...]:
    """Return the links of a base that rolls on the plane z = 0 of the joint's frame on two wheels.

    The coordinates are the angles of the left and the right wheel, then x and y of the centre of the axle. Both wheels
    turn positively when the base rolls forward, along its x axis. The rates are the wheel rates, with
    V = r (φ̇_r + φ̇_l)/2 and ω = r (φ̇_r − φ̇_l)/T. Rolling without slip and the heading r (φ_r − φ_l)/T are therefore
    exact.

    Parameters
    ----------
    link : Link
        Link whose body is carried.
    radius, track : float
        Wheel radius r and distance T between the wheels [m].
    """
    from dynsim.model.description import in_rows

    x = np.eye(3)[0]
    left, right = in_rows(link, [("left", "left_wheel", x), ("right", "right_wheel", x)])
    return replace(left, parameter=radius / track), replace(right, parameter=0.5 * radius)
