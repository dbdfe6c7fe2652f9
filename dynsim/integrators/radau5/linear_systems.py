"""Linear systems of RADAU5's Newton method, reduced to the rates: one real and one complex, solved together.

The systems are (g I − J) u = r, J the Jacobian of ẏ, with g = γ/h and with g = (α + iβ)/h, see
dynsim.integrators.radau5.step. In Python numpy solves the two one after the other. Compiled code solves them at once on
SIMD lanes: lane 0 is the real system, lanes 1 and 2 are real and imaginary part of the complex one. A number to
multiply by is then a pair (p, m): x ∘ (p, m) = p x + m x', where x' is x with lanes 1 and 2 exchanged; the inverse
matrices consist of such pairs.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.derivative import System
from dynsim.dynamics.simd.tables import as_lanes, lane
from dynsim.dynamics.tables import Workspace
from dynsim.dynamics.tree.joints import positions_along, rates_across
from dynsim.integrators.radau5.tables import ALPHA_RADAU, BETA_RADAU, GAMMA_RADAU, NewtonArrays
from dynsim.jit.compiler import form_of
from dynsim.jit.kernel import internal_kernel
from dynsim.jit.simd import four, turned


@internal_kernel
def factor_both(system: System, r: NewtonArrays, h):
    """Inverses of both reduced matrices, from ``r.along`` and ``r.linear``, for steps of length h."""
    r.inverse[0] = reduced_inverse(system, r, GAMMA_RADAU / h)
    r.inverse[1] = reduced_inverse(system, r, complex(ALPHA_RADAU / h, BETA_RADAU / h))


@internal_kernel
def solve_both(system: System, ws: Workspace, y, r: NewtonArrays, h):
    """``r.one`` and ``r.two``, (s,) real and complex, from right sides to solutions, by :func:`factor_both`."""
    r.one[:] = solve_newton(system, y, r, GAMMA_RADAU / h, r.inverse[0].real, r.one)
    r.two[:] = solve_newton(system, y, r, complex(ALPHA_RADAU / h, BETA_RADAU / h), r.inverse[1], r.two)


def reduced_inverse(system: System, r: NewtonArrays, g):
    """The inverse of the reduced matrix for g, real or complex; as Python only."""
    along, block, table = r.along, r.linear, system.drives.table
    n = along.shape[1]
    first = 2 * n  # of the rows of circuits
    matrix = g * np.eye(n) - along[n:first].T - along[:n].T / g
    for row, (j, k) in zip(block, table[:, [ka.DRIVEN, ka.CIRCUIT]], strict=True):
        if k >= 0:
            matrix[:, j] -= along[first + k] * (row[ka.RATE_Q] / g + row[ka.RATE_V]) / (g - row[ka.RATE_I])
    return np.linalg.inv(matrix)


def solve_newton(system: System, y, r: NewtonArrays, g, inverse, x):
    """(g I − J)⁻¹ x by the inverse of the reduced matrix, x (s,) real or complex; as Python only."""
    along, table, layout = r.along, system.drives.table, system.layout
    n, q, v = along.shape[1], layout.q, layout.v
    first = 2 * n - layout.current  # of the rows of circuits
    angle, solved = x[q : q + n].copy(), x.copy()
    if layout.extra > 0:
        rates_across(system.model, y, q, x, angle)
    angle /= g
    u = x[v : v + n] + angle @ along[:n]
    circuits = [
        (row, j, layout.current + k)
        for row, (j, k) in zip(r.linear, table[:, [ka.DRIVEN, ka.CIRCUIT]], strict=True)
        if k >= 0
    ]
    for row, j, e in circuits:
        u = u + along[first + e] * (x[e] + row[ka.RATE_Q] * angle[j]) / (g - row[ka.RATE_I])
    u = inverse @ u
    for row, j, e in circuits:
        pull = row[ka.RATE_Q] * (angle[j] + u[j] / g) + row[ka.RATE_V] * u[j]
        solved[e] = (x[e] + pull) / (g - row[ka.RATE_I])
    solved[v : v + n] = u
    if layout.extra > 0:
        positions_along(system.model, y, q, u, solved)
        solved[q : q + n + layout.extra] /= g
    else:
        solved[q : q + n] = angle + u / g
    return solved


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
    p, m = as_lanes(r.direct), as_lanes(r.crossed)
    over, circuit = as_lanes(r.over), as_lanes(r.circuit)
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
        r.pivot[k] = best
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
        best = r.pivot[k]
        if best != k:
            for i in range(n):
                p[i, k], p[i, best] = p[i, best], p[i, k]
                m[i, k], m[i, best] = m[i, best], m[i, k]


@form_of(solve_both, _compiled)
def multiply_on_lanes(system, ws, y, r, h):
    """By the inverses of :func:`invert_on_lanes`."""
    along, block, table, layout = r.along, r.linear, system.drives.table, system.layout
    n, q, v, current = along.shape[1], layout.q, layout.v, layout.current
    p, m, x, room = as_lanes(r.direct), as_lanes(r.crossed), as_lanes(r.x), as_lanes(r.room)
    over, circuit = as_lanes(r.over), as_lanes(r.circuit)
    op, om = over[0], over[1]
    u, angle, across, first = room[0], room[1], room[2], 2 * n
    for j in range(x.shape[0]):
        x[j] = four(r.one[j], r.two[j].real, r.two[j].imag, 0.0)
    if layout.extra > 0:
        rates_across(system.model, y, q, x, angle)
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
        positions_along(system.model, y, q, u, x)
        for j in range(q, q + n + layout.extra):
            e = x[j]
            x[j] = e * op + turned(e) * om
    for j in range(x.shape[0]):
        e = x[j]
        r.one[j], r.two[j] = lane(e, 0), complex(lane(e, 1), lane(e, 2))
