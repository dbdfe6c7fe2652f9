"""The kinematic snake and its tick loop: rolling, sampling error, feedback, limits, modes that tip, live sources."""

import json
import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from numba import config
from support.messages import check_message, lines_with, raises

from dynsim.engine import kinematic, simulate
from dynsim.engine.kinematic import attitude, attitude_distance
from dynsim.errors import ModelError, ScenarioError
from dynsim.scenario import Scenario, ScenarioConfig, load_scenario
from dynsim.snake import controller as control
from dynsim.snake import kinematics, ticks
from dynsim.snake.description import NO_REQUEST, SWITCHING, CommandBlock

GAMMA = {"type": "ramp", "start_s": 0.1, "duration_s": 1.0, "displacement": [0.02, 0.03, -0.03, 0.1, 0.1, 0.3]}


def scenario(duration_s=2.0, rate_hz=100, plant=None, **controller):
    config = ScenarioConfig.model_validate(
        {
            "name": "test",
            "duration_s": duration_s,
            "plant": {"type": "snake"} | (plant or {}),
            "controller": {"type": "task_space"} | controller,
            "record": {"rate_hz": rate_hz},
        }
    )
    return Scenario("test", "", config)


def run(*args, **settings):
    return simulate(scenario(*args, **settings))


@pytest.mark.parametrize(("rates_at", "order"), [("start", 1), ("middle", 2)])
def test_head_error_falls_with_the_order_of_the_held_rates(rates_at, order):
    errors = []
    for period in (0.01, 0.005, 0.0025):
        record = run(rates_at=rates_at, period_s=period, paths=[GAMMA], rate_hz=100)
        errors.append(record.summary["position_error_max_m"])
    ratios = np.array(errors[:-1]) / errors[1:]
    # exact halving up to the next term of the series
    np.testing.assert_allclose(ratios, 2.0**order, rtol=0.15)


def test_wheels_roll_without_slip():
    """The recorded base motion against the recorded wheel angles: X_1 . v_1 - side b yaw' = r rho_1'."""
    record = run(paths=[GAMMA], rate_hz=200)
    base, rho, h = record["base_pose"], record["rho"], 1 / 200
    rate = (base[2:] - base[:-2]) / (2 * h)
    yaw = base[1:-1, 2]
    centre = rate[:, 0] * np.cos(yaw) + rate[:, 1] * np.sin(yaw) - 0.075 * rate[:, 2]
    wheel = 0.05 * (rho[2:, 0] - rho[:-2, 0]) / (2 * h)
    # central differences, and rates that are constant within a period: O(h^2) = 2.5e-5 times curvature, O(h) at kinks
    moving = slice(30, 210)
    np.testing.assert_allclose(centre[moving], wheel[moving], atol=1e-4)
    side = -rate[:, 0] * np.sin(yaw) + rate[:, 1] * np.cos(yaw)
    np.testing.assert_allclose(side[moving], 0.0, atol=1e-4)
    assert record.summary["slip_max_m_s"] < 1e-4


def test_motion_does_not_depend_on_wheel_side_or_track_as_wheel_weights_vanish():
    """A whole run with mode switching: other sides and gaps turn the wheels otherwise, the robot moves the same.

    The margin is a matter of the track, so no mode may be refused and the cost is that of the angles.
    """
    other = {"driven_side": ["right", "right", "left", "left", "right", "left", "left"], "wheel_gap_m": 0.1}
    commands = [{"at_s": 0.3, "mode": "switching"}]
    difference = []
    for weight in (1e-2, 1e-4, 1e-6):
        settings = {"weight_wheel": weight, "paths": [GAMMA], "commands": commands, "switching": {"period_s": 0.3}}
        records = [run(plant=plant, **settings) for plant in ({}, other)]
        assert records[0].summary["mode_switches"] > 3
        assert np.abs(records[0]["rho"] - records[1]["rho"]).max() > 0.1
        motions = [np.hstack([record["phi"], record["base_pose"]]) for record in records]
        difference.append(np.abs(motions[0] - motions[1]).max())
    # proportional to the weight: a hundredth each time (a factor of two is left for the second order)
    assert difference[1] < 2e-2 * difference[0]
    assert difference[2] < 2e-2 * difference[1]


