"""Motors and controllers of scenes, with gains that hold the arm and references that move it a little."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.random import Generator

from combinations.factors import PLANNED, SAMPLED, Levels
from combinations.plants import Joint, Plant
from dynsim import Model

# Controllers whose references are waypoints if the start requires references.
FOLLOWERS = ("hold", "waypoints", "hand_path", *SAMPLED, *PLANNED)


def motors(random: Generator, levels: Levels, robot: Plant) -> dict[str, dict[str, Any]]:
    """Return a motor for each motorised joint, with the joint name as key."""
    level = levels["motor"]
    if level == "none":
        return {}
    chosen = {joint.name: _motor(random, level, joint) for joint in robot.joints if joint.name != "base.right"}
    if level == "partly":
        # Braces can carry two joints without motors by friction alone.
        own = [joint.name for joint in robot.joints if joint.before and joint.name in chosen]
        for k in random.permutation(len(own)).tolist()[: 1 + int(random.integers(2))]:
            del chosen[own[k]]
    gear = float(random.uniform(0.05, 0.3)) if levels["rubbing"] in ("gear", "both") else 0.0
    for motor in chosen.values():
        if gear and motor["type"] != "torque":
            motor["coulomb_friction_N_m"] = gear
        elif motor["type"] in ("servo", "mx_28", "mx_106"):
            motor["coulomb_friction_N_m"] = 0.0
    return chosen


def _motor(random: Generator, level: str, joint: Joint) -> dict[str, Any]:
    if level == "torque":
        return {"type": "torque", "limit_N_m": 80.0}
    if level in ("servo", "velocity") and joint.turns:
        if level == "velocity":
            return {"type": "mx_28"}
        return {
            "type": "servo",
            "voltage_V": 12.0,
            "stall_torque_N_m": float(random.uniform(30.0, 60.0)),
            "no_load_speed_rad_per_s": 5.0,
            "k_p_V_per_rad": float(random.uniform(40.0, 120.0)),
            "rotor_inertia_kg_m2": 0.02,
            **({"current_limit_A": 12.0} if random.random() < 0.5 else {}),
        }
    if level in ("published", "partly") and joint.turns:
        return {"type": "wang_minami"}
    # The motor has the size of Maxon's RE 40 with a gear of 113:1; for a slide, it drives a spindle.
    return {
        "type": "dc",
        "torque_constant_N_m_per_A": 0.0302,
        "resistance_ohm": 0.299,
        "inductance_H": 8.23e-5,
        "rotor_inertia_kg_m2": 1.42e-5,
        "gear_ratio": 113.0 if joint.turns else 300.0,
        "gear_damping_N_m_s_per_rad": 3e-6,
        **({"voltage_limit_V": 24.0, "peak_current_A": 12.0} if level == "dc" else {}),
    }


def controller(
    random: Generator, levels: Levels, robot: Plant, driven: dict[str, dict[str, Any]], model: Model, duration: float
) -> dict[str, Any] | None:
    """Return the ``controller:`` section, or None without a controller."""
    level = levels["controller"]
    if level == "none":
        return None
    section: dict[str, Any] = {"type": "joint_pd", **_gains(random, levels, robot, driven)}
    moved = [joint for joint in robot.joints if joint.name in driven and not joint.name.startswith("base.")]
    if level in ("waypoints", "hand_path", "operator", "torques"):
        # Scenes that move joints without a motor are refused.
        moved = moved or [joint for joint in robot.joints if not joint.name.startswith("base.")]
    if level in SAMPLED:
        section["sample_time_s"] = float(random.choice((0.0005, 0.001)))
    if level == "torques":
        able = [joint.name for joint in moved if driven.get(joint.name, {}).get("type") == "torque"]
        section["torques"] = _torques(random, able or [moved[-1].name], model, duration)
    elif level == "gravity":
        section["feed_forward"] = str(random.choice(("gravity", "dynamics")))
    elif level == "pressing":
        # Either all declared points press, or only the elbow.
        alone = levels["start"] in ("on_surface", "on_references") and levels["points"] != "elbow"
        if random.random() < 0.5 and not alone:
            section["brace"] = "optimal"
        else:
            force = float(random.uniform(1.0, 8.0))
            # A third of the elbows press in the first part of the run only, half of these with the least heat.
            during = {"during_s": [[0.0, max(0.5 * duration, 0.2)]]}
            kinds: list[Any] = [during, {"force_N": force, **during}, *[force] * 4]
            section["brace"] = {"elbow": kinds[int(1e6 * force) % 6]}
    followed: list[Joint] = []
    if level == "hand_path":
        followed = _followers(random, levels, robot, moved)
        section["hand"] = {
            "joints": [joint.name for joint in followed],
            **_path(random, robot, followed, model, duration),
        }
        if levels["contact"] == "glued" and any(joint.before for joint in followed):
            section["hand"]["braces"] = ["elbow"]
    elif level == "operator":
        speed = random.uniform(-0.1, 0.1, size=3).tolist()
        section["operator"] = {
            "joints": [joint.name for joint in _followers(random, levels, robot, moved)],
            "commands": [{"at_s": 0.0, "hand": speed}, {"at_s": 0.5 * duration, "hand": [0.0, 0.0, 0.0]}],
        }
        if levels["plant"] == "mobile" and "base.left" in driven:
            section["operator"]["commands"][0]["base"] = [0.05, 0.1]
    moves = level in ("waypoints", *PLANNED) or (level in SAMPLED and random.random() < 0.7)
    if moves or (levels["start"] == "on_references" and level in FOLLOWERS):
        free = [joint for joint in moved if joint not in followed]
        if level != "waypoints":
            free = [joint for joint in free if driven[joint.name]["type"] != "torque"]
        section |= _waypoints(random, levels, free, duration)
    if level == "pressing":
        _ease(section.get("joints", {}), model)
    return section


def _gains(random: Generator, levels: Levels, robot: Plant, driven: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return gains for each DC motor, from soft to stiff, and softer if commands are held between samples."""
    sampled = levels["controller"] in SAMPLED
    stiff = float(10.0 ** random.uniform(-0.5, 0.3)) * (0.3 if sampled else 1.0)
    k_p: list[float] = []
    k_d: list[float] = []
    for joint in robot.joints:
        # Both wheels have the motor of the left wheel.
        motor = driven.get("base.left" if joint.name == "base.right" else joint.name)
        if motor is None or motor["type"] not in ("wang_minami", "dc"):
            continue
        p, d = (400.0, 12.0) if motor["type"] == "wang_minami" else (40.0, 1.5) if joint.turns else (1000.0, 20.0)
        k_p.append(stiff * p)
        k_d.append(stiff * d)
    if not k_p:
        return {}
    if len(set(k_p)) == 1:
        return {"k_p_V_per_rad": k_p[0], "k_d_V_s_per_rad": k_d[0]}
    return {"k_p_V_per_rad": k_p, "k_d_V_s_per_rad": k_d}


