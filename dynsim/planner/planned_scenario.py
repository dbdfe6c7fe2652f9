"""Plan as a runnable scenario: initial posture, joint references, brace forces and gains."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dynsim.compile.control import MovedPath
from dynsim.model.description import Array
from dynsim.planner.dense import Dense
from dynsim.planner.problem import OF_OBJECTS, Candidate, Task, contact_names, without_objects
from dynsim.record.urdf_text import roll_pitch_yaw
from dynsim.scenario import Scenario
from dynsim.scenario.reading import scenario_from_resolved

# Number of decimal places of the waypoints, which makes the hand accurate to a nanometre.
DIGITS = 10
# Gain of joints that do not press any brace [V/rad], and fraction of the largest lever arm below which a joint counts
# as such.
STIFF, FREE = 500.0, 0.05
# Number of instants at which lever arms are compared.
SAMPLES = 12
# Keys of the controller that a plan replaces.
REPLACED = (
    "hand",
    "joints",
    "torques",
    "feed_forward",
    "brace",
    "min_N",
    "operator",
    "k_p_V_per_rad",
    "k_d_V_s_per_rad",
)
# Keys of the contacts that a plan does not need, or that only the bilateral law has.
DROPPED = ("slip_smoothing_m_s", "pulling_friction", "reference_tolerance_m")


def method(task: Task) -> str:
    """Return the integration method for plans.

    If several braces stick at the turning points of a path, an event-driven method may open and close them endlessly.
    The heats of both methods agree to 1e-4. A mobile base requires an event-driven method, which detects tipping.
    """
    return "time_stepping" if task.arm.model.robot.base is None else "auto"


def damping_gain(k_p: float) -> float:
    """Return k_d [V s/rad] for k_p [V/rad], scaled from the gains of the published arm (k_p 500, k_d 20) by √k_p."""
    return 20.0 * float(np.sqrt(k_p / 500.0))


def stiffness_gains(task: Task, braces: tuple[Candidate, ...], dense: Dense, k_p: float) -> Array:
    """Return k_p of each moved joint, shape (n,): ``k_p`` for joints that press braces, otherwise at least STIFF.

    A joint that moves no brace along the normal tolerates any surface error at any stiffness. Examples are the yaw
    joint of an arm on a floor, and joints beyond the last brace. With low gains these joints would not hold the hand in
    place.
    """
    if not braces:
        return np.full(task.arm.n, k_p)
    problem, none = task.problem(braces, 1), np.zeros((1, len(braces)))
    pressing = np.zeros(task.arm.n)
    for t in range(0, len(dense.q), max(len(dense.q) // SAMPLES, 1)):
        problem.evaluate(dense.q[t : t + 1].copy(), none)
        rates = np.abs(problem.work.gap_rate[0, dense.acting(t)])
        pressing = np.maximum(pressing, (rates / rates.max(axis=1, keepdims=True)).max(axis=0, initial=0.0))
    return np.where(pressing > FREE, k_p, max(k_p, STIFF))


def stiffness(task: Task, braces: tuple[Candidate, ...], dense: Dense, k_p: float) -> Array:
    """Return the stiffness of each moved joint under PD control, K_m k_p/R, shape (n,) [N m/rad or N/m]."""
    constants = [motor.joint_constant / motor.resistance for motor in task.arm.motors]
    return stiffness_gains(task, braces, dense, k_p) * np.array(constants)


def shared_sections(task: Task) -> dict[str, Any]:
    """Return the part that all plans of a scenario share: the scenario without the keys that plans replace.

    Objects are omitted, because planned voltages require a motor on every joint.
    """
    data, alone = dict(task.scenario.resolved), without_objects(task.scenario).config
    links = {"self", "links", *task.arm.model.robot.bodies}
    data.pop("objects", None)
    for section in OF_OBJECTS.keys() & data.keys():
        data[section] = {name: part for name, part in data[section].items() if name in getattr(alone, section)}
    data["name"] = f"{task.scenario.name}_plan"
    data.pop("variant", None)
    hand = {key: value for key, value in data["controller"]["hand"].items() if key in ("path", "orientation")}
    if hand["path"].get("frame") == "start" and isinstance(task.path, MovedPath):  # the plan has another start
        hand["path"] = hand["path"] | {"frame": "world", "origin_m": task.path.origin.tolist()}
        if task.turn is not None:
            hand["orientation"] = {"rpy_deg": np.rad2deg(roll_pitch_yaw(task.turn)).tolist()}
    controller = {key: value for key, value in data["controller"].items() if key not in REPLACED}
    data["controller"] = controller | {"hand": hand | {"joints": []}}
    contacts = {key: value for key, value in data["contacts"].items() if key not in DROPPED}
    data["contacts"] = contacts | {"law": "unilateral", "candidates": "points", "points": {}}
    between = [
        entry | {"ignore": [pair for pair in entry.get("ignore", ()) if links.issuperset(pair)]}
        for entry in contacts.get("between", ())
        if entry["bodies"] == "self" or links.issuperset(entry["bodies"])
    ]
    if between:
        data["contacts"]["between"] = between
    else:
        data["contacts"].pop("between", None)
    data["integrator"] = {"method": method(task)}
    data.pop("initial", None)
    return data


def plan_sections(task: Task, braces: tuple[Candidate, ...], dense: Dense, k_p: float) -> dict[str, Any]:
    """Return the sections of one plan."""
    arm = task.arm
    joints = {}
    for name, link, column in zip(arm.joints, arm.links, dense.q.T, strict=True):
        angular = arm.model.robot.links[link].units[0] == "rad"
        values = np.round(np.rad2deg(column) if angular else column, DIGITS).tolist()
        joints[name] = {
            "times_s": np.round(dense.times, DIGITS).tolist(),
            "angles_deg" if angular else "positions_m": values,
            **({} if dense.rests else {"ends": "free"}),
        }
    own = dict(zip(arm.joints, stiffness_gains(task, braces, dense, k_p).tolist(), strict=True))
    gains = [own.get(motor.joint, STIFF) for motor in arm.model.robot.motors]
    damping = [round(damping_gain(gain), 4) for gain in gains]
    controller: dict[str, Any] = {
        "k_p_V_per_rad": gains if len(set(gains)) > 1 else k_p,
        "k_d_V_s_per_rad": damping if len(set(damping)) > 1 else damping[0],
        "joints": joints,
    }
    names, schedule = contact_names(braces), dense.schedule
    initial: dict[str, Any] = {"on_references": True}
    if braces:
        during = [task.intervals(schedule, brace) for brace in braces]
        times = {name: {"during_s": np.round(part, DIGITS).tolist()} for name, part in zip(names, during, strict=True)}
        controller |= {"brace": times if schedule.borders else "optimal", "min_N": task.options.min_N}
        initial["on_surface"] = [name for name, part in zip(names, during, strict=True) if part[0][0] == 0.0]
    else:
        controller["feed_forward"] = "dynamics"
    points = {
        name: {
            "body": brace.body,
            "point_m": list(brace.point_m),
            "surface": brace.surface,
            **({"radius_m": brace.radius} if brace.radius else {}),
        }
        for name, brace in zip(names, braces, strict=True)
    }
    return {"controller": controller, "contacts": {"points": points}, "initial": initial}


def scenario(
    task: Task,
    braces: tuple[Candidate, ...],
    dense: Dense,
    k_p: float,
    variant: str = "",
    more: Mapping[str, Any] | None = None,
) -> Scenario:
    """Return the plan as a scenario; ``more`` contains additional sections."""
    shared, own = shared_sections(task), plan_sections(task, braces, dense, k_p)
    return scenario_from_resolved(
        {
            **shared,
            **({"variant": variant} if variant else {}),
            "controller": shared["controller"] | own["controller"],
            "contacts": shared["contacts"] | own["contacts"],
            "initial": own["initial"],
            **(more or {}),
        }
    )
