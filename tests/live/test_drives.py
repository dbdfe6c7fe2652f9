"""Live drives: replay of a drive from its script bit for bit, references from velocities, limits of reach, refusals."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from support.messages import mentions, raises

import dynsim
from dynsim import Record, Scenario, load_scenario, simulate
from dynsim.errors import DynsimError, ScenarioError
from dynsim.hardware.replay.check import check_motion
from dynsim.hardware.servo_map import load_servo_map
from dynsim.record.poses import ORIENTATION, POSITION, poses_at
from dynsim.scenario import scenario_from_resolved
from dynsim.snake.description import FIXING, SWITCHING
from dynsim.teleop.snake import Command, begin

pytestmark = pytest.mark.long


def assert_same(a: Record, b: Record) -> None:
    assert list(a) == list(b)
    for name in a:
        assert np.array_equal(a[name], b[name], equal_nan=True), name
    assert a.events == b.events
    assert a.complete == b.complete


def replayed(record: Record) -> Record:
    return simulate(scenario_from_resolved(record.provenance["scenario"]))


def driven_at_random(scenario: Scenario, ticks: int, size: float, requests: dict[int, int] | None = None) -> Record:
    """A drive with new velocities every eighth tick, all of them zero now and then."""
    session, random = begin(scenario), np.random.default_rng(1)
    velocity = (0.0,) * len(session.axes)
    for k in range(ticks):
        if k % 8 == 3:
            velocity = tuple((size * random.uniform(-1.0, 1.0, len(session.axes)) * (k % 32 != 27)).tolist())
        session.tick(Command(velocity, (requests or {}).get(k, 0), closed=20 < k < 50))
    return session.record()


ARMS = [
    ("elbow_comparison", "two_elbows"),
    ("elbow_comparison_floor", "two_elbows"),
    ("six_axis_arm", None),
    ("mobile_path", None),
]


@pytest.mark.parametrize(("name", "variant"), ARMS)
def test_drive_of_an_arm_is_replayed_bit_for_bit(name: str, variant: str | None) -> None:
    record = driven_at_random(load_scenario(name, variant), 60, 0.1)
    assert record.provenance["scenario"]["controller"]["operator"]["commands"]
    assert record.time[-1] == pytest.approx(0.6)
    assert np.ptp(record["hand_position"], axis=0).max() > 1e-3
    assert_same(record, replayed(record))


@pytest.mark.parametrize("ticks", [69, 70, 71])
def test_a_drive_may_end_at_any_tick(ticks: int) -> None:
    """Also where ticks times their period are a rounding beside ticks divided by their rate: 70 * 0.01 > 70 / 100."""
    record = driven_at_random(load_scenario("six_axis_arm"), ticks, 0.1)
    assert_same(record, replayed(record))


def test_a_drive_that_ends_between_samples_has_one_at_its_end() -> None:
    """At 30 Hz, after 37 ticks of 10 ms; what comes after a look at the record has none there."""
    session = begin(load_scenario("six_axis_arm", overrides={"record.rate_hz": 30}))
    records = []
    for ticks in (37, 8):
        for _ in range(ticks):
            session.tick(Command((0.05, -0.03, 0.02)))
        records.append(session.record())
    for record, end in zip(records, (0.37, 0.45), strict=True):
        assert record.time[-1] == record.summary["duration_s"] == pytest.approx(end, rel=1e-12)
        assert len(record) == math.floor(30.0 * end) + 2
        assert_same(record, replayed(record))


@pytest.mark.parametrize(
    ("name", "variant", "size"), [("snake_operator", None, 0.6), ("snake_circle", "backward_switching", 0.6)]
)
def test_drive_of_a_snake_is_replayed_bit_for_bit(name: str, variant: str | None, size: float) -> None:
    """Also where the target waits, which a script would wait for too, and with modes."""
    requests = {40: SWITCHING, 600: FIXING, 700: 3}
    record = driven_at_random(load_scenario(name, variant), 900, size, requests)
    assert record.summary["mode_switches"] > 2
    assert record.summary["waiting_s"] > 0.0
    assert record["gripper"].max() == 1
    assert_same(record, replayed(record))


def test_contacts_of_a_frame_are_those_of_the_record() -> None:
    session = begin(load_scenario("elbow_comparison_floor", "two_elbows"))
    for _ in range(40):
        session.tick(Command((0.05, 0.0, 0.0)))
    frame, record = session.frame(), session.record()
    assert list(frame.touching) == list(record.labels["contact_normal_force"])
    # At one of the last samples before that instant: steps are longer than the time between samples.
    forces, vectors = record["contact_normal_force"], record["contact_force"]
    (k,) = np.flatnonzero(forces[:, 1] == frame.touching["elbow_7"].force)
    assert frame.time - 0.05 < record.time[k] <= frame.time
    for c, touch in enumerate(frame.touching.values()):
        assert touch.force == forces[k, c]
        assert np.array_equal(touch.vector, vectors[k, c])
        assert touch.mode == record["contact_mode"][k, c]
    assert any(touch.force > 0.0 for touch in frame.touching.values())


def test_hand_goes_as_fast_as_it_is_asked_to() -> None:
    """The target exactly, the hand as well as the controller follows it."""
    session = begin(load_scenario("six_axis_arm"))
    start = session.frame().hand.copy()
    velocity, still = np.array([0.05, -0.03, 0.02]), (0.0, 0.0, 0.0)
    for k in range(100):
        session.tick(Command(tuple(velocity.tolist()) if k < 50 else still))
    # What it loses while it speeds up it makes up for while it slows down; sums of ticks, so to rounding.
    distance = 0.5 * velocity
    assert session.frame().hand - start == pytest.approx(distance, abs=1e-3 * 0.025)
    record = session.record()
    assert record["target_position"][-1] == pytest.approx(session.frame().hand, abs=1e-12)
    speed = np.linalg.norm(np.diff(record["target_position"], axis=0), axis=1) / np.diff(record.time)
    assert speed.max() == pytest.approx(np.linalg.norm(velocity))
    # By ticks of 10 ms, seen in samples of 5 ms.
    assert np.abs(speed[2:] - speed[:-2]).max() == pytest.approx(0.5 * 0.01, rel=1e-6)
    assert record.summary["hand_error_max_m"] < 2e-3


def test_base_goes_along_its_arc() -> None:
    """V = 0.2 m/s and ω = 0.4 rad/s for 1 s: an arc of radius 0.5 m; the hand is carried along."""
    session = begin(load_scenario("mobile_path"))
    names = [axis.name for axis in session.axes]
    command = Command(tuple({"ahead": 0.2, "turn": 0.4}.get(name, 0.0) for name in names))
    still = Command((0.0,) * len(names))
    for k in range(200):
        session.tick(command if k < 100 else still)
    record = session.record()
    x, y, heading = record["base_pose"][-1]
    # A little different where it speeds up and slows down: there the radius is another one.
    assert (x, y, heading) == pytest.approx((0.5 * math.sin(0.4), 0.5 * (1.0 - math.cos(0.4)), 0.4), abs=8e-3)
    assert record["tip_margin"].min() > 0.2
    arm = record["q"][:, [k for k, name in enumerate(record.labels["q"]) if name.startswith("joint")]]
    assert np.abs(arm[-1] - arm[0]).max() < 5e-3


def test_hand_waits_where_it_cannot_go() -> None:
    """Pulled straight up for ten times the arm's length: it stops at its reach, and comes back when asked to."""
    session = begin(load_scenario("six_axis_arm"))
    for _ in range(1000):
        session.tick(Command((0.0, 0.0, 0.5)))
    top = session.frame().hand.copy()
    assert mentions(session.frame().hindrance, "elbow_pitch")
    assert top[2] < 3.0
    rates = np.abs(session.record()["v"])
    assert rates.max() < 2.5
    for _ in range(20):
        session.tick(Command((0.0, 0.0, -0.05)))
    assert session.frame().hand[2] < top[2] - 0.005


