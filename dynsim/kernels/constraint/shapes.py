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

from dynsim.kernels import arrays as ka
from dynsim.kernels.arrays import ContactArrays, ModelArrays, Workspace
from dynsim.kernels.constraint import distance as kd
from dynsim.kernels.constraint.distance import ShapeArrays, distance, nearest
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
        if shapes.kind[k, kd.SURFACE] != kd.AS_POINT:
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
    i, m, radius = contacts.link[k, ka.LINK], ws.active[k, ka.FIRST_ROW], shapes.data[k, kd.RADIUS]
    x, y, z = point[k, ka.POINT], point[k, ka.POINT + 1], point[k, ka.POINT + 2]
    sx = links[i, ka.P] + links[i, ka.R] * x + links[i, ka.R + 1] * y + links[i, ka.R + 2] * z
    sy = links[i, ka.P + 1] + links[i, ka.R + 3] * x + links[i, ka.R + 4] * y + links[i, ka.R + 5] * z
    sz = links[i, ka.P + 2] + links[i, ka.R + 6] * x + links[i, ka.R + 7] * y + links[i, ka.R + 8] * z
    x, y, z = data[k, kd.D], data[k, kd.D + 1], data[k, kd.D + 2]
    dx = links[i, ka.R] * x + links[i, ka.R + 1] * y + links[i, ka.R + 2] * z
    dy = links[i, ka.R + 3] * x + links[i, ka.R + 4] * y + links[i, ka.R + 5] * z
    dz = links[i, ka.R + 6] * x + links[i, ka.R + 7] * y + links[i, ka.R + 8] * z
    u = 0.0
    if shapes.kind[k, kd.MOVES] != 0:
        u = nearest(shapes, k, sx, sy, sz, dx, dy, dz)
        sx, sy, sz = sx + u * dx, sy + u * dy, sz + u * dz
    far, nx, ny, nz, hxx, hxy, hxz, hyy, hyz, hzz = distance(shapes, k, sx, sy, sz)
    # Velocity of the body's point at s, and its acceleration at vdot = 0 (A carries −g from its root).
    wx, wy, wz = links[i, ka.V], links[i, ka.V + 1], links[i, ka.V + 2]
    vx = links[i, ka.V + 3] + wy * sz - wz * sy
    vy = links[i, ka.V + 4] + wz * sx - wx * sz
    vz = links[i, ka.V + 5] + wx * sy - wy * sx
    ex, ey, ez = links[i, ka.A], links[i, ka.A + 1], links[i, ka.A + 2]
    ax = links[i, ka.A + 3] + model.gravity[0] + ey * sz - ez * sy + wy * vz - wz * vy
    ay = links[i, ka.A + 4] + model.gravity[1] + ez * sx - ex * sz + wz * vx - wx * vz
    az = links[i, ka.A + 5] + model.gravity[2] + ex * sy - ey * sx + wx * vy - wy * vx
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
        scale = 1.0 / math.sqrt(tx * tx + ty * ty + tz * tz + point[k, ka.V_S] * point[k, ka.V_S])
        gx, gy, gz = tx * scale, ty * scale, tz * scale
    else:
        gx, gy, gz, rows[m, ka.ROW_MU] = slide_direction(unilateral, contacts, k, tx, ty, tz)
    state[k, ka.GAP], state[k, ka.GAP_RATE], rows[m, ka.TARGET] = far - radius, rate, -second
    state[k, ka.POSITION], state[k, ka.POSITION + 1], state[k, ka.POSITION + 2] = cx, cy, cz
    state[k, ka.NORMAL], state[k, ka.NORMAL + 1], state[k, ka.NORMAL + 2] = nx, ny, nz
    state[k, ka.SLIP_VELOCITY], state[k, ka.SLIP_VELOCITY + 1], state[k, ka.SLIP_VELOCITY + 2] = tx, ty, tz
    state[k, ka.TANGENT], state[k, ka.TANGENT + 1], state[k, ka.TANGENT + 2] = gx, gy, gz
    point_row(rows, m, cx, cy, cz, nx, ny, nz)
    unit_force(rows, m, signed_friction(ws, m), cx, cy, cz, nx, ny, nz, gx, gy, gz)
    if ws.active[k, ka.MODE] != ka.STICKING:
        return
    rolls = radius > 0.0 or shapes.kind[k, kd.MOVES] != 0
    if rolls:
        # It rolls on from where it has begun to stick: any two tangents of the place where it is span the same rows.
        tangents(ws, k)
    sticking_rows(model, ws, k, i)
    if rolls:
        lx, ly, lz = vx - (mx - radius * hx), vy - (my - radius * hy), vz - (mz - radius * hz)
        lx, ly, lz = wy * lz - wz * ly, wz * lx - wx * lz, wx * ly - wy * lx
        for r in range(m + 1, m + 3):
            rows[r, ka.TARGET] += rows[r, ka.ROW + 3] * lx + rows[r, ka.ROW + 4] * ly + rows[r, ka.ROW + 5] * lz
            rows[r, ka.ROW_GAP] = 0.0
