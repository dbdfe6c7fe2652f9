"""Tables of contacts under the unilateral law, of joint stops, dry friction and ties; slip and friction coefficient.

0 ≤ f_n ⟂ gap ≥ 0. The force on a sliding point is f_n (n − μ(s) t), t = v_t/|v_t|, s = |v_t|; a point at rest sticks
while |f_t| ≤ μ_s f_n. Modes (open, sliding, sticking) are constant within a step of the event-driven integrators;
:mod:`dynsim.integrators.contacts.modes` chooses them. Here are the parts of the law that the right-hand side needs.

A tie is a spring and damper between two bodies along or about an axis, with a bound of its force.
``NAME = 0  # 3: …`` means three columns from column 0.
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
REFERENCE = 0  # 3: direction of slip at the start of the step, or while FROZEN as last taken; 0 before any slip
FROZEN = 3  # 1: slip is too slow to define a direction, so friction is near REFERENCE, see slide_direction
SPEED = 4  # v_t · REFERENCE [m/s]
NEXT = 5  # 3: direction at the end of the step
NEXT_SPEED = 8  # |v_t| there [m/s]
LANDS_AT = 9  # depth below its surface at which a candidate that is off it has landed [m]
HEADWAY = 10  # speed against REFERENCE that was left when slip began; its reversal is counted from there [m/s]
SLIDE_SIZE = 11
# LANDS_AT is DEPTH until the candidate has been higher than −DEPTH, because projection leaves closed contacts within
# ± DEPTH/2; after that it is AT_ROOT, practically at gap = 0.
DEPTH, AT_ROOT = 2e-10, 1e-13
# UnilateralArrays.tally, of a candidate
TIME_OPEN, TIME_SLIDING, TIME_STICKING = 0, 1, 2  # in the order of the modes [s]
LIFT_OFFS, LANDINGS, SLIP_STARTS, BOUNCES = 3, 4, 5, 6
LOSS = 7  # energy that impacts have taken [J]
# The next four are in the same order for stops.
SETTLE = 8  # slower than that a touching point counts as at rest along the normal [m/s]
WINDOW_START, WINDOW_COUNT = 9, 10  # of the count of events that detects chatter
CHATTERED = 11  # how often SETTLE was raised because of it
DEEPEST = 12  # largest depth below the surface [m]
UNPRESSED = 13  # time for which it stuck although nothing pressed it [s]
# Impacts in which it left although a solution exists that keeps it, and the time of the first of them [s].
OPEN_IMPACTS, OPEN_SINCE = 14, 15
TALLY_SIZE = 16
# UnilateralArrays.stop_table, int
STOP_JOINT = 0  # link whose joint it stops
STOP_CLOSED = 1
STOP_ROW = 2  # its row while it is closed
STOP_BEFORE = 3  # scratch of the choice of modes
STOP_TOUCHED = 4  # scratch too: STOP_CLOSED before it
STOP_STRUCK = 5  # 1: its joint has just run against it
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
STOP_SETTLE = 9  # slower than that a joint that an impact drives off its stop stays on it [rad/s or m/s]
STOP_WINDOW_START, STOP_WINDOW_COUNT, STOP_CHATTERED = 10, 11, 12  # as of a candidate
STOP_SIZE = 13
# UnilateralArrays.dry_table, int
DRY_JOINT = 0  # link whose joint rubs
DRY_ROW = 1
DRY_DRIVE = 2  # whose gear does, -1 for none
DRY_HOLDS = 3  # 1: it has a row, bounded in time stepping; 0: its force is constant, by the event-driven methods
DRY_NEXT = 4  # scratch of the choice of modes
DRY_TOLD = 5  # 1, 0: held or sliding, as last reported to the log; -1: nothing reported yet
DRY_BRAKE = 6  # of the joint: NEVER_CLOSED, CLOSED, or OPENED again; may be written between steps
DRY_OVERLOADED = 7  # scratch of the choice of modes, as OVERLOADED
DRY_TABLE_SIZE = 8
NEVER_CLOSED, CLOSED, OPENED = 0, 1, 2
# UnilateralArrays.dry: the force of a joint at rest is any up to the sum of both, in motion that against it [N m or N]
OF_GEAR, OF_JOINT = 0, 1
DRY_FORCE = 2  # on the joint [N m or N]
DRY_SIDE = 3  # sign of the rate at which it slides; between −1 and 1 at rest, where the force is that part of the bound
DRY_AT = 4  # where it is held [rad or m]
DRY_HEADWAY = 5  # what it began to slide with against its side, because the rows could not take it away
DRY_LEFT = 6  # acceleration_left() of rows that depended on each other at the last choice of modes [rad/s² or m/s²]
DRY_RATE_THEN, DRY_ACCELERATION_THEN = 7, 8  # at the start of the step [rad/s, rad/s²; m/s, m/s²]
DRY_SIZE = 9
# UnilateralArrays.tie_table, int
TIE_A, TIE_B = 0, 1  # links
TIE_TURNS = 2  # 1: about its axis, 0: along it
TIE_KIND = 3  # BOX, ONE_WAY (A is pushed along the axis), or -1 where it does not hold; may be written between steps
TIE_HOLDS = 4  # 1: it has a row
TIE_ROW = 5
TIE_TABLE_SIZE = 6
# UnilateralArrays.tie; its parameters may be written between steps too
TIE_STIFFNESS, TIE_DAMPING = 0, 1  # [N/m, N s/m; N m/rad, N m s/rad]
TIE_BOUND = 2  # of a BOX [N or N m]
TIE_AXIS = 3  # 3: in the axes of A
TIE_POINT, TIE_OTHER_POINT = 6, 9  # 3 each: on A, on B [m]
TIE_ATTITUDE = 12  # 9: rotation of B in the axes of A where it is not turned
TIE_REST = 21  # deflection without force [m or rad]; NaN: the deflection at which the tie begins
TIE_FORCE = 22  # on A along or about the axis [N or N m]
TIE_STORED = 23  # in its spring [J]
TIE_GIVEN = 24  # how far its rest has moved since it began, there and back [m or rad]
TIE_REST_NOW, TIE_STORED_NOW, TIE_AT, TIE_IMPLICIT = 25, 26, 27, 28  # of the step that is tried
TIE_TURNED = 29  # of a torsion: its rotation vector along the axis at the last step [rad]
TIE_SIZE = 30
# UnilateralArrays.mode, int: columns
WANTED, BEFORE, TOUCHING, STRUCK = 0, 1, 2, 3
GIVES_WAY = 4  # 1: it has reached its static cone, and the kinetic coefficient holds from now on
LEAVES = 5  # 1: nothing presses it, and the next choice of modes is without it
TOUCHED = 6  # TOUCHING before a choice of modes
OVERLOADED = 7  # 1: held at rest it would have more force than its friction, however little it is accelerated
BEGINS = 8  # scratch of the choice of modes; 1: its friction is along REFERENCE now, see contacts.modes.aim
MODE_SIZE = 9
# UnilateralArrays.vector: three of the splits of forces, then those of the problem that chooses modes
OFFSET, SOLUTION, CONE_FRICTION, FIRST_PART, SECOND_PART = 3, 4, 5, 6, 7
VECTORS = 8
# UnilateralArrays.index, int: four of the splits of forces; kinds of the problem's rows, and which of the table's
KINDS, TABLE_ROW = 4, 5
INDICES = 6
# UnilateralArrays.room
SPLIT_MATRIX, NULL_SPACE, PROBLEM, SCRATCH = 0, 1, 2, 3
ROOM = SCRATCH + kc.CONE_ROOM
# UnilateralArrays.number
REDUNDANT = 0  # 1: the rows of sticking points, held joints and stops depend on each other
BEST_MARGIN = 1  # the worst margin of the best split of their forces [N], where the least norm fits no cones
SPLIT = 2  # 1: BEST_MARGIN counts at this evaluation
SLOW = 3  # slip along REFERENCE below this speed does not define a direction [m/s]
LAST_CHANGE, CHANGES = 4, 5  # time of the last change of modes, and how many there were at that time
HOLDING = 6  # share of the friction at rest that counts where modes are chosen; 1 outside of such a choice
WIDTH = 7  # number of independent splits of the last evaluation with dependent rows, columns of room[NULL_SPACE]
SHARED = 8  # 1: a contact slides and rows depend on each other, so that forces continue from ``shares``
SPLIT_ROWS = 9  # rows of the last splits, of couplings not counted
SEARCH = 10  # of the choice of modes: FROM_ZERO, NEAR or LAST
CORNER = 11  # 1: that choice ended in a corner of the admissible forces, and was given up
CREEP = 12  # below this rate a joint with dry friction may be at rest [rad/s or m/s]
LEFT = 13  # share of its tolerances that projection left after the last choice of modes, see contacts.yielding
NUMBERS = 14
# Where a choice of modes starts to look for forces: at none; near those before it; at none, and it takes any solution.
FROM_ZERO, NEAR, LAST = 0.0, 1.0, 2.0


class UnilateralArrays(NamedTuple):
    """c candidates, s joint stops, d joints with dry friction, e ties; p is the most rows that there can be."""

    slide: np.ndarray  # (c, SLIDE_SIZE)
    mode: np.ndarray  # (c, MODE_SIZE) int
    tally: np.ndarray  # (c, TALLY_SIZE)
    stop_table: np.ndarray  # (s, STOP_TABLE_SIZE) int
    stop: np.ndarray  # (s, STOP_SIZE)
    dry_table: np.ndarray  # (d, DRY_TABLE_SIZE) int
    dry: np.ndarray  # (d, DRY_SIZE)
    tie_table: np.ndarray  # (e, TIE_TABLE_SIZE) int, of time stepping alone: see dynsim.integrators.stepping.contacts
    tie: np.ndarray  # (e, TIE_SIZE)
    index: np.ndarray  # (INDICES, p or c + 2) int
    vector: np.ndarray  # (VECTORS, p)
    room: np.ndarray  # (ROOM, p, p) two matrices of the splits, one of the problem that chooses modes, its scratch
    split_room: np.ndarray  # scratch of the splits
    number: np.ndarray  # (NUMBERS,)
    shares: np.ndarray  # forces at the last change of modes, see dynsim.dynamics.contact.shares
    kept: np.ndarray  # the tables above that a choice of modes writes, as they were before it


def share_count(couplings: int, contacts: int, stops: int, joints: int) -> int:
    """Length of ``shares``."""
    return couplings + stops + joints + ka.MOST_ROWS * contacts


def kept_size(shares: int, contacts: int, stops: int, joints: int) -> int:
    """Length of ``kept``, see :mod:`dynsim.integrators.contacts.impacts`."""
    candidate, stop, joint = SLIDE_SIZE + MODE_SIZE + TALLY_SIZE, STOP_TABLE_SIZE + STOP_SIZE, DRY_TABLE_SIZE + DRY_SIZE
    return contacts * candidate + stops * stop + joints * joint + NUMBERS + shares


@internal_kernel
def slide_direction(unilateral: UnilateralArrays, contacts: ContactArrays, k, slip, n):
    """Direction of slip of candidate k at tangential velocity ``slip`` and normal n, and its friction there.

    The direction is v_t/|v_t| with the sign of v_t · REFERENCE: it does not flip when v_t passes through zero, so that
    a step that passes the end of slip is smooth, and slip ends where v_t · REFERENCE is zero.

    While FROZEN, with r = REFERENCE along the surface, whose normal turns within a step, and s = SLOW, it is that of
    w = v_t + max(0, s − v_t·r) r: of v_t itself if the point slides along r at s or faster. A direction that did not
    follow slip across r would drive it: friction off the direction in which forces balance accelerates the point to s
    at once, however slowly it slides along r. Instead the direction turns until they balance, at a slip of s tan(angle)
    across r; its time constant has s in place of |v_t|.
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
    """Distance of its joint from joint stop k, ≥ 0 [rad or m]."""
    stop = unilateral.stop
    return stop[k, SIDE] * ws.joints[unilateral.stop_table[k, STOP_JOINT], ka.Q] - stop[k, LIMIT]