HALF = math.sqrt(0.5)
WAYS = [
    (0, 0, 1),
    (1, 0, 0),
    (0, 1, 0),
    (0, 0, -1),
    (-1, 0, 0),
    (0, -1, 0),
    (HALF, HALF, 0),
    (0, HALF, HALF),
    (-HALF, 0, HALF),
]


@pytest.mark.parametrize("direction", WAYS)
def test_hand_eases_to_rest_at_its_edge(direction: tuple[float, float, float]) -> None:
    """At 0.1 m/s for 3 s: its target speeds up and slows down at 0.5 m/s² at most, and servos may follow the drive."""
    session = begin(load_scenario("elbow_comparison", "two_elbows"))
    operator = session.simulation.operator
    targets, hindered = [operator.target.copy()], set()
    for _ in range(300):
        session.tick(Command(tuple(0.1 * part for part in direction)))
        targets.append(operator.target.copy())
        hindered.add(session.frame().hindrance)
    velocity = np.diff(np.array([targets[0], *targets]), axis=0) / session.period
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=1) / session.period
    assert acceleration.max() == pytest.approx(0.5, rel=1e-6)
    speed = np.linalg.norm(velocity, axis=1)
    if hindered == {""}:
        assert speed[-1] == pytest.approx(0.1)
    else:
        # It comes to rest once, and rests.
        rests = int(np.flatnonzero(speed[20:] == 0.0)[0]) + 20
        assert not speed[rests:].any()
        assert np.diff(speed[rests - 15 : rests]).max() < 1e-9
    check_motion(session.record(), load_servo_map("arm"))


