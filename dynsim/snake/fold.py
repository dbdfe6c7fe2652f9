"""Compiled lifting of wheel pairs: their heights over time, the pitch angles that lift them, and the sag of the servos.

Every product is rounded (:func:`dynsim.jit.kernel.exact_kernel`), so that records and servos get the same angles as the
run.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.jit.kernel import exact_kernel, kernel

NEWTON_STEPS = 12
# Minimum change of height per pitch angle [m/rad]; if it is less, the height is out of reach.
FLAT = 1e-12
# Size of the last Newton step of a pitch angle [rad]; the height of the wheel is then accurate to 2e-10 m.
CONVERGED = 1e-9
# Ticks between two updates of the geometry of lifted pairs while their heights do not change.
STEADY_TICKS = 4
OUT_OF_REACH = -1


class LiftTables(NamedTuple):
    """Lifting of a dynamic snake's wheel pairs: parameters, and workspace."""

    before: np.ndarray  # (pairs - 1,) distance from an axle to the yaw joint behind it [m]
    behind: np.ndarray  # (pairs - 1,) distance from this joint to the next axle [m]
    half_track: np.ndarray  # (pairs,) distance from the middle of an axle to a wheel [m]
    radius: float  # radius of the wheels [m]
    clearance: float  # height of lifted pairs [m]
    blend: float  # time to lift or lower a pair [s]
    weight: np.ndarray  # (pairs - 1,) weight of the plate behind each axle [N]
    length: float  # half the distance between two axles [m]
    stiffness: np.ndarray  # (pairs - 1,) stiffness of the pitch joints [N m/rad]; infinite if sag is not compensated
    yaw: np.ndarray  # (pairs - 1,) yaw angles [rad]
    height: np.ndarray  # (pairs,) heights [m], then in units of the clearance
    hinge: np.ndarray  # (pairs - 1,) angles added to the pitch joints [rad]
    moments: np.ndarray  # (pairs - 1,) [N m]
    lower: np.ndarray  # (pairs,) [m]
    tilt: np.ndarray  # (pairs,) [m]


@exact_kernel
def smooth(u):
    """Return s(u), which rises from 0 at u = 0 to 1 at u = 1."""
    u = min(max(u, 0.0), 1.0)
    return u * u * u * (10.0 + u * (-15.0 + 6.0 * u))


@kernel
def lift_heights(time, up, down, clearance, blend, height):
    """Compute the heights of pairs that are lifted from ``up`` to ``down`` [s], which may be infinite.

    All arrays have the same shape, (k,).
    """
    for k in range(height.shape[0]):
        height[k] = clearance * smooth((time[k] - up[k]) / blend) * smooth((down[k] - time[k]) / blend)


@exact_kernel
def pitch_angle(above, radius, rise, slope, lever):
    """Solve above + rise + lever slope - r sqrt(1 - slope^2) = 0 for psi by Newton's method; NaN if it fails.

    ``rise`` and ``slope`` are the coefficients of 1, cos psi and sin psi.
    """
    psi = 0.0
    for _ in range(NEWTON_STEPS):
        c, s = math.cos(psi), math.sin(psi)
        incline, rate = slope[0] + slope[1] * c + slope[2] * s, slope[2] * c - slope[1] * s
        if not abs(incline) < 1.0:
            break
        disc = math.sqrt(1.0 - incline * incline)
        change = rise[2] * c - rise[1] * s + lever * rate + radius * incline * rate / disc
        if not abs(change) > FLAT:
            break
        step = (above + rise[0] + rise[1] * c + rise[2] * s + lever * incline - radius * disc) / change
        psi -= step
        # Convergence is quadratic, so the next step would be of the order of this step squared.
        if abs(step) < CONVERGED:
            return psi
    return math.nan


@exact_kernel
def fold_row(before, behind, half_track, radius, yaw, height, hinge, lower, tilt):
    """Fold the base part at one instant, see :func:`fold_rows`; return the first pair out of reach, or 0.

    The vector up is e_z in the frame of the plate.
    """
    ux, uy, uz, z = 0.0, 0.0, 1.0, radius
    for j in range(yaw.shape[0]):
        cos, sin, half = math.cos(yaw[j]), math.sin(yaw[j]), half_track[j + 1]
        x, y = -before[j] - behind[j] * cos, -behind[j] * sin
        # Coefficients of 1, cos psi, sin psi in up . Ry(psi) vector, for the vector to the next axle and for the axle's
        # direction.
        rise, slope = (uy * y, ux * x, -uz * x), (uy * cos, -ux * sin, uz * sin)
        left = pitch_angle(z - height[j + 1], radius, rise, slope, half)
        right = pitch_angle(z - height[j + 1], radius, rise, slope, -half)
        if math.isnan(left) or math.isnan(right):
            return j + 1
        psi = max(left, right)
        c, s = math.cos(psi), math.sin(psi)
        z += rise[0] + rise[1] * c + rise[2] * s
        incline = slope[0] + slope[1] * c + slope[2] * s
        hinge[j], tilt[j + 1] = psi, 2.0 * half * abs(incline)
        lower[j + 1] = z - half * abs(incline) - radius * math.sqrt(1.0 - incline * incline)
        x, uz = c * ux - s * uz, s * ux + c * uz  # Ry(psi)^T up, then Rz(theta)^T of it
        ux, uy = cos * x + sin * uy, cos * uy - sin * x
    return 0


