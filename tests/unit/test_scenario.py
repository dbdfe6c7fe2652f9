"""Scenario files: merging, errors that name file, line, key, value and fix, and round trips."""

import re
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from support.messages import raises

import dynsim
from dynsim.config.problems import OptionKey
from dynsim.engine import check
from dynsim.errors import DynsimError, ModelError, ScenarioError, UnreachableReference
from dynsim.scenario import (
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
    with raises(ScenarioError, "integrator.newer", "step_max_s") as caught:
        scenario_from_resolved(resolved)
    assert "\n" not in str(caught.value)


def test_null_removes_a_key(tmp_path: Path):
    path = write(tmp_path, MINIMAL + "integrator: {rtol: 1e-9}\nvariants: {a: {integrator: {rtol: null}}, b: {}}\n")
    assert load_scenario(path, "a").integrator.rtol == 1e-6
    assert load_scenario(path, "b").integrator.rtol == 1e-9


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("", ["case.yaml", "duration_s", "plant"]),
        ("- 1\n", ["case.yaml"]),
        ("a: [1\n", ["case.yaml:2", "YAML"]),
        ("duration_s: 1\nduration_s: 2\n", ["case.yaml:2", "duration_s", "1"]),
        (MINIMAL + "integrater: {}\n", ["case.yaml:3", "integrater", "integrator"]),
        (MINIMAL + "integrator:\n  rtoll: 1\n", ["case.yaml:4", "integrator.rtoll", "rtol"]),
        (MINIMAL.replace("duration_s: 1", "duration_s: soon"), ["case.yaml:1", "duration_s = 'soon'"]),
        (MINIMAL.replace("duration_s: 1\n", ""), ["case.yaml", "duration_s"]),
        (MINIMAL.replace("serial_arm", "serial_amr"), ["plant.type", "serial_amr", "serial_arm"]),
        (MINIMAL.replace("axis: y", "mass_kg: -1"), ["case.yaml:2", "plant.chain.0.mass_kg = -1"]),
        (MINIMAL.replace("axis: y", "axis: w"), ["plant.chain.0.axis"]),
        (MINIMAL.replace("duration_s: 1", "duration_s: .nan"), ["case.yaml:1", "duration_s = nan"]),
        (MINIMAL + "integrator: {step_s: 0}\n", ["integrator.step_s = 0"]),
        (MINIMAL + "varaints: {}\n", ["case.yaml:3", "varaints", "variants"]),
        (MINIMAL + "name: a/b\n", ["case.yaml:3: name = 'a/b'"]),
        (MINIMAL + "variants:\n  ..: {}\n", ["variant = '..'"]),
        (SHARED.replace("mass_kg", "mas_kg"), ["case.yaml:4: plant.link.mas_kg", "mass_kg"]),
        (SHARED.replace("0.2", "heavy"), ["case.yaml:4: plant.link.mass_kg = 'heavy'"]),
        (SHARED.replace("[{axis: y}]", "[]"), ["case.yaml:5: plant.chain", "0", "1"]),
        (SHARED.replace("{mass_kg: 0.2}", "3"), ["case.yaml:4: plant.link = 3"]),
        (
            SHARED.replace("mass_kg: 0.2", "motor: {type: wang_minami, inductance_H: 0}"),
            ["case.yaml:4: plant.link.motor.inductance_H = 0", "1e-6", "radau5"],
        ),
        (
            SHARED.replace("mass_kg: 0.2", "motor: {type: wang_minami, inductance_H: -1}"),
            ["case.yaml:4: plant.link.motor.inductance_H = -1"],
        ),
        (
            SHARED.replace("axis: y", "mass_kg: 1"),
            ["case.yaml:4: plant.link.mass_kg = 0.2", "plant.chain.0.mass_kg"],
        ),
        (
            SHARED.replace("mass_kg", "damping_N_s_per_m"),
            ["case.yaml:4: plant.link.damping_N_s_per_m = 0.2", "damping_N_m_s_per_rad"],
        ),
        (
            MINIMAL.replace("axis: y", "kind: prismatic, damping_N_m_s_per_rad: 1"),
            ["case.yaml:2: plant.chain.0.damping_N_m_s_per_rad = 1", "damping_N_s_per_m"],
        ),
    ],
)
def test_errors_are_one_line_that_names_the_place(tmp_path: Path, text: str, names: list[str]):
    with raises(ScenarioError, *names) as caught:
        load_scenario(write(tmp_path, text))
    assert "\n" not in str(caught.value)


