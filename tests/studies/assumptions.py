"""Study: sensitivity of the elbow comparison to assumptions that the paper leaves open, one at a time.

``PYTHONPATH=tests python -m studies.assumptions`` writes results/reference/assumptions.json, which
docs/validation/bracing.md quotes.
"""

from __future__ import annotations

from pathlib import Path

from support.wang_minami import changed_assumptions

from dynsim._version import __version__
from dynsim.system.files import write_json

if __name__ == "__main__":
    rows = changed_assumptions()
    write_json(Path("results/reference/assumptions.json"), {"dynsim_version": __version__, "cases": rows})
    for case, variants in rows.items():
        energies = " | ".join(f"{row['electrical_energy_J']:.1f}" for row in variants.values())
        errors = " | ".join(f"{1e3 * row['hand_error_rms_m']:.1f}" for row in variants.values())
        pulling = 100.0 * variants["two_elbows"]["pulling_elbow_4"]
        print(f"| {case} | {energies} | {errors} | {pulling:.1f} |")
