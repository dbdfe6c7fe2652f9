"""Causes of the distance between hand and target at the end of a run.

In each scene the cause is known. The share is compared with a closed form or with the run without the cause, whose hand
reaches its target.
"""

from __future__ import annotations

import io
import json
import re
from typing import Any

import numpy as np
import pytest
from support.messages import mentions

import dynsim
from dynsim.cli.comparison import print_summary
from dynsim.engine.target_distance import HEAD_FIXES, PART, TEXTS, UNEXPLAINED, DistanceCause, because, named_causes
from dynsim.library.controllers import joint_pd, task_space
from dynsim.scenario.reading import scenario_from_resolved
from dynsim.system.files import json_text
from dynsim.system.terminal import Terminal

K, R, LENGTH, MASS, GRAVITY = 2.0, 1.0, 0.5, 1.0, 9.81
MOTOR: dict[str, Any] = {
    "type": "dc", "torque_constant_N_m_per_A": K, "resistance_ohm": R, "inductance_H": 1e-3, "gear_ratio": 1.0,
    "rotor_inertia_kg_m2": 1e-3,
}  # fmt: skip
LINK: dict[str, Any] = {"length_m": LENGTH, "mass_kg": MASS, "damping_N_m_s_per_rad": 0.5, "motor": MOTOR}
SLIDER: dict[str, Any] = {
    "kind": "prismatic", "axis": "x", "length_m": 0.0, "mass_kg": 0.1, "motor": MOTOR, "damping_N_s_per_m": 2.0,
}  # fmt: skip
AT_REST = {"type": "line", "frame": "start", "from_m": [0, 0, 0], "to_m": [0, 0, 1e-9], "duration_s": 1.0}


def scenario(chain: list[dict[str, Any]], joints: list[str], k_p: float = 100.0, **more: Any) -> dynsim.Scenario:
    """An arm that keeps its hand at its start; other sections replace or extend its own."""
    gravity = more.pop("gravity", GRAVITY)
    hand = {"joints": joints, "path": AT_REST, "tolerance_m": 1e-3} | more.pop("hand", {})
    controller = {"type": "joint_pd", "k_p_V_per_rad": k_p, "k_d_V_s_per_rad": 5.0, "hand": hand}
    data: dict[str, Any] = {
        "name": "arm",
        "duration_s": 4.0,
        "plant": {"type": "serial_arm", "gravity_m_s2": [0, 0, -gravity], "chain": chain},
        "controller": controller | more.pop("control", {}),
        "record": {"rate_hz": 20},
    }
    return scenario_from_resolved(data | more)


def result(*args: Any, **more: Any) -> tuple[float, dict[str, DistanceCause], dynsim.Record]:
    """Run a scene and return the final distance [m], a dictionary of the causes and the record."""
    record = dynsim.simulate(scenario(*args, **more))
    causes = {entry["cause"]: DistanceCause(**entry) for entry in record.summary["hand_error_causes"]}
    return record.summary["hand_error_end_m"], causes, record


def turn(degrees: float, duration: float = 1.0) -> dict[str, Any]:
    """Sections of a path from the upright posture of one link, which its joint follows by waypoints."""
    angle = np.deg2rad(degrees)
    end = [LENGTH * np.sin(angle), 0.0, LENGTH * np.cos(angle)]
    joints = {"joint_1": {"times_s": [0.0, duration], "angles_deg": [0.0, degrees]}}
    path = {"type": "line", "from_m": [0, 0, LENGTH], "to_m": end, "duration_s": duration}
    return {"hand": {"path": path}, "control": {"joints": joints}, "gravity": 0.0}


LEVEL = [LINK | {"initial_deg": 90.0}]


