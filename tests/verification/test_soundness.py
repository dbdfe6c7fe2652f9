"""Unstable sampled loops and joints without inertia: found at the start, named at a stop."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from scipy.linalg import expm
from support.messages import check_message, lines_with, mentions, raises

from dynsim import Simulation, State, build_model, load_scenario, simulate
from dynsim.compile.mobility import moving_nothing, without_inertia
from dynsim.compile.model import Model
from dynsim.engine import check
from dynsim.engine.prepare import prepare
from dynsim.engine.soundness import loop_growth
from dynsim.errors import ModelError, SimulationStopped
from dynsim.model.description import Inertia, Link, Robot
from dynsim.scenario.reading import scenario_from_resolved

LINK = """
duration_s: 10
plant:
  type: serial_arm
  link: {length_m: 0.3, mass_kg: 0.5, motor: MOTOR}
  chain: [{count: 1}]
  gravity_m_s2: [0, 0, 0]
controller: {type: joint_pd, GAINSsample_time_s: 0.004}
metrics: {settle_s: 0}
"""
DC = "{type: wang_minami}"
SERVO = (
    "{type: servo, voltage_V: 1.0e+9, stall_torque_N_m: 8.0e+8, no_load_speed_rad_per_s: 5.0e+8, "
    "k_p_V_per_rad: 1000, k_d_V_s_per_rad: 10}"
)


def growth_of(scenario, period):
    prepared = prepare(scenario)
    return loop_growth(scenario, prepared, prepared.model.robot.initial, period)


@pytest.fixture
def link(tmp_path):
    def of(motor=DC, **changes):
        path = tmp_path / "link.yaml"
        # The gains of a servo are part of its motor.
        gains = "k_p_V_per_rad: 1000, k_d_V_s_per_rad: 30, " if motor == DC else ""
        path.write_text(LINK.replace("MOTOR", motor).replace("GAINS", gains))
        return load_scenario(path, None, {key.replace("__", "."): value for key, value in changes.items()})

    return of


@pytest.mark.parametrize("motor", [DC, SERVO], ids=["dc", "servo"])
@pytest.mark.parametrize(
    "encoders",
    [
        None,
        {"resolution_deg": 0},
        {"resolution_deg": 0, "delay_s": 0.008},
        {"resolution_deg": 0, "rate_hz": 125},
        {"resolution_deg": 0, "rate_hz": 1000, "delay_s": 0.0025},
    ],
    ids=["joints", "encoders", "late", "slow", "fast"],
)
def test_deviations_of_a_run_grow_by_the_spectral_radius(link, motor, encoders):
    """One link without gravity is linear: the logarithm of its state has the slope of the growth."""
    period = 0.004
    changes = {} if encoders is None else {"sensors__encoders": encoders}
    scenario = link(motor, record__rate_hz=125, **changes)
    expected = growth_of(scenario, period)
    assert expected.unstable
    count = int(min(300, 30.0 / (expected.rate * 0.008)))
    simulation = Simulation(scenario, state=State(0.0, np.zeros(1), np.full(1, 1e-6), np.zeros(1)))
    simulation.advance(count * 0.008)
    record = simulation.record()
    size = np.log(np.hypot(30.0 * record["q"][:, 0], record["v"][:, 0]))[count // 4 :]
    slope = np.polyfit(record.time[count // 4 :], size, 1)[0]
    # Complex eigenvalues sway about the slope by a factor of a few over the whole of e^20 or more.
    assert slope == pytest.approx(expected.rate, rel=0.05)


def test_loops_with_very_many_samples_under_way_are_not_examined(link):
    """At a shorter period a delay holds more of them; the search for one that is stable took minutes."""
    scenario = link(sensors__encoders={"resolution_deg": 0, "delay_s": 0.02})
    assert growth_of(scenario, 1e-3) is not None
    assert growth_of(scenario, 2e-5) is None


def test_the_radius_of_the_published_arm_agrees_with_its_linearization():
    """Free arm, from the state matrices of the kernels, which have gravity too: three digits."""
    scenario = load_scenario("elbow_comparison", "no_elbow")
    linear = Simulation(scenario).linearize(inputs=["command"], outputs=[])
    n = 10
    gains = np.hstack([-500.0 * np.eye(n), -20.0 * np.eye(n), np.zeros((n, n))])
    alone = linear.A - linear.B @ gains
    for period, known in ((5e-4, 0.9993), (1e-3, 1.161), (2e-3, 1.961), (5e-3, 9.99)):
        both = expm(np.block([[alone, linear.B], [np.zeros((n, 4 * n))]]) * period)
        held, commanded = np.split(both[: len(alone)], [len(alone)], axis=1)
        radius = np.abs(np.linalg.eigvals(held + commanded @ gains)).max()
        sampled = load_scenario("elbow_comparison", "no_elbow", {"controller.sample_time_s": period})
        own = growth_of(sampled, period).radius
        assert own == pytest.approx(radius, rel=2e-3)
        assert own == pytest.approx(known, rel=2e-3)


@pytest.mark.parametrize(("name", "variant", "period", "stable"), [
    ("elbow_comparison", "two_elbows", 0.0005, True),
    ("elbow_comparison", "two_elbows", 0.0006, False),
    ("six_axis_arm", None, 0.003, True),
    ("six_axis_arm", None, 0.004, False),
    ("mobile_path", None, 0.0005, True),
    ("mobile_path", None, 0.0008, False),
])  # fmt: skip
def test_check_warns_of_an_unstable_loop_alone(name, variant, period, stable):
    """Each was run for a second: the stable ones track, the others grow to 60 to 800 rad/s or a limit cycle."""
    scenario = load_scenario(name, variant, {"controller.sample_time_s": period})
    warnings = lines_with(check(scenario).warnings, phrase="unstable")
    assert len(warnings) == (0 if stable else 1)
    for text in warnings:
        check_message(text, f"controller.sample_time_s = {period:g} s", "k_p")
        assert any(0.0 < float(number) < period for number in re.findall(r"\d\.\d+", text))


def test_the_shown_encoders_are_stable_with_the_shown_gains():
    """The example in docs/scenarios/control.md, on the published arm; with its default gains it is not."""
    shown = {"controller.sample_time_s": 0.001, "sensors.encoders.delay_s": 0.002}
    gains = {"controller.k_p_V_per_rad": 100, "controller.k_d_V_s_per_rad": 2}
    assert not growth_of(load_scenario("elbow_comparison", "two_elbows", shown | gains), 0.001).unstable
    assert growth_of(load_scenario("elbow_comparison", "two_elbows", shown), 0.001).unstable


def test_a_run_and_a_stop_name_the_unstable_loop():
    """It read: no signs of the normal forces agree, or no step forward; the arm sways by its own commands."""
    settings = {"controller.sample_time_s": 0.1, "duration_s": 1.0}
    with raises(SimulationStopped, "controller.sample_time_s = 0.1 s", "k_p = 500 V/rad", phrase="unstable") as raised:
        simulate(load_scenario("elbow_comparison", "two_elbows", settings))
    assert not mentions(raised.value, "Painlevé")
    assert lines_with(raised.value.record.summary["warnings"], phrase="unstable")


FOLDED = """
duration_s: 1.0
plant:
  type: serial_arm
  link: {length_m: 0.3, mass_kg: 0.5, motor: {type: wang_minami}}
  chain: [{count: 1}, {count: 1, initial_deg: 170}]
  gravity_m_s2: [0, 0, 0]
