"""Time stepping: its equations, tables and workspace, and the geometry of a step.

Moreau's and Jean's θ method for the whole coupled system. From (q, v, i) over a step h, with geometry at the midpoint
q_m = q + h v / 2 and x_θ = x + θ (x' − x):

    M (v' − v) = h (τ_θ + Q − bias) + Jᵀ p,    L (i' − i) = h (u_θ − R i_θ − K_m v_θ),    q' = q + h v_θ

Drives are implicit by their linear blocks: i' is eliminated, which adds the effect of voltage loops, back-EMF and
damping to the diagonal of M (``stepping.drives``). The impulses p solve one contact problem over all candidates that
touch at q_m; its law is on the rates at the end, with the rows of the end (``stepping.contacts``).

θ = 1 damps and is of first order; θ = 1/2 is of second order between events, and keeps the energy of linear systems,
contacts aside, to rounding. A landing leaves a penetration of up to h times its speed, which is taken back.

The ledger has the discrete works: power at x_θ, friction −p_t·(u + u')/2, and p_n (u_n + u_n')/2 of rows that hold.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.cone import steps as kc
from dynsim.dynamics.contact.rows import contact_rows, shaped_rows
from dynsim.dynamics.tables import ContactArrays, ModelArrays, Workspace, row_limit
from dynsim.dynamics.tree.joints import displace, normalise, read_positions
from dynsim.dynamics.tree.spatial import cross, dot, dot_vector, put_vector, rotate, rotation, six, vector
from dynsim.dynamics.tree.sweep import forward_sweep
from dynsim.jit.kernel import integers, internal_kernel, reals

# Residuals of contact problems [m/s]: the aim of a search, one that ends it, and one above which a solve counts as
# capped. Below the last a point that touches does not leave, and a point that sticks does not slip.
GOOD, FAIR, BAD = 1e-11, 1e-10, 1e-8
# Starts of the last search, and in all searches together.
LAST_ROUNDS = 12
MOST_ROUNDS = 1 + kc.NEAR_STEPS + LAST_ROUNDS
# A gap that counts as closed: far above rounding [m].
MARGIN = 1e-10
# SteppingArrays.memory: of the last accepted step, and of the one that is tried; its columns, of a candidate
LAST, NOW = 0, 1
LISTED = 0  # 1: it had rows
CLOSED = 1  # 1: it pressed, or touched without leaving
SLID = 2  # 1: it slid
NORMAL_IMPULSE = 3  # [N s]
END_RATE = 4  # 3: rates of its rows at the end of that step
NORMAL_THEN, TANGENT_THEN = 7, 10  # 3 each: directions of its first two rows
CENTRE = 13  # 3: of the sphere that touches [m]
BUDGET = 16  # energy that its landing has taken, and that pushing it out of its surface may give back [J]
STORED = 17  # energy in its spring [J]
MEMORY_SIZE = 18
# SteppingArrays.turn, of a candidate with rows
ADDED = 0  # 3: what the law adds to the end rates of its rows [m/s]
TURNED = 3  # 3: the share of that which is due to rows that turn
PUSH = 6  # rate at which it is pushed out of its surface; negative: let into it [m/s]
MEAN = 7  # 1: it slides on, along the mean of its rates
KNOWN = 8  # 1: its rows are those of the last step, turned
STRUCK = 9  # what the step books as its impact loss [J]
PRESSED_IN, IMPLICIT = 10, 11  # of what gives way: gap at the start [m], and φ of its law
TURN_SIZE = 12
# SteppingArrays.statistics: largest residual [m/s], solves above BAD, largest penetration [m]; solves, and solves with
# more than one start; most of what steps have taken of the energy, or made (negative), at any time [J];
# steps whose limits of drives contradict each other; energy that would be another one if all came half a step later
# [J]; solves without what the law adds to the rates, because with it there was no solution.
WORST, CAPPED, PENETRATION, SOLVES, LONG_SOLVES, TAKEN, UNSETTLED, HALF_STEP, DROPPED = 0, 1, 2, 3, 4, 5, 6, 7, 8
# Most energy that steps have taken until any time, and most that they have made since [J].
MOST_TAKEN, MADE = 9, 10
STIFFEST = 11  # largest stiffness times mobility of a row that gives way [1/s²]
STATISTICS_SIZE = 12
# SteppingArrays.before: rates at the start; rates of the velocity products; acceleration of the last step, and then of
# this one; what is applied at the start, without loads; rates at the end of the last accepted step; acceleration of the
# last step without an impact.
V_START, V_BIAS, ACCELERATION, APPLIED_THEN, V_LAST, SMOOTH = 0, 1, 2, 3, 4, 5
BEFORE_SIZE = 6
# SteppingArrays.eliminated
FREE, PER, DIDT_THEN = 0, 1, 2
# SteppingArrays.energy
START, STOP = 0, 1
MECHANICAL, MAGNETIC = 0, 1
# SteppingArrays.grid: time from which steps of one length are counted [s], how many have been since; length of the last
# accepted step [s], the power of drives and loads in it, and in the step that is tried [W]; for how many steps motors
# keep their torques because of an impact, the last one included; 1: the last accepted step had an impact; length of the
# step that ``impulse`` belongs to, zero before the first one [s].
GRID_START, GRID_STEPS, LENGTH_LAST, POWER_LAST, POWER_NOW, HELD_STEPS, IMPACT_LAST, IMPULSE_STEP = range(8)
GRID_SIZE = 8


class SteppingArrays(NamedTuple):
    """What time stepping reads and writes beside ``Run``; p is the most rows that there can be."""

    theta: float
    body: np.ndarray  # (n, BODY_SIZE) as that of the model, its ARMATURE with what is implicit
    linear: np.ndarray  # (na, BLOCK_SIZE)
    segment: np.ndarray  # (na,) int: which limit holds each drive, see dynsim.dynamics.drive.law.segment_of
    torque: np.ndarray  # (na,) on the shafts, in the last accepted step without an impact [N m or N]; NaN: none yet
    eliminated: np.ndarray  # (na, 3) i' − i at v' = v, what v' − v adds to it; di/dt at the start
    before: np.ndarray  # (BEFORE_SIZE, n) see V_START and what follows it
    energy: np.ndarray  # (2, 2) at START and STOP of the step: MECHANICAL and MAGNETIC [J]
    rate: np.ndarray  # (2, p) row rates at the start and the end
    direction: np.ndarray  # (p, 6) wrenches of unit forces of the rows, kept while a sample is swept
    impulse: np.ndarray  # (p,) of the rows of candidate k at 3 k, then couplings: the next start
    f: np.ndarray  # (p,)
    b: np.ndarray  # (p,) row rates at the end without impulses
    w: np.ndarray  # (p,) what the law is on
    right: np.ndarray  # (p,) of the contact problem
    mu: np.ndarray  # (p,)
    kind: np.ndarray  # (p,) int
    modes: np.ndarray  # (c,) int: OPEN, or STICKING for three rows
    motion: np.ndarray  # (c,) int: OPEN, SLIDING or STICKING at the end of the step
    told: np.ndarray  # (c,) int: that of the last accepted step; −1 before the first
    memory: np.ndarray  # (2, c, MEMORY_SIZE) LAST and NOW
    turn: np.ndarray  # (c, TURN_SIZE)
    room: np.ndarray  # (CONE_ROOM, p, p)
    statistics: np.ndarray  # (STATISTICS_SIZE,)
    grid: np.ndarray  # (GRID_SIZE,)


def stepping_arrays(
    model: ModelArrays,
    contacts: ContactArrays,
    na: int,
    joint_rows: int,
    theta: float,
) -> SteppingArrays:
    """Allocate :class:`SteppingArrays`."""
    n, c = model.body.shape[0], contacts.link.shape[0]
    p = row_limit(c, joint_rows)
    return SteppingArrays(
        theta=float(theta),
        body=reals(model.body),
        linear=np.zeros((na, ka.BLOCK_SIZE)),
        segment=integers(np.zeros(na)),
        torque=np.full(na, np.nan),
        eliminated=np.zeros((na, 3)),
        before=np.zeros((BEFORE_SIZE, n)),
        energy=np.full((2, 2), np.nan),
        rate=np.zeros((2, p)),
        direction=np.zeros((p, 6)),
        impulse=np.zeros(p),
        f=np.zeros(p),
        b=np.zeros(p),
        w=np.zeros(p),
        right=np.zeros(p),
        mu=np.zeros(p),
        kind=integers(np.zeros(p)),
        modes=integers(np.full(c, -1)),
        motion=integers(np.full(c, ka.OPEN)),
        told=integers(np.full(c, -1)),
        memory=np.zeros((2, c, MEMORY_SIZE)),
        turn=np.zeros((c, TURN_SIZE)),
        room=np.zeros((kc.CONE_ROOM, p, p)),
        statistics=np.zeros(STATISTICS_SIZE),
        grid=np.zeros(GRID_SIZE),
    )


@internal_kernel
def moved(system, ws: Workspace, y, scale, out):
    """Positions of y moved by ``scale`` times the ka.QDD column, into out; its other entries as in y."""
    layout = system.layout
    for j in range(y.shape[0]):
        out[j] = y[j]
    for i in range(ws.joints.shape[0]):
        ws.joints[i, ka.QDD] *= scale
    if layout.extra == 0:
        for i in range(ws.joints.shape[0]):
            out[layout.q + i] += ws.joints[i, ka.QDD]
    else:
        displace(system.model, ws, out, layout.q)
        normalise(system.model, out, layout.q)


@internal_kernel
def place_joints(system, ws: Workspace, y):
    """Positions of y into ``ws.joints``."""
    layout = system.layout
    if layout.extra > 0:
        read_positions(system.model, y, layout.q, ws)
        return
    for i in range(ws.joints.shape[0]):
        ws.joints[i, ka.Q] = y[layout.q + i]


@internal_kernel
def geometry(system, model: ModelArrays, ws: Workspace):
    """Poses, gaps and rows at the positions and rates in ``ws.joints``; tangents along and across the grip axis.

    Without one they are functions of the normal: isotropic friction does not turn with the body.
    """
    forward_sweep(model, ws, 1.0, 0.0, 1.0)
    contact_rows(model, system.contacts, system.unilateral, ws)
    shaped_rows(system.shapes, system.unilateral, model, system.contacts, ws)
    state = ws.contacts
    for k in range(state.shape[0]):
        R, n = rotation(ws.links, system.contacts.link[k, ka.LINK], ka.R), vector(state, k, ka.NORMAL)
        t = rotate(R, vector(system.contacts.law, k, ka.GRIP_AXIS))
        across = dot_vector(t, n)
        t = t[0] - across * n[0], t[1] - across * n[1], t[2] - across * n[2]
        length = math.sqrt(dot_vector(t, t))
        if not length > 1e-6:  # there is no axis, or it is along the normal: any direction does
            t = (0.0, n[2], -n[1]) if abs(n[0]) < 0.7 else (-n[2], 0.0, n[0])
            length = math.sqrt(dot_vector(t, t))
        t = t[0] / length, t[1] / length, t[2] / length
        put_vector(state, k, ka.FIRST_TANGENT, t)
        put_vector(state, k, ka.SECOND_TANGENT, cross(n, t))


@internal_kernel
def constraint_rates(model: ModelArrays, ws: Workspace, y, first, out):
    """J v of all rows, v from ``first`` on in y. A row's rate climbs from its link to the world."""
    rows, active = ws.rows, ws.active
    for r in range(ws.counts[ka.ROWS]):
        a, b = active[r, ka.BODY_A], active[r, ka.BODY_B]
        if r < ws.counts[ka.COUPLED]:
            out[r] = rows[r, ka.ROW] * y[first + a] + rows[r, ka.ROW + 1] * y[first + b]
            continue
        row, total = six(rows, r, ka.ROW), 0.0
        while a >= 0:
            total += y[first + a] * dot(row, six(ws.links, a, ka.S))
            a = model.tree[a, ka.PARENT]
        if active[r, ka.ROW_KIND] == ka.BODY_ROW:
            while b >= 0:
                total -= y[first + b] * dot(row, six(ws.links, b, ka.S))
                b = model.tree[b, ka.PARENT]
        out[r] = total