def test_all_unknown_keys_of_a_file_are_in_one_answer(tmp_path: Path):
    text = (
        MINIMAL.replace("axis: y", "axs: y")
        + "integrater: {}\nrecord: {rate: 5, size_limit_GB: -1}\nvariants:\n  a: {}\n  b:\n    metrics: {settle: 1}\n"
    )
    path = write(tmp_path, text)
    with raises(ScenarioError, "axis", "rate_hz", "integrator", "settle_s") as caught:
        load_scenario(path)
    places = re.findall(rf"{re.escape(str(path))}:\d+: [\w.]+(?: = -1)?", str(caught.value))
    assert [entry.removeprefix(f"{path}:") for entry in places] == [
        "2: plant.chain.0.axs",
        "4: record.rate",
        "3: integrater",
        "8: metrics.settle",
        "4: record.size_limit_GB = -1",
    ]


def test_every_problem_is_told_with_its_place(tmp_path: Path):
    text = MINIMAL.replace("axis: y", "axis: q, kind: prismatik, length_m: -1") + (
        "surfaces:\n  floor: {typ: plane}\nintegrator: {rtol: x}\nrecord: {rate_hz: -1}\nmetrics: {settle_s: -1}\n"
    )
    path = write(tmp_path, text)
    with raises(
        ScenarioError, f"{path}:2: plant.chain.0.kind = 'prismatik'", "'prismatic'", "'revolute'", "3"
    ) as caught:
        load_scenario(path)
    message = str(caught.value)
    places = [f"{path}:2: plant.chain.0.{key}" for key in ("kind", "axis = 'q'", "length_m = -1")]
    positions = [message.index(entry) for entry in (*places, f"{path}:4: surfaces.floor.typ")]
    assert positions == sorted(positions)
    assert "integrator" not in message


def test_of_very_many_unknown_keys_the_first_are_named(tmp_path: Path):
    with raises(ScenarioError, "k19") as caught:
        load_scenario(write(tmp_path, MINIMAL + "".join(f"k{k}: 1\n" for k in range(5000))))
    assert "k20:" not in str(caught.value)


def test_errors_of_a_choice_are_about_the_type_that_is_named(tmp_path: Path):
    text = MINIMAL + "surfaces:\n  floor:\n    type: sphere\n    center_m: [0, 0, 0]\n    normal: [0, 0, 1]\n"
    with raises(ScenarioError, "case.yaml:7: surfaces.floor.normal", "type, center_m, radius_m, inside"):
        load_scenario(write(tmp_path, text))
    with raises(ScenarioError, "case.yaml:5: surfaces.floor.type", "['sphere']", "'sphere'"):
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
    ("change", "names"),
    [
        (
            ("surface: floor", "surface: flor"),
            [":9: contacts.points.tip.surface = 'flor'", "floor"],
        ),
        (("body: link_1", "body: link_2"), [":7: contacts.points.tip.body", "link_2", "link_1"]),
        (("initial_deg: 90", "initial_deg: 80"), [":6: contacts.points.tip", "+0.05209 m", "floor"]),
    ],
)
def test_errors_of_contacts_name_key_and_line(tmp_path: Path, change: tuple[str, str], names: list[str]):
    path = write(tmp_path, CONTACT)
    check(load_scenario(path))
    write(tmp_path, CONTACT.replace(*change))
    with raises(ModelError, f"{path}{names[0]}", *names[1:]):
        check(load_scenario(path))


def test_errors_of_overridden_contacts_say_so(tmp_path: Path):
    path = write(tmp_path, CONTACT + "variants: {one: {}}\n")
    overrides = {OptionKey("contacts.points.tip.surface"): "flor"}
    with raises(ModelError, f"{path} (one): --set: contacts.points.tip.surface = 'flor'"):
        check(load_scenario(path, overrides=overrides))


def test_error_in_a_variant_names_the_variants_line(tmp_path: Path):
    text = MINIMAL + "variants:\n  good: {}\n  bad:\n    metrics:\n      settle: 1\n"
    with raises(ScenarioError, "case.yaml:7: metrics.settle", "settle_s"):
        load_scenario(write(tmp_path, text), "bad")


