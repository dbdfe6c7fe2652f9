"""Servos that follow a pilot: every goal sent satisfies the limits of the offline check."""

from __future__ import annotations

import itertools
import math
import random
import re
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from studies.fault_table import CASES, Case
from support.messages import check_message, raises

from dynsim.errors import CheckRefused, DynsimError
from dynsim.hardware.bus.protocol import Clock
from dynsim.hardware.errors import OutputsFailed, PortError, ReplayAborted
from dynsim.hardware.replay.check import SILENCE, DrivenMotion, IncrementalPath, MotionLimits, Sample, check_drive, lead
from dynsim.hardware.replay.output import ReplayProgress, ReplayState, StopRequest, displayed
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.replay.session import run_replay, shown_by
from dynsim.hardware.replay.trajectory import Path as RobotPath
from dynsim.hardware.servo_map import load_servo_map

from .conftest import TORQUE_ADDRESS, Rig, Run, check_goals_within_limits
from .output_faults import AFTER, BEFORE, Call, Outputs, watched
from .test_output_faults import ARMED

pytestmark = pytest.mark.long

STEP = 0.005
Array = np.ndarray
Posture = Callable[[float], tuple[Array, Array]]


def swinging(time: float) -> tuple[Array, Array]:
    """From rest: angles of 0.3 (1 − cos 4t), at up to 1.2 rad/s; the wheel at up to 3 rad/s."""
    angle, rate = 0.3 * (1.0 - math.cos(4.0 * time)), 1.2 * math.sin(4.0 * time)
    return np.array([angle, -angle, 2.5 * angle]), np.array([rate, -rate, 2.5 * rate])


@dataclass
class Simulated:
    """A simulation on the clock of the servos: it keeps real time, waits for them, and is lost in time now and then.

    Attributes
    ----------
    posture : of each time; until : [s] its end
    stalls : (from, until) [s of its own time, seconds] in which nothing comes
    dies_at : [s] its process is gone from then on
    told : times that it was told
    """

    clock: Clock
    ahead: float
    posture: Posture = swinging
    until: float = 2.0
    stalls: Sequence[tuple[float, float]] = ()
    dies_at: float = math.inf
    step: float = STEP
    told: list[float] = field(default_factory=list)
    sent: int = 0
    fault: str = ""
    _due: float | None = None
    _stalled: set[int] = field(default_factory=set)

    @property
    def over(self) -> bool:
        return (self.sent + 1) * self.step > self.until

    def take(self, most: int) -> list[Sample]:
        now, due = self.clock.now(), []
        if self.sent * self.step >= self.dies_at:
            self.fault = "the process of the simulation is gone"
        while len(due) < most and not self.over and not self.fault and self._may_go_on(now):
            self.sent += 1
            due.append(Sample(self.sent * self.step, *self.posture(self.sent * self.step)))
            # As live.pace does: what is lost beyond a period is lost.
            self._due = max(self._due + self.step, now - self.step)
        return due

    def _may_go_on(self, now: float) -> bool:
        if not self.told:
            return False
        self._due = now if self._due is None else self._due
        for number, (at, seconds) in enumerate(self.stalls):
            if self.sent * self.step >= at and number not in self._stalled:
                self._stalled.add(number)
                self._due = now + seconds
        return self._due <= now and (self.sent + 1) * self.step <= self.told[-1] + self.ahead

    def report_time(self, time: float) -> None:
        self.told.append(time)


def prepared(rig: Rig, *faults: dict[str, Any], stop: StopRequest | None = None, **options: Any) -> Run:
    """A drive that has not begun; options of Simulated, of check_drive (rate) and of Replay."""
    replay = {name: options.pop(name) for name in ("policy", "observer", "live") if name in options}
    rate = options.pop("rate", None)
    feed = Simulated(None, lead(rig.map), **options)  # type: ignore[arg-type]
    motion = check_drive(Sample(0.0, *feed.posture(0.0)), rig.map, feed, step=feed.step, longest=feed.until, rate=rate)
    run = Rig(rig.map, rig.record, {}).prepare(*faults, motion=motion, stop=stop, **replay)
    feed.clock = run.clock
    return run


