"""Scenario files: merging, errors that name file, line, key, value and fix, and round trips."""

import re
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import dynsim
from dynsim.engine import check
from dynsim.errors import DynsimError, ModelError, ScenarioError, UnreachableReference
from dynsim.scenario import (
    SetOptions,
    build,
    build_model,
    find_scenario,
    json_schema,
    load_scenario,
    parse_override,
    scenario_from_resolved,
    to_yaml,
    variant_names,
)

MINIMAL = "duration_s: 1\nplant: {type: serial_arm, chain: [{axis: y}]}\n"
SHARED = "duration_s: 1\nplant:\n  type: serial_arm\n  link: {mass_kg: 0.2}\n  chain: [{axis: y}]\n"


def write(folder: Path, text: str) -> Path:
    path = folder / "case.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_variants_differ_only_where_they_say():
    full, lone = (load_scenario("elbow_comparison", name) for name in ("two_elbows", "elbow_7"))
    assert [c.name for c in build.contacts(full)] == ["elbow_4", "elbow_7"]
    assert [c.name for c in build.contacts(lone)] == ["elbow_7"]
    assert full.resolved["plant"] == lone.resolved["plant"]
    assert variant_names("elbow_comparison") == ["two_elbows", "elbow_7", "elbow_4", "no_elbow"]


def test_first_variant_is_the_default():
    assert load_scenario("elbow_comparison").variant == "two_elbows"


def test_overrides_reach_mappings_lists_and_new_keys():
    scenario = load_scenario(
        "elbow_comparison",
        overrides={"plant.chain.1.mass_kg": 0.2, "integrator.rtol": 1e-8, "contacts.points.elbow_4.friction": 0.3},
    )
    assert build_model(scenario).robot.links[5].inertia.mass == 0.2
    assert scenario.integrator.rtol == 1e-8
    assert build.contacts(scenario)[0].friction == 0.3


def test_resolved_scenario_reads_back_as_itself(tmp_path: Path):
    scenario = load_scenario("elbow_comparison", "elbow_7")
    again = load_scenario(write(tmp_path, to_yaml(scenario.resolved)))
    assert again.resolved == scenario.resolved
    assert scenario_from_resolved(scenario.resolved).resolved == scenario.resolved


DYNAMIC_SNAKE = """
duration_s: 0.05
plant: {type: snake, level: dynamic}
controller: {type: task_space, state: measured}
contacts: {stiffness_N_per_m: null, restitution: 0.3}
sensors: {motion_capture: {rate_hz: null}}
integrator: {step_s: null}
"""


def test_nulls_in_whose_place_defaults_would_come_are_resolved(tmp_path: Path):
    """Of a plant (tyres, the length of steps) and of a key (the rate of a sensor)."""
    scenario = load_scenario(write(tmp_path, DYNAMIC_SNAKE))
    resolved = scenario.resolved
    for again in (scenario_from_resolved(resolved), load_scenario(write(tmp_path, to_yaml(resolved)))):
        assert again.resolved == resolved
        assert again.config.contacts == scenario.config.contacts
        assert again.config.contacts.stiffness_N_per_m is again.integrator.step_s is None
        assert again.config.sensors.motion_capture.rate_hz is None
    # No others.
    text = to_yaml(resolved)
    assert len(re.findall(r":\s+null", text)) == 3
    assert "null" not in to_yaml(load_scenario("elbow_comparison").resolved)


def test_a_scenario_of_another_version_is_refused_in_one_line():
    resolved = load_scenario("elbow_comparison").resolved
    resolved["integrator"]["newer"] = 1
    with pytest.raises(ScenarioError) as caught:
        scenario_from_resolved(resolved)
    assert str(caught.value).startswith("the scenario in this record: integrator.newer: unknown key")
    assert "\n" not in str(caught.value)


