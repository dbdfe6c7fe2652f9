"""Mechanical stops of the dynamic snake's joints, apart from the limits of the command."""

import numpy as np
import pytest
from support.messages import lines_with, raises

from dynsim.compile.snake_tree import lifting_joints
from dynsim.engine import simulate
from dynsim.errors import ModelError
from dynsim.scenario import build, load_scenario


def dynamic(**overrides):
    return load_scenario("snake_positioning_dynamic", "x", {"controller.paths": [], **overrides})


def stops(robot):
    """Lower and upper stop by joint [deg], of joints that have any."""
    return {
        link.joint: tuple(np.rad2deg([link.lower, link.upper]).round(9).tolist())
        for link in robot.links
        if np.isfinite(link.upper)
    }


def test_by_default_they_are_at_the_limits_of_the_command():
    robot = build.robot(dynamic(**{"plant.limits_deg": {"yaw": 60.0, "pitch": 115.0}}))
    d = robot.description
    for name, (lower, upper) in stops(robot).items():
        assert (lower, upper) == ((-115.0, 115.0) if name.startswith("psi") else (-60.0, 60.0))
    np.testing.assert_allclose([stops(robot)[name] for name in d.joint_names], np.rad2deg([d.lower, d.upper]).T)


def test_each_kind_of_joint_has_its_own_and_the_limits_stay():
    robot = build.robot(dynamic(**{"plant.dynamics.stops_deg.pitch": 125.0}))
    limits = stops(robot)
    assert {name for name, pair in limits.items() if pair == (-125.0, 125.0)} == {
        "psi1", "psi2", *lifting_joints(robot.description),
    }  # fmt: skip
    assert {pair for name, pair in limits.items() if name.startswith("theta")} == {(-65.0, 65.0)}
    np.testing.assert_allclose(np.unique(np.rad2deg(robot.description.upper)), [65.0, 113.0])


@pytest.mark.parametrize(("kind", "angle"), [("yaw", 64.0), ("pitch", 112.0)])
def test_they_are_no_narrower_than_the_limits(kind, angle):
    with raises(ModelError, f"plant.dynamics.stops_deg.{kind} = {angle:g}", f"plant.limits_deg.{kind}"):
        build.robot(dynamic(**{f"plant.dynamics.stops_deg.{kind}": angle}))


def test_a_joint_beyond_the_limit_of_the_command_is_held_by_its_stop():
    """20 N push the head back: psi3 gives way past 113 degrees to 118.9, or as far as its stop allows."""
    push = {"type": "constant", "body": "head", "point_m": [0.0905, 0.0, 0.0], "force_N": [-20.0, 0.0, 0.0]}
    for stop, rests_at in ((None, 113.0), (118.0, 118.0), (125.0, 118.9)):
        changes = {"plant.dynamics.stops_deg.pitch": stop, "loads": {"push": push}, "duration_s": 1.0}
        record = simulate(dynamic(**changes))
        assert np.rad2deg(record["phi"][-1, record.labels["phi"].index("psi3")]) == pytest.approx(rests_at, abs=0.05)
        force = record["stop_force"][:, record.labels["stop_force"].index("psi3")]
        assert force.any() == (stop != 125.0)
        # Only the kinematic level lets joints pass.
        assert not lines_with(record.summary["warnings"], phrase="would stop")