def test_sag_equals_weight_over_stiffness() -> None:
    """At rest k_p δ = (R/K) m g (l/2) cos δ, with δ below the horizontal."""
    distance, causes, record = result(LEVEL, ["joint_1"])
    sag = -np.pi / 2 + record["q"][-1, 0]
    assert 100.0 * sag == pytest.approx(R / K * MASS * GRAVITY * LENGTH / 2 * np.cos(sag), rel=1e-4)
    assert distance == pytest.approx(2.0 * LENGTH * np.sin(sag / 2), rel=1e-6)
    assert causes["sag"] == DistanceCause("sag", pytest.approx(1.0, abs=0.01), ["joint_1"])
    assert len(causes) == 1
    output = io.StringIO()
    print_summary(Terminal(file=output, emoji=False), record.summary)
    assert re.search(rf"at the end \[mm\] +{1e3 * distance:.4g}\s+hand error, main cause +sag", output.getvalue())
    weightless, none, _ = result(LEVEL, ["joint_1"], gravity=0.0)
    assert weightless < 1e-6
    assert not none


def test_start_in_equilibrium_has_no_sag() -> None:
    distance, causes, record = result(LEVEL, ["joint_1"], initial={"equilibrium": True})
    assert distance < 1e-6
    assert not causes
    assert record.summary["hand_error_start_m"] < 1e-9


def test_load_is_the_cause_with_and_without_equilibrium() -> None:
    """The push begins after the start, so that the shift of an equilibrium does not carry it."""
    push = {"type": "samples", "body": "link_1", "point_m": [0, 0, LENGTH], "hold": True, "interpolation": "linear"}
    loads = {"push": push | {"times_s": [0.5, 1.0], "force_N": [[0, 0, 0], [0, 0, -10]]}}
    for initial in (None, {"equilibrium": True}):
        distance, causes, _ = result(LEVEL, ["joint_1"], gravity=0.0, loads=loads, initial=initial)
        assert distance == pytest.approx(LENGTH * R / K * 10 * LENGTH / 100.0, rel=0.02)
        assert list(causes) == ["load"]


def test_motors_at_their_limits_are_the_cause() -> None:
    """Without the limit the hand would sag by a tenth."""
    weak = [LINK | {"initial_deg": 90.0, "motor": MOTOR | {"voltage_limit_V": 0.5}}]
    distance, causes, record = result(weak, ["joint_1"])
    assert list(causes) == ["limit"]
    assert causes["limit"].joints == ["joint_1"]
    assert distance > 10.0 * result(LEVEL, ["joint_1"])[0]
    (warning,) = [text for text in record.summary["warnings"] if text.startswith("hand:")]
    assert mentions(warning, "joint_1", "limits of voltage", "larger motors")


def test_sag_and_limit_compete() -> None:
    """At rest the motor gives its limit V; k_p δ = V + excess, and V/k_p is the sag that the gain allows."""
    limit, k_p = 1.1, 4.0
    weak = [LINK | {"initial_deg": 90.0, "motor": MOTOR | {"voltage_limit_V": limit}}]
    _, causes, record = result(weak, ["joint_1"], k_p=k_p, duration_s=60.0)
    deviation = record["q"][-1, 0] - np.pi / 2
    assert set(causes) == {"sag", "limit"}
    assert causes["sag"].share == pytest.approx(limit / (k_p * deviation), abs=0.02)
    assert causes["sag"].share + causes["limit"].share == pytest.approx(1.0, abs=0.02)


def test_joint_stop_is_the_cause_even_if_the_motor_saturates() -> None:
    for motor in (MOTOR, MOTOR | {"voltage_limit_V": 5.0}):
        chain = [LINK | {"motor": motor, "limit_deg": [-40.0, 40.0]}]
        sections = turn(60.0) | {"contacts": {"law": "unilateral"}}
        distance, causes, record = result(chain, [], **sections)
        assert np.rad2deg(record["q"][-1, 0]) == pytest.approx(40.0, abs=1e-3)
        assert distance > 0.1
        assert list(causes) == ["stop"]
        free = [LINK | {"motor": motor}]
        assert result(free, [], **sections)[0] < 2e-3


