"""Tables for unilateral contacts, joint stops, dry friction and ties; slip direction and friction coefficient.

0 ≤ f_n ⟂ gap ≥ 0. The force on a sliding point is f_n (n − μ(s) t), t = v_t/|v_t|, s = |v_t|; a point at rest sticks
while |f_t| ≤ μ_s f_n. Modes (open, sliding, sticking) are constant within a step of the event-driven integrators;
:mod:`dynsim.integrators.contacts.modes` chooses them. This file contains the parts of the law that the right-hand side
uses.

A tie is a spring and damper between two bodies along or about an axis, with a bound on its force.
``NAME = 0  # 3: …`` means three columns, starting at column 0.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.cone import steps as kc
from dynsim.dynamics.tables import ContactArrays, Workspace
from dynsim.jit.kernel import internal_kernel

# UnilateralArrays.slide
REFERENCE = 0  # 3: slip direction at the start of the step, or the last direction set while FROZEN; 0 before any slip
FROZEN = 3  # 1: slip is too slow to define a direction, so friction is near REFERENCE, see slide_direction
SPEED = 4  # v_t · REFERENCE [m/s]
NEXT = 5  # 3: slip direction at the end of the step
NEXT_SPEED = 8  # |v_t| at the end of the step [m/s]
LANDS_AT = 9  # depth below its surface at which an open candidate has landed [m]
HEADWAY = 10  # speed against REFERENCE at the start of slip [m/s]; a reversal of slip is measured from this speed
SLIDE_SIZE = 11
# LANDS_AT is DEPTH until the candidate has been higher than −DEPTH, because projection leaves closed contacts within
# ± DEPTH/2; after that, LANDS_AT is AT_ROOT, which is practically gap = 0.
DEPTH, AT_ROOT = 2e-10, 1e-13
# UnilateralArrays.tally, for each candidate
TIME_OPEN, TIME_SLIDING, TIME_STICKING = 0, 1, 2  # time spent in each mode, in the order of the modes [s]
LIFT_OFFS, LANDINGS, SLIP_STARTS, BOUNCES = 3, 4, 5, 6
LOSS = 7  # energy dissipated by impacts [J]
# Joint stops have the next four columns in the same order.
SETTLE = 8  # speed along the normal below which a touching point counts as at rest [m/s]
WINDOW_START, WINDOW_COUNT = 9, 10  # window and count of events for the detection of chatter
CHATTERED = 11  # number of times that SETTLE was raised because of chatter
DEEPEST = 12  # largest depth below the surface [m]
UNPRESSED = 13  # time for which the candidate stuck although nothing pressed it [s]
# Number of impacts in which the candidate left although another solution keeps it; time of the first such impact [s].
OPEN_IMPACTS, OPEN_SINCE = 14, 15
TALLY_SIZE = 16
# UnilateralArrays.stop_table, int
STOP_JOINT = 0  # link whose joint is stopped
STOP_CLOSED = 1
STOP_ROW = 2  # row of the stop while it is closed
STOP_BEFORE = 3  # scratch of the choice of modes
STOP_TOUCHED = 4  # scratch: STOP_CLOSED before the choice of modes
STOP_STRUCK = 5  # 1: the joint has just hit the stop
STOP_TABLE_SIZE = 6
# UnilateralArrays.stop
SIDE = 0  # 1 for a lower limit, −1 for an upper one
LIMIT = 1  # SIDE times the limit [rad or m]: the gap is SIDE q − LIMIT
STOP_FORCE = 2  # [N m or N], ≥ 0
HITS = 3
STOP_LOSS = 4  # [J]
CLOSED_TIME = 5  # [s]
HIT_AT = 6  # depth beyond the limit at which the joint hits the stop: DEPTH, or more if it left from there [rad or m]
STOP_GAP_THEN, STOP_RATE_THEN = 7, 8  # at the start of the step [rad, rad/s; m, m/s]
STOP_SETTLE = 9  # a joint that leaves its stop after an impact at less than this rate stays on it [rad/s or m/s]
STOP_WINDOW_START, STOP_WINDOW_COUNT, STOP_CHATTERED = 10, 11, 12  # as for a candidate
STOP_SIZE = 13
# UnilateralArrays.dry_table, int
DRY_JOINT = 0  # link whose joint has dry friction
DRY_ROW = 1
DRY_DRIVE = 2  # drive whose gear has dry friction, -1 if none
DRY_HOLDS = 3  # 1: the friction has a row, bounded in time stepping; 0: its force is constant (event-driven methods)
DRY_NEXT = 4  # scratch of the choice of modes
DRY_TOLD = 5  # state last reported to the log: 1 held, 0 sliding, -1 nothing reported yet
DRY_BRAKE = 6  # brake of the joint: NEVER_CLOSED, CLOSED, or OPENED again; may be written between steps
DRY_OVERLOADED = 7  # scratch of the choice of modes, as OVERLOADED
DRY_TABLE_SIZE = 8
NEVER_CLOSED, CLOSED, OPENED = 0, 1, 2
# UnilateralArrays.dry: dry friction of gear and joint [N m or N]; the sum bounds the force at rest and opposes motion
OF_GEAR, OF_JOINT = 0, 1
DRY_FORCE = 2  # on the joint [N m or N]
DRY_SIDE = 3  # in motion: sign of the rate; at rest: force as a fraction of the bound, between −1 and 1
DRY_AT = 4  # position at which the joint is held [rad or m]
DRY_HEADWAY = 5  # speed against DRY_SIDE at the start of slip, which the rows could not remove
DRY_LEFT = 6  # acceleration_left() of rows that depended on each other at the last choice of modes [rad/s² or m/s²]
DRY_RATE_THEN, DRY_ACCELERATION_THEN = 7, 8  # at the start of the step [rad/s, rad/s²; m/s, m/s²]
DRY_SIZE = 9
# UnilateralArrays.tie_table, int
TIE_A, TIE_B = 0, 1  # links
TIE_TURNS = 2  # 1: the tie acts about its axis, 0: along it
TIE_KIND = 3  # BOX, ONE_WAY (A is pushed along the axis), or -1 if inactive; may be written between steps
TIE_HOLDS = 4  # 1: the tie has a row
TIE_ROW = 5
TIE_TABLE_SIZE = 6
# UnilateralArrays.tie; its parameters may also be written between steps
TIE_STIFFNESS, TIE_DAMPING = 0, 1  # [N/m, N s/m; N m/rad, N m s/rad]
TIE_BOUND = 2  # bound of a BOX [N or N m]
TIE_AXIS = 3  # 3: axis of the tie in the frame of A
TIE_POINT, TIE_OTHER_POINT = 6, 9  # 3 each: on A, on B [m]
TIE_ATTITUDE = 12  # 9: rotation of B in the axes of A without deflection
TIE_REST = 21  # deflection without force [m or rad]; NaN: the deflection at which the tie begins
TIE_FORCE = 22  # on A along or about the axis [N or N m]
TIE_STORED = 23  # energy in its spring [J]
TIE_GIVEN = 24  # total movement of the rest value since the tie began, in both directions [m or rad]
TIE_REST_NOW, TIE_STORED_NOW, TIE_AT, TIE_IMPLICIT = 25, 26, 27, 28  # values for the step being tried
TIE_TURNED = 29  # torsion: component of the rotation vector along the axis at the last step [rad]
TIE_SIZE = 30
# UnilateralArrays.mode, int: columns
WANTED, BEFORE, TOUCHING, STRUCK = 0, 1, 2, 3
KINETIC_ONLY = 4  # 1: the candidate has reached its static cone, and the kinetic coefficient applies from now on
LEAVES = 5  # 1: nothing presses the candidate, and the next choice of modes excludes it
TOUCHED = 6  # TOUCHING before a choice of modes
OVERLOADED = 7  # 1: at rest the candidate would exceed its friction, however small its acceleration
BEGINS = 8  # scratch of the choice of modes; 1: friction acts along REFERENCE now, see contacts.modes.aim
MODE_SIZE = 9
# UnilateralArrays.vector: three vectors for the splits of forces, then five for the problem that chooses modes
OFFSET, SOLUTION, CONE_FRICTION, FIRST_PART, SECOND_PART = 3, 4, 5, 6, 7
VECTORS = 8
# UnilateralArrays.index, int: three for the splits of forces; kinds of the problem's rows, and their rows in the table
KINDS, TABLE_ROW = 3, 4
INDICES = 5
# UnilateralArrays.room
SPLIT_MATRIX, NULL_SPACE, PROBLEM, SCRATCH = 0, 1, 2, 3
ROOM = SCRATCH + kc.CONE_ROOM
# UnilateralArrays.number
REDUNDANT = 0  # 1: the rows of sticking points, held joints and stops depend on each other
BEST_MARGIN = 1  # worst margin of the best split of their forces [N], if the least norm is outside the cones
SPLIT = 2  # 1: BEST_MARGIN is valid at this evaluation
SLOW = 3  # slip along REFERENCE below this speed does not define a direction [m/s]
LAST_CHANGE, CHANGES = 4, 5  # time of the last change of modes, and number of changes at that time
HOLDING = 6  # factor applied to friction at rest while modes are chosen; otherwise 1
WIDTH = 7  # number of independent splits (columns of room[NULL_SPACE]) at the last evaluation with dependent rows
SHARED = 8  # 1: a contact slides and rows depend on each other, so that forces continue from ``shares``
SPLIT_ROWS = 9  # number of rows of the last splits, without couplings
SEARCH = 10  # start of the choice of modes: FROM_ZERO, NEAR or LAST
CORNER = 11  # 1: that choice ended in a corner of the admissible forces and was rejected
CREEP = 12  # a joint with dry friction below this rate may be at rest [rad/s or m/s]
LEFT = 13  # projection residual after the last choice of modes, relative to its tolerance; see contacts.events
NUMBERS = 14
# Start of the search for forces: zero; near the previous forces; zero, and any solution is accepted.
FROM_ZERO, NEAR, LAST = 0.0, 1.0, 2.0


class UnilateralArrays(NamedTuple):
    """c candidates, s joint stops, d joints with dry friction, e ties; p is the largest possible number of rows."""

    slide: np.ndarray  # (c, SLIDE_SIZE)
    mode: np.ndarray  # (c, MODE_SIZE) int
    tally: np.ndarray  # (c, TALLY_SIZE)
    stop_table: np.ndarray  # (s, STOP_TABLE_SIZE) int
    stop: np.ndarray  # (s, STOP_SIZE)
    dry_table: np.ndarray  # (d, DRY_TABLE_SIZE) int
    dry: np.ndarray  # (d, DRY_SIZE)
    tie_table: np.ndarray  # (e, TIE_TABLE_SIZE) int, time stepping only: see dynsim.integrators.stepping.contacts
    tie: np.ndarray  # (e, TIE_SIZE)
    index: np.ndarray  # (INDICES, p or c + 2) int
    vector: np.ndarray  # (VECTORS, p)
    room: np.ndarray  # (ROOM, p, p): two matrices for the splits, the matrix of the problem that chooses modes, scratch
    split_room: np.ndarray  # scratch of the splits
    number: np.ndarray  # (NUMBERS,)
    shares: np.ndarray  # forces at the last change of modes, see dynsim.dynamics.contact.shares
    kept: np.ndarray  # copy, made before a choice of modes, of the above tables that the choice overwrites


def share_count(couplings: int, contacts: int, stops: int, joints: int) -> int:
    """Return the length of ``shares``."""
    return couplings + stops + joints + ka.MOST_ROWS * contacts


def kept_size(shares: int, contacts: int, stops: int, joints: int) -> int:
    """Return the length of ``kept``, see :mod:`dynsim.integrators.contacts.impacts`."""
    candidate, stop, joint = SLIDE_SIZE + MODE_SIZE + TALLY_SIZE, STOP_TABLE_SIZE + STOP_SIZE, DRY_TABLE_SIZE + DRY_SIZE
    return contacts * candidate + stops * stop + joints * joint + NUMBERS + shares


@internal_kernel
def slide_direction(unilateral: UnilateralArrays, contacts: ContactArrays, k, slip, n):
    """Return the slip direction of candidate k at tangential velocity ``slip`` and normal n, and its friction there.

    The direction is v_t/|v_t| with the sign of v_t · REFERENCE: it does not flip when v_t passes through zero, so that
    a step past the end of slip is smooth, and slip ends where v_t · REFERENCE is zero.

    While FROZEN, with r = REFERENCE along the surface, whose normal turns within a step, and s = SLOW, it is the
    direction of w = v_t + max(0, s − v_t·r) r: of v_t itself if the point slides along r at s or faster. A direction
    that did not follow slip across r would drive it: friction off the direction in which forces balance accelerates the
    point to s at once, however slowly it slides along r. Instead the direction turns until they balance, at a slip of
    s tan(angle) across r; its time constant has s in place of |v_t|.
    """
    slide, (x, y, z) = unilateral.slide, slip
    a, b, c = slide[k, REFERENCE], slide[k, REFERENCE + 1], slide[k, REFERENCE + 2]
    along = x * a + y * b + z * c
    slide[k, SPEED] = along
    speed = along
    if slide[k, FROZEN] == 1.0:
        more, up = max(0.0, unilateral.number[SLOW] - along), a * n[0] + b * n[1] + c * n[2]
        a, b, c = a - up * n[0], b - up * n[1], c - up * n[2]
        u, v, w = x + more * a, y + more * b, z + more * c
        size = math.sqrt(u * u + v * v + w * w)
        if size > 0.0:
            a, b, c = u / size, v / size, w / size
            speed = x * a + y * b + z * c
        return a, b, c, sliding_friction(contacts.law, k, speed)
    size = math.sqrt(x * x + y * y + z * z)
    if size > 0.0:
        scale = 1.0 / size if along >= 0.0 else -1.0 / size
        a, b, c = x * scale, y * scale, z * scale
        speed = size if along >= 0.0 else -size
    return a, b, c, sliding_friction(contacts.law, k, speed)


@internal_kernel
def stop_gap(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return the distance of a joint from its stop k, ≥ 0 [rad or m]."""
    stop = unilateral.stop
    return stop[k, SIDE] * ws.joints[unilateral.stop_table[k, STOP_JOINT], ka.Q] - stop[k, LIMIT]


