"""Kernel tables of contact candidates with a shape (spheres, capsules), and distances from surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dynsim.dynamics.contact import distance as kd
from dynsim.dynamics.contact import solids as ks
from dynsim.errors import ModelError
from dynsim.model.description import Contact, Robot
from dynsim.model.surfaces import SIMPLE, Array, Box, Capsule, Quadric, Surface, shape_arrays


def compile_shapes(robot: Robot, contacts: Sequence[Contact]) -> kd.ShapeArrays | None:
    """Return the shapes of the candidates; None if all are points on quadrics, which need no shapes.

    Raises
    ------
    ModelError
        If a candidate with a radius or an axis touches a surface whose distance function is not exact.
    """
    entries = []
    for contact in contacts:
        along = np.zeros(3)
        if contact.tip is not None:
            along = robot.attached_axes(contact.body) @ (contact.tip - contact.point)
        point = contact.radius == 0.0 and contact.tip is None and contact.surface.carrier is None
        point &= isinstance(contact.surface, Quadric)
        if not contact.radius >= 0.0:
            raise ModelError(f"contact {contact.name}: radius {contact.radius} m must be zero or positive")
        if not point and isinstance(contact.surface, Quadric) and contact.surface.drawn.kind not in SIMPLE:
            raise ModelError(
                f"contact {contact.name}: only points can touch the general quadric {contact.surface_name!r}; use a "
                "point (no radius_m, no link axis), or a plane, sphere, cylinder, box or height field"
            )
        entries.append((None if point else contact.surface, contact.radius, along, moves(contact)))
    if all(surface is None for surface, _, _, _ in entries):
        return None
    arrays, index, solids = shape_arrays(entries), list[tuple[int, int]](), list[list[Array]]()
    for k, contact in enumerate(contacts):
        if contact.solid is None:
            continue
        if contact.slot == 0:
            carrier = contact.surface.carrier
            links = [-1 if s is None else robot.attach(s, np.zeros(3))[0] for s in (contact.solid.carrier, carrier)]
            index.append((links[0], links[1]))
            solids.append([solid_row(contact.solid), solid_row(contact.surface)])
        arrays.kind[k, [kd.SURFACE, kd.FIELD, kd.COUNT]] = kd.PAIR, len(index) - 1, contact.slot
    if all(contact.surface.carrier is None and contact.solid is None for contact in contacts):
        return arrays
    both = np.reshape(solids, (-1, 2, ks.SOLID_SIZE))
    return arrays._replace(pairs=ks.pair_arrays(np.reshape(index, (-1, ks.PAIR_SIZE)), both))


def solid_row(solid: Surface) -> Array:
    """Return the kernel table row of a capsule or box, (SOLID_SIZE,)."""
    row = np.zeros(ks.SOLID_SIZE)
    if isinstance(solid, Box):
        axes, centre, half, radius = solid.axes.T, solid.centre, solid.core, solid.edge_radius
    else:
        assert isinstance(solid, Capsule)
        length = float(np.linalg.norm(solid.axis))
        axes = np.eye(3) if length == 0.0 else axes_along(solid.axis / length)
        centre, half, radius = solid.start + 0.5 * solid.axis, np.array([0.0, 0.0, 0.5 * length]), solid.radius
    row[ks.POSE : ks.POSE + 9], row[ks.POSE + 9 : ks.POSE + 12] = axes.ravel(), centre
    row[ks.CORE : ks.CORE + 3], row[ks.CORE + 3] = half, radius
    row[ks.BOUND] = float(np.linalg.norm(half)) + radius
    return row


def core_pose(row: Array, R: Array, p: Array) -> tuple[Array, Array]:
    """Return axes, (T, 3, 3) by rows, and centres, (T, 3) [m], of a core in W; R and p are those of its link."""
    local, centre = row[ks.POSE : ks.POSE + 9].reshape(3, 3), row[ks.POSE + 9 : ks.POSE + 12]
    return np.einsum("ijt,jk->tki", R, local), p.T + np.einsum("ijt,j->ti", R, centre)


def overlaps(rows: Sequence[Array], cores: Sequence[tuple[Array, Array]]) -> tuple[Array, Array, Array]:
    """Return distances of centres along separating axes of two solids, overlaps, (T, n) [m], and axes, (T, n, 3).

    The least overlap is the depth if the cores overlap. The axes are those of the solids, their cross products and, as
    the last one, the line of centres.
    """
    (A, a), (B, b) = cores
    edges = np.cross(A[:, :, None], B[:, None]).reshape(-1, 9, 3)
    axes = np.concatenate([A, B, edges, (a - b)[:, None]], axis=1)
    length = np.linalg.norm(axes, axis=2)
    axes = axes / np.maximum(length, 1e-300)[..., None]
    apart = np.einsum("tni,ti->tn", axes, a - b)
    reach = rows[0][ks.CORE + 3] + rows[1][ks.CORE + 3] - np.abs(apart)
    for core, row in zip((A, B), rows, strict=True):
        reach += np.abs(np.einsum("tni,tki->tnk", axes, core)) @ row[ks.CORE : ks.CORE + 3]
    return apart, np.where(length > 1e-6, reach, np.inf), axes


def axes_along(direction: Array) -> Array:
    """Return a rotation, (3, 3), whose third column is a unit vector."""
    first = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(direction, first), direction])


def moves(contact: Contact) -> bool:
    """Return whether the contact point can move along the axis: on the outside of a sphere, cylinder or box.

    On other surfaces the nearest point is one of the ends, which are separate candidates.
    """
    return contact.tip is not None and bends_outward(contact.surface)


def bends_outward(surface: Surface) -> bool:
    """Return whether the point of a straight axis nearest to a surface, on its free side, can be between the ends."""
    if isinstance(surface, Capsule):
        return True
    if isinstance(surface, Quadric):
        return surface.drawn.kind in ("sphere", "cylinder") and (surface.drawn.radius or 0.0) > 0.0
    return isinstance(surface, Box)


def share_of_axis(contact: Contact, start: Array, end: Array) -> float:
    """Return where the axis of a capsule is nearest to its surface: 0 at ``start`` to 1 at ``end``, (3,)."""
    if not moves(contact):
        return 0.0
    along = np.asarray(end) - start
    shapes = shape_arrays([(contact.surface, contact.radius, along, True)])
    u = np.zeros(1)
    kd.nearest_points(shapes, np.array(start, dtype=np.float64)[None], along[None].copy(), u)
    return float(u[0])


def touching_points(contact: Contact, starts: Array, ends: Array | None = None) -> Array:
    """Return the points where a surface touches a sphere or capsule and its force acts, (T, 3) [m].

    See dynsim.dynamics.contact.distance.

    Parameters
    ----------
    contact : Contact
        Sphere or capsule.
    starts : (T, 3) ndarray
        Centres of the sphere, or start points of the axis [m].
    ends : (T, 3) ndarray, optional
        End points of the axis [m].
    """
    nearest = np.array(starts, dtype=np.float64)
    if ends is not None and moves(contact):
        along, u = ends - nearest, np.zeros(len(nearest))
        shapes = shape_arrays([(contact.surface, contact.radius, np.zeros(3), True)])
        kd.nearest_points(shapes, nearest, np.ascontiguousarray(along), u)
        nearest = nearest + u[:, None] * along
    return np.asarray(nearest - contact.radius * contact.surface.normals(nearest))
