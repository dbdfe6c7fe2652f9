"""Checks of a scene's runs that share no code with the kernels: properties of every record, and agreement of methods.

Each check is a function of a record (:class:`combinations.observed.Observed`) and yields a sentence about the worst
sample. A comment next to each tolerance explains its value.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from combinations.agreement import disagreements
from combinations.commands import commands
from combinations.contact_law import CREEP, dry, friction, gaps, stops, touching
from combinations.energy import ledger, losses, powers
from combinations.newton import circuit, equation, momentum, motion, support, wrench
from combinations.observed import Observed, warned
from combinations.running import Run
from combinations.sentences import JUMPS, MOVED, OTHER_FORCES, SLIPS_AT_START, UNSTABLE, WEDGED
from combinations.verdicts import untrue, untrue_start
from dynsim.errors import SimulationStopped
from dynsim.model.drives import Motor, Servo
from dynsim.scenario import build

# A start within a micrometre of a surface is projected onto it; this moves the first sample.
START = 1e-5
# A force above this multiple of weight, loads and motor torques at a lever of 5 cm is absurd.
ABSURD, LEVER_M = 1e6, 0.05
# Rates above which rounding of positions spoils derived quantities; only unstable loops get there [rad/s, m/s].
ROUNDED = 1e9
# Signals that may be NaN because they divide by a load that may be zero.
MAY_BE_NAN = ("center_of_pressure", "traction_demand")


@dataclass(frozen=True)
class Problem:
    """A fault of a run.

    ``kind`` : the check, in a word; ``detail`` : a sentence with name, time and numbers
    """

    kind: str
    detail: str


Array = NDArray[np.float64]
Finding = Iterator[str]


def problems(scenario: Mapping[str, Any], run: Run) -> list[Problem]:
    """Return all problems of a run; each check reports its worst sample."""
    listed = [Problem("check", text) for text in started_as_checked(run)]
    if run.record is None or run.resolved is None:
        return listed
    listed += [Problem("finite", text) for text in finite(run)]
    if isinstance(run.error, SimulationStopped) and not len(run.record):
        listed += [Problem("verdict", text) for text in untrue_start(run.error, Observed(run))]
    if listed or not len(run.record) or "vdot" not in run.record:
        return listed
    seen = Observed(run)
    if not (np.abs(seen.v).max(initial=0.0) > ROUNDED and UNSTABLE in str(run.error)):
        for name, check in CHECKS.items():
            listed += [Problem(name, text) for text in check(seen)]
    listed += [Problem("verdict", text) for text in untrue(scenario, run, seen)]
    return listed


def compare(scenario: Mapping[str, Any], runs: Mapping[str, Run]) -> list[Problem]:
    """Return the differences of runs of one scene by several methods, solvers and ways that exceed their limits."""
    return [Problem(kind, text) for kind, text in disagreements(scenario, runs)]


def started_as_checked(run: Run) -> Finding:
    """Check that ``check`` refuses a scene if and only if it does not start."""
    if run.begun and run.checked is not None:
        yield f"check refuses what runs: {run.checked[:200]}"
    if not run.begun and run.checked is None:
        yield f"check passes what does not start: {str(run.error)[:200]}"


def finite(run: Run) -> Finding:
    """Check that all signals are finite, except signals that may be NaN."""
    assert run.record is not None
    for name in run.record:
        data = np.asarray(run.record[name], dtype=np.float64)
        if name not in MAY_BE_NAN and not np.isfinite(data).all():
            rows = np.argwhere(~np.isfinite(data.reshape(len(data), -1)))
            yield f"{name} is not finite, first in sample {rows[0, 0]}"


def _starts_softly(seen: Observed) -> bool:
    """Whether the plant is a dynamic snake that has settled before the run."""
    plant = seen.config["plant"]
    return "dynamics" in plant and plant["dynamics"].get("start", "soft") == "soft"


def start(seen: Observed) -> Finding:
    """Check that the first sample is the requested posture, at rest."""
    # A soft start settles into another posture.
    if seen.time[0] != 0.0 or _starts_softly(seen):
        return
    asked = build.unposed(seen.scenario).initial
    initial = seen.config.get("initial") or {}
    free = np.zeros(len(asked), dtype=bool)
    places = dict(zip(seen.joints, seen.bodies.places, strict=True))
    if initial.get("on_references"):
        for joint, path in ((seen.config.get("controller") or {}).get("joints") or {}).items():
            key = next((key for key in path if key.startswith(("angles_", "positions_"))), None)
            if key is not None and joint in places:
                first = float(path[key][0])
                asked[places[joint]] = np.radians(first) if key.endswith("deg") else first
            elif joint in places:
                free[places[joint]] = True
        for coupling in seen.robot.couplings:
            asked[places[coupling.joint]] = coupling.ratio * asked[places[coupling.leader]] + coupling.offset
    # An equilibrium compresses compliant contacts, and moves bodies and joints no further than that needs, or with a
    # warning.
    deepest, allowed = 0.0, START
    if initial.get("equilibrium"):
        deepest = max((-float(t.gap[0]) for t in seen.touches() if t.contact.stiffness > 0.0), default=0.0)
        allowed += _pressed_by(seen)
    warned_of = np.zeros_like(free)
    for warning in seen.run.warnings:
        if (moved := re.match(MOVED, warning)) is not None:
            for joint, index in places.items():
                warned_of[index] = warned_of[index] or f"{joint} by " in moved[1]
    free |= warned_of
    if initial.get("on_surface"):
        kept = [places[joint] for joint in initial.get("keep", []) if joint in places]
        free[:] = True
        free[kept] = False
        for touch in seen.touches():
            presses = START + max(deepest, 0.0) if touch.contact.stiffness > 0.0 else START
            if touch.contact.name in initial["on_surface"] and abs(touch.gap[0]) > presses:
                yield f"{touch.contact.name} starts {touch.gap[0]:+.3g} m from its surface, not on it"
    off = np.where(free, 0.0, np.abs(seen.q[0] - asked))
    if off.max(initial=0.0) > allowed:
        k = int(off.argmax())
        name = seen.record.labels["q"][k]
        yield f"{name} starts at {seen.q[0, k]:.6g}, asked for {asked[k]:.6g}"
    # Compare with the posture of the resolved scenario, in which points have been placed on surfaces.
    off = np.where(warned_of, 0.0, np.abs(seen.q[0] - seen.robot.initial))
    if off.max(initial=0.0) > allowed:
        k = int(off.argmax())
        yield f"{seen.record.labels['q'][k]} starts at {seen.q[0, k]:.6g}, the scenario has {seen.robot.initial[k]:.6g}"
    fastest = float(np.abs(seen.v[0]).max(initial=0.0))
    # Bodies that start on their surfaces are at rest; an impact at the start could only reduce velocities.
    if fastest > CREEP:
        yield f"{seen.joints[int(np.abs(seen.v[0]).argmax())]} starts with a rate of {fastest:.3g}, not at rest"


def _pressed_by(seen: Observed) -> float:
    """Return how far joints may move to press compliant contacts in as deep as they begin [rad or m].

    To first order the least displacement d changes the gaps g of contacts that touch by J d = g − g_0. J changes on the
    way, on a ball of 3 cm within millimetres: a step is good if gaps change by half of J d, so that 2 d may be needed.
    """
    if all(touch.contact.stiffness == 0.0 for touch in seen.touches()):
        return 0.0
    motion = seen.bodies.motion(seen.robot.initial[None], *np.zeros((2, 1, len(seen.joints))))
    rows, before, after = [], [], []
    for touch in seen.touches():
        body, centre, far, normal = seen.nearest_point(touch.contact, motion)
        position = centre - touch.contact.radius * normal
        rows.append(normal[0] @ seen.bodies.jacobian(motion, body, position)[0])
        before.append(far[0] - touch.contact.radius)
        after.append(touch.gap[0])
    J, gaps, ends = np.array(rows), np.array(before), np.array(after)
    kept = ends <= START
    # Contacts that end open may have to be lifted, but no further than until they touch.
    ends[~kept] = 0.0
    while kept.any():
        least = np.linalg.lstsq(J[kept], (ends - gaps)[kept], rcond=1e-10)[0]
        pressed = np.where(kept, 0.0, gaps + J @ least)
        if pressed.min() >= -START:
            return 2.0 * float(np.abs(least).max())
        kept[pressed.argmin()] = True
    return 0.0


def equilibrium(seen: Observed) -> Finding:
    """Check that a scene which starts in equilibrium does not accelerate."""
    initial, controller = seen.config.get("initial") or {}, seen.config.get("controller") or {}
    if not initial.get("equilibrium") or seen.time[0] != 0.0:
        return
    if any(not isinstance(motor, Motor) for motor in seen.robot.motors) and (
        controller.get("joints") or controller.get("hand")
    ):
        return
    # Planned voltages include the initial acceleration of the references.
    planned = controller.get("feed_forward") == "dynamics" or controller.get("brace")
    if planned and (controller.get("joints") or controller.get("hand")):
        return
    # References and torques that jump at the start are reported by a warning.
    if warned(seen, JUMPS) or warned(seen, SLIPS_AT_START):
        return
    # Wedged points may rest or leave: in the run they leave, and a warning reports it.
    if warned(seen, OTHER_FORCES):
        return
    size = np.abs(seen.vdot[0])
    # The limit is far below the acceleration of a falling joint.
    allowed = 1e-4 * (1.0 + float(np.linalg.norm(seen.bodies.gravity))) + _misread(seen)
    if seen.stepped and len(seen) > 2 and _begins_to_move(seen):
        # This is the mean of the first step; if references begin to move, the next mean is up to three times as large.
        allowed = max(allowed, 0.7 * float(np.abs(seen.vdot[2]).max(initial=0.0)), _led(seen))
    if size.max(initial=0.0) > allowed:
        yield f"{seen.joints[int(size.argmax())]} starts with an acceleration of {size.max():.3g}, from equilibrium"


def _begins_to_move(seen: Observed) -> bool:
    """Whether references or loads may change in the first steps."""
    controller = seen.config.get("controller") or {}
    if any(controller.get(key) for key in ("joints", "hand", "operator", "torques")):
        return True
    return any(np.ptp(load.components(seen.time[:3]), axis=0).any() for load in seen.loads)


def _misread(seen: Observed) -> float:
    """Return the largest acceleration from encoder errors at the start."""
    encoders = (seen.config.get("sensors") or {}).get("encoders") or {}
    angle = np.radians(0.5 * encoders.get("resolution_deg", 0.0) + 6.0 * encoders.get("noise_deg", 0.0))
    if not angle:
        return 0.0
    controller = seen.config.get("controller") or {}
    gains = np.broadcast_to(controller.get("k_p_V_per_rad", 0.0), len(seen.robot.motors))
    servos = [motor.k_p if isinstance(motor, Servo) else 0.0 for motor in seen.robot.motors]
    # Errors have any signs.
    return float((np.abs(_mobility(seen)) @ _jolts(seen, gains * angle, np.multiply(servos, angle))).max())


def _led(seen: Observed) -> float:
    """Return the largest acceleration from an operator at the start.

    From the first tick on references have a rate, the least with which the joints follow the hand's target; commands of
    motors jump by its multiple k_d.
    """
    controller = seen.config.get("controller") or {}
    operator = controller.get("operator")
    if not operator or not operator.get("joints") or seen.robot.hand is None or seen.robot.base is not None:
        return 0.0
    target, columns = seen.record["target_position"], [seen.joints.index(joint) for joint in operator["joints"]]
    body, point = seen.robot.attach(*seen.robot.hand)
    J = seen.bodies.jacobian(seen.motion, body, seen.motion.point(body, point))[0]
    rates = np.zeros(len(seen.joints))
    speed = (target[1] - target[0]) / (seen.time[1] - seen.time[0])
    rates[columns] = np.linalg.lstsq(J[:, columns], speed, rcond=1e-10)[0]
    gains = np.broadcast_to(controller.get("k_d_V_s_per_rad", 0.0), len(seen.robot.motors))
    driven = np.array([rates[seen.joints.index(motor.joint)] for motor in seen.robot.motors])
    return float(np.abs(_mobility(seen) @ _jolts(seen, gains * driven, np.zeros(len(gains)))).max())


def _mobility(seen: Observed) -> Array:
    """Return the accelerations of unit torques at the start, (n, n)."""
    return np.asarray(np.linalg.pinv(seen.bodies.mass_matrix(seen.robot.initial)))


def _jolts(seen: Observed, commands_V: Array, servos_V: Array) -> Array:
    """Return the torques (n,) if commands of motors and voltages of servos jump by so much at the start, (na,).

    Servos pass voltages on without a delay. Circuits follow with L/R, of which the first time step sees a part.
    """
    torques = np.zeros(len(seen.joints))
    for motor, command, servo in zip(seen.robot.motors, commands_V, servos_V, strict=True):
        if isinstance(motor, Servo):
            voltage, share = servo, 1.0
        elif isinstance(motor, Motor) and seen.stepped:
            voltage, share = command, min(seen.step * motor.resistance / motor.inductance, 1.0)
        else:
            continue
        torques[seen.joints.index(motor.joint)] += share * motor.joint_constant * voltage / motor.resistance
    return torques


def absurd(seen: Observed) -> Finding:
    """Check that weight, loads, motors and motion can explain the size of all forces."""
    weight = sum(link.inertia.mass for link in seen.bodies.robot.links)
    size = weight * (np.linalg.norm(seen.bodies.gravity) + 1.0)
    size += sum(
        float(np.linalg.norm(load.components(seen.time)[:, :3], axis=1).max(initial=0.0)) for load in seen.loads
    )
    size += float(np.abs(seen.driven_torques(seen.record["current"], seen.v)).sum(axis=1).max(initial=0.0)) / LEVER_M
    for name in ("contact_normal_force", "stop_force", "joint_friction", "tie_force"):
        if name not in seen.record or not seen.record[name].size:
            continue
        # A contact that wedges itself may have a force of any size.
        if name == "contact_normal_force" and warned(seen, WEDGED):
            continue
        most = float(np.abs(seen.record[name]).max())
        if most > ABSURD * size:
            yield f"{name} reaches {most:.3g}, but weight, loads and motors only {size:.3g}"
    # Scenes of a few kilograms do not reach such speeds, unless motors without a limit follow an unstable loop.
    if warned(seen, UNSTABLE):
        return
    if np.abs(seen.v).max(initial=0.0) > 1e5 or np.abs(seen.q).max(initial=0.0) > 1e6:
        yield f"rates reach {np.abs(seen.v).max():.3g}, positions reach {np.abs(seen.q).max():.3g}"


CHECKS: dict[str, Callable[[Observed], Finding]] = {
    "start": start,
    "equilibrium": equilibrium,
    "equation": equation,
    "momentum": momentum,
    "motion": motion,
    "circuit": circuit,
    "support": support,
    "wrench": wrench,
    "touching": touching,
    "friction": friction,
    "gaps": gaps,
    "stops": stops,
    "dry": dry,
    "ledger": ledger,
    "losses": losses,
    "powers": powers,
    "commands": commands,
    "absurd": absurd,
}