@internal_kernel
def stop_rate(unilateral: UnilateralArrays, ws: Workspace, k):
    """Return the rate of :func:`stop_gap` [rad/s or m/s]."""
    return unilateral.stop[k, SIDE] * ws.joints[unilateral.stop_table[k, STOP_JOINT], ka.QD]


@internal_kernel
def note_stop_forces(unilateral: UnilateralArrays, ws: Workspace):
    """Record the forces of the joint stops from their rows; open stops have zero force."""
    table = unilateral.stop_table
    for k in range(table.shape[0]):
        closed = table[k, STOP_CLOSED] == 1
        unilateral.stop[k, STOP_FORCE] = ws.rows[table[k, STOP_ROW], ka.FORCE] if closed else 0.0


@internal_kernel
def dry_bound(unilateral: UnilateralArrays, k):
    """Return the total dry friction, of gear and bearing, of the k-th joint with dry friction [N m or N]."""
    return unilateral.dry[k, OF_GEAR] + unilateral.dry[k, OF_JOINT]


@internal_kernel
def holding_bound(unilateral: UnilateralArrays, k):
    """Return the dry friction [N m or N] that can hold the k-th joint; slightly reduced while modes are chosen."""
    return unilateral.number[HOLDING] * dry_bound(unilateral, k)