def test_wall_is_the_cause_even_if_the_motor_saturates() -> None:
    """The hand starts 20 mm before a wall and is to move 0.1 m beyond it."""
    wall = {"surfaces": {"wall": {"type": "plane", "point_m": [LENGTH + 0.02, 0, 0], "normal": [-1, 0, 0]}}}
    point = {"tip": {"body": "link_1", "point_m": [0, 0, LENGTH], "surface": "wall"}}
    chain = [SLIDER | {"motor": MOTOR}, LINK | {"initial_deg": 90.0, "motor": MOTOR}]
    point["tip"]["body"] = "link_2"
    hand = {"path": AT_REST | {"to_m": [0.12, 0, 0]}}
    sections = {"contacts": {"law": "unilateral", "points": point}, "hand": hand, "gravity": 0.0, **wall}
    for limit in ({}, {"voltage_limit_V": 3.0}):
        chain[0]["motor"] = MOTOR | limit
        distance, causes, _ = result(chain, ["joint_1", "joint_2"], **sections)
        assert distance == pytest.approx(0.1, abs=0.01)
        assert list(causes) == ["contact"]
        assert causes["contact"].joints == ["joint_1"]
    sections["contacts"]["points"]["tip"]["enabled"] = False
    assert result(chain, ["joint_1", "joint_2"], **sections)[0] < 1e-3


def test_floor_that_carries_a_weak_arm_is_not_the_cause() -> None:
    """The saturated motor lets the hand fall on the floor, which supports it."""
    floor = {"surfaces": {"floor": {"type": "plane", "point_m": [0, 0, -0.3]}}}
    point = {"tip": {"body": "link_1", "point_m": [0, 0, LENGTH], "surface": "floor"}}
    weak = [LINK | {"initial_deg": 90.0, "motor": MOTOR | {"voltage_limit_V": 0.5}}]
    _, causes, record = result(weak, ["joint_1"], contacts={"law": "unilateral", "points": point}, **floor)
    assert record["contact_normal_force"][-1, 0] > 1.0
    assert list(causes) == ["limit"]


@pytest.mark.parametrize("law", ["bilateral", "unilateral"])
def test_gear_friction_is_the_cause(law: str) -> None:
    """A servo stops where its friction holds the link; the smoothed friction of the bilateral law lets it creep."""
    servo = {
        "type": "servo", "voltage_V": 12.0, "stall_torque_N_m": 12.0, "no_load_speed_rad_per_s": 6.0,
        "k_p_V_per_rad": 20.0, "coulomb_friction_N_m": 2.0,
    }  # fmt: skip
    for friction in (2.0, 0.0):
        chain = [LINK | {"motor": servo | {"coulomb_friction_N_m": friction}}]
        data = scenario(chain, [], contacts={"law": law}, **turn(20.0)).resolved
        for key in ("k_p_V_per_rad", "k_d_V_s_per_rad"):
            data["controller"].pop(key)
        summary = dynsim.simulate(scenario_from_resolved(data)).summary
        if friction:
            assert summary["hand_error_end_m"] > 0.01
            assert [cause["cause"] for cause in summary["hand_error_causes"]] == ["friction"]
        else:
            assert summary["hand_error_end_m"] < 1e-3


def test_moving_reference_is_the_cause() -> None:
    """The run ends in the middle of the path, where the damping of the joint needs a deviation."""
    chain = [SLIDER | {"damping_N_s_per_m": 20.0}, LINK]
    hand = {"path": AT_REST | {"to_m": [1.0, 0, 0], "duration_s": 2.0}}
    distance, causes, _ = result(chain, ["joint_1"], 50.0, duration_s=1.0, hand=hand, gravity=0.0)
    assert distance > 0.02
    assert list(causes) == ["motion"]


