"""Study: bodies that touch each other, in dynsim and in MuJoCo: time, penetration, drift, and falling dominoes.

``PYTHONPATH=tests python -m studies.bodies`` writes results/reference/bodies.json in a minute once the kernels are
compiled. MuJoCo has the elliptic cone and the same solids, masses, friction and step; sharp edges where dynsim rounds
those between bodies by 1 mm. Its solver has its defaults, or is as stiff as the step allows.
"""

from __future__ import annotations

import math
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from dynsim.dynamics import state as kst
from dynsim.engine.simulation import prepare
from dynsim.integrators import run as ki
from dynsim.record.quaternion import of_turn
from dynsim.scenario import Scenario, load_scenario
from dynsim.system.files import write_json
from studies.bench.job import integrate
from studies.bench.mujoco_peer import STIFFEST
from studies.bench.run import machine, versions

Array = NDArray[np.float64]

FILE = Path("results/reference/bodies.json")
FRICTION = 0.5
# Poses are compared after each interval [s], which every step divides.
INTERVAL = 1e-3
ROUNDS = 3
# Program: step [s], and whether MuJoCo's contacts are as stiff as the step allows.
DYNSIM = {"dynsim 1 ms": 1e-3, "dynsim 0.25 ms": 2.5e-4}
MUJOCO = {"MuJoCo 1 ms": (1e-3, False), "MuJoCo 1 ms, stiff": (1e-3, True), "MuJoCo 0.1 ms, stiff": (1e-4, True)}
# Domino: edges x, y, z and distance from the next one [m], mass [kg], number, and tilt of the first one, which falls.
DOMINO, PITCH, DOMINO_MASS, DOMINOES, TILT_DEG = [0.008, 0.024, 0.048], 0.03, 0.01, 10, 12.0
# A domino falls from the time at which it is tilted by this angle [deg].
FALLS_DEG = 2.0


class Outcome(NamedTuple):
    """CPU seconds of a run, its steps, largest penetration [m], and poses by interval, (T, objects, 7)."""

    seconds: float
    steps: int
    penetration: float
    poses: Array


def box(position: list[float], edges: list[float], mass: float, pitch_deg: float = 0.0) -> dict[str, Any]:
    """Return a box as an object of a scenario."""
    return {"size_m": edges, "mass_kg": mass, "position_m": position, "rpy_deg": [0.0, pitch_deg, 0.0]}


def dominoes() -> dict[str, Any]:
    """Return a row of dominoes, the first one of which is tilted about its lower edge."""
    a, _, c = DOMINO
    tilt = math.radians(TILT_DEG)
    x = 0.5 * a - 0.5 * a * math.cos(tilt) + 0.5 * c * math.sin(tilt)
    z = 0.5 * a * math.sin(tilt) + 0.5 * c * math.cos(tilt)
    first = box([x, 0.0, z], DOMINO, DOMINO_MASS, TILT_DEG)
    others = {f"d{k}": box([k * PITCH, 0.0, 0.5 * c], DOMINO, DOMINO_MASS) for k in range(1, DOMINOES)}
    return {"d0": first} | others


def cases() -> dict[str, tuple[dict[str, Any], list[float], float]]:
    """Return objects, gravity [m/s²] and duration [s] by case; the boxes are on a slope of ten degrees."""
    slope = [9.81 * math.sin(math.radians(10.0)), 0.0, -9.81 * math.cos(math.radians(10.0))]
    level = [0.0, 0.0, -9.81]
    edges = [0.2, 0.2, 0.1]
    low = box([0.0, 0.0, 0.05], edges, 2.0)
    balls = {
        f"s{k}": {"shape": "sphere", "radius_m": 0.05, "mass_kg": 1.0, "position_m": [0.0, 0.0, 0.05 + 0.1 * k]}
        for k in range(8)
    }
    return {
        "two boxes, one on the other": ({"a": low, "b": box([0.03, 0.02, 0.15], edges, 2.0)}, slope, 2.0),
        "two boxes, side by side": ({"a": low, "b": box([0.2, 0.02, 0.05], edges, 2.0)}, slope, 2.0),
        "stack of eight spheres": (balls, level, 2.0),
        f"row of {DOMINOES} dominoes": (dominoes(), level, 1.0),
    }


def scenario_of(objects: dict[str, Any], gravity: list[float], duration: float, step: float) -> Scenario:
    """Return a scenario of time stepping with objects on a plane, and a link far above them."""
    link = {"axis": "y", "length_m": 0.1, "mass_kg": 0.1}
    values = {
        "plant": {
            "type": "serial_arm", "chain": [link], "base": {"position_m": [0, 0, 9]}, "gravity_m_s2": gravity
        },
        "objects": objects,
        "surfaces": {"floor": {"type": "plane"}},
        "contacts": {
            "law": "unilateral", "friction": FRICTION, "between": [{"bodies": ["objects", "objects"]}]
        },
        "integrator": {"method": "time_stepping", "step_s": step},
        "record": {"rate_hz": 1.0 / INTERVAL},
        "duration_s": duration,
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "bodies.yaml")
        path.write_text(yaml.safe_dump(values), encoding="utf-8")
        return load_scenario(path)