def drive(rig: Rig, *faults: dict[str, Any], **options: Any) -> Run:
    run = prepared(rig, *faults, **options)
    run.result = run.replay.run()
    return run


def feed_of(run: Run) -> Simulated:
    motion = run.replay.motion
    assert isinstance(motion, DrivenMotion)
    assert isinstance(motion.feed, Simulated)
    return motion.feed


def followed(run: Run) -> tuple[Array, Array, Array]:
    """Of the cycles in which the path went on, and those of the stop: path time [s], goals, their rates."""
    record = run.result.record
    rows = np.isfinite(record["record_time"])
    goals = np.column_stack([record["q_goal"], record["rho_dot_goal"]])[rows]
    return record["record_time"][rows], goals, record["v_goal"][rows]


def check_on_the_path(run: Run) -> None:
    """All goals are postures of the simulation, at a time that only rises and never faster than real time."""
    time, goals, _ = followed(run)
    speeds = np.diff(time) / run.replay.loop.period
    assert speeds.min() >= 0.0
    assert speeds.max() <= 1.0 + 1e-9
    # A stop in stop_time, and a start as slow: no jumps.
    assert np.abs(np.diff(speeds)).max() <= run.replay.loop.period / run.map.safety.stop_time * (1.0 + 1e-6)
    feed = feed_of(run)
    expected = np.array([feed.posture(t)[0][:2] for t in time])
    # Cubics through samples 5 ms apart: h⁴/384 max |q''''| = 5e-10 rad.
    assert goals[:, :2] == pytest.approx(expected, abs=1e-9)
    top = max(abs(feed.posture(t)[1][:2]).max() for t in np.arange(0.0, feed.until, 1e-3))
    steps = np.abs(np.diff(goals[:, :2], axis=0)).max()
    assert steps <= top * run.replay.loop.period * (1.0 + 1e-3)
    assert time[-1] <= feed.sent * feed.step
    check_goals_within_limits(run)


def test_the_servos_follow_the_drive_to_its_end(rig: Rig) -> None:
    run = drive(rig)
    assert run.result.fault is None
    assert run.result.end_state == "off"
    check_on_the_path(run)
    time, goals, rates = followed(run)
    assert time[-1] == pytest.approx(2.0)
    assert rates[-1] == pytest.approx(0.0, abs=1e-9)
    assert np.ptp(goals[:, 0]) > 0.55
    record = run.result.record
    assert record.complete
    assert np.nanmax(np.abs(record["q"] - record["q_goal"])) < 0.12  # 43.5 ms of lag at 1.2 rad/s, and its growth


@pytest.mark.parametrize("stalls", [[], [(0.7, 0.5)]])
def test_the_servos_are_so_far_behind_that_a_stop_is_known(rig: Rig, stalls: list[tuple[float, float]]) -> None:
    run = prepared(rig, stalls=stalls)
    feed, stop_time = feed_of(run), rig.map.safety.stop_time
    report_time, behind, needed = feed.report_time, [], []

    def note(time: float) -> None:
        report_time(time)
        if run.replay.loop.course is not None and time > 0.0:
            behind.append(feed.sent * STEP - time)
            needed.append(0.5 * run.replay.loop.course.speed**2 * stop_time)

    feed.report_time = note  # type: ignore[method-assign]
    run.replay.run()
    assert np.all(np.array(behind) >= np.array(needed) - 1e-9)
    assert max(behind) <= lead(rig.map) + 1e-9
    # Where nothing is late: a stop, two samples, a cycle.
    if not stalls:
        assert max(behind) <= 0.5 * stop_time + 4 * 0.01


