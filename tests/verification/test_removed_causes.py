"""Causes of distances from targets, checked by removal: random arms with limits, stops, friction, floors and loads.

An arm without the first cause must come closer to its target, by the share of the cause within a margin. Another effect
may take over instead, such as friction that holds an arm without weight, so that a tenth of the arms may fail.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from numpy.random import Generator

import dynsim
from dynsim.errors import DynsimError
from dynsim.scenario.reading import scenario_from_resolved

SCENES, MARGIN, EXCEPTIONS = 150, 0.3, 0.1
# Causes that nothing in a scene can remove without another motion.
LEFT = ("motion", "reference")


def drawn(random: Generator) -> dict[str, Any]:
    """Return an arm in a vertical plane whose joints follow waypoints to the target of the hand."""

    def between(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    count, servos = int(random.integers(1, 5)), random.random() < 0.3
    chain: list[dict[str, Any]] = []
    for k in range(count):
        motor = {
            "type": "dc", "torque_constant_N_m_per_A": between(0.5, 3.0), "resistance_ohm": 1.0, "inductance_H": 1e-3,
            "gear_ratio": 1.0, "rotor_inertia_kg_m2": 5e-3,
        } | ({"voltage_limit_V": between(0.5, 8.0)} if random.random() < 0.4 else {})  # fmt: skip
        if servos:
            motor = {
                "type": "servo", "voltage_V": 12.0, "stall_torque_N_m": between(1.0, 15.0),
                "no_load_speed_rad_per_s": 6.0, "k_p_V_per_rad": between(5.0, 60.0),
                "coulomb_friction_N_m": float(random.choice([0.0, 0.3, 1.5])),
            }  # fmt: skip
        start = between(20.0, 80.0) if k == 0 else between(-60.0, 60.0)
        link = {"length_m": between(0.2, 0.4), "mass_kg": between(0.1, 0.6), "damping_N_m_s_per_rad": 1.0}
        stops = {"limit_deg": [start - 20.0, start + between(3.0, 20.0)]} if random.random() < 0.2 else {}
        chain.append({**link, "motor": motor, "initial_deg": start, **stops})
    gains = {} if servos else {"k_p_V_per_rad": 10.0 ** between(0.7, 2.3), "k_d_V_s_per_rad": 3.0}
    ends = [link["initial_deg"] + between(-15.0, 30.0) for link in chain]
    joints = {
        f"joint_{k + 1}": {"times_s": [0.0, 1.0], "angles_deg": [link["initial_deg"], end]}
        for k, (link, end) in enumerate(zip(chain, ends, strict=True))
    }
    tip = {"body": f"link_{count}", "point_m": [0.0, 0.0, chain[-1]["length_m"]]}
    floor = {"floor": {"type": "plane", "point_m": [0.0, 0.0, between(-0.1, 0.3)]}} if random.random() < 0.5 else {}
    push = {"type": "constant", "body": tip["body"], "force_N": random.uniform(-4.0, 4.0, 3).tolist()}
    path = {"type": "line", "from_m": [0, 0, 0], "to_m": [0, 0, 0], "duration_s": 1.0}
    data = {
        "name": "random",
        "duration_s": 8.0,
        "record": {"rate_hz": 20},
        "plant": {"type": "serial_arm", "chain": chain},
        "surfaces": floor,
        "contacts": {"law": "unilateral", "friction": 0.3, "points": {"tip": tip} if floor else {}},
        "loads": {"push": push} if random.random() < 0.3 else {},
        "controller": {"type": "joint_pd", "joints": joints, "hand": {"joints": [], "path": path}, **gains},
    }
    model = dynsim.build_model(scenario_from_resolved(data))
    at = (model.point_position(*model.robot.hand, q) for q in (model.robot.initial, np.deg2rad(ends)))
    path["from_m"], path["to_m"] = (position.tolist() for position in at)
    return data


def without(data: dict[str, Any], cause: str) -> dict[str, Any]:
    """Return the scene without the cause."""
    data = copy.deepcopy(data)
    for link in data["plant"]["chain"]:
        motor = link["motor"]
        if cause == "limit":
            motor.pop("voltage_limit_V", None)
            for key in ("voltage_V", "stall_torque_N_m", "no_load_speed_rad_per_s"):
                motor |= {key: 50.0 * motor[key]} if key in motor else {}
        if cause == "stop":
            link.pop("limit_deg", None)
        if cause == "friction":
            motor["coulomb_friction_N_m"] = 0.0
    if cause in ("sag", "deflection"):
        data["plant"]["gravity_m_s2"] = [0, 0, 0]
    if cause in ("contact", "deflection"):
        data["contacts"]["points"] = {}
    if cause in ("load", "deflection"):
        data["loads"] = {}
    return data


def summary(data: dict[str, Any]) -> dict[str, Any] | None:
    """Return the summary of a run, None if the arm is refused or its run stops."""
    try:
        return dynsim.simulate(scenario_from_resolved(data)).summary
    except DynsimError:
        return None


@pytest.mark.long
def test_hands_are_closer_without_the_cause() -> None:
    checked, exceptions = set[str](), []
    count = 0
    for k in range(SCENES):
        data = drawn(np.random.default_rng([51, k]))
        before = summary(data)
        if before is None or not before["hand_error_causes"] or before["hand_error_causes"][0]["cause"] in LEFT:
            continue
        first = before["hand_error_causes"][0]
        after = summary(without(data, first["cause"]))
        if after is None:
            continue
        count += 1
        checked.add(first["cause"])
        part = 1.0 - min(first["share"], 1.0) + MARGIN
        if after["hand_error_end_m"] > part * before["hand_error_end_m"]:
            exceptions.append((k, first, before["hand_error_end_m"], after["hand_error_end_m"]))
    assert count > SCENES / 3
    assert checked >= {"sag", "limit", "stop", "load", "contact", "friction"}
    assert len(exceptions) <= EXCEPTIONS * count, exceptions
