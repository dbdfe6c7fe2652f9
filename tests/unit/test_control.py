"""Position references of controllers: the motor references made from them, and refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.messages import raises

from dynsim.compile.control import JointControl
from dynsim.engine.prepare import prepare
from dynsim.errors import ModelError
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
    for sampled, other in zip(first.reference, second.reference, strict=True):
        assert np.array_equal(sampled, other)
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
    ("change", "names"),
    [
        ({"positions": {"elbow": TIMES}}, ("elbow", "joint_1")),
        ({"positions": {"joint_1": TIMES[:-1]}}, ("joint_1", "101")),
        ({"positions": {"joint_1": lambda t: 0.0}}, ("joint_1", "101")),
        ({"positions": {"joint_1": TIMES * np.nan}}, ("joint_1", "101")),
        ({"times": TIMES**2}, ()),
        ({"times": TIMES[:5]}, ()),
        ({"times": -TIMES}, ()),
        ({"times": ()}, ()),
        ({"k_p": [1.0, 2.0]}, ("k_p", "10")),
        ({"k_d": -1.0}, ("k_d",)),
    ],
)
def test_references_that_do_not_fit_are_refused(robot: Robot, change: dict, names: tuple[str, ...]) -> None:
    arguments = {"k_p": 1.0, "k_d": 1.0, "times": TIMES, "positions": {"joint_1": TIMES}} | change
    with raises(ModelError, *names):
        JointControl.following(robot, **arguments)


def test_references_that_end_before_the_run_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = load_scenario("elbow_comparison")
    model = build.build_model(scenario)
    short = JointControl.following(model.robot, 1.0, 1.0, TIMES, {"joint_1": TIMES})
    monkeypatch.setattr("dynsim.library.controllers.joint_pd.build", lambda config, context: replace(short))
    with raises(ModelError, "joint_pd", "2 s", "10 s"):
        build.controller(scenario, model)


def kinked(t: np.ndarray) -> np.ndarray:
    """Rest, and from 1 s on a constant acceleration."""
    return 0.1 * np.maximum(t - 1.0, 0.0) ** 2


def test_references_bend_where_the_polynomials_of_their_segments_part(robot: Robot) -> None:
    """Each knot in turn: the segment before, continued for three knots, against the segment behind."""
    rtol, atol = 1e-6, 1e-8
    control = JointControl.following(robot, 500.0, 20.0, TIMES, {"joint_3": kinked})
    splines, spacing = control.reference.coefficients[:, 0], control.reference.grid[1]
    # The last three knots are too near the end to look three further, but what their segments are is known.
    before, behind = (np.array([np.polyval(c[::-1], x * spacing) for c in splines]) for x in (4.0, 3.0))
    parts = np.abs(before[:-1] - behind[1:]) > atol + rtol * 0.1
    assert np.allclose(control.bends(rtol, atol), TIMES[1:-1][parts], rtol=0.0, atol=1e-12)
    # The spline through samples of a kink rings on both sides of it, by 0.43 times from knot to knot.
    near = np.abs(control.bends(rtol, atol) - 1.0)
    assert len(near) >= 6
    assert near.max() <= 0.25
    assert len(control.bends(1e-3, 1e-4)) < len(near)


def test_smooth_references_and_commands_that_are_held_bend_nowhere(robot: Robot) -> None:
    smooth = {"joint_3": lambda t: 0.1 * np.sin(3.0 * t)}
    assert not len(JointControl.following(robot, 500.0, 20.0, TIMES, smooth).bends(1e-6, 1e-8))
    assert not len(JointControl.following(robot, 500.0, 20.0).bends(1e-6, 1e-8))
    held = JointControl.following(robot, 500.0, 20.0, TIMES, {"joint_3": kinked}, sample_time=0.01)
    assert not len(held.bends(1e-6, 1e-8))


def test_planned_voltages_bend_too(robot: Robot) -> None:
    voltages = np.zeros((len(TIMES), len(robot.motors)))
    voltages[:, 4] = kinked(TIMES)
    control = JointControl.following(robot, 500.0, 20.0, TIMES, voltages=voltages)
    moved = JointControl.following(robot, 500.0, 20.0, TIMES, {"joint_3": kinked})
    assert np.array_equal(control.bends(1e-6, 1e-8), moved.bends(1e-6, 1e-8))


def test_only_the_steps_of_an_implicit_method_end_at_bends() -> None:
    run = {m: prepare(load_scenario("wall_push", overrides={"integrator.method": m})).run for m in ("radau5", "dopri5")}
    assert {round(t, 9) for t in run["radau5"].breaks} >= {0.18, 0.22, 1.18, 1.22, 1.48, 1.52, 4.48, 4.52}
    assert not len(run["dopri5"].breaks)
