"""Points held to surfaces: geometry of the candidates, slip direction, and constraint rows of the active ones."""

from __future__ import annotations

import math

from dynsim.kernels import arrays as ka
from dynsim.kernels.arrays import ContactArrays, ModelArrays, Workspace
from dynsim.kernels.constraint.rows import point_row, sticking_rows
from dynsim.kernels.constraint.unilateral import UnilateralArrays, slide_direction
from dynsim.kernels.jit import exact_kernel, internal_kernel

# Tries, beyond two per contact, to find signs of dissipative contacts that agree with their forces.
SIGN_PASSES = 64
# With more contacts than this not every choice of signs is tried.
SIGNS_LIMIT = 8
# A normal force below this fraction of the largest one is rounding.
NO_FORCE = 1e-12


@internal_kernel
def surface_distance(value, slope, curvature):
    """Signed distance along the normal from the level-set value: root of C − |∇C| s + κ s²/2 with κ = nᵀQn.

    Exact for the plane, the sphere and the cylinder.
    """
    inner = 1.0 - 2.0 * curvature * value / (slope * slope)
    if inner <= 0.0:
        return value / slope
    return 2.0 * value / (slope * (1.0 + math.sqrt(inner)))


@internal_kernel
def hessian_product(point, k, x, y, z):
    """(x, y, z)·Q (x, y, z) of the surface of contact k; point: (c, POINT_SIZE)."""
    return (
        x * (point[k, ka.QUADRIC] * x + 2.0 * (point[k, ka.QUADRIC + 1] * y + point[k, ka.QUADRIC + 2] * z))
        + y * (point[k, ka.QUADRIC + 3] * y + 2.0 * point[k, ka.QUADRIC + 4] * z)
        + z * point[k, ka.QUADRIC + 5] * z
    )


