"""Contact points on quadrics: geometry, slip direction, constraint rows, and the friction of the bilateral law."""

from __future__ import annotations

import math

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.rows import point_row, sticking_rows
from dynsim.dynamics.contact.unilateral import UnilateralArrays, slide_direction
from dynsim.dynamics.tables import ContactArrays, ModelArrays, Workspace
from dynsim.dynamics.tree.spatial import (
    dot_vector,
    point_acceleration,
    point_velocity,
    put_six,
    put_vector,
    rotation,
    six,
    times_inertia,
    times_number,
    transform,
    vector,
)
from dynsim.jit.kernel import exact_kernel, internal_kernel

# Most solves, beyond two per contact, in search of signs of dissipative contacts that agree with their forces.
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
def hessian_product(point, k, u):
    """u·Q u of the surface of contact k; point: (c, POINT_SIZE)."""
    return (
        u[0] * (point[k, ka.QUADRIC] * u[0] + 2.0 * (point[k, ka.QUADRIC + 1] * u[1] + point[k, ka.QUADRIC + 2] * u[2]))
        + u[1] * (point[k, ka.QUADRIC + 3] * u[1] + 2.0 * point[k, ka.QUADRIC + 4] * u[2])
        + u[2] * point[k, ka.QUADRIC + 5] * u[2]
    )


@internal_kernel
def contact_rows(model: ModelArrays, contacts: ContactArrays, unilateral: UnilateralArrays | None, ws: Workspace):
    """Position, gap, slip, constraint row and force direction of every candidate, after ``forward_sweep``.

    A candidate that is off its surface has a row too, behind the active ones: geometry without branches.

    C(r) = r·Q r/2 + b·r + c, n = ∇C/|∇C| ([WM] eqs 3, 6, 8); a gap > 0 is off the surface. Row:
    n·r̈ = −ṙᵀ(∂²C/∂r²)ṙ / |∇C| ([WM] eqs 15, 30). Force per unit f_n: n − σ μ t with the smoothed slip direction
    t = v_t / √(|v_t|² + v_s²) ([WM] eqs 9, 14 and f_t = μ f_n); v_s is dynsim's assumption, the paper says nothing
    of zero slip. σ is 1 in the paper's law; for the dissipative law it is the sign of f_n, kept between calls. Under
    the unilateral law t and μ are those of :func:`~dynsim.dynamics.contact.unilateral.slide_direction`.
    """
    links, state, rows, point, gravity = ws.links, ws.contacts, ws.rows, contacts.point, model.gravity
    for k in range(contacts.link.shape[0]):
        i, m = contacts.link[k, ka.LINK], ws.active[k, ka.FIRST_ROW]
        mu = signed_friction(ws, m)
        R = rotation(links, i, ka.R)
        at = transform(vector(links, i, ka.P), R, vector(point, k, ka.POINT))
        # ∇C and C; a plane's ∇C is its unit normal, which spares every right-hand side two roots and three divisions.
        n = vector(point, k, ka.QUADRIC + 6)
        gap = dot_vector(n, at) + point[k, ka.QUADRIC + 9]
        inverse, curved = 1.0, contacts.link[k, ka.CURVED] != 0
        if curved:
            bent = times_inertia(six(point, k, ka.QUADRIC), at)
            n = n[0] + bent[0], n[1] + bent[1], n[2] + bent[2]
            slope = math.sqrt(dot_vector(n, n))
            inverse = 1.0 / slope
            n = times_number(n, inverse)
            gap = surface_distance(gap + 0.5 * dot_vector(bent, at), slope, hessian_product(point, k, n))
        # Velocity of the point, and its acceleration at vdot = 0 (A carries −g from its root).
        V = six(links, i, ka.V)
        v, a = point_velocity(V, at), point_acceleration(six(links, i, ka.A), V, at)
        a = a[0] + gravity[0], a[1] + gravity[1], a[2] + gravity[2]
        rate = dot_vector(n, v)
        slip = v[0] - rate * n[0], v[1] - rate * n[1], v[2] - rate * n[2]
        if unilateral is None:
            t = times_number(
                slip, 1.0 / math.sqrt(dot_vector(slip, slip) + contacts.law[k, ka.V_S] * contacts.law[k, ka.V_S])
            )
        else:
            x, y, z, mu = slide_direction(unilateral, contacts, k, slip, n)
            t = x, y, z
            rows[m, ka.ROW_MU] = mu
        state[k, ka.GAP], state[k, ka.GAP_RATE] = gap, rate
        target = -dot_vector(n, a)
        rows[m, ka.TARGET] = target - hessian_product(point, k, v) * inverse if curved else target
        put_vector(state, k, ka.POSITION, at)
        put_vector(state, k, ka.NORMAL, n)
        put_vector(state, k, ka.SLIP_VELOCITY, slip)
        # From here on nothing is read back: stores to one table keep the compiler from trusting the other.
        put_vector(state, k, ka.TANGENT, t)
        point_row(rows, m, at, n)
        unit_force(rows, m, mu, at, n, t)
    if ws.counts[ka.STUCK] == 0:
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
def unit_force(rows, m, mu, at, n, t):
    """Wrench of a unit normal force with its friction, n − σ μ t through the contact point, as DIRECTION of row m.

    The same bits where it is first made and where a sign has turned, so that a right-hand side does not depend on the
    signs of the one before.
    """
    x, y, z = n[0] - mu * t[0], n[1] - mu * t[1], n[2] - mu * t[2]
    # Written out: a function of its own would have its products contracted.
    wrench = at[1] * z - at[2] * y, at[2] * x - at[0] * z, at[0] * y - at[1] * x, x, y, z
    put_six(rows, m, ka.DIRECTION, wrench)


@internal_kernel
def turn_direction(ws: Workspace, m):
    """DIRECTION of row m for its present SIGN."""
    state, k = ws.contacts, ws.active[m, ka.OWNER]
    at, n, t = vector(state, k, ka.POSITION), vector(state, k, ka.NORMAL), vector(state, k, ka.TANGENT)
    unit_force(ws.rows, m, signed_friction(ws, m), at, n, t)


@internal_kernel
def sign_changed(ws: Workspace, passes):
    """True when dissipative contacts' solved forces contradict their assumed signs; turns those directions around.

    All at once in the first passes, then only the first of them (least-index pivoting, which cannot cycle while all
    choices have determinants of one sign), at last every choice in turn. Without a consistent choice (Painlevé) the
    forces become NaN, the count of CONTRADICTORY goes up and the search ends. Forces that vanish to rounding have no
    sign and take +. So the result does not depend on the signs that the search began with, unless several choices are
    consistent (dynsim.dynamics.contact.uniqueness watches for that).
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
