"""Candidates with a shape as the tables of the kernels, and their distances at a configuration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dynsim.errors import ModelError
from dynsim.kernels.constraint import distance as kd
from dynsim.kernels.jit import integers, reals
from dynsim.model.description import Contact, Robot
from dynsim.model.model import Model
from dynsim.model.surfaces import Array, Box, HeightField, Quadric, Surface

_SIMPLE = {"plane": kd.PLANE, "sphere": kd.SPHERE, "cylinder": kd.CYLINDER}


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
        if not point and isinstance(contact.surface, Quadric) and contact.surface.drawn.kind not in _SIMPLE:
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


def shape_arrays(entries: Sequence[tuple[Surface | None, float, Array, bool]]) -> kd.ShapeArrays:
    """Tables of candidates: surface, radius [m], axis in its body [m], and whether its nearest point touches.

    The surface is None for a point on a quadric.
    """
    kind = np.zeros((len(entries), kd.SHAPE_KIND_SIZE), dtype=np.int64)
    data = np.zeros((len(entries), kd.SHAPE_SIZE))
    fields: list[Array] = [np.zeros(0)]
    starts: dict[int, int] = {}
    for k, (surface, radius, along, moving) in enumerate(entries):
        if surface is None:
            continue
        data[k, kd.RADIUS], data[k, kd.D : kd.D + 3], kind[k, kd.MOVES] = radius, along, moving
        if isinstance(surface, Box):
            kind[k, kd.SURFACE] = kd.BOX
            data[k, kd.PLACE : kd.PLACE + 3] = surface.centre
            data[k, kd.AXES : kd.AXES + 9] = np.asarray(surface.axes).ravel()
            data[k, kd.SIZE : kd.SIZE + 3] = 0.5 * np.asarray(surface.edges) - surface.edge_radius
            data[k, kd.EDGE] = surface.edge_radius
        elif isinstance(surface, HeightField):
            kind[k, kd.SURFACE] = kd.HEIGHT_FIELD
            if id(surface) not in starts:
                starts[id(surface)] = sum(map(len, fields))
                fields.append(surface.coefficients.ravel())
            kind[k, kd.FIELD], ny, nx = starts[id(surface)], *surface.heights.shape
            kind[k, kd.COUNT : kd.COUNT + 2] = nx, ny
            data[k, kd.PLACE : kd.PLACE + 2], data[k, kd.SIZE : kd.SIZE + 2] = surface.origin, surface.spacing
        elif isinstance(surface, Quadric):
            drawn = surface.drawn
            kind[k, kd.SURFACE] = _SIMPLE[drawn.kind]
            data[k, kd.PLACE : kd.PLACE + 3] = drawn.position
            if drawn.direction is not None:
                data[k, kd.AXES : kd.AXES + 3] = drawn.direction
            data[k, kd.SIZE] = drawn.radius or 0.0
        else:
            raise ModelError(f"a {type(surface).__name__} is no surface that the kernels know")
    return kd.ShapeArrays(kind=integers(kind), data=reals(data), fields=reals(np.concatenate(fields)))


def gap_at(model: Model, contact: Contact, q: Array) -> float:
    """Gap [m] of a contact at a configuration, (nq,); ModelError for a body that the model does not have."""
    ends = [model.point_position(contact.body, end, q) for end in (contact.point, contact.tip) if end is not None]
    return contact_gap(contact, *ends)


def contact_gap(contact: Contact, start: Array, end: Array | None = None) -> float:
    """Gap [m] of a contact whose point is at ``start``, (3,), and the other end of whose axis is at ``end``."""
    if end is None:
        return contact.surface.gap(start) - contact.radius
    return contact.surface.gap(start + share_of_axis(contact, start, end) * (end - start)) - contact.radius


def share_of_axis(contact: Contact, start: Array, end: Array) -> float:
    """Where on the axis from ``start`` to ``end``, (3,), a capsule is nearest to its surface, 0 to 1."""
    if not moves(contact):
        return 0.0
    along = np.asarray(end) - start
    shapes = shape_arrays([(contact.surface, contact.radius, along, True)])
    u = np.zeros(1)
    kd.nearest_points(shapes, np.array(start, dtype=np.float64)[None], along[None].copy(), u)
    return float(u[0])
