"""Start postures that a user changes: copied keys reproduce them, hand targets, snapping, new braces, torques, undo."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML
from support.messages import check_message, raises

from dynsim import Scenario, build_model, load_scenario
from dynsim.compile.hand_posture import hand_turn
from dynsim.engine import Start, check
from dynsim.errors import DynsimError
from dynsim.scenario import SHIPPED, shipped_scenarios, variant_names
from dynsim.teleop.posture import ArmPosture, StartPosture, open_posture, yaml_text
from dynsim.teleop.web.pilot import Refused
from dynsim.teleop.web.posing import LivePosture, parse_change

# A copied angle is rounded to 1e-8 deg.
EXACT_M = 2e-9
STEP_M = 0.004
EVERY = [(file.stem, variant) for file in shipped_scenarios() for variant in variant_names(file) or [""]]
# One scenario of each kind of plant, path, contact law and `initial`.
KINDS = [
    ("elbow_comparison", "two_elbows"), ("brace_on_cylinder", "real"), ("soft_floor", "rigid"), ("six_axis_arm", ""),
    ("sampled_arm", "ideal"), ("spring_drawer", "opens"), ("free_flyer", "cycle"), ("corrected_arm", "floating"),
    ("mobile_elbow_comparison", "elbow_4"), ("snake_joint_limits", "cyclic"), ("snake_pick_up", "lifts"),
]  # fmt: skip


def opened(name: str, variant: str = "", **overrides: Any) -> StartPosture:
    """Open the start posture of a shipped scenario."""
    return open_posture(load_scenario(name, variant or None, overrides))


def read_yaml(text: str) -> Any:
    return YAML(typ="safe", pure=True).load(text)


def pasted(scenario: Scenario, text: str, folder: Path) -> Scenario:
    """Return the scenario of a file in which a user has pasted the copied text into a variant."""
    source = scenario.source
    assert source is not None
    data = read_yaml(source.read_text(encoding="utf-8"))
    variant = data.pop("variants", {}).get(scenario.variant) or {}
    data["variants"] = {"pasted": _both(variant, read_yaml(text))}
    stream = io.StringIO()
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.dump(data, stream)
    content = stream.getvalue()
    for shared in ("robots", "data"):
        content = content.replace(f"{shared}/", f"{SHIPPED}/{shared}/")
    file = folder / f"{source.stem}.yaml"
    file.write_text(content, encoding="utf-8")
    return load_scenario(file)


def _both(first: Any, second: Any) -> Any:
    """Return both mappings, with null values, which remove keys of the file."""
    if not (isinstance(first, Mapping) and isinstance(second, Mapping)):
        return second
    return {**first, **{key: _both(first.get(key), value) for key, value in second.items()}}


def moved(posture: StartPosture) -> None:
    """Move the hand by some millimetres with the braces on their surfaces; if that is impossible, the first slider."""
    at = np.array(posture.frame()["hand"])
    for step in ([0.0, 0.0, STEP_M], [-STEP_M, 0.0, 0.0]):
        try:
            posture.reach((at + step).tolist())
        except DynsimError:
            continue
        return
    name, slider = next((name, slider) for name, slider in posture.sliders.items() if not slider.leader)
    posture.set(name, posture.frame()["values"][name] + (0.5 if slider.unit == "deg" else 0.005))


def assert_same_start(name: str, variant: str, folder: Path) -> None:
    """Assert that the copied text of a changed posture passes the check and gives the same hand and gaps."""
    posture = opened(name, variant)
    moved(posture)
    frame = posture.frame()
    starts: list[Start] = []
    # The first start is before compliant contacts are pressed in.
    check(pasted(posture.scenario, "".join(frame["text"].values()), folder), starts.append)
    assert posture.changed
    if posture.scenario.plant.type != "snake" or posture.scenario.plant.level == "kinematic":  # dynamic snakes sag
        assert starts[0].hand == pytest.approx(frame["hand"], abs=1e-6)
    if isinstance(posture, ArmPosture):
        gaps = posture.gaps()
        assert {name for name in starts[0].gaps if not name.startswith(("trolley", "box"))} <= gaps.keys()
        for point, gap in starts[0].gaps.items():
            assert gap == pytest.approx(gaps.get(point, gap), abs=EXACT_M)


@pytest.mark.parametrize(("name", "variant"), KINDS)
def test_copied_text_reproduces_hand_and_gaps(name: str, variant: str, tmp_path: Path) -> None:
    assert_same_start(name, variant, tmp_path)


@pytest.mark.long
@pytest.mark.parametrize(("name", "variant"), [pair for pair in EVERY if pair not in KINDS])
def test_copied_text_of_every_variant_reproduces_hand_and_gaps(name: str, variant: str, tmp_path: Path) -> None:
    assert_same_start(name, variant, tmp_path)


@pytest.mark.parametrize(
    ("name", "variant"), [("mobile_turns", "arc"), ("free_flyer", "cycle"), ("snake_operator", "")]
)
def test_sliders_of_base_and_attitude_are_copied(name: str, variant: str, tmp_path: Path) -> None:
    posture = opened(name, variant)
    for number, (slider, about) in enumerate(posture.sliders.items()):
        if "." in slider:
            posture.set(slider, 5.0 * number if about.unit == "deg" else 0.01 * number)
    before = posture.frame()
    other = open_posture(pasted(posture.scenario, "".join(before["text"].values()), tmp_path))
    values = other.frame()["values"]
    assert any(value for name, value in values.items() if "." in name)
    assert values == pytest.approx(before["values"], abs=1e-6)
    # The wheels of a base, which are the last bodies, start at the angle zero.
    count = 7 * (len(posture.scene.bodies) - len(posture.scene.base[1:]))
    assert before["poses"][:count] == pytest.approx(other.frame()["poses"][:count], abs=2e-6)


def test_hand_target_keeps_braces_and_orientation() -> None:
    posture = opened("elbow_comparison", "two_elbows")
    target = np.add(posture.frame()["hand"], [0.0, -0.05, 0.02]).tolist()
    posture.reach(target)
    assert posture.frame()["hand"] == pytest.approx(target, abs=1e-6)
    assert isinstance(posture, ArmPosture)
    assert posture.gaps() == pytest.approx({"elbow_4": 0.0, "elbow_7": 0.0}, abs=1e-8)
    turned = opened("six_axis_arm")
    assert isinstance(turned, ArmPosture)
    axes = hand_turn(turned.model, turned.q)
    turned.reach((np.array(turned.frame()["hand"]) - [0.1, 0.0, 0.05]).tolist(), keep_orientation=True)
    assert hand_turn(turned.model, turned.q) == pytest.approx(axes, abs=1e-8)


def test_hand_of_a_mobile_arm_moves_while_its_base_rests() -> None:
    posture = opened("mobile_elbow_comparison", "two_elbows")
    posture.set("base.heading", 30.0)
    posture.set("base.x", 0.2)
    target = np.add(posture.frame()["hand"], [-0.02, 0.03, 0.01])
    base = {name: value for name, value in posture.frame()["values"].items() if name.startswith("base.")}
    posture.reach(target.tolist())
    frame = posture.frame()
    assert base == {"base.x": 0.2, "base.y": 0.0, "base.heading": 30.0}
    assert {name: frame["values"][name] for name in base} == base
    assert frame["hand"] == pytest.approx(target, abs=1e-6)
    assert [point["gap"] for point in frame["points"]] == pytest.approx([0.0, 0.0], abs=1e-8)
    assert 0.0 < frame["margin"] < 1.0


def test_unreachable_hand_target_leaves_the_posture() -> None:
    posture = opened("six_axis_arm")
    before = posture.q.copy()
    with raises(DynsimError, "residual"):
        posture.reach([5.0, 0.0, 0.0])
    assert np.array_equal(posture.q, before)
    assert not posture.frame()["undo"]


def test_snap_returns_a_brace_to_its_surface_with_the_hand_at_rest() -> None:
    posture = opened("brace_on_shapes", "block")
    assert isinstance(posture, ArmPosture)
    posture.set("joint_3", 55.0)
    hand = posture.frame()["hand"]
    (name,) = posture.points
    assert posture.gaps()[name] > 1e-3
    posture.snap(name, keep_hand=True)
    assert posture.gaps()[name] == pytest.approx(0.0, abs=1e-12)
    assert posture.frame()["hand"] == pytest.approx(hand, abs=1e-6)


def test_listed_point_that_left_its_surface_is_removed_from_initial(tmp_path: Path) -> None:
    posture = opened("brace_on_shapes", "flat")
    posture.set("joint_2", 50.0)
    text = posture.text()
    assert read_yaml(text["initial"]) == {"initial": None}
    start = check(pasted(posture.scenario, "".join(text.values()), tmp_path))
    assert start.gaps["elbow"] == pytest.approx(posture.frame()["points"][0]["gap"], abs=EXACT_M)
    assert start.gaps["elbow"] > 0.05


def test_new_brace_is_copied_touches_after_snap_and_is_undone(tmp_path: Path) -> None:
    posture = opened("elbow_comparison_floor", "no_elbow")
    posture.set("joint_2", 40.0)
    posture.add_brace("link_8", "floor")
    posture.snap("link_8_floor")
    frame = posture.frame()
    (point,) = [entry for entry in frame["points"] if entry["name"] == "link_8_floor"]
    assert point["gap"] == pytest.approx(0.0, abs=1e-9)
    assert point["force"] > 0.1
    start = check(pasted(posture._original, "".join(frame["text"].values()), tmp_path))
    assert start.gaps == pytest.approx({"link_8_floor": 0.0}, abs=EXACT_M)
    posture.undo()
    posture.undo()
    assert "link_8_floor" not in [point["name"] for point in posture.frame()["points"]]
    with raises(DynsimError, "link_8", "ceiling", "floor"):
        posture.add_brace("link_8", "ceiling")


def test_torques_hold_the_weight_and_exceed_a_rating() -> None:
    posture = opened("six_axis_arm", **{"plant.motor.nominal_torque_N_m": 5.0})
    posture.set("shoulder_pitch", 80.0)
    frame, model = posture.frame(), build_model(posture.posed())
    weight = model.bias_forces(posture.q, np.zeros(model.n))
    torques = frame["torques"]
    assert [torques[name][0] for name in model.joint_names] == pytest.approx(weight, abs=1e-5)
    stall, lasting = torques["shoulder_pitch"][1:]
    assert stall == pytest.approx(48.0 / 0.5 * 0.1 * 100.0)
    assert lasting == 5.0 < abs(torques["shoulder_pitch"][0])


def test_follower_moves_with_its_leader(tmp_path: Path) -> None:
    posture = opened("free_flyer", "cycle", **{"plant.lock_m": {}})
    assert posture.sliders["right"].leader == "left"
    posture.set("left", 0.02)
    frame = posture.frame()
    assert frame["values"]["right"] == pytest.approx(abs(frame["values"]["left"]))
    assert "right" not in read_yaml(frame["text"]["plant"])["plant"].get("initial_m", {})
    assert check(posture.posed()).hand == pytest.approx(frame["hand"], abs=1e-6)
    with raises(DynsimError, "right", "left"):
        posture.set("right", 0.01)


def test_values_are_limited_and_undone_in_order() -> None:
    posture = opened("snake_operator")
    posture.set("theta1", 20.0)
    posture.set("theta1", 200.0)
    posture.set("base.x", 3.0)
    assert posture.frame()["values"]["theta1"] == pytest.approx(65.0)
    assert posture.frame()["undo"] == 2
    assert check(posture.posed()).hand == pytest.approx(posture.frame()["hand"], abs=1e-6)
    posture.undo()
    posture.undo()
    assert not posture.changed
    posture.redo()
    assert posture.frame()["values"]["theta1"] == pytest.approx(65.0)
    posture.reset()
    assert not posture.changed
    with raises(DynsimError, "theta99", "theta1"):
        posture.set("theta99", 0.0)


def test_posture_opens_although_a_listed_point_cannot_touch() -> None:
    posture = opened("brace_on_shapes", "flat", **{"surfaces.ground.point_m": [0, 0, -5]})
    check_message(posture.frame()["note"], "elbow", "initial.keep")
    assert posture.frame()["values"]["joint_2"] == pytest.approx(60.0)


@pytest.mark.long
@pytest.mark.parametrize(("name", "variant"), KINDS)
def test_frames_stay_valid_under_random_changes(name: str, variant: str) -> None:
    rng = np.random.default_rng(7)
    live = LivePosture(opened(name, variant), name)
    hello, frame = live.posture.hello(), live.posture.frame()
    sliders = [slider["name"] for slider in hello["sliders"]]
    for k in range(25):
        points = [point["name"] for point in frame["points"]] or ["none"]
        target = np.add(frame["hand"], rng.normal(0.0, 0.1, 3)).tolist()
        change = [
            {"do": "set", "name": str(rng.choice(sliders)), "value": float(rng.choice([-1e4, 1e4, 0.3, 25.0, -70.0]))},
            {"do": "reach", "target": target, "braces": k % 2 == 0, "orientation": k % 3 == 0},
            {"do": "snap", "name": str(rng.choice(points)), "hand": k % 2 == 0},
            {"do": "brace", "body": (hello["bodies"] or ["none"])[-1], "surface": (hello["surfaces"] or ["none"])[0]},
            {"do": str(rng.choice(["undo", "redo", "reset"]))},
        ][rng.integers(5)]
        live._execute(parse_change(json.dumps(change)))
        frame = live._frame()
        assert json.loads(json.dumps(frame, allow_nan=False)) == frame


def test_contact_on_an_unknown_body_is_an_error() -> None:
    with raises(DynsimError, "contacts.points.elbow_4.body", "link_99"):
        opened("elbow_comparison", "two_elbows", **{"contacts.points.elbow_4.body": "link_99"})


def test_check_reports_the_first_error_of_the_posture() -> None:
    posture = opened("elbow_comparison", "two_elbows")
    posture.set("joint_3", 80.0)
    posture.check()
    check_message(posture.note, "check", "elbow_4", "floor")


@pytest.mark.parametrize("name", ["yes", "a: b", "é", "1", "# x", "point-1", "a/b.c", "null", 'q"q', ""])
def test_names_are_quoted_in_the_copied_text(name: str) -> None:
    keys = {"contacts": {"points": {name: {"body": name, "point_m": [1e-5, -2.0, 3], "enabled": False}}}}
    text = yaml_text(keys, {("contacts", "points", name): "at [0, 0] m"})
    assert read_yaml(text) == keys


@pytest.mark.parametrize(
    "text",
    ["[]", "{}", '{"do": 3}', '{"do": "fly"}', '{"do": "set", "name": "x"}', '{"do": "set", "name": "x", "value": "1"}',
     '{"do": "set", "name": "x", "value": NaN}', '{"do": "set", "name": 1, "value": 1}', '{"do": "undo", "x": 1}',
     '{"do": "set", "name": "x", "value": 1e9}', '{"do": "reach", "target": [1], "braces": true, "orientation": true}',
     '{"do": "reach", "target": [1, 2, null], "braces": true, "orientation": true}', b"{}"],
)  # fmt: skip
def test_invalid_messages_of_a_page_are_refused(text: str | bytes) -> None:
    with pytest.raises(Refused):
        parse_change(text)
    assert parse_change('{"do": "set", "name": "x", "value": 1}')["value"] == 1


def test_plant_without_start_keys_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("dynsim.library.plants.serial_arm.start_keys")
    with raises(DynsimError, "serial_arm", "start_keys", "docs/extending.md"):
        opened("single_pendulum")


COUPLED = """\
<robot name="coupled">
  <link name="world"/>
  <link name="upper"><inertial><origin xyz="0 0 0.2"/><mass value="2"/><inertia ixx="0.01" iyy="0.01" izz="0.01"
    ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0 0 0.3"/><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01"
    ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="lead" type="revolute"><parent link="world"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="9" effort="100" velocity="3"/></joint>
  <joint name="follow" type="continuous"><parent link="upper"/><child link="lower"/><origin xyz="0 0 0.5"/>
    <axis xyz="0 1 0"/><mimic joint="lead" multiplier="-0.5" offset="0.2"/></joint>
