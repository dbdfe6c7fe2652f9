"""Contact surfaces: quadrics, rounded boxes and height fields, with their distance functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynsim.errors import ModelError
from dynsim.record.scene import SceneSurface

if TYPE_CHECKING:
    from dynsim.dynamics.contact.distance import ShapeArrays

Array = NDArray[np.float64]
# Quadrics that spheres and capsules can touch.
SIMPLE = ("plane", "sphere", "cylinder")
# Signs of the coordinates of a box's corners in its axes.
CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


@dataclass(frozen=True)
class Quadric:
    """Surface C(r) = r·Q r/2 + b·r + c = 0, Q (3, 3) symmetric, b (3,); C > 0 is outside, where ∇C points.

    Like all surfaces it is described in the axes of its ``carrier``, a body, or in the world if this is None. The part
    of an infinite surface about ``middle``, (3,) [m], is drawn.
    """

    Q: Array
    b: Array
    c: float
    carrier: str | None = None
    middle: Array | None = None

    def __post_init__(self) -> None:
        shapes = np.shape(self.Q), np.shape(self.b)
        if shapes != ((3, 3), (3,)):
            raise ModelError(f"a quadric requires Q of shape (3, 3), b of shape (3,), got {shapes[0]} and {shapes[1]}")
        rounding = 1e-9 * float(np.abs(self.Q).max())
        if not np.allclose(self.Q, np.transpose(self.Q), rtol=0.0, atol=rounding, equal_nan=True):
            raise ModelError("Q of a quadric must be symmetric; use (Q + Qᵀ)/2 for the same surface")

    def gap(self, position: Array) -> float:
        """Return the signed distance [m] of a point along the normal; exact for plane, sphere and cylinder."""
        from dynsim.dynamics.contact.rows import surface_distance

        gradient = self.Q @ position + self.b
        slope = float(np.linalg.norm(gradient))
        if slope == 0.0:
            raise ModelError(
                "is at the centre, or on the axis, of its surface, where all directions are equally near; move it by a "
                "micrometre"
            )
        normal = gradient / slope
        value = float(0.5 * position @ self.Q @ position + self.b @ position + self.c)
        return float(surface_distance(value, slope, float(normal @ self.Q @ normal)))

    def gaps(self, positions: Array) -> Array:
        """Return :meth:`gap` of many points, (T, 3) → (T,) [m]; even if ∇C vanishes, as at a sphere's centre."""
        if not self.Q.any():
            return np.asarray((positions @ self.b + self.c) / np.linalg.norm(self.b))
        Qr = positions @ self.Q
        gradient = Qr + self.b
        value = np.sum((0.5 * Qr + self.b) * positions, axis=1) + self.c
        square = np.sum(gradient * gradient, axis=1)
        steepest = float(np.abs(np.linalg.eigvalsh(self.Q)).max())
        bent = np.sum((gradient @ self.Q) * gradient, axis=1)
        curvature = np.where(square > 0.0, bent / np.where(square > 0.0, square, 1.0), -steepest * np.sign(value))
        inner = square - 2.0 * curvature * value
        slope = np.sqrt(square)
        return np.asarray(
            np.where(
                inner > 0.0,
                2.0 * value / (slope + np.sqrt(np.maximum(inner, 1e-300))),
                value / np.maximum(slope, 1e-300),
            )
        )

    def shifted(self, by: Array) -> Quadric:
        """Return the surface moved by a vector [m]."""
        c = float(self.c - self.b @ by + 0.5 * by @ self.Q @ by)
        return replace(self, b=self.b - self.Q @ by, c=c, middle=None if self.middle is None else self.middle + by)

    def turned(self, R: Array) -> Quadric:
        """Return the surface turned about the origin."""
        middle = None if self.middle is None else R @ self.middle
        return replace(self, Q=R @ self.Q @ R.T, b=R @ self.b, middle=middle)

    def normal(self, position: Array) -> Array:
        """Return ∇C/|∇C| at a point, (3,); zero if ∇C vanishes, as at the centre of a sphere."""
        gradient = self.Q @ position + self.b
        slope = float(np.linalg.norm(gradient))
        return np.asarray(gradient / slope) if slope > 0.0 else np.zeros(3)

    def normals(self, positions: Array) -> Array:
        """Return :meth:`normal` at many points, (T, 3) → (T, 3)."""
        gradients = positions @ self.Q + self.b
        slopes = np.linalg.norm(gradients, axis=1, keepdims=True)
        return np.divide(gradients, slopes, out=np.zeros_like(gradients), where=slopes > 0.0)

    @cached_property
    def drawn(self) -> SceneSurface:
        """Unnamed scene surface of the matching simple kind with its parameters; None if there is no such kind."""
        return SceneSurface.of_quadric("", self.Q, self.b, self.c)


