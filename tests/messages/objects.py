"""Names that the Python of inputs may use."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from studies import fault_table

import dynsim
from dynsim import scenario
from dynsim.hardware.imported import import_motion
from dynsim.hardware.replay.check import check_motion
from dynsim.hardware.replay.compare import compare_records
from dynsim.hardware.servo_map import load_servo_map
from dynsim.model.description import Coupling, Inertia, Link, Robot
from dynsim.record import Record
from dynsim.studies import sweep, sweep_plan
from dynsim.teleop.web.pilot import Refused, parse
from messages import stock


def edited(change: str, *, trust: bool = True) -> Record:
    """Read the file of a record after a change by h5py."""
    path = Path("record.h5")
    path.write_bytes(stock.TWO_JOINTS())
    with h5py.File(path, "r+") as file:
        exec(change, {"file": file, "np": np, "h5py": h5py})
    return Record.load(path, trust=trust)


def cut(size: int) -> Record:
    """Read the first bytes of the file of a record."""
    return written(stock.TWO_JOINTS()[:size])


def written(content: bytes) -> Record:
    """Read a file as a record."""
    path = Path("record.h5")
    path.write_bytes(content)
    return Record.load(path)


def resumed(file: str, old: str, new: str) -> None:
    """Resume a sweep of two runs after a text of a file in its folder has been replaced in all its lines."""
    axis = sweep_plan.Axis.parse("plant.chain.0.mass_kg=1,2")
    short = {"duration_s": 0.05, "metrics.settle_s": 0.0}
    plan = sweep_plan.Plan(scenario.read_scenario("single_pendulum"), (None,), short, (axis,))
    folder = Path("swept")
    sweep.run_sweep(plan, folder)
    text = (folder / file).read_text(encoding="utf-8")
    assert old in text
    (folder / file).write_text(text.replace(old, new), encoding="utf-8")
    sweep.run_sweep(plan, folder, resume=True)


def motion(change: str, *edit: str, speed: float = 1.0, rate: float | None = None) -> Any:
    """Check the swing of the rig after a change of its record, and an edit (old, new) of its servo map."""
    record = fault_table.swing()
    exec(change, {"record": record, "math": math, "np": np})
    text = fault_table.MAP.replace(*edit) if edit else fault_table.MAP
    Path("rig.yaml").write_text(text, encoding="utf-8")
    return check_motion(record, load_servo_map("rig.yaml"), rate=rate, speed=speed)


def replayed(entry: dict[str, Any]) -> str:
    """Replay a swing on virtual servos with a fault."""
    run = fault_table.rig().run(entry)
    return f"{run.result.fault_text or 'replayed'}; robot left {run.result.end_state}"


def compared(change: str) -> None:
    """Compare the swing of the rig with a copy of it after a change."""
    measured = fault_table.swing()
    exec(change, {"measured": measured, "np": np})
    compare_records(fault_table.swing(), measured)


def imported(change: str, *, header: str = "time [s],shoulder [rad],elbow [rad],wheel [rad]", **options: Any) -> str:
    """Import a recording of the rig after a change of its rows, which are lists of texts; return the notes."""
    rows = [[f"{k / 30:.4f}", f"{math.sin(k / 30):.4f}", f"{0.5 * math.sin(k / 20):.4f}", "0"] for k in range(120)]
    exec(change, {"rows": rows})
    Path("rig.yaml").write_text(fault_table.MAP, encoding="utf-8")
    lines = [header, *(",".join(row) for row in rows)]
    Path("taught.csv").write_text("\n".join(lines), encoding="utf-8")
    return "; ".join(import_motion(Path("taught.csv"), load_servo_map("rig.yaml"), **options)[2])


def pilot(message: str | bytes) -> str:
    """Return the answer of a drive of two axes to a message of its page that it rejects."""
    try:
        return str(parse(message, 2, (1, 2)))
    except Refused as refused:
        return str(refused)


NAMES: dict[str, Any] = {
    "BODY": Link("body", "hinge", None, "revolute", np.array([0.0, 0.0, 1.0]), Inertia(1.0)),
    "Coupling": Coupling,
    "Inertia": Inertia,
    "Path": Path,
    "Robot": Robot,
    "compared": compared,
    "cut": cut,
    "dynsim": dynsim,
    "edited": edited,
    "imported": imported,
    "math": math,
    "motion": motion,
    "np": np,
    "pilot": pilot,
    "replace": dataclasses.replace,
    "replayed": replayed,
    "resumed": resumed,
    "scenario": scenario,
    "set_options": lambda text: dict([scenario.parse_override(text)]),
    "written": written,
}
# Functions that make the objects of these names, because inputs change them.
MADE: dict[str, Callable[[], Any]] = {
    "arm": lambda: dynsim.load_scenario("elbow_comparison"),
    "free": lambda: dynsim.Simulation(dynsim.load_scenario("elbow_comparison", "no_elbow")),
    "model": lambda: dynsim.build_model(dynsim.load_scenario("elbow_comparison")),
    "pendulum": stock.pendulum,
    "record": stock.two_joints,
    "simulation": lambda: dynsim.Simulation(dynsim.load_scenario("elbow_comparison_floor"), duration=0.1),
    "stepped": lambda: dynsim.Simulation(
        dynsim.load_scenario("elbow_comparison_floor", overrides={"integrator.method": "time_stepping"})
    ),
}


class Objects(dict[str, Any]):
    """Global names of the Python of one input; objects are made when they are first used."""

    def __missing__(self, name: str) -> Any:
        if name in NAMES:
            return NAMES[name]
        if name not in MADE:
            raise KeyError(name)
        self[name] = MADE[name]()
        return self[name]