@internal_kernel
def stop_rate(unilateral: UnilateralArrays, ws: Workspace, k):
    """Rate of :func:`stop_gap` [rad/s or m/s]."""
    return unilateral.stop[k, SIDE] * ws.joints[unilateral.stop_table[k, STOP_JOINT], ka.QD]


@internal_kernel
def note_stop_forces(unilateral: UnilateralArrays, ws: Workspace):
    """Forces of the joint stops from their rows; none where they are open."""
    table = unilateral.stop_table
    for k in range(table.shape[0]):
        closed = table[k, STOP_CLOSED] == 1
        unilateral.stop[k, STOP_FORCE] = ws.rows[table[k, STOP_ROW], ka.FORCE] if closed else 0.0


@internal_kernel
def dry_bound(unilateral: UnilateralArrays, k):
    """Dry friction of the k-th joint with dry friction, gear and bearing together [N m or N]."""
    return unilateral.dry[k, OF_GEAR] + unilateral.dry[k, OF_JOINT]


@internal_kernel
def holding_bound(unilateral: UnilateralArrays, k):
    """Dry friction that may hold the k-th joint with dry friction; a little less while modes are chosen [N m or N]."""
    return unilateral.number[HOLDING] * dry_bound(unilateral, k)


@internal_kernel
def rows_of_couplings(unilateral: UnilateralArrays, ws: Workspace):
    """Number of rows of couplings: the first in the table, before those of held joints and of closed stops."""
    rows = ws.counts[ka.COUPLED] - dry_rows_held(unilateral)
    for k in range(unilateral.stop_table.shape[0]):
        rows -= unilateral.stop_table[k, STOP_CLOSED]
    return rows


