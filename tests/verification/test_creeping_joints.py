"""Joints with dry friction that contacts hold at rest, and then move: energies follow the tolerance.

Such a joint has no row. It is known to move by its rate, and has the whole of its friction from then on. An elbow
slides in a wide pipe, whose normal turns: the pitch joint that it holds begins to move with the cube of the time. With
a limit of ten times rtol the energies were off by 21 rtol, whatever the errors of the steps.
"""

from __future__ import annotations

from functools import cache

import pytest

from dynsim import simulate
from dynsim.record import Record
from dynsim.scenario import scenario_from_resolved

ENERGIES = ("energy_electrical", "heat_joule", "heat_friction", "loss_gear")
MOTOR = {"type": "wang_minami", "coulomb_friction_N_m": 0.09648}


@cache
def dragged(method: str, rtol: float) -> Record:
    """An arm turns about its first joint and drags its elbow along a pipe of 4 m."""
    chain = [
        {"axis": axis, "length_m": length, "mass_kg": mass, "initial_deg": angle, "motor": MOTOR}
        for axis, length, mass, angle in (
            ("z", 0.0, 0.3357, -18.2156),
            ("y", 0.22201659533524337, 0.1296, 121.51289395441187),
            ("y", 0.23761313076082466, 0.44375, -52.12660890050773),
            ("y", 0.18455885414993292, 0.1877, 3.6687759926945063),
        )
    ]
    pipe = {"type": "cylinder", "radius_m": 4.0, "inside": True, "axis": [-0.9948553, 0.1011680, 0.0052888]}
    config = {
        "duration_s": 0.236,
        "plant": {"type": "serial_arm", "link": {"radius_m": 0.0125}, "chain": chain},
        "controller": {
            "type": "joint_pd",
            "k_p_V_per_rad": 127.8,
            "k_d_V_s_per_rad": 3.834,
            "joints": {"joint_1": {"times_s": [0.0, 0.118, 0.236], "angles_deg": [-18.2156, -24.8, -31.9]}},
        },
        "surfaces": {"floor": pipe | {"point_m": [0.21045, 0.034005, 3.8693036]}},
        "contacts": {
            "law": "unilateral",
            "points": {
                "elbow": {
                    "body": "link_3", "surface": "floor", "radius_m": 0.0145,
                    "friction": 0.1823, "static_friction": 0.2922,
                }
            },
        },
        "initial": {"on_surface": ["elbow"]},
        "integrator": {"method": method, "rtol": rtol},
    }  # fmt: skip
    return simulate(scenario_from_resolved(config))


@pytest.mark.long
@pytest.mark.parametrize(("rtol", "reference"), [(1e-6, 1e-8), (1e-7, 1e-9)])
@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_energies_where_elbows_slide_and_joints_rub_are_within_five_rtol(method: str, rtol: float, reference: float):
    """The references have a limit of 1e-8 rad/s, which is good for 3e-8 of the turnover."""
    exact, record = dragged("dopri5", reference), dragged(method, rtol)
    assert {"joint_1", "joint_2"} <= {event.name for event in exact.events if event.kind == "slip_start"}
    assert exact["heat_friction"][-1] > 0.01 * exact.summary["energy_turnover_J"]
    for name in ENERGIES:
        off = abs(record[name][-1] - exact[name][-1])
        assert off <= 5.0 * rtol * exact.summary["energy_turnover_J"], name
    assert record.summary["energy_residual_relative"] < rtol
