"""What the kernels read and write: a few flat tables per concept, in SI units and the world frame W.

n links (one velocity each), na drives (motors), c contact points. A link is one joint and the body it carries; links
are ordered so that a parent comes before its children. Spatial vectors are (angular, linear) at the world origin, so
inertias and forces of different bodies simply add.

A table is one array whose columns are named by the constants below. Few arrays matter: every array of an argument
costs copying in each compiled call, and what belongs to one link lies together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# Joint kinds. The three axis-aligned revolute joints are special cases of REVOLUTE, for speed.
REVOLUTE_X, REVOLUTE_Y, REVOLUTE_Z, REVOLUTE, PRISMATIC = 0, 1, 2, 3, 4
# Rows of joints with several velocities, or with a motion of their own: dynsim.kernels.tree.joints.
BALL_X, BALL_Y, BALL_Z, ROLL, TURN = 5, 6, 7, 8, 9
# Friction of a contact under a negative (pulling) normal force, see dynsim.kernels.constraint.surface.
FRICTION_SIGNED, FRICTION_DISSIPATIVE = 0, 1

# ModelArrays.tree, int
PARENT = 0  # index of the parent link, -1 for the world
KIND = 1  # joint kind
TURNED = 2  # 0 when R_PJ is the identity, so that one product can be skipped
BRANCHES = 3  # number of children other than link i + 1
POSITION_INDEX = 4  # where the row's coordinates begin in the block of positions
BASE = 5  # index of the link that the row's joint is mounted on: that of its first row's parent, -1 for the world
TREE_SIZE = 6
# ModelArrays.body
R_PJ = 0  # 9: rotation of the joint frame at q = 0 in the parent's frame, row-major
P_PJ = 9  # 3: origin of the joint frame in the parent's frame [m]
AXIS = 12  # 3: joint axis in the body's frame, unit length
MASS = 15  # [kg]
COM = 16  # 3: centre of mass in B [m]
INERTIA = 19  # 6: about the centre of mass, in B, xx xy xz yy yz zz [kg m^2]
ARMATURE = 25  # reflected motor inertia J_m [kg m^2 or kg]
DAMPING = 26  # viscous joint loss D [N m s/rad or N s/m]
GEAR_DAMPING = 27  # viscous gear loss D_m, reflected [N m s/rad or N s/m]
PARAMETER = 28  # what else a kind of joint needs, such as the lead of a screw
BODY_SIZE = 29
# Drive kinds, see dynsim.kernels.drive.
DC_MOTOR, POSITION_SERVO, OPEN_TORQUE = 0, 1, 2
# DriveArrays.table, int
DRIVEN = 0  # index of the link whose joint the drive moves
DRIVE_KIND = 1
CIRCUIT = 2  # index of its current among those of the state, -1 for none
SAMPLED = 3  # 1: the command is HELD between ticks; 0: it follows the state continuously
DRIVE_SIZE = 4
# DriveArrays.motor
K_M = 0  # K k [N m/A = V s/rad]
RESISTANCE = 1  # [ohm]
INDUCTANCE = 2  # [H]
J_M = 3  # I_m k^2 [kg m^2]
D_M = 4  # d_m k^2 [N m s/rad]
K_P = 5  # [V/rad]
K_D = 6  # [V s/rad]
U_MAX = 7  # voltage limit [V], inf for none
I_MAX = 8  # current limit of a servo [A], torque limit of an open torque [N m]; inf for none
K_V = 9  # gain of a servo's velocity loop [V s/rad]
COULOMB = 10  # gear friction of a servo at speed [N m]
COULOMB_SPEED = 11  # below which it fades [rad/s]
FREE_DRAG = 12  # viscous drag of a servo's gear while it is off [N m s/rad]
MOTOR_SIZE = 16  # whole cache lines
# DriveArrays.input
HELD = 0  # command of a sampled drive between ticks [V; N m for an open torque]
LINE_START = 1  # a rewritten reference: its value [rad; N m for an open torque]
LINE_RATE = 2  # [rad/s; N m/s]
LINE_SINCE = 3  # time at which it has that value [s]
MODE = 4  # of a servo
INPUT_SIZE = 5
# Modes of a servo
POSITION_MODE, VELOCITY_MODE, OFF = 0, 1, 2
# ReferenceArrays.spline, instead of a row of coefficients: held, and the line of DriveArrays.input
HELD_POSITION, REWRITTEN = -1, -2
# Linear block of a drive, see dynsim.kernels.drive.law.drive_block
TORQUE_Q, TORQUE_V, TORQUE_I, RATE_Q, RATE_V, RATE_I = 0, 1, 2, 3, 4, 5
BLOCK_SIZE = 6
# ContactArrays.link, int
LINK = 0
FRICTION_LAW = 1
CURVED = 2  # 0 for a plane: Q = 0, and then b is its unit normal
CONTACT_LINK_SIZE = 3
# ContactArrays.point
POINT = 0  # 3: in the body's frame [m]
QUADRIC = 3  # 10: C(r) = r.Q r/2 + b.r + c: Q xx xy xz yy yz zz, b, c
MU = 13  # kinetic friction coefficient
V_S = 14  # smoothing speed of the slip direction [m/s]
POINT_SIZE = 15

# Workspace.links
R = 0  # 9: R_WB, row-major
P = 9  # 3: p_WB [m]
S = 12  # 6: joint axis as a motion vector at the world origin
V = 18  # 6: spatial velocity
A = 24  # 6: spatial acceleration minus gravity
F = 30  # 6: wrench through the joint; scratch of the solves
U_OVER_D = 36  # 6: IA S / D, D = S.IA S + J_m
INVERSE_D = 42  # 1 / D
IA = 43  # 21: articulated inertia handed down by branches: angular block 6, coupling 9 row-major, linear block 6
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
DRAG = 5  # gear friction that is not part of GEAR_DAMPING, against v [N m]
MOTOR_STATE_SIZE = 6
# Workspace.contacts
ROW = 0  # 6: the constraint's motion is ROW . V
DIRECTION = 6  # 6: wrench of a unit constraint force
TARGET = 12  # J vdot must equal this [m/s^2]
RHS = 13  # right-hand side of the small system
FORCE = 14  # normal force f_n [N]
SIGN = 15  # sign of the normal force that DIRECTION was built for
NORMAL = 16  # 3: surface normal in W
TANGENT = 19  # 3: smoothed slip direction in W
POSITION = 22  # 3: in W [m]
SLIP_VELOCITY = 25  # 3: tangential velocity [m/s]
GAP = 28  # signed distance from the surface [m]
GAP_RATE = 29  # [m/s]
CONTACT_STATE_SIZE = 30


class ModelArrays(NamedTuple):
    """The tree of bodies."""

    tree: np.ndarray  # (n, TREE_SIZE) int
    body: np.ndarray  # (n, BODY_SIZE)
    gravity: np.ndarray  # (3,) in W [m/s^2]


class DriveArrays(NamedTuple):
    """What drives the joints, each of one kind, with the law of its command. ``input`` may be written between steps."""

    table: np.ndarray  # (na, DRIVE_SIZE) int
    motor: np.ndarray  # (na, MOTOR_SIZE)
    input: np.ndarray  # (na, INPUT_SIZE)


class ReferenceArrays(NamedTuple):
    """Joint references q_d(t): held angles, and quintic splines on one uniform grid for the moving ones."""

    spline: np.ndarray  # (na,) int: row of coefficients, HELD_POSITION or REWRITTEN
    held: np.ndarray  # (na,) constant angle of a held joint
    grid: np.ndarray  # (2,) time of the first knot, knot distance [s]
    coefficients: np.ndarray  # (segments, splines, 6) ascending powers of t - t_knot


class ContactArrays(NamedTuple):
    """Points on bodies held to surfaces. A surface is a quadric C(r) = r.Q r / 2 + b.r + c."""

    link: np.ndarray  # (c, CONTACT_LINK_SIZE) int
    point: np.ndarray  # (c, POINT_SIZE)


class Workspace(NamedTuple):
    """Everything a right-hand side computes on its way; allocated once."""

    links: np.ndarray  # (n, LINK_SIZE)
    joints: np.ndarray  # (n, JOINT_SIZE)
    trig: np.ndarray  # (3, n or more) sine, cosine and q; padded to whole vectors of four, which have no slow remainder
    motors: np.ndarray  # (na, MOTOR_STATE_SIZE)
    contacts: np.ndarray  # (c, CONTACT_STATE_SIZE)
    column: np.ndarray  # (n, 1 + 2c) eliminated right-hand sides: applied force, then per contact its row and direction
    small: np.ndarray  # (4, c, c) the p×p system J M^-1 F and the scratch of its solve
    deficient: np.ndarray  # (2,) int: right-hand sides whose constraint forces were not unique, and that had none


def workspace(n: int, na: int, c: int) -> Workspace:
    """Allocate a :class:`Workspace` for n links, na motors and c contacts."""
    contacts = np.zeros((c, CONTACT_STATE_SIZE))
    contacts[:, SIGN] = 1.0
    return Workspace(
        links=np.zeros((n, LINK_SIZE)),
        joints=np.zeros((n, JOINT_SIZE)),
        trig=np.zeros((3, 4 * -(-n // 4))),
        motors=np.zeros((na, MOTOR_STATE_SIZE)),
        contacts=contacts,
        column=np.zeros((n, 1 + 2 * c)),
        small=np.zeros((4, c, c)),
        deficient=np.zeros(2, dtype=np.int64),
    )
