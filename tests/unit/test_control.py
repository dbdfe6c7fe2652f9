"""References that controllers give as positions: what the motors then follow, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dynsim.errors import ModelError
from dynsim.model.control import JointControl
from dynsim.model.description import Robot
from dynsim.scenario import build, load_scenario

TIMES = np.linspace(0.0, 2.0, 101)


@pytest.fixture(scope="module")
def robot() -> Robot:
    return build.robot(load_scenario("elbow_comparison"))


def test_samples_and_functions_are_the_same_references_and_the_other_joints_hold(robot: Robot) -> None:
    start = robot.initial[2]
    motion = lambda t: start + 0.1 * np.sin(3.0 * t)  # noqa: E731
    first = JointControl.following(robot, 500.0, 20.0, TIMES, {"joint_3": motion(TIMES)})
    second = JointControl.following(robot, 500.0, 20.0, TIMES, {"joint_3": motion})
    for one, other in zip(first.reference, second.reference, strict=True):
        assert np.array_equal(one, other)
    times, q = (np.concatenate(pieces) for pieces in zip(*first.positions(robot), strict=True))
    # A quintic spline errs by some h⁶ max|f⁽⁶⁾| = 0.02⁶ · 0.1 · 3⁶, more towards its ends.
    assert np.allclose(q[:, 2], motion(times), rtol=0.0, atol=1e-7)
    others = [j for j in range(len(robot.links)) if j != 2]
    assert np.array_equal(q[:, others], np.tile(robot.initial[others], (len(q), 1)))
    assert first.end == pytest.approx(2.0)
    assert set(first.k_p) == {500.0}


def test_without_positions_every_motor_holds(robot: Robot) -> None:
    gains = np.linspace(500.0, 50.0, len(robot.motors))
    control = JointControl.following(robot, gains, 0.1 * gains)
    assert np.array_equal(control.reference.held, robot.initial)
    assert (control.reference.spline == -1).all()
    assert np.array_equal(control.k_p, gains)
    assert control.end == np.inf


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"positions": {"elbow": TIMES}}, "'elbow' is no joint with a motor; those are: joint_1"),
        ({"positions": {"joint_1": TIMES[:-1]}}, "reference of joint_1 needs 101 finite positions"),
        ({"positions": {"joint_1": lambda t: 0.0}}, "reference of joint_1 needs 101 finite positions"),
        ({"positions": {"joint_1": TIMES * np.nan}}, "reference of joint_1 needs 101 finite positions"),
        ({"times": TIMES**2}, "six or more equally spaced times"),
        ({"times": TIMES[:5]}, "six or more equally spaced times"),
        ({"times": -TIMES}, "must increase"),
        ({"times": ()}, "six or more equally spaced times"),
        ({"k_p": [1.0, 2.0]}, "k_p must be one gain, or one for each of 10 motors"),
        ({"k_d": -1.0}, "k_d must be one gain"),
    ],
)
def test_references_that_do_not_fit_are_refused(robot: Robot, change: dict, expected: str) -> None:
    given = {"k_p": 1.0, "k_d": 1.0, "times": TIMES, "positions": {"joint_1": TIMES}} | change
    with pytest.raises(ModelError, match=expected):
        JointControl.following(robot, **given)


def test_references_that_end_before_the_run_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = load_scenario("elbow_comparison")
    model = build.build_model(scenario)
    short = JointControl.following(model.robot, 1.0, 1.0, TIMES, {"joint_1": TIMES})
    monkeypatch.setattr("dynsim.control.joint_pd.build", lambda config, context: replace(short))
    with pytest.raises(ModelError, match="controller 'joint_pd': its references end at 2 s, the run at 10 s"):
        build.controller(scenario, model)
