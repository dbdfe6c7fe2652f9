"""What motors have to give in a run, beside what they can for ever."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dynsim.model.description import Array, Robot
from dynsim.model.drives import Drive, TorqueSource
from dynsim.record import Record


def motor_loads(record: Record, robot: Robot) -> list[dict[str, Any]]:
    """Of each motor the root mean square and the largest current and torque at the shaft, and its ratings.

    Over the whole run, by trapezoids between the samples; a rating that is not known is left out.
    """
    units = {link.joint: "N_m" if link.units[3] == "N m" else "N" for link in robot.links}
    # Along samples, which lie together then: a third of the time.
    values = {name: np.ascontiguousarray(record[name].T) for name in ("current", "torque")}
    rms = {name: _rms(record.time, rows).tolist() for name, rows in values.items()}
    most = {
        name: np.maximum(rows.max(axis=1, initial=0.0), -rows.min(axis=1, initial=0.0)).tolist()
        for name, rows in values.items()
    }
    found = []
    for a, motor in enumerate(robot.motors):
        unit = units[motor.joint]
        entry: dict[str, Any] = {"joint": motor.joint}
        torque = "torque" if unit == "N_m" else "force"
        if not isinstance(motor, TorqueSource):
            entry |= {"current_rms_A": rms["current"][a], "current_max_A": most["current"][a]}
        entry |= {f"{torque}_rms_{unit}": rms["torque"][a], f"{torque}_max_{unit}": most["torque"][a]}
        for key, rating in _ratings(motor, f"nominal_{torque}_{unit}").items():
            if np.isfinite(rating):
                entry[key] = rating
        found.append(entry)
    return found


def _ratings(motor: Drive, torque: str) -> dict[str, float]:
    """Ratings by key, infinite where they are not known."""
    if isinstance(motor, TorqueSource):
        return {torque: motor.nominal_torque}
    return {
        "nominal_current_A": motor.nominal_current,
        "peak_current_A": motor.greatest_current,
        torque: motor.nominal_torque,
    }


def _rms(time: Array, values: Array) -> Array:
    """Root mean square over time of each row, (k, T) → (k,)."""
    if len(time) < 2:
        return np.abs(values).max(axis=1, initial=0.0)
    # Half of each interval belongs to the sample at either end of it.
    weight = np.zeros(len(time))
    weight[:-1] = np.diff(time)
    weight[1:] += weight[:-1].copy()
    mean: Array = (values * values) @ weight / (2.0 * (time[-1] - time[0]))
    return np.sqrt(mean)


def overloaded(loads: Sequence[dict[str, Any]]) -> list[str]:
    """Warnings of motors whose root mean square is above what they can give for ever, the most loaded first."""
    found = []
    for what, quantity, unit in (("current", "current", "A"), ("torque", "torque", "N_m"), ("force", "force", "N")):
        over = []
        for one in loads:
            rms, nominal = one.get(f"{quantity}_rms_{unit}"), one.get(f"nominal_{quantity}_{unit}")
            if rms is not None and nominal is not None and rms > nominal:
                over.append((rms / nominal, f"{one['joint']} {rms:.3g} of {nominal:g} {unit.replace('_', ' ')}"))
        if over:
            texts = [text for _, text in sorted(over, key=lambda entry: -entry[0])]
            found.append(
                f"{', '.join(texts)}: the {what}, rms over the run, is more than nominal, which a motor does not "
                "stand for long; brace the arm, go slower, or take a larger motor"
            )
    return found
