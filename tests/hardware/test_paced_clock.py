"""The clock of virtual servos in wall time: it keeps pace, and slows down on a busy computer."""

from __future__ import annotations

import pytest

from dynsim.hardware.bus import protocol
from dynsim.hardware.bus.protocol import CATCH_UP, PacedClock

from .conftest import Rig


class Computer:
    """Stands for the module ``time``: its clock advances in sleeps and, while the program is suspended, by itself."""

    def __init__(self) -> None:
        self.now = 100.0
        self.slept = 0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        self.slept += 1


@pytest.fixture
def computer(monkeypatch: pytest.MonkeyPatch) -> Computer:
    computer = Computer()
    monkeypatch.setattr(protocol, "time", computer)
    return computer


def test_clock_keeps_pace_with_wall_time(computer: Computer) -> None:
    clock = PacedClock()
    for k in range(1, 6):
        clock.sleep_until(0.1 * k)
        assert clock.now() == pytest.approx(computer.now - 100.0) == pytest.approx(0.1 * k)
        computer.now += 0.01  # work that fits in the period


def test_clock_slows_down_after_a_pause(computer: Computer) -> None:
    clock = PacedClock()
    clock.sleep_until(0.1)
    computer.now += 0.5
    assert clock.now() == pytest.approx(0.1), "work takes no time on this clock"
    clock.sleep_until(0.2)
    assert clock.now() == pytest.approx(0.2)
    for k in range(3, 20):
        clock.sleep_until(0.1 * k)
    # Only a small part of the pause is made up.
    assert computer.now - 100.0 - clock.now() == pytest.approx(0.4 - CATCH_UP)


def test_a_suspended_program_skips_no_cycle(rig: Rig, computer: Computer) -> None:
    run = rig.prepare()
    clock = PacedClock()
    run.replay.clock = run.replay.loop.clock = run.replay.journal.clock = run.replay.bus.port.clock = clock
    cycles = 0

    def suspend(_: object) -> None:
        nonlocal cycles
        cycles += 1
        computer.now += 0.3 if cycles % 10 == 0 else 0.0

    run.replay.journal.observer = suspend
    result = run.replay.run()
    assert result.fault is None
    assert result.timing["skipped_cycles"] == 0
    assert result.timing["lateness_max_s"] == pytest.approx(0.0, abs=1e-9)
    # Longer than the watchdogs of the servos allow, again and again.
    assert computer.now - 100.0 > clock.now() + 0.2 * (cycles // 10)
