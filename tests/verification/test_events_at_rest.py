"""Events between two instants of rest: nothing but the forces changes, so nothing else limits the steps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from dynsim.engine import simulate
from dynsim.scenario.reading import scenario_from_resolved

TIMES = [0.0, 0.4, 0.45, 0.5, 1.0]


def scene(kind: str, method: str) -> dict[str, Any]:
    """A link without weight, held by a stop, a wall or dry friction, whose torque lets it go for 0.1 s."""
    link: dict[str, Any] = {"axis": "y", "length_m": 0.3, "mass_kg": 0.3, "motor": {"type": "torque"}}
    torques = [1.0, 1.0, -1.0, 1.0, 1.0]
    data: dict[str, Any] = {"name": kind, "duration_s": 1.0, "contacts": {"law": "unilateral"}}
    if kind == "stop":
        link["limit_deg"] = [-90, 0]
    elif kind == "friction":
        link["friction_N_m"], torques = 1.5, [0.5, 0.5, 4.0, 0.5, 0.5]
    else:
        data["surfaces"] = {"wall": {"type": "plane", "normal": [-1, 0, 0]}}
        data["contacts"]["points"] = {"tip": {"body": "link_1", "point_m": [0, 0, 0.3], "surface": "wall"}}
    plan = {"joint_1": {"times_s": TIMES, "torques_N_m": torques}}
    return data | {
        "plant": {"type": "serial_arm", "gravity_m_s2": [0, 0, 0], "chain": [link]},
        "controller": {"type": "joint_pd", "torques": plan},
        "integrator": {"method": method},
        "record": {"rate_hz": 500},
    }


@pytest.mark.parametrize("kind", ["stop", "contact", "friction"])
def test_an_event_while_everything_rests_is_located(kind: str) -> None:
    """Explicit steps grew to 0.3 s, past the instants at which the link left and came back."""
    explicit, implicit = (simulate(scenario_from_resolved(scene(kind, method))) for method in ("dopri5", "radau5"))
    assert len(explicit.events) == len(implicit.events) > 0
    times = [[event.time for event in record.events] for record in (explicit, implicit)]
    np.testing.assert_allclose(*times, rtol=0, atol=1e-5)
    # Both to rtol 1e-6.
    np.testing.assert_allclose(explicit["q"], implicit["q"], rtol=0, atol=1e-4)
    if kind == "contact":
        assert explicit["contact_normal_force"].min() >= -1e-6


def block(law: str, method: str) -> dict[str, Any]:
    """1 kg on a floor, which a torque source, or a load, may lift."""
    chain = [{"axis": axis, "kind": "prismatic", "length_m": 0.0, "mass_kg": 1.0} for axis in "xz"]
    return {
        "name": "block",
        "duration_s": 3.0,
        "plant": {"type": "serial_arm", "chain": chain},
        "surfaces": {"floor": {"type": "plane"}},
        "contacts": {"law": law, "friction": 0.3, "points": {"foot": {"body": "link_2", "surface": "floor"}}},
        "integrator": {"method": method},
        "record": {"rate_hz": 2000},
    }


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_a_force_that_passes_its_bound_between_two_waypoints_is_seen(method: str) -> None:
    """It lifts off where the cubic through the waypoints is the weight; radau5 went from one waypoint to the next."""
    times, forces = [0.0, 1.0, 2.0, 3.0], [4.0, 9.0, 9.0, 4.0]
    data = block("unilateral", method)
    data["plant"]["chain"][1]["motor"] = {"type": "torque"}
    data["controller"] = {"type": "joint_pd", "torques": {"joint_2": {"times_s": times, "torques_N_m": forces}}}
    record = simulate(scenario_from_resolved(data))
    weight = CubicSpline(times, forces, bc_type="clamped").solve(9.81)
    lift = next(event.time for event in record.events if event.kind == "lift_off")
    assert lift == pytest.approx(min(weight[weight > 0.0]), abs=1e-3)
    assert record["contact_normal_force"].min() > -1e-6


@pytest.mark.parametrize("law", ["bilateral", "unilateral"])
@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_the_mean_force_under_a_load_of_two_samples_is_right(law: str, method: str) -> None:
    """Its ramp is between them, and the load continues after the second; nothing else limits the steps."""
    data = block(law, method)
    ramp = {"times_s": [1.3, 1.7], "force_N": [[0, 0, 0], [0, 0, -30]], "interpolation": "linear", "hold": True}
    data["loads"] = {"press": {"type": "samples", "body": "link_2"} | ramp}
    record = simulate(scenario_from_resolved(data))
    # From the middle of the ramp on.
    impulse = 3.0 * 9.81 + 1.5 * 30.0
    assert record.summary["contacts"][0]["normal_force_mean_N"] == pytest.approx(impulse / 3.0, rel=1e-9)


def test_explicit_steps_see_the_pull_of_a_glued_contact_that_nothing_moves() -> None:
    """A force of a few tenths of a second; the mean over the run was 36 % off, and the pull was not there."""
    times, forces = [0.2 * k for k in range(11)], [0.0, 0, -4, 0, 14, 0, -3, 0, 12, 0, 0]
    data = block("bilateral", "dopri5") | {"duration_s": 2.0}
    data["plant"]["chain"][1]["motor"] = {"type": "torque"}
    data["controller"] = {"type": "joint_pd", "torques": {"joint_2": {"times_s": times, "torques_N_m": forces}}}
    record = simulate(scenario_from_resolved(data))
    force = 9.81 - CubicSpline(times, forces, bc_type="clamped")(record.time)
    contact = record.summary["contacts"][0]
    mean = float(np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(record.time))) / 2.0
    assert contact["normal_force_mean_N"] == pytest.approx(mean, rel=1e-3)
    assert contact["pulling_fraction"] == pytest.approx(float((force < 0.0).mean()), abs=0.01)


@pytest.mark.parametrize("method", ["dopri5", "radau5"])
def test_the_heat_of_a_servo_that_pushes_against_a_stop_is_right(method: str) -> None:
    """Its voltage follows the reference into the limit and out again; ∫ u²/R from the samples of the voltage.

    Nothing moves, and the currents of servos are not states: dopri5 missed 2e-4 of this heat at any rtol.
    """
    servo = {"type": "servo", "voltage_V": 12, "stall_torque_N_m": 10, "no_load_speed_rad_per_s": 6}
    servo |= {"k_p_V_per_rad": 30}
    data = scene("stop", method)
    data["plant"]["chain"][0]["motor"] = servo
    data["controller"] = {"type": "joint_pd", "joints": {"joint_1": {"times_s": [0, 0.5, 1], "angles_deg": [0, 60, 0]}}}
    record = simulate(scenario_from_resolved(data | {"record": {"rate_hz": 20_000}}))
    assert np.abs(record["q"]).max() < 1e-9
    voltage = record["voltage"][:, 0]
    assert voltage.max() == 12.0
    power = record["current"][:, 0] * voltage
    heat = float(np.sum(0.5 * (power[1:] + power[:-1]) * np.diff(record.time)))
    np.testing.assert_allclose(record["heat_joule"][-1], heat, rtol=2e-5)
    np.testing.assert_allclose(record["energy_electrical"][-1], heat, rtol=2e-5)
