"""The offline check: refusals name joint, time and margin; an accepted motion never violates a limit."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from support.messages import check_message, lines_with, mentions, raises, says

from dynsim.errors import CheckRefused
from dynsim.hardware.bus.control_table import RAD_PER_TICK
from dynsim.hardware.replay.check import check_motion, plan_cycle, velocity_limit
from dynsim.hardware.replay.trajectory import Path, path_of_record
from dynsim.hardware.servo_map import load_servo_map
from dynsim.record import Record

from .conftest import Rig, check_goals_within_limits, swing


def record_of(time, shoulder, shoulder_rate) -> Record:
    zero = np.zeros_like(time)
    record = Record(time)
    record.add("q", np.stack([shoulder, zero], axis=1), "rad", labels=("shoulder", "elbow"))
    record.add("v", np.stack([shoulder_rate, zero], axis=1), "rad/s", labels=("shoulder", "elbow"))
    record.add("rho", zero[:, None], "rad", labels=("wheel",))
    record.add("rho_dot", zero[:, None], "rad/s", labels=("wheel",))
    return record


def test_a_motion_within_limits_passes_with_its_margins(rig) -> None:
    motion = rig.motion()
    tightest = {(margin.joint, margin.quantity): margin for margin in motion.margins}
    assert tightest["wheel", "velocity"].value == pytest.approx(3.0, abs=1e-3)
    assert tightest["shoulder", "velocity"].margin == pytest.approx(3.0 - 2.4, abs=1e-3)
    assert ("wheel", "position") not in tightest
    assert all(margin.margin >= 0 for margin in motion.margins)


def test_a_violation_names_joint_time_and_margin(rig) -> None:
    record = swing(amplitude=1.2)
    with raises(CheckRefused) as refusal:
        check_motion(record, rig.map)
    assert lines_with(
        str(refusal.value), "shoulder", "position", "-1.2000 rad", "1.178 s", "-1.0472 rad", "-0.1528 rad"
    )
    assert lines_with(str(refusal.value), "shoulder", "velocity", "4.8000 rad/s")


def test_extremes_between_the_samples_count(rig) -> None:
    """Two samples at 0.9 rad, between them q(½) = 0.9 + h (v0 − v1)/8 = 1.15 rad."""
    time = np.array([0.0, 1.0, 2.0])
    record = record_of(time, np.array([0.9, 0.9, 0.9]), np.array([0.0, 1.0, -1.0]))
    with raises(CheckRefused, re.compile(r"\n  shoulder\b.*\bposition\b.* 1\.15")):
        check_motion(record, rig.map)


def test_speed_scales_velocities(rig) -> None:
    check_motion(rig.record, rig.map, speed=1.2)
    with raises(CheckRefused, "shoulder", "velocity", "--speed 1.25"):
        check_motion(rig.record, rig.map, speed=1.3)


def test_held_rates_make_straight_stretches_that_never_overshoot(write_map) -> None:
    """A joint that runs to 0.9 rad and stays: the smooth interpolant overshoots, the record's robot did not."""
    time, angle = np.array([0.0, 0.5, 1.0, 1.5]), np.array([0.1, 0.5, 0.9, 0.9])
    record = record_of(time, angle, np.array([0.8, 0.8, 0.8, 0.0]))
    old = "{position: q, velocity: v}"
    smooth = path_of_record(record, load_servo_map(write_map()))
    held = path_of_record(record, load_servo_map(write_map((old, "{position: q, velocity: v, rates: held}"))))
    assert smooth.extremes().position[..., 0].max() > 0.95
    assert held.extremes().position[..., 0].max() == pytest.approx(0.9, abs=1e-12)
    assert held.extremes().velocity[..., 0].max() == pytest.approx(0.8)
    assert held.at(0.75)[0][0] == pytest.approx(0.7)