def test_null_removes_a_key(tmp_path: Path):
    path = write(tmp_path, MINIMAL + "integrator: {rtol: 1e-9}\nvariants: {a: {integrator: {rtol: null}}, b: {}}\n")
    assert load_scenario(path, "a").integrator.rtol == 1e-6
    assert load_scenario(path, "b").integrator.rtol == 1e-9


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", ["case.yaml", "empty"]),
        ("- 1\n", ["must be a mapping"]),
        ("a: [1\n", ["case.yaml:2", "not YAML"]),
        ("duration_s: 1\nduration_s: 2\n", ["case.yaml:2", "duplicate key"]),
        (MINIMAL + "integrater: {}\n", ["case.yaml:3", "integrater", "did you mean 'integrator'"]),
        (MINIMAL + "integrator:\n  rtoll: 1\n", ["case.yaml:4", "integrator.rtoll", "did you mean 'rtol'"]),
        (MINIMAL.replace("duration_s: 1", "duration_s: soon"), ["case.yaml:1", "duration_s = 'soon'", "number"]),
        (MINIMAL.replace("duration_s: 1\n", ""), ["duration_s", "is missing"]),
        (MINIMAL.replace("serial_arm", "serial_amr"), ["plant.type", "unknown type 'serial_amr'", "serial_arm"]),
        (MINIMAL.replace("axis: y", "mass_kg: -1"), ["case.yaml:2", "plant.chain.0.mass_kg = -1", "greater"]),
        (MINIMAL.replace("axis: y", "axis: w"), ["plant.chain.0.axis"]),
        (MINIMAL.replace("duration_s: 1", "duration_s: .nan"), ["duration_s", "finite"]),
        (MINIMAL + "integrator: {step_s: 0}\n", ["integrator.step_s = 0"]),
        (MINIMAL + "varaints: {}\n", ["case.yaml:3", "did you mean 'variants'"]),
        (MINIMAL + "name: a/b\n", ["case.yaml:3: name = 'a/b': names a folder"]),
        (MINIMAL + "variants:\n  ..: {}\n", ["variant = '..': names a folder"]),
        (SHARED.replace("mass_kg", "mas_kg"), ["case.yaml:4: plant.link.mas_kg: unknown key; did you mean 'mass_kg'?"]),
        (SHARED.replace("0.2", "heavy"), ["case.yaml:4: plant.link.mass_kg = 'heavy'", "number"]),
        (SHARED.replace("[{axis: y}]", "[]"), ["case.yaml:5: plant.chain: has 0 entries; it must have at least 1"]),
        (SHARED.replace("{mass_kg: 0.2}", "3"), ["case.yaml:4: plant.link = 3: must be a mapping"]),
        (
            SHARED.replace("mass_kg: 0.2", "motor: {type: wang_minami, inductance_H: 0}"),
            ["case.yaml:4: plant.link.motor.inductance_H = 0: must be positive", "1e-6", "radau5"],
        ),
        (
            SHARED.replace("mass_kg: 0.2", "motor: {type: wang_minami, inductance_H: -1}"),
            ["case.yaml:4: plant.link.motor.inductance_H = -1: must be greater than 0"],
        ),
        (
            SHARED.replace("axis: y", "mass_kg: 1"),
            ["case.yaml:4: plant.link.mass_kg = 0.2: has no effect", "set plant.chain.0.mass_kg instead"],
        ),
        (
            SHARED.replace("mass_kg", "damping_N_s_per_m"),
            ["case.yaml:4: plant.link.damping_N_s_per_m = 0.2: has no effect", "set damping_N_m_s_per_rad instead"],
        ),
        (
            MINIMAL.replace("axis: y", "kind: prismatic, damping_N_m_s_per_rad: 1"),
            ["case.yaml:2: plant.chain.0.damping_N_m_s_per_rad = 1: a prismatic joint has damping_N_s_per_m"],
        ),
    ],
)
def test_errors_are_one_line_that_names_the_place(tmp_path: Path, text: str, expected: list[str]):
    with pytest.raises(ScenarioError) as caught:
        load_scenario(write(tmp_path, text))
    message = str(caught.value)
    assert "\n" not in message
    for part in expected:
        assert part in message


