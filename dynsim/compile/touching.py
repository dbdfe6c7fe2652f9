"""Points where contact candidates are nearest to their surfaces, of the world or of other bodies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from dynsim.compile.shapes import core_pose, overlaps, share_of_axis, solid_row
from dynsim.dynamics.contact import solids as ks
from dynsim.errors import ModelError
from dynsim.jit.kernel import reals
from dynsim.model.description import Array, Contact, Robot
from dynsim.model.surfaces import Box, Capsule


class Kinematics(Protocol):
    """Methods of :class:`dynsim.Model` with which postures and contacts are computed."""

    robot: Robot
    n: int
    nq: int

    def body_index(self, body: str | int) -> int: ...
    def body_pose(self, body: str | int, q: ArrayLike) -> tuple[Array, Array]: ...
    def point_position(self, body: str | int, point: ArrayLike, q: ArrayLike) -> Array: ...
    def point_jacobian(self, body: str | int, point: ArrayLike, q: ArrayLike) -> Array: ...
    def point_position_and_jacobian(self, body: str | int, point: ArrayLike, q: ArrayLike) -> tuple[Array, Array]: ...


@dataclass(frozen=True)
class TouchPoint:
    """Place where a contact candidate is nearest to its surface.

    Attributes
    ----------
    contact : Contact
        Contact candidate.
    link : int
        Link of the candidate.
    point : (3,) ndarray
        Point of the candidate in the frame of its link [m].
    position : (3,) ndarray
        Its position in the world [m].
    normal : (3,) ndarray
        Normal of the surface in the world.
    carrier : int
        Link that carries the surface, or -1 for the world.
    nearest : (3,) ndarray
        Nearest point of the candidate's axis in the frame of the surface [m].
    apart : float or None
        Distance of two solids there [m]; None for other candidates.
    """

    contact: Contact
    link: int
    point: Array
    position: Array
    normal: Array
    carrier: int
    nearest: Array
    apart: float | None = None

    @property
    def gap(self) -> float:
        """Distance from the surface [m]."""
        if self.apart is not None:
            return self.apart
        try:
            return float(self.contact.surface.gap(self.nearest) - self.contact.radius)
        except ModelError as error:
            raise ModelError(f"contact {self.contact.name} {error}") from None

    def jacobian(self, model: Kinematics, q: Array) -> Array:
        """Return the Jacobian of the velocity against the surface, (3, n), at a configuration, (nq,)."""
        own = model.point_jacobian(self.link, self.point, q)
        if self.carrier < 0:
            return own
        R, p = model.body_pose(self.carrier, q)
        return own - model.point_jacobian(self.carrier, R.T @ (self.position - p), q)


def touch(model: Kinematics, contact: Contact, q: Array, share: float | None = None) -> TouchPoint:
    """Return where a contact is nearest to its surface at a configuration, (nq,).

    Parameters
    ----------
    model : Kinematics
        Model of the robot.
    contact : Contact
        Contact candidate.
    q : (nq,) ndarray
        Coordinates [rad or m].
    share : float, optional
        Point of a capsule's axis, from 0 at its start to 1 at its end. Default: the point nearest to the surface.

    Returns
    -------
    TouchPoint
        Point and normal.

    Raises
    ------
    ModelError
        If the body or its carrier is unknown.
    """
    carrier = -1 if contact.surface.carrier is None else model.body_index(contact.surface.carrier)
    if contact.solid is not None:
        return _slot(model, contact, carrier, q)
    turned, origin = _pose(model, carrier, q)
    point, ends = contact.point, contact.point[None] if contact.tip is None else np.array([contact.point, contact.tip])
    seen = [(model.point_position(contact.body, end, q) - origin) @ turned for end in ends]
    nearest = seen[0]
    if contact.tip is not None:
        share = share_of_axis(contact, *seen) if share is None else share
        nearest, point = nearest + share * (seen[1] - nearest), point + share * (contact.tip - point)
    normal = turned @ np.asarray(contact.surface.normal(nearest), dtype=np.float64)
    link, point = model.robot.attach(contact.body, point)
    if contact.radius > 0.0:
        point = point - contact.radius * (model.body_pose(link, q)[0].T @ normal)
    return TouchPoint(contact, link, point, model.point_position(link, point, q), normal, carrier, nearest)


def _pose(model: Kinematics, index: int, q: Array) -> tuple[Array, Array]:
    """Return the pose of a body, or of the world for index −1."""
    return (np.eye(3), np.zeros(3)) if index < 0 else model.body_pose(index, q)


def _slot(model: Kinematics, contact: Contact, carrier: int, q: Array) -> TouchPoint:
    """Return one of the contacts of two solids; see :func:`dynsim.dynamics.contact.solids.find_contacts`."""
    link, rows, poses = model.body_index(contact.body), [], []
    for index, solid in ((link, contact.solid), (carrier, contact.surface)):
        assert solid is not None
        row = solid_row(solid)
        R, p = _pose(model, index, q)
        local = row[ks.POSE : ks.POSE + 9].reshape(3, 3)
        rows.append(row)
        poses.append(np.concatenate([(R @ local).ravel(), p + R @ row[ks.POSE + 9 : ks.POSE + 12]]))
    pairs = ks.pair_arrays(np.zeros((1, ks.PAIR_SIZE), dtype=np.int64), np.array([rows]))
    cores = [reals(row[ks.CORE : ks.CORE + 4]) for row in rows]
    ks.find_contacts(poses[0], cores[0], poses[1], cores[1], pairs.known[0], pairs.slots[0], pairs.places, pairs.chosen)
    slot = pairs.slots[0, contact.slot]
    position, normal = slot[ks.PLACE : ks.PLACE + 3].copy(), slot[ks.NORMAL : ks.NORMAL + 3].copy()
    R, p = model.body_pose(link, q)
    return TouchPoint(contact, link, R.T @ (position - p), position, normal, carrier, position, float(slot[ks.GAP]))


def gap_at(model: Kinematics, contact: Contact, q: Array) -> float:
    """Return the gap [m] of a contact at a configuration, (nq,); raises ModelError for an unknown body."""
    return touch(model, contact, q).gap


def separation(model: Kinematics, first: Box | Capsule, second: Box | Capsule, q: Array) -> Array:
    """Return the shortest translation of a moving solid that ends its overlap with another one, in W, (3,) [m].

    If the cores overlap, it is along a face normal, or along a common normal of two edges. Otherwise it is along the
    line between the nearest points of the cores. It is zero if the solids do not overlap.
    """
    assert first.carrier is not None
    rows, poses = [solid_row(first), solid_row(second)], list[tuple[Array, Array]]()
    for row, solid in zip(rows, (first, second), strict=True):
        R, p = _pose(model, -1 if solid.carrier is None else model.body_index(solid.carrier), q)
        poses.append(core_pose(row, R[..., None], p[:, None]))
    apart, (depths,), axes = overlaps(rows, poses)
    k = int(depths.argmin())
    if depths[k] > rows[0][ks.CORE + 3] + rows[1][ks.CORE + 3]:
        return np.asarray(np.copysign(depths[k], apart[0, k]) * axes[0, k])
    at = touch(model, Contact("", first.carrier, np.zeros(3), second, solid=first), q)
    return max(-at.gap, 0.0) * at.normal