def test_a_record_in_motion_gets_a_run_up_and_a_run_out_at_rest(rig) -> None:
    path = path_of_record(rig.record, rig.map)
    first, last = rig.record["v"][0], rig.record["v"][-1]
    assert path.start == pytest.approx(-np.abs(first).max() / 20)
    assert path.end - np.ptp(rig.record.time) == pytest.approx(
        max(np.abs(last).max(), np.abs(rig.record["rho_dot"][-1]).max()) / 20
    )
    for time in (path.start, path.end):
        assert np.all(path.at(time)[1] == 0)
    inside = np.linspace(path.start + 1e-9, -1e-9, 50)
    accelerations = np.diff([path.at(t)[1] for t in inside], axis=0) / np.diff(inside)[:, None]
    assert np.abs(accelerations).max() <= 20 * (1 + 1e-6)


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (
            lambda record: record.signals.pop("v"),
            ("servos.shoulder", "'v'", "q, rho, rho_dot"),
        ),
        (lambda record: record["q"].__setitem__((3, 1), math.nan), ("elbow", "'q'", "nan", "0.015 s")),
        (lambda record: record.time.__setitem__(4, 0.0), ("4", "0 s")),
        (lambda record: record.time.__setitem__(-1, math.inf), ("inf", "239", "240")),
        (lambda record: record.time.__setitem__(-1, math.nan), ("nan", "239", "240")),
        (lambda record: record.time.__setitem__(0, -math.inf), ("-inf", "0", "240")),
    ],
)
def test_unusable_records_are_refused(rig, change, names: tuple[str, ...]) -> None:
    record = swing()
    change(record)
    with raises(CheckRefused, *names):
        check_motion(record, rig.map)


def test_a_column_is_proposed_for_a_wrong_name(rig) -> None:
    record = swing()
    record.add("q", record["q"], "rad", labels=("shoulder", "elbow_pitch"))
    with raises(CheckRefused, "servos.elbow", "shoulder, elbow_pitch", "'elbow_pitch'"):
        check_motion(record, rig.map)


def test_joints_without_a_servo_are_warned_of(rig) -> None:
    """Not refused: wheels of a mobile base are rightly without."""
    record = swing()
    both, still = record["q"], np.zeros(len(record))
    wrist = np.radians(12.3) * record.time / record.time[-1]
    labels = ("shoulder", "elbow", "wrist", "tool")
    record.add("q", np.column_stack([both, wrist, still, still]), "rad", labels=(*labels, "base.x"))
    record.add("v", np.column_stack([record["v"], np.gradient(wrist, record.time), still]), "rad/s", labels=labels)
    (warning,) = check_motion(record, rig.map).warnings
    check_message(warning, "wrist", "12.3 deg", "tool")
    assert not check_motion(swing(), rig.map).warnings


def test_a_missing_column_and_a_wrong_unit_are_refused(rig) -> None:
    record = swing()
    record.add("q", record["q"], "rad", labels=("shoulder", "knee"))
    with raises(CheckRefused, re.compile(r"rig\.yaml:\d+: servos\.elbow: "), "'elbow'", "'q'", "shoulder, knee"):
        check_motion(record, rig.map)
    record.add("q", record["q"], "deg", labels=("shoulder", "elbow"))
    with raises(CheckRefused, "'q'", "'deg'", "'rad'", "shoulder"):
        check_motion(record, rig.map)
    with raises(CheckRefused, "1"):
        check_motion(swing(duration=0.004), rig.map)


def test_an_incomplete_record_passes_with_a_warning(rig) -> None:
    record = swing()
    record.complete = False
    assert says(check_motion(record, rig.map).warnings[0], "incomplete")


def test_torque_of_the_record_is_checked_where_the_map_names_it(write_map) -> None:
    servo_map = load_servo_map(write_map(("{position: q, velocity: v}", "{position: q, velocity: v, torque: torque}")))
    record = swing()
    torque = np.zeros((len(record), 2))
    torque[7, 1] = -7.0
    record.add("torque", torque, "N m", labels=("shoulder", "elbow"))
    with raises(CheckRefused, "elbow", "torque", "-7.0000 N m", "0.035 s", "6.0000 N m"):
        check_motion(record, servo_map)


