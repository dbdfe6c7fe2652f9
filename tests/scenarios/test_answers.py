"""The headers of scenarios state answers with numbers; the runs of their variants give these numbers."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import dynsim
from dynsim.errors import SimulationStopped
from dynsim.record import Record

# Headers round to two or three digits.
ROUNDED = {"rel": 0.03}


@cache
def run(name: str, variant: str) -> Record:
    return dynsim.simulate(dynsim.load_scenario(name, variant))


def column(record: Record, signal: str, label: str) -> np.ndarray:
    return record[signal][:, record.labels[signal].index(label)]


def energy(name: str, variant: str) -> float:
    return float(run(name, variant).summary["electrical_energy_J"])


def hand_error_mm(name: str, variant: str) -> float:
    return 1e3 * float(run(name, variant).summary["hand_error_rms_m"])


def test_spring_drawer() -> None:
    opens = run("spring_drawer", "opens")
    assert column(opens, "q", "drawer")[-1] == pytest.approx(0.291, **ROUNDED)
    assert np.abs(column(opens, "tie_force", "hook")).max() == pytest.approx(40.0, **ROUNDED)
    assert column(opens, "q", "trolley.x")[-1] - 0.38 == pytest.approx(-0.268, **ROUNDED)
    assert [energy("spring_drawer", each) for each in ("opens", "released")] == pytest.approx([186.0, 30.0], **ROUNDED)
    weak = run("spring_drawer", "weak_hook")
    assert np.abs(column(weak, "tie_force", "hook")).max() == pytest.approx(12.0)
    assert column(weak, "q", "drawer")[-1] == pytest.approx(0.162, **ROUNDED)
    # The chest lies on its side: cos of half the angle.
    assert column(run("spring_drawer", "braked"), "q", "trolley.qw")[-1] < np.cos(np.deg2rad(40.0))
    lids = [np.rad2deg(column(run("spring_drawer", each), "q", "lid").max()) for each in ("opens", "loose_lid")]
    assert lids == pytest.approx([19.0, 60.5], **ROUNDED)


def test_sampled_arm() -> None:
    currents = {
        each: next(m for m in run("sampled_arm", each).summary["motors"] if m["joint"] == "joint_4")["current_rms_A"]
        for each in ("ideal", "encoders", "coarse")
    }
    assert currents["encoders"] / currents["ideal"] == pytest.approx(1.43, **ROUNDED)
    assert currents["coarse"] / currents["ideal"] == pytest.approx(3.8, **ROUNDED)
    assert [hand_error_mm("sampled_arm", each) for each in currents] == pytest.approx([2.0] * 3, abs=0.2)
    assert energy("sampled_arm", "encoders") == pytest.approx(20.0, **ROUNDED)
    # The unstable loop oscillates between the voltage limits.
    assert energy("sampled_arm", "late") > 15.0 * energy("sampled_arm", "encoders")
    assert any("unstable" in warning for warning in run("sampled_arm", "late").summary["warnings"])
    assert energy("sampled_arm", "servos") == pytest.approx(4.4, **ROUNDED)
    assert hand_error_mm("sampled_arm", "servos") == pytest.approx(16.1, **ROUNDED)


@pytest.mark.long
def test_sampled_arm_with_the_dense_solver() -> None:
    """Both solvers take the same steps, and only rounding differs. No other default test compiles this solver."""
    np.testing.assert_allclose(
        run("sampled_arm", "dense")["q"], run("sampled_arm", "encoders")["q"], rtol=0, atol=1e-11
    )


def test_soft_floor() -> None:
    errors = {"rigid": 2.2, "rubber": 2.15, "foam": 7.6, "low_floor": 11.4, "dropped": 22.8}
    assert {each: hand_error_mm("soft_floor", each) for each in errors} == pytest.approx(errors, **ROUNDED)
    energies = {"rigid": 50.0, "skate": 29.3, "moon": 80.0}
    assert {each: energy("soft_floor", each) for each in energies} == pytest.approx(energies, **ROUNDED)
    free = {
        "controller.brace": None,
        "controller.min_N": 0.5,
        "controller.feed_forward": "dynamics",
        "contacts.points.elbow.enabled": False,
    }
    for variant, expected in (("moon", 17.0), ("rigid", 435.0)):
        record = dynsim.simulate(dynsim.load_scenario("soft_floor", variant, free))
        assert record.summary["electrical_energy_J"] == pytest.approx(expected, **ROUNDED)


def test_brace_on_shapes() -> None:
    plane = energy("brace_on_shapes", "flat")
    assert plane == pytest.approx(32.4, **ROUNDED)
    for shape in ("bowl", "pipe", "terrain"):
        assert 1.025 < energy("brace_on_shapes", shape) / plane < 1.065
    assert energy("brace_on_shapes", "ball") / plane == pytest.approx(1.21, abs=0.01)
    assert energy("brace_on_shapes", "block") / plane == pytest.approx(2.54, **ROUNDED)
    assert hand_error_mm("brace_on_shapes", "block") == pytest.approx(16.5, **ROUNDED)
    assert hand_error_mm("brace_on_shapes", "flat") == pytest.approx(7.6, **ROUNDED)
    assert energy("brace_on_shapes", "glued") == pytest.approx(plane, rel=1e-2)


def test_mobile_turns() -> None:
    margins = {"arc": 0.471, "fast_arc": 0.367, "recorded": 0.377}
    for variant, margin in margins.items():
        assert run("mobile_turns", variant).summary["base"]["tip_margin_min_settled"] == pytest.approx(
            margin, **ROUNDED
        )
    assert run("mobile_turns", "fast_arc").summary["base"]["traction_demand_max"] == pytest.approx(0.79, **ROUNDED)
    ends = [run("mobile_turns", variant)["tip_margin"][-1] for variant in ("arc", "driven")]
    assert ends == pytest.approx([0.506, 0.617], **ROUNDED)


def turn_deg(record: Record) -> float:
    """Angle by which the satellite has turned [°]."""
    w, *xyz = (column(record, "q", f"root.q{axis}")[-1] for axis in "wxyz")
    return float(np.rad2deg(2.0 * np.arctan2(np.linalg.norm(xyz), w)))


def test_free_flyer() -> None:
    cycle, back, quick, empty = (run("free_flyer", each) for each in ("cycle", "reversed", "quick", "empty"))
    assert [turn_deg(each) for each in (cycle, back, quick, empty)] == pytest.approx(
        [32.1, 32.0, 32.1, 28.3], **ROUNDED
    )
    assert column(cycle, "q", "root.qz")[-1] == pytest.approx(-column(back, "q", "root.qz")[-1], rel=1e-2)
    energies = [energy("free_flyer", each) for each in ("cycle", "quick")]
    assert energies == pytest.approx([19.8, 39.6], **ROUNDED)
    forces = [np.linalg.norm(record["wrench_force"], axis=2).max() for record in (cycle, quick)]
    assert forces == pytest.approx([1.43, 5.76], **ROUNDED)
    for record in (cycle, back, quick, empty):
        # The joints are back where they were, but for gear friction over k_p.
        joints = [column(record, "q", joint) for joint in ("rail", "shoulder", "elbow")]
        assert max(abs(joint[-1] - joint[0]) for joint in joints) < 1e-3


def test_corrected_arm() -> None:
    fixed, floating = (run("corrected_arm", each) for each in ("fixed", "floating"))
    swings = [np.rad2deg(column(record, "q", "shoulder")[-1]) for record in (fixed, floating)]
    assert swings[0] == pytest.approx(28.2, **ROUNDED)
    assert abs(swings[1]) < 0.01
    assert turn_deg(floating) == pytest.approx(17.2, **ROUNDED)
    assert [column(record, "q", "elbow")[0] for record in (fixed, floating)] == pytest.approx(np.deg2rad([10, 10]))


def test_snake_short() -> None:
    waits = {"circle": 0.0, "door": 0.0, "sideways": 4.78, "backward": 8.87}
    for variant, seconds in waits.items():
        assert run("snake_short", variant).summary["waiting_s"] == pytest.approx(seconds, abs=0.1)
    assert run("snake_short", "circle").summary["displacement"][1] == pytest.approx(1.0, abs=1e-4)
    door = run("snake_short", "door").summary
    assert door["displacement"][5] == pytest.approx(np.deg2rad(25.0), abs=1e-4)
    assert door["mode_switches"] == 0
    assert run("snake_short", "rises").summary["displacement"][2] == pytest.approx(0.044, abs=5e-4)


@pytest.mark.long
def test_snake_pull() -> None:
    ways = {"holds": 0.058, "slips": 0.0453, "encoders": 0.0517, "twists": np.deg2rad(23.0)}
    for variant, way_of_handle in ways.items():
        assert column(run("snake_pull", variant), "q", "handle").max() == pytest.approx(way_of_handle, **ROUNDED)
    for variant, slips in (("holds", False), ("slips", True), ("encoders", False), ("twists", True)):
        assert ("gripper slips" in [event.kind for event in run("snake_pull", variant).events]) == slips
    beyond = run("snake_pull", "shoved").summary["joint_limit_violation_max_rad"]
    assert np.rad2deg(beyond) == pytest.approx(0.6, abs=0.05)
    strong = {"loads.shove.force_N": [[0, 0, 0], [0, 15, 0], [0, 15, 0], [0, 0, 0]]}
    with pytest.raises(SimulationStopped, match="overturned"):
        dynsim.simulate(dynsim.load_scenario("snake_pull", "shoved", strong))


def test_push_box() -> None:
    """The table turns μ m g times the distance into heat; after the shove the box slides on by v²/(2 μ g)."""
    weight, moved = 2.0 * 9.81, {"pushes": 0.130, "shoves": 0.191}
    for variant, distance in moved.items():
        record = run("push_box", variant)
        x = column(record, "q", "box.x")
        assert x[-1] - x[0] == pytest.approx(distance, **ROUNDED)
        assert record.summary["friction_heat_J"] == pytest.approx(0.3 * weight * (x[-1] - x[0]), rel=1e-5)
    # From rest to rest, hand and friction have the same impulse.
    pushes = run("push_box", "pushes")
    times = {event.kind: event.time for event in pushes.events if event.name == "box1.table"}
    start, end = times["slip_start"], times["slip_stop"]
    impulse = np.diff(np.interp([start - 0.01, end], pushes.time, column(pushes, "contact_impulse", "link_3-box")))
    assert impulse == pytest.approx([0.3 * weight * (end - start)], rel=2e-3)
    shoves = run("push_box", "shoves")
    leaves = next(event.time for event in shoves.events if (event.kind, event.name) == ("lift_off", "link_3-box"))
    at, speed = (np.interp(leaves, shoves.time, column(shoves, kind, "box.x")) for kind in ("q", "v"))
    alone = column(shoves, "q", "box.x")[-1] - at
    assert alone == pytest.approx(speed**2 / (2.0 * 0.3 * 9.81), rel=0.01)
    assert alone == pytest.approx(0.107, **ROUNDED)


def test_brace_on_itself() -> None:
    energies = {"braced": 128.0, "all_links": 128.0, "free": 213.0}
    assert {each: energy("brace_on_itself", each) for each in energies} == pytest.approx(energies, **ROUNDED)
    (elbow,) = run("brace_on_itself", "braced").summary["contacts"]
    links = run("brace_on_itself", "all_links").summary["contacts"]
    assert elbow["normal_force_mean_N"] == pytest.approx(4.8, **ROUNDED)
    assert sum(contact["normal_force_mean_N"] for contact in links) == pytest.approx(4.8, **ROUNDED)
    assert [contact["name"] for contact in links if contact["closed_fraction"]] == ["link_2-link_4"]


def test_box_on_brace() -> None:
    elbows = {
        each: next(c for c in run("box_on_brace", each).summary["contacts"] if c["name"] == "elbow")
        for each in ("light", "heavy", "too_heavy")
    }
    assert [elbow["lift_offs"] for elbow in elbows.values()] == [0, 0, 1]
    assert [1e3 * elbows[each]["slip_distance_m"] for each in ("light", "heavy")] == pytest.approx([1.0, 3.0], rel=0.1)
    assert [energy("box_on_brace", each) for each in elbows] == pytest.approx([105.0, 1100.0, 4400.0], **ROUNDED)
    assert column(run("box_on_brace", "too_heavy"), "q", "box.z")[-1] == pytest.approx(0.015, abs=1e-4)
