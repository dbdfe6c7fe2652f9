"""Contact geometry of spheres and capsules, and of surfaces given by a signed distance.

A candidate is a sphere of radius ρ about a point s of its body, or about the point of a straight axis s = a + u d,
0 ≤ u ≤ 1, that is nearest to the surface. A surface is its signed distance φ with n = ∇φ, |n| = 1, and H = ∂²φ:

    gap       g = φ(s) − ρ,   it touches at c = s − ρ n
    rate      ġ = n · v                                     v: velocity of the body's point at s
    second    g̈ = n · a + v·H v − (v·H d + n·(ω × d))² / (d·H d)

The last term is due to the motion of the nearest point along the axis, u̇ = −(v·H d + n·(ω × d)) / (d·H d). φ is
stationary in u there, so u̇ is not in ġ. The term is absent where u is constant: for spheres, and at the ends.
"""

from __future__ import annotations

import math

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import distance as kd
from dynsim.dynamics.contact.distance import ShapeArrays, distance, nearest
from dynsim.dynamics.contact.quadrics import signed_friction, unit_force
from dynsim.dynamics.contact.rows import point_row, sticking_rows, tangents
from dynsim.dynamics.contact.unilateral import UnilateralArrays, slide_direction
from dynsim.dynamics.tables import ContactArrays, ModelArrays, Workspace
from dynsim.dynamics.tree.spatial import (
    along,
    cross,
    dot_vector,
    point_acceleration,
    point_velocity,
    put_vector,
    rotate,
    rotation,
    six,
    times_inertia,
    times_number,
    transform,
    vector,
)
from dynsim.jit.kernel import internal_kernel

# sin² of the angle between an axis and the direction of constant distance. Below it u̇ = 0: the axis is parallel to
# that of a cylinder, say, and no point of it is nearest.
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
    R = rotation(links, i, ka.R)
    s = transform(vector(links, i, ka.P), R, vector(point, k, ka.POINT))
    d = rotate(R, vector(data, k, kd.D))
    u = 0.0
    if shapes.kind[k, kd.MOVES] != 0:
        u = nearest(shapes, k, s[0], s[1], s[2], d[0], d[1], d[2])
        s = along(s, d, u)
    far, nx, ny, nz, hxx, hxy, hxz, hyy, hyz, hzz = distance(shapes, k, s[0], s[1], s[2])
    n, H = (nx, ny, nz), (hxx, hxy, hxz, hyy, hyz, hzz)
    # Velocity of the body's point at s, and its acceleration at vdot = 0 (A carries −g from its root).
    V = six(links, i, ka.V)
    w, v, a = (V[0], V[1], V[2]), point_velocity(V, s), point_acceleration(six(links, i, ka.A), V, s)
    a = a[0] + model.gravity[0], a[1] + model.gravity[1], a[2] + model.gravity[2]
    # H v, which becomes ṅ = H ṡ, and v, which becomes ṡ.
    n_rate, s_rate = times_inertia(H, v), v
    second = dot_vector(n, a) + dot_vector(v, n_rate)
    if 0.0 < u < 1.0:
        H_d = times_inertia(H, d)
        bent = dot_vector(d, H_d)
        if bent > ALONG * dot_vector(d, d) * (hxx + hyy + hzz):
            mixed = dot_vector(v, H_d) + dot_vector(n, cross(w, d))
            speed = -mixed / bent
            second += speed * mixed
            n_rate, s_rate = along(n_rate, H_d, speed), along(s_rate, d, speed)
    c = along(s, n, -radius)
    rate = dot_vector(n, v)
    v = along(v, cross(w, n), -radius)
    slip = along(v, n, -rate)
    if unilateral is None:
        t = times_number(
            slip, 1.0 / math.sqrt(dot_vector(slip, slip) + contacts.law[k, ka.V_S] * contacts.law[k, ka.V_S])
        )
    else:
        tx, ty, tz, rows[m, ka.ROW_MU] = slide_direction(unilateral, contacts, k, slip, n)
        t = tx, ty, tz
    state[k, ka.GAP], state[k, ka.GAP_RATE], rows[m, ka.TARGET] = far - radius, rate, -second
    put_vector(state, k, ka.POSITION, c)
    put_vector(state, k, ka.NORMAL, n)
    put_vector(state, k, ka.SLIP_VELOCITY, slip)
    put_vector(state, k, ka.TANGENT, t)
    point_row(rows, m, c, n)
    unit_force(rows, m, signed_friction(ws, m), c, n, t)
    if ws.active[k, ka.MODE] != ka.STICKING:
        return
    rolls = radius > 0.0 or shapes.kind[k, kd.MOVES] != 0
    if rolls:
        # It rolls on from where it has begun to stick: any two tangents of the place where it is span the same rows.
        tangents(ws, k)
    sticking_rows(model, ws, k, i)
    if rolls:
        # v_c − ċ
        left = along(along(v, s_rate, -1.0), n_rate, radius)
        extra = cross(w, left)
        for r in range(m + 1, m + 3):
            rows[r, ka.TARGET] += dot_vector(vector(rows, r, ka.ROW + 3), extra)
            rows[r, ka.ROW_GAP] = 0.0