def test_all_unknown_keys_of_a_file_are_in_one_answer(tmp_path: Path):
    text = (
        MINIMAL.replace("axis: y", "axs: y")
        + "integrater: {}\nrecord: {rate: 5, size_limit_GB: -1}\nvariants:\n  a: {}\n  b:\n    metrics: {settle: 1}\n"
    )
    path = write(tmp_path, text)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    assert str(caught.value) == (
        f"{path}:2: plant.chain.0.axs: unknown key; did you mean 'axis'?; "
        f"{path}:4: record.rate: unknown key; did you mean 'rate_hz'?; "
        f"{path}:3: integrater: unknown key; did you mean 'integrator'?; "
        f"{path}:8: metrics.settle: unknown key; did you mean 'settle_s'?; "
        f"{path}:4: record.size_limit_GB = -1: must be greater than 0"
    )


def test_every_problem_is_told_with_its_place(tmp_path: Path):
    text = MINIMAL.replace("axis: y", "axis: q, kind: prismatik, length_m: -1") + (
        "surfaces:\n  floor: {typ: plane}\nintegrator: {rtol: x}\nrecord: {rate_hz: -1}\nmetrics: {settle_s: -1}\n"
    )
    path = write(tmp_path, text)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    assert str(caught.value) == (
        f"{path}:2: plant.chain.0.kind = 'prismatik': must be 'revolute' or 'prismatic'; did you mean 'prismatic'?; "
        f"{path}:2: plant.chain.0.axis = 'q': must be 'x', 'y' or 'z'; "
        f"{path}:2: plant.chain.0.length_m = -1: must be greater than or equal to 0; "
        f"{path}:4: surfaces.floor.typ: unknown key; did you mean 'type'?; and 3 more problems"
    )


def test_of_very_many_unknown_keys_the_first_are_named(tmp_path: Path):
    with pytest.raises(ScenarioError, match=r"k19: unknown key.*; and more$") as caught:
        load_scenario(write(tmp_path, MINIMAL + "".join(f"k{k}: 1\n" for k in range(5000))))
    assert "k20:" not in str(caught.value)


def test_errors_of_a_choice_are_about_the_type_that_is_named(tmp_path: Path):
    text = MINIMAL + "surfaces:\n  floor:\n    type: sphere\n    center_m: [0, 0, 0]\n    normal: [0, 0, 1]\n"
    with pytest.raises(ScenarioError) as caught:
        load_scenario(write(tmp_path, text))
    message = str(caught.value)
    assert "case.yaml:7: surfaces.floor.normal: unknown key; known here: type, center_m, radius_m, inside" in message
    with pytest.raises(ScenarioError, match=r"case.yaml:5: surfaces.floor.type: unknown type \['sphere'\]"):
        load_scenario(write(tmp_path, text.replace("type: sphere", "type: [sphere]")))


def test_the_schema_is_about_the_type_that_is_named():
    """Editors report what a validator of JSON schemas does: the fault, not that none of the choices fits."""
    validator = jsonschema.Draft202012Validator(json_schema())
    scenario = load_scenario("elbow_comparison").resolved
    assert not list(validator.iter_errors(scenario))
    scenario["plant"]["bas"] = 1
    scenario["surfaces"]["floor"]["type"] = "plan"
    scenario["controller"]["hand"]["path"]["radius"] = 1
    errors = {(".".join(map(str, error.path)), error.message) for error in validator.iter_errors(scenario)}
    assert errors == {
        ("plant", "Additional properties are not allowed ('bas' was unexpected)"),
        ("surfaces.floor.type", "'plan' is not one of ['box', 'cylinder', 'height_field', 'plane', 'sphere']"),
        ("controller.hand.path", "Additional properties are not allowed ('radius' was unexpected)"),
    }
    assert json_schema()["properties"]["plant"]["discriminator"]["propertyName"] == "type"


