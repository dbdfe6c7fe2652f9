"""Tables of the right-hand side: columns, constants and arrays of model, drives, contacts and workspace, in SI units.

The dimensions are n links (one rate each), na drives (motors), c contact points and p constraint rows. A link is one
row of a joint and the body that it carries; parents come before their children. W is the world frame and B the frame of
a body. Spatial vectors are (angular, linear) in W about the world origin, so the inertias and wrenches of different
bodies can simply be added.

A table is one array whose columns are named by the constants below. There are only a few arrays, because each one costs
time in every compiled call, and because the columns of one link are then adjacent in memory.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# Joint kinds. The three axis-aligned revolute joints are special cases of REVOLUTE, for speed.
REVOLUTE_X, REVOLUTE_Y, REVOLUTE_Z, REVOLUTE, PRISMATIC = 0, 1, 2, 3, 4
# Rows of joints with several velocities or a special motion, see dynsim.dynamics.tree.joints.
BALL_X, BALL_Y, BALL_Z, ROLL, TURN, LEFT_WHEEL, RIGHT_WHEEL = 5, 6, 7, 8, 9, 10, 11
# Friction of a contact under a negative (pulling) normal force, see dynsim.dynamics.contact.rows.
FRICTION_SIGNED, FRICTION_DISSIPATIVE = 0, 1
# Mode of a candidate: off its surface (no row), sliding (one row, whose force includes friction), or held at its anchor
# (three rows). The mode is constant within a step.
OPEN, SLIDING, STICKING = 0, 1, 2
MOST_ROWS = 3  # maximum number of rows of a candidate

# ModelArrays.tree, int
PARENT = 0  # index of the parent link, -1 for the world
KIND = 1  # joint kind
TURNED = 2  # 0 if R_PJ is the identity, so that a matrix product can be skipped
BRANCHES = 3  # number of children other than link i + 1
POSITION_INDEX = 4  # start of the row's coordinates in the block of positions
BASE = 5  # link on which the row's joint is mounted: the parent of the joint's first row, -1 for the world
TREE_SIZE = 6
# ModelArrays.body
R_PJ = 0  # 9: rotation of the joint frame at q = 0 in the parent's frame, row-major
P_PJ = 9  # 3: origin of the joint frame in the parent's frame [m]
AXIS = 12  # 3: joint axis in the body's frame, unit length
MASS = 15  # [kg]
COM = 16  # 3: centre of mass in B [m]
INERTIA = 19  # 6: about the centre of mass, in B, xx xy xz yy yz zz [kg m^2]
ARMATURE = 25  # reflected motor inertia J_m, or BRAKED if a brake is closed [kg m^2 or kg]
DAMPING = 26  # viscous joint loss D [N m s/rad or N s/m]
GEAR_DAMPING = 27  # viscous gear loss D_m, reflected [N m s/rad or N s/m]
PARAMETER = 28  # additional parameter of some kinds of joints, such as the lead of a screw
BODY_SIZE = 29
# Inertia so large that loads do not change the joint's position even by rounding, and that a contact point carried only
# by braked joints does not move.
BRAKED = 1e30
# Drive kinds, see dynsim.dynamics.drive.
DC_MOTOR, POSITION_SERVO, OPEN_TORQUE = 0, 1, 2
# DriveArrays.table, int
DRIVEN = 0  # index of the link whose joint the drive moves
DRIVE_KIND = 1
CIRCUIT = 2  # index of the drive's current among the currents of the state, -1 without a circuit
SAMPLED = 3  # CONTINUOUS: the command follows the state; AT_TICKS: sampled and held; GIVEN: set by the caller and held
SERVO_MODE = 4  # POSITION_MODE, VELOCITY_MODE or OFF; may be written between steps
CURRENT_LIMITED = 5  # 1: DC motor whose driver limits the current to I_MAX
DRIVE_SIZE = 6
CONTINUOUS, AT_TICKS, GIVEN = 0, 1, 2
# DriveArrays.motor
K_M = 0  # K k [N m/A = V s/rad]
RESISTANCE = 1  # [ohm]
INDUCTANCE = 2  # [H]
J_M = 3  # I_m k^2 [kg m^2]
D_M = 4  # d_m k^2 [N m s/rad]
K_P = 5  # [V/rad]
K_D = 6  # [V s/rad]
U_MAX = 7  # voltage limit [V], inf if none
I_MAX = 8  # current limit of a servo or DC motor [A], torque limit of an open torque [N m]; inf if none
K_V = 9  # gain of a servo's velocity loop [V s/rad]
COULOMB = 10  # Coulomb friction in a servo's gear [N m]
COULOMB_SPEED = 11  # speed below which the Coulomb friction fades [rad/s]
FREE_DRAG = 12  # viscous drag of a servo's gear while it is off [N m s/rad]
MOTOR_SIZE = 16  # padded to whole cache lines
# DriveArrays.input
COMMAND = 0  # command of a sampled drive between ticks [V; N m for an open torque]
LINE_START = 1  # rewritten reference: its value [rad; N m for an open torque]
LINE_RATE = 2  # [rad/s; N m/s]
LINE_SINCE = 3  # time at which the reference has the value LINE_START [s]
INPUT_SIZE = 4
# Modes of a servo
POSITION_MODE, VELOCITY_MODE, OFF = 0, 1, 2
# Values of ReferenceArrays.spline in place of a row of coefficients: held, or the line in DriveArrays.input
HELD_POSITION, REWRITTEN = -1, -2
# Linear block of a drive, see dynsim.dynamics.drive.law.drive_block
TORQUE_Q, TORQUE_V, TORQUE_I, RATE_Q, RATE_V, RATE_I = 0, 1, 2, 3, 4, 5
BLOCK_SIZE = 6
# ContactArrays.link, int
LINK = 0
FRICTION_LAW = 1
CURVED = 2  # 0 for a plane: Q = 0, and then b is its unit normal
LEFT_OUT = 3  # 1: no joint moves the point along the normal in any posture, so that it never has an active row
CARRIER = 4  # link on which the surface is fixed, or -1 for the world
CONTACT_LINK_SIZE = 5
# ContactArrays.point
POINT = 0  # 3: in the body's frame [m]
QUADRIC = 3  # 10: C(r) = r.Q r/2 + b.r + c: Q xx xy xz yy yz zz, b, c
POINT_SIZE = 13
# ContactArrays.law: friction and impacts; the bilateral law reads MU and V_S only
MU = 0  # kinetic coefficient μ
V_S = 1  # smoothing speed of the slip direction [m/s]
STATIC = 2  # static coefficient μ_s ≥ μ
STRIBECK = 3  # speed v_s [m/s] of μ + (μ_s − μ) exp(−(s/v_s)²); 0: μ as soon as it slips
VISCOUS = 4  # viscous friction c [s/m], which adds c s to the coefficient
RESTITUTION = 5
GRIP = 6  # time stepping: ratio of friction along GRIP_AXIS to friction across it; 1: isotropic
GRIP_AXIS = 7  # 3: in the body's frame; zero for isotropic friction
CONTACT_STIFFNESS = 10  # time stepping: combined stiffness of surface and body along the normal [N/m]; 0: rigid
CONTACT_DAMPING = 11  # [N s/m]
FLOOR = 12  # bilateral law: no force if the mobility along the normal is at most this [1/kg]
CONTACT_LAW_SIZE = 13
# CouplingArrays.joint, int
FOLLOWER = 0  # link whose joint follows
LEADER = 1
COUPLING_JOINT_SIZE = 2
# CouplingArrays.law
RATIO = 0  # [1, m/rad or similar]
OFFSET = 1  # [rad or m]
COUPLING_SIZE = 2

# Workspace.links
R = 0  # 9: R_WB, row-major
P = 9  # 3: p_WB [m]
S = 12  # 6: joint axis as a motion vector at the world origin
V = 18  # 6: spatial velocity
A = 24  # 6: spatial acceleration minus gravity
F = 30  # 6: wrench transmitted by the joint; scratch of the solves
U_OVER_D = 36  # 6: IA S / D, D = S.IA S + J_m
INVERSE_D = 42  # 1 / D
IA = 43  # 21: articulated inertia passed down by branches: angular block 6, coupling 9 row-major, linear block 6
LINK_SIZE = 64
# Workspace.joints
Q = 0  # [rad or m]
QD = 1  # v [rad/s or m/s]
QDD = 2  # vdot
BIAS = 3  # h + g, or the result of newton_euler
APPLIED = 4  # applied generalised force
EXTRA = 5  # second coordinate of a row that has two
JOINT_SIZE = 6
# Workspace.motors
CURRENT = 0  # [A]
VOLTAGE = 1  # [V]
Q_REF = 2  # [rad; N m for an open torque]
V_REF = 3  # [rad/s]
DIDT = 4  # [A/s]
DRAG = 5  # gear friction that is not part of GEAR_DAMPING, opposing v [N m]
DRY_DRAG = 6  # drag of a gear with dry friction: positive against v > 0 [N m or N]
MOTOR_STATE_SIZE = 7
# Workspace.contacts: geometry and forces of each candidate, with or without rows
NORMAL = 0  # 3: surface normal in W
TANGENT = 3  # 3: smoothed slip direction in W
POSITION = 6  # 3: in W [m]
SLIP_VELOCITY = 9  # 3: tangential velocity [m/s]
GAP = 12  # signed distance from the surface [m]
GAP_RATE = 13  # [m/s]
NORMAL_FORCE = 14  # f_n [N], zero without rows
FORCE_VECTOR = 15  # 3: normal and friction force in W [N]
ANCHOR = 18  # 3: point at which a sticking point is held, in the frame of its surface [m]
FIRST_TANGENT = 21  # 3: directions of a sticking point's tangential rows in W
SECOND_TANGENT = 24  # 3
CONTACT_STATE_SIZE = 27
# Workspace.rows: one scalar constraint each, and its force
ROW = 0  # 6: the constraint's motion is ROW . (V_A - V_B); for a joint row the coefficients of its two joints
DIRECTION = 6  # 6: wrench of a unit force on A, its negative on B; for a joint row as ROW
TARGET = 12  # J vdot must equal this [m/s^2]
RHS = 13  # right-hand side of the small system
FORCE = 14  # [N]
SIGN = 15  # sign of the force for which DIRECTION was computed
ROW_MU = 16  # friction coefficient included in DIRECTION
ROW_GAP = 17  # position error that projection removes [m or rad], see dynsim.dynamics.contact.rows
ROW_RATE = 18  # rate error that projection removes [m/s or rad/s]
ROW_OFFSET = 19  # joint row: required sum of its two joints times its coefficients [rad or m]
ROW_FLOOR = 20  # the row has no force if its mobility is at most this
ROW_STATE_SIZE = 21
# Workspace.active, int: for each row
ROW_KIND = 0
OWNER = 1  # candidate, tie, coupling or, numbered after the couplings, joint stop, then dry friction of a joint
BODY_A = 2  # link, or the following joint of a joint row
BODY_B = 3  # link at the other end, -1 for the world; the leading joint of a joint row
LAW = 4  # FRICTION_SIGNED unless DIRECTION depends on the sign of the force
# Columns of the same array for each candidate
MODE = 5  # OPEN, SLIDING or STICKING
FIRST_ROW = 6
ACTIVE_SIZE = 7
# Kinds of rows: point that slides on its surface, point that sticks to it, row between two bodies, or two joints.
SLIDING_ROW, STICKING_ROW, BODY_ROW, JOINT_ROW = 0, 1, 2, 3
# Workspace.counts, int
ROWS = 0  # active rows p
DEPENDENT = 1  # right-hand sides whose constraint forces were not unique
CONTRADICTORY = 2  # right-hand sides for which no signs of the forces agreed with friction
COUPLED = 3  # number of joint rows, the first active rows
STUCK = 4  # number of sticking candidates
COUNTS_SIZE = 5


class ModelArrays(NamedTuple):
    """Tables of the tree of bodies."""

    tree: np.ndarray  # (n, TREE_SIZE) int
    body: np.ndarray  # (n, BODY_SIZE)
    gravity: np.ndarray  # (3,) in W [m/s^2]


class DriveArrays(NamedTuple):
    """Tables of the drives of the joints; ``input`` may be written between steps."""

    table: np.ndarray  # (na, DRIVE_SIZE) int
    motor: np.ndarray  # (na, MOTOR_SIZE)
    input: np.ndarray  # (na, INPUT_SIZE)


class ReferenceArrays(NamedTuple):
    """Joint references q_d(t): held angles, and quintic splines on one uniform grid for moving joints."""

    spline: np.ndarray  # (na,) int: row of coefficients, HELD_POSITION or REWRITTEN
    held: np.ndarray  # (na,) constant angle of a held joint
    grid: np.ndarray  # (2,) time of the first knot, knot distance [s]
    coefficients: np.ndarray  # (segments, splines, 6) ascending powers of t - t_knot
    # (segments, na, 6) added to the commands of DC motors [V]; no segments: no addition
    voltage: np.ndarray = np.zeros((0, 0, 6))


class ContactArrays(NamedTuple):
    """Contact candidates: points on bodies, each with its surface, the quadric C(r) = r.Q r / 2 + b.r + c."""

    link: np.ndarray  # (c, CONTACT_LINK_SIZE) int
    point: np.ndarray  # (c, POINT_SIZE)
    law: np.ndarray  # (c, CONTACT_LAW_SIZE)


class CouplingArrays(NamedTuple):
    """Joints that follow other joints, q_follower = ratio q_leader + offset."""

    joint: np.ndarray  # (couplings, COUPLING_JOINT_SIZE) int
    law: np.ndarray  # (couplings, COUPLING_SIZE)


class Workspace(NamedTuple):
    """Intermediate results of the right-hand side, allocated once; p is the largest possible number of rows."""

    links: np.ndarray  # (n, LINK_SIZE)
    joints: np.ndarray  # (n, JOINT_SIZE)
    trig: np.ndarray  # (3, n or more) sine, cosine and q; padded to a multiple of four to avoid a slow remainder loop
    motors: np.ndarray  # (na, MOTOR_STATE_SIZE)
    contacts: np.ndarray  # (c, CONTACT_STATE_SIZE)
    rows: np.ndarray  # (p, ROW_STATE_SIZE); the active rows come first: couplings, then contacts
    active: np.ndarray  # (p, ACTIVE_SIZE) int
    column: np.ndarray  # (n, 1 + 2p) eliminated right-hand sides: applied force, then each row and its direction
    small: np.ndarray  # (4, p, p) matrix J M^-1 F of the active rows, and scratch for its solution
    counts: np.ndarray  # (COUNTS_SIZE,) int


def row_limit(c: int, couplings: int) -> int:
    """Return the largest number of rows that c candidates and ``couplings`` couplings can have."""
    return MOST_ROWS * c + couplings


def workspace(n: int, na: int, c: int, couplings: int = 0) -> Workspace:
    """Allocate a :class:`Workspace` without active rows for n links, na motors, c candidates and some couplings."""
    p = row_limit(c, couplings)
    return Workspace(
        links=np.zeros((n, LINK_SIZE)),
        joints=np.zeros((n, JOINT_SIZE)),
        trig=np.zeros((3, 4 * -(-n // 4))),
        motors=np.zeros((na, MOTOR_STATE_SIZE)),
        contacts=np.zeros((c, CONTACT_STATE_SIZE)),
        rows=np.zeros((p, ROW_STATE_SIZE)),
        active=np.zeros((p, ACTIVE_SIZE), dtype=np.int64),
        column=np.zeros((n, 1 + 2 * p)),
        small=np.zeros((4, p, p)),
        counts=np.zeros(COUNTS_SIZE, dtype=np.int64),
    )
