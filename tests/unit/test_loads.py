"""Loads of a scenario: forces and torques over time, payloads as part of the links, and errors that name the line."""

from __future__ import annotations

from pathlib import Path

import jsonschema
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from support.messages import raises

from dynsim.compile.model import Model
from dynsim.engine import check
from dynsim.errors import ModelError, ScenarioError
from dynsim.model.description import Load
from dynsim.scenario import Scenario, build, json_schema, load_scenario, scenario_from_resolved, to_yaml

CHAIN = "duration_s: 2\nplant:\n  type: serial_arm\n  chain: [{axis: z}, {axis: y}, {axis: y, mass_kg: 0.3}]\n"
TIMES = [0.0, 0.5, 0.7, 1.5, 1.8]
FORCES = [[0.0, 1.0, 2.0], [3.0, -1.0, 0.5], [2.0, 2.0, 2.0], [0.0, 0.1, -4.0], [1.0, 1.0, 1.0]]
URDF = """<robot name="r">
  <link name="base"/>
  <link name="arm"><inertial><origin xyz="0 0 0.1"/><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="tool"/>
  <joint name="j" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint>
  <joint name="f" type="fixed"><parent link="arm"/><child link="tool"/>
    <origin xyz="0 0 0.4" rpy="0 0 1.5707963267948966"/></joint>
</robot>
"""


def read(folder: Path, loads: str, plant: str = CHAIN) -> Scenario:
    path = folder / "case.yaml"
    path.write_text(f"{plant}loads:\n{loads}", encoding="utf-8")
    return load_scenario(path)


def the_load(scenario: Scenario) -> Load:
    (load,) = build.loads(scenario, build.robot(scenario))
    return load


def test_a_constant_load_has_no_end(tmp_path: Path) -> None:
    load = the_load(
        read(tmp_path, "  push: {type: constant, body: link_2, point_m: [0, 0, 0.1], force_N: [1, 2, 3]}\n")
    )
    assert (load.name, load.body, load.in_body) == ("push", "link_2", False)
    assert np.array_equal(load.point, [0.0, 0.0, 0.1])
    assert np.array_equal(load.components(np.array([-1.0, 0.0, 1.3, 2.0, 9.0])), np.tile([1, 2, 3, 0, 0, 0], (5, 1)))


@pytest.mark.parametrize("keeps_last", [True, False])
@pytest.mark.parametrize("interpolation", ["spline", "linear"])
def test_samples_are_met_and_interpolated_as_scipy_and_numpy_do(
    tmp_path: Path, interpolation: str, keeps_last: bool
) -> None:
    text = f"  push: {{type: samples, body: link_3, times_s: {TIMES}, torque_N_m: {FORCES}, "
    load = the_load(read(tmp_path, f"{text}interpolation: {interpolation}, hold: {str(keeps_last).lower()}}}\n"))
    t = np.linspace(TIMES[0], TIMES[-1], 301)
    columns = np.array(FORCES)
    expected = CubicSpline(TIMES, columns)(t)
    if interpolation == "linear":
        expected = np.stack([np.interp(t, TIMES, column) for column in columns.T], axis=1)
    # Some rounding errors of numbers up to ten.
    assert np.allclose(load.components(t)[:, 3:], expected, rtol=0.0, atol=1e-13)
    assert np.allclose(load.components(np.array(TIMES))[:, 3:], columns, rtol=0.0, atol=1e-13)
    assert not load.components(t)[:, :3].any()
    before, after = load.components(np.array([TIMES[0] - 1e-9, TIMES[-1] + 1e-9]))[:, 3:]
    assert np.allclose([before, after], [columns[0], columns[-1]] if keeps_last else 0.0, rtol=0.0, atol=1e-13)