def test_error_beside_a_variant_names_the_line_that_has_the_key(tmp_path: Path):
    text = SHARED.replace("mass_kg", "mas_kg") + "variants:\n  a: {plant: {base: {yaw_deg: 1}}}\n"
    with raises(ScenarioError, "case.yaml:4: plant.link.mas_kg"):
        load_scenario(write(tmp_path, text), "a")


def test_shared_keys_of_a_resolved_scenario_are_refused_with_the_keys_to_set(tmp_path: Path):
    path = write(tmp_path, to_yaml(load_scenario("elbow_comparison").resolved))
    with raises(ScenarioError, "overrides: plant.link.mass_kg = 0.5", "plant.chain.0.mass_kg, plant.chain.1.mass_kg"):
        load_scenario(path, overrides={"plant.link.mass_kg": 0.5})
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
    ("overrides", "error", "names"),
    [
        ({"plant.initial_deg.1": 40}, ModelError, "contacts.points.elbow_4 +0.03698 floor"),
        ({"contacts.points.elbow_4.surface": "flor"}, ModelError, "contacts.points.elbow_4.surface floor"),
        ({"contacts.points.elbow_4.body": "link_44"}, ModelError, "contacts.points.elbow_4.body link_44 link_4"),
        ({"controller.hand.path.center_m": [3, 3, 0.4]}, UnreachableReference, "controller.hand.path 0.000 2.06"),
        ({"controller.hand.path.radius_m": 0.6}, UnreachableReference, "controller.hand.path 0.000 0.34"),
        ({"controller.hand.joints": ["joint_99"]}, ModelError, "controller.hand.joints joint_99 joint_9"),
        ({"controller.k_p_V_per_rad": [1, 2]}, ModelError, "k_p_V_per_rad 2 10"),
        ({"record.rate_hz": 1e7}, ScenarioError, "record.rate_hz"),
        ({"controller.knot_spacing_s": 1e-10}, ModelError, "controller.knot_spacing_s 1e-10 1e+11 10"),
    ],
)
def test_what_no_simulation_can_be_made_of_is_refused_by_check(overrides, error, names):
    with raises(error, *names.split()) as caught:
        check(load_scenario("elbow_comparison", overrides=overrides))
    # Which of several scenarios and variants it was.
    assert re.match(rf"{find_scenario('elbow_comparison')}(:\d+)? \(two_elbows\): ", str(caught.value))


KNOWN = "switching, fixing, 1, 2, 3, 4, 5, 6"


@pytest.mark.parametrize(
    ("command", "names"),
    [
        ({"mode": 9}, ("mode = 9", KNOWN)),
        ({"mode": 0}, ("mode = 0", KNOWN)),
        ({"mode": -1}, ("mode = -1", KNOWN)),  # inside the engine -1 and -2 are the states
        ({"mode": -2}, ("mode = -2", KNOWN)),
        ({"mode": -7}, ("mode = -7", KNOWN)),
        ({"at_s": 1e6, "mode": 44}, ("mode = 44", KNOWN)),  # after the end of the run
        ({"mode": True}, ("mode = True", "switching, fixing")),
        ({"mode": 3.0}, ("mode = 3.0", "switching, fixing")),
        ({"mode": [1]}, ("mode", "switching, fixing")),
        ({"mode": "swithcing"}, ("mode = 'swithcing'", "'switching'", "switching, fixing")),
        ({"velocity": [0.1, 0, 0, 0, 0]}, ("velocity", "5", "6")),
        ({"velocity": [0.1, 0]}, ("velocity", "2", "6")),
        ({"velocity": [0, 0, 0, 0, 0, 0, 0]}, ("velocity", "7", "6")),
    ],
)
def test_commands_that_no_snake_can_carry_out(command, names):
    with raises(ScenarioError, f"overrides: controller.commands.1.{names[0]}", *names[1:]) as caught:
        load_scenario("snake_operator", overrides={"controller.commands": [{"at_s": 1.0}, {"at_s": 2.0} | command]})
    assert "\n" not in str(caught.value)
    assert "; overrides" not in str(caught.value), "one problem is told once"