def test_joint_without_motor_is_the_cause() -> None:
    """The wrist falls, the shoulder holds."""
    loose = {key: value for key, value in LINK.items() if key != "motor"}
    distance, causes, _ = result(
        [LINK | {"initial_deg": 90.0, "mass_kg": 0.1}, loose | {"mass_kg": 0.05}], ["joint_1"], 2000.0
    )
    assert distance > 0.4
    assert list(causes) == ["free"]
    assert causes["free"].joints == ["joint_2"]


def test_references_elsewhere_are_the_cause() -> None:
    angles = {"joint_1": {"times_s": [0.0, 1.0], "angles_deg": [90.0, 60.0]}}
    distance, causes, _ = result(LEVEL, [], 2000.0, control={"joints": angles})
    assert distance == pytest.approx(2.0 * LENGTH * np.sin(np.pi / 12), rel=0.01)
    assert list(causes) == ["reference"]


def test_base_off_its_path_is_the_cause() -> None:
    """The base has not yet reached the end of its path, and the stiff arm follows its references."""
    gains = {
        "controller.k_p_V_per_rad": [0.2, 0.2, *[2000.0] * 10],
        "controller.k_d_V_s_per_rad": [0.0, 0.0, *[20.0] * 10],
    }
    keys = {**gains, "duration_s": 3.0, "contacts.points": {}, "plant.arm.gravity_m_s2": [0, 0, -0.1]}
    record = dynsim.simulate(dynsim.load_scenario("mobile_elbow_comparison_driving", "no_elbow", overrides=keys))
    causes = [cause["cause"] for cause in record.summary["hand_error_causes"]]
    off = np.linalg.norm(record["base_pose"][-1, :2] - record["base_target"][-1, :2])
    assert off > 0.02
    assert causes[0] == "base"


def test_planned_voltages_leave_only_the_unplanned_load() -> None:
    """The plan carries the weight of the links; a load that it does not know deflects the arm."""
    push = {"type": "samples", "body": "link_1", "point_m": [0, 0, LENGTH], "hold": True}
    loads = {"push": push | {"times_s": [0.5, 1.0], "force_N": [[0, 0, 0], [0, 0, -10]]}}
    for plan in ("gravity", "dynamics"):
        distance, causes, _ = result(LEVEL, ["joint_1"], control={"feed_forward": plan}, loads=loads)
        assert distance > 0.01
        assert list(causes) == ["load"]


PLANS = ("gravity", "dynamics")


@pytest.mark.parametrize("plan", PLANS)
@pytest.mark.parametrize("duration", [0.7, 4.0])  # on the path, and at rest
def test_wall_is_the_cause_with_planned_voltages(plan: str, duration: float) -> None:
    """Without the wall the planned voltages leave a hundredth of the distance."""
    wall = {"surfaces": {"wall": {"type": "plane", "point_m": [LENGTH + 0.02, 0, 0], "normal": [-1, 0, 0]}}}
    point = {"tip": {"body": "link_2", "point_m": [0, 0, LENGTH], "surface": "wall"}}
    chain, hand = [SLIDER, LINK | {"initial_deg": 90.0}], {"path": AT_REST | {"to_m": [0.12, 0, 0]}}
    for enabled in (True, False):
        point["tip"]["enabled"] = enabled
        contacts = {"law": "unilateral", "points": point}
        sections = {"contacts": contacts, "hand": hand, "control": {"feed_forward": plan}, **wall}
        distance, causes, _ = result(chain, ["joint_1", "joint_2"], 1000.0, duration_s=duration, **sections)
        if enabled:
            assert distance > 0.05
            assert list(causes) == ["contact"]
            free = distance
        else:
            assert distance < 0.01 * free


def test_joint_without_its_planned_voltage_sags() -> None:
    """A reference that the caller sets replaces the plan of its motor, so that the loop carries the weight."""
    simulation = dynsim.Simulation(scenario(LEVEL, ["joint_1"], control={"feed_forward": "gravity"}))
    simulation.set_reference("joint_1", np.pi / 2)
    simulation.advance(4.0)
    summary = simulation.record().summary
    assert summary["hand_error_end_m"] == pytest.approx(LENGTH * R / K * MASS * GRAVITY * LENGTH / 2 / 100.0, rel=0.01)
    assert [cause["cause"] for cause in summary["hand_error_causes"]] == ["sag"]