@pytest.mark.parametrize("torques", [True, False])
def test_a_table_is_read_beside_its_scenario(tmp_path: Path, torques: bool) -> None:
    header = "t_s,fx_N,fy_N,fz_N" + (",mx_N_m,my_N_m,mz_N_m" if torques else "")
    rows = [[t, *force, *(force if torques else ())] for t, force in zip(TIMES, FORCES, strict=True)]
    lines = [header, *(",".join(map(repr, row)) for row in rows)]
    (tmp_path / "push.csv").write_text("\n".join(lines), encoding="utf-8")
    load = the_load(read(tmp_path, "  push: {type: csv, body: link_1, file: push.csv, interpolation: linear}\n"))
    expected = np.hstack([FORCES, FORCES if torques else np.zeros((5, 3))])
    assert np.allclose(load.components(np.array(TIMES)), expected, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("frame", ["world", "body"])
def test_axes_of_a_frame_fixed_on_a_link_become_those_of_the_link(tmp_path: Path, frame: str) -> None:
    (tmp_path / "robot.urdf").write_text(URDF, encoding="utf-8")
    load = the_load(
        read(
            tmp_path,
            f"  push: {{type: constant, body: tool, point_m: [0.1, 0, 0], frame: {frame}, "
            "force_N: [1, 0, 2], torque_N_m: [0, 3, 0]}\n",
            "duration_s: 1\nplant: {type: urdf_arm, file: robot.urdf}\n",
        )
    )
    assert (load.body, load.in_body) == ("arm", frame == "body")
    assert np.allclose(load.point, [0.0, 0.1, 0.4], rtol=0.0, atol=1e-12)
    # The tool is turned by a right angle about z: its x is the link's y, its y the link's -x.
    expected = [0, 1, 2, -3, 0, 0] if frame == "body" else [1, 0, 2, 0, 3, 0]
    assert np.allclose(load.components(np.zeros(1))[0], expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("shape", "moments"),
    [
        ("", [0.0, 0.0, 0.0]),
        (", radius_m: 0.1", [0.002] * 3),
        (", inertia_kg_m2: [0.01, 0.02, 0.03]", [0.01, 0.02, 0.03]),
    ],
)
def test_a_payload_adds_its_mass_to_the_mass_matrix_and_its_weight_to_the_bias(
    tmp_path: Path, shape: str, moments: list[float]
) -> None:
    """ΔM = m J_vᵀ J_v + J_ωᵀ R I Rᵀ J_ω and Δg = −m J_vᵀ g, with the Jacobians of its centre of mass."""
    point, mass = [0.05, -0.02, 0.3], 0.5
    payload = f"  gripper: {{type: payload, body: link_2, mass_kg: {mass}, point_m: {point}{shape}}}\n"
    loaded, bare = Model(build.robot(read(tmp_path, payload))), Model(build.robot(read(tmp_path, "  {}\n")))
    assert build.loads(read(tmp_path, payload), loaded.robot) == []
    random = np.random.default_rng(4)
    for _ in range(5):
        q = random.uniform(-2.0, 2.0, 3)
        J = bare.point_jacobian("link_2", point, q)
        # Rates of the axes of the link, from points on them: ω × e for each axis e.
        ends = [bare.point_jacobian("link_2", e, q) - bare.point_jacobian("link_2", np.zeros(3), q) for e in np.eye(3)]
        axes = [bare.point_position("link_2", e, q) - bare.point_position("link_2", np.zeros(3), q) for e in np.eye(3)]
        R = np.stack(axes, axis=1)
        spin = 0.5 * sum(np.cross(a, end, axisb=0, axisc=0) for a, end in zip(axes, ends, strict=True))
        dM = mass * J.T @ J + spin.T @ R @ np.diag(moments) @ R.T @ spin
        assert np.allclose(loaded.mass_matrix(q) - bare.mass_matrix(q), dM, rtol=0.0, atol=1e-12)
        dg = -mass * J.T @ np.array([0.0, 0.0, -9.81])
        still = np.zeros(3)
        assert np.allclose(loaded.bias_forces(q, still) - bare.bias_forces(q, still), dg, rtol=0.0, atol=1e-12)


def test_several_payloads_on_a_link_add_up(tmp_path: Path) -> None:
    two = "  a: {type: payload, body: link_3, mass_kg: 1, point_m: [0.1, 0, 0]}\n"
    two += "  b: {type: payload, body: link_3, mass_kg: 1, point_m: [-0.1, 0, 0]}\n"
    inertia = build.robot(read(tmp_path, two)).links[2].inertia
    assert inertia.mass == pytest.approx(2.3, rel=1e-15)
    assert np.allclose(inertia.com, [0.0, 0.0, 0.3 * 0.15 / 2.3], rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("shape", ["", ", radius_m: 0.1"])
def test_a_payload_without_mass_adds_nothing(tmp_path: Path, shape: str) -> None:
    """As a sweep over its mass begins: the link is that without a payload, to the bit."""
    payload = f"  gripper: {{type: payload, body: link_2, mass_kg: 0, point_m: [0.1, 0, 0]{shape}}}\n"
    loaded, bare = build.robot(read(tmp_path, payload)), build.robot(read(tmp_path, "  {}\n"))
    for with_it, without in zip(loaded.links, bare.links, strict=True):
        assert with_it.inertia.mass == without.inertia.mass
        assert np.array_equal(with_it.inertia.com, without.inertia.com)
        assert np.array_equal(with_it.inertia.tensor, without.inertia.tensor)


@pytest.mark.parametrize(
    ("load", "names"),
    [
        ("{type: constant, body: link_9}", "case.yaml:6: loads.push.body link_9"),
        ("{type: payload, body: link_9, mass_kg: 1}", "case.yaml:6: loads.push.body link_9"),
        ("{type: constnat, body: link_1}", "case.yaml:6: loads.push.type constnat constant"),
        ("{type: constant, body: link_1, force: [1, 0, 0]}", "case.yaml:6: loads.push.force force_N"),
        ("{type: constant, body: link_1, force_N: [1, 0]}", "case.yaml:6: loads.push.force_N"),
        ("{type: constant, body: link_1, frame: tool}", "case.yaml:6: loads.push.frame 'tool'"),
        ("{type: samples, body: link_1, times_s: [0, 1]}", "case.yaml:6: loads.push force_N torque_N_m"),
        (
            "{type: samples, body: link_1, times_s: [0, 1], force_N: [[0, 0, 0]]}",
            "case.yaml:6: loads.push.force_N 1 2 times_s",
        ),
        (
            "{type: samples, body: link_1, times_s: [1, 1], force_N: [[0, 0, 0], [0, 0, 0]]}",
            "case.yaml:6: loads.push.times_s",
        ),
        ("{type: csv, body: link_1, file: steep.csv}", "case.yaml:6: loads.push steep.csv"),
        ("{type: payload, body: link_1}", "case.yaml:6: loads.push.mass_kg"),
        ("{type: payload, body: link_1, mass_kg: -1}", "case.yaml:6: loads.push.mass_kg -1"),
        ("{type: payload, body: link_9, mass_kg: 0}", "case.yaml:6: loads.push.body link_9"),
        (
            "{type: payload, body: link_1, mass_kg: 0, inertia_kg_m2: [1, 1, 1]}",
            "case.yaml:6: loads.push.inertia_kg_m2 mass_kg",
        ),
        (
            "{type: payload, body: link_1, mass_kg: 1, radius_m: 1, inertia_kg_m2: [1, 1, 1]}",
            "case.yaml:6: loads.push.inertia_kg_m2 radius_m",
        ),
        (
            "{type: payload, body: link_1, mass_kg: 1, inertia_kg_m2: [1, 1, 3]}",
            "case.yaml:6: loads.push.inertia_kg_m2",
        ),
        ("{type: csv, body: link_1, file: none.csv}", "none.csv"),
        ("{type: csv, body: link_1, file: bad.csv}", "bad.csv:1 't,fx,fy,fz' t_s,fx_N,fy_N,fz_N"),
        ("{type: csv, body: link_1, file: row.csv}", "row.csv:3 5 4 t_s,fx_N,fy_N,fz_N"),
    ],
)
def test_errors_are_one_line_that_names_the_place(tmp_path: Path, load: str, names: str) -> None:
    (tmp_path / "bad.csv").write_text("t,fx,fy,fz\n0,1,2,3\n1,1,2,3\n", encoding="utf-8")
    (tmp_path / "steep.csv").write_text("t_s,fx_N,fy_N,fz_N\n0,1,2,3\n1e-200,1e200,2,3\n1,2,3,4\n", encoding="utf-8")
    (tmp_path / "row.csv").write_text("t_s,fx_N,fy_N,fz_N\n0,1,2,3\n1,1,2,3,4\n", encoding="utf-8")
    with raises((ScenarioError, ModelError), *names.split()) as caught:
        check(read(tmp_path, f"  push: {load}\n"))
    assert "\n" not in str(caught.value)


def test_a_resolved_scenario_has_its_loads_and_no_key_without_them(tmp_path: Path) -> None:
    scenario = read(tmp_path, f"  push: {{type: samples, body: link_1, times_s: {TIMES}, force_N: {FORCES}}}\n")
    again = scenario_from_resolved(scenario.resolved)
    assert again.resolved == scenario.resolved
    assert np.array_equal(the_load(again).coefficients, the_load(scenario).coefficients)
    (tmp_path / "again.yaml").write_text(to_yaml(scenario.resolved), encoding="utf-8")
    assert load_scenario(tmp_path / "again.yaml").resolved == scenario.resolved
    assert "loads" not in read(tmp_path, "  {}\n").resolved
    assert "loads" not in load_scenario("elbow_comparison").resolved


def test_a_kinematic_plant_takes_no_loads() -> None:
    load = {"type": "constant", "body": "head", "force_N": [1, 0, 0]}
    with raises(ModelError, "snake_circle.yaml", "snake", "kinematic"):
        check(load_scenario("snake_circle", overrides={"loads": {"push": load}}))


@pytest.mark.parametrize(
    ("load", "valid"),
    [
        ({"type": "constant", "body": "a", "force_N": [1, 2, 3]}, True),
        ({"type": "constant", "body": "a", "force_N": [1, 2]}, False),
        ({"type": "payload", "body": "a", "mass_kg": 1}, True),
        ({"type": "payload", "body": "a", "mass_kg": 1, "force_N": [1, 2, 3]}, False),
        ({"type": "gust", "body": "a"}, False),
    ],
)
def test_the_schema_knows_loads(load: dict, valid: bool) -> None:
    scenario = {"duration_s": 1, "plant": {"type": "serial_arm", "chain": [{}]}, "loads": {"push": load}}
    assert jsonschema.Draft202012Validator(json_schema()).is_valid(scenario) is valid