def test_substeps_of_the_plant_change_nothing_but_rounding_of_the_base():
    """Runge-Kutta 4 over 5 ms is already converged: its error is far below that of the held rates."""
    single, four = (run(paths=[GAMMA], plant_substeps=n) for n in (1, 4))
    np.testing.assert_allclose(single["base_pose"], four["base_pose"], atol=1e-9)
    assert np.any(single["base_pose"] != four["base_pose"])  # the option does something


@pytest.mark.parametrize("state", ["measured", "estimated", "feedforward"])
def test_states_agree_when_nothing_disturbs(state):
    """[T] IV.C.1, IV.C.2: with ideal joints and no slip, integration and measurement tell the same."""
    record = run(paths=[GAMMA], state=state, duration_s=4.0)
    assert record.summary["final_position_error_m"] < 1e-6
    assert record.summary["final_attitude_error_rad"] < 1e-6
    np.testing.assert_allclose(record["w_estimate"], record["w"], atol=1e-6)


@pytest.mark.parametrize("state", ["measured", "estimated", "feedforward"])
def test_what_is_integrated_is_never_corrected(state):
    """From the zigzag joints are clamped and the head goes off by millimetres: only the measured state notices."""
    overrides = {"controller.state": state, "duration_s": 2.0}
    record = simulate(load_scenario("snake_joint_limits", "saturate", overrides))
    assert record.summary["clamped_joint_ticks"] > 0
    # without the last sample: no control period begins there, and nothing is measured
    off = np.abs(record["w_estimate"] - record["w"])[:-1].max(axis=0)
    if state == "measured":
        assert off.max() == 0.0
    else:
        assert off[[0, 1]].max() > 1e-3
        np.testing.assert_allclose(off[2:5], 0.0, atol=1e-9)


def test_only_measurement_removes_an_error_that_joints_cannot_show():
    """x, y, gamma of the estimated state are the integrated target ([T] IV.C.1): their error never shows, nor goes.

    Coarse sampling with rates of the period's beginning makes such an error.
    """
    coarse = {"paths": [GAMMA], "period_s": 0.02, "rates_at": "start", "duration_s": 8.0, "rate_hz": 50}
    measured = run(**coarse, state="measured").summary["final_position_error_m"]
    estimated = run(**coarse, state="estimated").summary["final_position_error_m"]
    assert measured < 1e-6 < 1e-4 < estimated


def test_the_target_waits_instead_of_breaking_a_limit():
    """Driven backward the robot jack-knifes; with the allocating policy the head stays where its target waits."""
    back = {"type": "ramp", "start_s": 0.1, "duration_s": 6.0, "displacement": [-0.6, 0, 0, 0, 0, 0]}
    kink = {"initial_joints_rad": [0, -0.8, 0, -1.1, 0, 1.9, 0.2, -0.1] + [0.0] * 4}
    summary = run(paths=[back], plant=kink, duration_s=10.0).summary
    assert summary["waiting_s"] > 1.0
    assert summary["joint_limit_violation_max_rad"] == 0.0
    assert summary["clamped_joint_ticks"] == 0
    assert summary["position_error_max_m"] < 1e-4
    assert summary["attitude_error_max_rad"] < 1e-4
    without = run(paths=[back], plant=kink, duration_s=10.0, limit_policy="none").summary
    assert without["joint_limit_violation_max_rad"] > 0.1


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_saturated_tail_stops_at_its_limit(side):
    """The last joint starts there, and driving backward would bend it on: it stays where it is."""
    limit = np.deg2rad(65.0)
    back = {"type": "ramp", "start_s": 0.1, "duration_s": 1.0, "displacement": [-0.2, 0, 0, 0, 0, 0]}
    bent = {"initial_joints_rad": [0, -0.8, 0, -1.1, 0, 1.9] + [0.0] * 5 + [side * limit]}
    saturated = run(1.0, paths=[back], plant=bent, limit_policy="saturate")
    assert saturated.summary["clamped_joint_ticks"] > 100
    assert np.abs(saturated["phi"][:, 11]).max() <= limit * (1.0 + 1e-12)
    free = run(1.0, paths=[back], plant=bent, limit_policy="none")
    assert (side * free["phi"][-1, 11]) > limit + 0.1