@pytest.mark.parametrize("directions", [6, pytest.param(20, marks=pytest.mark.long)])
def test_a_hand_at_its_edge_comes_back(directions: int) -> None:
    """For a second in one of some directions at random, to the edge and along it, then back to where it began."""
    session = begin(load_scenario("elbow_comparison", "two_elbows"))
    operator, random = session.simulation.operator, np.random.default_rng(3)
    targets, hindered = [operator.target.copy()], 0

    def goes(direction: np.ndarray[Any, Any]) -> None:
        session.tick(Command(tuple(direction.tolist())))
        targets.append(operator.target.copy())

    for _ in range(directions):
        direction = random.normal(size=3)
        for _ in range(100):
            goes(0.2 * direction / np.linalg.norm(direction))
        hindered += bool(session.frame().hindrance)
        before = np.linalg.norm(targets[0] - targets[-1])
        for _ in range(150):
            left = targets[0] - targets[-1]
            goes(0.2 * left / max(float(np.linalg.norm(left)), 0.1))
        assert np.linalg.norm(targets[0] - targets[-1]) < max(0.5 * before, 0.02)
    assert hindered >= directions // 5
    acceleration = np.diff(np.array(targets), n=2, axis=0) / session.period**2
    assert np.linalg.norm(acceleration, axis=1).max() < 0.5 + 1e-6


def test_stepper_follows_the_script_and_goes_back() -> None:
    commands = [{"at_s": 0.1, "hand": [0.05, 0.0, 0.0]}, {"at_s": 0.3, "hand": [0.0, 0.0, 0.05]}]
    operator = {"joints": ["base_yaw", "shoulder_pitch", "elbow_pitch"], "commands": commands}
    resolved: dict[str, Any] = load_scenario("six_axis_arm").resolved
    del resolved["controller"]["hand"]
    resolved["controller"]["operator"] = operator
    resolved["duration_s"] = 0.5
    scenario = scenario_from_resolved(resolved)
    simulation = dynsim.Simulation(scenario)
    simulation.advance(0.2)
    before = simulation.snapshot()
    first = simulation.advance(0.5).q
    simulation.restore(before)
    assert np.array_equal(simulation.advance(0.5).q, first)
    assert simulate(scenario)["q"][-1] == pytest.approx(first, abs=1e-9)


@pytest.mark.parametrize(
    ("name", "change", "names"),
    [
        ("single_pendulum", {}, ["single_pendulum.yaml"]),
        (
            "elbow_comparison",
            {"controller.operator": {"joints": ["joint_9"]}},
            ["elbow_comparison.yaml:27: controller.hand"],
        ),
        (
            "six_axis_arm",
            {"controller.hand": None, "controller.operator": {"joints": ["knee"]}},
            ["controller.operator.joints", "'knee'", "base_yaw"],
        ),
        (
            "six_axis_arm",
            {"controller.hand": None, "controller.operator": {"commands": [{"at_s": 0, "base": [1, 0]}]}},
            ["controller.operator", "pws_arm"],
        ),
        (
            "six_axis_arm",
            {"controller.hand": None, "controller.operator": {"commands": [{"at_s": 1}, {"at_s": 0}]}},
            ["controller.operator", "at_s"],
        ),
    ],
)
def test_what_cannot_be_driven_is_refused(name: str, change: dict[str, Any], names: list[str]) -> None:
    with raises(DynsimError, *names):
        scenario = load_scenario(name, None, change)
        if "commands" in change.get("controller.operator", {}):
            simulate(scenario)
        begin(scenario)


def test_an_operator_needs_something_to_move() -> None:
    with raises(ScenarioError, "controller.operator"):
        dynsim.Simulation(load_scenario("six_axis_arm"), operator=object())  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["snake_operator", "mobile_path", "six_axis_arm"])
def test_poses_of_an_instant_are_those_of_the_record(name: str) -> None:
    record = simulate(load_scenario(name, None, {"duration_s": 0.5}))
    assert record.scene is not None
    signals = {body.joint.signal for body in record.scene.bodies}
    for k in (0, -1):
        here = {s: dict(zip(record.labels[s], record[s][k].tolist(), strict=True)) for s in signals if s}
        poses = poses_at(record.scene, here)
        assert poses[:, :3] == pytest.approx(record[POSITION][k], abs=1e-6)
        turn = np.abs((poses[:, 3:] * record[ORIENTATION][k]).sum(axis=1))
        assert turn == pytest.approx(np.ones(len(poses)), abs=1e-6)
