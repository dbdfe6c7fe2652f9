"""How far the elbow comparison depends on what the paper does not say: one assumption changed at a time.

``python -m dynsim.studies.assumptions`` writes results/reference/assumptions.json, which docs/validation.md quotes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dynsim._version import __version__
from dynsim.files import write_json
from dynsim.studies.compare import compare

SCENARIO = "elbow_comparison"
PATH = "controller.hand.path"

# What is changed → overrides.
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


def assumptions() -> dict[str, dict[str, dict[str, float]]]:
    """Case → variant → electrical energy [J], hand error rms [m], pulling fraction of elbow 4."""
    result: dict[str, dict[str, dict[str, float]]] = {}
    for case, overrides in CASES.items():
        result[case] = {}
        for variant, record in compare(SCENARIO, overrides=overrides).items():
            summary = record.summary
            row = {key: summary[key] for key in ("electrical_energy_J", "hand_error_rms_m", "hand_error_z_rms_m")}
            row |= {f"pulling_{c['name']}": c["pulling_fraction"] for c in summary["contacts"]}
            row["energy_residual_relative"] = summary["energy_residual_relative"]
            result[case][variant] = row
    return result


if __name__ == "__main__":
    rows = assumptions()
    write_json(Path("results/reference/assumptions.json"), {"dynsim_version": __version__, "cases": rows})
    for case, variants in rows.items():
        energies = " | ".join(f"{row['electrical_energy_J']:.1f}" for row in variants.values())
        errors = " | ".join(f"{1e3 * row['hand_error_rms_m']:.1f}" for row in variants.values())
        pulling = 100.0 * variants["two_elbows"]["pulling_elbow_4"]
        print(f"| {case} | {energies} | {errors} | {pulling:.1f} |")
