"""Postures with points on surfaces, nearest to the initial posture, and motor torques that hold a posture at rest."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dynsim.compile.bracing import MIN_N, BracePlanner, brace_rows
from dynsim.compile.mobility import immobile_at
from dynsim.compile.model import Model
from dynsim.compile.solids import axes_inside, passes_through, tangent_planes
from dynsim.compile.touching import TouchPoint, gap_at, touch
from dynsim.dynamics.contact.braces import statics as kb
from dynsim.errors import ModelError, first_few
from dynsim.model.description import Array, Contact, Load, Robot
from dynsim.model.drives import Servo
from dynsim.model.surfaces import Surface

HAND = "hand"

# Distance from a surface that counts as zero [m].
TOLERANCE = 1e-13
REACHED = 1e-12
ITERATIONS = 300
# A point that no joint moves along the surface normal must start this close to its surface [m].
START_TOLERANCE = 1e-6
# Amount by which a joint may exceed its limit due to rounding [rad or m].
BEYOND = 1e-9
STEP_MAX = 0.3  # maximum step per iteration [rad or m]; prevents jumps to another solution branch


def gaps_and_rates(model: Model, contacts: Sequence[Contact], q: Array) -> tuple[Array, Array]:
    """Return the distances of contacts from surfaces, (c,) [m], and their derivatives, (c, n) [m/rad]."""
    gaps, rates = np.zeros(len(contacts)), np.zeros((len(contacts), model.n))
    for k, contact in enumerate(contacts):
        nearest = touch(model, contact, q)
        gaps[k], rates[k] = nearest.gap, nearest.normal @ nearest.jacobian(model, q)
    return gaps, rates


def on_surfaces(model: Model, contacts: Mapping[str, Contact], names: Sequence[str], keep: Sequence[str]) -> Array:
    """Find the posture nearest to the initial one, by |q − q_0|, that puts the named points on their surfaces.

    Joints that would exceed their limits are stopped there, the worst joint first, and the other joints continue.

    A point stays on the side of a box, sphere or cylinder that it faces in the initial posture. If link axes are then
    inside the solid, or the point starts inside and cannot reach the nearest side, the search is repeated from each
    side of the solid. The nearest posture without axes inside is returned.

    The search takes Gauss–Newton steps q ← q_0 + J⁺ (J (q − q_0) − e), and then Newton steps without the pull towards
    q_0 to gain the last digits.

    Parameters
    ----------
    model : Model
        Model of the robot.
    contacts : mapping of str to Contact
        Contacts of the scenario.
    names : sequence of str
        Contacts to put on their surfaces.
    keep : sequence of str
        Joints that do not move; with the entry ``hand``, the hand keeps its position.

    Returns
    -------
    (nq,) ndarray
        Joint positions [rad or m].

    Raises
    ------
    ModelError
        If a name is unknown or refers to a link axis, the points cannot reach their surfaces, or only with an arm that
        passes through a solid.
    """
    robot = model.robot
    for name in names:
        if name not in contacts:
            raise ModelError(f"initial.on_surface: unknown contact {name!r}; contacts: {', '.join(contacts) or 'none'}")
        if contacts[name].tip is not None:
            raise ModelError(f"initial.on_surface: {name!r} is the axis of a link; use the points at its ends")
        if contacts[name].left_out and abs(gap := gap_at(model, contacts[name], robot.initial)) > START_TOLERANCE:
            raise ModelError(
                f"initial.on_surface: no joint moves {name!r} along the normal of "
                f"{contacts[name].surface_name!r} (gap {gap:+.4g} m); remove it from the list"
            )
    fixed = [name for name in keep if name != HAND]
    for name in fixed:
        if name not in robot.joint_names:
            raise ModelError(f"initial.keep: unknown joint {name!r}; use {HAND} or {', '.join(robot.joint_names)}")
    if robot.couplings:
        raise ModelError("initial: coupled joints are not supported; set the joint positions instead")
    columns = [
        k for k, link in enumerate(robot.links) if len(link.row.neutral) == 1 and robot.joint_names[k] not in fixed
    ]
    points = [contacts[name] for name in names if not contacts[name].left_out]
    start = robot.initial
    gaps, _ = gaps_and_rates(model, points, start)

    def search(planes: Sequence[Contact] = ()) -> tuple[Array, float, str]:
        """Return a posture, its largest residual [m], and the joints at their limits as text."""
        stopped = dict[int, float]()
        guess = _nearest(model, planes, columns, stopped, HAND in keep, start)[0] if planes else start
        while True:
            q, worst = _nearest(model, points, columns, stopped, HAND in keep, guess)
            beyond = _furthest_beyond(robot, columns, q) if worst <= REACHED else None
            if beyond is None:
                at_limit = ", ".join(robot.joint_names[k] for k in stopped)
                return q, worst, f" with {at_limit} at the limit" if at_limit else ""
            stopped[beyond[0]] = beyond[1]

    def rank(q: Array, solid: Surface) -> tuple[float, int, float]:
        """Return the length of axes inside a solid [mm], the number of points on the far side, and the distance."""
        turned = 0
        for contact, gap in zip(points, gaps, strict=True):
            if contact.surface is solid and gap > 0.0:
                before, now = (
                    contact.surface.normal(model.point_position(contact.body, contact.point, posture))
                    for posture in (start, q)
                )
                turned += bool(before @ now < 0.0)
        return round(1e3 * axes_inside(robot, solid, q)), turned, float(np.linalg.norm(q - start))

    q, worst, within = search()
    sides = points
    for solid in {id(contact.surface): contact.surface for contact in points}.values():
        planes = tangent_planes(solid)
        if not planes or (worst <= REACHED and rank(q, solid)[:2] == (0, 0)):
            continue
        tried = [
            [replace(contact, surface=plane) if contact.surface is solid else contact for contact in sides]
            for plane in planes
        ]
        others = [search(entry) for entry in tried]
        ranks = [(rank(other[0], solid), k) for k, other in enumerate(others) if other[1] <= REACHED]
        best = min((entry for entry in ranks if entry[0][0] == 0), default=None)
        if best is not None and not (worst <= REACHED and rank(q, solid) <= best[0]):
            (q, worst, within), sides = others[best[1]], tried[best[1]]
    if not worst <= REACHED:
        raise ModelError(
            f"initial: cannot bring {', '.join(names)} onto their surfaces{within}: {worst:.3g} m short; "
            "list fewer joints in initial.keep or start closer"
        )
    for contact in points:
        if tangent_planes(contact.surface) and passes_through(robot, contact, q):
            raise ModelError(
                f"initial.on_surface: {contact.name!r} only reaches the far side of {contact.surface_name!r}, with the "
                "arm through it; start on the near side or move the surface within reach"
            )
    return q


def _nearest(
    model: Model,
    points: Sequence[Contact],
    columns: Sequence[int],
    stopped: Mapping[int, float],
    keep_hand: bool,
    guess: Array,
) -> tuple[Array, float]:
    """Return the posture with the points on their surfaces and joints ``stopped`` fixed, and the largest residual."""
    robot = model.robot
    moving = [k for k in columns if k not in stopped]
    places = [robot.position_index[k] for k in moving]
    start = robot.initial
    hand = model.point_position(*robot.hand, start)
    q = guess.copy()
    for k, value in stopped.items():
        q[robot.position_index[k]] = value
    for turn in range(ITERATIONS):
        error, J = gaps_and_rates(model, points, q)
        if keep_hand:
            position, jacobian = model.point_position_and_jacobian(*robot.hand, q)
            error, J = np.concatenate([error, position - hand]), np.vstack([J, jacobian])
        pull = start[places] - q[places] if turn < ITERATIONS - 5 else 0.0 * q[places]
        step = pull - np.linalg.lstsq(J[:, moving], error + J[:, moving] @ pull, rcond=1e-10)[0]
        longest = float(np.abs(step).max(initial=0.0))
        if np.abs(error).max(initial=0.0) <= TOLERANCE and longest < 1e-10:
            break
        q[places] += step * min(1.0, STEP_MAX / max(longest, 1e-300))
    return q, float(np.abs(error).max(initial=0.0))


def _furthest_beyond(robot: Robot, columns: Sequence[int], q: Array) -> tuple[int, float] | None:
    """Return the joint that exceeds its limit most, and the limit; other code reports joints that start beyond it."""
    worst, furthest = BEYOND, None
    for k in columns:
        link, at, start = robot.links[k], q[robot.position_index[k]], robot.initial[robot.position_index[k]]
        for side, limit in ((1.0, link.upper), (-1.0, link.lower)):
            if side * (start - limit) <= 0.0 and side * (at - limit) > worst:
                worst, furthest = side * (at - limit), (k, limit)
    return furthest


# Motor torques that hold a posture at rest against weight, loads and braces with the least motor heat.


# Contacts with a gap below this [m] count as closed at the start.
TOUCHING = 1e-6
KEYS = ("initial", "equilibrium")
# Fraction of the static friction that an equilibrium uses at most, unless it needs the full friction.
RESERVED = 0.9


@dataclass(frozen=True)
class Rest:
    """A posture at rest.

    Attributes
    ----------
    torques : (n,) ndarray
        Motor torques [N m or N], zero for joints whose motor cannot produce a torque at rest.
    normal_forces : dict of str to float
        Normal force of each contact that touches [N]; negative: the surface pulls.
    forces : list of (int, (3,) ndarray, (3,) ndarray)
        Forces of these contacts on the arm: link index, point in its frame [m], force in the world [N].
    on_edge : bool
        True if the posture requires the full static friction.
    """

    torques: Array
    normal_forces: dict[str, float]
    forces: list[tuple[int, Array, Array]]
    on_edge: bool = False


def holding_torques(
    model: Model,
    q: Array,
    contacts: Sequence[Contact],
    loads: Sequence[Load],
    able: Sequence[str],
    real: bool,
    springs: Mapping[str, float] | None = None,
) -> Rest:
    """Return the motor torques that hold a posture with the least heat.

    Parameters
    ----------
    model : Model
        Model of the robot.
    q : (nq,) ndarray
        Posture [rad or m].
    contacts : sequence of Contact
        All contacts; only contacts that touch carry load.
    loads : sequence of Load
        External loads, evaluated at t = 0.
    able : sequence of str
        Joints whose motors can produce a torque at rest.
    real : bool
        True for the unilateral law.
    springs : mapping of str to float, optional
        Spring force of each contact that carries load [N]; NaN for a rigid contact. Compliant contacts get these forces
        if possible, otherwise the nearest possible forces, whatever torques they require. Default: all touching
        contacts carry load and are rigid.

    Returns
    -------
    Rest
        Torques and contact forces.

    Raises
    ------
    ModelError
        If no torques hold the posture; the message lists joints whose motors are too weak. Also if the robot has
        coupled joints.
    """
    robot = model.robot
    if robot.couplings:
        raise ModelError("initial.equilibrium: coupled joints are not supported, because they share a motor", keys=KEYS)
    touching = touching_contacts(model, contacts, q, real, springs)
    # Try without friction, then with a friction reserve, then with the full Coulomb friction. Try each first with a
    # minimum force, so that contacts that press continue to press.
    attempts = [(0.0, 0.0, False)]
    if real and touching:
        ways = (False,) if springs is None else (True, False)
        attempts = [
            (share, least, follow_springs)
            for share in (0.0, RESERVED, 1.0)
            for follow_springs in ways
            for least in (MIN_N, 0.0)
        ]
    loaded = load_forces(model, q, loads)
    pushes = [_row(point, push, 0.0, 0.0, float(np.linalg.norm(push))) for _, point, push in loaded]
    driven = replace(robot, motors=tuple(motor for motor in robot.motors if motor.joint in able))
    for share, least, follow_springs in attempts:
        rows = []
        for at in touching:
            # The force of the spring is either prescribed or the target of a search.
            spring = np.nan if springs is None else springs[at.contact.name]
            commanded = spring if follow_springs else np.nan
            rows.append(_row(at.point, at.normal, share * at.contact.friction_at_rest, least, commanded))
            if not (follow_springs or np.isnan(spring)):
                rows[-1][[kb.NEAR, kb.COMPLIANCE]] = spring, 1.0 / at.contact.stiffness
            if not real:
                rows.append(_row(at.point, -at.normal, 0.0, 0.0))
        sides = 1 if real else 2
        links = [at.link for at in touching for _ in range(sides)] + [link for link, *_ in loaded]
        carriers = [at.carrier for at in touching for _ in range(sides)] + [-1] * len(loaded)
        planner = BracePlanner(driven, model.arrays, links, carriers)
        tables = np.array([*rows, *pushes]).reshape(1, -1, kb.BRACE_SIZE)
        still, arrays = np.zeros((1, model.n)), planner.arrays
        torques, normal_N, solved = planner.least_heat(q[None], still, still, tables)
        if solved == 1:
            pressed = normal_N[0, : len(rows)]
            normal = pressed if real else pressed[::2] - pressed[1::2]
            names = [at.contact.name for at in touching]
            forces = arrays.forces[: len(rows)] if real else arrays.forces[: len(rows)].reshape(-1, 2, 3).sum(axis=1)
            acting = [pair for at, force in zip(touching, forces, strict=True) for pair in _acting(model, q, at, force)]
            return Rest(torques[0], dict(zip(names, normal.tolist(), strict=True)), acting, share == 1.0)
    raise ModelError(
        _describe_weak_joints(model, arrays.motors, arrays.free, [at.contact.name for at in touching]), keys=KEYS
    )


def touching_contacts(
    model: Model, contacts: Sequence[Contact], q: Array, real: bool, named: Container[str] | None = None
) -> list[TouchPoint]:
    """Return the contacts that touch and can carry load, or only the ``named`` contacts, whatever their gaps."""
    nearest = [touch(model, contact, q) for contact in contacts if not contact.left_out]
    touching = [
        at
        for at in nearest
        if (abs(at.gap) <= TOUCHING or (real and at.gap < 0.0) if named is None else at.contact.name in named)
    ]
    # A point that no joint moves along its normal carries no force, see dynsim.integrators.contacts.impacts.
    return [at for at in touching if not immobile_at(model, at, q)]


def _acting(model: Model, q: Array, at: TouchPoint, force: Array) -> list[tuple[int, Array, Array]]:
    """Return the forces of a contact on its link and on the link that carries the surface, as in :class:`Rest`."""
    acting = [(at.link, at.point, force)]
    if at.carrier >= 0:
        R, p = model.body_pose(at.carrier, q)
        acting.append((at.carrier, R.T @ (at.position - p), -force))
    return acting


def _row(point: Array, normal: Array, friction: float, least: float, force: float = np.nan) -> Array:
    """Return the table row of a brace that does not slide, for the kernels."""
    return brace_rows(point, normal[None], np.array([friction]), least, force, np.zeros((1, 3)))[0]


def load_torques(model: Model, q: Array, loads: Sequence[Load], time: float = 0.0) -> Array:
    """Return the torques that hold the loads at a time [s], −J_wᵀ W, (n,) [N m or N]."""
    torques = np.zeros(model.n)
    for link, point, force in load_forces(model, q, loads, time):
        torques -= model.point_jacobian(link, point, q).T @ force
    return torques


def load_forces(model: Model, q: Array, loads: Sequence[Load], time: float = 0.0) -> list[tuple[int, Array, Array]]:
    """Return the loads at a time [s] as pure forces: link, point in its frame [m], force in the world [N].

    A torque M is replaced by the couple of M × d and −M × d at ±d/2, with d a unit vector perpendicular to M.
    """
    forces = []
    for load in loads:
        wrench = load.components(np.array([time]))[0]
        link, point = model.robot.attach(load.body, load.point)
        axes, _ = model.body_pose(link, q)
        force, torque = (axes @ part if load.in_body else part for part in (wrench[:3], wrench[3:]))
        pushes = [(point, force)]
        if torque.any():
            across = np.cross(torque, np.eye(3)[np.abs(torque).argmin()])
            across /= np.linalg.norm(across)
            lever, couple = 0.5 * axes.T @ across, np.cross(torque, across)
            pushes += [(point + lever, couple), (point - lever, -couple)]
        forces += [(link, at, push) for at, push in pushes if push.any()]
    return forces


def _describe_weak_joints(model: Model, limits: Array, needed: Array, braces: Sequence[str]) -> str:
    """Describe the joints that cannot produce the torques needed for weight and loads."""
    robot = model.robot
    motors = {motor.joint: motor for motor in robot.motors}
    weak = []
    for link, (low, high), torque in zip(robot.links, limits[:, [kb.LOWER, kb.UPPER]], needed, strict=True):
        if low - 1e-9 <= torque <= high + 1e-9:
            continue
        motor, unit = motors.get(link.joint), link.units[3]
        if low < high:
            reason = f"its motor can produce {high:.4g} {unit}"
        elif motor is None:
            reason = "has no motor"
        elif isinstance(motor, Servo):
            reason = "its servo follows rates, not positions"
        else:
            reason = "its motor does not hold it: no controller, or k_p = 0"
        weak.append((abs(torque), f"{link.joint} {torque:.4g} {unit} ({reason})"))
    text = "initial.equilibrium: this posture cannot be held at rest"
    if weak:
        largest = [entry for _, entry in sorted(weak, key=lambda entry: -entry[0])]
        text += f": weight and loads require {first_few(largest)}"
    carries = f"; {', '.join(braces)} cannot carry it" if braces else "; no contact touches"
    return f"{text}{carries}; change the posture, add a brace, or remove initial.equilibrium"


def static_margin(model: Model, q: Array, forces: Sequence[tuple[int, Array, Array]] = ()) -> float:
    """Return the tip margin of a base at rest: 1 at the incentre of its support, 0 if it tips, −1 if it lifts.

    See :mod:`dynsim.dynamics.tree.support`.

    Parameters
    ----------
    model : Model
        Model of a robot with a mobile base.
    q : (nq,) ndarray
        Coordinates.
    forces : sequence of (int, (3,) ndarray, (3,) ndarray), optional
        External forces in addition to the weight: link index, point in its frame [m], force in the world [N]. Forces on
        objects next to the base, and weights of these objects, do not count.
    """
    robot, base = model.robot, model.robot.base
    assert base is not None
    axes, origin = model.body_pose(base.body, q)
    force, moment, carried = np.zeros(3), np.zeros(3), robot.tree_of(base.body)
    weights = [(i, link.inertia.com, link.inertia.mass * robot.gravity) for i, link in enumerate(robot.links)]
    for link, point, push in (*weights, *forces):
        if not carried[link]:
            continue
        force += push
        moment += np.cross(model.point_position(link, point, q) - origin, push)
    # Ground reaction, in the axes of the base.
    pressed, (turn_x, turn_y) = -float(axes[:, 2] @ force), (-axes.T @ moment)[:2]
    if pressed <= 0.0:
        return -1.0
    x, y = base.caster[:2]
    caster = -turn_y / x
    difference = 2.0 * (turn_x - caster * y) / base.track
    loads = np.array([pressed - caster + difference, pressed - caster - difference, 2.0 * caster]) / 2.0
    half = 0.5 * base.track
    sides = np.array([np.hypot(x, y + half), np.hypot(x, y - half), base.track])
    return float((loads / pressed * sides.sum() / sides).min())