# Head stretched out to the left, base curled to the left: lifting its middle leaves the centre of mass outside.
CURLED = {"initial_joints_rad": [0.6, -0.2, 0.6, -0.2, 0.9, 0.4] + [1.1] * 6}
HELD = {"shape_points_rad": {"psi3": 0.4}, "null_gain": 0.0}


@pytest.mark.parametrize("request_mode", [3, 4])
def test_a_mode_that_would_tip_the_robot_is_refused(request_mode):
    """Modes 3 and 4 lift pairs 4 to 6 of the curled base; the robot keeps mode 1, says so, and does not tip."""
    record = run(plant=CURLED, commands=[{"at_s": 0.5, "mode": request_mode}], **HELD)
    (refusal,) = record.summary["refusals"]
    assert (refusal["time_s"], refusal["mode"], refusal["taken"]) == (0.5, request_mode, False)
    assert refusal["support_margin_m"] < -0.03
    assert set(record["mode"]) == {1}
    assert record.summary["modes_refused"] == 1
    assert not record.summary["tipping"]
    (warning,) = record.summary["warnings"]
    check_message(warning, str(request_mode), "0.500 s", f"{1e3 * refusal['support_margin_m']:.1f} mm")


@pytest.mark.parametrize("policy", ["cyclic", "predictive"])
def test_switching_passes_over_modes_that_would_tip(policy):
    commands = [{"at_s": 0.0, "mode": "switching"}]
    record = run(6.0, plant=CURLED, commands=commands, switching={"policy": policy}, **HELD)
    refused = {refusal["mode"] for refusal in record.summary["refusals"]}
    assert {3, 4} <= refused
    assert refused.isdisjoint(record["mode"])
    assert not record.summary["tipping"]
    assert record.summary["modes_refused"] == len(record.summary["refusals"])


def test_a_mode_whose_prediction_diverges_is_refused():
    """The null space, with an absurd gain, comes on within the predicted period but after the end of the run."""
    record = run(
        0.2,
        commands=[{"at_s": 0.1, "mode": "switching"}],
        switching={"policy": "predictive", "order": [2]},
        null_gain=1e300,
        null_start_s=1.0,
        limit_policy="none",
    )
    assert record.summary["refusals"] == [{"time_s": 0.1, "mode": 2, "support_margin_m": None, "taken": False}]
    check_message(record.summary["warnings"][0], "2", "0.100 s", phrase="diverges")
    assert set(record["mode"]) == {1}


def test_the_return_to_the_fixing_mode_is_tested_too():
    """The robot starts in a fixing mode that tips, leaves it by request, and is not let back."""
    commands = [{"at_s": 0.2, "mode": 1}, {"at_s": 0.6, "mode": "fixing"}]
    record = run(1.0, plant=CURLED, commands=commands, fixing_mode=4, **HELD)
    assert record["mode"][np.searchsorted(record.time, [0.1, 0.4, 0.9])].tolist() == [4, 1, 1]
    assert [(r["time_s"], r["mode"]) for r in record.summary["refusals"]] == [(0.6, 4)]
    assert record.summary["tipping"]  # at the start


def test_least_margin_refuses_what_would_only_just_stand():
    commands = [{"at_s": 0.2, "mode": 5}, {"at_s": 0.4, "mode": 6}]  # margins of 14.7 and 66 mm
    for least, modes in ((0.0, {1, 5, 6}), (0.02, {1, 6}), (0.08, {1})):
        record = run(0.6, plant=CURLED, commands=commands, switching={"least_margin_m": least}, **HELD)
        assert set(record["mode"]) == modes


class Operator:
    """Live: drives ahead until the head has moved 40 mm, then to the left while the base lags, then switches modes.

    Every decision is taken on what the feedback shows; what was commanded is kept.
    """

    def __init__(self, periods=1):
        self.periods, self.reads, self.said = periods, 0, []

    def read(self, first, count, period, feedback):
        self.start = feedback.w if first == 0 else self.start
        assert feedback.time == pytest.approx(first * period)
        velocity, request, closed = np.zeros(6), NO_REQUEST, 0
        if feedback.w[0] < self.start[0] + 0.04:
            velocity[0] = 0.1
        elif feedback.w[1] < 0.03:
            velocity[1], closed = 0.04, 1
        elif feedback.mode == 1 and abs(feedback.phi[6]) > 0.05:
            request, closed = SWITCHING, 1
        known = min(self.periods, count)
        block = CommandBlock(np.tile(velocity, (known, 1)), np.zeros(known, dtype=int), np.full(known, closed))
        block.request[0] = request
        self.reads += 1
        self.said.append((first, velocity, request, closed))
        return block

    def script(self, period):
        """The equivalent script: what was said, as if it had been known beforehand."""
        mode = {SWITCHING: {"mode": "switching"}, NO_REQUEST: {}}
        return [
            {"at_s": first * period, "velocity": velocity.tolist(), "gripper": ("open", "closed")[closed]}
            | mode[request]
            for first, velocity, request, closed in self.said
        ]


