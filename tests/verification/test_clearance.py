"""Poses and gaps of many samples, depth of links below surfaces, and references that lift a contact off."""

import io
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from support.messages import check_message, lines_with, raises
from support.random_robots import random_positions, random_robot, random_robot_of, random_unit

import dynsim
from dynsim.cli.comparison import print_comparison, print_summary
from dynsim.compile.clearance import _is_above, axis_gaps, poses, sinking
from dynsim.compile.model import Model
from dynsim.engine import check
from dynsim.errors import ModelError
from dynsim.model.description import Inertia, Link, Quadric, Robot
from dynsim.model.joints.ball import floating
from dynsim.scenario import build, load_scenario, scenario_from_resolved

seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_poses_of_many_samples_are_those_of_the_model(seed):
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, 7)
    model, q = Model(robot), rng.normal(size=(5, len(robot.links)))
    seen = []
    for link, R, p in poses(robot, q):
        seen.append(link.name)
        for k in range(5):
            rotation, origin = model.body_pose(link.name, q[k])
            np.testing.assert_allclose(R[:, :, k], rotation, atol=1e-12)
            np.testing.assert_allclose(p[:, k], origin, atol=1e-11)
    assert seen == [link.name for link in robot.links]


@given(seeds)
def test_poses_behind_joints_of_every_kind(seed):
    rng = np.random.default_rng(seed)
    kinds = ["ball", "floating", "planar", "rolling", "revolute", "prismatic"]
    robot = random_robot_of(rng, [str(kind) for kind in rng.permutation(kinds)])
    model, q = Model(robot), np.array([random_positions(rng, robot) for _ in range(5)])
    # Between two normalisations a quaternion is not quite of unit length.
    q *= 1.0 + 1e-3 * np.array([[name.split(".")[-1] in ("qw", "qx", "qy", "qz") for name in robot.position_names]])
    for link, R, p in poses(robot, q):
        for k in range(5):
            rotation, origin = model.body_pose(link.name, q[k])
            np.testing.assert_allclose(R[:, :, k], rotation, atol=1e-12)
            np.testing.assert_allclose(p[:, k], origin, atol=1e-11)


@given(seeds)
def test_heights_in_single_precision_decide_away_from_the_limit(seed):
    rng = np.random.default_rng(seed)
    robot, q = random_robot(rng, 7), rng.normal(size=(9, 7))
    plane = Quadric(np.zeros((3, 3)), rng.normal(size=3), rng.normal())
    lowest = min(float(gap.min()) for _, _, gap in axis_gaps(robot, {"plane": plane}, q))
    size = float(np.linalg.norm(plane.b))
    # 160 roundings of 1.2e-7 of lengths (14 m), positions (7 × 4 rad) and the distance of the plane (100 m) are 3e-3 m.
    for height, above in ((1e-2, True), (1e-6, False), (-1e-2, False)):
        raised = Quadric(plane.Q, plane.b, plane.c + size * (height - lowest))
        assert _is_above(robot, {"plane": raised}, q) == above
        assert (sinking(robot, {"plane": raised}, q) == []) == (height > 0.0)


def test_rows_without_a_body_do_not_sink():
    """The first rows of a floating joint are at its frame, below the table that the body is above."""
    table = {"table": Quadric(np.zeros((3, 3)), np.array([0.0, 0.0, 1.0]), -1.0)}
    robot = Robot("r", floating(Link("body", "free", None, "", np.eye(3)[2], Inertia(1.0))), (), ("body", np.zeros(3)))
    q = np.array([[0.3, 0.2, 1.5, 1.0, 0.0, 0.0, 0.0], [0.3, 0.2, 0.8, 1.0, 0.0, 0.0, 0.0]])
    assert sinking(robot, table, q[:1]) == []
    (sunk,) = sinking(robot, table, q)
    assert (sunk.body, sunk.sample) == ("body", 1)
    assert sunk.depth == pytest.approx(0.2)


