"""Study: results of the kinematic snake scenarios, and their sensitivity to settings.

``PYTHONPATH=tests python -m studies.snake_kinematic`` writes results/snake/kinematic.json, which
docs/validation/snake.md quotes, in half a minute with compiled kernels.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dynsim._version import __version__
from dynsim.engine import simulate
from dynsim.errors import CheckRefused
from dynsim.hardware.replay.check import check_motion
from dynsim.hardware.servo_map import SHIPPED, ServoMap, load_servo_map
from dynsim.record import Record
from dynsim.scenario import load_scenario, variant_names
from dynsim.system.files import write_json

FILE = Path("results/snake/kinematic.json")
NAMES = (
    "snake_positioning",
    "snake_joint_limits",
    "snake_circle",
    "snake_circle_backward",
    "snake_door_arc",
    "snake_operator",
)
KEPT = (
    "final_position_error_m",
    "final_attitude_error_rad",
    "position_error_max_m",
    "attitude_error_max_rad",
    "joint_limit_violation_max_rad",
    "waiting_s",
    "waiting_for_s",
    "cost_initial",
    "cost_final",
    "mode_switches",
    "modes_refused",
    "support_margin_min_m",
    "support_area_final_m2",
)
# The circle backward with less time, or with a larger least margin: duration of the path [s], margin [m].
CIRCLES = ((400.0, 0.02), (200.0, 0.01), (200.0, 0.02))
# Servo map: allowed height of a wheel on the ground [mm], acceleration up to a motion's start [rad/s²].
TILT_MM, RUN_UP = 18.0, 10.0
# Gains of the redundancy, for the order in which the joints of the base become straight.
NULL_GAINS = (0.1, 0.3, 1.0)


def simulated(name: str, variant: str | None, overrides: Mapping[str, Any] | None = None) -> Record:
    """Return the record of a shipped scenario with overrides."""
    return simulate(load_scenario(name, variant, overrides))


def outcome(record: Record) -> dict[str, Any]:
    """Return the numbers of a run."""
    rise = np.diff(record["cost"])
    same = np.diff(record["mode"]) == 0
    return {
        **{key: record.summary[key] for key in KEPT},
        "duration_s": float(record.time[-1]),
        "turned_deg": float(np.rad2deg(record["w"][-1, 5] - record["w"][0, 5])),
        "base_rms_rad": float(np.sqrt(np.mean(record["phi"][-1, 6:] ** 2))),
        "cost_rise_max_within_a_mode": float(rise[same].max()),
    }


def wider_map() -> ServoMap:
    """Return the shipped servo map for a robot whose grounded wheels may rise and whose joints may start fast."""
    content = yaml.safe_load((SHIPPED / "snake.yaml").read_text(encoding="utf-8"))
    content["lifts"]["tilt_mm"], content["safety"]["run_up"] = TILT_MM, RUN_UP
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "snake.yaml")
        file.write_text(yaml.safe_dump(content), encoding="utf-8")
        return load_servo_map(file)


def verdict(record: Record, servo_map: ServoMap) -> str:
    """Return the first reason of ``dynsim hw check`` to refuse a record at its own speed, or an empty text."""
    try:
        check_motion(record, servo_map)
    except CheckRefused as refused:
        return str(refused)
    return ""


def halved(record: Record) -> dict[str, float | None]:
    """Return when joints of the base finally fall below half of their initial angle [s]; None: not within the run."""
    times: dict[str, float | None] = {}
    names = record.labels["phi"]
    for j in range(6, record["phi"].shape[1]):
        above = np.flatnonzero(np.abs(record["phi"][:, j]) >= 0.5 * np.abs(record["phi"][0, j]))[-1]
        times[names[j]] = float(record.time[above + 1]) if above + 1 < len(record.time) else None
    return times


def circle(duration: float, margin: float) -> dict[str, Any]:
    """Return the circle backward with a different path duration and least margin."""
    path = load_scenario("snake_circle_backward").resolved["controller"]["paths"][0]
    settings = {
        "controller.paths": [path | {"duration_s": duration}],
        "controller.switching.least_margin_m": margin,
        "duration_s": duration + 80.0,
    }
    return {"path_s": duration, "least_margin_m": margin} | outcome(simulated("snake_circle_backward", None, settings))


def order(null_gain: float) -> dict[str, Any]:
    """Return when the joints of the base become straight, with modes in turn and a gain of the redundancy."""
    record = simulated("snake_joint_limits", "cyclic", {"controller.null_gain": null_gain})
    reduced = record.summary["null_space_reduced_s"]
    return {"null_gain": null_gain, "halved_s": halved(record), "null_space_reduced_s": reduced}


def study() -> dict[str, Any]:
    """Return all results."""
    maps = {"shipped": load_servo_map("snake"), "wider": wider_map()}
    runs: dict[str, dict[str, Any]] = {}
    servos: dict[str, dict[str, Any]] = {}
    for name in NAMES:
        runs[name], servos[name] = {}, {}
        for variant in variant_names(name) or [None]:
            record = simulated(name, variant)
            runs[name][variant or ""] = outcome(record)
            servos[name][variant or ""] = {kind: verdict(record, servo_map) for kind, servo_map in maps.items()}
    predictive = simulated("snake_joint_limits", "eq20", {"controller.switching.policy": "predictive"})
    return {
        "dynsim_version": __version__,
        "runs": runs,
        "servos": servos,
        "circles": [circle(duration, margin) for duration, margin in CIRCLES],
        "order": [order(gain) for gain in NULL_GAINS],
        "eq20_predictive": outcome(predictive),
    }


if __name__ == "__main__":
    FILE.parent.mkdir(parents=True, exist_ok=True)
    write_json(FILE, study())