@pytest.mark.parametrize("periods", [1, 7])
def test_a_live_source_gives_what_its_script_gives(periods):
    """Asked period by period, or in small blocks, and reacting to the robot; the script is written down afterwards."""
    operator = Operator(periods)
    live = kinematic.simulate(scenario(5.0, switching={"period_s": 0.5}), source=operator)
    assert operator.reads == -(-1000 // periods)
    # each coordinate stops when a read shows that it is there: a block late, and the head error
    assert live["w"][-1, :2] - live["w"][0, :2] == pytest.approx([0.04, 0.03], abs=0.1 * 0.005 * periods + 1e-6)
    assert {1, 2, 3} <= set(live["mode"])
    script = run(5.0, switching={"period_s": 0.5}, commands=operator.script(0.005))
    for name in live.signals:
        np.testing.assert_array_equal(live[name], script[name], err_msg=name)


def test_a_live_source_sees_that_its_target_waits_and_what_it_said_then_is_lost():
    """A script's path waits with its target; a joystick says anew what it wants."""

    class Backward:
        waited = 0

        def read(self, first, count, period, feedback):
            self.waited += feedback.waiting
            speed = 0.1 if feedback.waiting else -0.1
            return CommandBlock(np.array([[speed, 0, 0, 0, 0, 0]]), [NO_REQUEST], [0])

    kink = {"initial_joints_rad": [0, -0.8, 0, -1.1, 0, 1.9, 0.2, -0.1] + [0.0] * 4}
    source = Backward()
    record = kinematic.simulate(scenario(8.0, plant=kink), source=source)
    # the last period is not reported any more
    assert source.waited == pytest.approx(record.summary["waiting_s"] / 0.005, abs=1)
    assert source.waited > 10


@pytest.mark.parametrize(
    ("block", "names"),
    [
        (CommandBlock(np.zeros((0, 6)), [], []), ["velocity (0, 6)", "(T, 6)", "1", "400"]),
        (CommandBlock(np.zeros((401, 6)), [0] * 401, [0] * 401), ["velocity (401, 6)", "(T, 6)", "1", "400"]),
        (CommandBlock(np.zeros((1, 3)), [0], [0]), ["velocity (1, 3)", "(T, 6)"]),
        (CommandBlock(np.zeros((1, 6)), [9], [0]), ["controller.commands", "9", "1, 2, 3, 4, 5, 6"]),
    ],
)
def test_commands_that_make_no_sense_are_refused(block, names):
    class Source:
        def read(self, first, count, period, feedback):
            return block

    with raises(ModelError, *names):
        kinematic.simulate(scenario(), source=Source())


def test_attitude_distance_is_the_angle_of_the_relative_rotation():
    random = np.random.default_rng(0)
    w, v = random.uniform(-1, 1, (2, 50, 6))
    relative = np.einsum("tij,tik->tjk", attitude(w), attitude(v))
    angle = np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1))
    np.testing.assert_allclose(attitude_distance(w, v), angle, atol=1e-12)
    tiny = w + 1e-9 * np.eye(6)[5]
    np.testing.assert_allclose(attitude_distance(w, tiny), 1e-9, rtol=1e-5)


def test_a_recording_rate_that_does_not_divide_the_control_rate_is_refused():
    with raises(ScenarioError, "record.rate_hz = 150", "200 Hz", "controller.period_s"):
        run(rate_hz=150)


@pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")
def test_every_kernel_has_one_compiled_signature():
    """A second one means an array of another layout or a literal slipped in: twice the compile time, silently."""
    run(duration_s=0.05)
    # Those that a run calls from Python: what only kernels call has none here when it comes from the cache.
    entry = [ticks.run_ticks, ticks.record_row, control.control_input]
    entry += [kinematics.pose_of_point, kinematics.walk_chain, kinematics.constraint_matrices]
    for kernel in entry:
        assert len(kernel.signatures) == 1, kernel


