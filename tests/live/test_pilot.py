"""Commands of a pilot: accepted values, dead-man's key, silence; a clock that stretches time and does not catch up."""

from __future__ import annotations

import itertools
import json

import pytest
from support.messages import raises

from dynsim.snake.description import SWITCHING
from dynsim.teleop.snake import PilotAxis
from dynsim.teleop.web.live import RealTimeClock
from dynsim.teleop.web.pilot import DRIVING, NO_PILOT, RELEASED, SILENCE, SILENT, Deadman, PilotCommand, Refused, parse

AXES = (PilotAxis("x", "hand", "m/s", 0.1), PilotAxis("turn", "base", "rad/s", 0.5))


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def said(**changes: object) -> str:
    return json.dumps({"n": 1, "axes": [0.0, 0.0], "held": False} | changes)


def test_parse_takes_a_command() -> None:
    command = parse(said(axes=[0.5, -2.0], held=True, mode="switching", closed=True), 2, (1, 2))
    assert command == PilotCommand(1, (0.5, -1.0), True, SWITCHING, True)
    assert parse(said(mode=2), 2, (1, 2)) == PilotCommand(1, (0.0, 0.0), False, 2)
    assert parse('{"do": "take"}', 2, ()) == "take"


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("", "JSON"),
        ("[" * 4000, "JSON"),
        ("[1]", "JSON"),
        (b"\x00", ""),
        ('{"n": 1, "axes": [NaN, 0], "held": true}', "NaN"),
        ('{"n": 1, "axes": [Infinity, 0], "held": true}', "Infinity"),
        ('{"n": 1, "axes": [1e999, 0], "held": true}', "axes"),
        ('{"n": 1, "axes": [' + "9" * 3900 + ', 0], "held": true, "closed": 1}', "closed"),
        (said(axes=[True, 0.0]), "axes"),
        (said(axes=["1", 0.0]), "axes"),
        (said(axes=[0.0]), "axes 2"),
        (said(axes=None), "axes 2"),
        (said(held=1), "held"),
        (said(n=-1), "n"),
        (said(n=1.5), "n"),
        (said(n=True), "n"),
        (said(mode=7), "mode switching, fixing, 1, 2"),
        (said(mode="up"), "mode switching, fixing, 1, 2"),
        (said(speed=3), "'speed'"),
        ('{"do": "format"}', "do take, leave, end"),
        ('{"do": []}', "do take, leave, end"),
    ],
)
def test_parse_refuses(text: str | bytes, names: str) -> None:
    with raises(Refused, *names.split()):
        parse(text, 2, (1, 2))


def test_whole_numbers_beyond_all_bounds_are_full_speed() -> None:
    command = parse('{"n": 1, "axes": [' + "9" * 3900 + ', 0], "held": true}', 2, ())
    assert isinstance(command, PilotCommand)
    assert command.axes == (1.0, 0.0)


def test_deadman_needs_the_key_heard_released_first() -> None:
    clock = Clock()
    deadman = Deadman(AXES, clock)
    assert deadman.command()[1] == NO_PILOT
    deadman.receive(PilotCommand(1, (1.0, 1.0), held=True))
    assert deadman.command()[0].velocity == (0.0, 0.0)
    deadman.receive(PilotCommand(2, (1.0, 1.0), held=False))
    command, state, count = deadman.command()
    assert (command.velocity, state, count) == ((0.0, 0.0), RELEASED, 2)
    deadman.receive(PilotCommand(3, (0.5, -1.0), held=True))
    command, state, count = deadman.command()
    assert (command.velocity, state, count) == ((0.05, -0.5), DRIVING, 3)