CONTACT = """duration_s: 1
plant: {type: serial_arm, chain: [{axis: y, initial_deg: 90}]}
surfaces: {floor: {type: plane}}
contacts:
  points:
    tip:
      body: link_1
      point_m: [0, 0, 0.3]
      surface: floor
"""


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            ("surface: floor", "surface: flor"),
            ":9: contacts.points.tip.surface = 'flor': no such surface; did you mean",
        ),
        (("body: link_1", "body: link_2"), ":7: contacts.points.tip.body: "),
        (("initial_deg: 90", "initial_deg: 80"), ":6: contacts.points.tip: its point starts +0.05209 m from surface"),
    ],
)
def test_errors_of_contacts_name_key_and_line(tmp_path: Path, change: tuple[str, str], expected: str):
    path = write(tmp_path, CONTACT)
    check(load_scenario(path))
    write(tmp_path, CONTACT.replace(*change))
    with pytest.raises(ModelError, match=f"^{re.escape(f'{path}{expected}')}"):
        check(load_scenario(path))


def test_errors_of_overridden_contacts_say_so(tmp_path: Path):
    path = write(tmp_path, CONTACT + "variants: {one: {}}\n")
    overrides = SetOptions({"contacts.points.tip.surface": "flor"})
    expected = f"{path} (one): --set: contacts.points.tip.surface = 'flor'"
    with pytest.raises(ModelError, match=f"^{re.escape(expected)}"):
        check(load_scenario(path, overrides=overrides))


def test_error_in_a_variant_names_the_variants_line(tmp_path: Path):
    text = MINIMAL + "variants:\n  good: {}\n  bad:\n    metrics:\n      settle: 1\n"
    with pytest.raises(ScenarioError, match=r"case.yaml:7: metrics.settle: unknown key; did you mean 'settle_s'"):
        load_scenario(write(tmp_path, text), "bad")


def test_error_beside_a_variant_names_the_line_that_has_the_key(tmp_path: Path):
    text = SHARED.replace("mass_kg", "mas_kg") + "variants:\n  a: {plant: {base: {yaw_deg: 1}}}\n"
    with pytest.raises(ScenarioError, match=r"case.yaml:4: plant.link.mas_kg"):
        load_scenario(write(tmp_path, text), "a")


def test_shared_keys_of_a_resolved_scenario_are_refused_with_the_keys_to_set(tmp_path: Path):
    path = write(tmp_path, to_yaml(load_scenario("elbow_comparison").resolved))
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path, overrides={"plant.link.mass_kg": 0.5})
    assert str(caught.value) == (
        "overrides: plant.link.mass_kg = 0.5: has no effect on any entry of plant.chain; "
        "set plant.chain.0.mass_kg, plant.chain.1.mass_kg instead, or take it away"
    )
    # What the entries do not have still reaches them.
    com = build_model(load_scenario(path, overrides={"plant.link.com_m": [0, 0, 0.1]})).robot.links[3].inertia.com
    assert list(com) == [0, 0, 0.1]


def test_each_kind_of_joint_takes_the_shared_loss_of_its_own_unit(tmp_path: Path):
    path = write(
        tmp_path,
        SHARED.replace("mass_kg: 0.2", "damping_N_m_s_per_rad: 0.5, damping_N_s_per_m: 3").replace(
            "{axis: y}", "{kind: prismatic}, {axis: y}, {kind: prismatic, damping_N_s_per_m: 7}"
        ),
    )
    assert [link.damping for link in build_model(load_scenario(path)).robot.links] == [3.0, 0.5, 7.0]


