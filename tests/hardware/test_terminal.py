"""Terminals that close, block or vanish, and signals, during a motion. No times are asserted."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.messages import check_message, lines_with, says
from support.processes import wait_for

from dynsim.hardware.replay.output import PART, ReplayState
from dynsim.record import Record

from .test_pseudo_terminal import Servos, command, virtual_servos

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("hang_ups")]


@pytest.fixture
def servos(tmp_path: Path) -> Iterator[Servos]:
    with virtual_servos(tmp_path) as servos:
        yield servos


class Terminal:
    """A replay on a terminal of its own; ``session``: the terminal controls it, as a window does a shell's."""

    def __init__(self, servos: Servos, *, controls: bool, speed: float = 0.4) -> None:
        self.servos = servos
        self.master, slave = pty.openpty()

        def enter() -> None:
            os.setsid()
            if controls:
                import fcntl
                import termios

                fcntl.ioctl(0, termios.TIOCSCTTY, 0)

        options = ("--live", "--yes", "--speed", speed)
        self.process = subprocess.Popen(
            servos.replay(*options),
            stdin=slave,
            stdout=slave,
            stderr=slave,
            preexec_fn=enter,
        )
        os.close(slave)
        wait_for(lambda: lines_with(servos.log, "REPLAY") or self.process.poll() is not None)
        assert self.process.poll() is None, os.read(self.master, 65536).decode(errors="replace")

    def close(self) -> None:
        os.close(self.master)

    def end(self) -> int:
        return self.process.wait(120)


def measured(servos: Servos) -> tuple[Record, dict]:
    summary = json.loads((servos.folder / "out" / "summary.json").read_text(encoding="utf-8"))
    return Record.load(servos.folder / "out" / "measured.h5"), summary


def completed(servos: Servos) -> dict[str, str]:
    """Gives the outputs that failed."""
    record, summary = measured(servos)
    assert record.complete
    assert summary["end_state"] == "off"
    assert np.nanmax(record["record_time"]) > 1.19
    assert servos.torque() == [0, 0, 0]
    return summary["outputs_failed"]


def test_a_terminal_that_goes_does_not_change_the_motion(servos: Servos) -> None:
    terminal = Terminal(servos, controls=False)
    terminal.close()
    assert terminal.end() == 1  # that standard output could not be written
    assert completed(servos) == {"standard output": "[Errno 5] Input/output error"}


def test_a_window_that_is_closed_is_a_controlled_stop(servos: Servos) -> None:
    terminal = Terminal(servos, controls=True)
    terminal.close()
    # The shell of the window sends the signal once more.
    os.kill(terminal.process.pid, signal.SIGHUP)
    assert terminal.end() in (130, 128 + signal.SIGHUP)
    record, summary = measured(servos)
    assert not record.complete
    assert summary["fault"] == "interrupted"
    assert summary["end_state"] == "holding"
    assert servos.torque() == [1, 1, 1]


def test_a_terminal_that_is_held_does_not_delay_the_motion(servos: Servos) -> None:
    terminal = Terminal(servos, controls=False)
    os.write(terminal.master, b"\x13")  # Ctrl-S: from here on every write waits
    wait_for(lambda: lines_with(servos.log[servos.log.index(" REPLAY ") :], "SETTLE"))
    terminal.close()
    assert terminal.end() == 1
    # The bar, too, where it was still waiting at the end.
    assert {"standard output"} <= completed(servos).keys() <= {"standard output", "progress bar"}


@pytest.mark.parametrize("closed", ["<&- >&- 2>&-", "</dev/null >/dev/full 2>/dev/full"])
def test_standard_streams_that_are_closed_or_full(servos: Servos, closed: str) -> None:
    arguments = " ".join(f"'{argument}'" for argument in servos.replay("--live", "--yes"))
    ended = subprocess.run(["/bin/sh", "-c", f"exec {arguments} {closed}"], timeout=120, check=False)
    if "full" in closed:
        # The motion went well, and what it had to tell was lost: told where it can be, and by the exit code.
        assert ended.returncode == 1
        assert completed(servos) == {"standard output": "[Errno 28] No space left on device"}
    else:
        assert ended.returncode == 0
        assert completed(servos) == {}


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGTSTP, 130), (signal.SIGQUIT, 130)]
)
def test_signals_stop_under_control_however_often_they_come(servos: Servos, number: int, code: int) -> None:
    terminal = Terminal(servos, controls=False, speed=0.1)
    for _ in range(3):
        os.kill(terminal.process.pid, number)
        time.sleep(0.05)
    assert terminal.end() in (130, code)
    terminal.close()
    assert measured(servos)[1]["end_state"] == "holding"
    assert servos.torque() == [1, 1, 1]


def test_signals_of_terminals_and_pipes_do_nothing(servos: Servos) -> None:
    terminal = Terminal(servos, controls=False)
    for number in (signal.SIGTTOU, signal.SIGTTIN, signal.SIGPIPE, signal.SIGXFSZ):
        os.kill(terminal.process.pid, number)
    assert terminal.end() == 0
    terminal.close()
    assert completed(servos) == {}


def test_nohup_is_heeded(servos: Servos) -> None:
    out = servos.folder / "nohup.out"
    with out.open("w") as file:
        process = subprocess.Popen(
            ["nohup", *servos.replay("--live", "--yes", "--speed", "0.4")], stdin=file, stdout=file, stderr=file
        )
    wait_for(lambda: lines_with(servos.log, "REPLAY"))
    process.send_signal(signal.SIGHUP)
    assert process.wait(120) == 0, out.read_text()
    assert completed(servos) == {}


def test_a_killed_replay_keeps_its_cycles(servos: Servos) -> None:
    folder = servos.folder / "out"
    terminal = Terminal(servos, controls=False, speed=0.1)
    size = (folder / PART).stat().st_size
    wait_for(lambda: (folder / PART).stat().st_size > size)
    os.kill(terminal.process.pid, signal.SIGKILL)
    terminal.end()
    terminal.close()
    plot = subprocess.run(command("plot", folder / "measured.h5"), capture_output=True, text=True, check=False)
    assert plot.returncode == 2
    assert f"dynsim hw recover {folder}" in " ".join(plot.stderr.split())
    recovery = subprocess.run(command("hw", "recover", folder), capture_output=True, text=True, check=False)
    assert recovery.returncode == 0, recovery.stderr
    assert says(recovery.stdout, "incomplete")
    recovered = Record.load(folder / "measured.h5")
    again = subprocess.run(command("hw", "recover", folder), capture_output=True, text=True, check=False)
    assert again.returncode == 2
    check_message(again.stderr, re.compile("^error: "), PART)
    assert not recovered.complete
    assert recovered["state"][-1] == ReplayState.REPLAY
    assert np.isfinite(recovered["record_time"][-1])