def quintics(knots: np.ndarray, seed: int) -> Path:
    """A path whose interpolant is known as polynomials: random angles and rates at the knots."""
    random = np.random.default_rng(seed)
    rates = random.normal(size=(len(knots), 2))
    return Path(knots, random.normal(size=(len(knots), 2)), rates[:-1], rates[1:])


def test_extremes_of_the_acceleration_are_those_of_the_interpolant() -> None:
    """Against the slope of the rates that the path gives between its knots."""
    path = quintics(np.array([0.0, 0.3, 0.4, 1.0]), seed=3)
    extremes = path.extremes()
    for interval in range(3):
        left, right = path.time[interval], path.time[interval + 1]
        times = np.linspace(left + 1e-9, right - 1e-9, 401)
        rates = np.array([path.at(t)[1] for t in times])
        accelerations = np.diff(rates, axis=0) / np.diff(times)[:, None]
        computed = extremes.acceleration[:2, interval]
        # Differences lie half a step inside the interval.
        inside = 1 / 400 * np.abs(computed[1] - computed[0])
        assert np.all(np.abs(computed.max(axis=0) - accelerations.max(axis=0)) <= inside)
        assert np.all(np.abs(computed.min(axis=0) - accelerations.min(axis=0)) <= inside)


def test_a_held_rate_that_steps_is_an_acceleration_over_the_time_it_stands_for() -> None:
    """From 1 rad/s held for 0.1 s to 2 rad/s held for 0.3 s: 1 rad/s in 0.2 s, and nothing between the knots."""
    rates = np.array([[1.0], [2.0]])
    path = Path(np.array([0.0, 0.1, 0.4]), np.array([[0.0], [0.1], [0.7]]), rates, rates)
    acceleration = path.extremes().acceleration[..., 0]
    assert acceleration[2] == pytest.approx([0.0, 5.0])
    assert acceleration[:2] == pytest.approx(0.0, abs=1e-12)


def test_the_jerk_of_a_smooth_path_is_the_mean_of_its_third_derivative() -> None:
    """q = sin ωt: |d³q/dt³| = ω³ |cos ωt|, whose mean over a window of half a period is 2ω³/π wherever it begins."""
    omega, time = 7.0, np.linspace(0.0, 2.0, 2001)
    rates = omega * np.cos(omega * time)[:, None]
    path = Path(time, np.sin(omega * time)[:, None], rates[:-1], rates[1:])
    jerk, _ = path.jerk(math.pi / omega)
    assert jerk[0] == pytest.approx(2 * omega**3 / math.pi, rel=1e-3)


def zigzag(size: float, step: float, rates: str = "none") -> Record:
    time = step * np.arange(60)
    angle = size * (np.arange(60) % 2)
    return record_of(time, angle, np.zeros(60) if rates == "none" else np.gradient(angle, time))


HELD = ("{position: q, velocity: v}", "{position: q, velocity: v, rates: held}")


@pytest.mark.parametrize("replaced", [(), (HELD,)])
@pytest.mark.parametrize("rates", ["none", "gradient"])
def test_a_zigzag_of_12_mrad_every_5_ms_is_refused(write_map, replaced, rates: str) -> None:
    """Its speed is within the limit of 3 rad/s (2.4 held): what no servo can follow is the acceleration."""
    servo_map = load_servo_map(write_map(("velocity: 3.0", "velocity: 4.0"), *replaced))
    with raises(CheckRefused, "shoulder", re.compile(r"\bjerk \d+\.\d+ rad/s³")) as refusal:
        check_motion(zigzag(0.012, 0.005, rates), servo_map)
    assert "velocity" not in str(refusal.value)
    # The same way in steps of 100 ms is one that anybody may go.
    check_motion(zigzag(0.012, 0.1, rates), servo_map)


def test_the_jerk_of_a_zigzag_does_not_depend_on_the_window() -> None:
    """Held rates ±d/h: the acceleration at the knots is ±2d/h², and changes by 4d/h² in every step."""
    time, angle = 0.005 * np.arange(200), 0.012 * (np.arange(200) % 2)
    rates = (np.diff(angle) / 0.005)[:, None]
    path = Path(time, angle[:, None], rates, rates)
    for window in (0.02, 0.05, 0.1):
        assert path.jerk(window)[0][0] == pytest.approx(4 * 0.012 / 0.005**3, rel=1e-9)