</robot>
"""


def test_motor_of_a_leader_holds_its_follower(tmp_path: Path) -> None:
    (tmp_path / "coupled.urdf").write_text(COUPLED, encoding="utf-8")
    file = tmp_path / "coupled.yaml"
    file.write_text(
        "duration_s: 1\nplant: {type: urdf_arm, file: coupled.urdf, motors: {lead: {type: torque}}}\n", encoding="utf-8"
    )
    posture = open_posture(load_scenario(file))
    posture.set("lead", 40.0)
    lead = np.deg2rad(40.0)

    def potential(q: float) -> float:
        follow = -0.5 * q + 0.2
        return 9.81 * (2.0 * 0.2 * np.cos(q) + 0.5 * np.cos(q) + 0.3 * np.cos(q + follow))

    torque = (potential(lead + 1e-5) - potential(lead - 1e-5)) / 2e-5
    frame = posture.frame()
    assert frame["values"]["follow"] == pytest.approx(-20.0 + np.rad2deg(0.2))
    assert frame["torques"]["lead"][0] == pytest.approx(torque, abs=1e-5)
    assert read_yaml(frame["text"]["plant"]) == {"plant": {"initial_deg": {"lead": 40}}}


def test_typed_values_end_at_the_limits_of_the_joint() -> None:
    posture = opened("single_pendulum", **{"plant.chain.0.limit_deg": [-30, 400]})
    for typed, value in ((-90.0, -30.0), (390.0, 390.0), (500.0, 400.0)):
        posture.set("joint_1", typed)
        assert posture.frame()["values"]["joint_1"] == pytest.approx(value)
    free = opened("single_pendulum")
    free.set("joint_1", 720.0)
    assert free.frame()["values"]["joint_1"] == pytest.approx(720.0)