@pytest.mark.parametrize(
    ("overrides", "error", "expected"),
    [
        ({"plant.initial_deg.1": 40}, ModelError, "starts +0.03698 m from surface 'floor'"),
        ({"contacts.points.elbow_4.surface": "flor"}, ModelError, "did you mean 'floor'"),
        ({"contacts.points.elbow_4.body": "link_44"}, ModelError, "link_44"),
        ({"controller.hand.path.center_m": [3, 3, 0.4]}, UnreachableReference, "at t = 0.000 s it stays 2.0"),
        ({"controller.hand.path.radius_m": 0.6}, UnreachableReference, "at t = "),
        ({"controller.hand.joints": ["joint_99"]}, ModelError, "joint_99"),
        ({"controller.k_p_V_per_rad": [1, 2]}, ModelError, "2 values, there are 10 motors"),
        ({"record.rate_hz": 1e7}, ScenarioError, "record.rate_hz"),
        ({"controller.knot_spacing_s": 1e-10}, ModelError, "controller.knot_spacing_s = 1e-10: 1e+11 knots in 10 s"),
    ],
)
def test_what_no_simulation_can_be_made_of_is_refused_by_check(overrides, error, expected):
    with pytest.raises(error) as caught:
        check(load_scenario("elbow_comparison", overrides=overrides))
    assert expected in str(caught.value)
    # Which of several scenarios and variants it was.
    assert re.match(rf"{find_scenario('elbow_comparison')}(:\d+)? \(two_elbows\): ", str(caught.value))


KNOWN = "known: switching, fixing, 1, 2, 3, 4, 5, 6"


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ({"mode": 9}, f"mode = 9: no mode 9; {KNOWN}"),
        ({"mode": 0}, f"mode = 0: no mode 0; {KNOWN}"),
        ({"mode": -1}, f"mode = -1: no mode -1; {KNOWN}"),  # inside the engine -1 and -2 are the states
        ({"mode": -2}, f"mode = -2: no mode -2; {KNOWN}"),
        ({"mode": -7}, f"mode = -7: no mode -7; {KNOWN}"),
        ({"at_s": 1e6, "mode": 44}, f"mode = 44: no mode 44; {KNOWN}"),  # after the end of the run
        ({"mode": True}, "mode = True: no such mode; known: switching, fixing, or the number of a mode"),
        ({"mode": 3.0}, "mode = 3.0: no such mode"),
        ({"mode": [1]}, "mode: no such mode"),
        ({"mode": "swithcing"}, "mode = 'swithcing': no such mode; did you mean 'switching'?; known: switching"),
        ({"velocity": [0.1, 0, 0, 0, 0]}, "velocity: has 5 entries, 6 are needed"),
        ({"velocity": [0.1, 0]}, "velocity: has 2 entries, 6 are needed"),
        ({"velocity": [0, 0, 0, 0, 0, 0, 0]}, "at most 6"),
    ],
)
def test_commands_that_no_snake_can_carry_out(command, expected):
    with pytest.raises(ScenarioError) as caught:
        load_scenario("snake_operator", overrides={"controller.commands": [{"at_s": 1.0}, {"at_s": 2.0} | command]})
    assert str(caught.value).startswith("overrides: controller.commands.1.")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "; overrides" not in str(caught.value), "one problem is told once"


def test_an_unknown_mode_in_a_file_is_named_with_its_line(tmp_path: Path):
    text = "duration_s: 1\nplant: {type: snake}\ncontroller:\n  type: task_space\n  commands:\n    - at_s: 0\n"
    with pytest.raises(ScenarioError, match=r"case.yaml:7: controller.commands.0.mode = -1: no mode -1; known: "):
        load_scenario(write(tmp_path, text + "      mode: -1\n"))


@pytest.mark.parametrize("key", ["controller.fixing_mode", "controller.switching.order.0"])
def test_true_is_no_mode_number(key):
    with pytest.raises(ScenarioError, match=f"{key} = True: must be a valid integer"):
        load_scenario("snake_operator", overrides={"controller.switching.order": [2], key: True})


def test_a_robot_too_short_for_the_default_modes_is_told_to_bring_its_own():
    short = {"plant.yaw_joints": 4}
    with pytest.raises(ModelError, match=r"controller.modes is not given.* needs 7 wheel pairs; this robot has 2"):
        check(load_scenario("snake_operator", overrides=short))
    own = {"controller.modes": {"1": []}, "controller.switching.order": [1]}
    check(load_scenario("snake_operator", overrides=short | own))


