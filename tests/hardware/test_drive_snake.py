"""A driven snake on servos through mode switches: its goals are those of the record's replay."""

from __future__ import annotations

from collections.abc import Mapping
from multiprocessing import get_context

import numpy as np
import pytest
from support.messages import check_message, raises

from dynsim import load_scenario
from dynsim.errors import CheckRefused
from dynsim.hardware.bus.protocol import Clock
from dynsim.hardware.replay.check import IncrementalPath, Sample, check_drive, check_motion
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.servo_map import ServoMap
from dynsim.record import Record
from dynsim.snake.description import FIXING, SWITCHING
from dynsim.teleop.snake import Command, begin
from dynsim.teleop.web.follower import NOT_LIFTED, NOT_STARTED, REGULAR, Columns, PipeFeed, ServoFollower

from .conftest import Rig, Run, check_goals_within_limits
from .test_lifting import BLEND, CLEARANCE, JOINTS, Oracle, settled, snake_map, with_lifts

pytestmark = pytest.mark.long

RATE = 50.0
REQUESTS = {150: 4, 300: SWITCHING, 700: FIXING, 860: 2}
"""Requested modes by number of the tick of 5 ms."""


def command(tick: int, requests: Mapping[int, int]) -> Command:
    """Forward, aside and turning, one after the other."""
    velocity = (0.05 * (tick > 80), 0.02 * (tick > 250), 0.0, 0.0, 0.0, 0.05 * (tick > 400))
    return Command(velocity, requests.get(tick, 0))


class SimulatedSnake:
    """The simulation process of a drive, run in this process on the clock of the servos."""

    def __init__(
        self,
        servo_map: ServoMap,
        requests: Mapping[int, int] = REQUESTS,
        ticks: int = 1000,
        stall: tuple[int, float] = (0, 0.0),
    ) -> None:
        self.session = begin(load_scenario("snake_operator"))
        self.requests, self.ticks, self.stall = requests, ticks, stall
        self.refused: CheckRefused | None = None
        reader, writer = get_context("spawn").Pipe(duplex=False)
        self.heard = [NOT_STARTED]
        self.follower = ServoFollower(self.session, servo_map, writer, self.heard)
        self._feed = PipeFeed(reader, self.heard, servo_map)
        self.clock: Clock | None = None
        self._due: float | None = None
        self._ended = False
        self.behind: list[float] = []

    @property
    def over(self) -> bool:
        return self._feed.over

    @property
    def fault(self) -> str:
        return self._feed.fault

    def take(self, most: int) -> list[Sample]:
        assert self.clock is not None
        now, step = self.clock.now(), self.session.period
        while self.follower.begun and not self._ended:
            self._due = now if self._due is None else self._due
            if self._due > now or not self.follower.ready:
                break
            self._tick()
            lost = self.stall[1] if self.session.ticks == self.stall[0] else 0.0
            # What is lost beyond a cycle is lost.
            self._due = max(self._due + step, now - 1.0 / RATE) + lost
        return list(self._feed.take(most))

    def report_time(self, time: float) -> None:
        self._feed.report_time(time)
        self.behind.append(self.session.time - time)

    def _tick(self) -> None:
        """As follower.simulate does."""
        try:
            if self.session.ticks < self.ticks:
                self.session.tick(command(self.session.ticks, self.requests))
                self.follower.after_tick()
                return
            self.follower.finish()
            self.follower.end(REGULAR)
        except CheckRefused as refused:
            self.refused = refused
            self.follower.end(NOT_LIFTED)
        self._ended = True


def driven(servo_map: ServoMap, *, policy: str | None = None, **options: object) -> tuple[Run, SimulatedSnake]:
    feed = SimulatedSnake(servo_map, **options)  # type: ignore[arg-type]
    motion = check_drive(feed.follower.first, servo_map, feed, step=feed.session.period, longest=20.0, rate=RATE)
    posture = dict(zip(servo_map.joints, motion.start.tolist(), strict=True))
    run = Rig(servo_map, Record([0.0]), posture).prepare(motion=motion, policy=policy)
    feed.clock = run.clock
    run.result = run.replay.run()
    return run, feed