def after(change: Any, *args: Any, **more: Any) -> tuple[float, list[tuple[str, tuple[str, ...]]], list[str]]:
    """Distance [m], causes with their joints, and warnings of a run in which the caller changes something at once."""
    simulation = dynsim.Simulation(scenario(*args, **more))
    change(simulation)
    simulation.advance(4.0)
    summary = simulation.record().summary
    causes = [(cause["cause"], cause["joints"]) for cause in summary["hand_error_causes"]]
    return summary["hand_error_end_m"], causes, [text for text in summary["warnings"] if text.startswith("hand")]


@pytest.mark.parametrize("law", ["bilateral", "unilateral"])
@pytest.mark.parametrize("limit", [{}, {"voltage_limit_V": 5.0}])
def test_closed_brake_is_the_cause_even_if_the_motor_saturates(law: str, limit: dict[str, float]) -> None:
    sections = turn(30.0) | {"contacts": {"law": law}}
    chain = [LINK | {"motor": MOTOR | limit}]
    distance, causes, (warning,) = after(lambda s: s.set_brake("joint_1", closed=True), chain, [], **sections)
    assert distance == pytest.approx(2.0 * LENGTH * np.sin(np.deg2rad(15.0)), rel=1e-6)
    assert causes == [("brake", ["joint_1"])]
    assert mentions(warning, "brakes of joint_1", "open the brakes")
    assert after(lambda _: None, chain, [], **sections)[0] < 2e-3


def test_brake_that_keeps_a_sagging_joint_is_not_the_cause() -> None:
    """The arm sags before its brake closes, which then carries nothing."""
    simulation = dynsim.Simulation(scenario(LEVEL, ["joint_1"]))
    simulation.advance(2.0)
    simulation.set_brake("joint_1", closed=True)
    simulation.advance(4.0)
    assert [cause["cause"] for cause in simulation.record().summary["hand_error_causes"]] == ["sag"]


def test_command_of_the_caller_is_the_cause() -> None:
    distance, causes, (warning,) = after(lambda s: s.set_command("joint_1", 0.0), [LINK], [], **turn(30.0))
    assert distance > 0.1
    assert causes == [("command", ["joint_1"])]
    assert mentions(warning, "commands", "joint_1")


def coupled(ratio: float, lead: str) -> tuple[dict[str, Any], str]:
    """Resolved scenario and URDF of two level links of a URDF arm; the joint without a motor follows the other one."""
    other = {"joint_1": "joint_2", "joint_2": "joint_1"}[lead]
    inertia = '<inertia ixx="0.004" iyy="0.004" izz="0.0004" ixy="0" ixz="0" iyz="0"/>'
    body = '<link name="{}"><inertial><origin xyz="0 0 0.15"/><mass value="0.4"/>' + inertia + "</inertial></link>"
    joint = (
        '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/><origin xyz="0 0 {3}"/>'
        '<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="0" velocity="0"/>{4}</joint>'
    )
    mimic = {other: f'<mimic joint="{lead}" multiplier="{ratio}"/>'}
    parts = [body.format("a"), body.format("b"), joint.format("joint_1", "base", "a", 0.2, mimic.get("joint_1", ""))]
    parts.append(joint.format("joint_2", "a", "b", 0.3, mimic.get("joint_2", "")))
    urdf = f'<robot name="arm"><link name="base"/>{"".join(parts)}</robot>'
    still = {lead: {"times_s": [0.0, 1.0], "angles_deg": [40.0, 40.0]}}
    data = scenario([LINK], [], k_p=200.0, control={"joints": still}).resolved
    data["plant"] = {
        "type": "urdf_arm", "file": "arm.urdf", "motor": {"type": "wang_minami"}, "damping_N_m_s_per_rad": 0.5,
        "initial_deg": {lead: 40.0, other: 40.0 * ratio}, "hand": {"body": "b", "point_m": [0, 0, 0.3]},
    }  # fmt: skip
    return data, urdf


