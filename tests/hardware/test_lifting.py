"""Lifting of wheel pairs when a record of the snake is replayed on servos: poses in Pinocchio, settings, refusals.

The kinematic model is flat, so the check of a replay adds pitch angles that lift the pairs which the record has off the
ground. The oracle is a Pinocchio model of all 18 joints. It gets the recorded pose of the head and the angles that the
servos are sent, but no positions of the wheeled part: if pair 1, the first behind the head, lies on the floor at its
recorded place, the head is where the record has it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from studies.lifted_wheels import (
    BLEND,
    CLEARANCE,
    JOINTS,
    LINK,
    PITCH,
    Oracle,
    Posed,
    best_deviation,
    posed,
    second_order,
    settled,
    snake_map,
    with_lifts,
)
from support.messages import raises

from dynsim.errors import CheckRefused, RecordError
from dynsim.hardware.errors import ServoMapError
from dynsim.hardware.ports import bus_on
from dynsim.hardware.replay.check import check_motion
from dynsim.hardware.replay.compare import compare_records
from dynsim.hardware.replay.machine import Replay
from dynsim.hardware.replay.trajectory import path_of_record
from dynsim.hardware.servo_map import SHIPPED, load_servo_map
from dynsim.record import Record
from dynsim.snake.lifting import Fold, Lifts, base_part, lifted

pytestmark = pytest.mark.long

MODES = {1: (3, 6), 2: (6, 7), 3: (5, 6), 4: (4, 5), 5: (3, 4), 6: (2, 3)}  # [T] Table II
PASSING = [("snake_operator", None), ("snake_positioning", "x"), ("snake_positioning", "y"), ("snake_door_arc", "push")]


Find = Callable[[str, "str | None"], Posed]


@pytest.fixture(scope="module")
def posed_run(simulated: Callable[[str, str | None], Record]) -> Find:
    """Record of a scenario and variant, as the shipped map has it replayed."""
    return cache(lambda scenario, variant: posed(simulated(scenario, variant), snake_map()))


@pytest.fixture(scope="module")
def operator(posed_run: Find) -> Posed:
    return posed_run("snake_operator", None)


@pytest.mark.parametrize(("scenario", "variant"), PASSING)
def test_lifted_wheels_clear_the_floor_and_grounded_pairs_touch_it(posed_run, scenario, variant) -> None:
    """At every sample of the records, blends and all; both wheels of what is lifted, the lower one of the others."""
    poses = posed_run(scenario, variant)
    record, up = poses.record, settled(poses.record)
    assert (record["grounded"] == 0).any()
    assert up.sum() > 0.9 * (record["grounded"] == 0).sum()
    np.testing.assert_allclose(poses.lower[up], CLEARANCE, atol=1e-8)
    assert poses.wheel[up].min() > CLEARANCE - 1e-8
    # Far within the 0.1 mm: nothing is left but rounding, and nothing is pushed into the floor, in no blend either.
    np.testing.assert_allclose(poses.lower[poses.grounded], 0.0, atol=1e-8)
    assert poses.wheel.min() > -1e-8


def test_the_operator_lifts_in_all_samples_and_every_mode(operator) -> None:
    assert (operator.grounded.sum(axis=1) == 5).all()
    lifted_pairs = {tuple(np.flatnonzero(~row) + 1) for row in operator.grounded}
    assert lifted_pairs == set(MODES.values())


@pytest.mark.parametrize(("scenario", "variant"), PASSING)
def test_the_head_stays_where_the_record_has_it(posed_run, scenario, variant) -> None:
    """From the recorded head down the chain pair 1 is met at its recorded place, flat on the floor."""
    poses = posed_run(scenario, variant)
    base = poses.record["base_pose"]
    np.testing.assert_allclose(poses.middle[:, 0, :2], base[:, :2], atol=1e-8)
    np.testing.assert_allclose(poses.wheel[:, 0], 0.0, atol=1e-8)
    left = np.column_stack([-np.sin(base[:, 2]), np.cos(base[:, 2])])
    np.testing.assert_allclose(poses.axle[:, 0, :2], left, atol=1e-8)


def test_no_wheel_is_pushed_into_the_floor_between_two_samples(operator) -> None:
    """The path between samples: yaw angles straight, pitch angles cubic. A few micrometres, in the blends too."""
    oracle, servo_map, record = Oracle(), snake_map(), operator.record
    path = path_of_record(record, servo_map)
    columns = [servo_map.joints.index(name) for name in JOINTS]
    psi_3 = record["phi"][:, record.labels["phi"].index("psi3")]
    blending = ~(operator.grounded | settled(record)).all(axis=1)
    rows = np.flatnonzero(blending[:-1])
    assert len(rows) > 7 * 2 * 50
    for row in [*rows, *range(0, len(record) - 1, 100)]:
        for part in (0.25, 0.5, 0.75):
            time = (1 - part) * record.time[row] + part * record.time[row + 1]
            angle = (1 - part) * psi_3[row] + part * psi_3[row + 1]
            wheel = oracle.from_pair_1(angle, path.at(time)[0][columns])[2]
            assert wheel.min() > -5e-6
            still = operator.grounded[row] & operator.grounded[row + 1]
            np.testing.assert_allclose(wheel[still].min(axis=1), 0.0, atol=5e-6)


def test_pairs_are_in_the_air_only_while_the_record_says_so(operator) -> None:
    """A pair that carries in the record carries on the robot: it lifts after the change and is down before it."""
    record, lower = operator.record, operator.lower
    change = int(np.flatnonzero(np.diff(record["grounded"][:, 6]) < 0)[0]) + 1  # pair 7 goes up
    assert lower[change, 6] == pytest.approx(0.0, abs=1e-9)
    rising = lower[change : change + 61, 6]
    assert (np.diff(rising) > 0).all()
    u = np.linspace(0.0, 1.0, 61)
    np.testing.assert_allclose(rising, CLEARANCE * (6 * u**5 - 15 * u**4 + 10 * u**3), atol=1e-8)
    down = int(np.flatnonzero(np.diff(record["grounded"][:, 6]) > 0)[0]) + 1
    np.testing.assert_allclose(lower[down - 60 : down + 1, 6], rising[::-1], atol=1e-8)


def test_rates_and_accelerations_are_those_of_the_blend(operator) -> None:
    """Base almost straight: no hinge needs more than 4 clearance s''/2l, between neighbours that go the other way."""
    servo_map = snake_map()
    path, segment = path_of_record(operator.record, servo_map), 2 * LINK
    for name in PITCH[1:]:
        column = servo_map.joints.index(name)
        before, after = path.rate_before[:-1, column], path.rate_after[1:, column]
        np.testing.assert_allclose(before, after, atol=1e-12)  # no jump in speed anywhere
        acceleration = np.diff(path.rate_after[:, column]) / np.diff(path.time[:-1])
        assert np.abs(path.extremes().velocity[..., column]).max() < 4 * 1.875 * CLEARANCE / BLEND / segment
        assert np.abs(acceleration).max() < 4 * 5.774 * CLEARANCE / BLEND**2 / segment


def test_the_grounded_part_keeps_its_kinematics_to_second_order(operator) -> None:
    """Axles that are on the ground are where the flat base of the record has them, up to clearance^2."""
    off, heading = second_order(operator)
    assert off < 0.3e-3
    assert heading < 0.05e-3
    half, _ = second_order(posed(operator.record, with_lifts(snake_map(), clearance_mm=2.5)))
    assert half == pytest.approx(off / 4, rel=0.05)


def test_clearance_and_blend_can_be_set(simulated) -> None:
    record = simulated("snake_positioning", "z")
    poses = posed(record, with_lifts(snake_map(), clearance_mm=12, blend_s=0.5))
    np.testing.assert_allclose(poses.lower[~poses.grounded], 12e-3, atol=1e-8)
    np.testing.assert_allclose(poses.lower[poses.grounded], 0.0, atol=1e-8)


def a_snake(yaw: np.ndarray, grounded: np.ndarray, simulated, rate: float = 200.0) -> Record:
    """A record with the scene of a real one: yaw angles (T, 6) of the base part, pairs on the ground or not (T, 7)."""
    real = simulated("snake_positioning", "z")
    record = Record(np.arange(len(yaw)) / rate)
    phi = np.repeat(real["phi"][:1], len(yaw), axis=0)
    phi[:, 6:] = yaw
    record.add("phi", phi, "rad", labels=real.labels["phi"])
    record.add("phi_dot", np.gradient(phi, record.time, axis=0), "rad/s", labels=real.labels["phi"])
    record.add("rho", np.zeros((len(yaw), 7)), "rad", labels=real.labels["rho"])
    record.add("rho_dot", np.zeros((len(yaw), 7)), "rad/s", labels=real.labels["rho"])
    record.add("grounded", grounded, "1", labels=real.labels["grounded"])
    record.scene = real.scene
    return record


def held(yaw: list[float], away: tuple[int, ...], simulated) -> Fold:
    grounded = np.ones((3, 7))
    grounded[:, np.array(away) - 1] = 0
    record = a_snake(np.tile(yaw, (3, 1)), grounded, simulated)
    return lifted(record, Lifts(joints=PITCH, tilt_mm=100.0))


@pytest.mark.parametrize("mode", MODES)
def test_a_straight_base_folds_in_a_plane(mode, simulated) -> None:
    """Segments between an axle up and one down incline by asin(clearance / 2l), in closed form."""
    fold = held([0.0] * 6, MODES[mode], simulated)
    height = np.where(np.isin(np.arange(1, 8), MODES[mode]), CLEARANCE, 0.0)
    incline = np.arcsin(np.diff(height) / (2 * LINK))
    np.testing.assert_allclose(fold.hinge[0], np.diff(incline, prepend=0.0), atol=1e-12)
    np.testing.assert_allclose(fold.tilt, 0.0, atol=1e-12)


@pytest.mark.parametrize("away", [(3,), (3, 6), (2, 5)])
def test_a_base_bent_in_an_arc_folds_without_a_twist(away, simulated) -> None:
    """All axles meet in the middle of the arc: both wheels of what is grounded stay down. In a zigzag they cannot."""
    arc, zigzag = held([0.3] * 6, away, simulated), held([0.3, -0.3] * 3, away, simulated)
    grounded = ~np.isin(np.arange(1, 8), away)
    assert arc.tilt[0, grounded].max() < 0.02e-3
    assert zigzag.tilt[0, grounded].max() > 1e-3


def test_what_stays_of_the_twist_no_pitch_angles_could_remove(operator) -> None:
    """Mode 1 lifts single pairs between grounded ones. Shared between both wheels, half the tilt is the least."""
    record = operator.record
    tilt = np.ptp(operator.wheel, axis=2) * operator.grounded
    row = int(tilt.max(axis=1).argmax())
    assert tilt[row].max() < 0.45e-3
    away = set(np.flatnonzero(~operator.grounded[row]) + 1)
    assert away == {3, 6}
    least = best_deviation(record["phi"][row, 6:], away)
    assert least > 0.1e-3
    assert tilt[row].max() / 2 == pytest.approx(least, rel=0.02)


def blinking(away: dict[int, tuple[float, float]], duration: float = 2.0, rate: float = 200.0) -> np.ndarray:
    """Pairs off the ground from a time to another, shape (T, 7)."""
    time = np.arange(0.0, duration, 1 / rate)
    grounded = np.ones((len(time), 7))
    for pair, (start, end) in away.items():
        grounded[(time >= start) & (time < end), pair - 1] = 0
    return grounded


@pytest.mark.parametrize(
    ("away", "names"),
    [
        ({1: (0.5, 1.5)}, ["pair1", "0.500 s"]),
        (dict.fromkeys(range(2, 8), (0.5, 1.5)), ["pair1"]),
        ({4: (0.5, 0.9)}, ["pair4", "0.400 s", "0.6 s", "lifts.blend_s"]),
        ({4: (1.8, 9.0)}, ["pair4", "0.3 s"]),
    ],
)
def test_what_cannot_be_lifted_is_refused(away, names, simulated) -> None:
    grounded = blinking(away)
    record = a_snake(np.zeros((len(grounded), 6)), grounded, simulated)
    with raises(CheckRefused, *names):
        check_motion(record, snake_map())


def test_a_twist_beyond_the_bound_is_refused_and_the_bound_can_be_set(simulated) -> None:
    grounded = blinking({3: (0.0, 9.0)})
    record = a_snake(np.tile([0.0, 0.6, -0.6, 0.0, 0.0, 0.0], (len(grounded), 1)), grounded, simulated)
    with raises(CheckRefused, "lifts.tilt_mm: 2.5"):
        check_motion(record, snake_map())
    assert check_motion(record, with_lifts(snake_map(), tilt_mm=9))


def test_a_record_too_coarse_for_the_blend_is_refused(simulated) -> None:
    grounded = blinking({4: (0.5, 1.5)}, rate=50)
    record = a_snake(np.zeros((len(grounded), 6)), grounded, simulated, rate=50)
    with raises(CheckRefused, "67 Hz"):
        check_motion(record, snake_map())
    assert check_motion(record, with_lifts(snake_map(), blend_s=0.45))


def test_without_an_entry_in_the_map_lifted_wheels_are_refused_and_others_pass(simulated) -> None:
    servo_map = snake_map()
    servo_map.lifts = None
    with raises(CheckRefused, "pair3, pair6", "lifts"):
        check_motion(simulated("snake_positioning", "z"), servo_map)
    flat = a_snake(np.zeros((400, 6)), np.ones((400, 7)), simulated)
    kept = check_motion(flat, servo_map).path
    assert np.array_equal(kept.position, check_motion(flat, snake_map()).path.position)


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"signal": "ground"}, ["'ground'"]),
        ({"signal": "phi"}, ["'phi'", "0", "1"]),
        ({"joints": PITCH[1:]}, ["5", "7"]),
    ],
)
def test_an_entry_that_does_not_fit_the_record_is_refused(change, names, simulated) -> None:
    with raises(CheckRefused, *names):
        check_motion(simulated("snake_positioning", "z"), with_lifts(snake_map(), **change))


@pytest.mark.parametrize(
    ("old", "new", "name"),
    [
        ("[psi3, psi4,", "[psi3, psi44,", "psi44"),
        ("[psi3, psi4,", "[psi3, wheel1,", "wheel1"),
        ("id: 8, sign: 1, zero_tick: 2048, hold_at_deg: 0", "id: 8, hold_at_deg: 3", "psi4"),
        ("clearance_mm: 5", "clearance_mm: 0", "clearance_mm"),
    ],
)
def test_an_entry_that_does_not_fit_the_servos_is_refused(old, new, name, tmp_path) -> None:
    text = (SHIPPED / "snake.yaml").read_text(encoding="utf-8")
    assert old in text
    file = tmp_path / "snake.yaml"
    file.write_text(text.replace(old, new), encoding="utf-8")
    with raises(ServoMapError, "lifts", name):
        load_servo_map(file)


def test_a_record_without_a_scene_has_no_lengths(simulated) -> None:
    record = a_snake(np.zeros((400, 6)), blinking({4: (0.5, 1.5)}), simulated)
    record.scene = None
    with raises(CheckRefused):
        check_motion(record, snake_map())
    with raises(CheckRefused, "pair9"):
        base_part(simulated("snake_positioning", "z"), ("pair1", "pair9"))


def test_what_was_lifted_is_no_error_of_the_replay(simulated) -> None:
    """psi3 with the lifting added, psi4 to psi8 that the record does not have: compared with what they were to do."""
    record, servo_map = simulated("snake_positioning", "z"), snake_map()
    fold = lifted(record, servo_map.lifts)
    measured = Record(record.time, provenance=servo_map.lifting)
    psi_3 = record["phi"][:, record.labels["phi"].index("psi3")]
    measured.add("phi", np.column_stack([psi_3, np.zeros((len(record), 5))]) + fold.hinge, "rad", labels=PITCH)
    comparison = compare_records(record, measured)
    assert {joint.joint for joint in comparison.joints} == set(PITCH)
    assert max(joint.max for joint in comparison.joints) < 1e-12
    measured.provenance = {}
    (only,) = compare_records(record, measured).joints
    assert only.joint == "psi3"
    measured.provenance = {"lifts": {"joints": 3}}
    with raises(RecordError, "lifts"):
        compare_records(record, measured)


@pytest.mark.slow
def test_lifting_on_virtual_servos(simulated, tmp_path) -> None:
    """The goals are the path's, and the servos follow them."""
    record, servo_map = simulated("snake_positioning", "x"), snake_map()
    motion = check_motion(record, servo_map)
    with bus_on("virtual", servo_map) as (bus, clock):
        result = Replay(motion, servo_map, bus, clock).run()
    assert result.fault is None
    comparison = compare_records(record, result.record)
    of = {joint.joint: joint for joint in comparison.joints}
    assert set(PITCH) < set(of)
    assert max(of[name].max for name in PITCH) < 0.01
    goals = result.record["phi_goal"][:, [result.record.labels["phi_goal"].index(name) for name in PITCH[1:]]]
    rows = np.isfinite(result.record["record_time"])
    wanted = np.array([motion.path.at(time)[0] for time in result.record["record_time"][rows]])
    columns = [servo_map.joints.index(name) for name in PITCH[1:]]
    np.testing.assert_allclose(goals[rows], wanted[:, columns], atol=1e-12)
    assert np.abs(goals[rows]).max() > 0.05
    assert len(comparison.wheels) == 7