def goals_of(run: Run, simulated: Record) -> np.ndarray:
    """Goals of the joints by the names of the oracle, in the cycles of the drive; all are those of the replay."""
    measured, path = run.result.record, check_motion(simulated, run.map).path
    rows = np.isfinite(measured["record_time"])
    time = measured["record_time"][rows]
    wanted = [path.at(t) for t in time]
    position, rate = (np.array(part) for part in zip(*wanted, strict=True))
    labels = list(measured.labels["phi_goal"])
    of_joint = [run.map.joints.index(name) for name in labels]
    goals = measured["phi_goal"][rows]
    np.testing.assert_allclose(goals, position[:, of_joint], rtol=0, atol=1e-12)
    # Times the speed along the path. Where it stands at the end of what is known, its rate there counts as none.
    speed = np.diff(time, prepend=0.0) * RATE
    wheels = [k for k, servo in enumerate(run.map.servos) if not servo.in_position_mode]
    np.testing.assert_allclose(measured["rho_dot_goal"][rows], speed[:, None] * rate[:, wheels], rtol=0, atol=1e-7)
    assert np.abs(measured["rho_dot_goal"][rows]).max() > 0.1
    return goals[:, [labels.index(name) for name in JOINTS]]


@pytest.fixture(scope="module")
def regular() -> tuple[Run, SimulatedSnake]:
    return driven(snake_map())


def test_goals_are_those_of_the_replay_of_the_finished_record(regular: tuple[Run, SimulatedSnake]) -> None:
    run, feed = regular
    assert run.result.fault is None
    assert run.result.end_state == "holding"
    simulated = feed.session.record()
    assert simulated.summary["mode_switches"] >= 4
    goals = goals_of(run, simulated)
    time = run.result.record["record_time"]
    assert time[np.isfinite(time)][-1] == pytest.approx(simulated.time[-1])
    assert np.ptp(goals[:, [JOINTS.index(f"psi{k}") for k in range(4, 9)]], axis=0).min() > 0.02
    check_goals_within_limits(run)
    # A stop, what is held back, two samples and a cycle; at first and at the end more or less.
    behind = np.array(feed.behind)[50:-50]
    assert behind.min() >= 0.5 * run.map.safety.stop_time + BLEND
    assert behind.max() <= 0.5 * run.map.safety.stop_time + feed.follower.lookahead.delay + 2.0 / RATE


def test_wheels_that_are_lifted_clear_the_floor_and_others_stand_on_it(regular: tuple[Run, SimulatedSnake]) -> None:
    """Of the goals that were sent, by the whole chain in Pinocchio."""
    run, feed = regular
    simulated = feed.session.record()
    goals, time = goals_of(run, simulated), run.result.record["record_time"]
    time = time[np.isfinite(time)]
    before = np.clip(np.searchsorted(simulated.time, time, side="right") - 1, 0, len(simulated) - 2)
    up, down = settled(simulated), simulated["grounded"] == 1
    psi_3 = np.interp(time, simulated.time, simulated["phi"][:, simulated.labels["phi"].index("psi3")])
    oracle, blending = Oracle(), 0
    for k, row in enumerate(before):
        wheel = oracle.from_pair_1(psi_3[k], goals[k])[2]
        assert wheel.min() > -5e-6
        np.testing.assert_allclose(
            wheel[up[row] & up[row + 1]].min(axis=1, initial=1.0).clip(max=CLEARANCE), CLEARANCE, atol=5e-6
        )
        np.testing.assert_allclose(wheel[down[row] & down[row + 1]].min(axis=1), 0.0, atol=5e-6)
        blending += bool((~down[row] & ~up[row]).any())
    assert blending > 4 * 2 * BLEND * RATE


def test_a_simulation_that_is_late_in_a_mode_switch_changes_no_goal() -> None:
    """The wheels come down when the simulation has them down, however long that takes."""
    run, feed = driven(snake_map(), ticks=500, stall=(330, 1.0))
    assert run.result.fault is None
    simulated = feed.session.record()
    goals_of(run, simulated)
    time = run.result.record["record_time"]
    time = time[np.isfinite(time)]
    assert (np.diff(time) < 1e-6).sum() > 10, "it has stood still"
    assert time[-1] == pytest.approx(simulated.time[-1])