@pytest.mark.parametrize(("ratio", "lead"), [(1.5, "joint_1"), (-0.5, "joint_1"), (0.7, "joint_2")])
def test_weight_of_coupled_joints_is_sag_of_the_leader(tmp_path: Any, ratio: float, lead: str) -> None:
    data, urdf = coupled(ratio, lead)
    (tmp_path / "arm.urdf").write_text(urdf, encoding="utf-8")
    data["plant"]["file"] = str(tmp_path / "arm.urdf")
    summary = dynsim.simulate(scenario_from_resolved(data)).summary
    assert summary["hand_error_end_m"] > 5e-3
    ((cause, share, joints),) = [tuple(cause.values()) for cause in summary["hand_error_causes"]]
    assert (cause, joints) == ("sag", [lead])
    assert share == pytest.approx(1.0, abs=0.01)
    data["plant"]["gravity_m_s2"] = [0, 0, 0]
    assert dynsim.simulate(scenario_from_resolved(data)).summary["hand_error_end_m"] < 1e-6


def test_reach_of_sliders_includes_their_travel() -> None:
    """Without limits the reach of a gantry is zero, and the text of the warning gives only the least distance."""
    chain = [SLIDER | {"axis": axis, "limit_m": [-0.4, 0.1]} for axis in "xy"] + [SLIDER | {"axis": "z"}]
    joints = ["joint_1", "joint_2", "joint_3"]
    summary = result(chain, joints)[2].summary
    assert summary["hand_reach_m"] == pytest.approx(0.8)
    for slider in chain:
        slider.pop("limit_m", None)
    summary = result(chain, joints)[2].summary
    assert summary["hand_reach_m"] == 0.0
    (warning,) = [text for text in summary["warnings"] if text.startswith("hand:")]
    assert "(limit 1 mm)" in warning


def test_continued_run_does_not_start_off_its_path() -> None:
    arm = scenario(LEVEL, ["joint_1"], 10.0)
    simulation = dynsim.Simulation(arm)
    simulation.advance(2.0)
    continued = dynsim.Simulation(arm, state=simulation.state)
    continued.advance(3.0)
    summary = continued.record().summary
    assert summary["hand_error_start_m"] > 0.05
    assert not [text for text in summary["warnings"] if "starts" in text]


def test_path_relative_to_the_start_is_not_advised_again() -> None:
    hand = {"path": AT_REST | {"origin_m": [0.0, 0.0, -0.1]}}
    warnings = result([LINK, LINK | {"initial_deg": 45.0}], ["joint_1", "joint_2"], hand=hand)[2].summary["warnings"]
    (start,) = [text for text in warnings if "starts" in text]
    assert mentions(start, "begin the path at the hand")
    assert "frame" not in start


def test_brace_that_is_pushed_sideways_is_not_called_sag() -> None:
    """The friction of the elbow turns the vertical joint, which carries no weight."""
    record = dynsim.simulate(dynsim.load_scenario("brace_on_shapes", "flat"))
    # A loaded record has the same summary.
    assert json.loads(json_text(record.summary)) == record.summary
    (cause,) = record.summary["hand_error_causes"]
    assert (cause["cause"], cause["joints"]) == ("contact", ["joint_1"])


def test_unexplained_distances_have_no_cause() -> None:
    assert named_causes({"sag": {"a": 0.8}, "": {"a": 0.2}}) == []
    assert named_causes({"sag": {"a": 0.8}, "": {"a": UNEXPLAINED, "b": -UNEXPLAINED}}) == []
    assert named_causes({"sag": {"a": PART - 0.01}, "limit": {"a": PART - 0.01}, "stop": {"a": 1.02 - 2 * PART}}) == []
    small = {cause: {"a": 0.2} for cause in ("sag", "limit", "stop", "friction", "motion")}
    assert named_causes(small) == []
    assert "no single cause" in because([])


