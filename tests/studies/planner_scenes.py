"""Random scenes for the planner of braces, and studies of its plans and of the published arm's postures.

    PYTHONPATH=tests python -m studies.planner_scenes --out results/planner
    PYTHONPATH=tests python -m studies.planner_scenes --study reference --effort 100 --out results/planner
    PYTHONPATH=tests python -m studies.planner_scenes --study gains --out results/planner
    PYTHONPATH=tests python -m studies.planner_scenes --study posture --out results/planner
    PYTHONPATH=tests python -m studies.planner_scenes --study phases --out results/planner

The first command plans each scene. The second searches each scene with ``--effort`` times the usual rounds, for the
best known answer; rows of other scenes in its file are kept. The third runs the best plans, and those of the published
arm, on surfaces displaced by 5 mm, with stiff to soft gains. The fourth computes the least heat of the published arm at
the postures of its scenario, which no plan has chosen, over all forces at its elbows of at least 0.5 N. The fifth plans
arms of nine joints with two fixed braces and with braces that change once, with several seeds.

Arms of 7 to 10 joints whose hand moves back and forth along a short path, over a floor, a pipe, a box, or with a joint
about a third axis. The seed of a scene is its number; the constants of the search were chosen on the first twenty.
"""

from __future__ import annotations

import argparse
import json
import math
import time as clock
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dynsim.compile.bracing import Brace
from dynsim.engine.simulation import prepare
from dynsim.planner.answer import plan_braces
from dynsim.planner.dense import references
from dynsim.planner.problem import Options, task
from dynsim.planner.search import Search
from dynsim.planner.verify import Tolerances, Verifier
from dynsim.scenario import Scenario, load_scenario
from dynsim.scenario.reading import scenario_from_resolved
from dynsim.studies.processes import cores
from dynsim.system.files import write_json

# Seed of the random postures of ``--study reference``.
OTHER_SEED = 1000
# Gains k_p of ``--study gains`` [V/rad].
GAINS = (500.0, 200.0, 100.0, 50.0, 20.0)
# Number of seeds of ``--study phases``; ends of the path of the hand there and back [m], and overrides of the scenario
# tall_path: the scenario itself, an arm on a base of 0.3 m next to a table that ends at 0.8 m, and a flat floor.
SEEDS = 5
TABLE = {"type": "box", "center_m": [0.5, 0.0, 0.1], "edges_m": [0.6, 2.0, 0.2], "edge_radius_m": 0.02}
PATHS: dict[str, tuple[tuple[Any, Any] | None, dict[str, Any]]] = {
    "rises from 0.16 to 1.1 m (`tall_path`)": (None, {}),
    "1 m, from above a table to beyond its edge": (
        ([0.75, 0.0, 0.5], [1.75, 0.0, 0.35]), {"plant.base.position_m": [0.0, 0.0, 0.3], "surfaces.table": TABLE},
    ),
    "0.8 to 1.8 m over a flat floor": (([0.8, 0.0, 0.35], [1.8, 0.0, 0.35]), {}),
}  # fmt: skip
KINDS = ("floor", "pipe", "box", "third_axis")
PERIOD_S = 10.0
LIMIT_DEG = [-120.0, 120.0]
MOTOR = {
    "type": "dc",
    "torque_constant_N_m_per_A": 0.203,
    "resistance_ohm": 1.1,
    "inductance_H": 1.7e-3,
    "rotor_inertia_kg_m2": 1.64e-4,
    "gear_damping_N_m_s_per_rad": 0.01,
}


def kind_of(seed: int) -> str:
    """Return what a scene has in addition to its arm."""
    return KINDS[seed % 4]


def along_of(seed: int) -> tuple[float, ...]:
    """Return fractions along links that are also candidates: the middle, in every third scene."""
    return (0.5,) if seed % 3 == 0 else ()


