"""The linear systems of RADAU5's Newton method, reduced to the rates: a real and a complex one, solved together.

(g I − J) u = r with g = γ/h and with g = (α + iβ)/h, see dynsim.integrators.radau5.step. As Python they are two, by LU
factors. Compiled they are lanes of one: the real number, then real and imaginary part. To multiply by a complex number
is then x ∘ (p, m) = p x + m x', x' with those two parts exchanged; the inverse matrices are such pairs.
"""

from __future__ import annotations

from typing import Any

from dynsim.dynamics import tables as ka
from dynsim.dynamics.derivative import System
from dynsim.dynamics.simd.system import FOUR
from dynsim.dynamics.simd.tables import as_lanes, lane
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.joints import positions_along, rates_across
from dynsim.integrators.radau5.newton import NewtonArrays
from dynsim.integrators.tableaux import ALPHA_RADAU, BETA_RADAU, GAMMA_RADAU
from dynsim.jit.compiler import form_of
from dynsim.jit.kernel import internal_kernel
from dynsim.jit.simd import four, turned


@internal_kernel
def factor_both(system: System, r: NewtonArrays, h):
    """Factors of both reduced matrices, from ``r.along`` and ``r.linear``, for steps of length h."""
    factor_newton(system, r, GAMMA_RADAU / h, r.real, r.pivot[0])
    factor_newton(system, r, complex(ALPHA_RADAU / h, BETA_RADAU / h), r.complex, r.pivot[1])


@internal_kernel
def solve_both(system: System, ws: Workspace, y, r: NewtonArrays, h):
    """``r.one`` and ``r.two``, (s,) real and complex, from right sides to solutions, by :func:`factor_both`."""
    solve_newton(system, ws, y, r, GAMMA_RADAU / h, r.real, r.pivot[0], r.one, r.room_one)
    solve_newton(system, ws, y, r, complex(ALPHA_RADAU / h, BETA_RADAU / h), r.complex, r.pivot[1], r.two, r.room_two)


def factor_newton(system: System, r: NewtonArrays, g, matrix, pivot):
    """The reduced matrix for g, real or complex, LU-factored with partial pivoting."""
    along, block, table = r.along, r.linear, system.drives.table
    n = matrix.shape[0]
    first = 2 * n  # of the rows of circuits
    for i in range(n):
        for j in range(n):
            matrix[i, j] = -along[n + j, i] - along[j, i] / g
        matrix[i, i] += g
    for a in range(table.shape[0]):
        j, k = table[a, ka.DRIVEN], table[a, ka.CIRCUIT]
        if k >= 0:
            slope = (block[a, ka.RATE_Q] / g + block[a, ka.RATE_V]) / (g - block[a, ka.RATE_I])
            for i in range(n):
                matrix[i, j] -= along[first + k, i] * slope
    for k in range(n):
        best, largest = k, 0.0
        for i in range(k, n):
            x = matrix[i, k]
            size = x.real * x.real + x.imag * x.imag
            if size > largest:
                best, largest = i, size
        pivot[k] = best
        if best != k:
            for j in range(n):
                matrix[k, j], matrix[best, j] = matrix[best, j], matrix[k, j]
        for i in range(k + 1, n):
            matrix[i, k] /= matrix[k, k]
            for j in range(k + 1, n):
                matrix[i, j] -= matrix[i, k] * matrix[k, j]


