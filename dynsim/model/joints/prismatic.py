"""Prismatic joint: one distance along an axis."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dynsim.dynamics import tables as ka
from dynsim.model.joints import DISTANCE, Array, Row, unturned

if TYPE_CHECKING:
    from dynsim.model.description import Link


def motion(link: Link, q: Array) -> tuple[Array, Array]:
    """Return rotation and origin, see :class:`dynsim.model.joints.Row`."""
    return unturned(q.shape[1]), link.axis[:, None] * q[0]


ROWS = {"prismatic": Row(ka.PRISMATIC, DISTANCE, drawn="prismatic", motion=motion)}
