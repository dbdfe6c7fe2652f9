"""Study: the snake's tasks on both levels, each with the variants that fail.

``PYTHONPATH=tests python -m studies.snake_tasks`` writes results/snake/tasks.json, whose table is in
docs/validation/snake.md, in two minutes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dynsim._version import __version__
from dynsim.engine import simulate
from dynsim.errors import SimulationStopped
from dynsim.record import Record
from dynsim.scenario import load_scenario, variant_names
from dynsim.system.files import write_json

FILE = Path("results/snake/tasks.json")
# For each task: coordinate of its object, factor and unit.
TASKS = {
    "snake_pick_up": ("pipe.z", 1e3, "mm"),
    "snake_valve": ("valve", 180.0 / np.pi, "°"),
    "snake_door": ("door", 180.0 / np.pi, "°"),
}


def run(name: str, variant: str, level: str) -> tuple[Record, str]:
    """Return the record of a run, and the reason and time of an early end; empty if it was completed."""
    try:
        return simulate(load_scenario(name, variant, {"plant.level": level})), ""
    except SimulationStopped as stop:
        if stop.record is None:
            raise
        return stop.record, f"`{str(stop).partition(':')[0]}` at {stop.time:.1f} s"


def outcome(name: str, variant: str, level: str) -> dict[str, Any]:
    """Return how far the object was moved, what the gripper carried, and how well the ledger closes."""
    record, end = run(name, variant, level)
    coordinate, factor, unit = TASKS[name]
    moved = factor * record["q"][:, record.labels["q"].index(coordinate)]
    result: dict[str, Any] = {"moved": float(moved[-1] - moved[0]), "unit": unit, "end": end}
    if level == "dynamic":
        forces = np.abs(record["tie_force"]).max(axis=0)
        by_name = dict(zip(record.labels["tie_force"], forces.tolist(), strict=True))
        largest = {name.rpartition(".")[2]: force for name, force in by_name.items() if name.startswith("gripper.")}
        supplied = float(record["energy_electrical_supply"][-1])
        result |= {
            "force_N": max(largest[axis] for axis in "xyz"),
            "torque_N_m": max(largest[f"r{axis}"] for axis in "xyz"),
            "supplied_J": supplied,
            "ledger": float(np.abs(record["energy_residual"]).max()) / supplied,
            "real_time": float(record.time[-1]) / record.summary["integration_wall_s"],
        }
    return result


def main() -> None:
    """Run all tasks and write the file."""
    runs = [
        {"scenario": name, "variant": variant, "level": level, **outcome(name, variant, level)}
        for name in TASKS
        for variant in variant_names(name)
        if variant != "pushes"
        for level in ("kinematic", "dynamic")
    ]
    for entry in runs:
        entry.pop("real_time", None)  # depends on the machine
    write_json(FILE, {"dynsim_version": __version__, "runs": runs})


if __name__ == "__main__":
    main()