def solve_newton(system: System, ws: Workspace, y, r: NewtonArrays, g, matrix, pivot, x, room):
    """x ← (g I − J)⁻¹ x by the factors of :func:`factor_newton`, x (s,) and room (2, s) real or complex."""
    along, block, table, layout = r.along, r.linear, system.drives.table, system.layout
    n, q, v, current = matrix.shape[0], system.layout.q, system.layout.v, system.layout.current
    u, angle, first = room[0], room[1], 2 * n
    if layout.extra > 0:
        rates_across(system.model.compound, system.model, y, q, x, angle)
    for i in range(n):
        angle[i] = (angle[i] if layout.extra > 0 else x[q + i]) / g
        u[i] = x[v + i]
    for j in range(n):
        for i in range(n):
            u[i] += along[j, i] * angle[j]
    for a in range(table.shape[0]):
        j, k = table[a, ka.DRIVEN], table[a, ka.CIRCUIT]
        if k >= 0:
            free = (x[current + k] + block[a, ka.RATE_Q] * angle[j]) / (g - block[a, ka.RATE_I])
            for i in range(n):
                u[i] += along[first + k, i] * free
    for i in range(n):
        p = pivot[i]
        u[i], u[p] = u[p], u[i]
    for i in range(n):
        for j in range(i):
            u[i] -= matrix[i, j] * u[j]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            u[i] -= matrix[i, j] * u[j]
        u[i] /= matrix[i, i]
    for a in range(table.shape[0]):
        j, k = table[a, ka.DRIVEN], table[a, ka.CIRCUIT]
        if k >= 0:
            pull = block[a, ka.RATE_Q] * (angle[j] + u[j] / g) + block[a, ka.RATE_V] * u[j]
            x[current + k] = (x[current + k] + pull) / (g - block[a, ka.RATE_I])
    for i in range(n):
        x[v + i] = u[i]
        if layout.extra == 0:
            x[q + i] = angle[i] + u[i] / g
    if layout.extra > 0:
        positions_along(system.model.compound, system.model, y, q, u, x)
        for j in range(q, q + n + layout.extra):
            x[j] /= g


def _compiled(*_: Any) -> bool:
    return True


@internal_kernel
def pair(real, z):
    """What x ∘ (p, m) multiplies by: a real number and a complex one."""
    return four(real, z.real, z.real, real), four(0.0, -z.imag, z.imag, 0.0)


@form_of(factor_both, _compiled)
def invert_on_lanes(system, r, h):
    """The inverses of both, by Gauss–Jordan elimination; pivots large in both."""
    along, block, table = r.along, r.linear, system.drives.table
    p, m = as_lanes(r.direct, FOUR), as_lanes(r.crossed, FOUR)
    over, circuit = as_lanes(r.over, FOUR), as_lanes(r.circuit, FOUR)
    n, real, z = p.shape[0], GAMMA_RADAU / h, complex(ALPHA_RADAU / h, BETA_RADAU / h)
    first = 2 * n
    gp, gm = pair(real, z)
    op, om = pair(1.0 / real, 1.0 / z)
    over[0], over[1] = op, om
    for i in range(n):
        for j in range(n):
            p[i, j] = -along[j, i] * op - along[n + j, i]
            m[i, j] = -along[j, i] * om
        p[i, i] += gp
        m[i, i] += gm
    for a in range(table.shape[0]):
        j, k = table[a, ka.DRIVEN], table[a, ka.CIRCUIT]
        if k >= 0:
            rate = block[a, ka.RATE_I]
            cp, cm = pair(1.0 / (real - rate), 1.0 / (z - rate))
            circuit[a, 0], circuit[a, 1] = cp, cm
            sp, sm = block[a, ka.RATE_Q] * op + block[a, ka.RATE_V], block[a, ka.RATE_Q] * om
            sp, sm = sp * cp - sm * cm, sp * cm + sm * cp
            for i in range(n):
                p[i, j] -= along[first + k, i] * sp
                m[i, j] -= along[first + k, i] * sm
    for k in range(n):
        best, largest = k, 0.0
        for i in range(k, n):
            size = (r.direct[i, k, 1] ** 2 + r.crossed[i, k, 2] ** 2) * r.direct[i, k, 0] ** 2
            if size > largest:
                best, largest = i, size
        r.pivot[0, k] = best
        if best != k:
            for j in range(n):
                p[k, j], p[best, j] = p[best, j], p[k, j]
                m[k, j], m[best, j] = m[best, j], m[k, j]
        dp, dm = pair(1.0 / r.direct[k, k, 0], 1.0 / complex(r.direct[k, k, 1], r.crossed[k, k, 2]))
        p[k, k], m[k, k] = 1.0, 0.0
        for j in range(n):
            c, d = p[k, j], m[k, j]
            p[k, j], m[k, j] = c * dp - d * dm, c * dm + d * dp
        for i in range(n):
            if i != k:
                e, f = p[i, k], m[i, k]
                p[i, k], m[i, k] = 0.0, 0.0
                for j in range(n):
                    c, d = p[k, j], m[k, j]
                    p[i, j], m[i, j] = p[i, j] - (e * c - f * d), m[i, j] - (e * d + f * c)
    for k in range(n - 1, -1, -1):
        best = r.pivot[0, k]
        if best != k:
            for i in range(n):
                p[i, k], p[i, best] = p[i, best], p[i, k]
                m[i, k], m[i, best] = m[i, best], m[i, k]


