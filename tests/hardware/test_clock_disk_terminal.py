"""Clocks that jump or stall, slow or full disks and blocked pipes, during replays and drives."""

from __future__ import annotations

import fcntl
import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.disturbed import WORLDS, disturb, fill, press_until_it_ends
from support.processes import wait_for
from support.teleop_clients import prepare_child

from dynsim.hardware.bus.protocol import Clock, VirtualClock
from dynsim.hardware.replay.machine import Replay
from dynsim.hardware.replay.rules import Cause
from dynsim.record import Record

from .conftest import MAP, Rig, Run, check_goals_within_limits, swing
from .test_drive import feed_of, prepared
from .test_pseudo_terminal import Servos, command, virtual_servos
from .test_terminal import completed, measured

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("hang_ups")]


@pytest.fixture
def world(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Processes that are started have this clock or disk."""
    disturb(request.param, tmp_path, monkeypatch)
    return str(request.param)


@pytest.fixture
def servos(tmp_path: Path) -> Iterator[Servos]:
    """Virtual servos of an undisturbed process."""
    with virtual_servos(tmp_path) as servos:
        yield servos


@pytest.mark.parametrize("world", WORLDS, indirect=True)
def test_a_replay_keeps_its_cycle(servos: Servos, world: str) -> None:
    ended = subprocess.run(servos.replay("--live", "--yes"), capture_output=True, text=True, timeout=120, check=False)
    lost = completed(servos)
    record, summary = measured(servos)
    assert np.diff(record.time).max() < 0.8  # a cycle that waits for the disk takes a second
    assert "fault" not in summary
    if world == "dead disk":
        assert ended.returncode == 1
        assert len(ended.stderr.splitlines()) == 1
        assert lost.keys() <= {"log", "streamed record"} != set()
    else:
        assert (ended.returncode, lost) == (0, {}), ended.stderr


def replay_in(folder: Path) -> list[str]:
    """Write a record and a map, and return the command that replays the record to the folder ``o``."""
    swing().save(folder / "rig.h5")
    (folder / "rig.yaml").write_text(MAP, encoding="utf-8")
    words = ("replay", folder / "rig.h5", "--map", folder / "rig.yaml", "--port", "virtual", "--out", folder / "o")
    return command("hw", *words)


def test_a_replay_with_blocked_output_ends_at_ctrl_c(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    fcntl.fcntl(reader, fcntl.F_SETPIPE_SZ, 4096)
    fill(reader)
    process = subprocess.Popen(replay_in(tmp_path), stdout=writer, stderr=writer, preexec_fn=prepare_child)
    os.close(writer)
    try:
        # The motion does not wait for the reader: all files are complete.
        wait_for((tmp_path / "o" / "summary.json").exists)
        wait_for(lambda: not (tmp_path / "o" / "measured.part").exists())
        assert press_until_it_ends(process) == 130
    finally:
        process.kill()
        process.wait()
        os.close(reader)
    assert Record.load(tmp_path / "o" / "measured.h5").complete
    assert json.loads((tmp_path / "o" / "summary.json").read_text(encoding="utf-8"))["end_state"] == "off"


def test_a_disk_that_becomes_full_leaves_the_end_state(tmp_path: Path) -> None:
    """The limit of file sizes leaves room for the summary, but not for the record."""
    line = " ".join(f"'{word}'" for word in replay_in(tmp_path))
    script = f"ulimit -f 24; NUMBA_CACHE_DIR={tmp_path} exec {line}"
    ended = subprocess.run(["/bin/sh", "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 1, ended.stderr
    (message,) = ended.stderr.splitlines()
    assert "hw recover" in message
    summary = json.loads((tmp_path / "o" / "summary.json").read_text(encoding="utf-8"))
    assert summary["end_state"] == "off"
    assert all(servo["torque"] is False for servo in summary["servos"])
    recovered = subprocess.run(command("hw", "recover", tmp_path / "o"), capture_output=True, timeout=120, check=False)
    assert recovered.returncode == 0, recovered.stderr
    assert len(Record.load(tmp_path / "o" / "measured.h5")) > 10


# -- the monotonic clock, in virtual time -----------------------------------------------------------------------------


class Stalling(Clock):
    """Clock of a program that stalls at ``at`` for ``seconds`` of the world's time.

    With ``suspended``, the program is stopped for this time, too.
    """

    def __init__(self, world: VirtualClock, at: float, seconds: float, *, suspended: bool) -> None:
        self.world, self.at, self.seconds, self.suspended = world, at, seconds, suspended

    def now(self) -> float:
        now = self.world.now()
        return now if now < self.at else max(self.at, now - self.seconds)

    def sleep_until(self, deadline: float) -> None:
        self.world.sleep_until(self.world.now() + max(0.0, deadline - self.now()))
        if self.suspended and self.at <= self.world.now() < self.at + self.seconds:
            self.world.sleep_until(self.at + self.seconds)


def stalled(run: Run, seconds: float, *, suspended: bool, policy: str = "decelerate") -> Run:
    """Run again with the clock of the program stalled in the motion."""
    clock = Stalling(run.clock, 1.9, seconds, suspended=suspended)
    run.replay = Replay(run.replay.motion, run.map, run.replay.bus, clock, policy=policy)  # type: ignore[arg-type]
    run.result = run.replay.run()
    return run


@pytest.mark.parametrize("policy", ["decelerate", "hold", "off"])
# Without a suspension the loop sleeps for one period more in each cycle: by 0.14 s after 1 s, 0.31 s after 5 s.
@pytest.mark.parametrize(
    ("suspended", "seconds", "tripped"),
    [(True, 0.05, False), (True, 1.0, True), (False, 0.05, False), (False, 1.0, False), (False, 5.0, True)],
)
@pytest.mark.parametrize("driven", [False, True])
def test_a_monotonic_clock_that_stalls(
    rig: Rig, driven: bool, seconds: float, suspended: bool, tripped: bool, policy: str
) -> None:
    run = prepared(rig) if driven else rig.prepare()
    if driven:
        feed_of(run).clock = Stalling(run.clock, 1.9, seconds, suspended=suspended)
    stalled(run, seconds, suspended=suspended, policy=policy)
    check_goals_within_limits(run)
    result = run.result
    if not tripped:
        assert result.fault is None, result.fault_text
        assert result.end_state == "off"
        return
    # The program cannot see that time passed, but the servos report that their watchdogs tripped.
    assert result.fault is not None
    assert result.fault.cause in (Cause.WATCHDOG, Cause.FOLLOWING_ERROR, Cause.MISSED_STATUS), result.fault_text
    assert "watchdog" in result.fault_text
    torque = [bool(servo["torque_enable"]) for servo in run.line.servos.registers.values()]
    assert [end.torque for end in result.servos] == torque
    assert result.end_state == ("off" if policy == "off" else "holding")
    assert len(result.record) > 10
