"""Study of the dynamic snake: step length and Table III of [T]; order of time stepping while a released head falls.

``PYTHONPATH=tests python -m studies.snake_steps`` writes results/snake/steps.json, which
docs/validation/snake.md quotes, in a minute or two.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dynsim._version import __version__
from dynsim.engine import simulate
from dynsim.scenario import load_scenario
from dynsim.snake.published import TABLE_III, displacement
from dynsim.system.files import write_json

SCENARIO, FILE = "snake_positioning_dynamic", Path("results/snake/steps.json")
STEPS_MS = (1.0, 2.5, 5.0)
# Fall of the head after its release: steps, the last of which is the reference, and duration.
FALL_MS, FALL_S = (5.0, 2.5, 1.25, 0.3125), 0.15


def end_values(moved: str, step_ms: float) -> np.ndarray:
    """Return the displacement of the head as defined in Table III, (6,) [m, rad]."""
    return displacement(simulate(load_scenario(SCENARIO, moved, {"integrator.step_s": 1e-3 * step_ms})))


def fall_errors(theta: float) -> list[float]:
    """Return the largest position error of the head while it falls, by step [m]."""
    settings = {"plant.dynamics.start": "released", "duration_s": FALL_S, "integrator.theta": theta}
    falls = [
        simulate(load_scenario(SCENARIO, "x", {**settings, "integrator.step_s": 1e-3 * step}))["w"] for step in FALL_MS
    ]
    return [float(np.abs(fall - falls[-1])[:, :3].max()) for fall in falls[:-1]]


def study() -> dict[str, Any]:
    """Return all results."""
    ends = {moved: [end_values(moved, step).tolist() for step in STEPS_MS] for moved in TABLE_III}
    spread = np.array([np.ptp(values, axis=0) for values in ends.values()])
    return {
        "dynsim_version": __version__,
        "steps_ms": STEPS_MS,
        "end_values": ends,
        "spread_mm": 1e3 * float(spread[:, :3].max()),
        "spread_mrad": 1e3 * float(spread[:, 3:].max()),
        "fall_steps_ms": FALL_MS[:-1],
        "fall_errors_m": {f"theta_{theta:g}": fall_errors(theta) for theta in (0.5, 1.0)},
    }


if __name__ == "__main__":
    FILE.parent.mkdir(parents=True, exist_ok=True)
    write_json(FILE, study())
