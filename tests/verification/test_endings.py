"""End of every run: bounds of the integration loops, reasons that stop a run, wall limit, Ctrl-C, stuck steps."""

from __future__ import annotations

import os
import re
import signal
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from combinations.sentences import HOLDS_UP
from support.messages import check_message, mentions, raises, says

import dynsim
from dynsim.engine import kinematic, stopping
from dynsim.engine.prepare import prepare
from dynsim.errors import ScenarioError, SimulationInterrupted, SimulationStopped
from dynsim.integrators import driver, events, steps
from dynsim.integrators import run as ki
from dynsim.integrators.radau5 import step as radau
from dynsim.integrators.radau5 import tables as kn
from dynsim.system import interruption

ENDLESS = Path(__file__).parents[1] / "data" / "endless" / "arm.yaml"
CREEPING = ENDLESS.with_name("creeping_block.yaml")


@pytest.fixture(autouse=True)
def nothing_is_left(monkeypatch: pytest.MonkeyPatch):
    """Clear the flag of steps that were left running in a thread: the steps of these tests end without help."""
    monkeypatch.setattr(interruption, "_left", False)


def test_an_arm_on_a_pipe_comes_to_its_end():
    """At 0.196 s a step of radau5 that ends the search does not repeat to the bit; references depend on all 10 s."""
    record = dynsim.simulate(dynsim.load_scenario(ENDLESS))
    other = dynsim.simulate(dynsim.load_scenario(ENDLESS, overrides={"integrator.method": "dopri5"}))
    assert record.time[-1] == 10.0
    assert [(event.kind, event.name) for event in record.events] == [(event.kind, event.name) for event in other.events]
    energy = record.summary["electrical_energy_J"]
    assert energy == pytest.approx(other.summary["electrical_energy_J"], rel=1e-6)


# ---- Loops of the driver, as plain Python

# A system without contacts.
BARE = SimpleNamespace(model=None, unilateral=None, contacts=None)


def table(count: int = 1) -> Any:
    """Return the changing part of a run with ``count`` events: only the fields that the root search reads."""
    event, event_table = np.zeros((count, ki.EVENT_SIZE)), np.zeros((count, ki.EVENT_TABLE_SIZE), dtype=int)
    event[:, ki.SIDE] = event[:, ki.START_VALUE] = 1.0
    event[:, ki.INNER_VALUE : ki.INNER_VALUE + 2] = 1.0
    clock = np.zeros(ki.CLOCK_SIZE)
    clock[ki.INNER : ki.INNER + 2] = 0.3, 0.8
    return SimpleNamespace(
        clock=clock,
        count=np.zeros(ki.COUNT_SIZE, dtype=int),
        event=event,
        event_table=event_table,
        gaps=None,
    )


@pytest.mark.parametrize("seed", range(20))
def test_a_search_ends_whatever_its_trials_say(monkeypatch: pytest.MonkeyPatch, seed: int):
    """A root at 0.3 of the step, known to 1e-12 only: closer trials are on either side of it at random."""
    random = np.random.default_rng(seed)
    run = table(2)
    run.clock[ki.STEP] = 1e-3
    noise = 0.0 if seed == 0 else 1e-12

    def guard(system: Any, t: float, ws: Any, run: Any, e: int) -> float:
        return 1.0 if e == 1 else 0.3e-3 - t + noise * random.uniform(-1.0, 1.0)

    monkeypatch.setattr(events, "guard", guard)
    trials = 1
    while events.cut_step(BARE, None, run):
        trials += 1
        assert trials < 2 * events.SEARCH_LIMIT
    assert run.count[ki.FIRED] == 1
    assert run.clock[ki.STEP] == pytest.approx(0.3e-3, abs=1e-11)
    # The code that handles the event finds that it has passed.
    assert events.happened(run, 0, run.event[0, ki.VALUE])
    assert not events.happened(run, 1, run.event[1, ki.VALUE])