@pytest.mark.parametrize(
    ("stalls", "rate"),
    [([(0.6, 0.2)], 100.0), ([(0.9, 2.0)], 140.0), ([(0.3, 0.15), (0.5, 0.4), (1.2, 1.0)], 50.0)],
)
def test_a_simulation_that_is_late_makes_no_burst(rig: Rig, stalls: list[tuple[float, float]], rate: float) -> None:
    run = drive(rig, stalls=stalls, rate=rate)
    assert run.result.fault is None
    check_on_the_path(run)
    time, goals, _ = followed(run)
    assert time[-1] == pytest.approx(2.0)
    if max(seconds for _, seconds in stalls) > 0.5:
        # It has stood still, every servo of it, the wheel too.
        still = np.flatnonzero(np.diff(time) < 1e-6)
        still = still[(time[still] > 0.1) & (time[still] < 1.9)]
        assert len(still) > 0.3 * rate
        assert np.abs(goals[still + 1, 2]).max() < 1e-3


def test_a_loop_that_is_late_makes_no_burst(rig: Rig) -> None:
    """The computer runs something else for 0.15 s, again and again: the simulation waits for the servos."""
    run = prepared(rig)
    sleep = run.clock.sleep_until
    count = itertools.count()

    def sleep_until(deadline: float) -> None:
        late = 0.15 if run.replay.journal.state == ReplayState.REPLAY and next(count) % 40 == 39 else 0.0
        sleep(deadline + late)

    run.clock.sleep_until = sleep_until  # type: ignore[method-assign]
    run.result = run.replay.run()
    assert run.result.fault is None
    assert run.result.timing["skipped_cycles"] > 30
    check_on_the_path(run)
    feed = feed_of(run)
    assert feed.sent * STEP == 2.0


def beyond(limit: str) -> Posture:
    """As swinging, and from 1 s on something that no map allows."""

    def posture(time: float) -> tuple[Array, Array]:
        position, rate = swinging(time)
        since = time - 1.0
        if since <= 0.0:
            return position, rate
        if limit == "position":  # 1.05 rad are allowed
            position[0] += 0.4 * since**2
            rate[0] += 0.8 * since
        elif limit == "velocity":
            position[1] += 4.0 * since**2
            rate[1] += 8.0 * since
        elif limit == "acceleration":
            rate[0] += 5.5 * (since < 2 * STEP)
        elif limit == "shaking":
            position[0] += 0.012 * (round(since / STEP / 2) % 2)
        elif limit == "wheel":
            position[2] += 4.0 * since**2
            rate[2] += 8.0 * since
        elif limit == "no number":
            position[0] = math.nan
        return position, rate

    return posture


NAMES = {
    "position": ("shoulder", "position"),
    "velocity": ("elbow", "velocity"),
    "acceleration": ("shoulder", "acceleration"),
    "shaking": ("shoulder",),
    "wheel": ("wheel", "velocity"),
    "no number": ("shoulder", "position", "nan"),
}


@pytest.mark.parametrize("limit", NAMES)
def test_what_is_beyond_a_limit_is_never_followed(rig: Rig, limit: str) -> None:
    run = drive(rig, posture=beyond(limit), until=4.0)
    assert run.result.fault is not None
    assert run.result.fault.cause == Cause.LIMIT
    check_message(run.result.fault.text, *NAMES[limit])
    assert run.result.fault_state == ReplayState.REPLAY
    assert run.result.end_state == "holding"
    check_goals_within_limits(run)
    time, _, _ = followed(run)
    # It has stopped on the way that was checked, and before what was refused.
    assert time[-1] <= (feed_of(run).sent - 1) * STEP + 1e-9
    check_on_the_path(run)
    run.line.advance(run.line.time + 1.0)
    assert np.abs(run.line.servos.plant.velocity).max() < 1e-2