class _Shaped:
    """Surface whose distances are computed by the kernels of dynsim.dynamics.contact.distance."""

    def gap(self, position: Array) -> float:
        """Return the signed distance of a point, (3,), along the normal [m]."""
        return float(self._distances(np.asarray(position)[None])[0][0])

    def gaps(self, positions: Array) -> Array:
        """Return :meth:`gap` of many points, (T, 3) → (T,) [m]."""
        return self._distances(positions)[0]

    def normal(self, position: Array) -> Array:
        """Return the unit normal at a point, (3,), to the free side."""
        return np.asarray(self._distances(np.asarray(position)[None])[1][0])

    def normals(self, positions: Array) -> Array:
        """Return :meth:`normal` at many points, (T, 3) → (T, 3)."""
        return self._distances(positions)[1]

    def _distances(self, positions: Array) -> tuple[Array, Array]:
        from dynsim.dynamics.contact.distance import surface_distances

        points = np.array(positions, dtype=np.float64, order="C")
        gaps, normals = np.zeros(len(points)), np.zeros((len(points), 3))
        assert isinstance(self, Box | Capsule | HeightField)
        surface_distances(shape_arrays([(self, 0.0, np.zeros(3), False)]), points, gaps, normals)
        return gaps, normals


@dataclass(frozen=True)
class Box(_Shaped):
    """Box whose edges and corners are rounded by ``edge_radius``; the free side is outside.

    Attributes
    ----------
    centre : (3,) ndarray
        Centre [m].
    axes : (3, 3) ndarray
        Axes of the box in W, as rows.
    edges : (3,) ndarray
        Lengths along the axes [m].
    edge_radius : float
        Radius of edges and corners, at most half the shortest edge [m].
    """

    centre: Array
    axes: Array
    edges: Array
    edge_radius: float
    carrier: str | None = None
    is_sphere = False

    @property
    def core(self) -> Array:
        """Half edges of the box whose corners are the centres of the rounded corners, (3,) [m]."""
        return 0.5 * self.edges - self.edge_radius

    @property
    def corners(self) -> Array:
        """Centres of the rounded corners, in the order of ``CORNERS``, (8, 3) [m]."""
        return self.centre + (CORNERS * self.core) @ self.axes

    def shifted(self, by: Array) -> Box:
        """Return the box moved by a vector [m]."""
        return replace(self, centre=self.centre + by)

    def turned(self, R: Array) -> Box:
        """Return the box turned about the origin."""
        return replace(self, centre=R @ self.centre, axes=self.axes @ R.T)


@dataclass(frozen=True)
class Capsule(_Shaped):
    """Capsule from a start along an axis, (3,) each [m]; the free side is outside."""

    start: Array
    axis: Array
    radius: float
    carrier: str | None = None

    @property
    def is_sphere(self) -> bool:
        """Whether the axis has no length."""
        return not self.axis.any()

    def shifted(self, by: Array) -> Capsule:
        """Return the capsule moved by a vector [m]."""
        return replace(self, start=self.start + by)

    def turned(self, R: Array) -> Capsule:
        """Return the capsule turned about the origin."""
        return replace(self, start=R @ self.start, axis=R @ self.axis)


