"""Study: the published arm with its elbows held on the floor, on a real floor, and with all links as candidates.

``PYTHONPATH=tests python -m studies.contact`` writes results/contact/, which README.md and docs/validation/bracing.md
quote, in about ten seconds once the kernels are compiled.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dynsim._version import __version__
from dynsim.draw.figures import contacts, posture
from dynsim.draw.figures.style import look, save
from dynsim.record import Record
from dynsim.studies.compare import compare
from dynsim.system.files import write_json

FOLDER = Path("results/contact")
GLUED, REAL, LINKS = "elbow_comparison", "elbow_comparison_floor", "elbow_comparison_links"
SCENARIOS = (GLUED, REAL, LINKS)
# Keys of a summary that are quoted for a run, and for each of its contacts that touched.
RUN = (
    "electrical_energy_J", "mechanical_work_J", "joule_heat_J", "friction_heat_J", "impact_loss_J", "hand_error_rms_m",
    "hand_error_z_rms_m", "energy_residual_relative", "constraint_drift_max_m", "rhs_evaluations",
)  # fmt: skip
CONTACT = (
    "normal_force_min_N", "normal_force_mean_N", "normal_force_max_N", "pulling_fraction", "closed_fraction",
    "sticking_fraction", "sliding_fraction", "slip_distance_m", "lift_offs", "landings", "slip_starts", "impact_loss_J",
)  # fmt: skip


def numbers(record: Record) -> dict[str, Any]:
    """Return the quoted numbers of a run: energies, errors, contacts, and contact events as [time, kind, contact]."""
    summary = record.summary
    row: dict[str, Any] = {key: summary[key] for key in RUN if key in summary}
    row["deepest_below_the_floor_m"] = max((sunk["depth_m"] for sunk in summary["sinking"]), default=0.0)
    row["contacts"] = {
        contact["name"]: {key: contact[key] for key in CONTACT if key in contact}
        for contact in summary["contacts"]
        if contact["closed_fraction"] > 0.0
    }
    row["events"] = [[event.time, event.kind, event.name] for event in record.events]
    return row


def side_by_side(glued: dict[str, Record], real: dict[str, Record]) -> dict[str, Record]:
    """Return every variant on both floors, one after the other."""
    return {
        f"{variant}, {floor}": records[variant]
        for variant in glued
        for floor, records in (("glued", glued), ("real floor", real))
    }


def table(numbers_of: dict[str, dict[str, Any]]) -> str:
    """Return the numbers of all runs, for the terminal."""
    lines = [f"{'':40}{'energy [J]':>11}{'error [mm]':>11}{'residual':>10}  contacts: mean N, closed %, sticking %"]
    for scenario, variants in numbers_of.items():
        for variant, row in variants.items():
            touching = "; ".join(
                f"{name} {contact['normal_force_mean_N']:.2f}, {100 * contact['closed_fraction']:.1f}, "
                f"{100 * contact.get('sticking_fraction', 0.0):.1f}"
                for name, contact in row["contacts"].items()
            )
            lines.append(
                f"{scenario + ' ' + variant:40}{row['electrical_energy_J']:11.5g}{1e3 * row['hand_error_rms_m']:11.4g}"
                f"{row['energy_residual_relative']:10.1e}  {touching}"
            )
    return "\n".join(lines)


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    runs = {scenario: compare(scenario) for scenario in SCENARIOS}
    rows = {scenario: {name: numbers(record) for name, record in records.items()} for scenario, records in runs.items()}
    write_json(FOLDER / "comparison.json", {"dynsim_version": __version__, **rows})
    print(table(rows))
    both = side_by_side(runs[GLUED], runs[REAL])
    with look():
        for name, figure in (
            ("posture", posture.posture_comparison(both)),
            ("forces", contacts.forces_comparison({k: r for k, r in both.items() if k.startswith("two_elbows")})),
            ("modes", contacts.forces(runs[REAL]["two_elbows"])),
        ):
            if figure is not None:
                print(save(figure, FOLDER / f"{name}.png"))