@internal_kernel
def dry_rows_held(unilateral: UnilateralArrays):
    """Rows of joints that dry friction holds."""
    rows = 0
    for k in range(unilateral.dry_table.shape[0]):
        rows += unilateral.dry_table[k, DRY_HOLDS]
    return rows


@internal_kernel
def dry_rests(unilateral: UnilateralArrays, k):
    """True for a joint that dry friction keeps at rest, by a row or, where contacts hold it, by a constant force."""
    return unilateral.dry_table[k, DRY_HOLDS] == 1 or abs(unilateral.dry[k, DRY_SIDE]) < 1.0


@internal_kernel
def rub(unilateral: UnilateralArrays | None, ws: Workspace):
    """Add the dry friction of the joints without a row to the applied forces; it is constant within a step."""
    if unilateral is None:  # resolved at compile time
        return
    for k in range(unilateral.dry.shape[0]):
        if unilateral.dry_table[k, DRY_HOLDS] == 0:
            force = unilateral.dry[k, DRY_SIDE] * dry_bound(unilateral, k)
            ws.joints[unilateral.dry_table[k, DRY_JOINT], ka.APPLIED] -= force


@internal_kernel
def note_dry_forces(unilateral: UnilateralArrays, ws: Workspace):
    """Note the dry friction of all joints that have it, and the drag of gears on their shafts."""
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
    """Coefficient of friction of candidate k that slides at this speed; law: (c, CONTACT_LAW_SIZE)."""
    mu = law[k, ka.MU]
    if law[k, ka.STRIBECK] > 0.0:
        ratio = speed / law[k, ka.STRIBECK]
        mu += (law[k, ka.STATIC] - mu) * math.exp(-ratio * ratio)
    return mu + law[k, ka.VISCOUS] * speed