def run_dynsim(scenario: Scenario, count: int) -> Outcome:
    """Return the outcome for ``count`` objects; timed runs record no samples."""
    seconds = min(integrate(prepare(scenario, times=np.full(1, np.inf))) for _ in range(ROUNDS))
    prepared = prepare(scenario)
    integrate(prepared)
    run = prepared.run
    deepest = max(0.0, -float(run.outputs("contact")[..., kst.OUT_GAP].min()))
    poses = run.states("q")[:, -7 * count :].reshape(-1, count, 7)
    return Outcome(seconds, int(run.count[ki.STEPS]), deepest, poses)


def build_mujoco(objects: dict[str, Any], gravity: list[float], step: float, stiff: bool) -> Any:
    """Return the same solids as a ``mujoco.MjModel``, with MuJoCo's default contacts or the stiffest ones."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = step, gravity
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    more = {"friction": [FRICTION, 0.0, 0.0]} | ({"solref": [2.0 * step, 1.0], "solimp": STIFFEST} if stiff else {})
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[10, 10, 1], **more)
    for name, shape in objects.items():
        quaternion = of_turn([0.0, 1.0, 0.0], math.radians(shape.get("rpy_deg", [0.0, 0.0, 0.0])[1]))
        body = spec.worldbody.add_body(name=name, pos=shape["position_m"], quat=quaternion)
        body.add_freejoint()
        if "size_m" in shape:
            kind, size = mujoco.mjtGeom.mjGEOM_BOX, 0.5 * np.array(shape["size_m"])
        else:
            kind, size = mujoco.mjtGeom.mjGEOM_SPHERE, [shape["radius_m"], 0, 0]
        body.add_geom(type=kind, size=size, mass=shape["mass_kg"], **more)
    return spec.compile()


def run_mujoco(model: Any, duration: float) -> Outcome:
    """Return the outcome of the same scene in MuJoCo, timed in one native call."""
    import mujoco
    from mujoco import rollout

    steps, every = round(duration / model.opt.timestep), round(INTERVAL / model.opt.timestep)
    data = mujoco.MjData(model)
    start = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, start, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    seconds = []
    for _ in range(ROUNDS):
        started = time.thread_time()
        rollout.rollout(model, mujoco.MjData(model), start[None], nstep=steps)
        seconds.append(time.thread_time() - started)
    poses, deepest = [data.qpos.copy()], 0.0
    for k in range(steps):
        mujoco.mj_step(model, data)
        if (k + 1) % every == 0:
            deepest = max(deepest, -min(data.contact.dist, default=0.0))
            poses.append(data.qpos.copy())
    return Outcome(min(seconds), steps, float(deepest), np.array(poses).reshape(len(poses), -1, 7))


def tilts(poses: Array) -> Array:
    """Return the angles between the z axes of bodies and the vertical, (T, bodies) [rad]."""
    _, x, y, _ = np.moveaxis(poses[..., 3:], -1, 0)
    return np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))


def falling_times(poses: Array) -> list[float | None]:
    """Return the time at which each domino begins to fall [s], interpolated; None if it stays."""
    times = []
    for tilt in np.degrees(tilts(poses)).T[1:]:
        over = np.flatnonzero(tilt > FALLS_DEG)
        k = int(over[0]) if len(over) else 0
        times.append(INTERVAL * (k - 1 + (FALLS_DEG - tilt[k - 1]) / (tilt[k] - tilt[k - 1])) if k else None)
    return times


def measure(case: str) -> list[dict[str, Any]]:
    """Return the numbers of every program for one case."""
    objects, gravity, duration = cases()[case]
    outcomes = {
        program: run_dynsim(scenario_of(objects, gravity, duration, step), len(objects))
        for program, step in DYNSIM.items()
    } | {
        program: run_mujoco(build_mujoco(objects, gravity, step, stiff), duration)
        for program, (step, stiff) in MUJOCO.items()
    }
    rows = []
    for program, (seconds, steps, depth, poses) in outcomes.items():
        row: dict[str, Any] = {"case": case, "program": program, "us_per_step": 1e6 * seconds / steps}
        row |= {"times_real_time": duration / seconds, "penetration_m": depth}
        if "dominoes" in case:
            times = falling_times(poses)
            half = len(times) // 2
            last, middle = times[-1], times[half]
            fell = last is not None and middle is not None
            row |= {"falls_s": times, "wave_m_s": (len(times) - 1 - half) * PITCH / (last - middle) if fell else None}
        else:
            row["drift_m"] = float(np.linalg.norm(poses[-1, :, :3] - poses[0, :, :3], axis=1).max())
        rows.append(row)
    return rows


if __name__ == "__main__":
    table: list[dict[str, Any]] = []
    for case in cases():
        for row in measure(case):
            table.append(row)
            print({key: value for key, value in row.items() if key != "falls_s"}, flush=True)
    write_json(FILE, {"machine": machine(), "versions": versions(), "bodies": table})
    print(f"written: {FILE}; into the pages: python .ci/pages.py")