def test_a_file_that_is_not_utf_8_is_named_with_its_line(tmp_path: Path):
    path = tmp_path / "case.yaml"
    path.write_bytes("duration_s: 1\nname: café\n".encode("latin-1"))
    with pytest.raises(ScenarioError, match=r"case.yaml:2: byte 0xe9 is not UTF-8; save it as UTF-8"):
        load_scenario(path)


def test_a_folder_is_no_scenario(tmp_path: Path):
    with pytest.raises(ScenarioError, match="is a folder; a regular file is needed"):
        load_scenario(tmp_path)


def test_a_record_of_10_GB_is_refused_with_a_rate_that_fits():
    with pytest.raises(ScenarioError, match=r"need 10\.\d GB, the limit .* is 2 GB; \S+ Hz would fit"):
        check(load_scenario("elbow_comparison", overrides={"record.rate_hz": 9.2e5}))


def test_missing_file_lists_what_is_shipped():
    with pytest.raises(ScenarioError, match=r"did you mean 'elbow_comparison'.*single_pendulum"):
        find_scenario("elbow_comparision.yaml")


def test_parse_override():
    assert parse_override("a.b=1e-8") == ("a.b", 1e-8)
    assert parse_override("a=[1, x]") == ("a", [1, "x"])
    with pytest.raises(ScenarioError):
        parse_override("a.b")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (".=1", "--set .: a part of the key is empty"),
        ("plant..x=1", "--set plant..x: a part of the key is empty"),
        ("=1", "--set =1: must look like"),
        ("plant.chain.²=1", "--set plant.chain.²: '²' is no index of a list of 2"),
        ("plant.chain.٠=1", "'٠' is no index"),
        ("plant.chain.-1.mass_kg=1", "'-1' is no index"),
        ("plant.chain." + "9" * 5000 + "=1", "is no index of a list of 2"),
        ("variants={a: {}}", "--set variants: which variant runs is chosen by its name"),
        ("variants.two_elbows=1", "--set variants.two_elbows: which variant runs"),
        ("variant=x", "--set variant: which variant runs"),
        ("duration_s=*a", "--set duration_s: alias *a: there is no anchor"),
        ("duration_s=&a [*a]", "--set duration_s: alias *a is within"),
        ("duration_s=" + "9" * 5000, "--set duration_s: a number of 5000 digits"),
        ("duration_s=" + "9" * 308, "--set: duration_s = 99999"),
        ("duration_s=1e-300", "--set: duration_s = 1e-300: its size must be between 1e-30 and 1e+30"),
        ("duration_s=2024-99-99", "--set: duration_s = '2024-99-99'"),
        ("duration_s=._", "--set: duration_s = '._'"),
        ("duration_s='\"", "--set duration_s: not YAML"),
        ("duration_s=\"'1'\"", "--set: duration_s = \"'1'\""),
        ("duration_s=!!python/name:os.system", "--set duration_s: tag '!!python/name:os.system' is not known"),
        ("duration_s=" + "{a: " * 100, "--set duration_s: more than 50 mappings"),
        ("duration_s=a\ud800", "--set duration_s: not YAML: character U+D800"),
        ("a" + ".a" * 100 + "=1", "has 101 parts; no key of a scenario has more than 50"),
        ("a\nb=1", "--set: a\\nb: unknown key"),
        ("a" * 5000 + "=1", "aaa…: unknown key"),
        ("name=" + "x" * 300, "must not be longer than 255 bytes"),
        ("name='a\tb'", "must be printable in one line"),
        ("plant.type=[1]", "--set: plant.type: unknown type [1]"),
    ],
)
def test_every_override_is_one_clear_error(text: str, expected: str):
    with pytest.raises(ScenarioError) as caught:
        load_scenario("elbow_comparison", overrides=SetOptions([parse_override(text)]))
    assert expected in str(caught.value)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000