def test_a_step_that_never_passes_again_ends_the_search_all_the_same(monkeypatch: pytest.MonkeyPatch):
    run, values = table(), iter([-1.0])
    run.clock[ki.STEP] = 1e-3
    monkeypatch.setattr(events, "guard", lambda *_: next(values, 1e-15))
    trials = 1
    while events.cut_step(BARE, None, run):
        trials += 1
        assert trials < 2 * events.SEARCH_LIMIT
    assert (run.count[ki.FIRED], run.clock[ki.STEP]) == (1, 1e-3)
    assert events.happened(run, 0, run.event[0, ki.VALUE])


def test_what_seems_to_be_passed_over_for_ever_does_not_shorten_steps_to_nothing(monkeypatch: pytest.MonkeyPatch):
    run = table()
    run.clock[ki.STEP] = 1e-3
    monkeypatch.setattr(events, "too_long", lambda *_: 0.01)
    trials = 0
    while events.passes_over(BARE, None, run):
        trials += 1
        assert trials <= events.SEARCH_LIMIT
    assert run.clock[ki.STEP] > events.event_tolerance(0.0)


@pytest.mark.parametrize(
    ("roots", "side", "direction", "part"),
    [
        ((0.4, 0.6), 1, 0, 0.5),
        ((0.4, 0.6), -1, 0, 0.5),
        # Whatever the direction: of two passages one counts.
        ((0.4, 0.6), 1, 1, 0.5),
        ((0.05, 0.07), 1, -1, 0.06),
        # From a root that has just been found, and to the one at which the step ends.
        ((0.0, 0.5), 1, -1, 0.25),
        # A guard at zero has the side of the end.
        ((0.0, 0.5), 0, 0, 0.25),
        # It only touches zero, or turns outside the step, or has passed once.
        ((0.5, 0.5), 1, 0, 0.5),
        ((-0.2, -0.1), 1, 0, 1.0),
        ((0.7, 2.0), 1, 1, 1.0),
    ],
)
def test_a_guard_that_passes_twice_within_a_step_ends_it_where_it_turns(roots, side, direction, part):
    """Of a parabola, which the cubic through four of its values is."""
    run, sign = table(), -1.0 if side < 0 else 1.0
    nodes = np.array([0.0, 0.3, 0.8, 1.0])
    start, first, second, end = sign * (nodes - roots[0]) * (nodes - roots[1])
    run.event[0, [ki.SIDE, ki.START_VALUE, ki.VALUE]] = side, start, end
    run.event[0, ki.INNER_VALUE : ki.INNER_VALUE + 2] = first, second
    run.event_table[0, ki.DIRECTION] = direction
    assert events.turns_within(run) == pytest.approx(part, abs=1e-12)


def test_a_guard_that_stays_away_from_zero_or_at_it_ends_no_step():
    """It turns 0.2 off zero by 0.25, or by rounding alone."""
    nodes = np.array([0.0, 0.3, 0.8, 1.0])
    for scale, lift in ((1.0, 0.2), (1e-13, 0.0)):
        run = table()
        start, first, second, end = scale * (nodes - 0.5) ** 2 + lift - 0.1 * scale * (lift == 0.0)
        run.event[0, [ki.START_VALUE, ki.VALUE]] = start, end
        run.event[0, ki.INNER_VALUE : ki.INNER_VALUE + 2] = first, second
        assert events.turns_within(run) == 1.0


def test_the_next_root_is_not_the_one_just_found(monkeypatch: pytest.MonkeyPatch):
    """Near the root at the start of the step the guard is rounding, and may be beyond zero again."""
    run = table()
    run.clock[ki.STEP], run.event[0, ki.START_VALUE] = 1e-3, 1e-17

    def guard(system: Any, t: float, ws: Any, run: Any, e: int) -> float:
        return t * (0.4e-3 - t) - (1e-16 if t < 1e-12 else 0.0)

    monkeypatch.setattr(events, "guard", guard)
    while events.cut_step(BARE, None, run):
        pass
    assert run.clock[ki.STEP] == pytest.approx(0.4e-3, abs=1e-12)


