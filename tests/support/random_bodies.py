"""Random scenes of bodies that touch each other, their invariants, and the contact problems that were hard to solve.

    PYTHONPATH=.:tests python -m support.random_bodies FIRST COUNT FILE

appends a line of JSON for each scene to FILE, and the problems above a bound to FILE with the ending ``npz``.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.random import Generator

from dynsim import Simulation, load_scenario
from dynsim.dynamics import tables as ka
from dynsim.errors import DynsimError
from dynsim.integrators.stepping import tables as kt

STEP_S, G = 1e-3, 9.81
# Initial velocity [m/s] and angular velocity [rad/s] of each object.
Motions = Mapping[str, tuple[Sequence[float], Sequence[float]]]


@dataclass
class Result:
    """Result of a scene.

    The residual of the ledger is relative to the energy of the objects, because a stack at rest has no turnover; the
    change of momentum is relative to the sum of the largest momenta of all objects.
    """

    seed: int
    kind: str
    bodies: int
    solves: int = 0
    long_solves: int = 0
    dropped: int = 0
    capped: int = 0
    residual: float = 0.0
    above_fair: int = 0
    ledger: float = 0.0
    momentum: float = 0.0
    depth: float = 0.0
    depth_bound: float = 0.0
    pressed: bool = False
    stopped: str = ""
    problems: list[dict[str, Any]] = field(default_factory=list, repr=False)


def faults(result: Result) -> list[str]:
    """Return the invariants that a result violates."""
    checks = {
        f"stopped: {result.stopped}": bool(result.stopped),
        f"ledger {result.ledger:.1e} of the energy": not result.ledger <= 1e-12,
        f"momentum {result.momentum:.1e}": not result.momentum <= 1e-12,
        f"depth {result.depth:.2e} m, bound {result.depth_bound:.2e} m": not result.depth <= result.depth_bound,
        f"residual {result.residual:.1e} m/s": not result.residual <= kt.BAD,
    }
    return [text for text, failed in checks.items() if failed]


def settings(seed: int) -> tuple[str, dict[str, Any], Motions]:
    """Return the kind of a scene, its scenario, and the motions of its objects."""
    rng = np.random.default_rng(seed)
    kind = str(rng.choice(["free", "floor", "stack", "arm"], p=[0.3, 0.3, 0.2, 0.2]))
    count = int(rng.integers(2, 7))
    law: dict[str, Any] = {"law": "unilateral", "friction": float(rng.uniform()) if rng.random() < 0.8 else 0.0}
    if rng.random() < 0.2:
        law |= {"stiffness_N_per_m": float(10 ** rng.uniform(4, 6)), "damping_N_s_per_m": float(rng.uniform(0, 100))}
    elif rng.random() < 0.6:
        law["restitution"] = float(rng.choice([rng.uniform(), 1.0], p=[0.85, 0.15]))
    if rng.random() < 0.2:
        law["static_friction"] = law["friction"] + float(rng.uniform(0, 0.3))
    plant: dict[str, Any] = {
        "type": "serial_arm",
        "chain": [{"axis": "y", "length_m": 0.1, "mass_kg": 0.1}],
        "base": {"position_m": [0, 0, 9]},
    }
    between: list[dict[str, Any]] = [{"bodies": ["objects", "objects"]}]
    if kind == "arm":
        plant["chain"] = _arm(rng)
        plant["base"]["position_m"] = [0, 0, float(rng.uniform(0.4, 1.0))]
        between += [{"bodies": ["links", "objects"]}, {"bodies": "self"}]
        count = min(count, 4)
    if kind == "free":
        plant["gravity_m_s2"] = [0, 0, 0]
    objects, motions = (_stack if kind == "stack" else _crowd)(rng, kind, count)
    scenario = {
        "plant": plant,
        "objects": objects,
        "contacts": law | {"between": between},
        "integrator": {"method": "time_stepping", "step_s": STEP_S, "wall_limit_s": 60},
        "record": {"rate_hz": 1000},
        "duration_s": float(rng.uniform(0.5, 1.0)),
    }
    if kind != "free":
        scenario["surfaces"] = {"floor": {"type": "plane"}}
    return kind, scenario, motions


def _arm(rng: Generator) -> list[dict[str, Any]]:
    """Return the links of a limp arm that folds under its weight."""
    radius, n = float(rng.uniform(0.01, 0.03)), int(rng.integers(3, 7))
    return [
        {
            "axis": str(rng.choice(["y", "z"])) if k and rng.random() < 0.3 else "y",
            "length_m": float(rng.uniform(0.1, 0.25)),
            "mass_kg": float(rng.uniform(0.1, 0.5)),
            "radius_m": radius,
            "initial_deg": float(rng.uniform(-60, 60)),
            "damping_N_m_s_per_rad": float(10 ** rng.uniform(-3, -1)),
        }
        for k in range(n)
    ]


def _body(rng: Generator) -> tuple[dict[str, Any], float]:
    """Return a body and the radius of the sphere about it."""
    shape, mass = rng.choice(["sphere", "cylinder", "box"], p=[0.35, 0.25, 0.4]), float(10 ** rng.uniform(-1, 0.5))
    if shape == "box":
        size = rng.uniform(0.04, 0.15, 3)
        return {"size_m": size.tolist(), "mass_kg": mass}, float(0.5 * np.linalg.norm(size))
    radius = float(rng.uniform(0.02, 0.06))
    if shape == "sphere":
        return {"shape": "sphere", "radius_m": radius, "mass_kg": mass}, radius
    length = float(rng.uniform(2.2, 5)) * radius
    return {"shape": "cylinder", "radius_m": radius, "length_m": length, "mass_kg": mass}, 0.5 * length


def _crowd(rng: Generator, kind: str, count: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return bodies near each other that fly at their middle, or fall on the floor."""
    objects, motions, taken = {}, {}, list[tuple[np.ndarray, float]]()
    middle = np.array([0.0, 0.0, 0.0 if kind == "free" else 0.15])
    if kind == "arm":
        middle = np.array([float(rng.uniform(0.2, 0.5)), 0.0, 0.2])
    for k in range(count):
        body, bound = _body(rng)
        spread = 0.1
        while True:
            centre = middle + spread * rng.normal(size=3)
            free = kind == "free" or centre[2] > bound + 1e-3
            if kind == "arm":  # below the arm's base, outside the reach of its posture at the start
                free = free and centre[2] < 0.2
            if free and all(np.linalg.norm(centre - c) > bound + r + 1e-3 for c, r in taken):
                break
            spread *= 1.02
        taken.append((centre, bound))
        speed = float(rng.uniform(0, 2))
        toward = (middle - centre) / max(float(np.linalg.norm(middle - centre)), 1e-9)
        velocity = speed * toward + 0.3 * rng.normal(size=3)
        spin = float(rng.choice([0.0, 10.0])) * rng.normal(size=3)
        objects[f"b{k}"] = body | {"position_m": centre.tolist(), "rpy_deg": rng.uniform(-180, 180, 3).tolist()}
        motions[f"b{k}"] = velocity.tolist(), spin.tolist()
    return objects, motions