def _followers(random: Generator, levels: Levels, robot: Plant, moved: Sequence[Joint]) -> list[Joint]:
    """Return the joints that follow the hand: all, or only joints behind the elbow, without joints near a stop."""
    able = [joint for joint in moved if joint.name != "grip"]
    moved = [joint for joint in able if joint.name not in robot.limited] or able
    if levels["plant"] == "mimic":
        moved = [joint for joint in moved if joint.turns]
    behind = [joint for joint in moved if not joint.before]
    if levels["start"] == "on_references":
        # The last joint has waypoints.
        return moved[:-1] or moved
    return behind if behind and random.random() < 0.5 else moved


def _path(random: Generator, robot: Plant, followed: Sequence[Joint], model: Model, duration: float) -> dict[str, Any]:
    """Return a line that the joints can follow: it ends at the hand position after small turns of the joints.

    They may leave it in between, and more if the start moves joints that are not among them, and the hand with them.
    Every second line is relative to the start.
    """
    q = np.array(model.robot.initial)
    start = model.point_position(*robot.hand, q)
    index = {link.joint: int(k) for link, k in zip(model.robot.links, model.robot.position_index, strict=True)}
    share = 1.0
    # The joints turn in alternate directions, so that a planar arm stays bent.
    for k, joint in enumerate(followed):
        share = float(random.uniform(0.5, 1.0))
        q[index[joint.name]] += (0.02 if not joint.turns else 0.08) * (-1.0) ** k * share
    end = model.point_position(*robot.hand, q)
    path = {"type": "line", "from_m": start.tolist(), "to_m": end.tolist(), "duration_s": duration}
    if share < 0.75:  # without another draw, which would change the other scenes
        path |= {"frame": "start", "from_m": [0.0, 0.0, 0.0], "to_m": (end - start).tolist()}
    return {"path": path, "tolerance_m": 0.05}