def test_steps_that_are_always_refused_are_too_small_in_the_end():
    run = table()
    run.clock[ki.STEP], run.y_new, run.stage, run.method = 1e-3, np.zeros(2), np.zeros((8, 2)), ki.RADAU5
    ws = SimpleNamespace(counts=np.zeros(20, dtype=int))
    trials = 0
    while run.count[ki.STATUS] == ki.RUNNING:
        assert steps.rejected(ws, run, 1.0 + 1e-9, 4.0)
        trials += 1
        assert trials < 1000
    assert run.count[ki.STATUS] == ki.STEP_TOO_SMALL


def test_a_step_of_radau5_whose_newton_method_diverges_takes_two_jacobians_at_most(monkeypatch: pytest.MonkeyPatch):
    """The first may have been made before the step; none is made twice at one place."""
    n = 2
    newton = kn.newton_arrays(n, 0, 0, 2 * n, 2 * n)
    newton.count[kn.STALE], newton.count[kn.MADE_AT] = 0, -1
    run = SimpleNamespace(
        clock=np.ones(ki.CLOCK_SIZE), count=np.zeros(ki.COUNT_SIZE, dtype=int), newton=newton,
        y=np.zeros(2 * n), y_new=np.zeros(2 * n), stage=np.zeros((8, 2 * n)),
    )  # fmt: skip
    made: list[str] = []

    def differentiate(system: Any, ws: Any, run: Any) -> None:
        made.append("jacobian")
        run.newton.count[kn.STALE], run.newton.count[kn.MADE_AT] = 0, run.count[ki.STEPS]

    def solve_stages(*_: Any) -> bool:
        made.append("solve")
        return False

    monkeypatch.setattr(radau, "differentiate", differentiate)
    monkeypatch.setattr(radau, "factor_both", lambda *_: None)
    monkeypatch.setattr(radau, "solve_stages", solve_stages)
    assert radau.step_radau5(None, None, run) == radau.NO_STAGES
    assert made == ["solve", "jacobian", "solve"]


# ---- The progress watch

TINY = {"record.rate_hz": 10, "metrics.settle_s": 0}


@pytest.mark.parametrize("method", ["radau5", "dopri5", "time_stepping"])
def test_steps_that_come_nowhere_end_a_run(method: str):
    """With every method: in a run of 10 s, the counted steps advance by 1e-9 s at a time."""
    step = "step_s" if method == "time_stepping" else "step_max_s"
    overrides = {**TINY, "integrator.method": method, f"integrator.{step}": 1e-13}
    with pytest.raises(SimulationStopped) as raised:
        dynsim.simulate(dynsim.load_scenario("elbow_comparison_floor", "two_elbows", overrides))
    stop = raised.value
    assert stop.kind == "no_progress"
    assert stop.time < 1e-8
    check_message(stop, "10000", "1.0e-05 s", "1.0e-13 s", "elbow_4")
    # Contact and mode; a step of time stepping begins with different modes.
    assert method == "time_stepping" or mentions(stop, "elbow_4", "elbow_7")
    assert stop.record is not None
    assert not stop.record.complete
    assert stop.record.time.tolist() == [0.0]
    assert stop.record.provenance["stopped"]["kind"] == "no_progress"


def test_steps_are_counted_from_where_they_last_came_on():
    """A run with more than MOST_TRIALS steps that advances does not count as a run without progress."""
    overrides = {**TINY, "integrator.step_max_s": 1e-5, "duration_s": 0.5, "integrator.method": "dopri5"}
    record = dynsim.simulate(dynsim.load_scenario("single_pendulum", overrides=overrides))
    assert record.summary["rhs_evaluations"] > 6 * 2 * ki.MOST_TRIALS