@pytest.mark.parametrize("policy", ["hold", "decelerate", "off"])
@pytest.mark.parametrize("trouble", ["limit", "dead", "interrupted"])
def test_the_policy_says_how_a_drive_ends(rig: Rig, trouble: str, policy: str) -> None:
    stop = StopRequest()
    options: dict[str, Any] = {
        "limit": {"posture": beyond("position"), "until": 4.0},
        "dead": {"dies_at": 1.1},
        "interrupted": {"observer": lambda progress: stop() if interrupting(run, progress, stop) else None},
    }[trouble]
    run = prepared(rig, stop=stop, policy=policy, **options)
    run.result = run.replay.run()
    cause = {"limit": Cause.LIMIT, "dead": Cause.SIMULATION, "interrupted": Cause.INTERRUPTED}[trouble]
    assert run.result.fault is not None
    assert run.result.fault.cause == cause
    assert run.result.end_state == ("off" if policy == "off" else "holding")
    assert any(value for _, _, value in run.writes_of(TORQUE_ADDRESS))
    if policy == "decelerate" or trouble == "interrupted":
        check_on_the_path(run)
    if policy == "off" and trouble != "interrupted":
        assert run.result.policy_goals == []


def interrupting(run: Run, progress: ReplayProgress, stop: StopRequest) -> bool:
    return progress.state == ReplayState.REPLAY and feed_of(run).told[-1:] > [1.1] and not stop.count


@pytest.mark.parametrize("at", [0.05, 0.4, 1.0, 1.9])
@pytest.mark.parametrize("stalls", [[], [(1.0, 1.0)]])
def test_a_stop_stays_on_what_is_known_of_the_path(rig: Rig, at: float, stalls: list[tuple[float, float]]) -> None:
    """Also while the robot is slowing down for a late simulation, and with nothing more to come from it."""
    stop = StopRequest()

    def observe(progress: ReplayProgress) -> None:
        if progress.state == ReplayState.REPLAY and feed_of(run).told[-1:] > [at] and not stop.count:
            stop()
            feed_of(run).take = lambda most: []  # type: ignore[method-assign]

    run = prepared(rig, stop=stop, observer=observe, stalls=stalls)
    run.result = run.replay.run()
    assert run.result.end_state == "holding"
    check_on_the_path(run)
    time, _, rates = followed(run)
    assert rates[-1] == pytest.approx(0.0, abs=1e-9)
    assert time[-1] - at <= 0.5 * rig.map.safety.stop_time + 3 * run.replay.loop.period


def test_a_second_ctrl_c_releases(rig: Rig) -> None:
    stop = StopRequest()

    def observe(progress: ReplayProgress) -> None:
        if interrupting(run, progress, stop):
            stop()
            stop()

    run = prepared(rig, stop=stop, observer=observe)
    result = run.replay.run()
    assert result.end_state == "off"
    assert not any(servo["torque_enable"] for servo in run.line.servos.registers.values())


def test_a_simulation_that_says_nothing_any_more_ends_the_drive(rig: Rig) -> None:
    run = drive(rig, stalls=[(1.0, 60.0)])
    assert run.result.fault is not None
    assert run.result.fault.cause == Cause.SIMULATION
    assert f"{SILENCE:g} s" in run.result.fault.text
    check_on_the_path(run)
    assert run.result.end_state == "holding"


def test_a_simulation_that_jumps_in_time_is_not_followed(rig: Rig) -> None:
    run = prepared(rig)
    take = feed_of(run).take
    feed_of(run).take = lambda most: [  # type: ignore[method-assign]
        sample._replace(time=sample.time + 0.1 * (sample.time > 1.0)) for sample in take(most)
    ]
    run.result = run.replay.run()
    assert run.result.fault is not None
    assert run.result.fault.cause == Cause.SIMULATION
    assert followed(run)[0][-1] <= 1.0 + 1e-9


STRUCK = [case for case in CASES if case.scripted_onset]


