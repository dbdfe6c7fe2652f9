"""One-line ``repr`` of Scenario and Model."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.messages import check_message, mentions

from dynsim.compile.model import Model
from dynsim.scenario import build_model, load_scenario

ARM = Path(__file__).parents[2] / "scenarios" / "robots" / "six_axis_arm.urdf"


@pytest.mark.parametrize(
    ("name", "variant", "names"),
    [
        (
            "elbow_comparison",
            "two_elbows",
            ["<Scenario elbow_comparison (two_elbows)", "serial_arm", "joint_pd", "10 s", "elbow_4, elbow_7"],
        ),
        ("elbow_comparison", "no_elbow", ["<Scenario elbow_comparison (no_elbow)", "serial_arm", "joint_pd", "10 s>"]),
        ("single_pendulum", None, ["<Scenario single_pendulum", "serial_arm", "10 s>"]),
        ("snake_positioning", "x", ["<Scenario snake_positioning (x)", "snake", "task_space", "10 s>"]),
    ],
)
def test_a_scenario_says_what_it_is(name: str, variant: str | None, names: list[str]) -> None:
    check_message(repr(load_scenario(name, variant, {"duration_s": 10})), *names)


def test_many_contacts_are_counted() -> None:
    points = {f"c{k}": {"body": "link_4"} for k in range(50)} | {"off": {"body": "link_4", "enabled": False}}
    scenario = load_scenario("single_pendulum", overrides={"contacts.points": points})
    assert mentions(repr(scenario), "c0 … c49", "50")


def test_a_model_says_what_it_is() -> None:
    model = build_model(load_scenario("elbow_comparison"))
    mass = sum(link.inertia.mass for link in model.robot.links)
    check_message(repr(model), "<Model serial_arm", "joint_1 … joint_10", "10", "link_10", f"{mass:.4g} kg>")
    pendulum = build_model(load_scenario("single_pendulum"))
    check_message(repr(pendulum), "<Model serial_arm", "joint_1", "link_1")
    driven = {"plant.motors": {"base_yaw": {"type": "wang_minami"}}, "plant.motor": None}
    assert mentions(repr(build_model(load_scenario("six_axis_arm", overrides=driven))), "base_yaw,", "flange")
    assert mentions(repr(Model.from_urdf(ARM)), "flange")
