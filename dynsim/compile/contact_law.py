"""Tables of the unilateral law for the kernels: law of each contact, joint stops, dry friction, ties.

The law itself is in :mod:`dynsim.dynamics.contact.unilateral` and :mod:`dynsim.integrators.contacts`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact import unilateral as ku
from dynsim.dynamics.contact.cone import problem as kc
from dynsim.dynamics.contact.cone.socp import split_size
from dynsim.dynamics.contact.unilateral import UnilateralArrays, kept_size, share_count
from dynsim.errors import ModelError
from dynsim.jit.kernel import integers, reals
from dynsim.model.description import WORLD, Contact, Robot, Tie
from dynsim.model.drives import TorqueSource

# A joint may start this far beyond its stop [rad or m].
START_TOLERANCE = 1e-6
# After an impact a point that separates more slowly than this stays closed, which ends a series of ever smaller
# bounces [m/s]. It exceeds 6e-5 m/s, the speed gained by falling through the depth at which a point counts as landed:
# with a lower bound two points of a rocking body would land in turn without end.
SETTLE_SPEED = 1e-4


@dataclass(frozen=True)
class JointStop:
    """What a joint comes up against: side 1 keeps q ≥ position, side −1 q ≤ position [rad or m]."""

    joint: str
    side: float
    position: float


@dataclass(frozen=True)
class DryFriction:
    """Friction of a joint that holds it at rest, of its gear and of its bearing [N m or N]."""

    joint: str
    gear: float
    bearing: float


def dry_frictions(robot: Robot) -> list[DryFriction]:
    """The joints of a robot with friction that is not smoothed."""
    gears = {motor.joint: motor.dry_friction for motor in robot.motors if not isinstance(motor, TorqueSource)}
    frictions = [DryFriction(link.joint, gears.get(link.joint, 0.0), link.friction) for link in robot.links]
    return [friction for friction in frictions if friction.gear + friction.bearing > 0.0]


def format_quantity(value: float, unit: str, digits: int = 5) -> str:
    """A joint coordinate for a line of text; an angle in degrees first, which scenarios are written in."""
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
) -> UnilateralArrays:
    """Tables of the unilateral law.

    Parameters
    ----------
    stops : what joints come up against
    slow : speed below which slip has no direction of its own [m/s]
    creep : rate below which a joint that rubs may be at rest [rad/s or m/s]
    dry : joints that rub
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
        room=reals(np.zeros((ku.ROOM, p, p))),
        split_room=reals(np.zeros(split_size(3 * c + len(dry) + s, c + len(dry) + s))),
        number=reals(number),
        shares=reals(np.zeros(shares)),
        kept=reals(np.zeros(kept_size(shares, c, s, len(dry)))),
    )


def _compile_tie(robot: Robot, tie: Tie, table: NDArray[np.int64], row: NDArray[np.float64]) -> None:
    """Rows of the tables of a tie."""
    where = f"tie {tie.name}"
    if not (tie.stiffness >= 0.0 and tie.damping >= 0.0 and tie.stiffness + tie.damping > 0.0 and tie.bound > 0.0):
        raise ModelError(f"{where}: needs a stiffness or a damping, neither negative, and a positive bound")
    a, point = robot.attach(tie.body, tie.point)
    b, other = (-1, tie.other_point) if tie.other == WORLD else robot.attach(tie.other, tie.other_point)
    if a == b:
        raise ModelError(f"{where}: both ends are on {robot.links[a].name}")
    length = float(np.linalg.norm(tie.axis))
    if not length > 0.0:
        raise ModelError(f"{where}: its axis has no direction")
    kind = kc.ONE_WAY if tie.pushes else kc.BOX
    table[[ku.TIE_A, ku.TIE_B, ku.TIE_TURNS, ku.TIE_KIND]] = a, b, tie.turns, kind if tie.holds else -1
    row[[ku.TIE_STIFFNESS, ku.TIE_DAMPING, ku.TIE_BOUND, ku.TIE_REST]] = tie.stiffness, tie.damping, tie.bound, tie.rest
    row[ku.TIE_AXIS : ku.TIE_AXIS + 3] = robot.attached_axes(tie.body) @ np.asarray(tie.axis) / length
    row[ku.TIE_POINT : ku.TIE_POINT + 3], row[ku.TIE_OTHER_POINT : ku.TIE_OTHER_POINT + 3] = point, other
    row[ku.TIE_ATTITUDE : ku.TIE_ATTITUDE + 9] = tie.attitude.ravel()