def test_kernels_run_as_plain_python():
    """NUMBA_DISABLE_JIT=1 gives the same numbers: debugging and coverage stay possible."""
    code = """
        import json
        from dynsim.engine import kinematic, simulate
        from dynsim.scenario import load_scenario
        short = {"duration_s": 0.05, "controller.cost": "eq20_min"}
        print(json.dumps(simulate(load_scenario("snake_joint_limits", None, short))["phi"][-1].tolist()))
    """
    interpreted = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    compiled = simulate(load_scenario("snake_joint_limits", None, {"duration_s": 0.05, "controller.cost": "eq20_min"}))
    np.testing.assert_allclose(json.loads(interpreted.stdout), compiled["phi"][-1], atol=1e-12)


FORWARD = {"type": "ramp", "start_s": 0.2, "duration_s": 1.0, "displacement": [0.1, 0, 0, 0, 0, 0]}


@pytest.mark.parametrize(
    "plant",
    [
        {"yaw_joints": 30},
        pytest.param({"yaw_joints": 60}, marks=pytest.mark.slow),
        {"link_length_m": 0.01, "wheel_radius_m": 0.005, "wheel_gap_m": 0.012},
    ],
)
def test_damping_is_measured_by_the_robot_and_does_not_stop_long_or_small_ones(plant):
    """The smallest singular value falls with the number and the length of the links: no singularity."""
    scale = plant.get("link_length_m", 0.09) / 0.09
    path = FORWARD | {"displacement": [0.1 * scale, 0, 0, 0, 0, 0]}
    record = run(2.0, plant=plant, paths=[path])
    assert record.summary["waiting_s"] == 0.0
    assert record.summary["displacement"][0] == pytest.approx(0.1 * scale, abs=1e-6)


def test_a_target_is_not_turned_over_the_singular_attitude():
    """At beta = -90 deg A loses rank ([T] eq 15 needs it): the target waits before it and the head stays on it."""
    plant = {"initial_joints_rad": [0, 0.2, 0, -1.0, 0, 1.9]}  # nose up by 63 deg
    path = {"type": "ramp", "start_s": 0.2, "duration_s": 2.0, "displacement": [0, 0, 0, 0, -0.65, 0]}
    for state in ("measured", "feedforward"):
        summary = run(3.0, plant=plant, paths=[path], state=state).summary
        assert list(summary["waiting_for_s"]) == ["attitude at beta = 90 deg"]
        assert summary["attitude_error_max_rad"] < 1e-6
        assert summary["joint_rate_max_rad_s"] < 1.0
        assert "attitude at beta = 90 deg" in summary["warnings"][0]


def test_feedback_and_shape_points_keep_the_rate_limit():
    """psi3 starts a radian from its target; at gain 20 it asks for more than 20 rad/s."""
    record = run(2.0, plant={"initial_joints_rad": [0, -0.3, 0, -0.6, 0, 0.9]}, gain=20.0)
    summary = record.summary
    # the recorded rates are those that were applied
    assert summary["joint_rate_max_rad_s"] <= 4.7 * (1.0 + 1e-12)
    assert summary["slowed_s"] > 0.0
    assert lines_with(summary["warnings"], phrase="slowed down")
    assert record["phi"][-1, 5] == pytest.approx(np.deg2rad(110.0), abs=1e-6)


def test_a_null_space_motion_that_is_too_fast_is_reduced_and_not_dropped():
    """With ten times the gain the cost ends lower, not higher; V still never rises within a mode."""
    final = {}
    for gain in (0.1, 1.0):
        limits = load_scenario("snake_joint_limits", "cyclic", overrides={"controller.null_gain": gain})
        record = simulate(limits)
        final[gain] = record.summary["cost_final"]
        assert record.summary["joint_rate_max_rad_s"] <= 4.7 * (1.0 + 1e-12)
        same = np.diff(record["mode"]) == 0
        # rounding, and the removal of head errors while a joint stands at its limit
        assert np.diff(record["cost"])[same].max() < 1e-6
    assert record.summary["null_space_reduced_s"] > 0.0
    assert final[1.0] < final[0.1]