@internal_kernel
def rows_of_couplings(unilateral: UnilateralArrays, ws: Workspace):
    """Return the number of coupling rows, which come first in the table, before held joints and closed stops."""
    rows = ws.counts[ka.COUPLED] - dry_rows_held(unilateral)
    for k in range(unilateral.stop_table.shape[0]):
        rows -= unilateral.stop_table[k, STOP_CLOSED]
    return rows


@internal_kernel
def dry_rows_held(unilateral: UnilateralArrays):
    """Return the number of rows of joints held by dry friction."""
    rows = 0
    for k in range(unilateral.dry_table.shape[0]):
        rows += unilateral.dry_table[k, DRY_HOLDS]
    return rows


@internal_kernel
def dry_rests(unilateral: UnilateralArrays, k):
    """Return whether dry friction keeps a joint at rest, by a row or, if contacts hold it, by a constant force."""
    return unilateral.dry_table[k, DRY_HOLDS] == 1 or abs(unilateral.dry[k, DRY_SIDE]) < 1.0


@internal_kernel
def apply_dry_friction(unilateral: UnilateralArrays | None, ws: Workspace):
    """Add the dry friction of joints without a row to the applied forces; it is constant within a step."""
    if unilateral is None:  # resolved at compile time
        return
    for k in range(unilateral.dry.shape[0]):
        if unilateral.dry_table[k, DRY_HOLDS] == 0:
            force = unilateral.dry[k, DRY_SIDE] * dry_bound(unilateral, k)
            ws.joints[unilateral.dry_table[k, DRY_JOINT], ka.APPLIED] -= force


@internal_kernel
def note_dry_forces(unilateral: UnilateralArrays, ws: Workspace):
    """Record the friction forces of all joints with dry friction, and the drag of the gears on their shafts."""
    table, dry = unilateral.dry_table, unilateral.dry
    for k in range(table.shape[0]):
        force, a = -dry[k, DRY_SIDE] * dry_bound(unilateral, k), table[k, DRY_DRIVE]
        if table[k, DRY_HOLDS] == 1:
            force = ws.rows[table[k, DRY_ROW], ka.FORCE]
        dry[k, DRY_FORCE] = force
        if a >= 0:
            ws.motors[a, ka.DRY_DRAG] = -force * dry[k, OF_GEAR] / dry_bound(unilateral, k)


@internal_kernel
def sliding_friction(law, k, speed):
    """Return the friction coefficient of candidate k at a sliding speed; ``law`` has shape (c, CONTACT_LAW_SIZE)."""
    mu = law[k, ka.MU]
    if law[k, ka.STRIBECK] > 0.0:
        ratio = speed / law[k, ka.STRIBECK]
        mu += (law[k, ka.STATIC] - mu) * math.exp(-ratio * ratio)
    return mu + law[k, ka.VISCOUS] * speed
