"""Study: results and forces of the arm of [WM] with elbows on the floor, and their sensitivity.

[WM]: see docs/theory/multibody.md. What the paper states is asserted in tests/published/test_wang_minami.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dynsim.compile.clearance import poses
from dynsim.record import Record
from dynsim.scenario import Scenario, build
from dynsim.studies.compare import compare

ELBOWS = "elbow_comparison"
PATH = "controller.hand.path"

# Changed assumption → overrides.
CASES: dict[str, dict[str, Any]] = {
    "as shipped": {},
    "circle vertical, in the heading's plane": {f"{PATH}.normal": [1, -1, 0], f"{PATH}.start": [1, 1, 0]},
    "circle vertical, square to the heading": {f"{PATH}.normal": [1, 1, 0], f"{PATH}.start": [1, -1, 0]},
    "circle clockwise": {f"{PATH}.clockwise": True},
    "circle starts at the far side": {f"{PATH}.start": [-1, 0, 0]},
    "one turn in 5 s": {f"{PATH}.period_s": 5},
    "one turn in 20 s": {f"{PATH}.period_s": 20},
    "v_s = 0.1 mm/s": {"contacts.slip_smoothing_m_s": 1e-4},
    "v_s = 10 mm/s": {"contacts.slip_smoothing_m_s": 1e-2},
    "no friction": {"contacts.friction": 0.0},
    "friction μ |f_n|": {"contacts.pulling_friction": "dissipative"},
}


def elbow_numbers(record: Record, scenario: Scenario) -> dict[str, float]:
    """Return energies, works and the depth of the lowest joint of one variant."""
    summary, time = record.summary, record.time
    keys = ("electrical_energy_J", "electrical_energy_supply_J", "electrical_energy_drawn_J", "mechanical_work_J")
    more = ("joule_heat_J", "friction_heat_J", "hand_error_rms_m", "hand_error_z_rms_m")
    row = {key: summary[key] for key in keys + more}
    row["sum_of_absolute_power_J"] = float(np.trapezoid(np.abs(record["torque"] * record["v"]).sum(axis=1), time))
    lowest = np.min([p[2] for _, _, p in poses(build.robot(scenario), record["q"])], axis=0)
    row["joint_depth_max_m"] = float(-lowest.min())
    # Not −0.0 if a joint is exactly on the floor.
    row["joint_depth_from_2_s_min_m"] = float(0.0 - lowest[time >= 2.0].max())
    row["joint_depth_from_2_s_max_m"] = float(-lowest[time >= 2.0].min())
    row["joint_depth_end_m"] = float(-lowest[-1])
    return row


def elbow_forces(record: Record) -> dict[str, float]:
    """Return how the floor pushes and then pulls at elbow 4, and when it pulls at elbow 7, with both elbows held."""
    time, names = record.time, record.labels["contact_normal_force"]
    force, other = (record["contact_normal_force"][:, names.index(name)] for name in ("elbow_4", "elbow_7"))
    pulled = time[other < 0.0]
    turn = int(np.flatnonzero(force < 0.0)[0])
    settled = force[time >= 0.17]
    return {
        "pushes_until_s": float(time[turn]),
        "push_max_N": float(force[:turn].max()),
        "at_0.1_s_N": float(np.interp(0.1, time, force)),
        "pull_max_N": float(-force.min()),
        "pull_from_0.17_s_min_N": float(-settled.max()),
        "pull_from_0.17_s_max_N": float(-settled.min()),
        "elbow_7_pulls_from_s": float(pulled[0]),
        "elbow_7_pulls_until_s": float(pulled[-1]),
        "hand_starts_off_m": float(np.linalg.norm(record["hand_position"][0] - record["target_position"][0])),
    }


def changed_assumptions() -> dict[str, dict[str, dict[str, float]]]:
    """Return case → variant → electrical energy [J], hand error rms [m], pulling fraction of elbow 4."""
    result: dict[str, dict[str, dict[str, float]]] = {}
    for case, overrides in CASES.items():
        result[case] = {}
        for variant, record in compare(ELBOWS, overrides=overrides).items():
            summary = record.summary
            row = {key: summary[key] for key in ("electrical_energy_J", "hand_error_rms_m", "hand_error_z_rms_m")}
            row |= {f"pulling_{c['name']}": c["pulling_fraction"] for c in summary["contacts"]}
            row["energy_residual_relative"] = summary["energy_residual_relative"]
            result[case][variant] = row
    return result
