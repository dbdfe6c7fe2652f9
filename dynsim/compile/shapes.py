"""Kernel tables of contact candidates with a shape (spheres, capsules), and distances from surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dynsim.compile.model import Model
from dynsim.dynamics.contact import distance as kd
from dynsim.errors import ModelError
from dynsim.model.description import Contact, Robot
from dynsim.model.surfaces import SIMPLE, Array, Box, Quadric, Surface, shape_arrays


def compile_shapes(robot: Robot, contacts: Sequence[Contact]) -> kd.ShapeArrays | None:
    """Shapes of the candidates; None when all are points on quadrics, which need none.

    Raises
    ------
    ModelError
        A candidate with a radius or an axis against a surface that has no exact distance.
    """
    entries = []
    for contact in contacts:
        along = np.zeros(3)
        if contact.tip is not None:
            along = robot.attached_axes(contact.body) @ (contact.tip - contact.point)
        point = isinstance(contact.surface, Quadric) and contact.radius == 0.0 and contact.tip is None
        if not contact.radius >= 0.0:
            raise ModelError(f"contact {contact.name}: radius {contact.radius} m must be zero or positive")
        if not point and isinstance(contact.surface, Quadric) and contact.surface.drawn.kind not in SIMPLE:
            raise ModelError(
                f"contact {contact.name}: {contact.surface_name!r} is a quadric of another kind, which only points can "
                "touch; spheres and capsules touch planes, spheres, cylinders, boxes and height fields"
            )
        entries.append((None if point else contact.surface, contact.radius, along, moves(contact)))
    if all(surface is None for surface, _, _, _ in entries):
        return None
    return shape_arrays(entries)


def moves(contact: Contact) -> bool:
    """Whether the nearest point of a contact's axis touches: on a sphere, a cylinder or a box, from outside.

    Elsewhere an axis is nearest with one of its ends, which are candidates of their own.
    """
    return contact.tip is not None and bends_outward(contact.surface)


def bends_outward(surface: Surface) -> bool:
    """Whether a straight axis can be nearest to a surface between its ends, which all lie on the free side."""
    if isinstance(surface, Quadric):
        return surface.drawn.kind in ("sphere", "cylinder") and (surface.drawn.radius or 0.0) > 0.0
    return isinstance(surface, Box)


def gap_at(model: Model, contact: Contact, q: Array) -> float:
    """Gap [m] of a contact at a configuration, (nq,); ModelError for a body that the model does not have."""
    ends = [model.point_position(contact.body, end, q) for end in (contact.point, contact.tip) if end is not None]
    return contact_gap(contact, *ends)


def contact_gap(contact: Contact, start: Array, end: Array | None = None) -> float:
    """Gap [m] of a contact whose point is at ``start``, (3,), and the other end of whose axis is at ``end``."""
    nearest = start if end is None else start + share_of_axis(contact, start, end) * (end - start)
    try:
        return contact.surface.gap(nearest) - contact.radius
    except ModelError as error:
        raise ModelError(f"contact {contact.name} {error}") from None


def share_of_axis(contact: Contact, start: Array, end: Array) -> float:
    """Where on the axis from ``start`` to ``end``, (3,), a capsule is nearest to its surface, 0 to 1."""
    if not moves(contact):
        return 0.0
    along = np.asarray(end) - start
    shapes = shape_arrays([(contact.surface, contact.radius, along, True)])
    u = np.zeros(1)
    kd.nearest_points(shapes, np.array(start, dtype=np.float64)[None], along[None].copy(), u)
    return float(u[0])


def touching_points(contact: Contact, starts: Array, ends: Array | None = None) -> Array:
    """Where the surface touches a sphere or capsule, and its force acts, (T, 3) [m]; see dynamics.contact.shapes.

    ``starts``, ``ends`` : (T, 3) of the axis [m]; no ends: of the centre
    """
    nearest = np.array(starts, dtype=np.float64)
    if ends is not None and moves(contact):
        along, u = ends - nearest, np.zeros(len(nearest))
        shapes = shape_arrays([(contact.surface, contact.radius, np.zeros(3), True)])
        kd.nearest_points(shapes, nearest, np.ascontiguousarray(along), u)
        nearest = nearest + u[:, None] * along
    return np.asarray(nearest - contact.radius * contact.surface.normals(nearest))