@kernel
def fold_rows(before, behind, half_track, yaw, height, radius, hinge, lower, tilt):
    """Compute the pitch angles that put the lower wheel of each pair at its height above the floor.

    Parameters
    ----------
    before, behind : (pairs - 1,) ndarray
        Distance from an axle to the yaw joint behind it, and from this joint to the next axle [m].
    half_track : (pairs,) ndarray
        Distance from the middle of an axle to a wheel [m].
    yaw : (T, pairs - 1) ndarray
        Yaw angles [rad].
    height : (T, pairs) ndarray
        Heights [m]; 0 for pair 1.
    radius : float
        Radius of the wheels [m].
    hinge, lower, tilt : ndarray
        Output, see :class:`dynsim.snake.lifting.Fold`.

    Returns
    -------
    row, pair : int
        First instant and pair whose height is out of reach; pair 0 if all heights are in reach.
    """
    row, pair = 0, 0
    while row < yaw.shape[0] and pair == 0:
        pair = fold_row(before, behind, half_track, radius, yaw[row], height[row], hinge[row], lower[row], tilt[row])
        row += 1
    return row - 1, pair


@exact_kernel
def lifted_moments(weight, length, height, level, moments):
    """Compute the weight moments at the pitch joints of pairs at least as high as ``level``, for a straight base part.

    Between two other pairs, the base part is treated as simply supported; behind the last one, as a cantilever.
    Positive moments lower the part behind the joint.

    Parameters
    ----------
    weight : (pairs - 1,) ndarray
        Weight of the plate behind each axle [N].
    length : float
        Half the distance between two axles [m].
    height : (pairs,) ndarray
        Heights in the unit of ``level``.
    level : float
        Least height of a lifted pair.
    moments : (pairs - 1,) ndarray
        Output [N m].
    """
    first, n = -1, height.shape[0]
    moments[:] = 0.0
    for last in range(n + 1):
        if last < n and height[last] >= level:
            continue
        count = last - first
        if first >= 0 and last == n:  # the tail, behind the last grounded pair
            for k in range(first, n - 1):
                for i in range(k, n - 1):
                    moments[k] += weight[i] * length * (2 * (i - k) + 1)
        elif first >= 0 and count > 1:
            reaction = 0.0
            for i in range(count):
                reaction += weight[first + i] * (2 * (count - i) - 1)
            reaction /= 2 * count
            for k in range(1, count):
                total = 0.0
                for i in range(k):
                    total += weight[first + i] * length * (2 * (k - i) - 1)
                moments[first + k] = -(reaction * 2 * length * k - total)
        first = last


@exact_kernel
def is_moving(lifting, up, down, time):
    """Return whether a height changes after a time [s]."""
    for k in range(up.shape[0]):
        if (math.isfinite(up[k]) and time < up[k] + lifting.blend) or (math.isfinite(down[k]) and time < down[k]):
            return True
    return False


@kernel
def lift_angles(lifting, up, down, time, yaw):
    """Compute the angles that lift the pairs at a time [s], ``lifting.hinge``, including the sag of the servos.

    ``up`` and ``down``, (pairs,), are the times of :func:`lift_heights`, and ``yaw``, (pairs - 1,), the yaw angles
    [rad]. Returns False if a height is out of reach.
    """
    height, hinge, moments, clearance = lifting.height, lifting.hinge, lifting.moments, lifting.clearance
    highest = 0.0
    for k in range(height.shape[0]):
        rising, falling = smooth((time - up[k]) / lifting.blend), smooth((down[k] - time) / lifting.blend)
        height[k] = clearance * rising * falling
        highest = max(highest, height[k])
    hinge[:] = 0.0
    if highest == 0.0:
        return True
    before, behind, lower, tilt = lifting.before, lifting.behind, lifting.lower, lifting.tilt
    if fold_row(before, behind, lifting.half_track, lifting.radius, yaw, height, hinge, lower, tilt) > 0:
        return False
    # The moments include all pairs higher than s and are averaged over s from zero to the clearance, so that they
    # change continuously.
    below = 0.0
    for k in range(height.shape[0]):
        height[k] /= clearance
    while below < highest / clearance:
        level = math.inf
        for share in height:
            if share > below:
                level = min(level, share)
        lifted_moments(lifting.weight, lifting.length, height, level, moments)
        for k in range(hinge.shape[0]):
            hinge[k] += (level - below) * moments[k] / lifting.stiffness[k]
        below = level
    return True


@exact_kernel
def lift_rates(lifting, up, down, time, period, yaw, yaw_rate, added, added_rate):
    """Compute the rates at which lifting moves the pitch joints until the next update, from the angles added so far.

    The yaw angles, (pairs - 1,), are those at the end of the control period that starts at ``time`` [s]; they continue
    at their rates until the next update. Returns the number of ticks until then: one while heights change, more
    otherwise, and OUT_OF_REACH if a height is out of reach.
    """
    ticks = 1 if is_moving(lifting, up, down, time) else STEADY_TICKS
    span = ticks * period
    for k in range(yaw.shape[0]):
        lifting.yaw[k] = yaw[k] + (span - period) * yaw_rate[k]
    if not lift_angles(lifting, up, down, time + span, lifting.yaw):
        return OUT_OF_REACH
    for k in range(yaw.shape[0]):
        added_rate[k] = (lifting.hinge[k] - added[k]) / span
    return ticks


@exact_kernel
def add_lift(line, added, added_rate, period, k):
    """Add the angle and rate of hinge k to the reference of its joint, and advance the angle by a control period."""
    line[0] += added[k]
    line[1] += added_rate[k]
    added[k] += period * added_rate[k]