def check_stopped(run: Run, feed: SimulatedSnake, *names: str) -> None:
    assert run.result.fault is not None
    assert run.result.fault.cause == Cause.SIMULATION
    check_message(run.result.fault.text)
    check_message(feed.refused, *names)
    assert run.result.end_state == "holding"
    check_goals_within_limits(run)
    # At least as long before what is refused as postures are held back.
    time = run.result.record["record_time"]
    assert np.nanmax(time) <= feed.session.time - BLEND


def test_modes_that_follow_too_soon_are_not_followed() -> None:
    run, feed = driven(snake_map(), requests={150: 4, 210: 2})
    check_stopped(run, feed, "0.300 s", "0.750 s", "0.6 s")


def test_a_base_that_would_twist_is_not_followed() -> None:
    run, feed = driven(with_lifts(snake_map(), tilt_mm=0.02), requests={}, ticks=2000)
    check_stopped(run, feed, "lifts.tilt_mm: 0.02")


def postures(duration: int, requests: Mapping[int, int]) -> tuple[list[Sample], Record]:
    """What leaves a drive of so many ticks."""
    servo_map = snake_map()
    feed = SimulatedSnake(servo_map)
    columns = Columns(feed.session, servo_map)
    lifted = []
    for tick in range(duration):
        feed.session.tick(command(tick, requests))
        lifted += feed.follower.lookahead.add(columns.sample(), *columns.base(feed.follower.lookahead.yaw))
    return [feed.follower.first, *lifted, *feed.follower.lookahead.remaining()], feed.session.record()


@pytest.mark.parametrize("ticks", [1, 2, 30, 61, 63, 230, 270])
def test_a_drive_may_end_at_any_tick(ticks: int) -> None:
    """Also where less has passed than postures are held back. Not while a pair rises: no record may end there."""
    samples, simulated = postures(ticks, {150: 4})
    assert [lifted.time for lifted in samples] == pytest.approx(simulated.time)
    path = check_motion(simulated, snake_map()).path
    growing = IncrementalPath(samples[0], snake_map())
    for sample in samples[1:]:
        assert growing.append(sample, keep=0.0) == []
        for back in (0.0, 0.002):
            np.testing.assert_allclose(growing.at(sample.time - back)[0], path.at(sample.time - back)[0], atol=1e-12)


def test_what_rises_at_the_end_is_left_on_its_way() -> None:
    samples, simulated = postures(180, {150: 4})
    with raises(CheckRefused, "0.150 s"):
        check_motion(simulated, snake_map())
    assert samples[-1].time == pytest.approx(0.9)
    growing = IncrementalPath(samples[0], snake_map())
    assert [words for sample in samples[1:] if (words := growing.append(sample, keep=0.0))] == []


@pytest.mark.parametrize(
    ("tick", "steady"), [(0, False), (59, False), (60, True), (150, True), (151, False), (269, False), (270, True)]
)
def test_it_is_known_when_modes_may_change(tick: int, steady: bool) -> None:
    servo_map = snake_map()
    feed = SimulatedSnake(servo_map)
    for k in range(tick):
        feed.session.tick(command(k, {150: 4}))
        feed.follower.after_tick()
        feed._feed.take(2)
    assert feed.follower.steady is steady


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"signal": "ground"}, ("'ground'", "phi, rho, grounded")),
        ({"joints": ("psi3", "psi4")}, ("2", "7")),
        ({"blend_s": 0.09}, ("222 Hz",)),
    ],
)
def test_what_cannot_be_lifted_is_said_before_anything_moves(change: dict[str, object], names: tuple[str, ...]) -> None:
    with raises(CheckRefused, *names):
        SimulatedSnake(with_lifts(snake_map(), **change))


def test_without_an_entry_in_the_map_wheels_would_be_dragged() -> None:
    servo_map = snake_map()
    servo_map.lifts = None
    still = begin(load_scenario("snake_operator"))
    with raises(CheckRefused):
        Columns(still, servo_map)