def test_a_simulation_that_comes_nowhere_stops_with_its_trace():
    overrides = {**TINY, "integrator.step_max_s": 1e-13, "integrator.method": "dopri5"}
    simulation = dynsim.Simulation(dynsim.load_scenario("single_pendulum", overrides=overrides), duration=np.inf)
    with pytest.raises(SimulationStopped) as raised:
        simulation.advance(1.0)
    assert raised.value.kind == "no_progress"
    assert raised.value.record.time.tolist() == [0.0]
    assert not simulation.record().complete


@pytest.mark.parametrize(("duration", "least"), [(0.35, 3.5e-6), (10.0, 1e-5), (3600.0, 3.6e-3)])
def test_short_runs_have_to_come_on_by_more_of_their_duration(duration: float, least: float):
    """Slip that ended every 5.5e-10 s in a run of 0.35 s never finished: 10 000 steps advanced by 9e-7 s."""
    scenario = dynsim.load_scenario("single_pendulum", overrides={**TINY, "duration_s": duration})
    assert prepare(scenario).run.clock[ki.LEAST_PROGRESS] == pytest.approx(least)


def test_runs_of_a_batch_that_come_nowhere_are_looked_at_alone():
    overrides = {**TINY, "integrator.step_max_s": 1e-12, "integrator.method": "dopri5"}
    lengths = [{"plant.chain.0.length_m": length} for length in (0.5, 1.0)]
    runs = [dynsim.load_scenario("single_pendulum", overrides={**overrides, **length}) for length in lengths]
    assert all(mentions(result.reason, "10000") for result in dynsim.simulate_batch(runs))


# ---- The wall limit

SLOW = {"duration_s": 100, "record.rate_hz": 1, "metrics.settle_s": 0, "integrator.step_max_s": 1e-6}
SLOW |= {"integrator.method": "dopri5", "integrator.wall_limit_s": 0.3}


def test_the_wall_limit_ends_a_run_with_what_it_has():
    with raises(SimulationStopped, "integrator.wall_limit_s = 0.3 s") as raised:
        dynsim.simulate(dynsim.load_scenario("single_pendulum", overrides=SLOW))
    assert raised.value.kind == "out_of_time"
    assert 0.0 < raised.value.time < 100.0
    assert len(raised.value.record.time) >= 1


def test_the_wall_limit_of_a_simulation_is_that_of_all_its_pieces():
    simulation = dynsim.Simulation(dynsim.load_scenario("single_pendulum", overrides=SLOW))

    def advance() -> None:
        for k in range(1, 100_000):
            simulation.advance(1e-3 * k)

    with raises(SimulationStopped, "integrator.wall_limit_s = 0.3 s"):
        advance()


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("out_of_time", {}),
        ("no_progress", {"duration_s": 36000.0, "record.rate_hz": 1, "integrator.wall_limit_s": None}),
    ],
)
@pytest.mark.parametrize("law", ["unilateral", "bilateral"])
def test_a_stop_says_which_friction_holds_explicit_steps_up(law: str, kind: str, settings: dict[str, object]):
    """A block that creeps down a slope, see the file: its friction changes within m s/(μ f), and W = 1/m.

    s is the limit of slow slip, 1e-7 m/s, or √(v² + v_s²) for a glued contact.
    """
    smooth = {"contacts.slip_smoothing_m_s": 1e-7} if law == "bilateral" else {}
    with pytest.raises(SimulationStopped) as raised:
        dynsim.simulate(dynsim.load_scenario(CREEPING, overrides={"contacts.law": law, **smooth, **settings}))
    assert raised.value.kind == kind
    said = re.search(HOLDS_UP, str(raised.value))
    assert said is not None
    step, speed, within = map(float, (said[1], said[3], said[4]))
    v = raised.value.state["v"]
    force = 2.0 * 9.81 / np.hypot(1.0, 0.4 * (1.0 + 4e-4))
    assert speed == pytest.approx(np.linalg.norm(v), rel=5e-3)
    slow = np.hypot(speed, 1e-7) if law == "bilateral" else 1e-7
    assert within == pytest.approx(2.0 * slow / (0.4 * force), rel=5e-3)
    # Value for DOPRI5, up to a rejected step.
    assert 1.0 < step / within < 5.0