def scene(seed: int) -> dict[str, Any]:
    """Return the scenario of a scene as plain data."""
    rng = np.random.default_rng(seed)

    def drawn(low: float, high: float, digits: int = 3) -> float:
        return round(float(rng.uniform(low, high)), digits)

    kind, pitching = kind_of(seed), int(rng.integers(6, 10))
    chain = [_link("z", 0.0, 0.1, 5.0)]
    for i in range(pitching):
        axis = "x" if kind == "third_axis" and i == pitching // 2 else "y"
        length = drawn(0.2, 0.34)
        chain.append(_link(axis, length, drawn(0.08, 0.2), 4.0 if i < 3 else 3.0, LIMIT_DEG))
    payload = drawn(0.0, 0.15) if rng.random() < 0.6 else 0.0
    height = drawn(0.0, 0.25)
    reach, friction = sum(link["length_m"] for link in chain), drawn(0.1, 0.35, 2)
    distance, up, azimuth = drawn(0.55, 0.8) * reach, drawn(0.25, 0.55), drawn(-0.3, 0.3)
    step = rng.normal(size=3) * [1.0, 1.0, 0.5]
    step = step / np.linalg.norm(step) * drawn(0.12, 0.25)
    start = np.array([distance * np.cos(azimuth), distance * np.sin(azimuth), up])
    end = start + step
    if end[2] < 0.15:
        end[2] = 2.0 * start[2] - end[2]
    surfaces: dict[str, Any] = {"floor": {"type": "plane", "point_m": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0]}}
    x = drawn(0.3, 0.55) * distance
    if kind == "pipe":
        point = [round(x, 3), 0.0, drawn(-0.02, 0.12)]
        surfaces["pipe"] = {
            "type": "cylinder",
            "point_m": point,
            "axis": [0.0, 1.0, 0.0],
            "radius_m": drawn(0.06, 0.15),
        }
    if kind == "box":
        center = [round(x, 3), 0.0, drawn(0.02, 0.1)]
        edges = [drawn(0.2, 0.4), 2.0, 0.2]
        surfaces["box"] = {"type": "box", "center_m": center, "edges_m": edges, "edge_radius_m": 0.02}
    points = [start.round(4).tolist(), end.round(4).tolist(), start.round(4).tolist()]
    path = {"type": "waypoints", "times_s": [0.0, 0.5 * PERIOD_S, PERIOD_S], "points_m": points}
    loads = {}
    if payload:
        tip = [0.0, 0.0, chain[-1]["length_m"]]
        loads["payload"] = {"type": "payload", "body": f"link_{len(chain)}", "point_m": tip, "mass_kg": payload}
    return {
        "name": f"scene_{seed}",
        "duration_s": PERIOD_S,
        "plant": {"type": "serial_arm", "base": {"position_m": [0.0, 0.0, height]}, "chain": chain},
        "controller": {
            "type": "joint_pd",
            "hand": {"joints": [f"joint_{k + 1}" for k in range(len(chain))], "path": path},
        },
        "surfaces": surfaces,
        "contacts": {"law": "unilateral", "friction": friction},
        "loads": loads,
    }


def _link(axis: str, length: float, mass: float, gear: float, limit: list[float] | None = None) -> dict[str, Any]:
    return {
        "axis": axis,
        "length_m": length,
        "mass_kg": mass,
        "damping_N_m_s_per_rad": 0.3,
        "motor": MOTOR | {"gear_ratio": gear},
        **({} if limit is None else {"limit_deg": limit}),
    }


def scene_scenario(seed: int) -> Scenario:
    """Return the scene as a scenario."""
    return scenario_from_resolved(scene(seed))


def planned(seed: int, jobs: int) -> dict[str, Any]:
    """Return the plan of a scene in numbers: heat, sets, corners, and cost of the search."""
    scenario, started = scene_scenario(seed), clock.perf_counter()
    cpu = clock.process_time()
    searched: list[tuple[float, float]] = []

    def tell(text: str, share: float) -> None:
        if text == "verifying" and not searched:
            searched.append((clock.process_time() - cpu, clock.perf_counter()))

    plan = plan_braces(scenario, along=along_of(seed), jobs=jobs, tell=tell)
    ended = clock.perf_counter()
    rows = []
    for size in plan.sizes:
        corners = () if size.verdict is None else size.verdict.corners
        row = {
            "count": size.count,
            "braces": size.label if size.planned else None,
            "heat_W": size.heat,
            "least_W": min((heat for _, heat in plan.ranked[size.count]), default=math.inf),
            "with_4_times_the_instants_W": math.nan,
            "simulated_W": corners[0].heat_W if corners else math.nan,
            "k_p_V_per_rad": size.k_p,
            "survives": size.survives,
            "reason": size.reason,
            "searches_that_found_it": f"{size.agreed}/{size.searches}",
        }
        if size.planned is not None:
            dense = references(plan.task, size.braces, size.planned.times, size.planned.local.Q, 4)
            row["with_4_times_the_instants_W"] = math.nan if isinstance(dense, str) else dense.heat
        rows.append({key: _rounded(value) for key, value in row.items()})
    return {
        "seed": seed,
        "kind": kind_of(seed),
        "joints": plan.task.arm.n,
        "candidates": len(plan.task.candidates),
        "friction": plan.task.friction,
        "search_cpu_s": round(searched[0][0], 2) if searched else None,
        "corners_wall_s": round(ended - searched[0][1], 1) if searched else None,
        "wall_s": round(ended - started, 1),
        "best": None if plan.best is None else plan.best.count,
        "sizes": rows,
    }


