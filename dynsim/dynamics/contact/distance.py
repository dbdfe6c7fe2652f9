"""Signed distances φ from surfaces, with unit normal n = ∇φ and curvature H = ∂²φ, and the nearest point of an axis.

For planes, spheres and cylinders, φ is exact everywhere. Boxes have edges rounded by a radius; φ is exact outside and
down to that depth inside, n is continuous, and H jumps where a flat face meets a rounded edge (φ is C¹). Height fields
z = h(x, y) are bicubic C² splines; φ is exact along the normal through the foot point, and n and H are continuous.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.dynamics.contact.solids import PairArrays
from dynsim.dynamics.tree.spatial import first_axis, rotate, rotate_back, rotation, second_axis, third_axis, vector
from dynsim.jit.kernel import internal_kernel, kernel

# ShapeArrays.kind, int
SURFACE = 0  # one of the kinds below
MOVES = 1  # 1: the axis touches the surface at its nearest point; 0: at its start
FIELD = 2  # height field: start of its coefficients in ShapeArrays.fields
COUNT = 3  # 2: numbers of grid lines along x and y
SHAPE_KIND_SIZE = 5
# Kinds of surfaces; AS_POINT: the candidate is a point on the quadric of ContactArrays
AS_POINT, PLANE, SPHERE, CYLINDER, BOX, HEIGHT_FIELD, CAPSULE = 0, 1, 2, 3, 4, 5, 6
# The candidate is slot COUNT of pair FIELD of ShapeArrays.pairs.
PAIR = 7
# ShapeArrays.data
RADIUS = 0  # ρ [m]
D = 1  # 3: axis from its start to its end, in the body's frame [m]
POSITION = 4  # 3: point of a plane or an axis, centre, or first point of a grid (without height) [m]
AXES = 7  # 9: normal of a plane, axis of a cylinder; axes of a box in W, one after the other
SIZE = 16  # 3: radius, negative if the inside is free; half edges of a box without rounding; spacing of a grid [m]
EDGE = 19  # radius of the edges of a box [m]
SHAPE_SIZE = 20

# Maximum number of steps to the foot point on a height field; from a few grid spacings away, three to five are enough.
FOOT_STEPS = 40
# A step shorter than this fraction of the grid spacing is the last one, because convergence is quadratic.
FOOT_TOLERANCE = 1e-9
# Maximum number of steps along an axis over a box; most are Newton steps, the others bisections.
AXIS_STEPS = 60


class ShapeArrays(NamedTuple):
    """Contact candidates with their shapes and surfaces."""

    kind: np.ndarray  # (c, SHAPE_KIND_SIZE) int
    data: np.ndarray  # (c, SHAPE_SIZE)
    fields: np.ndarray  # B-spline coefficients of all height fields, (nx + 2) (ny + 2) each, one x after the other
    pairs: PairArrays | None = None  # pairs of solids, possibly none; None: no body carries a surface


@internal_kernel
def distance(shapes: ShapeArrays, k, x, y, z):
    """Return φ [m], n (3 numbers) and H (xx xy xz yy yz zz) [1/m] at a point of W, for the surface of candidate k."""
    kind, data = shapes.kind[k, SURFACE], shapes.data
    if kind == HEIGHT_FIELD:
        return field_distance(shapes, k, x, y, z)
    x, y, z = x - data[k, POSITION], y - data[k, POSITION + 1], z - data[k, POSITION + 2]
    nx, ny, nz = vector(data, k, AXES)
    if kind == PLANE:
        return nx * x + ny * y + nz * z, nx, ny, nz, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if kind == BOX:
        return box_distance(shapes, k, x, y, z)
    if kind == CAPSULE:
        return capsule_distance(shapes, k, x, y, z)
    # For a sphere or cylinder, H = (1 − n nᵀ)/r, without the part along the axis of a cylinder.
    if kind == CYLINDER:
        along = nx * x + ny * y + nz * z
        x, y, z = x - along * nx, y - along * ny, z - along * nz
    else:
        nx, ny, nz = 0.0, 0.0, 0.0
    r, size = math.sqrt(x * x + y * y + z * z), data[k, SIZE]
    sign = math.copysign(1.0, size)
    scale = 1.0 / max(r, 1e-300)
    x, y, z, h = x * scale, y * scale, z * scale, sign * scale
    hxx, hxy, hxz = h * (1.0 - x * x - nx * nx), h * (-x * y - nx * ny), h * (-x * z - nx * nz)
    hyy, hyz, hzz = h * (1.0 - y * y - ny * ny), h * (-y * z - ny * nz), h * (1.0 - z * z - nz * nz)
    return sign * r - size, sign * x, sign * y, sign * z, hxx, hxy, hxz, hyy, hyz, hzz


@internal_kernel
def capsule_distance(shapes: ShapeArrays, k, x, y, z):
    """As :func:`distance` for a capsule whose axis begins at the origin and is AXES."""
    data = shapes.data
    dx, dy, dz = data[k, AXES], data[k, AXES + 1], data[k, AXES + 2]
    length = dx * dx + dy * dy + dz * dz
    u = (x * dx + y * dy + z * dz) / length if length > 0.0 else 0.0
    between = 1.0 if 0.0 < u < 1.0 else 0.0
    u = min(max(u, 0.0), 1.0)
    x, y, z = x - u * dx, y - u * dy, z - u * dz
    r = math.sqrt(x * x + y * y + z * z)
    h = 1.0 / max(r, 1e-300)
    x, y, z = x * h, y * h, z * h
    e = between / length if length > 0.0 else 0.0
    return (
        r - data[k, SIZE],
        x,
        y,
        z,
        h * (1.0 - x * x - e * dx * dx),
        h * (-x * y - e * dx * dy),
        h * (-x * z - e * dx * dz),
        h * (1.0 - y * y - e * dy * dy),
        h * (-y * z - e * dy * dz),
        h * (1.0 - z * z - e * dz * dz),
    )


@internal_kernel
def nearest_to_capsule(shapes: ShapeArrays, k, x, y, z, dx, dy, dz):
    """:func:`nearest` of a capsule: of two segments; parallel ones in the middle of where they are side by side."""
    data = shapes.data
    ex, ey, ez = data[k, AXES], data[k, AXES + 1], data[k, AXES + 2]
    rx, ry, rz = x - data[k, POSITION], y - data[k, POSITION + 1], z - data[k, POSITION + 2]
    a, e = dx * dx + dy * dy + dz * dz, ex * ex + ey * ey + ez * ez
    b, c, f = dx * ex + dy * ey + dz * ez, dx * rx + dy * ry + dz * rz, ex * rx + ey * ry + ez * rz
    if e == 0.0:
        return min(max(-c / a, 0.0), 1.0)
    det = a * e - b * b
    if det <= 1e-12 * a * e:
        # Shares of the own axis at which the ends of the other are beside it.
        first, second = -c / a, (b - c) / a
        low, high = max(min(first, second), 0.0), min(max(first, second), 1.0)
        if low <= high:
            return 0.5 * (low + high)
        return 0.0 if max(first, second) < 0.0 else 1.0
    u = min(max((b * f - c * e) / det, 0.0), 1.0)
    t = (b * u + f) / e
    if t < 0.0:
        return min(max(-c / a, 0.0), 1.0)
    if t > 1.0:
        return min(max((b - c) / a, 0.0), 1.0)
    return u


@internal_kernel
def box_distance(shapes: ShapeArrays, k, x, y, z):
    """Compute :func:`distance` for a box centred at the origin.

    Let p be the point in the axes of the box, b the half edges without the rounding r, and o = max(|p| − b, 0). Outside
    the core b, φ = |o| − r, and n and H belong to a plane, a cylinder or a sphere if o has one, two or three nonzero
    components. Within the core, the nearest face is used.
    """
    data = shapes.data
    R = rotation(data, k, AXES)
    px, py, pz = rotate(R, (x, y, z))
    ox, oy, oz = abs(px) - data[k, SIZE], abs(py) - data[k, SIZE + 1], abs(pz) - data[k, SIZE + 2]
    inside = max(ox, max(oy, oz))
    if inside <= 0.0:
        ox, oy, oz = (1.0, 0.0, 0.0) if ox == inside else ((0.0, 1.0, 0.0) if oy == inside else (0.0, 0.0, 1.0))
        far, r = inside, 1.0
    else:
        ox, oy, oz = max(ox, 0.0), max(oy, 0.0), max(oz, 0.0)
        r = math.sqrt(ox * ox + oy * oy + oz * oz)
        far = r
    # φ is curved along the axes in which o has a component, if there are several such axes.
    fx, fy, fz = 1.0 if ox > 0.0 else 0.0, 1.0 if oy > 0.0 else 0.0, 1.0 if oz > 0.0 else 0.0
    h = 1.0 / r if fx + fy + fz > 1.0 else 0.0
    ox, oy, oz = math.copysign(ox, px) / r, math.copysign(oy, py) / r, math.copysign(oz, pz) / r
    # In the axes of the box H = h (diag(f) − o oᵀ); transform to W with the axes as rows.
    nx, ny, nz = rotate_back(R, (ox, oy, oz))
    x, y, z = first_axis(R), second_axis(R), third_axis(R)
    hxx = h * (fx * x[0] * x[0] + fy * x[1] * x[1] + fz * x[2] * x[2] - nx * nx)
    hxy = h * (fx * x[0] * y[0] + fy * x[1] * y[1] + fz * x[2] * y[2] - nx * ny)
    hxz = h * (fx * x[0] * z[0] + fy * x[1] * z[1] + fz * x[2] * z[2] - nx * nz)
    hyy = h * (fx * y[0] * y[0] + fy * y[1] * y[1] + fz * y[2] * y[2] - ny * ny)
    hyz = h * (fx * y[0] * z[0] + fy * y[1] * z[1] + fz * y[2] * z[2] - ny * nz)
    hzz = h * (fx * z[0] * z[0] + fy * z[1] * z[1] + fz * z[2] * z[2] - nz * nz)
    return far - data[k, EDGE], nx, ny, nz, hxx, hxy, hxz, hyy, hyz, hzz


@internal_kernel
def field_distance(shapes: ShapeArrays, k, x, y, z):
    """Compute :func:`distance` for a height field; the normal n at the foot point c = (u, v, h(u, v)) meets the point.

    c is found by Newton's method on ½ |r − c|², starting from the point of the field straight below r. With e = z − h,
    X = ∂c/∂(u, v) and G = XᵀX, the second derivative is G − e ∂²h. Steps are halved if the distance grows. Then
    φ = n·(r − c) and

        H = X G⁻¹ B (G + φ B)⁻¹ Xᵀ,   B = −∂²h / √(1 + |∇h|²):

    a step dr moves c by X (G + φ B)⁻¹ Xᵀ dr, and n by X G⁻¹ B (G + φ B)⁻¹ Xᵀ dr. This is valid within the radius of
    curvature.
    """
    data = shapes.data
    size = min(data[k, SIZE], data[k, SIZE + 1])
    u, v, from_u, from_v, step_u, step_v, best = x, y, x, y, 0.0, 0.0, math.inf
    last = False
    h, p, q, a, b, c = field_height(shapes, k, u, v)
    for _ in range(FOOT_STEPS):
        e = z - h
        square = (x - u) * (x - u) + (y - v) * (y - v) + e * e
        if last:
            break
        if square > best * (1.0 + 1e-12):
            step_u, step_v = 0.5 * step_u, 0.5 * step_v
        else:
            best, from_u, from_v = square, u, v
            gu, gv = x - u + e * p, y - v + e * q
            guu, guv, gvv = 1.0 + p * p, p * q, 1.0 + q * q
            muu, muv, mvv = guu - e * a, guv - e * b, gvv - e * c
            det = muu * mvv - muv * muv
            if not (muu > 0.0 and det > 1e-3 * guu * gvv):  # no minimum nearby: use a Gauss–Newton step
                muu, muv, mvv = guu, guv, gvv
                det = muu * mvv - muv * muv
            step_u, step_v = (mvv * gu - muv * gv) / det, (muu * gv - muv * gu) / det
        last = step_u * step_u + step_v * step_v <= FOOT_TOLERANCE * FOOT_TOLERANCE * size * size
        u, v = from_u + step_u, from_v + step_v
        h, p, q, a, b, c = field_height(shapes, k, u, v)
    steep = 1.0 / math.sqrt(1.0 + p * p + q * q)
    nx, ny, nz = -p * steep, -q * steep, steep
    far = nx * (x - u) + ny * (y - v) + nz * (z - h)
    # B, G⁻¹ B and (G + φ B)⁻¹.
    a, b, c = -a * steep, -b * steep, -c * steep
    guu, guv, gvv = 1.0 + p * p, p * q, 1.0 + q * q
    det = 1.0 / (guu * gvv - guv * guv)
    k00, k01 = det * (gvv * a - guv * b), det * (gvv * b - guv * c)
    k10, k11 = det * (guu * b - guv * a), det * (guu * c - guv * b)
    guu, guv, gvv = guu + far * a, guv + far * b, gvv + far * c
    det = 1.0 / (guu * gvv - guv * guv)
    m00, m01 = det * (k00 * gvv - k01 * guv), det * (k01 * guu - k00 * guv)
    m11 = det * (k11 * guu - k10 * guv)
    # X = ((1, 0, p), (0, 1, q)) as columns.
    xz, yz = m00 * p + m01 * q, m01 * p + m11 * q
    return far, nx, ny, nz, m00, m01, xz, m11, yz, p * xz + q * yz


@internal_kernel
def field_height(shapes: ShapeArrays, k, x, y):
    """Return h and its derivatives x, y, xx, xy, yy at a point of the field, extrapolated linearly beyond the grid."""
    fields, data, kind = shapes.fields, shapes.data, shapes.kind
    nx, ny = kind[k, COUNT], kind[k, COUNT + 1]
    i, u, du, ddu = spline_weights((x - data[k, POSITION]) / data[k, SIZE], 1.0 / data[k, SIZE], nx)
    j, v, dv, ddv = spline_weights((y - data[k, POSITION + 1]) / data[k, SIZE + 1], 1.0 / data[k, SIZE + 1], ny)
    h, p, q, a, b, c = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for s in range(4):
        f = kind[k, FIELD] + (j + s) * (nx + 2) + i
        f0, f1, f2, f3 = fields[f], fields[f + 1], fields[f + 2], fields[f + 3]
        value = u[0] * f0 + u[1] * f1 + u[2] * f2 + u[3] * f3
        slope = du[0] * f0 + du[1] * f1 + du[2] * f2 + du[3] * f3
        bend = ddu[0] * f0 + ddu[1] * f1 + ddu[2] * f2 + ddu[3] * f3
        h, p, q = h + v[s] * value, p + v[s] * slope, q + dv[s] * value
        a, b, c = a + v[s] * bend, b + dv[s] * slope, c + ddv[s] * value
    return h, p, q, a, b, c


@internal_kernel
def spline_weights(x, per, count):
    """Return the cell that contains x, and the weights of its four uniform cubic B-splines with two derivatives.

    ``per`` is 1 / spacing. Beyond the first and last of ``count`` grid points, the weights are extrapolated linearly.
    """
    clamped = min(max(x, 0.0), count - 1.0)
    # NaN converts to an arbitrary integer.
    i = max(min(int(clamped), count - 2), 0)
    t, beyond = clamped - i, x - clamped
    s = 1.0 - t
    d0, d1, d2, d3 = -0.5 * s * s, (1.5 * t - 2.0) * t, (1.0 - 1.5 * t) * t + 0.5, 0.5 * t * t
    w0, w1 = s * s * s / 6.0 + beyond * d0, (0.5 * t - 1.0) * t * t + 2.0 / 3.0 + beyond * d1
    w2, w3 = ((1.0 - t) * t + 1.0) * 0.5 * t + 1.0 / 6.0 + beyond * d2, t * t * t / 6.0 + beyond * d3
    square = per * per if beyond == 0.0 else 0.0
    slopes = per * d0, per * d1, per * d2, per * d3
    curvatures = square * s, square * (3.0 * t - 2.0), square * (1.0 - 3.0 * t), square * t
    return i, (w0, w1, w2, w3), slopes, curvatures


@internal_kernel
def nearest(shapes: ShapeArrays, k, x, y, z, dx, dy, dz):
    """Return u in [0, 1] at which x + u d is nearest to the surface of candidate k.

    The surface is a sphere, a cylinder or a box, seen from outside. Spheres and cylinders have a closed-form solution.
    For a box, φ is convex, so n·d grows with u, and Newton's method within brackets finds the root. If the distance is
    constant over an interval, the middle of the interval is returned.
    """
    kind, data = shapes.kind[k, SURFACE], shapes.data
    if kind == BOX:
        return nearest_to_box(shapes, k, x, y, z, dx, dy, dz)
    if kind == CAPSULE:
        return nearest_to_capsule(shapes, k, x, y, z, dx, dy, dz)
    x, y, z = data[k, POSITION] - x, data[k, POSITION + 1] - y, data[k, POSITION + 2] - z
    length = dx * dx + dy * dy + dz * dz
    if kind == CYLINDER:
        nx, ny, nz = vector(data, k, AXES)
        along = nx * dx + ny * dy + nz * dz
        dx, dy, dz = dx - along * nx, dy - along * ny, dz - along * nz
    across = dx * dx + dy * dy + dz * dz
    if across <= 1e-14 * length:
        return 0.5
    return min(max((x * dx + y * dy + z * dz) / across, 0.0), 1.0)


@internal_kernel
def nearest_to_box(shapes: ShapeArrays, k, x, y, z, dx, dy, dz):
    """Compute :func:`nearest` for a box."""
    low, high, u = 0.0, 1.0, 0.5
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    for step in range(AXIS_STEPS):
        # Try both ends first, because most axes do not pass over an edge.
        at = 0.0 if step == 0 else 1.0 if step == 1 else u
        _, nx, ny, nz, hxx, hxy, hxz, hyy, hyz, hzz = distance(shapes, k, x + at * dx, y + at * dy, z + at * dz)
        slope = nx * dx + ny * dy + nz * dz
        if step == 0:
            if slope > 1e-14 * length:
                return 0.0
        elif step == 1:
            if slope < -1e-14 * length:
                return 1.0
        else:
            if abs(slope) <= 1e-15 * length:
                return u
            if slope < 0.0:
                low = u
            else:
                high = u
            bend = dx * (hxx * dx + 2.0 * (hxy * dy + hxz * dz)) + dy * (hyy * dy + 2.0 * hyz * dz) + dz * hzz * dz
            trial = u - slope / bend if bend > 0.0 else low
            # At the limit of rounding, a Newton step does not change u; along a flat face, no Newton step exists.
            if bend > 0.0 and trial == u:
                return u
            u = trial if low < trial < high else 0.5 * (low + high)
            if high - low <= 1e-15:
                return u
    return u


@kernel
def surface_distances(shapes: ShapeArrays, points, gaps, normals):
    """Write φ [m] and n of the surface of candidate 0 at points, (T, 3), to ``gaps``, (T,), and ``normals``, (T, 3)."""
    for t in range(points.shape[0]):
        gap = distance(shapes, 0, points[t, 0], points[t, 1], points[t, 2])
        gaps[t], normals[t, 0], normals[t, 1], normals[t, 2] = gap[0], gap[1], gap[2], gap[3]


@kernel
def nearest_points(shapes: ShapeArrays, starts, along, u):
    """Apply :func:`nearest` for candidate 0 to axes from ``starts`` along ``along``, (T, 3); results in ``u``, (T,)."""
    for t in range(starts.shape[0]):
        u[t] = nearest(shapes, 0, starts[t, 0], starts[t, 1], starts[t, 2], along[t, 0], along[t, 1], along[t, 2])