def test_an_implicit_method_is_not_held_up_by_stiff_friction():
    """Steps of 3.3 τ would be 1e7; with differences of 1e-9 m/s Newton's method held them at 13 µs, 75 000 a second."""
    implicit = {"integrator.method": "radau5", "integrator.wall_limit_s": None}
    record = dynsim.simulate(dynsim.load_scenario(CREEPING, overrides=implicit))
    assert record.summary["steps"] < 100


def test_the_wall_limit_ends_a_snake():
    overrides = {"duration_s": 1000, "record.rate_hz": 1, "integrator.wall_limit_s": 0.2}
    scenario = dynsim.load_scenario("snake_circle", overrides=overrides)
    with raises(SimulationStopped, "integrator.wall_limit_s = 0.2 s", "1") as raised:
        kinematic.simulate(scenario)
    assert len(raised.value.record.time) > 1


def test_a_method_that_was_removed_is_told_with_its_replacement():
    for method in ("rk4", "rk43"):
        with raises(ScenarioError, f"integrator.method = '{method}'", "dopri5", "time_stepping"):
            dynsim.load_scenario("single_pendulum", overrides={"integrator.method": method})


# ---- Interrupts while compiled code runs


def floor() -> dynsim.Scenario:
    """Return a scenario with the unilateral law, whose steps may take long."""
    overrides = {"duration_s": 0.5, "metrics.settle_s": 0}
    return dynsim.load_scenario("elbow_comparison_floor", "two_elbows", overrides)


class Stands:
    """Stand-in for the compiled driver: a step that does not end until it is released, and ignores interrupts."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, after: int = 0) -> None:
        self.inside, self.released, self.left = threading.Event(), threading.Event(), after
        self.advance = driver.advance
        monkeypatch.setattr(driver, "advance", self)
        monkeypatch.setattr(driver, "direct", lambda run: self)

    def __call__(self, system: Any, ws: Any, run: Any, limit: int) -> None:
        if limit < 0:
            self.advance(system, ws, run, limit)
            return
        self.advance(system, ws, run, 20)
        self.inside.set()
        # Watches count processor time.
        while not self.released.wait(1e-3):
            compute(0.01)


def compute(seconds: float) -> None:
    """Use processor time of this thread [s]."""
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def interrupt_when(event: threading.Event) -> None:
    """Send Ctrl-C to this process once the event is set."""

    def wait() -> None:
        event.wait(60.0)
        time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=wait, daemon=True).start()


@pytest.fixture
def ctrl_c():
    """Enable Ctrl-C: SIGINT is ignored if tests run in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_ends_a_run_whose_step_does_not(monkeypatch: pytest.MonkeyPatch, ctrl_c: None):
    stands = Stands(monkeypatch)
    interrupt_when(stands.inside)
    try:
        with pytest.raises(SimulationInterrupted) as raised:
            dynsim.simulate(floor())
        assert not stands.released.is_set()
    finally:
        stands.released.set()
    assert raised.value.time > 0.0
    assert not raised.value.record.complete