def contact_laws(robot: Robot, contacts: Sequence[Contact]) -> NDArray[np.float64]:
    """The law of each contact, (c, CONTACT_LAW_SIZE), see dynsim.dynamics.tables.

    Raises
    ------
    ModelError
        Static friction below the kinetic one, negative numbers, or restitution above one.
    """
    law = np.ones((len(contacts), ka.CONTACT_LAW_SIZE))
    # Isotropic friction has no axis: tangents that turned with the body would turn the rates of a step, also rates
    # that it has stopped.
    law[:, [ka.FLOOR, ka.GRIP_AXIS, ka.GRIP_AXIS + 1, ka.GRIP_AXIS + 2]] = 0.0
    for row, contact in zip(law, contacts, strict=True):
        where = f"contact {contact.name}"
        if not contact.friction >= 0.0:
            raise ModelError(f"{where}: friction {contact.friction} must be zero or positive")
        if not contact.slip_smoothing > 0.0:
            raise ModelError(f"{where}: slip smoothing {contact.slip_smoothing} m/s must be positive")
        if not contact.friction_at_rest >= contact.friction:
            raise ModelError(
                f"{where}: static friction {contact.static_friction:g} is less than the kinetic {contact.friction:g}"
            )
        if not 0.0 <= contact.restitution <= 1.0:
            raise ModelError(f"{where}: restitution {contact.restitution:g} is not between 0 and 1")
        if not (contact.stribeck >= 0.0 and contact.viscous_friction >= 0.0):
            raise ModelError(f"{where}: Stribeck speed and viscous friction must not be negative")
        row[[ka.MU, ka.V_S, ka.STATIC]] = contact.friction, contact.slip_smoothing, contact.friction_at_rest
        row[[ka.STRIBECK, ka.VISCOUS]] = contact.stribeck, contact.viscous_friction
        row[ka.RESTITUTION] = contact.restitution
        stiffness, damping = contact.stiffness, contact.damping
        if not (stiffness >= 0.0 and damping >= 0.0) or (damping > 0.0 and stiffness == 0.0):
            raise ModelError(f"{where}: stiffness and damping must not be negative, and damping needs a stiffness")
        row[[ka.CONTACT_STIFFNESS, ka.CONTACT_DAMPING]] = stiffness, damping
        if contact.grip_axis is not None and contact.grip != 1.0:
            row[ka.GRIP] = contact.grip
            row[ka.GRIP_AXIS : ka.GRIP_AXIS + 3] = robot.attached_axes(contact.body) @ contact.grip_axis
    return law


def joint_stops(
    robot: Robot, q: NDArray[np.float64] | None = None, tolerance: float = START_TOLERANCE
) -> list[JointStop]:
    """Return the stops of a robot's joints: their finite limits, the lower one first.

    Parameters
    ----------
    q : (nq,) ndarray
        Start [rad or m]; default: the robot's initial positions.
    tolerance : float
        A joint may start this far beyond its stop [rad or m].

    Raises
    ------
    ModelError
        If a joint starts beyond its stop.
    """
    stops, remedy = [], "change its initial position or its limit"
    if q is None:
        q = robot.initial
    else:
        remedy = "start from a state within its stops"
    for link, k in zip(robot.links, robot.position_index, strict=True):
        for side, limit in ((1.0, link.lower), (-1.0, link.upper)):
            if np.isfinite(limit):
                beyond = side * (limit - q[k])
                if beyond > tolerance:
                    raise ModelError(
                        f"{link.joint}: starts at {format_quantity(q[k], link.units[0])}, beyond its "
                        f"stop at {format_quantity(limit, link.units[0])}; "
                        f"contacts.law: unilateral enforces it: {remedy}",
                        keys=("plant",),
                    )
                stops.append(JointStop(link.joint, side, float(limit)))
    return stops
