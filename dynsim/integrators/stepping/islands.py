"""Contact problem of a time step; where bodies touch each other, it falls into islands without contact between them.

The rows of different islands share no joint, so that W has no entries between them. Each island is a problem of its
own. The impulses of the last step are kept if they solve it, as for bodies at rest: then no search is needed, and
impulses that are not unique need not be selected again.
"""

from __future__ import annotations

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.cone import steps as kc
from dynsim.dynamics.contact.cone.program import select_least_norm
from dynsim.dynamics.contact.cone.steps import FEW_PROXIMAL, approach, copy, measure, mobilities, motion, proximal_point
from dynsim.dynamics.tables import ModelArrays, Workspace
from dynsim.integrators.stepping import tables as kt
from dynsim.integrators.stepping.tables import SteppingArrays
from dynsim.jit.kernel import internal_kernel, noinline_kernel

# Largest proximal term of the first Newton steps. Where bodies touch each other, many impulses are not unique while
# contacts slide; with a smaller term, they would jump in the undetermined directions.
PROXIMAL = 1e-2


@internal_kernel
def root_of(tree, i):
    """Return the first joint of the tree that joint i belongs to."""
    while tree[i, ka.PARENT] >= 0:
        i = tree[i, ka.PARENT]
    return i


@internal_kernel
def find_islands(model: ModelArrays, pairs, s: SteppingArrays, ws: Workspace):
    """Write the first row of each row's island to ``s.group``; call after the rows have changed."""
    if pairs is None:  # resolved at compile time
        return
    island, p = s.group[kt.ISLAND], ws.counts[ka.ROWS]
    for r in range(p):
        island[r], s.group[kt.KEPT, r] = r, 0
        for end in range(2):
            i = ws.active[r, ka.BODY_A] if end == 0 else ws.active[r, ka.BODY_B]
            root = root_of(model.tree, i) if i >= 0 else -1
            for m in range(r if root >= 0 else 0):
                a, b = ws.active[m, ka.BODY_A], ws.active[m, ka.BODY_B]
                if root_of(model.tree, a) == root or (b >= 0 and root_of(model.tree, b) == root):
                    join(island, r, m)


@internal_kernel
def join(island, r, m):
    """Unite the islands of rows r and m < r."""
    old, new = max(island[r], island[m]), min(island[r], island[m])
    if old != new:
        for i in range(r + 1):
            if island[i] == old:
                island[i] = new


@internal_kernel
def solve_problem(s: SteppingArrays, W, p, rigid, pairs):
    """Solve w = W f + ``s.right`` for impulses f and law rates w; if f is not unique, select the f of least norm.

    Parameters
    ----------
    rigid : bool
        False if all contacts are compliant, which makes W regular and f unique.

    Returns
    -------
    residual : float
        Residual of the contact problem [m/s].
    """
    s.statistics[kt.SOLVES] += 1.0
    if pairs is None:  # resolved at compile time
        return search(s, W, s.right, s.kind, s.mu, p, s.f, s.w, rigid, kt.GOOD)
    return solve_islands(s, W, p, rigid)


@internal_kernel
def search(s: SteppingArrays, W, right, kind, mu, p, f, w, rigid, goal):
    """Solve a problem as :func:`solve_problem`; ``goal`` is the residual at which the first search ends."""
    residual = approach(W, right, kind, mu, p, f, s.room, goal, 1, FEW_PROXIMAL)
    if not residual <= kt.FAIR:
        s.statistics[kt.LONG_SOLVES] += 1.0
        residual = proximal_point(W, right, kind, mu, p, f, s.room, kt.GOOD)
    if not residual <= kt.FAIR:
        residual = approach(W, right, kind, mu, p, f, s.room, kt.GOOD, kt.LAST_ROUNDS, FEW_PROXIMAL)
    if kt.FAIR < residual <= kt.BAD:  # near a solution: W of deficient rank, b not in its range
        residual = proximal_point(W, right, kind, mu, p, f, s.room, kt.GOOD)
    motion(W, right, p, f, w)
    if rigid and residual <= kt.BAD:
        select_least_norm(W, w, kind, mu, p, f, s.room)
    return residual


@noinline_kernel
def solve_islands(s: SteppingArrays, W, p, rigid):
    """Solve the problem of each island, see :func:`solve_problem`; return the largest residual."""
    group, part, worst = s.group, s.part, 0.0
    row, kind = group[kt.ROW], group[kt.KIND]
    right, f, w, mu = part[kt.RIGHT], part[kt.IMPULSE], part[kt.RATE], part[kt.MU]
    for first in range(p):
        if group[kt.ISLAND, first] != first:
            continue
        n = 0
        for r in range(first, p):
            if group[kt.ISLAND, r] == first:
                row[n], kind[n], right[n], f[n], mu[n] = r, s.kind[r], s.right[r], s.f[r], s.mu[r]
                n += 1
        matrix = W
        if n < p:
            matrix = s.room[kc.CONE_ROOM]
            for k in range(n):
                for m in range(n):
                    matrix[k, m] = W[row[k], row[m]]
        mobilities(matrix, kind, n, s.room)
        residual, _ = measure(matrix, right, kind, mu, n, f, s.room)
        goal = kt.LEFT * kt.GOOD if residual <= kt.GOOD and group[kt.KEPT, first] == 0 else kt.GOOD
        group[kt.KEPT, first] = 1 if residual <= goal else 0
        if residual <= goal:
            copy(s.room[kc.MOTION, 0], w, n)
        else:
            residual = approach(matrix, right, kind, mu, n, f, s.room, goal, 1, PROXIMAL)
            residual = search(s, matrix, right, kind, mu, n, f, w, rigid, kt.FAIR if residual <= kt.FAIR else kt.GOOD)
        for k in range(n):
            s.f[row[k]], s.w[row[k]] = f[k], w[k]
        # Written so that NaN is kept.
        worst = worst if residual <= worst else residual
    return worst