def test_what_is_no_number_any_more_is_refused_and_no_speed_offered(rig) -> None:
    tiny = record_of(np.array([0.0, 1e-200, 2e-200]), np.array([0.0, 0.1, 0.2]), np.zeros(3))
    with raises(CheckRefused, "shoulder", "acceleration", "inf") as refusal:
        check_motion(tiny, rig.map)
    assert "--speed" not in str(refusal.value)


def triangles(tooth: float, every: float, step: float, count: int = 30) -> Record:
    """Straight to and fro by ``tooth`` [rad], a turn every so many seconds, sampled evenly; rates are those behind."""
    time = step * np.arange(round(count * every / step) + 1)
    angle = np.interp(time, every * np.arange(count + 1), tooth * (np.arange(count + 1) % 2))
    return record_of(time, angle, np.diff(angle, prepend=angle[:1]) / step)


SHAKES = [(0.02, 0.02, 0.02), (0.02, 0.02, 0.005), (0.04, 0.02, 0.01), (0.2, 0.1, 0.01), (0.25, 0.1, 0.025)]
SHAKES += [(0.005, 0.02, 0.02), (0.16, 0.1, 0.1)]  # about the least that is refused


@pytest.mark.parametrize("replaced", [(), (HELD,)])
@pytest.mark.parametrize("shake", SHAKES)
def test_shaking_is_refused_with_its_joint_and_time(write_map, replaced, shake) -> None:
    """Within all other limits that are set wide: it is what goes to and fro that is refused."""
    wide = ("velocity: 3.0", "velocity: 4.5, acceleration: 90000, jerk: 9000000")
    with pytest.raises(CheckRefused) as refusal:
        check_motion(triangles(*shake), load_servo_map(write_map(wide, *replaced)))
    lines = str(refusal.value).splitlines()
    assert lines_with(lines[1], "shoulder", "shaking", re.compile(r"\d+\.\d+ rad/s at t = \d+\.\d+ s"), "3.0000 rad/s")
    assert [line for line in lines[1:] if "shaking" not in line and "--speed" not in line] == []


@pytest.mark.parametrize("drift", [0.0, 0.9])
def test_a_spike_is_refused_on_a_joint_that_moves_too(write_map, drift: float) -> None:
    """20 mrad in one sample of 10 ms: 2 rad/s gained, 4 lost, 2 gained, whatever the joint does besides."""
    servo_map = load_servo_map(write_map(("velocity: 3.0", "velocity: 4.0"), HELD))
    time = 0.01 * np.arange(100)
    spike = 0.02 * (np.arange(100) == 50)
    check_motion(record_of(time, drift * (time - 0.5), np.full(100, drift)), servo_map)
    with raises(CheckRefused, "1", re.compile(r"^[^\n]*\n  shoulder: shaking 4\.0000 rad/s at t = 0\.[5-8]\d\d s")):
        check_motion(record_of(time, drift * (time - 0.5) + spike, np.full(100, drift)), servo_map)


def test_shaking_of_a_smooth_path_is_the_velocity_it_gains_and_loses() -> None:
    """A sine of 2 rad/s and period T: within T/2 about a peak of the rate it gains and loses 2 rad/s, within T 4."""
    time = np.linspace(0.0, 4.0, 2001)
    rate = 2 * np.cos(2 * math.pi * time)
    angle = 2 * np.sin(2 * math.pi * time) / (2 * math.pi)
    path = Path(time, angle[:, None], rate[:-1, None], rate[1:, None])
    for window, expected in ((0.5, 2.0), (1.0, 4.0), (0.248, 2 * (1 - math.cos(2 * math.pi * 0.124)))):
        assert path.shaking(window)[0][0] == pytest.approx(expected, rel=1e-4)
    # The cubic between three knots turns on the way: v = 1 − 3s + 3s², so 1 to ¼ and back to 1 within an interval.
    single = Path(np.array([0.0, 1.0]), np.array([[0.0], [0.5]]), np.array([[1.0]]), np.array([[1.0]]))
    assert single.shaking(1.0)[0][0] == pytest.approx(0.75)


