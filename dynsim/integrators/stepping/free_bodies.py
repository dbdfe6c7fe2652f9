"""Angular momentum of free rigid bodies within a time step.

The midpoint equation I Δω + h ω × I ω = h τ conserves angular momentum only to first order in steps with impacts,
because its velocity products belong to a prediction of ω. Where bodies touch each other, the rates of free bodies
are therefore computed from the balance itself,

    R' I ω' = R I ω + h R_m τ,

with the orientations R at the start, R_m at the midpoint and R' at the end of the step, and with the moment τ of all
forces in the axes of the body at the midpoint. Forces act at the positions of the midpoint, and bodies move with the
mean of their velocities, so that the angular momentum of all free bodies about any point is conserved to rounding.
"""

from __future__ import annotations

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.tables import ModelArrays, Workspace
from dynsim.dynamics.tree.joints import quaternion_rate, turned
from dynsim.dynamics.tree.spatial import cross, dot_vector, rotate, rotate_back, six, times_inertia
from dynsim.integrators.stepping import tables as kt
from dynsim.integrators.stepping.tables import SteppingArrays
from dynsim.jit.kernel import internal_kernel

# Maximum number of iterations for ω'; each one changes the error by a factor of about h |ω| √(I_max/I_min)/2. If the
# factor is above 1, a slender body turns too fast for the step, and the midpoint equation is kept.
MOST_ITERATIONS = 60


def free_bodies(model: ModelArrays) -> np.ndarray:
    """Return the first rotational row of each free rigid body.

    Bodies that carry others, and bodies whose centre of mass is not at their origin, are left out.

    Parameters
    ----------
    model : ModelArrays
        Tables of the model.

    Returns
    -------
    (k,) ndarray of int
    """
    tree, body = model.tree, model.body
    parents = set(tree[:, ka.PARENT].tolist())

    def is_free(i: int) -> bool:
        last, j = i + 2, tree[i, ka.PARENT]
        sliding = 0
        while j >= 0 and tree[j, ka.KIND] == ka.PRISMATIC:
            j, sliding = tree[j, ka.PARENT], sliding + 1
        rows = range(i - sliding, last + 1)
        light = all(body[k, c] == 0.0 for k in rows for c in (ka.ARMATURE, ka.DAMPING, ka.GEAR_DAMPING))
        centred = np.abs(body[last, ka.COM : ka.COM + 3]).max() < 1e-12
        return bool(j < 0 and sliding == 3 and last not in parents and light and centred)

    return np.array([i for i in np.flatnonzero(tree[:, ka.KIND] == ka.BALL_X).tolist() if is_free(i)], dtype=np.int64)


@internal_kernel
def rotation_by(rate, time):
    """Return the rotation of ``moved`` for a body with the angular velocity ``rate``, in body axes, and ``time``."""
    w, x, y, z = quaternion_rate(1.0, 0.0, 0.0, 0.0, time * rate[0], time * rate[1], time * rate[2])
    return turned(1.0 + w, x, y, z)


@internal_kernel
def balance_momentum(model: ModelArrays, s: SteppingArrays, ws: Workspace, h):
    """Change the mean accelerations of free bodies in the ka.QDD column so that angular momentum is balanced.

    The mean accelerations must be those of the midpoint equation. The work of the change on the mean motion is left
    in ``s.statistics``, because no force does it.
    """
    s.statistics[kt.BALANCED] = 0.0
    joints = ws.joints
    for m in range(s.free.shape[0]):
        i = s.free[m]
        start = s.before[kt.V_START, i], s.before[kt.V_START, i + 1], s.before[kt.V_START, i + 2]
        used = s.before[kt.V_BIAS, i], s.before[kt.V_BIAS, i + 1], s.before[kt.V_BIAS, i + 2]
        change = h * joints[i, ka.QDD], h * joints[i + 1, ka.QDD], h * joints[i + 2, ka.QDD]
        if dot_vector(start, start) + dot_vector(change, change) == 0.0:
            continue
        I = six(model.body, i + 2, ka.INERTIA)
        gyroscopic = cross(used, times_inertia(I, used))
        moment = times_inertia(I, change)
        before = rotate_back(rotation_by(start, 0.5 * h), times_inertia(I, start))
        # The angular momentum at the end, in the axes of the body at the midpoint.
        total = (
            before[0] + moment[0] + h * gyroscopic[0],
            before[1] + moment[1] + h * gyroscopic[1],
            before[2] + moment[2] + h * gyroscopic[2],
        )
        at_midpoint, inverse = rotation_by(start, 0.5 * h), inverted(I)
        stop, converged = (start[0] + change[0], start[1] + change[1], start[2] + change[2]), False
        for _ in range(MOST_ITERATIONS):
            mean = (
                start[0] + s.theta * (stop[0] - start[0]),
                start[1] + s.theta * (stop[1] - start[1]),
                start[2] + s.theta * (stop[2] - start[2]),
            )
            last = stop
            # R'ᵀ R_m = (Rᵀ R')ᵀ (Rᵀ R_m)
            stop = times_inertia(inverse, rotate_back(rotation_by(mean, h), rotate(at_midpoint, total)))
            off = stop[0] - last[0], stop[1] - last[1], stop[2] - last[2]
            converged = dot_vector(off, off) <= 1e-32 * dot_vector(stop, stop)
            if converged:
                break
        if not converged:
            continue
        more = stop[0] - start[0] - change[0], stop[1] - start[1] - change[1], stop[2] - start[2] - change[2]
        mean = 0.5 * (start[0] + stop[0]), 0.5 * (start[1] + stop[1]), 0.5 * (start[2] + stop[2])
        s.statistics[kt.BALANCED] += dot_vector(mean, times_inertia(I, more))
        for k in range(3):
            joints[i + k, ka.QDD] += more[k] / h


@internal_kernel
def inverted(I):
    """Return the inverse of a symmetric matrix xx xy xz yy yz zz."""
    xx, xy, xz = I[3] * I[5] - I[4] * I[4], I[2] * I[4] - I[1] * I[5], I[1] * I[4] - I[2] * I[3]
    scale = 1.0 / (I[0] * xx + I[1] * xy + I[2] * xz)
    return (
        scale * xx,
        scale * xy,
        scale * xz,
        scale * (I[0] * I[5] - I[2] * I[2]),
        scale * (I[1] * I[2] - I[0] * I[4]),
        scale * (I[0] * I[3] - I[1] * I[1]),
    )