def test_an_override_changes_nothing_but_what_it_names(tmp_path: Path):
    text = "duration_s: 1\nplant:\n  type: serial_arm\n  chain: [&link {com_m: &com [0, 0, 0]}, *link, {com_m: *com}]\n"
    scenario = load_scenario(write(tmp_path, text), overrides={"plant.chain.0.com_m.2": 0.1})
    assert [link["com_m"][2] for link in scenario.resolved["plant"]["chain"]] == [0.1, 0, 0]


def test_numbers_that_no_result_can_be_computed_from_are_refused(monkeypatch: pytest.MonkeyPatch):
    for value in (1e31, 1e-31, -1e300):
        with pytest.raises(ScenarioError, match=r"plant\.chain\.0\.com_m\.2 = .*: its size must be between"):
            load_scenario("elbow_comparison", overrides={"plant.chain.0.com_m": [0, 0, value]})

    def overflow(*_: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("dynsim.library.controllers.joint_pd.follow", overflow)
    with pytest.raises(
        ModelError, match=r"numbers of very different size, no result can be computed \(Singular matrix"
    ):
        check(load_scenario("elbow_comparison"))


def test_an_axis_has_a_direction():
    with pytest.raises(ScenarioError, match=r"plant.chain.0.axis: .*axis has no direction"):
        load_scenario("single_pendulum", overrides={"plant.chain.0.axis": [0, 0, 0]})


def test_schema_knows_every_family():
    text = str(json_schema())
    for word in ("serial_arm", "joint_pd", "wang_minami", "circle", "cylinder", "variants"):
        assert word in text


def test_overrides_are_called_as_they_were_given():
    with pytest.raises(ScenarioError, match=r"^overrides duration_s\.x: duration_s is a value"):
        load_scenario("single_pendulum", overrides={"duration_s.x": 1})
    with pytest.raises(ScenarioError, match=r"^--set: duration_s = -1: "):
        load_scenario("single_pendulum", overrides=SetOptions({"duration_s": -1}))


def test_a_list_is_no_scenario(tmp_path: Path):
    (tmp_path / "list.yaml").write_text("- 1\n")
    with pytest.raises(ScenarioError, match="must be a mapping of keys to values, not a list"):
        load_scenario(tmp_path / "list.yaml")


@pytest.mark.parametrize(
    ("row", "expected"), [("1, a, 0, 0", "'1, a, 0, 0' is not 4 numbers"), ("1, 0, 0", "3 values; there must be 4")]
)
def test_a_bad_row_of_a_csv_path_is_named_with_its_line(tmp_path: Path, row: str, expected: str):
    file = tmp_path / "path.csv"
    file.write_text(f"t_s, x_m, y_m, z_m\n0, 1, 0, 0\n\n{row}\n")
    with pytest.raises(ScenarioError, match=re.escape(f"{file}:4: {expected}")):
        load_scenario("elbow_comparison", overrides={"controller.hand.path": {"type": "csv", "file": str(file)}})


def test_a_record_that_does_not_fit_into_memory_is_an_error_of_the_scenario():
    overrides = {"duration_s": 1e6, "record.rate_hz": 1e9, "record.size_limit_GB": 1e12}
    with pytest.raises(ScenarioError, match="not enough memory"):
        check(load_scenario("single_pendulum", overrides=overrides))


def test_a_name_is_no_scenario():
    with pytest.raises(DynsimError, match="load_scenario"):
        dynsim.simulate("single_pendulum")  # type: ignore[arg-type]


@pytest.mark.parametrize("point", [[0.1, 0.2], [0.1, 0.2, 0.3, 0.4]])
def test_a_point_has_three_coordinates(point: list[float]):
    model = build_model(load_scenario("single_pendulum"))
    for method in (model.point_position, model.point_jacobian):
        with pytest.raises(ModelError, match="point has shape"):
            method(0, point, [0.0])