def _rounded(value: Any) -> Any:
    """Round numbers to five decimals; None for values that are not finite."""
    return value if not isinstance(value, float) else round(value, 5) if math.isfinite(value) else None


def best_known(seed: int, effort: int) -> dict[str, Any]:
    """Return the least heat of each number of braces by a search with ``effort`` times the rounds and another seed."""
    options = Options(along=along_of(seed), starts=effort * Options.starts, seed=OTHER_SEED, budget_s=0.0)
    search, cpu = Search(task(scene_scenario(seed), options)), clock.process_time()
    search.kept = 3 * search.kept
    plans = search.run()
    sizes = [
        {
            "count": count,
            "braces": ", ".join(b.label for b in ranked[0].braces) if ranked else None,
            "heat_W": _rounded(ranked[0].heat) if ranked else None,
            "searched_W": _rounded(ranked[0].heat) if ranked else None,
        }
        for count, ranked in plans.items()
    ]
    return {
        "seed": seed,
        "effort": effort,
        "rounds": options.starts,
        "cpu_s": round(clock.process_time() - cpu, 1),
        "sizes": sizes,
    }


def least_of(row: dict[str, Any], before: dict[str, Any]) -> dict[str, Any]:
    """Return a reference with the lesser heat of each number of braces, from this row or the previous one.

    Both heats are for dense references on hand path and surfaces; ``searched_W`` is always the heat of this row.
    """
    known = {size["count"]: size for size in before["sizes"] if size["heat_W"] is not None}
    sizes = [
        min(
            size,
            known.get(size["count"], size),
            key=lambda entry: math.inf if entry["heat_W"] is None else entry["heat_W"],
        )
        | {"searched_W": size["searched_W"]}
        for size in row["sizes"]
    ]
    return row | {"sizes": sizes}


def stiffness(scenario: Scenario, counts: Sequence[int], along: tuple[float, ...] = ()) -> list[dict[str, Any]]:
    """Return the cost of plans on surfaces displaced by 5 mm, by the gain k_p of all joints that press braces.

    For each number of braces, or for the best if ``counts`` is empty, the plan of least heat.
    """
    plan = plan_braces(scenario, along=along, count=(min(counts, default=1), max(counts, default=3)), verify=False)
    sizes = [size for size in plan.sizes if size.planned is not None]
    rows = []
    for size in sizes if counts else sizes and [min(sizes, key=lambda size: size.heat)]:
        assert size.planned is not None
        for k_p in GAINS:
            tolerances = Tolerances(friction=(1.0,), gains=(k_p,))
            (verdict,) = Verifier(plan.task, tolerances, cores()).verify([(size.braces, size.planned.dense)])
            rows.append(
                {
                    "scene": scenario.title,
                    "friction": plan.task.friction,
                    "count": size.count,
                    "heat_W": _rounded(size.heat),
                    "k_p_V_per_rad": k_p,
                    "times_the_heat": {
                        f"{1e3 * c.surface_shift_m:+g} mm": _rounded(c.heat_W / size.heat) for c in verdict.corners
                    },
                    "survives": verdict.survives,
                    "reason": verdict.reason,
                }
            )
    return rows


def published(friction: float) -> Scenario:
    """Return the published arm on its real floor."""
    return load_scenario("pressing", overrides={"contacts.friction": friction})