@pytest.mark.parametrize(
    ("case", "policy"),
    [
        pytest.param(case, ("decelerate", "hold", "off")[number % 3], marks=() if number % 4 == 0 else pytest.mark.long)
        for number, case in enumerate(STRUCK)
    ],
    ids=lambda value: getattr(value, "name", value),
)
def test_faults_of_servos_end_a_drive_as_they_end_a_replay(rig: Rig, case: Case, policy: str) -> None:
    fault = {**case.entry, "at": 0.9} | ({"id": case.ids[0]} if case.ids else {})
    run = drive(rig, fault, until=1.6, policy=policy)
    replayed = rig.run({**fault, "at": 1.9}, policy=policy)
    assert {fault.cause for fault in run.result.faults[:1]} <= set(case.causes)
    assert bool(run.result.faults) == bool(replayed.result.faults)
    assert run.result.end_state == replayed.result.end_state
    check_goals_within_limits(run)


def test_what_cannot_begin_is_refused(rig: Rig) -> None:
    feed = Simulated(None, 0.0)  # type: ignore[arg-type]
    zero = np.zeros(3)

    def begin(position: Array, velocity: Array, **options: Any) -> DrivenMotion:
        return check_drive(Sample(0.0, position, velocity), rig.map, feed, step=STEP, longest=10.0, **options)

    assert np.array_equal(begin(zero, zero).start, zero)
    with raises(CheckRefused, "1", re.compile(r"\n.*\belbow: position\b")):
        begin(np.array([0.0, 1.2, 0.0]), zero)
    with raises(CheckRefused, "shoulder"):
        begin(zero, np.array([0.1, 0.0, 0.0]))
    with raises(CheckRefused, "shoulder"):
        begin(np.array([math.nan, 0.0, 0.0]), zero)
    with raises(CheckRefused, "--rate"):
        begin(zero, zero, rate=5000.0)


def noisy(seed: int, size: float) -> tuple[Array, Array, Array]:
    """Times, angles and rates of three joints: waves, with knocks and trembling here and there."""
    draw = np.random.default_rng(seed)
    time = np.arange(0.0, 1.5, STEP)
    angle = sum(
        draw.uniform(0.0, 0.05) * (1 - np.cos(frequency * time))[:, None] * draw.uniform(-1.0, 1.0, 3)
        for frequency in (2.0, 5.0, 9.0)
    )
    for _ in range(3):
        at, length = draw.integers(50, 250), draw.integers(1, 20)
        angle[at : at + length, draw.integers(3)] += size * draw.uniform(-1.0, 1.0, length)
    rate = np.gradient(angle, time, axis=0)
    rate[0] = 0.0
    return time, angle, rate


@pytest.mark.parametrize(
    ("held", "jerk"), [(False, 60_000), pytest.param(True, 60_000, marks=pytest.mark.long), (False, 1000)]
)
def test_sample_by_sample_the_limits_are_those_of_the_check(
    write_map: Callable[..., Path], held: bool, jerk: float
) -> None:
    """A path that the check of a whole record refuses is refused at a sample, one well within all limits at none."""
    limits = [(text, f"{text}, jerk: {jerk}") for text in ("velocity: 3.0, torque: 6.0", "velocity: 5.0, torque: 1.8")]
    servo_map = load_servo_map(write_map(*limits))
    refused = passed = 0
    causes: set[str] = set()
    for seed in range(40):
        time, angle, rate = noisy(seed, 0.03 * (seed / 40) ** 4)
        path = IncrementalPath(Sample(0.0, angle[0], np.zeros(3)), servo_map)
        path._held[:] = held
        appended = (path.append(Sample(time[k], angle[k], rate[k]), keep=0.0) for k in range(1, len(time)))
        broken = next(filter(None, appended), None)
        straight = np.diff(angle, axis=0) / STEP
        rates = (straight, straight) if held else (rate[:-1], rate[1:])
        margins = list(MotionLimits(servo_map).margins(RobotPath(time, angle, *rates)))
        if not all(margin.holds for margin in margins):
            assert broken, [str(margin) for margin in margins if not margin.holds]
            refused += 1
            causes |= {" ".join({margin.quantity for margin in margins if not margin.holds})}
        elif all(margin.margin > 0.2 * abs(margin.limit) for margin in margins):
            assert not broken
            passed += 1
    assert refused > 5
    assert passed > 5
    # Each window is alone in seeing what is wrong, now and then.
    assert ("jerk" if jerk == 1000 else "shaking") in causes


