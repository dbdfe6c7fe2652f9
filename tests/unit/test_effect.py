"""Scenario keys without effect: each that a file sets is reported; such defaults are not in resolved scenarios."""

from __future__ import annotations

from typing import Any

import pytest
from support.messages import check_message

from dynsim import check, load_scenario
from dynsim.scenario.effect import idle_keys, is_set, without_effect
from dynsim.scenario.reading import scenario_from_resolved, variant_names
from dynsim.system.shipped import shipped_scenarios

FLOOR, FIXED = "elbow_comparison_floor", {"method": "time_stepping"}
LATE = {"type": "line", "from_m": [1, 1, 0.5], "to_m": [1, 1.1, 0.5], "start_s": 9, "duration_s": 1}
PUSH = {"type": "samples", "body": "link_4", "times_s": [3, 4], "force_N": [[1, 0, 0], [1, 0, 0]]}


@pytest.mark.parametrize(
    ("name", "overrides", "key", "names"),
    [
        (FLOOR, {"integrator": {**FIXED, "rtol": 1e-8}}, "integrator.rtol", "time_stepping integrator.step_s"),
        (FLOOR, {"integrator": {**FIXED, "step_max_s": 1}}, "integrator.step_max_s", "time_stepping integrator.step_s"),
        ("falling_arm", {"contacts.reference_tolerance_m": 0.1}, "contacts.reference_tolerance_m", "law: bilateral"),
        (
            "single_pendulum",
            {"contacts": {"friction": 0.3}},
            "contacts.friction",
            "contacts.points contacts.candidates",
        ),
        ("single_pendulum", {"controller": {"type": "joint_pd", "k_p_V_per_rad": 9}}, "controller", ""),
        ("elbow_comparison", {"duration_s": 1, "metrics.settle_s": 3}, "metrics.settle_s", "1"),
        ("elbow_comparison", {"duration_s": 1, "controller.hand.path": LATE}, "controller.hand.path", "9 1"),
        (
            "elbow_comparison",
            {"duration_s": 1, "controller.joints": {"joint_2": {"times_s": [2, 3], "angles_deg": [45, 50]}}},
            "controller.joints.joint_2",
            "2 1",
        ),
        ("elbow_comparison", {"duration_s": 1, "loads": {"push": PUSH}}, "loads.push", "3 1"),
        (
            "elbow_comparison",
            {"controller": {"type": "joint_pd", "knot_spacing_s": 0.1, "hand": None}},
            "controller.knot_spacing_s",
            "",
        ),
        (
            "snake_positioning",
            {"plant.level": "dynamic", "sensors.encoders.delay_s": 0.01},
            "sensors.encoders",
            "controller.state feedforward",
        ),
        (FLOOR, {"surfaces.lid": {"type": "plane", "on": "link_3"}}, "surfaces.lid", "link_3"),
        (
            FLOOR,
            {
                "contacts.candidates": "links",
                "contacts.points": {"p": {"body": "link_5", "surface": "s"}},
                "surfaces": {"s": {"type": "plane", "on": "link_3"}},
            },
            "contacts.candidates",
            "surfaces world",
        ),
        ("snake_circle", {"integrator.rtol": 1e-8}, "integrator.rtol", "snake kinematic"),
    ],
)
def test_a_key_without_effect_is_said(name: str, overrides: dict[str, Any], key: str, names: str) -> None:
    if overrides.get("controller", {}).get("hand", 1) is None:
        overrides = {"controller": {k: v for k, v in overrides["controller"].items() if v is not None}}
    scenario = load_scenario(name, overrides=overrides)
    motors = name != "single_pendulum"
    (line,) = [line for line in without_effect(scenario, motors) if line.startswith(f"{key} ")]
    check_message(line, "overrides", *names.split())
    # What it is made from says it again.
    again = scenario_from_resolved(scenario.resolved)
    assert [message.partition(" (")[0] for message in without_effect(again, motors)] == [line.partition(" (")[0]]


@pytest.mark.parametrize("path", shipped_scenarios(), ids=lambda path: path.stem)
def test_shipped_scenarios_say_nothing_in_vain(path) -> None:
    """Nor do their resolved ones, which have all defaults that change something."""
    for variant in variant_names(path) or [None]:
        scenario = load_scenario(path, variant)
        assert without_effect(scenario) == []
        again = scenario_from_resolved(scenario.resolved)
        assert without_effect(again) == []
        assert again.resolved == scenario.resolved


def test_defaults_that_change_nothing_are_not_resolved() -> None:
    """Of fixed steps the tolerance; that of the adaptive methods is there."""
    assert load_scenario("elbow_comparison").resolved["integrator"]["rtol"] == 1e-6
    fixed = load_scenario(FLOOR, overrides={"integrator.method": "time_stepping"})
    assert "rtol" not in fixed.resolved["integrator"]
    said = load_scenario(FLOOR, overrides={"integrator": {**FIXED, "rtol": 1e-6}})
    assert said.resolved["integrator"]["rtol"] == 1e-6
    assert ("integrator", "rtol") in idle_keys(said.config)
    assert is_set(said.config, ("integrator", "rtol"))
    assert not is_set(fixed.config, ("integrator", "rtol"))


def test_friction_of_free_objects_has_an_effect(tmp_path) -> None:
    path = tmp_path / "push.yaml"
    hinge = ", hinge: {}"
    text = (
        "duration_s: 0.1\nplant: {type: serial_arm, chain: [{axis: y, mass_kg: 1}]}\nsurfaces: {s: {type: plane}}\n"
        "objects: {b: {mass_kg: 1, size_m: [0.2, 0.2, 0.1], position_m: [3, 0, 0.05]HINGE}}\n"
        "contacts: {law: unilateral, friction: 0.3}\n"
    )
    for change, idle in (("", []), (hinge, ["contacts.friction"])):
        path.write_text(text.replace("HINGE", change))
        said = without_effect(load_scenario(path), None)
        assert [line.partition(" ")[0] for line in said] == idle


def test_check_says_it_too() -> None:
    start = check(load_scenario("single_pendulum", overrides={"contacts": {"friction": 0.3}}))
    assert len(start.warnings) == 1
    check_message(start.warnings[0], "contacts.friction", "overrides")