controller:
  type: joint_pd
  k_p_V_per_rad: 200
  k_d_V_s_per_rad: 5
  sample_time_s: 0.006
  joints: {joint_2: {times_s: [0, 0.5], angles_deg: [170, END]}}
metrics: {settle_s: 0}
"""


@pytest.mark.parametrize(("end", "unstable"), [("160", False), ("0", True)])
def test_a_run_warns_of_a_loop_that_is_unstable_in_a_later_posture_only(end, unstable, tmp_path):
    """Straight, the arm sways by up to 49 J, and the run ends in a posture in which the loop is stable again."""
    path = tmp_path / "folded.yaml"
    path.write_text(FOLDED.replace("END", end))
    scenario = load_scenario(path)
    assert not lines_with(check(scenario).warnings, phrase="unstable")
    warnings = lines_with(simulate(scenario).summary["warnings"], phrase="unstable")
    assert [mentions(text, re.compile(r"\bt = 0\.\d")) for text in warnings] == [True] * unstable


def test_a_session_logs_the_unstable_loop_when_it_starts(caplog):
    scenario = load_scenario("elbow_comparison", "two_elbows", {"controller.sample_time_s": 0.001})
    Simulation(scenario)
    assert lines_with(caplog.messages, phrase="unstable")


def wrist(**changes) -> Robot:
    """A link and a wrist about its own axis y, whose mass lies on that axis."""
    mass = Inertia(0.08, np.zeros(3), np.zeros((3, 3)))
    arm = Link("arm", "shoulder", None, "revolute", np.array([0.0, 1.0, 0.0]), Inertia(1.0, np.array([0.0, 0.0, 0.1])))
    tip = {"inertia": mass, "p_PJ": np.array([0.0, 0.0, 0.2])} | changes
    return Robot(
        "wrist",
        (arm, Link("wrist", "wrist_joint", "arm", "revolute", np.array([0.0, 1.0, 0.0]), **tip)),
        (),
        ("wrist", np.zeros(3)),
    )


@pytest.mark.parametrize("shift", [0.0, 30.0])
def test_a_joint_that_moves_no_inertia_is_named(shift):
    """Near the world's origin and far from it, where the sweep has rounding."""
    at_origin = wrist()
    first = at_origin.links[0]
    robot = Robot(
        "wrist",
        (
            Link("arm", "shoulder", None, "revolute", first.axis, first.inertia, p_PJ=np.array([shift, 0.0, 0.0])),
            at_origin.links[1],
        ),
        (),
        at_origin.hand,
    )
    for angles in ([0.0, 0.0], [0.7, -1.1]):
        assert without_inertia(Model(robot), np.array(angles)) == [(1, [1])]
    text = moving_nothing(Model(robot), np.zeros(2))
    check_message(text, "wrist_joint", "wrist")