def _stack(rng: Generator, kind: str, count: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return boxes, or spheres in the end, one on the other; every other stack at rest."""
    objects, motions, height = {}, {}, 0.0
    still = bool(rng.random() < 0.5)
    for k in range(count):
        mass = float(10 ** rng.uniform(-1, 0.5))
        gap = 0.0 if still else float(rng.uniform(0, 0.02))
        offset = rng.uniform(-0.02, 0.02, 2).tolist()
        if k == count - 1 and rng.random() < 0.4:
            radius = float(rng.uniform(0.02, 0.05))
            body, top = {"shape": "sphere", "radius_m": radius, "mass_kg": mass}, 2 * radius
        else:
            size = rng.uniform(0.06, 0.15, 3)
            body, top = {"size_m": size.tolist(), "mass_kg": mass}, float(size[2])
            if rng.random() < 0.5:
                body["rpy_deg"] = [0.0, 0.0, float(rng.uniform(-180, 180))]
        objects[f"b{k}"] = body | {"position_m": [*offset, height + gap + 0.5 * top]}
        motions[f"b{k}"] = ([0.0] * 3 if still else (0.3 * rng.normal(size=3)).tolist()), [0.0] * 3
        height += gap + top
    return objects, motions


def in_motion(scenario: dict[str, Any], motions: Motions) -> Simulation:
    """Return the simulation of a scenario at the start, with initial velocities of its free objects."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scene.yaml"
        file.write_text(yaml.safe_dump(scenario), "utf-8")
        loaded = load_scenario(file)
    start = Simulation(loaded)
    names, v = [link.joint for link in start.model.robot.links], start.state.v.copy()
    for body, motion in motions.items():
        v[[k for k, name in enumerate(names) if name.startswith(f"{body}.")]] = np.concatenate(motion)
    return Simulation(loaded, state=replace(start.state, v=v))


def started(seed: int) -> tuple[str, Simulation]:
    """Return the kind of a scene and its simulation at the start."""
    kind, scenario, motions = settings(seed)
    return kind, in_motion(scenario, motions)


def result_of(seed: int, *, problems: bool = False) -> Result:
    """Run a scene; with ``problems`` step by step if a contact problem was hard, to collect such problems."""
    kind, simulation = started(seed)
    robot, config = simulation.model.robot, simulation.scenario.config
    result = Result(seed, kind, len(config.objects))
    try:
        simulation.advance(config.duration_s)
    except DynsimError as error:
        result.stopped = f"{type(error).__name__}: {error}"
        return result
    record = simulation.record(pictured=False)
    counts = record.summary["time_stepping"]
    result.solves, result.long_solves = counts["contact_solves"], counts["long_solves"]
    result.dropped, result.capped = counts["dropped_solves"], counts["capped_solves"]
    result.residual = counts["residual_max_m_s"]
    v, names = record["v"], [link.joint for link in robot.links]
    speed, momentum, size, energy = 0.0, np.zeros((len(v), 3)), 0.0, 0.0
    for name, body in config.objects.items():
        own = v[:, [k for k, joint in enumerate(names) if joint.startswith(f"{name}.")]]
        mass, reach = body.inertia.mass, float(np.linalg.norm(body.solids[""].dimensions))
        momentum += mass * own[:, :3]
        energy += mass * (G * abs(body.position_m[2]) + 0.5 * float((own[:, :3] ** 2).sum(axis=1).max()))
        size += mass * float(np.linalg.norm(own[:, :3], axis=1).max())
        speed = max(
            speed, float((np.linalg.norm(own[:, :3], axis=1) + reach * np.linalg.norm(own[:, 3:], axis=1)).max())
        )
    if kind == "arm":
        length = float(sum(np.linalg.norm(link.p_PJ) for link in robot.links if "." not in link.joint)) + 0.25
        speed += length * float(
            np.abs(v[:, [k for k, joint in enumerate(names) if "." not in joint]]).sum(axis=1).max()
        )
    result.ledger = float(np.abs(record["energy_residual"]).max()) / energy
    if kind == "free":
        result.momentum = float(np.abs(momentum - momentum[0]).max()) / size
    gaps = record["contact_gap"]
    result.depth, result.pressed = float(-np.nanmin(gaps)), bool(record["contact_normal_force"].max() > 0.0)
    stiffness = config.contacts.stiffness_N_per_m
    give = 0.0 if stiffness is None else float(np.nanmax(record["contact_normal_force"])) / stiffness
    result.depth_bound = 2.0 * STEP_S * speed + 1e-6 + give
    if problems and (result.residual > kt.FAIR or result.dropped):
        _collect(seed, config.duration_s, result)
    return result


def _collect(seed: int, duration: float, result: Result) -> None:
    """Run a scene step by step and add the problems whose residual was not fair, or that were given up."""
    _, simulation = started(seed)
    simulation.advance(0.0)
    for k in range(round(duration / STEP_S)):
        run, ws = simulation._prepared.run, simulation._prepared.workspace
        s = run.stepping
        impulse, dropped = s.impulse.copy(), s.statistics[kt.DROPPED]
        s.statistics[kt.WORST] = 0.0
        simulation.advance((k + 1) * STEP_S)
        worst, drops = float(s.statistics[kt.WORST]), int(s.statistics[kt.DROPPED] - dropped)
        result.above_fair += worst > kt.FAIR
        if worst > kt.FAIR or drops:
            p, coupled = int(ws.counts[ka.ROWS]), int(ws.counts[ka.COUPLED])
            start, b = np.zeros(p), s.right[:p].copy()
            start[:coupled] = np.split(impulse, [3 * len(ws.contacts)])[1][:coupled]
            for c in range(len(ws.contacts)):
                if ws.active[c, ka.MODE] == ka.STICKING:
                    r = int(ws.active[c, ka.FIRST_ROW])
                    start[r : r + 3] = impulse[3 * c : 3 * c + 3]
            result.problems.append(
                {
                    "why": f"bodies {seed} at {k + 1}: residual {worst:.1e}, {drops} dropped",
                    "W": ws.small[0, :p, :p].copy(),
                    "b": b,
                    "kind": s.kind[:p].copy(),
                    "mu": s.mu[:p].copy(),
                    "start": start,
                }
            )


def packed(problems: Sequence[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Return problems as the arrays of ``tests/data/contact_problems``."""
    rows = {key: np.concatenate([problem[key] for problem in problems]) for key in ("b", "kind", "mu", "start")}
    return rows | {
        "p": np.array([len(problem["b"]) for problem in problems]),
        "W": np.concatenate([problem["W"].ravel() for problem in problems]),
        "why": np.array([problem["why"] for problem in problems]),
    }


def main(first: int, count: int, file: Path) -> None:
    """Run scenes and write their results."""
    hard: list[dict[str, Any]] = []
    for seed in range(first, first + count):
        try:
            result = result_of(seed, problems=True)
        except Exception as error:  # a fault of the generator itself
            result = Result(seed, "", 0, stopped=f"{type(error).__name__}: {error}")
        hard += result.problems
        line = {key: value for key, value in asdict(result).items() if key != "problems"} | {"faults": faults(result)}
        with file.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(line) + "\n")
        if result.problems:
            np.savez_compressed(file.with_suffix(f".{first}.npz"), **packed(hard))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