def test_an_unknown_mode_in_a_file_is_named_with_its_line(tmp_path: Path):
    text = "duration_s: 1\nplant: {type: snake}\ncontroller:\n  type: task_space\n  commands:\n    - at_s: 0\n"
    with raises(ScenarioError, "case.yaml:7: controller.commands.0.mode = -1", KNOWN):
        load_scenario(write(tmp_path, text + "      mode: -1\n"))


@pytest.mark.parametrize("key", ["controller.fixing_mode", "controller.switching.order.0"])
def test_true_is_no_mode_number(key):
    with raises(ScenarioError, f"{key} = True"):
        load_scenario("snake_operator", overrides={"controller.switching.order": [2], key: True})


def test_a_robot_too_short_for_the_default_modes_is_told_to_bring_its_own():
    short = {"plant.yaw_joints": 4}
    with raises(ModelError, "controller.modes", "7", "2"):
        check(load_scenario("snake_operator", overrides=short))
    own = {"controller.modes": {"1": []}, "controller.switching.order": [1]}
    check(load_scenario("snake_operator", overrides=short | own))


def test_a_file_that_is_not_utf_8_is_named_with_its_line(tmp_path: Path):
    path = tmp_path / "case.yaml"
    path.write_bytes("duration_s: 1\nname: café\n".encode("latin-1"))
    with raises(ScenarioError, "case.yaml:2", "0xe9"):
        load_scenario(path)


def test_a_folder_is_no_scenario(tmp_path: Path):
    with raises(ScenarioError, str(tmp_path)):
        load_scenario(tmp_path)


def test_a_record_of_10_GB_is_refused_with_a_rate_that_fits():
    with raises(
        ScenarioError, "record.rate_hz = 850000", re.compile(r"\b10\.\d GB"), "2 GB", "Hz", "record.size_limit_GB"
    ):
        check(load_scenario("elbow_comparison", overrides={"record.rate_hz": 8.5e5}))


def test_missing_file_lists_what_is_shipped():
    with raises(ScenarioError, "elbow_comparision.yaml", "'elbow_comparison'", "single_pendulum"):
        find_scenario("elbow_comparision.yaml")


def test_parse_override():
    assert parse_override("a.b=1e-8") == ("a.b", 1e-8)
    assert parse_override("a=[1, x]") == ("a", [1, "x"])
    with pytest.raises(ScenarioError):
        parse_override("a.b")


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (".=1", ("--set .",)),
        ("plant..x=1", ("--set plant..x",)),
        ("=1", ("--set =1", "integrator.rtol=1e-8")),
        ("plant.chain.²=1", ("--set plant.chain.²", "'²'", "2")),
        ("plant.chain.٠=1", ("--set plant.chain.٠", "'٠'", "2")),
        ("plant.chain.-1.mass_kg=1", ("--set plant.chain.-1.mass_kg", "'-1'", "2")),
        ("plant.chain." + "9" * 5000 + "=1", (re.compile(r"--set plant\.chain\.9+…"), "2")),
        ("variants={a: {}}", ("--set variants", "dynsim run --variant")),
        ("variants.two_elbows=1", ("--set variants.two_elbows", "dynsim run --variant")),
        ("variant=x", ("--set variant", "dynsim run --variant")),
        ("duration_s=*a", ("--set duration_s", "*a", "&a")),
        ("duration_s=&a [*a]", ("--set duration_s", "*a", "&a")),
        ("duration_s=" + "9" * 5000, ("--set duration_s", "5000", "308")),
        ("duration_s=" + "9" * 308, (re.compile(r"--set: duration_s = 9+…"), "1e-30", "1e+09")),
        ("duration_s=1e-300", ("--set: duration_s = 1e-300", "1e-30", "1e+09")),
        ("duration_s=2024-99-99", ("--set: duration_s = '2024-99-99'",)),
        ("duration_s=._", ("--set: duration_s = '._'",)),
        ("duration_s='\"", ("--set duration_s", "YAML")),
        ("duration_s=\"'1'\"", ("--set: duration_s = \"'1'\"",)),
        ("duration_s=!!python/name:os.system", ("--set duration_s", "!!python/name:os.system")),
        ("duration_s=" + "{a: " * 100, ("--set duration_s", "50")),
        ("duration_s=a\ud800", ("--set duration_s", "U+D800")),
        ("a" + ".a" * 100 + "=1", ("--set a.a", "101", "50")),
        ("a\nb=1", ("--set: a\\nb", "duration_s, plant")),
        ("a" * 5000 + "=1", (re.compile("--set: a+…: "), "duration_s, plant")),
        ("name=" + "x" * 300, ("--set: name", "255")),
        ("name='a\tb'", ("--set: name = 'a\\tb'",)),
        ("plant.type=[1]", ("--set: plant.type", "[1]", "serial_arm")),
    ],
)
def test_every_override_is_one_clear_error(text: str, names: tuple):
    with raises(ScenarioError, *names) as caught:
        load_scenario("elbow_comparison", overrides=dict([parse_override(text)]))
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000


