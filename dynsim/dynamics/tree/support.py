"""Ground reactions of a mobile base: wheel and caster loads, centre of pressure, tip margin, traction.

The base stands on the contact points of its left wheel l = (0, T/2), its right wheel r = (0, −T/2) and its caster
c = (c_x, c_y), in the plane z = 0 of its frame, whose z axis is normal to the ground. Three normal forces N balance the
force along z and the moments about x and y, so they are determined; the no-side-slip and rolling constraints give the
forces along y and x. The base is assumed to stay on the ground: N < 0 means that the ground pulls.

The base carries its own tree of bodies. Separate objects are supported by their hinges and contacts; connections
between them and the tree act on the base from outside, as contacts do.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.tables import ModelArrays, Workspace
from dynsim.dynamics.tree.joints import row_rates
from dynsim.dynamics.tree.loads import LINK as LOAD_LINK
from dynsim.dynamics.tree.loads import LoadArrays, load_wrench
from dynsim.dynamics.tree.spatial import (
    ZERO_SIX,
    along,
    cross,
    minus_scaled,
    plus,
    rotate_back,
    rotation,
    second_axis,
    six,
    transform,
    vector,
)
from dynsim.dynamics.tree.sweep import body_inertia, inertial_wrench
from dynsim.jit.kernel import integers, internal_kernel, noinline_kernel, reals

# SupportArrays.index, int: body, and rows of the wheel rates
BODY, LEFT, RIGHT = 0, 1, 2
INDEX_SIZE = 3
# SupportArrays.base
TRACK, CASTER_X, CASTER_Y, SPIN_INERTIA, FRICTION = 0, 1, 2, 3, 4
# Perimeter of the support triangle divided by the side opposite to l, r and c, which is the largest margin at each
# point.
SHARE = 5
BASE_SIZE = 8
# SupportArrays.state: recorded values
LOADS = 0  # 3: left wheel, right wheel, caster [N]
PRESSURE = 3  # 2: centre of pressure in W [m], NaN without load
MARGIN = 5
TRACTION = 6  # 2: |F| / (μ N) of left and right wheel, NaN for N <= 0
OUTPUTS = 8
# Forces behind the traction: forces of the wheels along x, total force along y [N]
LONGITUDINAL, LATERAL = 8, 10
STATE_SIZE = 11
# SupportArrays.least: loads as in state, then the margin
LEAST_MARGIN = 3
LEAST_SIZE = 4
# Load [N], and load relative to the loads of the wheels, below which the ground counts as unloaded.
NO_LOAD, ROUNDING = 1e-6, 1e-9


class SupportArrays(NamedTuple):
    """Ground support of a mobile base; for a robot without a base, the tables have size zero."""

    index: np.ndarray  # (INDEX_SIZE,) int
    carried: np.ndarray  # (n,) int: 1 for the rows of its tree, 0 for separate objects
    base: np.ndarray  # (BASE_SIZE,)
    state: np.ndarray  # (STATE_SIZE,) written by ground_reaction
    least: np.ndarray  # (LEAST_SIZE,) smallest loads and margin at accepted steps, see watch_support


def no_support() -> SupportArrays:
    """Return the tables of a robot without a mobile base."""
    return SupportArrays(*(integers(np.zeros(0)) for _ in range(2)), *(reals(np.zeros(0)) for _ in range(3)))


@noinline_kernel
def ground_reaction(model: ModelArrays, loads: LoadArrays, t, ws: Workspace, support: SupportArrays):
    """Write loads, centre of pressure, tip margin and traction demand at time t to ``support.state``.

    Call right after ``derivative``; overwrites V, with the same values, and A with the accelerations minus gravity.

    Balance of momentum of all bodies of its tree about the world origin: W = Σ (İV − weight) + İ_a − Σ W_contact −
    Σ W_load. The inertia I_a of the wheels about their axle y is not in the tensors of the bodies but on the rows of
    the wheels; its momentum I_a (φ̇_L + φ̇_R) y changes by I_a ((φ̈_L + φ̈_R) y + (φ̇_L + φ̇_R) ω × y). Momentum of rotors
    and gears is omitted, as for all joints. Moved to the base's frame, M_x = (N_L − N_R) T/2 + N_C c_y, M_y = −N_C c_x,
    F_z = ΣN; M_z = (F_R − F_L) T/2 and F_x = F_L + F_R give the forces along x that roll the wheels.

    The margin is min_i d_i/ρ with the distance d_i of the centre of pressure Σ N_i p_i / ΣN from side i (negative
    beyond it) and the inradius ρ. N_i/ΣN are its barycentric coordinates, so d_i/ρ = (N_i/ΣN) (perimeter / side i): 1
    at the incentre. If ΣN is negative or rounding error, the margin is −1. Loaded wheels share the lateral force in
    proportion to their loads.
    """
    links, joints, gravity = ws.links, ws.joints, model.gravity
    index, base, state, carried = support.index, support.base, support.state, support.carried
    W = ZERO_SIX
    for i in range(joints.shape[0]):
        row_rates(model, ws, i, joints[i, ka.QD], joints[i, ka.QDD], gravity[0], gravity[1], gravity[2])
        if carried[i] == 1:
            mass, centre, inertia = body_inertia(model, ws, i)
            W = plus(W, inertial_wrench(ws, i, mass, centre, inertia))
    for k in range(ws.counts[ka.ROWS]):
        # Forces between two joints, or between two bodies of the tree, are internal.
        if ws.active[k, ka.ROW_KIND] != ka.JOINT_ROW:
            first, other = ws.active[k, ka.BODY_A], ws.active[k, ka.BODY_B]
            within = carried[other] if other >= 0 else 0
            if carried[first] != within:
                sign = 1.0 if carried[first] == 1 else -1.0
                W = minus_scaled(W, six(ws.rows, k, ka.DIRECTION), sign * ws.rows[k, ka.FORCE])
    for k in range(loads.table.shape[0]):
        if carried[loads.table[k, LOAD_LINK]] == 1:
            W = minus_scaled(W, load_wrench(loads, k, t, ws), 1.0)
    b, left, right = index[BODY], index[LEFT], index[RIGHT]
    R, p = rotation(links, b, ka.R), vector(links, b, ka.P)
    axle, w = second_axis(R), vector(links, b, ka.V)
    spin = base[SPIN_INERTIA] * (joints[left, ka.QD] + joints[right, ka.QD])
    rate = base[SPIN_INERTIA] * (joints[left, ka.QDD] + joints[right, ka.QDD])
    turning, force = cross(w, axle), (W[3], W[4], W[5])
    at_base = cross(p, force)
    # Moments about the origin of the base, in its frame.
    moment = along(along(along((W[0], W[1], W[2]), axle, rate), turning, spin), at_base, -1.0)
    mx, my, mz = rotate_back(R, moment)
    fx, fy, fz = rotate_back(R, force)

    caster = -my / base[CASTER_X]
    difference = 2.0 * (mx - caster * base[CASTER_Y]) / base[TRACK]
    state[LOADS] = 0.5 * (fz - caster + difference)
    state[LOADS + 1] = 0.5 * (fz - caster - difference)
    state[LOADS + 2] = caster
    state[LONGITUDINAL] = 0.5 * fx - mz / base[TRACK]
    state[LONGITUDINAL + 1] = 0.5 * fx + mz / base[TRACK]
    state[LATERAL] = fy
    state[MARGIN] = -1.0
    state[PRESSURE], state[PRESSURE + 1] = math.nan, math.nan
    if fz > max(NO_LOAD, ROUNDING * (abs(state[LOADS]) + abs(state[LOADS + 1]) + abs(caster))):
        x, y = -my / fz, mx / fz
        pressure = transform(p, R, (x, y, 0.0))
        state[PRESSURE], state[PRESSURE + 1] = pressure[0], pressure[1]
        state[MARGIN] = math.inf
        for k in range(3):
            state[MARGIN] = min(state[MARGIN], state[LOADS + k] / fz * base[SHARE + k])
    pressed = max(state[LOADS], 0.0) + max(state[LOADS + 1], 0.0)
    for k in range(2):
        load = state[LOADS + k]
        state[TRACTION + k] = math.nan
        if load > 0.0:
            lateral = fy * load / pressed
            force = math.sqrt(state[LONGITUDINAL + k] ** 2 + lateral * lateral)
            state[TRACTION + k] = force / (base[FRICTION] * load)


@internal_kernel
def tip_margin(model: ModelArrays, loads: LoadArrays, t, ws: Workspace, support: SupportArrays):
    """Return the tip margin from :func:`ground_reaction`; infinite without a mobile base."""
    if support.index.shape[0] == 0:
        return math.inf
    ground_reaction(model, loads, t, ws, support)
    return support.state[MARGIN]


@internal_kernel
def watch_support(support: SupportArrays):
    """Update the smallest loads and margin; call after :func:`ground_reaction` at the end of an accepted step."""
    if support.index.shape[0] == 0:
        return
    state, least = support.state, support.least
    for k in range(3):
        least[k] = min(least[k], state[LOADS + k])
    least[LEAST_MARGIN] = min(least[LEAST_MARGIN], state[MARGIN])