@internal_kernel
def contact_rows(model: ModelArrays, contacts: ContactArrays, unilateral: UnilateralArrays | None, ws: Workspace):
    """Position, gap, slip, constraint row and force direction of every candidate, after ``forward_sweep``.

    A candidate that is off its surface has a row too, behind the active ones: geometry without branches.

    C(r) = r·Q r/2 + b·r + c, n = ∇C/|∇C| ([WM] eqs 3, 6, 8); a gap > 0 is off the surface. Row:
    n·r̈ = −ṙᵀ(∂²C/∂r²)ṙ / |∇C| ([WM] eqs 15, 30). Force per unit f_n: n − σ μ t with the smoothed slip direction
    t = v_t / √(|v_t|² + v_s²) ([WM] eqs 9, 14 and f_t = μ f_n); v_s is dynsim's assumption, the paper says nothing
    of zero slip. σ is 1 in the paper's law; for the dissipative law it is the sign of f_n, kept between calls. Under
    the unilateral law t and μ are those of :func:`~dynsim.kernels.constraint.unilateral.slide_direction`.
    """
    links, state, rows, point, gravity = ws.links, ws.contacts, ws.rows, contacts.point, model.gravity
    for k in range(contacts.link.shape[0]):
        i, m = contacts.link[k, ka.LINK], ws.active[k, ka.FIRST_ROW]
        mu = signed_friction(ws, m)
        x, y, z = point[k, ka.POINT], point[k, ka.POINT + 1], point[k, ka.POINT + 2]
        rx = links[i, ka.P] + links[i, ka.R] * x + links[i, ka.R + 1] * y + links[i, ka.R + 2] * z
        ry = links[i, ka.P + 1] + links[i, ka.R + 3] * x + links[i, ka.R + 4] * y + links[i, ka.R + 5] * z
        rz = links[i, ka.P + 2] + links[i, ka.R + 6] * x + links[i, ka.R + 7] * y + links[i, ka.R + 8] * z
        # ∇C and C; a plane's ∇C is its unit normal, which spares every right-hand side two roots and three divisions.
        nx, ny, nz = point[k, ka.QUADRIC + 6], point[k, ka.QUADRIC + 7], point[k, ka.QUADRIC + 8]
        gap = nx * rx + ny * ry + nz * rz + point[k, ka.QUADRIC + 9]
        inverse, curved = 1.0, contacts.link[k, ka.CURVED] != 0
        if curved:
            qx = point[k, ka.QUADRIC] * rx + point[k, ka.QUADRIC + 1] * ry + point[k, ka.QUADRIC + 2] * rz
            qy = point[k, ka.QUADRIC + 1] * rx + point[k, ka.QUADRIC + 3] * ry + point[k, ka.QUADRIC + 4] * rz
            qz = point[k, ka.QUADRIC + 2] * rx + point[k, ka.QUADRIC + 4] * ry + point[k, ka.QUADRIC + 5] * rz
            nx, ny, nz = nx + qx, ny + qy, nz + qz
            slope = math.sqrt(nx * nx + ny * ny + nz * nz)
            inverse = 1.0 / slope
            nx, ny, nz = nx * inverse, ny * inverse, nz * inverse
            value = gap + 0.5 * (qx * rx + qy * ry + qz * rz)
            gap = surface_distance(value, slope, hessian_product(point, k, nx, ny, nz))
        # Velocity of the point, and its acceleration at vdot = 0 (A carries −g from its root).
        wx, wy, wz = links[i, ka.V], links[i, ka.V + 1], links[i, ka.V + 2]
        vx = links[i, ka.V + 3] + wy * rz - wz * ry
        vy = links[i, ka.V + 4] + wz * rx - wx * rz
        vz = links[i, ka.V + 5] + wx * ry - wy * rx
        ex, ey, ez = links[i, ka.A], links[i, ka.A + 1], links[i, ka.A + 2]
        ax = links[i, ka.A + 3] + gravity[0] + ey * rz - ez * ry + wy * vz - wz * vy
        ay = links[i, ka.A + 4] + gravity[1] + ez * rx - ex * rz + wz * vx - wx * vz
        az = links[i, ka.A + 5] + gravity[2] + ex * ry - ey * rx + wx * vy - wy * vx
        rate = nx * vx + ny * vy + nz * vz
        tx, ty, tz = vx - rate * nx, vy - rate * ny, vz - rate * nz
        if unilateral is None:
            scale = 1.0 / math.sqrt(tx * tx + ty * ty + tz * tz + point[k, ka.V_S] * point[k, ka.V_S])
            sx, sy, sz = tx * scale, ty * scale, tz * scale
        else:
            sx, sy, sz, mu = slide_direction(unilateral, contacts, k, tx, ty, tz)
            rows[m, ka.ROW_MU] = mu
        state[k, ka.GAP] = gap
        state[k, ka.GAP_RATE] = rate
        target = -(nx * ax + ny * ay + nz * az)
        rows[m, ka.TARGET] = target - hessian_product(point, k, vx, vy, vz) * inverse if curved else target
        state[k, ka.POSITION], state[k, ka.POSITION + 1], state[k, ka.POSITION + 2] = rx, ry, rz
        state[k, ka.NORMAL], state[k, ka.NORMAL + 1], state[k, ka.NORMAL + 2] = nx, ny, nz
        state[k, ka.SLIP_VELOCITY], state[k, ka.SLIP_VELOCITY + 1], state[k, ka.SLIP_VELOCITY + 2] = tx, ty, tz
        # From here on nothing is read back: stores to one table keep the compiler from trusting the other.
        state[k, ka.TANGENT], state[k, ka.TANGENT + 1], state[k, ka.TANGENT + 2] = sx, sy, sz
        point_row(rows, m, rx, ry, rz, nx, ny, nz)
        unit_force(rows, m, mu, rx, ry, rz, nx, ny, nz, sx, sy, sz)
    if ws.counts[ka.HELD] == 0:
        return
    for k in range(contacts.link.shape[0]):
        if ws.active[k, ka.MODE] == ka.STICKING:
            sticking_rows(model, ws, k, contacts.link[k, ka.LINK])