def test_a_step_that_does_not_end_is_stuck(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(stopping, "STALLED_S", 0.3)
    stands = Stands(monkeypatch)
    try:
        with pytest.raises(SimulationStopped) as raised:
            dynsim.simulate(floor())
    finally:
        stands.released.set()
    assert raised.value.kind == "stuck"
    assert raised.value.record is not None


def test_steps_that_take_long_are_not_stuck(monkeypatch: pytest.MonkeyPatch):
    """Each step of a run takes more than half of STALLED_S: the run continues, because it advances."""
    monkeypatch.setattr(stopping, "STALLED_S", 0.4)
    advance = driver.advance

    def slowly(system: Any, ws: Any, run: Any, limit: int) -> None:
        if limit < 0:
            advance(system, ws, run, limit)
            return
        for _ in range(5):
            compute(0.25)
            advance(system, ws, run, 1)
        advance(system, ws, run, limit)

    monkeypatch.setattr(driver, "advance", slowly)
    assert dynsim.simulate(floor()).complete


def test_pieces_without_progress_add_up(monkeypatch: pytest.MonkeyPatch):
    """A run of many short pieces, as of a sampled controller, is stopped too."""
    monkeypatch.setattr(stopping, "STALLED_S", 0.3)
    watch, run = stopping.WallWatch(None), SimpleNamespace(clock=np.zeros(32))
    run.clock[ki.LEAST_PROGRESS] = 1e-6
    for _ in range(8):
        watch.begin()
        compute(0.05)
        watch.spend(run)
    assert watch.stalled
    run.clock[ki.TIME] = 2e-6
    watch.spend(run)
    assert not watch.stalled


def test_a_simulation_goes_on_after_ctrl_c_as_if_nothing_had_been(monkeypatch: pytest.MonkeyPatch, ctrl_c: None):
    scenario = floor()
    whole = dynsim.Simulation(scenario)
    whole.advance(0.5)
    advance, begun = driver.advance, threading.Event()

    def interrupted(system: Any, ws: Any, run: Any, limit: int) -> None:
        if limit > 0 and not begun.is_set():
            advance(system, ws, run, 10)
            begun.set()
            while run.count[ki.ASKED] == 0:
                time.sleep(0.01)
        advance(system, ws, run, limit)

    monkeypatch.setattr(driver, "direct", lambda run: interrupted)
    simulation = dynsim.Simulation(scenario)
    interrupt_when(begun)
    with pytest.raises(KeyboardInterrupt):
        simulation.advance(0.5)
    assert not simulation.finished
    simulation.advance(0.5)
    assert simulation.state.q.tobytes() == whole.state.q.tobytes()
    assert simulation.happened == whole.happened


def test_a_simulation_whose_step_did_not_end_does_not_go_on(monkeypatch: pytest.MonkeyPatch, ctrl_c: None):
    stands = Stands(monkeypatch)
    simulation = dynsim.Simulation(floor())
    interrupt_when(stands.inside)
    try:
        with pytest.raises(KeyboardInterrupt):
            simulation.advance(0.5)
    finally:
        stands.released.set()
    record = simulation.record()
    assert not record.complete
    assert says(record.summary["warnings"][-1], "stuck")


def test_ticks_of_a_snake_are_run_without_a_thread_each(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread for each tick took more than half of the time."""
    handed_over = []

    def run_in_thread(work: Any, *others: Any) -> Any:
        handed_over.append(1)
        return attend_to(work, *others)

    attend_to = stopping.run_in_thread
    monkeypatch.setattr(stopping, "run_in_thread", run_in_thread)
    dynsim.simulate(dynsim.load_scenario("snake_positioning_dynamic", "x", {"duration_s": 0.1}))
    assert handed_over == [1]  # the loading of kernels


def test_what_the_work_raises_is_raised():
    def work() -> None:
        raise ValueError("of the work")

    with pytest.raises(ValueError, match="of the work"):
        stopping.run_in_thread(work, lambda: None, lambda: None)


def test_work_of_one_thread_is_not_mistaken_for_that_of_another_task():
    done: list[int] = []
    release = threading.Event()

    def look() -> None:
        raise KeyboardInterrupt

    ended, raised = stopping.run_in_thread(lambda: release.wait(30.0), lambda: None, look)
    assert (ended, type(raised)) == (False, KeyboardInterrupt)
    assert stopping.run_in_thread(lambda: done.append(1), lambda: None, lambda: None) == (True, None)
    assert done == [1]
    release.set()
