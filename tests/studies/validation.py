"""Study: energies, errors, forces and residuals of scenarios quoted in README.md and docs/, simulated again.

``PYTHONPATH=tests python -m studies.validation`` writes results/reference/validation.json in about four minutes;
``python .ci/pages.py`` writes them into the pages.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from support.rotors import rotor_energies
from support.wang_minami import ELBOWS, elbow_forces, elbow_numbers

from dynsim._version import __version__
from dynsim.engine import simulate
from dynsim.errors import SimulationStopped
from dynsim.hardware.replay.check import check_motion
from dynsim.hardware.servo_map import load_servo_map
from dynsim.record import Record
from dynsim.scenario import Scenario, load_scenario, scenario_from_resolved, shipped_scenarios, variant_names
from dynsim.studies.compare import compare
from dynsim.system.files import write_json

FILE = Path("results/reference/validation.json")
# Keys of a summary that depend on the machine.
OF_THE_MACHINE = ("integration_wall_s", "real_time_factor")
# Sufficient resolution for the first tenth of a second.
RATE_HZ = 2000.0

_FLOOR: dict[str, Any] = {"floor": {"type": "plane"}}
# Scenarios without motors and with friction as only loss: step errors accumulate, as no motor corrects them.
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
        f"rod falling on a floor, friction {friction}, 3 s": {
            "duration_s": 3,
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
        for friction in (0.1, 0.3)
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
    """Return one of :data:`FREE`."""
    return scenario_from_resolved({"name": name, **FREE[name]})


def arms() -> dict[str, Scenario]:
    """Return the integrated variants of the shipped scenarios, by "scenario variant"."""
    scenarios = {
        f"{path.stem} {variant or ''}".strip(): load_scenario(path, variant)
        for path in shipped_scenarios()
        for variant in [*variant_names(path)] or (None,)
    }
    return {
        name: scenario
        for name, scenario in scenarios.items()
        if scenario.engine == "dynamics" and scenario.plant.type != "snake"
    }


def ended(scenario: Scenario) -> Record:
    """Return the record of a run, even if it is designed to stop when its base tips."""
    try:
        return simulate(scenario)
    except SimulationStopped as stop:
        if stop.record is None:
            raise
        return stop.record


def row(record: Record) -> dict[str, Any]:
    """Return the quoted numbers of a run: energy, error, ledger, work, contacts and event counts."""
    summary = record.summary
    keys = ("method", "electrical_energy_J", "hand_error_rms_m", "energy_residual_relative", "rhs_evaluations")
    numbers = {key: summary[key] for key in keys}
    numbers["events"] = dict(Counter(event.kind for event in record.events))
    numbers["first_at_s"] = {event.kind: event.time for event in reversed(record.events)}
    numbers["contacts"] = {
        contact["name"]: {
            key: contact[key]
            for key in ("normal_force_mean_N", "normal_force_max_N", "closed_fraction", "sticking_fraction")
            if key in contact
        }
        for contact in summary["contacts"]
        if contact["closed_fraction"] > 0.0
    }
    return numbers


def time_stepping() -> dict[str, dict[str, float]]:
    """Return balance and losses of the discrete equations in time stepping, and the depths of points."""
    cases: dict[str, tuple[str, str | None, dict[str, Any]]] = {
        "elbow_comparison_floor two_elbows, 2 s": ("elbow_comparison_floor", "two_elbows", {"duration_s": 2}),
        "wall_push weak_hold": ("wall_push", "weak_hold", {}),
        "bouncing_link half": ("bouncing_link", "half", {}),
        **{f"falling_arm {step:g} ms": ("falling_arm", None, {"step_s": 1e-3 * step}) for step in (1, 0.5, 0.25)},
    }
    results = {}
    for name, (scenario, variant, changes) in cases.items():
        method = {"method": "time_stepping", "step_s": changes.get("step_s", 1e-3)}
        overrides = {"integrator": method} | ({"duration_s": 2} if "duration_s" in changes else {})
        summary = simulate(load_scenario(scenario, variant, overrides)).summary
        results[name] = {
            "energy_residual_relative": summary["energy_residual_relative"],
            "taken_by_steps_relative": summary["scheme_loss_J"] / summary["energy_turnover_J"],
            "penetration_max_m": summary["time_stepping"]["penetration_max_m"],
        }
    return results


def knock() -> dict[str, float]:
    """Return the largest acceleration, jerk and shaking that the bridge check finds in the record of two elbows."""
    motion = check_motion(_elbows(), load_servo_map("arm"))
    keys = ("acceleration", "jerk", "shaking")
    return {key: max(abs(margin.value) for margin in motion.margins if margin.quantity == key) for key in keys}


def _elbows(variant: str = "two_elbows", **integrator: Any) -> Record:
    duration = {"duration_s": integrator.pop("duration_s")} if "duration_s" in integrator else {}
    return simulate(load_scenario(ELBOWS, variant, {f"integrator.{k}": v for k, v in integrator.items()} | duration))


def residuals_by_tolerance() -> dict[str, float]:
    """Return the ledger residual over turnover of two elbows, by method, tolerance and duration."""
    cases: dict[str, dict[str, Any]] = {
        "dopri5, rtol 1e-6, 1 s": {"duration_s": 1, "method": "dopri5"},
        "dopri5, rtol 1e-8, 1 s": {"duration_s": 1, "method": "dopri5", "rtol": 1e-8, "atol": 1e-10},
        "dopri5, rtol 1e-6, 10 s": {"method": "dopri5"},
        "radau5, rtol 1e-6, 1 s": {"duration_s": 1, "method": "radau5"},
        "radau5, rtol 1e-8, 1 s": {"duration_s": 1, "method": "radau5", "rtol": 1e-8, "atol": 1e-10},
        "radau5, rtol 1e-6, 10 s": {"method": "radau5"},
    }
    return {name: _elbows(**case).summary["energy_residual_relative"] for name, case in cases.items()}


def differences() -> dict[str, dict[str, float]]:
    """Return the effects of tolerances, methods and solvers on the run with two elbows, and of half the tolerance."""
    reference = _elbows(method="dopri5", rtol=1e-11, atol=1e-13)
    results: dict[str, dict[str, float]] = {}
    cases: dict[str, dict[str, Any]] = {
        "dopri5": {"method": "dopri5"},
        "radau5": {"method": "radau5"},
    }
    for name, case in cases.items():
        record = _elbows(**case)
        results[f"{name} against dopri5 at rtol 1e-11"] = {
            "q_rad": float(np.abs(record["q"] - reference["q"]).max()),
            "hand_m": float(np.abs(record["hand_position"] - reference["hand_position"]).max()),
        }
    first, other = _elbows(), _elbows(solver="m_star")
    results["m_star against articulated"] = {"q_rad": float(np.abs(first["q"] - other["q"]).max())}
    keys = ("electrical_energy_J", "mechanical_work_J")
    relative = dict.fromkeys(keys, 0.0)
    for variant in variant_names(ELBOWS):
        coarse, fine = _elbows(variant).summary, _elbows(variant, rtol=5e-7, atol=5e-9).summary
        for key in keys:
            relative[key] = max(relative[key], abs(coarse[key] / fine[key] - 1.0))
    results["half of rtol and atol, all variants, relative"] = relative
    return results


def validation() -> dict[str, Any]:
    """Return all results, by topic."""
    fine = compare(ELBOWS, overrides={"record.rate_hz": RATE_HZ})
    results = {name: ended(scenario) for name, scenario in arms().items()}
    free = {name: simulate(free_scenario(name)) for name in FREE}
    elbows = {name: results[f"{ELBOWS} {name}"] for name in variant_names(ELBOWS)}
    return {
        "runs": {name: row(record) for name, record in results.items()},
        "ledger_residual_of_free_motion": {
            name: record.summary["energy_residual_relative"] for name, record in free.items()
        },
        "ledger_residual_of_two_elbows": residuals_by_tolerance(),
        "differences": differences(),
        "elbows": {
            name: elbow_numbers(record, load_scenario(ELBOWS, name))
            | {"largest_gap_m": elbows[name].summary["constraint_drift_max_m"]}
            for name, record in fine.items()
        },
        "elbow_summaries": {
            name: {key: value for key, value in record.summary.items() if key not in OF_THE_MACHINE}
            for name, record in elbows.items()
        },
        "forces_with_two_elbows": elbow_forces(fine["two_elbows"]),
        "time_stepping": time_stepping(),
        "knock_at_the_start": knock(),
        "electrical_energy_by_rotor_model_J": rotor_energies(load_scenario(ELBOWS, "two_elbows")),
    }


if __name__ == "__main__":
    FILE.parent.mkdir(parents=True, exist_ok=True)
    write_json(FILE, {"dynsim_version": __version__, **validation()})
    print(f"written: {FILE}; into the pages: python .ci/pages.py")