def surface(kind: str, inside: bool = False, scale: float = 1.0) -> Quadric:
    shape = {
        "plane": {"point_m": [0, 0, 0.1], "normal": [1, 2, 3]},
        "sphere": {"center_m": [0.1, 0, 0.2], "radius_m": 0.3},
        "cylinder": {"point_m": [0.1, 0, 0.2], "axis": [1, 1, 0], "radius_m": 0.3},
    }[kind]
    keys = {"type": kind, **shape, **({} if kind == "plane" else {"inside": inside})}
    scenario = scenario_from_resolved(
        {"name": "", "duration_s": 1, "plant": {"type": "serial_arm", "chain": [{}]}, "surfaces": {"s": keys}}
    )
    plain = build.surfaces(scenario)["s"]
    return Quadric(scale * plain.Q, scale * plain.b, scale * plain.c)


KINDS = [("plane", False), ("sphere", False), ("sphere", True), ("cylinder", False), ("cylinder", True)]


@pytest.mark.parametrize(("kind", "inside"), KINDS)
@pytest.mark.parametrize("scale", [1.0, 7.0])
def test_gaps_of_many_points_are_those_of_one(kind, inside, scale):
    s, points = surface(kind, inside, scale), np.random.default_rng(5).normal(size=(50, 3))
    np.testing.assert_allclose(s.gaps(points), [s.gap(point) for point in points], rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(("kind", "inside"), KINDS[1:])
def test_gap_in_the_middle_of_a_sphere_or_cylinder(kind, inside):
    """∇C vanishes there; the surface is one radius away."""
    assert surface(kind, inside).gaps(np.array([[0.1, 0.0, 0.2]]))[0] == pytest.approx(0.3 if inside else -0.3)


@pytest.mark.parametrize(("kind", "inside"), KINDS)
def test_depth_of_a_link_is_that_of_its_deepest_point(kind, inside):
    """Against 2 001 points along the axis, which are at most l/4000 from the deepest one."""
    rng, s = np.random.default_rng(6), surface(kind, inside)
    deep = 0
    for _ in range(40):
        start, along = rng.normal(scale=0.5, size=3), random_unit(rng)
        link = Link(
            "rod", "joint", None, "revolute", np.array([0.0, 0, 1]), Inertia(1.0), p_PJ=start, radius=0.02, tip=along
        )
        robot = Robot("rod", (link,), (), ("rod", np.zeros(3)))
        depth = -s.gaps(start + np.linspace(0.0, 1.0, 2001)[:, None] * along).min()
        penetration = sinking(robot, {"s": s}, np.zeros((1, 1)))
        assert bool(penetration) == (depth > 0.02)
        if penetration:
            deep += 1
            assert penetration[0].depth == pytest.approx(depth, abs=2e-4)
            assert penetration[0].depth >= depth - 1e-12
    assert deep > 3
    # Outside the pipe and beyond the bowl is nearly everything.
    assert inside or deep < 40


def test_elbows_without_a_contact_sink_and_it_is_said(simulated):
    record = simulated("elbow_comparison", "no_elbow")
    summary = record.summary
    model = Model(build.robot(load_scenario("elbow_comparison", "no_elbow")))
    lowest = np.array([model.joint_positions(q)[:, 2] for q in record["q"]])
    by_body = {entry["body"]: entry for entry in summary["sinking"]}
    assert set(by_body) == {"link_3", "link_4", "link_6", "link_7", "link_8", "link_9"}
    for name, entry in by_body.items():
        i = int(name.removeprefix("link_")) - 1
        ends = lowest[:, i : i + 2].min(axis=1)
        assert entry["surface"] == "floor"
        assert entry["depth_m"] == pytest.approx(-ends.min(), abs=1e-12)
        assert entry["since_s"] == record.time[np.flatnonzero(ends < -0.01)[0]]
    assert by_body["link_7"]["depth_m"] == pytest.approx(0.140, abs=0.001)
    (warning,) = lines_with(summary["warnings"], "floor")
    check_message(warning, "link_6, link_7, link_8, link_9", "floor", "140 mm")


def test_joints_that_rest_on_the_floor_do_not_sink(simulated):
    for variant in ("two_elbows", "elbow_7"):
        summary = simulated("elbow_comparison", variant).summary
        assert summary["sinking"] == []
        assert not lines_with(summary["warnings"], phrase="sinks")


def test_sinking_stands_in_the_tables(simulated):
    summaries = {name: simulated("elbow_comparison", name).summary for name in ("two_elbows", "elbow_4")}
    text = io.StringIO()
    print_comparison(Console(file=text, width=100), summaries, every=True)
    (row,) = (line for line in text.getvalue().splitlines() if line.split()[-2:] == ["–", "42.3"])
    assert all(warning in " ".join(text.getvalue().split()) for warning in summaries["elbow_4"]["warnings"])
    assert lines_with(summaries["elbow_4"]["warnings"], "floor", phrase="sinks")
    output = io.StringIO()
    print_summary(Console(file=output, width=100), summaries["elbow_4"])
    assert "42.3" in output.getvalue()
    none = io.StringIO()
    print_summary(Console(file=none, width=100), summaries["two_elbows"])
    assert row.split("[mm]")[0].strip() not in none.getvalue()


def test_a_urdf_body_has_no_radius_and_reaches_to_its_joints_and_the_hand(tmp_path):
    scenario = load_scenario(
        "six_axis_arm",
        overrides={"duration_s": 0.05, "controller": None, "surfaces": {"ceiling": {
            "type": "plane", "point_m": [0, 0, 0.56], "normal": [0, 0, -1]}}},
    )  # fmt: skip
    robot = build.robot(scenario)
    model = Model(robot)
    summary = dynsim.simulate(scenario).summary
    heights = {link.name: [] for link in robot.links}
    for link in robot.links:
        z = model.body_pose(link.name, robot.initial)[1][2]
        heights[link.name].append(z)
        if link.parent is not None:
            heights[link.parent].append(z)
    heights[robot.hand[0]].append(model.point_position(*robot.hand, robot.initial)[2])
    above = {name for name, z in heights.items() if max(z) > 0.56}
    assert above
    assert {entry["body"] for entry in summary["sinking"] if entry["since_s"] == 0.0} == above


def test_a_run_that_diverged_has_finite_depths():
    """The last samples of a slide that ran away, beyond 1e154 m, whose squares overflow."""
    scenario = scenario_from_resolved(
        {
            "name": "away",
            "duration_s": 1,
            "plant": {"type": "serial_arm", "chain": [{"kind": "prismatic", "axis": "z"}]},
            "surfaces": {
                "floor": {"type": "plane", "normal": [1, 1, 1]},
                "ball": {"type": "sphere", "center_m": [0, 0, 1], "radius_m": 0.5},
            },
        }
    )
    q = np.array([[0.0], [-3.0], [-1e200], [1e308], [-np.inf], [np.nan]])
    penetrations = {s.surface: s for s in sinking(build.robot(scenario), build.surfaces(scenario), q)}
    assert set(penetrations) == {"floor"}
    assert penetrations["floor"].sample == 1
    assert penetrations["floor"].depth == pytest.approx(1e200 / np.sqrt(3.0))


TEARING = {"controller.joints": {"joint_3": {"times_s": [0, 2], "angles_deg": [90, 80]}}}


def test_references_that_tear_a_brace_off_are_refused():
    """Joint 3 raises the links behind it by 10° within 2 s, as 3 s² − 2 s³ of the time; yaw does not change heights."""
    scenario = load_scenario("elbow_comparison", "two_elbows", TEARING)
    model = Model(build.robot(scenario))

    def height(t: float) -> float:
        q, s = model.robot.initial.copy(), min(t / 2.0, 1.0)
        q[2] -= np.deg2rad(10.0) * (3.0 * s**2 - 2.0 * s**3)
        return float(model.point_position("link_7", np.zeros(3), q)[2])

    for refuse in (check, dynsim.simulate):
        with raises(ModelError, "elbow_7", "floor", "contacts.reference_tolerance_m = 0.002 m", "elbow_4") as caught:
            refuse(scenario)
        text = str(caught.value)
        (depth,), (time, first) = re.findall(r"\+([\d.]+) m", text), re.findall(r"\bt = ([\d.]+) s", text)
        (z,) = re.findall(r"\([\d.]+, [\d.]+, ([\d.]+)\) m", text)
        depth, time, z, first = map(float, (depth, time, z, first))
        # The quintic through the knots rings by some micrometres where the waypoints begin to hold.
        assert depth == pytest.approx(height(2.0), rel=1e-3)
        assert z == pytest.approx(depth, rel=1e-3)
        assert time == pytest.approx(2.0, abs=0.05)
        assert height(first - 0.006) < 0.002 < height(first + 0.001)


def lifted(angle: float, **more) -> dynsim.scenario.Scenario:
    """Only elbow 4 held; joint 3 goes to 90° + angle within a second."""
    return load_scenario(
        "elbow_comparison",
        "elbow_4",
        {
            "controller.joints": {"joint_3": {"times_s": [0, 1], "angles_deg": [90, 90 + angle]}},
            "duration_s": 2,
            **more,
        },
    )


def test_two_millimetres_are_allowed_and_the_key_moves_the_limit():
    # Elbow 4 is 0.3 m from joint 3, at 45° below it: dz = 0.3 m · sin 45° · dθ = 3.7 mm per degree.
    check(lifted(0.5))
    with raises(
        ModelError, "elbow_4", "floor", re.compile(r"\bt = [\d.]+ s"), "contacts.reference_tolerance_m = 0.002 m"
    ):
        check(lifted(0.6))
    check(lifted(0.6, **{"contacts.reference_tolerance_m": 0.01}))
    with raises(ModelError, "elbow_4", "contacts.reference_tolerance_m = 0.001 m"):
        check(lifted(0.5, **{"contacts.reference_tolerance_m": 0.001}))


def test_between_the_knots_is_looked_at_too():
    """Knots half a second apart put elbow 4 1.9 mm off at most; the spline that is followed bulges beyond 2 mm."""
    bulge = {"times_s": [0.0, 0.5, 1.0, 1.5], "angles_deg": [90, 90.52, 90.52, 90]}
    scenario = load_scenario(
        "elbow_comparison",
        "elbow_4",
        {"controller.joints": {"joint_3": bulge}, "controller.knot_spacing_s": 0.5, "duration_s": 3},
    )
    with raises(ModelError, "elbow_4", re.compile(r"-0\.002\d+ m"), "floor", "0.750 s"):
        check(scenario)


def test_a_joint_that_follows_nothing_gives_way():
    """Behind a free joint, or one whose motor has no position gain, the references do not place the point."""
    chain = [{"axis": "y", "initial_deg": 45, "motor": {"type": "wang_minami"}}, {"axis": "y", "initial_deg": 90}]
    base = {
        "name": "give",
        "duration_s": 1,
        "plant": {"type": "serial_arm", "chain": chain},
        "controller": {"type": "joint_pd", "joints": {"joint_1": {"times_s": [0, 1], "angles_deg": [45, 35]}}},
        "surfaces": {"floor": {"type": "plane"}},
        "contacts": {"points": {"tip": {"body": "link_2", "point_m": [0, 0, 0.3]}}},
    }
    check(scenario_from_resolved(base))
    driven = [chain[0], {**chain[1], "motor": {"type": "wang_minami"}}]
    with raises(ModelError, "tip", "floor", "contacts.reference_tolerance_m"):
        check(scenario_from_resolved({**base, "plant": {"type": "serial_arm", "chain": driven}}))
    limp = {**base, "plant": {"type": "serial_arm", "chain": driven}}
    limp["controller"] = {**base["controller"], "k_p_V_per_rad": [500, 0]}
    check(scenario_from_resolved(limp))