def _waypoints(random: Generator, levels: Levels, free: Sequence[Joint], duration: float) -> dict[str, Any]:
    """Return waypoints of one or two joints, behind the elbow if the elbow is glued or placed on its surface."""
    held = levels["contact"] == "glued" or levels["start"] == "on_references" or levels["controller"] in PLANNED
    able = [joint for joint in free if not (held and joint.before)]
    if not able and levels["start"] == "on_references":
        able = list(free)
    # The joints rest if they would pull a pressing point off its surface.
    idle = levels["controller"] == "pressing" and levels["points"] in ("two", "same_link")
    joints: dict[str, Any] = {}
    for k in random.permutation(len(able)).tolist()[: 1 + int(random.integers(2))]:
        joint = able[k]
        scale = 1.0 if joint.turns else 0.002
        start = joint.start + (scale * float(random.uniform(1.0, 4.0)) if levels["start"] == "on_references" else 0.0)
        ways = [start, *(start + (0.0 if idle else scale) * random.uniform(-15.0, 15.0, size=2)).tolist()]
        key = "angles_deg" if joint.turns else "positions_m"
        joints[joint.name] = {"times_s": [0.0, 0.5 * duration, duration], key: ways}
    return {"joints": joints} if joints else {}


def _ease(joints: dict[str, Any], model: Model) -> None:
    """Shorten paths until the motors can follow, because a plan beyond their limits is refused.

    Half of each limit is reserved for the forces of braces and the weight of payloads.
    """
    from scipy.interpolate import CubicSpline

    if not joints:
        return
    links, motors = list(model.robot.links), {motor.joint: motor for motor in model.robot.motors}
    own = [motors[link.joint] for link in links]
    constant, resistance, volts, amperes = (
        np.array([getattr(motor, key) for motor in own])
        for key in ("joint_constant", "resistance", "voltage_limit", "current_limit")
    )
    rate = {link.joint: k for k, link in enumerate(links)}
    ways = {name: next(key for key in ("angles_deg", "positions_m") if key in path) for name, path in joints.items()}
    for _ in range(10):
        paths = {
            name: CubicSpline(path["times_s"], path[ways[name]], bc_type="clamped") for name, path in joints.items()
        }
        most = 0.0
        for t in np.linspace(0.0, next(iter(joints.values()))["times_s"][-1], 21):
            q, v, vdot = np.array(model.robot.initial), np.zeros(model.n), np.zeros(model.n)
            for name, path in paths.items():
                unit = np.pi / 180.0 if ways[name] == "angles_deg" else 1.0
                k = rate[name]
                q[model.robot.position_index[k]], v[k], vdot[k] = (unit * float(path(t, order)) for order in range(3))
            torque = (model.mass_matrix(q) + np.diag(model.armature)) @ vdot + model.bias_forces(q, v)
            current = (torque + model.damping * v) / constant
            voltage = resistance * current + constant * v
            most = max(most, float((np.abs(current) / amperes).max()), float((np.abs(voltage) / volts).max()))
        if most <= 0.5:
            return
        for name, path in joints.items():
            first = path[ways[name]][0]
            path[ways[name]] = [first + 0.5 * (value - first) for value in path[ways[name]]]


def _torques(random: Generator, joints: Sequence[str], model: Model, duration: float) -> dict[str, Any]:
    """Return torques that hold the weight, plus a wave about them that presses and lifts."""
    weight = model.bias_forces(np.array(model.robot.initial), np.zeros(model.n))
    rates = {link.joint: i for i, link in enumerate(model.robot.links)}
    torques: dict[str, Any] = {}
    for name in joints:
        carried = float(weight[rates[name]])
        wave = float(random.uniform(-1.0, 1.0)) * (0.3 + 0.5 * abs(carried))
        values = [carried + wave, carried, carried - wave]
        torques[name] = {"times_s": [0.0, 0.5 * duration, duration], "torques_N_m": values}
    return torques
