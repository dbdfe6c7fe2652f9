"""Time stepping: equations, tables and workspace, and the geometry of a step.

The method is Moreau's and Jean's θ method for the whole coupled system. It advances (q, v, i) by a step h, with the
geometry at the midpoint q_m = q + h v / 2 and x_θ = x + θ (x' − x):

    M (v' − v) = h (τ_θ + Q − bias) + Jᵀ p,    L (i' − i) = h (u_θ − R i_θ − K_m v_θ),    q' = q + h v_θ

Drives are treated implicitly by their linear blocks: i' is eliminated, which adds the effect of voltage loops, back-EMF
and damping to the diagonal of M (``stepping.step``). The impulses p solve one contact problem for all candidates that
touch at q_m; its law applies to the rates at the end, with the rows at the end (``stepping.contacts``).

θ = 1 adds damping and is of first order; θ = 1/2 is of second order between events and, apart from contacts, conserves
the energy of linear systems up to rounding. A landing leaves a penetration of up to h times its speed, which is removed
afterwards.

The ledger contains discrete work: the power at x_θ, friction −p_t·(u + u')/2, and p_n (u_n + u_n')/2 of closed rows.
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

# Residuals of contact problems [m/s]: target of a search, acceptable residual, and residual above which a solve counts
# as capped. Below the last value, a touching point does not count as leaving, and a sticking point not as slipping.
GOOD, FAIR, BAD = 1e-11, 1e-10, 1e-8
# Fraction of GOOD up to which impulses are kept after a step in which they were not: a step that stops a motion needs
# more impulse than the next one, and the surplus would start the opposite motion.
LEFT = 0.1
# Number of starts in the last search, and total number of starts in all searches.
LAST_ROUNDS = 12
MOST_ROUNDS = 1 + 2 * kc.NEAR_STEPS + LAST_ROUNDS
# Gap that counts as closed [m]; it is far above rounding.
MARGIN = 1e-10
# SteppingArrays.memory: the last accepted step, and the step being tried; columns for each candidate
LAST, NOW = 0, 1
LISTED = 0  # 1: the candidate had rows
CLOSED = 1  # 1: the candidate pressed, or touched without leaving
SLID = 2  # 1: the candidate slid
NORMAL_IMPULSE = 3  # [N s]
END_RATE = 4  # 3: rates of the candidate's rows at the end of the step
NORMAL_THEN, TANGENT_THEN = 7, 10  # 3 each: directions of the first two rows
CENTRE = 13  # 3: centre of the touching sphere [m]
BUDGET = 16  # energy dissipated by the landing [J], which may be used to push the point out of its surface
STORED = 17  # energy in the contact's spring [J]
MEMORY_SIZE = 18
# SteppingArrays.turn, for a candidate with rows
ADDED = 0  # 3: additions of the law to the end rates of the candidate's rows [m/s]
TURNED = 3  # 3: part of these additions due to turning rows
PUSH = 6  # rate at which the point is pushed out of its surface [m/s]; negative: allowed to move into it
MEAN = 7  # 1: the point continues to slide, along the mean of its rates
KNOWN = 8  # 1: the rows continue the rows of the last step
STRUCK = 9  # impact loss recorded in the step [J]
PRESSED_IN, IMPLICIT = 10, 11  # compliant contacts: gap at the start [m], and φ of the law
TURN_SIZE = 12
# SteppingArrays.statistics: largest residual [m/s]; number of solves above BAD; largest penetration [m]; number of
# solves, and of solves with more than one start; largest scheme energy at any time, removed (positive) or created
# (negative) [J]; number of steps in which drive limits contradict each other; change of energy if everything occurred
# half a step later [J]; number of solves without the additions of the law to the rates, because no solution existed
# with them.
WORST, CAPPED, PENETRATION, SOLVES, LONG_SOLVES, TAKEN, UNSETTLED, HALF_STEP, DROPPED = 0, 1, 2, 3, 4, 5, 6, 7, 8
# Largest energy removed by steps up to any time, and largest energy created since then [J].
MOST_TAKEN, MADE = 9, 10
STIFFEST = 11  # largest stiffness times mobility of a compliant row [1/s²]
# Work of the changes of free bodies' rates in this step, which no force does [J].
BALANCED = 12
CYCLED = 13  # number of solves by articulated inertias that failed, so that the step was solved by a dense matrix
STATISTICS_SIZE = 14
# SteppingArrays.before: rates at the start; rates used for the velocity products; acceleration of the last step, which
# the acceleration of this step replaces; applied torques at the start, without loads; rates at the end of the last
# accepted step; acceleration of the last step without an impact.
V_START, V_BIAS, ACCELERATION, APPLIED_THEN, V_LAST, SMOOTH = 0, 1, 2, 3, 4, 5
BEFORE_SIZE = 6
# SteppingArrays.eliminated
FREE, PER, DIDT_THEN = 0, 1, 2
# SteppingArrays.energy
START, STOP = 0, 1
MECHANICAL, MAGNETIC = 0, 1
# SteppingArrays.grid: time from which steps of equal length are counted [s], and number of such steps since then;
# length of the last accepted step [s]; power of drives and loads in this step, and in the step being tried [W]; number
# of steps for which motors keep their torques because of an impact, including the last step; 1 if the last accepted
# step had an impact; length of the step to which ``impulse`` belongs, zero before the first step [s].
GRID_START, GRID_STEPS, LENGTH_LAST, POWER_LAST, POWER_NOW, HELD_STEPS, IMPACT_LAST, IMPULSE_STEP = range(8)
GRID_SIZE = 8
# SteppingArrays.group, for each row: first row of its island; 1 in the first row of an island whose last impulses have
# solved this step. Then, for the rows of the island being solved: row and kind.
ISLAND, KEPT, ROW, KIND = 0, 1, 2, 3
# SteppingArrays.part, for the rows of the island being solved.
RIGHT, IMPULSE, RATE, MU = 0, 1, 2, 3


class ArticulatedArrays(NamedTuple):
    """Working arrays of dynsim.integrators.stepping.articulated_contacts for n links and c contact candidates."""

    link: np.ndarray  # (n + 1, LINK_SIZE); row n, or −1, is the world: its motion and matrices remain zero
    contact: np.ndarray  # (c, CONTACT_SIZE)


class SteppingArrays(NamedTuple):
    """Working arrays of time stepping in addition to ``Run``; p is the largest possible number of rows."""

    theta: float
    body: np.ndarray  # (n, BODY_SIZE) body of the model with the implicit terms added to ARMATURE
    linear: np.ndarray  # (na, BLOCK_SIZE)
    segment: np.ndarray  # (na,) int: active limit of each drive, see dynsim.dynamics.drive.law.segment_of
    torque: np.ndarray  # (na,) shaft torque in the last accepted step without an impact [N m or N]; NaN before it
    eliminated: np.ndarray  # (na, 3) i' − i at v' = v; derivative of i' − i by v' − v; di/dt at the start
    before: np.ndarray  # (BEFORE_SIZE, n) see V_START and following
    energy: np.ndarray  # (2, 2) at START and STOP of the step: MECHANICAL and MAGNETIC [J]
    rate: np.ndarray  # (2, p) row rates at the start and the end
    direction: np.ndarray  # (p, 6) wrenches of unit forces of the rows, saved while a sample is swept
    impulse: np.ndarray  # (p,) initial impulses of the next solve: rows of candidate k at 3 k, then couplings
    f: np.ndarray  # (p,)
    b: np.ndarray  # (p,) row rates at the end without impulses
    w: np.ndarray  # (p,) rates in the contact law
    right: np.ndarray  # (p,) right-hand side of the contact problem
    mu: np.ndarray  # (p,)
    kind: np.ndarray  # (p,) int
    modes: np.ndarray  # (c,) int: OPEN, or STICKING for three rows
    motion: np.ndarray  # (c,) int: OPEN, SLIDING or STICKING at the end of the step
    logged_motion: np.ndarray  # (c,) int: motion in the last accepted step; −1 before the first
    memory: np.ndarray  # (2, c, MEMORY_SIZE) LAST and NOW
    turn: np.ndarray  # (c, TURN_SIZE)
    room: np.ndarray  # (CONE_ROOM + 1, p, p) scratch of the solver, and W of the island being solved
    group: np.ndarray  # (4, p) int: see ISLAND and following
    part: np.ndarray  # (4, p): see RIGHT and following
    statistics: np.ndarray  # (STATISTICS_SIZE,)
    grid: np.ndarray  # (GRID_SIZE,)
    free: np.ndarray  # (k,) int: first rotational rows of free bodies, if bodies touch each other
    articulated: ArticulatedArrays | None  # None if bodies touch each other


def stepping_arrays(
    model: ModelArrays,
    contacts: ContactArrays,
    na: int,
    joint_rows: int,
    theta: float,
    free: np.ndarray | None = None,
    articulated: ArticulatedArrays | None = None,
) -> SteppingArrays:
    """Allocate :class:`SteppingArrays` for ``joint_rows`` rows of joints, and the rows of all candidates."""
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
        logged_motion=integers(np.full(c, -1)),
        memory=np.zeros((2, c, MEMORY_SIZE)),
        turn=np.zeros((c, TURN_SIZE)),
        room=np.zeros((kc.CONE_ROOM + 1, p, p)),
        group=integers(np.zeros((4, p))),
        part=np.zeros((4, p)),
        statistics=np.zeros(STATISTICS_SIZE),
        grid=np.zeros(GRID_SIZE),
        free=integers(np.zeros(0) if free is None else free),
        articulated=articulated,
    )


@internal_kernel
def moved(system, ws: Workspace, y, scale, out):
    """Write y to out, with its positions moved by ``scale`` times the ka.QDD column."""
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
    """Copy the positions of y into ``ws.joints``."""
    layout = system.layout
    if layout.extra > 0:
        read_positions(system.model, y, layout.q, ws)
        return
    for i in range(ws.joints.shape[0]):
        ws.joints[i, ka.Q] = y[layout.q + i]


@internal_kernel
def place_state(system, ws: Workspace, y):
    """Copy positions and rates of y into ``ws.joints``, without applied forces."""
    place_joints(system, ws, y)
    for i in range(ws.joints.shape[0]):
        ws.joints[i, ka.QD], ws.joints[i, ka.APPLIED] = y[system.layout.v + i], 0.0


@internal_kernel
def geometry(system, model: ModelArrays, ws: Workspace):
    """Compute poses, gaps and rows at the positions and rates in ``ws.joints``.

    Tangents are along and across the grip axis. Without a grip axis, they depend only on the normal, because isotropic
    friction does not turn with the body.
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
        if not length > 1e-6:  # no axis, or an axis along the normal: any direction is suitable
            t = (0.0, n[2], -n[1]) if abs(n[0]) < 0.7 else (-n[2], 0.0, n[0])
            length = math.sqrt(dot_vector(t, t))
        t = t[0] / length, t[1] / length, t[2] / length
        put_vector(state, k, ka.FIRST_TANGENT, t)
        put_vector(state, k, ka.SECOND_TANGENT, cross(n, t))


@internal_kernel
def constraint_rates(model: ModelArrays, ws: Workspace, y, first, out):
    """Write J v of all rows to out, where v starts at index ``first`` in y.

    The rate of a row is summed over the joints from its link to the world.
    """
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
        while b >= 0:
            total -= y[first + b] * dot(row, six(ws.links, b, ka.S))
            b = model.tree[b, ka.PARENT]
        out[r] = total
