"""Candidates that are more than a point on a quadric: spheres and capsules, and surfaces with a distance of their own.

A candidate is a sphere of radius ρ about a point s of its body, or about the point of a straight axis s = a + u d,
0 ≤ u ≤ 1, that is nearest to the surface. A surface is its signed distance φ with n = ∇φ, |n| = 1, and H = ∂²φ:

    gap       g = φ(s) − ρ,   it touches at c = s − ρ n
    rate      ġ = n · v                                     v: velocity of the body's point at s
    second    g̈ = n · a + v·H v − (v·H d + n·(ω × d))² / (d·H d)

The last term is that of the nearest point as it moves along the axis, u̇ = −(v·H d + n·(ω × d)) / (d·H d): from
min over u of φ, whose first derivative does not feel u̇. It is absent where u is held: of spheres, and at the ends.
"""

from __future__ import annotations

import math

from dynsim.kernels.arrays import (
    FIRST_ROW,
    GAP,
    GAP_RATE,
    LINK,
    MODE,
    NORMAL,
    POINT,
    POSITION,
    ROW,
    ROW_GAP,
    ROW_MU,
    SLIP_VELOCITY,
    STICKING,
    TANGENT,
    TARGET,
    V_S,
    A,
    ContactArrays,
    ModelArrays,
    P,
    R,
    V,
    Workspace,
)
from dynsim.kernels.constraint.distance import AS_POINT, MOVES, RADIUS, SURFACE, D, ShapeArrays, distance, nearest
from dynsim.kernels.constraint.rows import point_row, sticking_rows, tangents
from dynsim.kernels.constraint.surface import signed_friction, unit_force
from dynsim.kernels.constraint.unilateral import UnilateralArrays, slide_direction
from dynsim.kernels.jit import internal_kernel

# sin² of the angle between an axis and the direction along which the distance does not change, below which the nearest
# point has no speed: the axis lies along a cylinder.
ALONG = 1e-8


@internal_kernel
def shaped_rows(
    shapes, unilateral: UnilateralArrays | None, model: ModelArrays, contacts: ContactArrays, ws: Workspace
):
    """Overwrite what ``contact_rows`` has made of the candidates that are no points on quadrics; None: there are none.

    Position (the point of contact c), gap, slip, row, target and direction as there, and the rows of those that stick.
    """
    if shapes is None:  # known to the compiler, which then leaves shapes out of the default program
        return
    for k in range(contacts.link.shape[0]):
        if shapes.kind[k, SURFACE] != AS_POINT:
            shaped_row(shapes, unilateral, model, contacts, ws, k)