def test_a_path_that_grows_forgets_only_what_nobody_asks_for(rig: Rig) -> None:
    path = IncrementalPath(Sample(0.0, *swinging(0.0)), rig.map)
    times = STEP * np.arange(1, 8000)
    for time in times:
        assert path.append(Sample(time, *swinging(time)), keep=time - 0.5) == []
        for before in (0.0, 0.2, 0.4999):
            if time > 1.0 and round(time / STEP) % 100 == 0:
                position, rate = path.at(time - before)
                assert position == pytest.approx(swinging(time - before)[0], abs=3e-9)
                assert (before == 0.0) or rate == pytest.approx(swinging(time - before)[1], abs=1e-6)
    assert len(path._path.time) < 2000


# -- what the loop lets out -------------------------------------------------------------------------------------------

ENDINGS: dict[str, dict[str, Any]] = {
    "regular": {},
    "late": {"stalls": [(0.2, 0.4)]},
    "limit": {"posture": beyond("position"), "until": 3.0},
    "dead": {"dies_at": 0.3},
}


class Driven:
    """A drive with its files and its progress bar, and what was on the wire."""

    def __init__(self, rig: Rig, ending: str, folder: Path, outputs: Outputs) -> None:
        self.run = prepared(rig, **{"until": 0.5, **ENDINGS[ending]})
        self.outputs, self.error = outputs, None
        with watched(outputs) as console:
            try:
                with shown_by(folder) as lost, displayed(console, lost) as observer:
                    run_replay(
                        self.run.replay.motion,
                        rig.map,
                        nullcontext((self.run.replay.bus, self.run.clock)),
                        folder,
                        live=True,
                        observer=observer,
                    )
            except DynsimError as error:
                self.error: DynsimError | None = error


@pytest.fixture(scope="module", params=ENDINGS)
def undisturbed(request: pytest.FixtureRequest, rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Any:
    return request.param, Driven(rig, request.param, tmp_path_factory.mktemp("drive"), Outputs())


def test_the_loop_of_a_drive_lets_nothing_out_while_the_robot_is_armed(undisturbed: tuple[str, Driven]) -> None:
    ending, case = undisturbed
    assert isinstance(case.error, ReplayAborted) == (ending in ("limit", "dead"))
    seen = case.outputs.seen
    assert [call for call in seen if call.looping and call.state in ARMED] == []
    assert {call.state for call in seen} >= {BEFORE, AFTER, ReplayState.ARM.name, ReplayState.REPLAY.name}


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_outputs_that_fail_do_not_change_what_is_on_the_wire(
    undisturbed: tuple[str, Driven], rig: Rig, tmp_path: Path
) -> None:
    ending, expected = undisturbed
    calls: list[Call] = list(expected.outputs.seen)
    for number, call in enumerate(random.Random(ending).sample(calls, 3)):
        folder = tmp_path / str(number)
        folder.mkdir()
        outputs = Outputs(failing=call)
        case = Driven(rig, ending, folder, outputs)
        if not outputs.failed:
            continue  # with an earlier result in the folder only
        if case.run.sent != expected.run.sent:
            assert isinstance(case.error, PortError)
            assert not case.run.writes_of(TORQUE_ADDRESS)
        else:
            assert case.error is None or isinstance(case.error, OutputsFailed | ReplayAborted)


def test_a_map_is_all_that_is_known_of_where_a_drive_goes(rig: Rig) -> None:
    """So a servo whose own limits are narrower than the map's is not armed: it would ignore goals without a word."""
    run = prepared(rig)
    run.line.servos.registers[1]["max_position"] = 2100
    result = run.replay.run()
    assert result.fault is not None
    assert result.fault.cause == Cause.VERIFICATION
    check_message(result.fault.text, re.compile(r"\(ID \d\)"), re.compile(r"\d+ to \d+"))
    assert feed_of(run).told == []
