"""Distance of the hand or head from its target at the end of a run, and its causes.

The last sample of a record is examined. The error of the hand is the sum of the contributions of the joints,

    p(q) − p_d = J̄ (q − q_r) + ... + p(q_r) − p_d,

with references q_r and the mean Jacobian J̄ between q_r and q. At a joint with a position loop, the deviation is the sum
of the voltages that the loop balances,

    k_p (q_r − q) = R/K (τ_weight + τ_contacts + τ_loads + τ_stop + τ_friction) + u_motion + (u_command − u),

with the torques that the motor carries, also those of joints coupled to its joint, K at the joint, and the part of the
command beyond the limits of the motor.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dynsim.compile.model import Model
from dynsim.compile.posture import load_torques
from dynsim.dynamics import tables as ka
from dynsim.dynamics.drive.law import asked_of, evaluate_reference, fed_forward, servo_drag
from dynsim.engine.force_indeterminacy import contact_point
from dynsim.errors import first_few
from dynsim.model.base_pose import base_coordinates, base_row
from dynsim.model.description import Array, Robot
from dynsim.record import Record
from dynsim.record.measures import hand_error, hand_target
from dynsim.system.memo import recall

if TYPE_CHECKING:
    from dynsim.engine.prepare import Prepared

# Distances of the hand from its target that cause a warning, as fractions of its reach: at the end, and at the start.
# Causes are determined above the third fraction. All are at least LEAST [m]; assumed.
END_LIMIT, START_LIMIT, EXAMINED, LEAST = 0.02, 0.05, 0.005, 1e-3
# Smallest part of the distance that counts as a cause; smallest sum of the parts of all causes; largest part that may
# remain unexplained; largest part by which other effects may reduce the distance. Otherwise the causes are unknown.
PART, EXPLAINED, UNEXPLAINED, OPPOSED = 0.25, 0.6, 0.1, 0.3
# Deviation of a joint beyond which the parts depend on the posture, so that only a part above MAIN counts [rad or m].
FAR, MAIN = 0.5, 0.75
# Smallest part of a cause for which a joint is named.
NAMED = 0.2
# Planned voltages differ from the voltages of the weight by less than this part if they carry the weight alone.
SAME = 1e-3
# Nodes and weights on [0, 1] of the mean Jacobian (Gauss, third order).
NODES = ((0.5 - 0.15**0.5, 5.0 / 18.0), (0.5, 8.0 / 18.0), (0.5 + 0.15**0.5, 5.0 / 18.0))

# Causes, with the text of warnings and their fixes.
TEXTS = {
    "sag": ("sag of {} under the weight", "raise the gains, brace the arm, or use controller.feed_forward: gravity"),
    "contact": ("contact forces on {}", "raise the gains, or move the path or the surface"),
    "deflection": ("deflection of {} under forces that partly cancel", "raise the gains, or add a brace"),
    "load": ("forces of loads and ties on {}", "raise the gains"),
    "limit": ("motors of {} at their limits of voltage, current or torque", "use larger motors, or slow down"),
    "stop": ("joint stops of {}", "change the path or the limits"),
    "friction": ("friction at rest of {}", "raise the gains"),
    "brake": ("closed brakes of {}", "open the brakes, or change the path"),
    "command": ("commands that replace the controller of {}", "set references instead of commands"),
    "motion": ("motion of {}", "run until the arm settles, slow down, or use controller.feed_forward: dynamics"),
    "base": ("deviation of the base from its path", "slow down the base, or raise the gains of its wheels"),
    "free": ("motion of {} without position control", "add motors, or a brace that does not slip"),
    "reference": ("joint references that do not reach the target", "change the references or the target"),
    "drift": ("drift of the base on its wheels", "use controller.state: measured"),
    "clamped": ("{} clamped at joint limits", "use controller.limit_policy: allocate"),
}
# Fixes for the head of a snake, whose controllers have neither feed-forward nor braces.
HEAD_FIXES = {"sag": "raise the gains", "motion": "run until the joints settle, or slow down"}


COLUMNS = [ka.DRIVEN, ka.DRIVE_KIND, ka.SERVO_MODE, ka.SAMPLED]
# Parts of a distance by cause and joint; the cause "" is unexplained.
Parts = dict[str, dict[str, float]]


class DistanceCause(NamedTuple):
    """A cause of a distance: key of :data:`TEXTS`, its part of the distance, and the joints with the largest parts."""

    cause: str
    share: float
    joints: list[str]


def hand_chain(robot: Robot) -> list[int]:
    """Return the indices of the links between the root and the hand, the root first."""
    names, chain = [link.name for link in robot.links], [robot.attach(*robot.hand)[0]]
    while (parent := robot.links[chain[0]].parent) is not None:
        chain.insert(0, names.index(parent))
    return chain


def hand_reach(robot: Robot) -> float:
    """Return the length of the chain from the first joint to the hand, with sliders at their further limits [m]."""
    links = [robot.links[k] for k in hand_chain(robot)]
    lengths = [float(np.linalg.norm(link.p_PJ)) for link in links[1:]]
    sliders = [max(-link.lower, link.upper) for link in links if link.kind == "prismatic"]
    lengths += [length for length in sliders if np.isfinite(length)]
    return float(np.linalg.norm(robot.attach(*robot.hand)[1]) + sum(lengths))


def named_causes(parts: Parts) -> list[DistanceCause]:
    """Return the causes with a considerable part of a distance, largest first; empty if the causes are unknown."""
    known: Parts = defaultdict(dict, {cause: dict(joints) for cause, joints in parts.items() if cause})
    reaction = parts.get("contact", {})
    for joint, force in reaction.items():
        weight = known["sag"].get(joint, 0.0)
        both = force + weight
        # A smaller opposite contact force is the reaction of a brace to the weight; small sums count as the larger one.
        if force * weight < 0.0 and (abs(force) < abs(weight) or abs(both) < PART):
            larger = abs(force) < abs(weight)
            known["sag"][joint], known["contact"][joint] = (both, 0.0) if larger else (0.0, both)
    total = {cause: sum(joints.values()) for cause, joints in known.items()}
    unexplained = abs(1.0 - sum(total.values())) + sum(map(abs, parts.get("", {}).values()))
    large = [cause for cause in sorted(total, key=lambda cause: -total[cause]) if total[cause] >= PART]
    if unexplained > UNEXPLAINED or sum(total[cause] for cause in large) < EXPLAINED:
        return []
    if -sum(part for part in total.values() if part < 0.0) > OPPOSED:
        static = [cause for cause in total if cause in ("sag", "contact", "load")]
        if abs(1.0 - sum(total[cause] for cause in static)) > PART:
            return []
        large, joints = ["deflection"], {joint for cause in static for joint in known[cause]}
        known["deflection"] = {joint: sum(known[cause].get(joint, 0.0) for cause in static) for joint in joints}
    # Contacts would take over the forces of motors, stops, brakes and friction, in an unknown way.
    if {"limit", "stop", "friction", "brake"} & set(large) and sum(map(abs, reaction.values())) > OPPOSED:
        return []
    return [_cause(cause, known[cause]) for cause in large]


def _cause(cause: str, joints: dict[str, float]) -> DistanceCause:
    part = sum(joints.values())
    largest = sorted(((own, joint) for joint, own in joints.items() if joint), reverse=True)
    return DistanceCause(cause, round(part, 3), [joint for own, joint in largest if own >= NAMED * part])


def hand_causes(
    record: Record, prepared: Prepared, target: Array, estimate: Array | None = None, sensed: bool = False
) -> list[DistanceCause]:
    """Return the causes of the distance between the hand and its target (3,) [m] at the last sample.

    Parameters
    ----------
    record : Record
        Record of the run.
    prepared : Prepared
        Prepared run after its last step.
    target : (3,) ndarray
        Target of the hand [m].
    estimate : (3,) ndarray, optional
        For a robot with a free root: position of the hand that its controller computes from the references [m].
    sensed : bool, optional
        True if the commands of a robot with a free root correct all deflections, so that only limits are causes.
    """
    model, robot, q = prepared.model, prepared.model.robot, record["q"][-1]
    if not all(np.isfinite(record[name][-1]).all() for name in ("q", "v", "vdot", "contact_force")):
        return []

    def hand(at: Array) -> Array:
        return model.point_position(*robot.hand, at)

    position, chain = hand(q), hand_chain(robot)
    if robot.base is not None:
        chain = [k for k in chain if robot.joint_names[k] not in robot.base.wheels]
    error = position - target
    weight = error / (error @ error)  # its product with a displacement is a part of the distance
    loops = _loops(record, prepared, chain)
    parts: Parts = defaultdict(dict)
    # Coordinates are set to their references one group after the other: position loops, other joints, base.
    referenced = q.copy()
    places, motions = list(robot.position_index), _coupled_motions(model)
    for k, loop in loops.items():
        referenced[places] += motions[:, k] * (loop.reference - q[places[k]])
    nodes = [w * model.point_jacobian(*robot.hand, referenced + x * (q - referenced)) for x, w in NODES]
    rates = np.sum(nodes, axis=0)
    for k, loop in loops.items():
        moved = weight @ rates @ motions[:, k]
        for cause, share in loop.parts.items():
            parts[cause][robot.links[k].joint] = float(moved * share)
    if sensed:
        causes = [_cause(cause, parts[cause]) for cause in ("limit", "stop") if cause in parts]
        return [cause for cause in causes if cause.share >= PART]
    before = hand(referenced)
    parts[""]["curvature"] = float(weight @ (position - before)) - sum(sum(p.values()) for p in parts.values())
    if estimate is not None:
        parts["drift"][""] = float(weight @ (before - estimate))
        parts["reference"][""] = float(weight @ (estimate - target))
        return named_causes(parts)
    ends = (*robot.position_index[1:], len(q))
    for k in chain:
        if k not in loops and not any(motions[k, other] for other in loops):
            coordinates = slice(robot.position_index[k], ends[k])
            referenced[coordinates] = robot.initial[coordinates]
            before, then = hand(referenced), before
            parts["free"][robot.links[k].joint] = float(weight @ (then - before))
    if "base_target" in record:
        first, _ = base_row(robot)
        turn, at = base_coordinates(robot, record["base_target"][-1])
        referenced[first : first + 4] = 0.0, turn, *at
        before, then = hand(referenced), before
        parts["base"][""] = float(weight @ (then - before))
    parts["reference"][""] = float(weight @ (before - target))
    causes = named_causes(parts)
    weights = model.bias_forces(referenced, np.zeros(model.n)) @ motions
    for k, loop in loops.items():
        off = abs(float(q[robot.position_index[k]]) - loop.reference)
        # The joint may have left a posture in which its weight was larger.
        if causes and off > FAR and (causes[0].share < MAIN or loop.compliance * abs(weights[k]) > OPPOSED * off):
            return []
    return causes


def hand_distance(record: Record, prepared: Prepared, settle: float, begun: float) -> dict[str, Any]:
    """Return the errors of the hand [m] for the summary, see :func:`dynsim.record.measures.hand_error`, and causes.

    The error at the start is None if the samples begin after the start of the run ``begun`` [s].
    """
    errors: dict[str, Any] = hand_error(record, settle)
    if errors["hand_error_end_m"] is None:
        return errors
    if record.time[0] > begun:
        errors["hand_error_start_m"] = None
    robot = prepared.model.robot
    reach = recall("reach", lambda: hand_reach(robot), robot)
    target, causes = hand_target(record), list[DistanceCause]()
    if target is not None and errors["hand_error_end_m"] > _limit(EXAMINED, reach):
        causes = hand_causes(record, prepared, target[-1])
    return {**errors, "hand_error_causes": [cause._asdict() for cause in causes], "hand_reach_m": reach}


def off_target(summary: dict[str, Any], time: float, begun: float, from_start: bool) -> list[str]:
    """Warn of a hand far from its target at the start of a run or at its end ``time`` [s], with the causes.

    A run that continues another one at ``begun`` > 0 [s] does not jump. ``from_start`` is true if the path begins
    relative to the hand.
    """
    warnings = []
    start, end, reach = summary["hand_error_start_m"], summary["hand_error_end_m"], summary.get("hand_reach_m", 0.0)
    if start is not None and begun == 0.0 and start > _limit(START_LIMIT, reach):
        frame = "" if from_start else "use controller.hand.path.frame: start, or "
        warnings.append(
            f"hand: starts {_beyond(start, START_LIMIT, reach)} from its path and jumps there; "
            f"{frame}begin the path at the hand"
        )
    if end is not None and end > _limit(END_LIMIT, reach):
        causes = [DistanceCause(**cause) for cause in summary["hand_error_causes"]]
        warnings.append(f"hand: {_beyond(end, END_LIMIT, reach)} from its target at t = {time:.4g} s{because(causes)}")
    return warnings


def head_distance(record: Record, prepared: Prepared, blind: bool) -> None:
    """Add the causes of the distance between the head of a dynamic snake and its target to the summary of a record.

    A controller that is not ``blind``, i.e. that uses sensors, corrects deflections by its commands. Only limits can
    then cause a distance.
    """
    reach, distance = hand_reach(prepared.model.robot), record.summary["final_position_error_m"]
    causes = list[DistanceCause]()
    if distance > _limit(EXAMINED, reach):
        target, estimate = (record[name][-1, :3] for name in ("w_target", "w_estimate"))
        causes = hand_causes(record, prepared, target, estimate, not blind)
    record.summary["final_position_error_causes"] = [cause._asdict() for cause in causes]
    if distance > _limit(END_LIMIT, reach):
        far, time = _beyond(distance, END_LIMIT, reach), record.time[-1]
        record.summary["warnings"].append(
            f"head: {far} from its target at t = {time:.4g} s{because(causes, HEAD_FIXES)}"
        )


def _limit(share: float, reach: float) -> float:
    return max(share * reach, LEAST)


def _beyond(distance: float, share: float, reach: float) -> str:
    part = f", {100.0 * share:g} % of its reach" if share * reach > LEAST else ""
    return f"{1e3 * distance:.3g} mm (limit {1e3 * _limit(share, reach):.3g} mm{part})"


def because(causes: Sequence[DistanceCause], fixes: Mapping[str, str] | None = None) -> str:
    """Return the causes of a distance and the fix of the first one, as the end of a warning."""
    if not causes:
        return "; no single cause was identified; compare q with the references"
    texts = []
    for cause, share, joints in causes:
        text = TEXTS[cause][0].format(first_few(joints) or "several joints")
        texts.append(f"{text} ({100.0 * min(share, 1.0):.0f} %)")
    first = causes[0].cause
    return f", because of {' and '.join(texts)}; {(fixes or {}).get(first, TEXTS[first][1])}"


class _Loop(NamedTuple):
    """Position loop of a joint.

    Attributes
    ----------
    reference : float
        Reference [rad or m].
    compliance : float
        Deviation per torque or force, R/(K k_p) [rad/(N m) or m/N].
    parts : dict of str to float
        Parts of the deviation q − reference by cause [rad or m].
    """

    reference: float
    compliance: float
    parts: dict[str, float]


def _loops(record: Record, prepared: Prepared, chain: Sequence[int]) -> dict[int, _Loop]:
    """Return the position loops of the links in ``chain`` at the last sample, by index of the link."""
    model, system, time = prepared.model, prepared.system, float(record.time[-1])
    robot, drives, reference, balance = model.robot, system.drives, system.reference, prepared.balance
    q, v, vdot, current, voltage = (record[name][-1] for name in ("q", "v", "vdot", "current", "voltage"))
    places, still = list(robot.position_index), np.zeros(model.n)
    seen: Any = SimpleNamespace(
        joints=np.zeros((model.n, ka.JOINT_SIZE)), motors=np.zeros((len(drives.table), ka.MOTOR_STATE_SIZE))
    )
    seen.joints[:, ka.Q], seen.joints[:, ka.QD] = q[places], v
    evaluate_reference(drives, reference, time, seen)
    braked, motions = model.armature == ka.BRAKED, _coupled_motions(model)
    armature = np.where(braked, 0.0, model.armature)
    # Torques that the motors carry, by cause, (n,); motors also carry the torques of joints coupled to theirs.
    gravity = model.bias_forces(q, still) @ motions

    def moving_torques(q: Array, v: Array, vdot: Array) -> Array:
        whole = model.inverse_dynamics(q, v, vdot) + armature * vdot + model.damping * v
        return np.asarray((whole - model.bias_forces(q, still)) @ motions)

    moving = moving_torques(q, v, vdot)
    loads = [load for load in prepared.loads if len(load.coefficients)]
    carried, touched = load_torques(model, q, loads, time), np.zeros(model.n)
    for contact, force in zip(prepared.contacts, record["contact_force"][-1], strict=True):
        if force.any():
            touched -= contact_point(model, contact, q)[1].T @ force
    carried, touched = carried @ motions, touched @ motions
    stopped, rubbing = (-_by_joint(record, name) @ motions for name in ("stop_force", "joint_friction"))
    plan = _plan(prepared, seen, time, moving_torques)
    loops = {}
    for a, (k, kind, mode, sampled) in enumerate(drives.table[:, COLUMNS].tolist()):
        motor = drives.motor[a]
        servo = kind == ka.POSITION_SERVO and mode == ka.POSITION_MODE
        if not motions[chain, k].any() or not (servo or kind == ka.DC_MOTOR) or not motor[ka.K_P] > 0.0:
            continue
        if sampled == ka.GIVEN:
            wanted = seen.motors[a, ka.Q_REF]
            loops[k] = _Loop(wanted, 0.0, {"command": q[places[k]] - wanted})
            continue
        volts, ahead = motor[ka.RESISTANCE] / motor[ka.K_M], seen.motors[a, ka.V_REF] - v[k]
        asked = asked_of(drives, reference, time, seen, a)
        parts = {
            "sag": volts * gravity[k],
            "contact": volts * touched[k],
            "load": volts * carried[k],
            "stop": volts * stopped[k],
            "friction": volts * (rubbing[k] + (servo_drag(drives.motor, a, mode, v[k]) if servo else 0.0)),
            "motion": volts * moving[k] + voltage[a] - motor[ka.RESISTANCE] * current[a] - motor[ka.K_D] * ahead,
            "limit": asked - voltage[a],
        }
        # A motor at its limit is too weak, unless it pushes against a stop or a contact.
        beyond = 0.0 if braked[k] else parts["limit"]
        against = (
            "stop" if stopped[k] != 0.0 else max(parts, key=lambda cause: (cause != "limit") * parts[cause] * beyond)
        )
        if against in ("stop", "contact") and parts[against] * beyond > 0.0:
            parts[against] += beyond
            parts["limit"] = 0.0
        shift = 0.0
        if balance is not None:  # The shift of the reference balances static forces at the start.
            weight, load = volts * (model.bias_forces(robot.initial, still) @ motions)[k], 0.0
            if loads:
                load = volts * (load_torques(model, robot.initial, loads) @ motions)[k]
            drop = motor[ka.RESISTANCE] * balance.current[a]
            if len(reference.voltage):
                weight, drop = 0.0, load
            for cause, part in (("sag", weight), ("load", load), ("contact", drop - weight - load)):
                parts[cause] -= part
            shift = drop / motor[ka.K_P]
        for cause, part in plan.get(a, {}).items():
            parts[cause] -= part
        wanted = seen.motors[a, ka.Q_REF] - shift
        remainder = motor[ka.K_P] * (wanted - q[places[k]]) - sum(parts.values())
        # All other forces that act between the samples of a continuous controller are forces of ties and of the caller.
        others = robot.ties or len(loads) < len(prepared.loads)
        cause = "load" if others and not (robot.couplings or sampled or braked[k]) else ""
        parts[cause] = parts.get(cause, 0.0) + remainder
        if braked[k]:
            parts = _braked(parts)
        loops[k] = _Loop(wanted, volts / motor[ka.K_P], {cause: -part / motor[ka.K_P] for cause, part in parts.items()})
    return loops


def _plan(
    prepared: Prepared, seen: Any, time: float, moving_torques: Callable[[Array, Array, Array], Array]
) -> dict[int, dict[str, float]]:
    """Return the parts of the planned voltages at a time [s]: weight, motion and braces, by motor [V]."""
    model, drives, reference = prepared.model, prepared.system.drives, prepared.system.reference
    if not len(reference.voltage):
        return {}
    # Plans require a motor on every joint, and a stationary base.
    q, (v, after), joints = model.robot.initial.copy(), np.zeros((2, model.n)), drives.table[:, ka.DRIVEN]
    q[np.array(model.robot.position_index)[joints]] = seen.motors[:, ka.Q_REF]
    v[joints] = seen.motors[:, ka.V_REF]
    later: Any = SimpleNamespace(motors=seen.motors.copy())
    step = 1e-3 * float(reference.grid[1])
    evaluate_reference(drives, reference, time + step, later)
    after[joints] = later.motors[:, ka.V_REF]
    motor = drives.motor
    volts = motor[:, ka.RESISTANCE] / motor[:, ka.K_M]
    planned = np.array([fed_forward(reference.voltage, reference.grid, time, a, 0.0) for a in range(len(motor))])
    weight = volts * model.bias_forces(q, np.zeros(model.n))[joints]
    motion = volts * moving_torques(q, v, (after - v) / step)[joints] + motor[:, ka.K_M] * v[joints]
    # Motors whose references were replaced have no plan.
    used = [a for a in range(len(motor)) if reference.voltage[:, a].any()]
    if np.abs(planned - weight)[used].max(initial=0.0) <= SAME * np.abs(planned).max():
        motion[:] = 0.0  # a plan of the weight alone
    pressing = planned - weight - motion
    return {a: {"sag": weight[a], "motion": motion[a], "contact": pressing[a]} for a in used}


def _braked(parts: dict[str, float]) -> dict[str, float]:
    """Return the parts of a joint with a closed brake, which carries all forces that the motor does not balance.

    A brake that carries part of the static forces follows from them, as a brace does.
    """
    static = {cause: parts.pop(cause) for cause in ("sag", "contact", "load")}
    forces, brake = sum(static.values()), sum(parts.values())
    if brake * forces >= 0.0:
        return static | {"brake": brake}
    if abs(brake) > abs(forces):
        return {"brake": brake + forces}
    return {cause: part * (1.0 + brake / forces) for cause, part in static.items()}


def _coupled_motions(model: Model) -> Array:
    """Return the rates of all joints per rate of each joint, with the joints coupled to it, (n, n)."""
    motions, names = np.eye(model.n), model.joint_names
    for _ in model.robot.couplings:  # a leader may follow another joint
        for coupling in model.robot.couplings:
            motions[names.index(coupling.joint)] = coupling.ratio * motions[names.index(coupling.leader)]
    for coupling in model.robot.couplings:
        joint = names.index(coupling.joint)
        leader = int(np.flatnonzero(motions[joint])[0]) if motions[joint].any() else joint
        motions[:, joint] = motions[:, leader] / motions[joint, leader] if leader != joint else 0.0
    return motions


def _by_joint(record: Record, name: str) -> Array:
    """Return the last sample of a force signal for all joints, (n,), zero for joints without it."""
    values = np.zeros(len(record.labels["v"]))
    if name in record:
        values[[record.labels["v"].index(joint) for joint in record.labels[name]]] = record[name][-1]
    return values