@internal_kernel
def signed_friction(ws: Workspace, m):
    """σ μ of row m."""
    mu = ws.rows[m, ka.ROW_MU]
    return mu * ws.rows[m, ka.SIGN] if ws.active[m, ka.LAW] == ka.FRICTION_DISSIPATIVE else mu


@exact_kernel
def unit_force(rows, m, mu, x, y, z, nx, ny, nz, tx, ty, tz):
    """Wrench of a unit normal force with its friction, n − σ μ t through the contact point, as DIRECTION of row m.

    The same bits where it is first made and where a sign has turned, so that a right-hand side does not depend on the
    signs of the one before.
    """
    fx, fy, fz = nx - mu * tx, ny - mu * ty, nz - mu * tz
    rows[m, ka.DIRECTION], rows[m, ka.DIRECTION + 1], rows[m, ka.DIRECTION + 2] = (
        y * fz - z * fy,
        z * fx - x * fz,
        x * fy - y * fx,
    )
    rows[m, ka.DIRECTION + 3], rows[m, ka.DIRECTION + 4], rows[m, ka.DIRECTION + 5] = fx, fy, fz


@internal_kernel
def turn_direction(ws: Workspace, m):
    """DIRECTION of row m for its present SIGN."""
    state, k = ws.contacts, ws.active[m, ka.OWNER]
    x, y, z = state[k, ka.POSITION], state[k, ka.POSITION + 1], state[k, ka.POSITION + 2]
    nx, ny, nz = state[k, ka.NORMAL], state[k, ka.NORMAL + 1], state[k, ka.NORMAL + 2]
    tx, ty, tz = state[k, ka.TANGENT], state[k, ka.TANGENT + 1], state[k, ka.TANGENT + 2]
    unit_force(ws.rows, m, signed_friction(ws, m), x, y, z, nx, ny, nz, tx, ty, tz)


@internal_kernel
def sign_changed(ws: Workspace, passes):
    """True when dissipative contacts' solved forces contradict their assumed signs; turns those directions around.

    All at once in the first passes, then only the first of them (least-index pivoting, which cannot cycle while all
    choices have determinants of one sign), at last every choice in turn. Without a consistent choice (Painlevé) the
    forces become NaN, the count of CONTRADICTORY goes up and the search ends. Forces that vanish to rounding have no
    sign and take +. So the result does not depend on the signs that the search began with, unless several choices are
    consistent (dynsim.kernels.constraint.uniqueness watches for that).
    """
    rows, active, p = ws.rows, ws.active, ws.counts[ka.ROWS]
    limit = 2 * p + SIGN_PASSES
    changed, largest = False, 0.0
    for k in range(p):
        largest = max(largest, abs(rows[k, ka.FORCE]))
    for k in range(p):
        if active[k, ka.LAW] == ka.FRICTION_DISSIPATIVE:
            agreement = rows[k, ka.FORCE] * rows[k, ka.SIGN]
            if agreement < -NO_FORCE * largest or (agreement <= NO_FORCE * largest and rows[k, ka.SIGN] < 0.0):
                if passes < limit and not (changed and passes > p):
                    rows[k, ka.SIGN] = -rows[k, ka.SIGN]
                    turn_direction(ws, k)
                changed = True
    if changed and passes >= limit:
        choice, free = passes - limit, 0
        for k in range(p):
            if active[k, ka.LAW] == ka.FRICTION_DISSIPATIVE:
                free += 1
        if free > SIGNS_LIMIT or choice >= 1 << free:
            ws.counts[ka.CONTRADICTORY] += 1
            for k in range(p):
                rows[k, ka.FORCE] = math.nan
            return False
        index = 0
        for k in range(p):
            if active[k, ka.LAW] == ka.FRICTION_DISSIPATIVE:
                rows[k, ka.SIGN] = -1.0 if (choice >> index) & 1 == 1 else 1.0
                index += 1
                turn_direction(ws, k)
    return changed
