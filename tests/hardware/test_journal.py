"""Failing log and progress output of a replay: the motion is unaffected, and the failure is reported."""

from __future__ import annotations

import pytest
from support.messages import mentions

from dynsim.hardware.bus.protocol import VirtualClock
from dynsim.hardware.replay.output import Journal, Recorder, RunLog, StopRequest


@pytest.fixture
def journal(rig) -> Journal:
    return Journal(VirtualClock(), Recorder(rig.map), RunLog(), None, StopRequest())


def test_an_output_that_fails_is_kept_and_switched_off(journal: Journal) -> None:
    calls = []

    def fails(text: str) -> None:
        calls.append(text)
        raise OSError(28, "No space left on device")

    assert journal.guard("plot", fails, "one") is None
    assert journal.guard("plot", fails, "two") is None
    assert calls == ["one"]
    assert str(journal.failures["plot"]) == "[Errno 28] No space left on device"
    assert mentions(journal.log.lines[-1], "plot", "No space left on device")
    assert journal.guard("other", lambda number: number + 1, 1) == 2
    assert set(journal.failures) == {"plot"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
def test_who_wants_out_of_an_output_asks_for_a_stop(journal: Journal, error: type[BaseException]) -> None:
    def leaves() -> None:
        raise error

    journal.guard("progress", leaves)
    assert journal.stop.count == 1
    assert isinstance(journal.failures["progress"], error)


def test_a_log_that_raises_loses_nothing_but_itself(journal: Journal, monkeypatch) -> None:
    def closed(*_: object) -> None:
        raise ValueError("I/O operation on closed file")

    monkeypatch.setattr(journal.log, "write", closed)
    journal.add_line("one")
    journal.add_line("two")
    assert set(journal.failures) == {"log"}


def test_an_observer_that_fails_does_not_stop_the_motion(rig) -> None:
    run = rig.prepare()

    def observe(progress: object) -> None:
        raise BrokenPipeError(32, "Broken pipe")

    run.replay.journal.observer = observe
    result = run.replay.run()
    assert result.fault is None
    assert result.end_state == "off"
    assert isinstance(run.replay.journal.failures["progress"], BrokenPipeError)


def test_what_is_held_back_is_written_afterwards_with_its_own_time(journal: Journal) -> None:
    with journal.buffered():
        journal.add_line("first")
        journal.clock.sleep_until(2.0)
        journal.add_line("second")
        assert not journal.log.lines
    assert [line.split() for line in journal.log.lines] == [
        ["0.0000", "CONNECT", "first"],
        ["2.0000", "CONNECT", "second"],
    ]
