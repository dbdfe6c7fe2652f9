"""Kernel tables for bodies, drives, contacts, contact laws, loads, couplings and a base; checks of descriptions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.cone import steps as kc
from dynsim.dynamics.contact.cone.program import split_size
from dynsim.dynamics.contact.unilateral import UnilateralArrays, kept_size, share_count
from dynsim.dynamics.derivative import System
from dynsim.dynamics.tree import loads as kl
from dynsim.dynamics.tree import support as ks
from dynsim.dynamics.tree.loads import LoadArrays
from dynsim.errors import ModelError, brief, first_few
from dynsim.jit.kernel import integers, reals
from dynsim.model.description import WORLD, Contact, Coupling, Link, Load, Quadric, Robot, Tie
from dynsim.model.drives import Drive, Motor, Servo, TorqueSource, servo_row
from dynsim.model.surfaces import shape_arrays

# Tables of the unilateral law: law of each contact, joint stops, dry friction, ties.


# A joint may start this far beyond its stop [rad or m].
START_TOLERANCE = 1e-6
# A point that separates more slowly than this after an impact stays closed, which ends a series of ever smaller bounces
# [m/s]. The value exceeds 6e-5 m/s, the speed gained by falling through the depth at which a point counts as landed.
# With a lower value, two points of a rocking body would land alternately and indefinitely.
SETTLE_SPEED = 1e-4


@dataclass(frozen=True)
class JointStop:
    """A joint stop: side 1 keeps q ≥ position, and side −1 keeps q ≤ position [rad or m]."""

    joint: str
    side: float
    position: float


@dataclass(frozen=True)
class DryFriction:
    """Dry friction in the gear and bearing of a joint [N m or N], which can hold the joint at rest."""

    joint: str
    gear: float
    bearing: float


def dry_frictions(robot: Robot) -> list[DryFriction]:
    """Return the joints of a robot with dry friction that is not smoothed."""
    gears = {motor.joint: motor.dry_friction for motor in robot.motors if not isinstance(motor, TorqueSource)}
    frictions = [DryFriction(link.joint, gears.get(link.joint, 0.0), link.friction) for link in robot.links]
    return [friction for friction in frictions if friction.gear + friction.bearing > 0.0]


def format_quantity(value: float, unit: str, digits: int = 5) -> str:
    """Return a joint coordinate as text; angles in degrees, as in scenarios, and in radians."""
    if unit != "rad":
        return f"{value:.{digits}g} {unit}"
    return f"{np.degrees(value):.{digits}g}° ({value:.{min(digits, 4)}g} rad)"


def compile_unilateral(
    robot: Robot,
    contacts: Sequence[Contact],
    stops: Sequence[JointStop],
    slow: float,
    creep: float,
    dry: Sequence[DryFriction] = (),
    stepped: bool = False,
) -> UnilateralArrays:
    """Return the tables of the unilateral law.

    Parameters
    ----------
    robot : Robot
        Description of the robot.
    contacts : sequence of Contact
        Contact candidates.
    stops : sequence of JointStop
        Joint stops.
    slow : float
        Speed below which slip has no defined direction [m/s].
    creep : float
        Rate below which a joint with dry friction may be at rest [rad/s or m/s].
    dry : sequence of DryFriction, optional
        Joints with dry friction.
    stepped : bool, optional
        True for time stepping, which has scratch of its own: the result has no ``room``.
    """
    c, s, ties = len(contacts), len(stops), robot.ties
    shares = share_count(len(robot.couplings), c, s, len(dry))
    p = ka.row_limit(c, len(robot.couplings) + s + len(dry) + len(ties))
    stop_table, stop = np.zeros((s, ku.STOP_TABLE_SIZE), dtype=np.int64), np.zeros((s, ku.STOP_SIZE))
    for k, limit in enumerate(stops):
        stop_table[k, ku.STOP_JOINT] = robot.joint_names.index(limit.joint)
        stop[k, ku.SIDE], stop[k, ku.LIMIT] = limit.side, limit.side * limit.position
    dry_table, frictions = np.zeros((len(dry), ku.DRY_TABLE_SIZE), dtype=np.int64), np.zeros((len(dry), ku.DRY_SIZE))
    driven = [motor.joint for motor in robot.motors]
    for k, friction in enumerate(dry):
        dry_table[k, ku.DRY_JOINT] = robot.joint_names.index(friction.joint)
        dry_table[k, ku.DRY_DRIVE] = driven.index(friction.joint) if friction.gear > 0.0 else -1
        dry_table[k, ku.DRY_HOLDS], dry_table[k, ku.DRY_TOLD] = 1, -1
        frictions[k, [ku.OF_GEAR, ku.OF_JOINT]] = friction.gear, friction.bearing
    tie_table, tie = np.zeros((len(ties), ku.TIE_TABLE_SIZE), dtype=np.int64), np.zeros((len(ties), ku.TIE_SIZE))
    for joined, ints, floats in zip(ties, tie_table, tie, strict=True):
        _compile_tie(robot, joined, ints, floats)
    slide = np.zeros((c, ku.SLIDE_SIZE))
    slide[:, ku.LANDS_AT] = ku.DEPTH
    stop[:, ku.HIT_AT] = ku.DEPTH
    stop[:, ku.STOP_SETTLE], stop[:, ku.STOP_WINDOW_START] = SETTLE_SPEED, -np.inf
    tally, number = np.zeros((c, ku.TALLY_SIZE)), np.zeros(ku.NUMBERS)
    tally[:, ku.SETTLE], tally[:, ku.WINDOW_START], number[ku.LAST_CHANGE] = SETTLE_SPEED, -np.inf, -np.inf
    number[ku.SLOW], number[ku.CREEP], number[ku.HOLDING] = slow, creep, 1.0
    return UnilateralArrays(
        slide=reals(slide),
        mode=integers(np.zeros((c, ku.MODE_SIZE))),
        tally=reals(tally),
        stop_table=integers(stop_table),
        stop=reals(stop),
        dry_table=integers(dry_table),
        dry=reals(frictions),
        tie_table=integers(tie_table),
        tie=reals(tie),
        index=integers(np.zeros((ku.INDICES, max(p, c + len(dry) + s + 2)))),
        vector=reals(np.zeros((ku.VECTORS, p))),
        room=np.zeros((ku.ROOM, *(0 if stepped else p,) * 2)),
        split_room=np.zeros(split_size(3 * c + len(dry) + s, c + len(dry) + s)),
        number=reals(number),
        shares=reals(np.zeros(shares)),
        kept=reals(np.zeros(kept_size(shares, c, s, len(dry)))),
    )


def _compile_tie(robot: Robot, tie: Tie, table: NDArray[np.int64], row: NDArray[np.float64]) -> None:
    """Fill the table rows of a tie."""
    where = f"tie {tie.name}"
    if not (tie.stiffness >= 0.0 and tie.damping >= 0.0 and tie.stiffness + tie.damping > 0.0 and tie.bound > 0.0):
        raise ModelError(f"{where}: stiffness or damping and the bound must be positive, and none may be negative")
    a, point = robot.attach(tie.body, tie.point)
    b, other = (-1, tie.other_point) if tie.other == WORLD else robot.attach(tie.other, tie.other_point)
    if a == b:
        raise ModelError(f"{where}: both ends are on {robot.links[a].name}")
    length = float(np.linalg.norm(tie.axis))
    if not length > 0.0:
        raise ModelError(f"{where}: its axis must not be the zero vector")
    kind = kc.ONE_WAY if tie.pushes else kc.BOX
    table[[ku.TIE_A, ku.TIE_B, ku.TIE_TURNS, ku.TIE_KIND]] = a, b, tie.turns, kind if tie.holds else -1
    row[[ku.TIE_STIFFNESS, ku.TIE_DAMPING, ku.TIE_BOUND, ku.TIE_REST]] = tie.stiffness, tie.damping, tie.bound, tie.rest
    row[ku.TIE_AXIS : ku.TIE_AXIS + 3] = robot.attached_axes(tie.body) @ np.asarray(tie.axis) / length
    row[ku.TIE_POINT : ku.TIE_POINT + 3], row[ku.TIE_OTHER_POINT : ku.TIE_OTHER_POINT + 3] = point, other
    row[ku.TIE_ATTITUDE : ku.TIE_ATTITUDE + 9] = tie.attitude.ravel()


def contact_laws(robot: Robot, contacts: Sequence[Contact]) -> NDArray[np.float64]:
    """Return the law of each contact, (c, CONTACT_LAW_SIZE), see dynsim.dynamics.tables.

    Raises
    ------
    ModelError
        If static friction is below kinetic friction, a value is negative, or restitution is above one.
    """
    law = np.ones((len(contacts), ka.CONTACT_LAW_SIZE))
    # Isotropic friction must not have an axis. With an axis, the tangents would rotate with the body and would rotate
    # the rates of a step, including rates that friction has stopped.
    law[:, [ka.FLOOR, ka.GRIP_AXIS, ka.GRIP_AXIS + 1, ka.GRIP_AXIS + 2]] = 0.0
    for row, contact in zip(law, contacts, strict=True):
        where = f"contact {contact.name}"
        if not contact.friction >= 0.0:
            raise ModelError(f"{where}: friction {contact.friction} must be zero or positive")
        if not contact.slip_smoothing > 0.0:
            raise ModelError(f"{where}: slip smoothing {contact.slip_smoothing} m/s must be positive")
        if not contact.friction_at_rest >= contact.friction:
            raise ModelError(
                f"{where}: static friction {contact.static_friction:g} must not be less than kinetic friction "
                f"{contact.friction:g}"
            )
        if not 0.0 <= contact.restitution <= 1.0:
            raise ModelError(f"{where}: restitution must be between 0 and 1, got {contact.restitution:g}")
        if not (contact.stribeck >= 0.0 and contact.viscous_friction >= 0.0):
            raise ModelError(f"{where}: Stribeck speed and viscous friction must not be negative")
        row[[ka.MU, ka.V_S, ka.STATIC]] = contact.friction, contact.slip_smoothing, contact.friction_at_rest
        row[[ka.STRIBECK, ka.VISCOUS]] = contact.stribeck, contact.viscous_friction
        row[ka.RESTITUTION] = contact.restitution
        stiffness, damping = contact.stiffness, contact.damping
        if not (stiffness >= 0.0 and damping >= 0.0) or (damping > 0.0 and stiffness == 0.0):
            raise ModelError(f"{where}: stiffness and damping must not be negative, and damping requires a stiffness")
        row[[ka.CONTACT_STIFFNESS, ka.CONTACT_DAMPING]] = stiffness, damping
        if contact.grip_axis is not None and contact.grip != 1.0:
            row[ka.GRIP] = contact.grip
            row[ka.GRIP_AXIS : ka.GRIP_AXIS + 3] = robot.attached_axes(contact.body) @ contact.grip_axis
    return law


def joint_stops(
    robot: Robot, q: NDArray[np.float64] | None = None, tolerance: float = START_TOLERANCE
) -> list[JointStop]:
    """Return the joint stops of a robot, one for each finite limit; the lower stop of a joint comes first.

    Only the unilateral law has stops. Under both laws no joint may start beyond a limit.

    Parameters
    ----------
    q : (nq,) ndarray
        Joint positions at the start [rad or m]; default: the robot's initial positions.
    tolerance : float
        A joint may start this far beyond its stop [rad or m].

    Raises
    ------
    ModelError
        If joints start beyond a limit; the message lists all of them.
    """
    stops, beyond, at = list[JointStop](), dict[str, Link](), robot.initial if q is None else q
    for link, k in zip(robot.links, robot.position_index, strict=True):
        for side, limit in ((1.0, link.lower), (-1.0, link.upper)):
            if np.isfinite(limit):
                if side * (limit - at[k]) > tolerance:
                    starts, bound = (format_quantity(value, link.units[0]) for value in (at[k], limit))
                    beyond[f"{link.joint}: starts at {starts}, beyond its limit of {bound}"] = link
                stops.append(JointStop(link.joint, side, float(limit)))
    if beyond:
        units = ["deg" if link.units[0] == "rad" else "m" for link in beyond.values()]
        keys = [f"{key}_{unit}" for key in ("initial", "limit") for unit in dict.fromkeys(units)]
        remedy = f"change {' or '.join(keys)}" if q is None else "start from a state within the limits"
        at_key = ("plant", f"initial_{units[0]}", next(iter(beyond.values())).joint)
        raise ModelError(f"{'; '.join(beyond)}; {remedy}", keys=at_key)
    return stops


# Maximum initial angle [rad]; for larger angles, the reduction to a quarter turn loses too many digits
# (dynsim.dynamics.tree.joints.sine_cosine).
ANGLE_LIMIT = 1e6
# Tolerance of the initial position of a follower with respect to its leader [rad or m].
COUPLING_TOLERANCE = 1e-6

_FRICTION = {"signed": ka.FRICTION_SIGNED, "dissipative": ka.FRICTION_DISSIPATIVE}


def compile_model(robot: Robot) -> ka.ModelArrays:
    """Return the tables of the tree of bodies.

    Raises
    ------
    ModelError
        If names are duplicated, a parent does not precede its child, an inertia is physically impossible, a joint
        cannot be accelerated, the hand is on an unknown body, a coupling is impossible or violated by the initial
        configuration, or a vector has the wrong shape or a value that is not finite.
    """
    links = robot.links
    if not links:
        raise ModelError(f"{robot.name}: a robot needs at least one link")
    _check_couplings(robot)
    _check_shapes(robot)
    initial, position, unturned = robot.initial, robot.position_index, np.eye(3)
    index: dict[str, int] = {}
    joints: dict[str, int] = {}
    tree = np.zeros((len(links), ka.TREE_SIZE), dtype=np.int64)
    body = np.zeros((len(links), ka.BODY_SIZE))
    for i, link in enumerate(links):
        if link.kind == "revolute" and abs(initial[position[i]]) > ANGLE_LIMIT:
            raise ModelError(
                f"{link.joint}: initial angle {initial[position[i]]:.3g} rad is too large (limit {ANGLE_LIMIT:g} rad); "
                "subtract whole turns"
            )
        if link.kind == "ball_x":
            length = float(np.linalg.norm(initial[position[i] : position[i] + 4]))
            if not abs(length - 1.0) < 1e-9:
                raise ModelError(f"{link.joint_of_rows}: the initial quaternion must have length 1, got {length:.6g}")
        if link.name in index or link.joint in joints:
            raise ModelError(f"{link.name}: the name of a body or joint occurs twice")
        if link.parent is not None and link.parent not in index:
            raise ModelError(f"{link.name}: parent {link.parent!r} must be a body defined before it")
        link.inertia.check(link.name)
        for loss in ("damping", "friction"):
            if not getattr(link, loss) >= 0.0:
                raise ModelError(f"{link.joint}: {loss} must be zero or positive, got {getattr(link, loss)}")
        norm = float(np.linalg.norm(link.axis))
        if not abs(norm - 1.0) < 1e-9:
            raise ModelError(f"{link.joint}: axis must be a unit vector, got {link.axis} with length {norm:.6g}")
        R_PJ = np.asarray(link.R_PJ)
        turned = not np.array_equal(R_PJ, unturned)
        if turned and (np.abs(R_PJ @ R_PJ.T - unturned).max() > 1e-9 or np.linalg.det(R_PJ) < 0.0):
            raise ModelError(f"{link.joint}: R_PJ is not a rotation")
        parent = -1 if link.parent is None else index[link.parent]
        index[link.name], joints[link.joint] = i, i
        tree[i, ka.PARENT] = parent
        tree[i, ka.KIND] = _joint_kind(link)
        tree[i, ka.POSITION_INDEX] = position[i]
        # Later rows of a joint are mounted on the same body as its first row.
        tree[i, ka.BASE] = parent if link.row.neutral else tree[parent, ka.BASE]
        tree[i, ka.TURNED] = int(turned)
        if parent >= 0 and parent != i - 1:
            tree[parent, ka.BRANCHES] += 1
        tensor = np.asarray(link.inertia.tensor)
        body[i, ka.R_PJ : ka.R_PJ + 9] = R_PJ.ravel()
        body[i, ka.P_PJ : ka.P_PJ + 3] = link.p_PJ
        body[i, ka.AXIS : ka.AXIS + 3] = link.axis
        body[i, ka.MASS] = link.inertia.mass
        body[i, ka.COM : ka.COM + 3] = link.inertia.com
        body[i, ka.INERTIA : ka.INERTIA + 6] = tensor[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        body[i, ka.DAMPING] = link.damping
        body[i, ka.PARAMETER] = link.parameter
        body[i, ka.ARMATURE] = link.armature
    names = set(index)
    for frame in robot.frames:
        if frame.name in names:
            raise ModelError(f"{frame.name}: the name of a body or frame occurs twice")
        if frame.body is not None and frame.body not in index:
            raise ModelError(f"frame {frame.name}: unknown body {frame.body!r}")
        names.add(frame.name)
    by_joint = {link.joint: link for link in links}
    for motor in robot.motors:
        _check_motor(motor, by_joint)
        i = joints[motor.joint]
        if len(links[i].row.neutral) != 1 and not links[i].row.own_position:
            raise ModelError(
                f"motor of {motor.joint}: this is one of several rates of a joint and has no position to control"
            )
        if not isinstance(motor, TorqueSource):
            body[i, ka.ARMATURE] += motor.armature
            body[i, ka.GEAR_DAMPING] += motor.reflected_damping
    _check_movable(robot, tree, body)
    check_couplings(robot, robot.initial)
    return ka.ModelArrays(
        tree=integers(tree),
        body=reals(body),
        gravity=reals(robot.gravity),
    )


def compile_drives(
    robot: Robot, *, k_p: Sequence[float], k_d: Sequence[float], sampled: bool = False, dry: bool = False
) -> ka.DriveArrays:
    """Return the tables of the motors.

    Parameters
    ----------
    robot : Robot
        Description of the robot.
    k_p, k_d : sequence of float
        Gains of the voltage PD controller, one per motor [V/rad, V s/rad]; only DC motors use them.
    sampled : bool, optional
        If True, commands are held between ticks, see :func:`dynsim.dynamics.drive.law.take_commands`.
    dry : bool, optional
        If True, gear friction that need not be smoothed has separate rows, see :func:`dry_frictions`.
    """
    joints = {link.joint: i for i, link in enumerate(robot.links)}
    table = np.zeros((len(robot.motors), ka.DRIVE_SIZE), dtype=np.int64)
    motor = np.zeros((len(robot.motors), ka.MOTOR_SIZE))
    inputs = np.zeros((len(robot.motors), ka.INPUT_SIZE))
    circuits, commanded = 0, ka.AT_TICKS if sampled else ka.CONTINUOUS
    for a, m in enumerate(robot.motors):
        table[a, [ka.DRIVEN, ka.CIRCUIT, ka.SAMPLED]] = joints[m.joint], -1, commanded
        if isinstance(m, Motor):
            table[a, ka.DRIVE_KIND], table[a, ka.CIRCUIT] = ka.DC_MOTOR, circuits
            table[a, ka.CURRENT_LIMITED] = np.isfinite(m.current_limit)
            circuits += 1
            motor[a] = _dc_motor(m, k_p[a], k_d[a])
        elif isinstance(m, Servo):
            table[a, ka.DRIVE_KIND] = ka.POSITION_SERVO
            table[a, ka.SERVO_MODE] = ka.VELOCITY_MODE if m.velocity_mode else ka.POSITION_MODE
            motor[a] = servo_row(m)
            if dry:
                motor[a, ka.COULOMB] -= m.dry_friction
        else:
            table[a, ka.DRIVE_KIND] = ka.OPEN_TORQUE
            motor[a, ka.K_M], motor[a, ka.I_MAX], motor[a, ka.U_MAX] = 1.0, m.torque_limit, np.inf
    return ka.DriveArrays(table=integers(table), motor=reals(motor), input=reals(inputs))


def _dc_motor(m: Motor, k_p: float, k_d: float) -> np.ndarray:
    row = np.zeros(ka.MOTOR_SIZE)
    row[ka.K_M] = m.joint_constant
    row[ka.RESISTANCE], row[ka.INDUCTANCE] = m.resistance, m.inductance
    row[ka.J_M], row[ka.D_M] = m.armature, m.reflected_damping
    row[ka.K_P], row[ka.K_D] = k_p, k_d
    row[ka.U_MAX], row[ka.I_MAX] = m.voltage_limit, m.current_limit
    return row


def _attached(robot: Robot, body: str, point: np.ndarray, user: str) -> tuple[int, np.ndarray]:
    """Return the index of a body and a point in its frame, see :meth:`Robot.attach`; errors begin with ``user``."""
    try:
        return robot.attach(body, point)
    except ModelError as error:
        raise ModelError(f"{user}: {error}") from None


def compile_contacts(robot: Robot, contacts: Sequence[Contact], floors: np.ndarray | None = None) -> ka.ContactArrays:
    """Return the tables of the contact points.

    Parameters
    ----------
    robot : Robot
        Description of the robot.
    contacts : sequence of Contact
        Contact candidates.
    floors : (c,) ndarray, optional
        Mobilities along the normals up to which contacts have no force [1/kg], for the bilateral law.

    Raises
    ------
    ModelError
        If a body is unknown, or friction or smoothing speed is negative.
    """
    link = np.zeros((len(contacts), ka.CONTACT_LINK_SIZE), dtype=np.int64)
    point = np.zeros((len(contacts), ka.POINT_SIZE))
    for k, contact in enumerate(contacts):
        body, on_body = _attached(robot, contact.body, contact.point, f"contact {contact.name}")
        surface = contact.surface
        link[k, ka.LINK], link[k, ka.FRICTION_LAW] = body, _FRICTION[contact.pulling_friction]
        link[k, ka.LEFT_OUT] = contact.left_out
        point[k, ka.POINT : ka.POINT + 3] = on_body
        link[k, ka.CARRIER] = -1
        if surface.carrier is not None:
            link[k, ka.CARRIER], _ = _attached(robot, surface.carrier, np.zeros(3), f"surface of {contact.name}")
        if surface.carrier is not None or not isinstance(surface, Quadric):  # use any plane: its rows are overwritten
            point[k, ka.QUADRIC + 8] = 1.0
            continue
        curved = bool(surface.Q.any())
        scale = 1.0 if curved else 1.0 / float(np.linalg.norm(surface.b))
        link[k, ka.CURVED] = curved
        point[k, ka.QUADRIC : ka.QUADRIC + 6] = surface.Q[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        point[k, ka.QUADRIC + 6 : ka.QUADRIC + 9] = scale * surface.b
        point[k, ka.QUADRIC + 9] = scale * surface.c
    law = contact_laws(robot, contacts)
    if floors is not None:
        law[:, ka.FLOOR] = floors
    return ka.ContactArrays(integers(link), reals(point), reals(law))


def compile_loads(robot: Robot, loads: Sequence[Load]) -> LoadArrays:
    """Return the tables of the external wrenches.

    Raises
    ------
    ModelError
        If a body is unknown.
    """
    table = np.zeros((len(loads), kl.TABLE_SIZE), dtype=np.int64)
    parts: list[np.ndarray] = []
    offset = 0
    for k, load in enumerate(loads):
        body, on_body = _attached(robot, load.body, load.point, f"load {load.name}")
        segments = np.column_stack([load.knots[:-1], load.coefficients.reshape(len(load.coefficients), 24)])
        table[k] = body, load.in_body, load.hold, offset, len(segments)
        parts += [on_body, np.zeros(6), segments.ravel(), load.knots[-1:]]
        offset += kl.FIRST_SEGMENT + segments.size + 1
    return LoadArrays(table=integers(table), data=reals(np.concatenate(parts) if parts else np.zeros(0)))


def compile_couplings(robot: Robot) -> ka.CouplingArrays:
    """Return the tables of the couplings of a robot that passes :func:`compile_model`."""
    joints = {link.joint: i for i, link in enumerate(robot.links)}
    joint = np.zeros((len(robot.couplings), ka.COUPLING_JOINT_SIZE), dtype=np.int64)
    law = np.zeros((len(robot.couplings), ka.COUPLING_SIZE))
    for k, coupling in enumerate(robot.couplings):
        joint[k, ka.FOLLOWER], joint[k, ka.LEADER] = joints[coupling.joint], joints[coupling.leader]
        law[k, ka.RATIO], law[k, ka.OFFSET] = coupling.ratio, coupling.offset
    return ka.CouplingArrays(joint=integers(joint), law=reals(law))


def compile_support(robot: Robot) -> ks.SupportArrays:
    """Return the tables of the mobile base; size zero for a robot without a base.

    Raises
    ------
    ModelError
        If its body or wheels do not belong to the robot, or its support triangle is degenerate.
    """
    base = robot.base
    if base is None:
        return ks.no_support()
    sizes = ks.BASE_SIZE, ks.STATE_SIZE, ks.LEAST_SIZE
    bodies, joints = [link.name for link in robot.links], robot.joint_names
    if base.body not in bodies or not set(base.wheels) <= set(joints):
        raise ModelError(
            f"{robot.name}: body {base.body!r} and wheels {', '.join(base.wheels)} of the mobile base must belong to "
            "the robot"
        )
    if not (base.wheel_radius > 0.0 and base.track > 0.0 and base.wheel_friction > 0.0):
        raise ModelError(f"{robot.name}: wheel radius, track and friction of the wheels must be positive")
    x, y = (float(part) for part in base.caster[:2])
    if x == 0.0:
        raise ModelError(f"{robot.name}: the caster is below the axle, so the base has no support triangle; move it")
    own = integers(robot.tree_of(base.body))
    numbers = (reals(np.full(size, np.inf)) for size in sizes)
    arrays = ks.SupportArrays(integers(np.zeros(ks.INDEX_SIZE)), own, *numbers)
    arrays.index[[ks.BODY, ks.LEFT, ks.RIGHT]] = bodies.index(base.body), *map(joints.index, base.wheels)
    arrays.base[[ks.TRACK, ks.CASTER_X, ks.CASTER_Y]] = base.track, x, y
    arrays.base[[ks.SPIN_INERTIA, ks.FRICTION]] = base.spin_inertia, base.wheel_friction
    half = 0.5 * base.track
    sides = np.array([np.hypot(x, y + half), np.hypot(x, y - half), base.track])
    arrays.base[ks.SHARE : ks.SHARE + 3] = sides.sum() / sides
    return arrays


def _check_couplings(robot: Robot) -> None:
    """Raise ModelError for couplings of unknown joints, two couplings of one joint, cycles, and invalid numbers."""
    joints = {link.joint: link for link in robot.links}
    leads: dict[str, Coupling] = {}
    for coupling in robot.couplings:
        name = f"coupling of {coupling.joint}"
        for joint in (coupling.joint, coupling.leader):
            if joint not in joints:
                raise ModelError(f"{name}: unknown joint {joint!r}; joints: {', '.join(joints)}")
            if joints[joint].kind not in ("revolute", "prismatic"):
                raise ModelError(
                    f"{name}: {joint} is {joints[joint].kind}; only revolute and prismatic joints can be coupled"
                )
        if coupling.joint in leads:
            raise ModelError(
                f"{name}: the joint already follows {leads[coupling.joint].leader!r}; it can follow only one joint"
            )
        for quantity in ("ratio", "offset"):
            value = getattr(coupling, quantity)
            if not (isinstance(value, (int, float, np.floating)) and np.isfinite(value)):
                raise ModelError(f"{name}: {quantity} {brief(value)} must be a finite number")
        leads[coupling.joint] = coupling
    for start in leads:
        circle, joint = [start], leads[start].leader
        while joint in leads and joint not in circle:
            circle.append(joint)
            joint = leads[joint].leader
        if joint in circle:
            raise ModelError(
                f"coupling of {start}: joints follow each other in a cycle: {' → '.join([*circle, joint])}"
            )


def check_couplings(robot: Robot, initial: np.ndarray) -> None:
    """Raise :class:`ModelError` if coordinates at the start, (nq,), violate a coupling."""
    position = dict(zip(robot.joint_names, robot.position_index, strict=True))
    for coupling in robot.couplings:
        q, leader = (initial[position[joint]] for joint in (coupling.joint, coupling.leader))
        wanted = coupling.ratio * leader + coupling.offset
        if not abs(q - wanted) <= COUPLING_TOLERANCE:
            raise ModelError(
                f"coupling of {coupling.joint}: initial position {q:.6g} does not match {coupling.ratio:g} · "
                f"{leader:.6g} ({coupling.leader}) + {coupling.offset:g} = {wanted:.6g}; omit the initial position "
                f"of {coupling.joint}"
            )


def _check_shapes(robot: Robot) -> None:
    """Raise ModelError for values that numpy would broadcast over the tables, or that are NaN."""
    names = [link.name for link in robot.links]
    body, point = robot.hand
    if body not in names:
        raise ModelError(f"{robot.name}: the hand is on the unknown body {body!r}; bodies: {', '.join(names)}")
    quantities: list[tuple[str, object, tuple[int, ...]]] = [
        (f"{robot.name}: gravity", robot.gravity, (3,)),
        (f"{robot.name}: the hand's point", point, (3,)),
        (f"{robot.name}: q0", robot.initial, (robot.nq,)),
    ]
    for link in robot.links:
        inertia = link.inertia
        quantities += [
            (f"{link.joint}: axis", link.axis, (3,)),
            (f"{link.joint}: R_PJ", link.R_PJ, (3, 3)),
            (f"{link.joint}: p_PJ", link.p_PJ, (3,)),
            (f"{link.name}: mass", inertia.mass, ()),
            (f"{link.name}: centre of mass", inertia.com, (3,)),
            (f"{link.name}: inertia tensor", inertia.tensor, (3, 3)),
        ]
    for quantity, value, shape in quantities:
        try:
            array = np.asarray(value)
        except ValueError:  # rows of unequal length
            array = np.array(None)
        if array.dtype.kind not in "fiu" or array.shape != shape or not np.isfinite(array).all():
            wanted = f"an array of shape {shape} of finite numbers" if shape else "a finite number"
            raise ModelError(f"{quantity} must be {wanted}, got {brief(value)}")


def _joint_kind(link: Link) -> int:
    if link.kind == "revolute":
        for kind, axis in ((ka.REVOLUTE_X, (1, 0, 0)), (ka.REVOLUTE_Y, (0, 1, 0)), (ka.REVOLUTE_Z, (0, 0, 1))):
            if np.array_equal(link.axis, axis):
                return kind
    return link.row.code


# Quantities of each kind of motor that must be positive, with their units, and that must not be negative.
_POSITIVE: dict[type, dict[str, str]] = {
    Motor: {"torque_constant": "N m/A", "resistance": "ohm", "gear_ratio": "1", "voltage_limit": "V",
            "current_limit": "A"},
    Servo: {"torque_constant": "N m/A", "resistance": "ohm", "coulomb_speed": "rad/s", "current_limit": "A",
            "voltage_limit": "V", "torque_limit": "N m"},
    TorqueSource: {"torque_limit": "N m"},
}  # fmt: skip
_NOT_NEGATIVE: dict[type, tuple[str, ...]] = {
    Motor: ("rotor_inertia", "gear_damping", "dry_friction"),
    Servo: ("k_p", "k_d", "k_v", "armature", "reflected_damping", "coulomb_friction", "free_drag"),
    TorqueSource: (),
}


def _check_motor(motor: Drive, joints: dict[str, Link]) -> None:
    if motor.joint not in joints:
        raise ModelError(f"motor: unknown joint {motor.joint!r}; joints: {', '.join(joints)}")
    for quantity, unit in _POSITIVE[type(motor)].items():
        value = getattr(motor, quantity)
        if value is not None and not value > 0.0:
            raise ModelError(f"motor of {motor.joint}: {quantity} {value} {unit} must be positive")
    if isinstance(motor, Motor) and not motor.inductance > 0.0:
        raise ModelError(
            f"motor of {motor.joint}: inductance {motor.inductance} H must be positive; "
            "for a circuit without inductance use a small value (1e-6 H) and integrator.method: auto or radau5"
        )
    for quantity in _NOT_NEGATIVE[type(motor)]:
        if not getattr(motor, quantity) >= 0.0:
            raise ModelError(f"motor of {motor.joint}: {quantity} {getattr(motor, quantity)} must be zero or positive")
    if isinstance(motor, Servo) and joints[motor.joint].units[0] != "rad":
        raise ModelError(f"motor of {motor.joint}: a servo requires a revolute joint (here {joints[motor.joint].kind})")


def _check_movable(robot: Robot, tree: np.ndarray, body: np.ndarray) -> None:
    """Raise ModelError for a joint that has no equation of motion: no motor inertia, and no mass beyond it."""
    empty: list[str] = []
    carried = np.abs(body[:, ka.MASS]) + np.abs(body[:, ka.INERTIA : ka.INERTIA + 6]).sum(axis=1)
    for i in range(len(tree) - 1, -1, -1):
        if carried[i] + body[i, ka.ARMATURE] <= 0.0:
            empty.append(robot.links[i].joint)
        if tree[i, ka.PARENT] >= 0:
            carried[tree[i, ka.PARENT]] += carried[i]
    if empty:
        text = "move no mass and have" if len(empty) > 1 else "moves no mass and has"
        fix = "set the mass of a link beyond it (mass_kg), or the rotor inertia of its motor"
        raise ModelError(f"{first_few(empty[::-1], 20)} {text} no motor inertia; {fix}")


# Empty shape tables for time stepping, so that one compiled program fits all scenes.


def with_shapes(system: System) -> System:
    """Return the system with shape tables, which are added if they are missing.

    Added tables treat all contacts as points on quadrics. The results are the same up to rounding, and the speed is the
    same within 2 %.
    """
    if system.shapes is not None:
        return system
    return system._replace(shapes=shape_arrays([(None, 0.0, np.zeros(3), False)] * len(system.contacts.link)))
