"""Ball joint and free body: the attitude is a quaternion (w, x, y, z), the angular velocity is in body axes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.model.joints import ANGLE, Array, Row

if TYPE_CHECKING:
    from dynsim.model.description import Link


def motion(link: Link, q: Array) -> tuple[Array, Array]:
    """Return rotation and origin, see :class:`dynsim.model.joints.Row`."""
    w, x, y, z = q / np.sqrt((q * q).sum(axis=0))
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return R, np.zeros((3, q.shape[1]))


ROWS = {
    "ball_x": Row(
        ka.BALL_X, ("1", *ANGLE[1:]), (1.0, 0.0, 0.0, 0.0), ("qw", "qx", "qy", "qz"), drawn="ball", motion=motion
    ),
    "ball_y": Row(ka.BALL_Y, ("1", *ANGLE[1:]), (), offset=2, drawn="fixed"),
    "ball_z": Row(ka.BALL_Z, ("1", *ANGLE[1:]), (), offset=3, drawn="fixed"),
}


def ball(link: Link) -> tuple[Link, ...]:
    """Return the links of a ball joint that carries the body of ``link``; its kind and axis are not used.

    The coordinates are the quaternion w, x, y, z of the body in the joint's frame. The rates are the angular velocity
    of the body in its own axes.
    """
    from dynsim.model.description import in_rows

    return in_rows(link, [(f"w{axis}", f"ball_{axis}", np.eye(3)[k]) for k, axis in enumerate("xyz")])


def floating(link: Link) -> tuple[Link, ...]:
    """Return the links of a body that moves freely relative to the joint's frame.

    The coordinates are the position of the body's origin in the joint's frame, then the quaternion. The rates are the
    velocity of the origin in the axes of the joint's frame, then the angular velocity in body axes.
    """
    from dynsim.model.description import in_rows, without_body

    carrier = replace(without_body(link), name=f"{link.name}.position")
    sliding = in_rows(carrier, [(axis, "prismatic", np.eye(3)[k]) for k, axis in enumerate("xyz")])
    return (*sliding, *ball(replace(link, parent=carrier.name, R_PJ=np.eye(3), p_PJ=np.zeros(3))))
