"""Each check finds what it is there for: a good record passes, and each way of spoiling it is found by that check."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from combinations.checks import problems
from combinations.running import Run
from dynsim import check, simulate
from dynsim.errors import DynsimError, SimulationStopped
from dynsim.record import Record
from dynsim.scenario.reading import scenario_from_resolved

# Two pitch joints whose tip slides over a floor, sticks and lifts off; a box that slides down beside them.
ARM = {
    "name": "checked",
    "duration_s": 0.4,
    "plant": {
        "type": "serial_arm",
        "link": {"radius_m": 0.01, "damping_N_m_s_per_rad": 0.05, "motor": {"type": "wang_minami"}},
        "chain": [
            {"axis": "z", "length_m": 0.0, "mass_kg": 0.2},
            {"axis": "y", "length_m": 0.3, "mass_kg": 0.4, "initial_deg": 60.0, "friction_N_m": 0.02},
            {"axis": "y", "length_m": 0.3, "mass_kg": 0.4, "initial_deg": 80.0, "limit_deg": [-170.0, 100.0]},
        ],
    },
    "controller": {"type": "joint_pd", "k_p_V_per_rad": 60.0, "k_d_V_s_per_rad": 2.0},
    "surfaces": {"floor": {"type": "plane", "point_m": [0.0, 0.0, -0.09]}},
    "contacts": {
        "law": "unilateral",
        "friction": 0.3,
        "points": {"tip": {"body": "link_3", "point_m": [0.0, 0.0, 0.3], "surface": "floor"}},
    },
    "loads": {
        "push": {"type": "constant", "body": "link_3", "force_N": [1.5, 0.5, -2.0]},
        "lean": {"type": "constant", "body": "box", "force_N": [0.8, 0.0, 0.0]},
    },
    "objects": {
        "box": {"mass_kg": 0.5, "size_m": [0.1, 0.1, 0.1], "position_m": [1.0, 1.0, -0.03], "rpy_deg": [5, 0, 0]}
    },
    "record": {"rate_hz": 1000.0},
    "metrics": {"settle_s": 0.0},
}


@cache
def _run(method: str, kind: str = "") -> Run:
    settings = deepcopy(ARM)
    settings["integrator"] = {"method": method}
    if kind == "sampled":
        settings["controller"]["sample_time_s"] = 0.002
        del settings["plant"]["chain"][1]["friction_N_m"]
    return _simulated(settings)


def _simulated(settings: dict[str, Any]) -> Run:
    scenario, checked = scenario_from_resolved(settings), None
    record, failure = None, None
    try:
        check(scenario)
    except DynsimError as error:
        checked = str(error)
    try:
        record = simulate(scenario)
    except SimulationStopped as stop:
        record, failure = stop.record, stop
    except DynsimError as error:
        failure = error
    said = list(record.summary["warnings"]) if record is not None else []
    return Run(settings, scenario, scenario.integrator.method, "simulate", record, failure, said, checked)


def _spoilt(run: Run, **signals: Callable[[np.ndarray], np.ndarray]) -> Run:
    """The run with some signals of its record changed."""
    assert run.record is not None
    record = Record(run.record.time, provenance=run.record.provenance)
    record.signals.update(run.record.signals)
    record.summary.update(run.record.summary)
    record.events.extend(run.record.events)
    for name, change in signals.items():
        signal = record.signals[name]
        record.signals[name] = replace(signal, data=change(np.array(signal.data)))
    return replace(run, record=record)


def _kinds(run: Run) -> set[str]:
    return {problem.kind for problem in problems(run.scenario, run)}


@pytest.mark.parametrize("kind", ["", "sampled"])
@pytest.mark.parametrize("method", ["dopri5", "radau5", "time_stepping"])
def test_good_records_pass(method: str, kind: str) -> None:
    run = _run(method, kind)
    assert problems(run.scenario, run) == []
    # There is something to check: contacts that slide and stick, a stop, dry friction.
    assert run.record is not None
    modes = run.record["contact_mode"]
    assert {0, 1} <= set(np.unique(modes))


def _shifted(by: float, first: int = 0, count: int | None = None) -> Callable[[np.ndarray], np.ndarray]:
    def change(data: np.ndarray) -> np.ndarray:
        data[first : None if count is None else first + count] += by
        return data

    return change


def _times(factor: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda data: factor * data


def _turned_tangent(data: np.ndarray) -> np.ndarray:
    """Friction on the floor turned by 40°, normal forces kept."""
    turn = np.radians(40.0)
    x, y = data[..., 0].copy(), data[..., 1].copy()
    data[..., 0], data[..., 1] = np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y
    return data


def _stronger_friction(data: np.ndarray) -> np.ndarray:
    data[..., :2] *= 1.2
    return data


def _with_nan(data: np.ndarray) -> np.ndarray:
    data[len(data) // 2] = np.nan
    return data


def _one_absurd(data: np.ndarray) -> np.ndarray:
    data[len(data) // 2] = 1e16
    return data


def _falling(data: np.ndarray) -> np.ndarray:
    data[len(data) // 2 :] -= 0.05 * data.max()
    return data


def _lagging(data: np.ndarray) -> np.ndarray:
    """Held a tick longer than it was."""
    return np.concatenate([data[:2], data[:-2]])


SPOILT: dict[str, tuple[dict[str, Callable[[np.ndarray], np.ndarray]], set[str]]] = {
    "first sample elsewhere": ({"q": _shifted(0.01, 0, 1)}, {"start"}),
    "starts moving": ({"v": _shifted(0.01, 0, 1)}, {"start"}),
    "accelerations of other forces": ({"vdot": _times(1.05)}, {"motion"}),
    "current that gives another torque": ({"current": _times(1.05)}, {"equation"}),
    "turned tangent": ({"contact_force": _turned_tangent}, {"equation", "friction", "momentum"}),
    "outside the cone": ({"contact_force": _stronger_friction}, {"friction"}),
    "other normal force": ({"contact_normal_force": _times(1.01)}, {"touching"}),
    "pulling": ({"contact_normal_force": _times(-1.0), "contact_force": _times(-1.0)}, {"touching", "equation"}),
    "force of an open contact": ({"contact_mode": _times(0.0)}, {"touching"}),
    "other gap": ({"contact_gap": _shifted(1e-4)}, {"touching"}),
    "slip of the other way": ({"contact_slip_velocity": _times(-1.0)}, {"touching"}),
    "dry friction beyond its bound": ({"joint_friction": _times(1.5)}, {"dry", "equation"}),
    "dry friction that drives": ({"joint_friction": _times(-1.0)}, {"dry", "equation"}),
    "kinetic energy": ({"energy_kinetic": _times(1.001)}, {"ledger"}),
    "electrical energy": ({"energy_electrical": _times(1.01)}, {"ledger"}),
    "Joule heat": ({"heat_joule": _times(1.5)}, {"powers"}),
    "losses": ({"loss_joint": _times(1.5)}, {"powers"}),
    "losses that fall": ({"loss_joint": _falling}, {"losses"}),
    "voltage of another gain": ({"voltage": _times(1.1)}, {"commands"}),
    "not finite": ({"contact_force": _with_nan}, {"finite"}),
    "absurd force": ({"contact_normal_force": _one_absurd}, {"absurd"}),
}


@pytest.mark.parametrize("fault", SPOILT)
@pytest.mark.parametrize("method", ["radau5", "time_stepping"])
def test_what_is_spoilt_is_found(method: str, fault: str) -> None:
    changes, expected = SPOILT[fault]
    spoilt = _spoilt(_run(method), **changes)
    assert expected <= _kinds(spoilt)