def test_an_override_changes_nothing_but_what_it_names(tmp_path: Path):
    text = "duration_s: 1\nplant:\n  type: serial_arm\n  chain: [&link {com_m: &com [0, 0, 0]}, *link, {com_m: *com}]\n"
    scenario = load_scenario(write(tmp_path, text), overrides={"plant.chain.0.com_m.2": 0.1})
    assert [link["com_m"][2] for link in scenario.resolved["plant"]["chain"]] == [0.1, 0, 0]


def test_numbers_that_no_result_can_be_computed_from_are_refused(monkeypatch: pytest.MonkeyPatch):
    for value in (1e31, 1e-31, -1e300):
        with raises(ScenarioError, "plant.chain.0.com_m.2", "1e-30", "1e+06"):
            load_scenario("elbow_comparison", overrides={"plant.chain.0.com_m": [0, 0, value]})

    def overflow(*_: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("dynsim.library.controllers.joint_pd.follow", overflow)
    with raises(ModelError, "elbow_comparison.yaml", "Singular matrix"):
        check(load_scenario("elbow_comparison"))


def test_an_axis_has_a_direction():
    with raises(ScenarioError, "plant.chain.0.axis"):
        load_scenario("single_pendulum", overrides={"plant.chain.0.axis": [0, 0, 0]})


def test_schema_knows_every_family():
    text = str(json_schema())
    for word in ("serial_arm", "joint_pd", "wang_minami", "circle", "cylinder", "variants"):
        assert word in text


def test_overrides_are_called_as_they_were_given():
    with raises(ScenarioError, re.compile(r"^overrides duration_s\.x: ")):
        load_scenario("single_pendulum", overrides={"duration_s.x": 1})
    with raises(ScenarioError, re.compile(r"^--set: duration_s = -1: ")):
        load_scenario("single_pendulum", overrides={OptionKey("duration_s"): -1})


def test_a_list_is_no_scenario(tmp_path: Path):
    (tmp_path / "list.yaml").write_text("- 1\n")
    with raises(ScenarioError, "list.yaml"):
        load_scenario(tmp_path / "list.yaml")


@pytest.mark.parametrize(
    ("row", "names"), [("1, a, 0, 0", ("'1, a, 0, 0'", "4")), ("1, 0, 0", ("3", "4", "t_s,x_m,y_m,z_m"))]
)
def test_a_bad_row_of_a_csv_path_is_named_with_its_line(tmp_path: Path, row: str, names: tuple[str, ...]):
    file = tmp_path / "path.csv"
    file.write_text(f"t_s, x_m, y_m, z_m\n0, 1, 0, 0\n\n{row}\n")
    with raises(ScenarioError, f"{file}:4", *names):
        load_scenario("elbow_comparison", overrides={"controller.hand.path": {"type": "csv", "file": str(file)}})


def test_a_record_that_does_not_fit_into_memory_is_an_error_of_the_scenario():
    overrides = {"duration_s": 1e6, "record.rate_hz": 1e9, "record.size_limit_GB": 1e12}
    with raises(ScenarioError, "single_pendulum.yaml", "PiB", "record.rate_hz", "duration_s"):
        check(load_scenario("single_pendulum", overrides=overrides))


def test_a_name_is_no_scenario():
    with raises(DynsimError, "single_pendulum", "load_scenario"):
        dynsim.simulate("single_pendulum")  # type: ignore[arg-type]


@pytest.mark.parametrize("point", [[0.1, 0.2], [0.1, 0.2, 0.3, 0.4]])
def test_a_point_has_three_coordinates(point: list[float]):
    model = build_model(load_scenario("single_pendulum"))
    for method in (model.point_position, model.point_jacobian):
        with raises(ModelError, f"({len(point)},)", "(3,)"):
            method(0, point, [0.0])
