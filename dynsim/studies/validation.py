"""The numbers that README.md and docs/ quote, measured anew.

``python -m dynsim.studies.validation`` writes results/reference/validation.json and prints it, in about three minutes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dynsim._version import __version__
from dynsim.engine import simulate
from dynsim.files import write_json
from dynsim.model.clearance import poses
from dynsim.record import Record
from dynsim.scenario import Scenario, load_scenario, scenario_from_resolved, shipped_scenarios, variant_names
from dynsim.studies.compare import compare
from dynsim.studies.rotors import rotor_energies

ELBOWS = "elbow_comparison"
# Fine enough for what happens in the first tenth of a second.
RATE_HZ = 2000.0

_FLOOR: dict[str, Any] = {"floor": {"type": "plane"}}
# Motion that nothing damps, or only friction: no motor steers it back, so that the errors of the steps stay in it.
FREE: dict[str, dict[str, Any]] = {
    "undamped fall of ten links, 5 s": {
        "duration_s": 5,
        "plant": {"type": "serial_arm", "chain": [{"axis": "y", "initial_deg": 90}, {"axis": "y", "count": 9}]},
    },
    "undamped chain of four links, its tip on a floor, 5 s": {
        "duration_s": 5,
        "plant": {"type": "serial_arm", "chain": [{"axis": "y", "initial_deg": a} for a in (30, 60, 60, 60)]},
        # cos 30° + cos 90° + cos 150° + cos 210° = −cos 30°
        "surfaces": {"floor": {"type": "plane", "point_m": [0, 0, -0.3 * np.cos(np.pi / 6)]}},
        "contacts": {"friction": 0.0, "points": {"tip": {"body": "link_4", "point_m": [0, 0, 0.3]}}},
    },
    **{
        f"rod falling on a floor, friction {friction}, 1 s": {
            "duration_s": 1,
            "plant": {
                "type": "serial_arm",
                "chain": [
                    {"kind": "prismatic", "axis": "x", "length_m": 0, "mass_kg": 0},
                    {"kind": "prismatic", "axis": "z", "length_m": 0, "mass_kg": 0},
                    {"axis": "y", "length_m": 1, "mass_kg": 1, "initial_deg": 30},
                ],
            },
            "surfaces": _FLOOR,
            "contacts": {"friction": friction, "points": {"foot": {"body": "link_3"}}},
        }
        for friction in (0.1, 0.3, 1.0)
    },
    "published arm without motors and losses, 10 s": {
        "duration_s": 10,
        "plant": {
            "type": "serial_arm",
            "base": {"yaw_deg": 45},
            "chain": [{"axis": "z", "length_m": 0}, {"axis": "y", "count": 9}],
            "initial_deg": [0, 45, 90, -90, 45, 45, -90, 45, -45, 45],
        },
    },
}


def free_scenario(name: str) -> Scenario:
    """One of :data:`FREE`."""
    return scenario_from_resolved({"name": name, **FREE[name]})


def residuals() -> dict[str, float]:
    """Ledger residual over turnover of all shipped arms and of motion that nothing damps."""
    found: dict[str, float] = {}
    for path in shipped_scenarios():
        for variant in [*variant_names(path)] or (None,):
            scenario = load_scenario(path, variant)
            if scenario.engine == "dynamics":
                summary = simulate(scenario).summary
                found[f"{path.stem} {variant or ''}".strip()] = summary["energy_residual_relative"]
    for name in FREE:
        found[name] = simulate(free_scenario(name)).summary["energy_residual_relative"]
    return found


def elbow_numbers(record: Record, scenario: Scenario) -> dict[str, float]:
    """Energies, works and the depth of the lowest joint of one variant."""
    summary, time = record.summary, record.time
    keys = ("electrical_energy_J", "electrical_energy_supply_J", "electrical_energy_drawn_J", "mechanical_work_J")
    row = {key: summary[key] for key in keys}
    row["sum_of_absolute_power_J"] = float(np.trapezoid(np.abs(record["torque"] * record["v"]).sum(axis=1), time))
    lowest = np.min([p[:, 2] for _, _, p in poses(scenario.robot(), record["q"])], axis=0)
    row["joint_depth_max_m"] = float(-lowest.min())
    row["joint_depth_end_m"] = float(-lowest[-1])
    return row


def elbow_4_force(record: Record) -> dict[str, float]:
    """How the floor pushes and then pulls at elbow 4 with both elbows held."""
    force, time = record["contact_normal_force"][:, record.labels["contact_normal_force"].index("elbow_4")], record.time
    turn = int(np.flatnonzero(force < 0.0)[0])
    settled = force[time >= 0.17]
    return {
        "pushes_until_s": float(time[turn]),
        "push_max_N": float(force[:turn].max()),
        "at_0.1_s_N": float(np.interp(0.1, time, force)),
        "pull_max_N": float(-force.min()),
        "pull_from_0.17_s_min_N": float(-settled.max()),
        "pull_from_0.17_s_max_N": float(-settled.min()),
    }


def validation() -> dict[str, Any]:
    """All of it, by topic."""
    records = compare(ELBOWS, overrides={"record.rate_hz": RATE_HZ})
    return {
        "ledger_residual": residuals(),
        "elbows": {name: elbow_numbers(record, load_scenario(ELBOWS, name)) for name, record in records.items()},
        "elbow_4_force_with_two_elbows": elbow_4_force(records["two_elbows"]),
        "electrical_energy_by_rotor_model_J": rotor_energies(load_scenario(ELBOWS, "two_elbows")),
    }


if __name__ == "__main__":
    result = validation()
    write_json(Path("results/reference/validation.json"), {"dynsim_version": __version__, **result})
    for topic, rows in result.items():
        print(topic)
        for name, value in rows.items():
            shown = value if isinstance(value, dict) else {"": value}
            print(f"  {name}:", ", ".join(f"{key} {number:.6g}".strip() for key, number in shown.items()))