def test_a_single_jump_of_the_rate_is_bounded_by_the_acceleration(write_map) -> None:
    """As the published arm's record begins: 2.5 rad/s within one sample of 5 ms, at a constant rate from there."""
    time = 0.005 * np.arange(40)
    rate = np.where(time > 0, 2.5, 0.0)
    angle = np.concatenate([[0.0], np.cumsum(0.005 * 0.5 * (rate[1:] + rate[:-1]))])
    record = record_of(time, angle, rate)
    check_motion(record, load_servo_map(write_map()))
    stricter = load_servo_map(write_map(("[-60, 60], velocity: 3.0", "[-60, 60], acceleration: 400, velocity: 3.0")))
    with raises(CheckRefused, "shoulder", "acceleration", "500.0000 rad/s²", "0.000 s", "400.0000 rad/s²"):
        check_motion(record, stricter)


@pytest.mark.parametrize("quantity", ["acceleration: 9.0", "jerk: 35.0"])
def test_a_slower_replay_that_is_offered_passes(write_map, quantity: str) -> None:
    limits = ("[-60, 60], velocity", f"[-60, 60], {quantity}, velocity")
    servo_map = load_servo_map(write_map(limits, ("run_up: 20", "run_up: 5, stop_time: 0.5")))
    with raises(CheckRefused, re.compile(r"--speed 0\.\d+")) as refusal:
        check_motion(swing(), servo_map)
    slower = float(re.findall(r"--speed ([\d.]+\d)", str(refusal.value))[0])
    motion = check_motion(swing(), servo_map, speed=slower)
    name, limit = quantity.split(": ")
    value = max(abs(margin.value) for margin in motion.margins if margin.quantity == name and margin.joint != "wheel")
    assert 0.7 * float(limit) < value <= float(limit)


def test_holes_in_the_record_are_refused_and_a_missing_sample_is_told(rig) -> None:
    whole = swing()

    def without(*samples: int) -> Record:
        kept = [k for k in range(len(whole)) if k not in samples]
        record = Record(whole.time[kept])
        for name in whole:
            record.add(name, whole[name][kept], whole.units[name], labels=whole.labels[name])
        return record

    assert rig.motion().warnings == ()
    warning = check_motion(without(100), rig.map).warnings[0]
    assert mentions(warning, "1", "238", "0.495", "0.505 s", "2", "5 ms")
    # The median of every third sample missing, and of steps of 5 and 10 ms in turn, is not the usual step.
    every_third = check_motion(without(*range(2, 240, 3)), rig.map).warnings[0]
    assert mentions(every_third, "79", "159", "2", "5 ms")
    with raises(CheckRefused, "2", "0.195", "0.215 s", "4", "5 ms"):
        check_motion(without(40, 41, 42, 100, 101), rig.map)


@pytest.mark.parametrize("speed", [1e-300, 0.0099, 10.1, 1e300])
def test_speeds_beyond_all_measure_are_refused(rig, speed: float) -> None:
    at_rest = record_of(0.01 * np.arange(5), np.zeros(5), np.zeros(5))
    with raises(CheckRefused, "--speed", "0.01", "10", f"{speed:g}"):
        check_motion(at_rest, rig.map, speed=speed)
    for possible in (0.01, 10.0):
        assert check_motion(at_rest, rig.map, speed=possible).speed == possible