def test_deadman_stops_in_silence_until_the_key_is_pressed_anew() -> None:
    clock = Clock()
    deadman = Deadman(AXES, clock)
    deadman.receive(PilotCommand(1, (0.0, 0.0), held=False))
    deadman.receive(PilotCommand(2, (1.0, 0.0), held=True, closed=True))
    clock.now = SILENCE
    assert deadman.command()[1] == DRIVING
    clock.now = SILENCE + 1e-3
    command, state, _ = deadman.command()
    assert (command.velocity, state) == ((0.0, 0.0), SILENT)
    assert command.closed, "a gripper does not open by itself"
    deadman.receive(PilotCommand(3, (1.0, 0.0), held=True))
    assert deadman.command()[0].velocity == (0.0, 0.0), "nothing goes on by itself"
    deadman.receive(PilotCommand(4, (1.0, 0.0), held=False))
    deadman.receive(PilotCommand(5, (1.0, 0.0), held=True))
    assert deadman.command()[0].velocity == (0.1, 0.0)


def test_silence_that_no_tick_has_seen_counts() -> None:
    clock = Clock()
    deadman = Deadman(AXES, clock)
    deadman.receive(PilotCommand(1, (0.0, 0.0), held=False))
    deadman.receive(PilotCommand(2, (1.0, 0.0), held=True))
    clock.now = 1.0
    deadman.receive(PilotCommand(3, (1.0, 0.0), held=True))
    assert deadman.command()[0].velocity == (0.0, 0.0)


def test_deadman_drops_words_that_were_overtaken_and_takes_a_mode_once() -> None:
    deadman = Deadman(AXES, Clock())
    deadman.receive(PilotCommand(1, (0.0, 0.0), held=False))
    deadman.receive(PilotCommand(5, (1.0, 0.0), held=True, request=3))
    deadman.receive(PilotCommand(4, (-1.0, 0.0), held=True))
    assert deadman.command()[0].velocity == (0.1, 0.0)
    deadman.receive(PilotCommand(6, (0.0, 0.0), held=True, request=3))
    assert [deadman.command()[0].request for _ in range(2)] == [3, 0]
    deadman.receive(PilotCommand(7, (0.0, 0.0), held=False, request=2))
    assert deadman.command()[0].request == 0, "a mode moves the robot: it wants the key too"


def test_a_pilot_who_left_leaves_nothing_to_the_next() -> None:
    deadman = Deadman(AXES, Clock())
    deadman.receive(PilotCommand(1, (0.0, 0.0), held=False))
    deadman.receive(PilotCommand(900, (1.0, 0.0), held=True))
    deadman.reset()
    assert deadman.command()[:2] == (deadman.command()[0], NO_PILOT)
    deadman.receive(PilotCommand(1, (1.0, 0.0), held=True))
    assert deadman.command()[0].velocity == (0.0, 0.0)


def test_real_time_clock_stretches_time_and_never_hurries() -> None:
    clock = Clock()

    def wait(seconds: float) -> None:
        clock.now += seconds

    ticks, begun = RealTimeClock(0.01, clock, wait), []
    for tick in range(40):
        ticks.next()
        begun.append(clock.now)
        clock.now += 0.5 if tick == 10 else 0.002
    assert ticks.lost == pytest.approx(0.5 - 0.02)
    # Before and long after the stall in their rhythm; nowhere is more than one period made up for.
    assert [b - a for a, b in itertools.pairwise(begun[:11])] == pytest.approx([0.01] * 10)
    assert [b - a for a, b in itertools.pairwise(begun[14:])] == pytest.approx([0.01] * 25)
    assert all(
        b - a >= (gap - 1) * 0.01 - 1e-9 for gap in range(1, 30) for a, b in zip(begun, begun[gap:], strict=False)
    )


def test_real_time_clock_of_a_simulation_that_is_too_slow() -> None:
    clock = Clock()
    ticks = RealTimeClock(0.01, clock, lambda seconds: None)
    for _ in range(100):
        ticks.next()
        clock.now += 0.02
    assert ticks.late == pytest.approx(0.02)
    assert ticks.lost == pytest.approx(99 * 0.01 - 0.01, abs=0.011)