@pytest.mark.parametrize("changes", [
    {"armature": 1e-6},
    {"inertia": Inertia(0.08, np.array([0.001, 0.0, 0.0]))},
    {"inertia": Inertia(0.08, np.zeros(3), 1e-8 * np.eye(3))},
])  # fmt: skip
def test_little_inertia_is_enough(changes):
    model = Model(wrist(**changes))
    assert without_inertia(model, np.zeros(2)) == []
    expected = {
        "armature": 1e-6,
        "inertia": 8e-8 if "inertia" in changes and not changes["inertia"].tensor.any() else 1e-8,
    }
    assert model.articulated_inertia(np.zeros(2))[1] == pytest.approx(expected[next(iter(changes))], rel=1e-6)


def test_pivots_agree_with_the_mass_matrix():
    model = Model(prepare(load_scenario("six_axis_arm")).model.robot)
    q = np.random.default_rng(0).normal(size=model.n)
    M = model.mass_matrix(q) + np.diag(model.armature)
    # M = L D Lᵀ from the tip on.
    pivots = np.diag(np.linalg.cholesky(M[::-1, ::-1])) ** 2
    np.testing.assert_allclose(model.articulated_inertia(q), pivots[::-1], rtol=1e-10)


def test_check_refuses_a_joint_without_inertia(tmp_path):
    (tmp_path / "arm.urdf").write_text(
        '<robot name="arm"><link name="base"/>'
        '<link name="arm"><inertial><origin xyz="0 0 0.1"/><mass value="1"/>'
        '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.001"/></inertial></link>'
        '<link name="wrist"><inertial><mass value="0.08"/>'
        '<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial></link>'
        '<joint name="shoulder" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint>'
        '<joint name="wrist_joint" type="continuous"><origin xyz="0 0 0.2"/><parent link="arm"/>'
        '<child link="wrist"/><axis xyz="0 1 0"/></joint></robot>'
    )
    (tmp_path / "arm.yaml").write_text("duration_s: 0.5\nplant: {type: urdf_arm, file: arm.urdf}\n")
    for start in (check, simulate):
        with raises(ModelError, "arm.yaml:2", "plant", "wrist_joint", "wrist"):
            start(load_scenario(tmp_path / "arm.yaml"))


def test_rates_are_logarithms_of_radii():
    scenario = load_scenario("elbow_comparison", "no_elbow", {"controller.sample_time_s": 1e-3})
    growth = growth_of(scenario, 1e-3)
    assert growth.rate == pytest.approx(math.log(growth.radius) / 1e-3)


def test_bodies_that_have_run_away_are_not_said_to_have_no_inertia():
    """At 1e9 m the sweep's rounding exceeds the inertia of a box about its centre, of which nothing is known then."""
    scenario = scenario_from_resolved(
        {
            "name": "far",
            "duration_s": 1.0,
            "plant": {"type": "serial_arm", "chain": [{"axis": "y", "mass_kg": 1.0, "length_m": 0.1}]},
            "contacts": {"law": "unilateral"},
            "objects": {"box": {"mass_kg": 0.5, "size_m": [0.1, 0.2, 0.05], "position_m": [0.0, 0.0, 1.0]}},
        }
    )
    model = build_model(scenario)
    q = model.robot.initial.copy()
    assert moving_nothing(model, q) == ""
    for distance in (1e3, 1e6, 1e9, 1e12):
        q[1:4] = distance
        assert moving_nothing(model, q) == ""