def test_opposite_deflections_are_not_attributed_to_the_weight() -> None:
    """Weight, brace forces and loads deflect joints in opposite directions, so that none of them alone is the cause."""
    parts = {"sag": {"a": 4.0, "b": 1.0}, "contact": {"a": -1.0, "b": -3.0}}
    assert [cause.cause for cause in named_causes(parts)] == ["deflection"]
    assert [cause.cause for cause in named_causes({"sag": {"a": 3.0}, "load": {"a": -2.0}})] == ["deflection"]
    assert named_causes({"sag": {"a": 3.0}, "stop": {"a": -2.0}}) == []
    assert [cause.cause for cause in named_causes({"contact": {"a": 3.0}, "sag": {"a": -2.0}})] == ["deflection"]
    # The brace carries the weight, and follows from it.
    assert [cause.cause for cause in named_causes({"sag": {"a": 3.0}, "contact": {"a": -2.0}})] == ["sag"]


def test_limits_are_not_the_cause_while_contacts_carry_the_arm() -> None:
    """Without the limit of its motor, an arm with these parts is 0.069 m from its target instead of 0.067 m."""
    assert named_causes({"sag": {"a": 1.2}, "contact": {"a": -0.8}, "limit": {"a": 0.6}}) == []
    assert named_causes({"sag": {"a": -0.7}, "contact": {"a": 0.6}, "friction": {"a": 1.1}}) == []


@pytest.mark.parametrize(("variant", "names"), [("z", ["sag"]), ("z_measured", [])])
def test_head_of_snake_sags_unless_it_is_measured(variant: str, names: list[str]) -> None:
    """The controller with motion capture corrects the sag by its commands."""
    record = dynsim.simulate(dynsim.load_scenario("snake_positioning_dynamic", variant, overrides={"duration_s": 1.0}))
    assert [cause["cause"] for cause in record.summary["final_position_error_causes"]] == names
    far = record["position_error"][-1]
    assert far > 0.05 if names else far < 0.01
    assert record.summary["initial_position_error_m"] == record["position_error"][0]
    assert any(mentions(text, "head", "psi2", "under the weight") for text in record.summary["warnings"]) == bool(names)


def test_clamped_joints_of_kinematic_snake_are_the_cause() -> None:
    """While theta8 is clamped, and not later; without limits the head stays on its path."""

    def causes(variant: str, duration: float) -> tuple[float, list[Any]]:
        keys = {"duration_s": duration}
        summary = dynsim.simulate(dynsim.load_scenario("snake_joint_limits", variant, overrides=keys)).summary
        return summary["final_position_error_m"], [cause["joints"] for cause in summary["final_position_error_causes"]]

    distance, joints = causes("saturate", 0.675)
    assert (distance > 6e-3, joints) == (True, [["theta8"]])
    assert causes("saturate", 1.5) == (pytest.approx(1.9e-3, abs=1e-4), [])
    assert causes("unlimited", 0.675) == (pytest.approx(0.0, abs=1e-4), [])


@pytest.mark.parametrize(
    ("other", "controllers"), [({}, (joint_pd,)), (HEAD_FIXES, (task_space,))], ids=["hand", "head"]
)
def test_fixes_name_keys_of_the_controller(other, controllers):
    keys = {key for controller in controllers for key in controller.Config.model_fields}
    # Drift and limits of the posture are causes of a head only.
    causes = [cause for cause in TEXTS if bool(other) or cause not in ("drift", "clamped")]
    fixes = [other.get(cause, TEXTS[cause][1]) for cause in causes]
    named = {key for fix in fixes for key in re.findall(r"controller\.(\w+)", fix)}
    assert named
    assert named <= keys