@internal_kernel
def shaped_row(
    shapes: ShapeArrays,
    unilateral: UnilateralArrays | None,
    model: ModelArrays,
    contacts: ContactArrays,
    ws: Workspace,
    k,
):
    """Geometry and rows of one candidate.

    Friction acts at c, along the velocity of the body's point there. Where it sticks it rolls: its tangential rows are
    t · v_c = 0 for the point of the body that is at c now, which another one follows. With v_c = v_O + ω × c

        t · (v̇_O + ω̇ × c + ω × ċ) = 0,   ċ = ṡ − ρ H ṡ,   ṡ = v + u̇ d,

    so that against a point that is held, ω × v_c becomes ω × ċ. There is no place to which it must return.
    """
    links, state, rows, point, data = ws.links, ws.contacts, ws.rows, contacts.point, shapes.data
    i, m, radius = contacts.link[k, LINK], ws.active[k, FIRST_ROW], shapes.data[k, RADIUS]
    x, y, z = point[k, POINT], point[k, POINT + 1], point[k, POINT + 2]
    sx = links[i, P] + links[i, R] * x + links[i, R + 1] * y + links[i, R + 2] * z
    sy = links[i, P + 1] + links[i, R + 3] * x + links[i, R + 4] * y + links[i, R + 5] * z
    sz = links[i, P + 2] + links[i, R + 6] * x + links[i, R + 7] * y + links[i, R + 8] * z
    x, y, z = data[k, D], data[k, D + 1], data[k, D + 2]
    dx = links[i, R] * x + links[i, R + 1] * y + links[i, R + 2] * z
    dy = links[i, R + 3] * x + links[i, R + 4] * y + links[i, R + 5] * z
    dz = links[i, R + 6] * x + links[i, R + 7] * y + links[i, R + 8] * z
    u = 0.0
    if shapes.kind[k, MOVES] != 0:
        u = nearest(shapes, k, sx, sy, sz, dx, dy, dz)
        sx, sy, sz = sx + u * dx, sy + u * dy, sz + u * dz
    far, nx, ny, nz, hxx, hxy, hxz, hyy, hyz, hzz = distance(shapes, k, sx, sy, sz)
    # Velocity of the body's point at s, and its acceleration at vdot = 0 (A carries −g from its root).
    wx, wy, wz = links[i, V], links[i, V + 1], links[i, V + 2]
    vx = links[i, V + 3] + wy * sz - wz * sy
    vy = links[i, V + 4] + wz * sx - wx * sz
    vz = links[i, V + 5] + wx * sy - wy * sx
    ex, ey, ez = links[i, A], links[i, A + 1], links[i, A + 2]
    ax = links[i, A + 3] + model.gravity[0] + ey * sz - ez * sy + wy * vz - wz * vy
    ay = links[i, A + 4] + model.gravity[1] + ez * sx - ex * sz + wz * vx - wx * vz
    az = links[i, A + 5] + model.gravity[2] + ex * sy - ey * sx + wx * vy - wy * vx
    # H v, which becomes ṅ = H ṡ, and v, which becomes ṡ.
    hx, hy, hz = hxx * vx + hxy * vy + hxz * vz, hxy * vx + hyy * vy + hyz * vz, hxz * vx + hyz * vy + hzz * vz
    second = nx * ax + ny * ay + nz * az + vx * hx + vy * hy + vz * hz
    mx, my, mz = vx, vy, vz
    if 0.0 < u < 1.0:
        qx, qy, qz = hxx * dx + hxy * dy + hxz * dz, hxy * dx + hyy * dy + hyz * dz, hxz * dx + hyz * dy + hzz * dz
        bent = dx * qx + dy * qy + dz * qz
        if bent > ALONG * (dx * dx + dy * dy + dz * dz) * (hxx + hyy + hzz):
            turned = nx * (wy * dz - wz * dy) + ny * (wz * dx - wx * dz) + nz * (wx * dy - wy * dx)
            mixed = vx * qx + vy * qy + vz * qz + turned
            speed = -mixed / bent
            second += speed * mixed
            hx, hy, hz = hx + speed * qx, hy + speed * qy, hz + speed * qz
            mx, my, mz = mx + speed * dx, my + speed * dy, mz + speed * dz
    cx, cy, cz = sx - radius * nx, sy - radius * ny, sz - radius * nz
    rate = nx * vx + ny * vy + nz * vz
    vx, vy, vz = vx - radius * (wy * nz - wz * ny), vy - radius * (wz * nx - wx * nz), vz - radius * (wx * ny - wy * nx)
    tx, ty, tz = vx - rate * nx, vy - rate * ny, vz - rate * nz
    if unilateral is None:
        scale = 1.0 / math.sqrt(tx * tx + ty * ty + tz * tz + point[k, V_S] * point[k, V_S])
        gx, gy, gz = tx * scale, ty * scale, tz * scale
    else:
        gx, gy, gz, rows[m, ROW_MU] = slide_direction(unilateral, contacts, k, tx, ty, tz)
    state[k, GAP], state[k, GAP_RATE], rows[m, TARGET] = far - radius, rate, -second
    state[k, POSITION], state[k, POSITION + 1], state[k, POSITION + 2] = cx, cy, cz
    state[k, NORMAL], state[k, NORMAL + 1], state[k, NORMAL + 2] = nx, ny, nz
    state[k, SLIP_VELOCITY], state[k, SLIP_VELOCITY + 1], state[k, SLIP_VELOCITY + 2] = tx, ty, tz
    state[k, TANGENT], state[k, TANGENT + 1], state[k, TANGENT + 2] = gx, gy, gz
    point_row(rows, m, cx, cy, cz, nx, ny, nz)
    unit_force(rows, m, signed_friction(ws, m), cx, cy, cz, nx, ny, nz, gx, gy, gz)
    if ws.active[k, MODE] != STICKING:
        return
    rolls = radius > 0.0 or shapes.kind[k, MOVES] != 0
    if rolls:
        # It rolls on from where it has begun to stick: any two tangents of the place where it is span the same rows.
        tangents(ws, k)
    sticking_rows(model, ws, k, i)
    if rolls:
        lx, ly, lz = vx - (mx - radius * hx), vy - (my - radius * hy), vz - (mz - radius * hz)
        lx, ly, lz = wy * lz - wz * ly, wz * lx - wx * lz, wx * ly - wy * lx
        for r in range(m + 1, m + 3):
            rows[r, TARGET] += rows[r, ROW + 3] * lx + rows[r, ROW + 4] * ly + rows[r, ROW + 5] * lz
            rows[r, ROW_GAP] = 0.0