@form_of(solve_both, _compiled)
def multiply_on_lanes(system, ws, y, r, h):
    """By the inverses of :func:`invert_on_lanes`."""
    along, block, table, layout = r.along, r.linear, system.drives.table, system.layout
    n, q, v, current = along.shape[1], layout.q, layout.v, layout.current
    p, m, x, room = as_lanes(r.direct, FOUR), as_lanes(r.crossed, FOUR), as_lanes(r.x, FOUR), as_lanes(r.room, FOUR)
    over, circuit = as_lanes(r.over, FOUR), as_lanes(r.circuit, FOUR)
    op, om = over[0], over[1]
    u, angle, across, first = room[0], room[1], room[2], 2 * n
    for j in range(x.shape[0]):
        x[j] = four(r.one[j], r.two[j].real, r.two[j].imag, 0.0)
    if layout.extra > 0:
        rates_across(system.model.compound, system.model, y, q, x, angle)
    for i in range(n):
        e = angle[i] if layout.extra > 0 else x[q + i]
        angle[i] = e * op + turned(e) * om
        u[i] = x[v + i]
    for j in range(n):
        e = angle[j]
        for i in range(n):
            u[i] += along[j, i] * e
    for a in range(table.shape[0]):
        j, k = table[a, ka.DRIVEN], table[a, ka.CIRCUIT]
        if k >= 0:
            free = x[current + k] + block[a, ka.RATE_Q] * angle[j]
            free = free * circuit[a, 0] + turned(free) * circuit[a, 1]
            for i in range(n):
                u[i] += along[first + k, i] * free
    for i in range(n):
        across[i] = turned(u[i])
    for i in range(n):
        total, other = x[v + i] * 0.0, x[v + i] * 0.0
        for j in range(n):
            total += p[i, j] * u[j]
            other += m[i, j] * across[j]
        x[v + i] = total + other
    for a in range(table.shape[0]):
        j, k = table[a, ka.DRIVEN], table[a, ka.CIRCUIT]
        if k >= 0:
            rate = x[v + j]
            moved = angle[j] + rate * op + turned(rate) * om
            free = x[current + k] + block[a, ka.RATE_Q] * moved + block[a, ka.RATE_V] * rate
            x[current + k] = free * circuit[a, 0] + turned(free) * circuit[a, 1]
    if layout.extra == 0:
        for i in range(n):
            rate = x[v + i]
            x[q + i] = angle[i] + rate * op + turned(rate) * om
    else:
        for i in range(n):
            u[i] = x[v + i]
        positions_along(system.model.compound, system.model, y, q, u, x)
        for j in range(q, q + n + layout.extra):
            e = x[j]
            x[j] = e * op + turned(e) * om
    for j in range(x.shape[0]):
        e = x[j]
        r.one[j], r.two[j] = lane(e, 0), complex(lane(e, 1), lane(e, 2))