@pytest.mark.parametrize(("step", "speed"), [(1e300, 1.0), (30_000.0, 1.0), (1000.0, 0.03)])
def test_a_motion_of_more_than_a_day_is_refused(rig, step: float, speed: float) -> None:
    at_rest = record_of(step * np.arange(4), np.zeros(4), np.zeros(4))
    with raises(CheckRefused, f"--speed {speed:g}", "24 h"):
        check_motion(at_rest, rig.map, speed=speed)
    check_motion(record_of(28_000.0 * np.arange(4), np.zeros(4), np.zeros(4)), rig.map)


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan, math.inf])
def test_nonsense_speeds_and_rates_are_refused(rig, speed: float) -> None:
    with raises(CheckRefused, "--speed", "0.01", "10", f"{speed:g}"):
        check_motion(rig.record, rig.map, speed=speed)
    with raises(CheckRefused, "--rate", str(speed)):
        check_motion(rig.record, rig.map, rate=speed)


def test_a_rate_the_bus_cannot_carry_is_refused_with_one_it_can(rig) -> None:
    with raises(CheckRefused, re.compile(r"--rate \d+"), "2000 Hz") as refusal:
        plan_cycle(rig.map, 2000)
    possible = int(str(refusal.value).split("--rate ")[1].split()[0])
    assert plan_cycle(rig.map, possible).health_every <= 10


def test_a_rate_at_which_the_watchdogs_would_trip_is_refused(rig) -> None:
    with raises(CheckRefused, "--rate 14", "0.2 s", "use 15"):
        plan_cycle(rig.map, 14)
    plan_cycle(rig.map, 15)


@pytest.mark.parametrize(("baud", "rate"), [(1_000_000, 142), (3_000_000, 277)])
def test_the_plan_agrees_with_the_estimate_for_eighteen_servos(write_map, baud: int, rate: float) -> None:
    """18 servos, 1 and 3 Mbit/s: wire time 195 and 584 Hz, with USB and turnaround 142 and 277 Hz."""
    lines = "".join(f"  j{k}: {{kind: joint, id: {k}}}\n" for k in range(20, 35))
    text = "  wheel: {kind: wheel, id: 7}\n"
    path = write_map((text, "  j19: {kind: joint, id: 19}\n" + lines), ("baud: 1000000", f"baud: {baud}"))
    servo_map = load_servo_map(path)
    assert len(servo_map.servos) == 18
    assert 1 / plan_cycle(servo_map, 0.93 * rate).cycle_time == pytest.approx(rate, rel=0.01)


motions = st.lists(
    st.tuples(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2), st.floats(-3.5, 3.5), st.floats(-3.5, 3.5), st.floats(-6, 6)),
    min_size=2,
    max_size=5,
)


@pytest.mark.long
@given(knots=motions, interval=st.floats(0.05, 0.6), speed=st.floats(0.3, 2.0))
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow])
def test_what_is_sent_never_violates_a_limit(rig: Rig, knots, interval: float, speed: float) -> None:
    """Whatever the record: it is refused, or every goal on the wire stays inside position and speed limits."""
    values = np.array(knots)
    record = Record(interval * np.arange(len(values)))
    # Shrunk towards rest until it passes, so that the examples sit at the limits rather than far outside of them.
    for shrink in (1.0, 0.8, 0.6, 0.4, 0.2, 0.05):
        record.add("q", shrink * values[:, :2], "rad", labels=("shoulder", "elbow"))
        record.add("v", shrink * values[:, 2:4], "rad/s", labels=("shoulder", "elbow"))
        record.add("rho", np.zeros((len(values), 1)), "rad", labels=("wheel",))
        record.add("rho_dot", shrink * values[:, 4:], "rad/s", labels=("wheel",))
        try:
            motion = check_motion(record, rig.map, speed=speed)
            break
        except CheckRefused:
            continue
    else:
        assume(False)
    run = rig.run(motion=motion)
    check_goals_within_limits(run)
    for servo in run.map.servos[:2]:
        sent = [(time, value) for time, id_, value in run.goals() if id_ == servo.id]
        assert len(sent) > 2
        times, ticks = np.array([t for t, _ in sent]), np.array([v for _, v in sent])
        # One tick of rounding at each end of the step.
        allowed = velocity_limit(servo) * np.maximum(np.diff(times), run.replay.loop.period) / RAD_PER_TICK + 1
        assert np.all(np.abs(np.diff(ticks)) <= allowed)
