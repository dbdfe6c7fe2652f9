"""Study: tracking with measured feedback, motion of the head during mode changes, and heights of lifted wheels.

``PYTHONPATH=tests python -m studies.snake_observations`` writes results/snake/observations.json, which
docs/validation/snake.md quotes, in a minute. All runs use the dynamic snake.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dynsim._version import __version__
from dynsim.engine import simulate
from dynsim.record import Record
from dynsim.scenario import load_scenario
from dynsim.system.files import write_json

FILE = Path("results/snake/observations.json")
MEASURED = ("beta", "y")
# Time from the start of a mode until wheels have reached their height [s].
LIFTING_S = 0.6
WHEELS, PAIRS = 14, 7


def switching_run(duration_s: float = 22.0) -> Record:
    """Run modes 1 to 6 of the paper's Table II, one after the other ([T] V.B)."""
    settings = {"plant.level": "dynamic", "duration_s": duration_s}
    return simulate(load_scenario("snake_joint_limits", "cyclic", settings))


def converged(variant: str) -> dict[str, float]:
    """Return the largest error of the head in the last second, measured by motion capture with 10 ms delay."""
    settings = {"controller.state": "measured", "sensors.motion_capture.delay_s": 0.01}
    record = simulate(load_scenario("snake_positioning_dynamic", variant, settings))
    off = np.abs(record["w"] - record["w_target"])[record.time >= record.time[-1] - 1.0]
    return {"position_mm": 1e3 * float(off[:, :3].max()), "attitude_mrad": 1e3 * float(off[:, 3:].max())}


def head_motion(record: Record) -> dict[str, float]:
    """Return the largest distance and rotation of the head from its pose at the first mode change, and its error."""
    switching = record.time >= 2.0
    w, target = record["w"][switching], record["w_target"][switching]
    moved, off = w - w[0], w - target
    return {
        "moved_mm": 1e3 * float(np.linalg.norm(moved[:, :3], axis=1).max()),
        "turned_rad": float(np.linalg.norm(moved[:, 3:], axis=1).max()),
        "error_mm": 1e3 * float(np.linalg.norm(off[:, :3], axis=1).max()),
        "error_rad": float(np.linalg.norm(off[:, 3:], axis=1).max()),
        "first_error_mm": 1e3 * float(np.linalg.norm(off[0, :3])),
        "first_error_rad": float(np.linalg.norm(off[0, 3:])),
    }


def settled(record: Record) -> np.ndarray:
    """Return a mask of samples at which the wheels have reached the heights of their mode, (T,)."""
    mode = record["mode"]
    begun = np.maximum.accumulate(np.where(np.diff(mode, prepend=mode[0]) != 0.0, record.time, 0.0))
    return record.time - begun > LIFTING_S


def lifted(record: Record) -> np.ndarray:
    """Return a mask of samples at which a pair has reached its lifted height, (T, 7)."""
    return (record["grounded"] == 0.0) & settled(record)[:, None]


def by_wheel(record: Record, signal: str) -> np.ndarray:
    """Return a contact signal for the wheels of each pair, (T, 7, 2)."""
    return record[signal][:, :WHEELS].reshape(-1, PAIRS, 2)


def wheel_heights(record: Record) -> dict[str, list[float]]:
    """Return mean heights of the lower and the higher wheel, by mode and lifted pair [mm]."""
    up, gaps = lifted(record), by_wheel(record, "contact_gap")
    heights = {}
    for mode in sorted(set(record["mode"])):
        for pair in range(PAIRS):
            chosen = gaps[up[:, pair] & (record["mode"] == mode), pair]
            if len(chosen):
                heights[f"mode {mode:.0f} pair {pair + 1}"] = [1e3 * x for x in np.sort(chosen, axis=1).mean(axis=0)]
    return heights


def study() -> dict[str, Any]:
    """Return all results."""
    record = switching_run()
    return {
        "dynsim_version": __version__,
        "measured_feedback": {variant: converged(variant) for variant in MEASURED},
        "mode_switching": head_motion(record),
        "lifted_wheels_mm": wheel_heights(record),
    }


if __name__ == "__main__":
    FILE.parent.mkdir(parents=True, exist_ok=True)
    write_json(FILE, study())