def posture_heat(friction: float, instants: int = 200) -> dict[str, Any]:
    """Return the least heat of the published posture, stationary at instants of its circle: the mean over them.

    The minimum is over all forces at both elbows of at least 0.5 N: ``Model.brace_statics``.
    """
    prepared = prepare(published(friction))
    model, up = prepared.model, np.array([0.0, 0.0, 1.0])
    pieces = list(prepared.control.positions(model.robot))
    times, references = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    braces = {
        name: Brace(f"link_{k}", np.zeros(3), up, friction=friction, min_N=0.5)
        for name, k in (("elbow_4", 4), ("elbow_7", 7))
    }
    at, still = np.linspace(0.0, PERIOD_S, instants, endpoint=False), np.zeros(model.n)
    postures = np.stack([np.interp(at, times, column) for column in references.T], axis=1)
    heat = [model.brace_statics(q, still, still, braces).heat for q in postures]
    return {"friction": friction, "heat_W": _rounded(float(np.mean(heat)))}


def changing(name: str, jobs: int) -> dict[str, Any]:
    """Return the heat of two fixed braces, of two that change once, and of its runs, for one of ``PATHS``."""
    ends, changes = PATHS[name]
    overrides = dict(changes)
    if ends is not None:
        points = [ends[0], ends[1], ends[0]]
        overrides["controller.hand.path"] = {"type": "waypoints", "times_s": [0, 10, 20], "points_m": points}
    scenario, heats = load_scenario("tall_path", overrides=overrides), list[Any]()
    plans = [
        plan_braces(scenario, count=(0, 2), phases=(1, 2), seed=seed, verify=seed == 0, jobs=jobs)
        for seed in range(SEEDS)
    ]
    fixed = plan_braces(scenario, count=(0, 2), verify=False)
    for plan in plans:
        some = [heat for label, heat in plan.ranked[2] if "→" in label]
        heats.append(_rounded(min(some, default=math.inf)))
    size = plans[0].size(2)
    corners = () if size.verdict is None else size.verdict.corners
    row = {
        "path": name,
        "fixed_W": min(size.heat for size in fixed.sizes),
        "changing_W": heats[0],
        "seeds_W": heats,
        "chosen": size.label,
        "simulated_W": corners[0].heat_W if corners else math.nan,
        "worst_W": max((corner.heat_W for corner in corners), default=math.nan),
        "survives": size.survives,
        "reason": size.reason,
    }
    return {key: _rounded(value) for key, value in row.items()}


def main() -> None:
    """Plan scenes, or search them for long, and write their numbers."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--out", type=Path, default=Path("results/planner"), metavar="FOLDER")
    parser.add_argument("--study", choices=("scenes", "reference", "gains", "posture", "phases"), default="scenes")
    parser.add_argument("--effort", type=int, default=100, metavar="N", help="multiple of the usual rounds")
    parser.add_argument("--scenes", type=int, nargs=2, default=(1, 20), metavar=("FIRST", "LAST"))
    chosen = parser.parse_args()
    first, last = chosen.scenes
    rows = []
    former = chosen.out / "reference.json"
    before = {row["seed"]: row for row in json.loads(former.read_text(encoding="utf-8"))} if former.exists() else {}
    if chosen.study == "scenes":
        # Compilation and loading do not count as time of a scene.
        planned(first, 1)
    for seed in range(first, last + 1) if chosen.study not in ("posture", "phases") else ():
        if chosen.study == "gains":
            rows += stiffness(scene_scenario(seed), (), along_of(seed))
        elif chosen.study == "reference":
            row = best_known(seed, chosen.effort)
            rows.append(least_of(row, before.get(seed, row)))
        else:
            rows.append(planned(seed, cores()))
        print(json.dumps(rows[-1]), flush=True)
    if chosen.study == "reference":
        rows = [row for _, row in sorted((before | {row["seed"]: row for row in rows}).items())]
    if chosen.study == "gains":
        rows += [row for friction in (0.1, 0.0) for row in stiffness(published(friction), range(1, 5))]
    if chosen.study == "posture":
        rows = [posture_heat(friction) for friction in (0.0, 0.1)]
    if chosen.study == "phases":
        for name in PATHS:
            rows.append(changing(name, cores()))
            print(json.dumps(rows[-1]), flush=True)
    chosen.out.mkdir(parents=True, exist_ok=True)
    write_json(chosen.out / f"{chosen.study}.json", rows)


if __name__ == "__main__":
    main()