@dataclass(frozen=True)
class HeightField(_Shaped):
    """Surface z = h(x, y), a bicubic C² spline through heights on a grid; the free side is above.

    Attributes
    ----------
    origin : (2,) ndarray
        x and y of the first height [m].
    spacing : (2,) ndarray
        Grid spacing along x and y [m].
    heights : (ny, nx) ndarray
        Heights [m], at least four in each direction: row j is at y_j, column i at x_i.
    """

    origin: Array
    spacing: Array
    heights: Array = field(repr=False)
    carrier: str | None = None

    def shifted(self, by: Array) -> HeightField:
        """Return the field moved by a vector [m]."""
        return replace(self, origin=self.origin + by[:2], heights=self.heights + by[2])

    def turned(self, R: Array) -> HeightField:
        """Return the field itself; raise ModelError for any rotation, because heights are along z."""
        if not np.array_equal(R, np.eye(3)):
            raise ModelError("a height field cannot be on a link that is turned against the body to which it is fixed")
        return self

    @cached_property
    def coefficients(self) -> Array:
        """Coefficients of the uniform cubic B-splines, (ny + 2, nx + 2), with not-a-knot end conditions.

        The third derivative does not jump at the second grid lines, so cubics are reproduced exactly.
        """
        return _spline(_spline(self.heights).T).T


Surface = Quadric | Box | Capsule | HeightField


class SolidPair(NamedTuple):
    """Two solids that can touch, each carried by a body, and their kinetic friction coefficient."""

    first: Box | Capsule
    second: Box | Capsule
    friction: float


"""Surface, as a member of the family ``surface`` builds it; its free side is where the distance is positive."""


def _spline(values: Array) -> Array:
    """Return coefficients of cubic B-splines along the first axis, (n, m) → (n + 2, m)."""
    from dynsim.dynamics.banded import solve_banded

    n, reach = len(values), 4
    band, right = np.zeros((n + 2, 3 * reach + 1)), np.zeros((n + 2, values.shape[1]))
    band[1:-1, reach - 1 : reach + 2] = 1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0
    band[0, reach : reach + 5] = band[-1, reach - 4 : reach + 1] = 1.0, -4.0, 6.0, -4.0, 1.0
    right[1:-1] = values
    solve_banded(band, reach, reach, right)
    return right


def shape_arrays(entries: Sequence[tuple[Surface | None, float, Array, bool]]) -> ShapeArrays:
    """Return tables of candidates from surface, radius [m], axis in the body [m], and if its nearest point touches.

    Each entry contains the surface (None for a point on a quadric), the radius [m], the axis in the body's frame [m],
    and whether the nearest point of the axis touches.
    """
    # Imported here because the kernels take a second to load and configurations do not need them.
    from dynsim.dynamics.contact import distance as kd
    from dynsim.jit.kernel import integers, reals

    simple = {"plane": kd.PLANE, "sphere": kd.SPHERE, "cylinder": kd.CYLINDER}
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
            data[k, kd.POSITION : kd.POSITION + 3] = surface.centre
            data[k, kd.AXES : kd.AXES + 9] = np.asarray(surface.axes).ravel()
            data[k, kd.SIZE : kd.SIZE + 3] = surface.core
            data[k, kd.EDGE] = surface.edge_radius
        elif isinstance(surface, Capsule):
            kind[k, kd.SURFACE] = kd.CAPSULE
            data[k, kd.POSITION : kd.POSITION + 3] = surface.start
            data[k, kd.AXES : kd.AXES + 3] = surface.axis
            data[k, kd.SIZE] = surface.radius
        elif isinstance(surface, HeightField):
            kind[k, kd.SURFACE] = kd.HEIGHT_FIELD
            if id(surface) not in starts:
                starts[id(surface)] = sum(map(len, fields))
                fields.append(surface.coefficients.ravel())
            kind[k, kd.FIELD], ny, nx = starts[id(surface)], *surface.heights.shape
            kind[k, kd.COUNT : kd.COUNT + 2] = nx, ny
            data[k, kd.POSITION : kd.POSITION + 2], data[k, kd.SIZE : kd.SIZE + 2] = surface.origin, surface.spacing
        elif isinstance(surface, Quadric):
            drawn = surface.drawn
            kind[k, kd.SURFACE] = simple[drawn.kind]
            data[k, kd.POSITION : kd.POSITION + 3] = drawn.position
            if drawn.direction is not None:
                data[k, kd.AXES : kd.AXES + 3] = drawn.direction
            data[k, kd.SIZE] = drawn.radius or 0.0
        else:
            raise ModelError(f"the kernels do not support a surface of type {type(surface).__name__}")
    return kd.ShapeArrays(kind=integers(kind), data=reals(data), fields=reals(np.concatenate(fields)))
