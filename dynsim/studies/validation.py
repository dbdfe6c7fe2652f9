"""The numbers that README.md and docs/ quote, measured anew.

``python -m dynsim.studies.validation`` writes results/reference/validation.json and prints it, in about two minutes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dynsim._version import __version__
from dynsim.engine import simulate
from dynsim.errors import SimulationStopped
from dynsim.files import write_json
from dynsim.record import Record
from dynsim.scenario import Scenario, load_scenario, scenario_from_resolved, shipped_scenarios, variant_names
from dynsim.studies.compare import compare
from dynsim.studies.published.rotors import rotor_energies
from dynsim.studies.published.wang_minami import ELBOWS, elbow_forces, elbow_numbers

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
    """One of :data:`FREE`."""
    return scenario_from_resolved({"name": name, **FREE[name]})


def residuals() -> dict[str, float]:
    """Ledger residual over turnover of all shipped arms and of motion that nothing damps."""
    found: dict[str, float] = {}
    for path in shipped_scenarios():
        for variant in [*variant_names(path)] or (None,):
            scenario = load_scenario(path, variant)
            if scenario.engine == "dynamics":
                found[f"{path.stem} {variant or ''}".strip()] = _until_it_ends(scenario)["energy_residual_relative"]
    for name in FREE:
        found[name] = simulate(free_scenario(name)).summary["energy_residual_relative"]
    return found


def _until_it_ends(scenario: Scenario) -> dict[str, Any]:
    """Summary of a run, also of one that is to stop where its base tips over."""
    try:
        return simulate(scenario).summary
    except SimulationStopped as stop:
        if stop.record is None:
            raise
        return stop.record.summary


def _elbows(variant: str = "two_elbows", **integrator: Any) -> Record:
    duration = {"duration_s": integrator.pop("duration_s")} if "duration_s" in integrator else {}
    return simulate(load_scenario(ELBOWS, variant, {f"integrator.{k}": v for k, v in integrator.items()} | duration))


def residuals_by_tolerance() -> dict[str, float]:
    """Ledger residual over turnover of two elbows, by method, tolerance, step and duration."""
    cases: dict[str, dict[str, Any]] = {
        "rk43, rtol 1e-6, 1 s": {"duration_s": 1, "method": "rk43"},
        "rk43, rtol 1e-8, 1 s": {"duration_s": 1, "method": "rk43", "rtol": 1e-8, "atol": 1e-10},
        "dopri5, rtol 1e-6, 1 s": {"duration_s": 1, "method": "dopri5"},
        "dopri5, rtol 1e-8, 1 s": {"duration_s": 1, "method": "dopri5", "rtol": 1e-8, "atol": 1e-10},
        "dopri5, rtol 1e-6, 10 s": {"method": "dopri5"},
        "radau5, rtol 1e-6, 1 s": {"duration_s": 1, "method": "radau5"},
        "radau5, rtol 1e-8, 1 s": {"duration_s": 1, "method": "radau5", "rtol": 1e-8, "atol": 1e-10},
        "radau5, rtol 1e-6, 10 s": {"method": "radau5"},
        "rk4, 1 ms, 1 s": {"duration_s": 1, "method": "rk4", "step_s": 1e-3},
        "rk4, 1 ms, 10 s": {"method": "rk4", "step_s": 1e-3},
        "rk4, 0.5 ms, 10 s": {"method": "rk4", "step_s": 5e-4},
        "rk4, 0.25 ms, 10 s": {"method": "rk4", "step_s": 2.5e-4},
    }
    return {name: _elbows(**case).summary["energy_residual_relative"] for name, case in cases.items()}


def differences() -> dict[str, dict[str, float]]:
    """What other tolerances, methods and solvers change in the run with two elbows, and half the tolerance in all."""
    reference = _elbows(method="dopri5", rtol=1e-11, atol=1e-13)
    found: dict[str, dict[str, float]] = {}
    cases: dict[str, dict[str, Any]] = {
        "rk43": {"method": "rk43"},
        "dopri5": {"method": "dopri5"},
        "radau5": {"method": "radau5"},
        "rk4, 1 ms": {"method": "rk4", "step_s": 1e-3},
    }
    for name, case in cases.items():
        record = _elbows(**case)
        found[f"{name} against dopri5 at rtol 1e-11"] = {
            "q_rad": float(np.abs(record["q"] - reference["q"]).max()),
            "hand_m": float(np.abs(record["hand_position"] - reference["hand_position"]).max()),
        }
    one, other = _elbows(), _elbows(solver="m_star")
    found["m_star against articulated"] = {"q_rad": float(np.abs(one["q"] - other["q"]).max())}
    keys = ("electrical_energy_J", "mechanical_work_J")
    relative = dict.fromkeys(keys, 0.0)
    for variant in variant_names(ELBOWS):
        coarse, fine = _elbows(variant).summary, _elbows(variant, rtol=5e-7, atol=5e-9).summary
        for key in keys:
            relative[key] = max(relative[key], abs(coarse[key] / fine[key] - 1.0))
    found["half of rtol and atol, all variants, relative"] = relative
    return found


def validation() -> dict[str, Any]:
    """All of it, by topic."""
    records = compare(ELBOWS, overrides={"record.rate_hz": RATE_HZ})
    return {
        "ledger_residual": residuals(),
        "ledger_residual_of_two_elbows": residuals_by_tolerance(),
        "differences": differences(),
        "elbows": {name: elbow_numbers(record, load_scenario(ELBOWS, name)) for name, record in records.items()},
        "forces_with_two_elbows": elbow_forces(records["two_elbows"]),
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
