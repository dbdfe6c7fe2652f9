"""Virtual servos behind a pseudo-terminal, client and commands in other processes. No times are asserted."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from dynamixel_sdk import COMM_SUCCESS, PortHandler, Protocol2PacketHandler
from support.messages import check_message, lines_with, mentions, raises
from support.processes import Child, started, wait_for

from dynsim.hardware.bus.control_table import MX_106
from dynsim.hardware.bus.dynamixel_bus import DynamixelBus, open_serial_port
from dynsim.hardware.bus.protocol import NoAnswer
from dynsim.hardware.errors import PortError
from dynsim.hardware.replay.output import ReplayState
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.virtual.line import PseudoTerminal, line_for_map
from dynsim.record import Record

from .conftest import MAP, Rig, swing

pytestmark = pytest.mark.long

F = MX_106.fields
# A busy machine may not run the servos for a while: patience where a real robot would abort.
PATIENT = MAP.replace("{baud: 1000000, rate: 100}", "{baud: 1000000, rate: 50, latency: 0.2}").replace(
    "safety: {", "safety: {watchdog: 2.0, missed_cycles: 25, late_cycles: 25, following_cycles: 25, "
)


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "dynsim", *map(str, arguments)]


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*arguments), capture_output=True, text=True, timeout=60, check=False)


class Servos:
    """Virtual servos in a process of their own."""

    def __init__(self, folder: Path, faults: str = "") -> None:
        self.folder = folder
        self.map, self.record, self.device = folder / "rig.yaml", folder / "record.h5", folder / "ttyDXL"
        self.map.write_text(PATIENT, encoding="utf-8")
        swing().save(self.record)
        script = []
        if faults:
            (folder / "faults.yaml").write_text(faults, encoding="utf-8")
            script = ["--faults", folder / "faults.yaml"]
        self.process = subprocess.Popen(
            command("hw", "virtual", "--map", self.map, "--link", self.device, *script),
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        self.greeting = self.process.stdout.readline()

    def replay(self, *options: object) -> list[str]:
        return command(
            "hw",
            "replay",
            self.record,
            "--map",
            self.map,
            "--port",
            self.device,
            "--out",
            self.folder / "out",
            *options,
        )

    @property
    def log(self) -> str:
        path = self.folder / "out" / "replay.log"
        return path.read_text(encoding="utf-8") if path.exists() else ""

    def torque(self) -> list[int]:
        bus = DynamixelBus(open_serial_port(str(self.device), 1_000_000, exclusive=False), latency=0.2)
        try:
            return [self._patiently(lambda id_=id_: bus.read(id_, F["torque_enable"])) for id_ in (1, 2, 7)]
        finally:
            bus.close()

    @staticmethod
    def _patiently(read: Callable[[], int]) -> int:
        """A computer with too much to do may not run the servos for longer than a client waits."""
        for _ in range(20):
            with suppress(NoAnswer):
                return read()
        raise AssertionError("no answer, twenty times")

    def end(self) -> int:
        """Exit code after one Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(timeout=20)


@contextmanager
def virtual_servos(folder: Path, faults: str = "") -> Iterator[Servos]:
    servos = Servos(folder, faults)
    try:
        assert mentions(servos.greeting, "3", "1000000")
        yield servos
    finally:
        servos.process.kill()
        servos.process.communicate(timeout=20)


@pytest.fixture
def servos(tmp_path: Path) -> Iterator[Servos]:
    with virtual_servos(tmp_path) as servos:
        yield servos
        assert servos.end() == 0
        assert not servos.device.is_symlink()


@contextmanager
def replaying(servos: Servos) -> Iterator[Child]:
    """A slow replay in a process of its own, in the middle of its motion."""
    with started(servos.replay("--live", "--yes", "--speed", "0.1"), servos.folder / "stderr") as child:
        wait_for(lambda: lines_with(servos.log, "REPLAY"))
        yield child


def test_the_stock_client_library_finds_the_servos(servos: Servos) -> None:
    port, library = PortHandler(str(servos.device)), Protocol2PacketHandler()
    assert port.setBaudRate(1_000_000)
    answered, result = library.broadcastPing(port)
    assert result == COMM_SUCCESS
    assert answered == {1: [321, 45], 2: [321, 45], 7: [30, 45]}
    port.setBaudRate(57_600)
    assert library.ping(port, 1)[1] != COMM_SUCCESS, "another bit rate is noise to the servos"
    port.closePort()
    scan = run("hw", "scan", "--port", servos.device, "--map", servos.map)
    assert scan.returncode == 0, scan.stderr
    assert mentions(scan.stdout, "3")


def test_without_live_a_real_port_is_a_dry_run(servos: Servos) -> None:
    dry = subprocess.run(servos.replay(), capture_output=True, text=True, timeout=60, check=False)
    assert dry.returncode == 0, dry.stderr
    assert "--live" in dry.stdout
    assert servos.torque() == [0, 0, 0]
    assert (servos.folder / "out" / "registers.json").exists()


def test_replay_over_a_serial_device(servos: Servos) -> None:
    live = subprocess.run(servos.replay("--live", "--yes"), capture_output=True, text=True, timeout=60, check=False)
    assert live.returncode == 0, live.stderr + servos.log
    measured = Record.load(servos.folder / "out" / "measured.h5")
    assert measured.complete
    replayed = measured["state"] == ReplayState.REPLAY
    assert replayed.sum() > 10
    assert np.nanmax(measured["q"][replayed]) > 0.4, "the servos moved"
    summary = json.loads((servos.folder / "out" / "summary.json").read_text(encoding="utf-8"))
    assert summary["end_state"] == "off"
    assert summary["timing"]["cycles"] == len(measured)
    assert servos.torque() == [0, 0, 0]


def test_a_second_replay_is_refused_and_stop_works_beside_the_first(servos: Servos) -> None:
    first = open_serial_port(str(servos.device), 1_000_000)
    with raises(PortError, str(servos.device)):
        open_serial_port(str(servos.device), 1_000_000)
    first.closePort()
    with replaying(servos) as running:
        again = servos.replay("--live", "--yes")
        second = subprocess.run(again, capture_output=True, text=True, timeout=60, check=False)
        assert second.returncode == 3
        check_message(second.stderr, re.compile("^error: "), str(servos.device))
        stop = run("hw", "stop", "--port", servos.device, "--map", servos.map)
        assert running.end() == 4, running.stderr
    assert servos.torque() == [0, 0, 0]
    assert stop.returncode in (0, 3)  # the replay may have taken the answers off the line


@pytest.mark.parametrize(("presses", "left"), [(1, [1, 1, 1]), (2, [0, 0, 0])])
def test_ctrl_c_in_a_running_replay(servos: Servos, presses: int, left: list[int]) -> None:
    with replaying(servos) as running:
        os.kill(running.process.pid, signal.SIGINT)
        for _ in range(presses - 1):
            # Two that come before the first is handled are one, and nothing is told before the robot is at rest.
            time.sleep(0.2)
            os.kill(running.process.pid, signal.SIGINT)
        assert running.end() == 130, running.stderr
    check_message(running.stderr, re.compile("^error: "), Cause.INTERRUPTED, "REPLAY")
    assert servos.torque() == left


@pytest.mark.parametrize(("policy", "left"), [("hold", [1, 1, 1]), ("off", [0, 0, 0])])
def test_a_replay_that_was_stopped_for_longer_than_the_watchdogs_names_it(
    servos: Servos, policy: str, left: list[int]
) -> None:
    with started(
        servos.replay("--live", "--yes", "--speed", "0.1", "--policy", policy), servos.folder / "stderr"
    ) as running:
        wait_for(lambda: lines_with(servos.log, "REPLAY"))
        os.kill(running.process.pid, signal.SIGSTOP)
        time.sleep(2.5)
        os.kill(running.process.pid, signal.SIGCONT)
        assert running.end() == 4, running.stderr
    left_as = "holding" if policy == "hold" else "off"
    check_message(running.stderr, re.compile("^error: "), Cause.STALL, "REPLAY", "2.00 s", left_as)
    assert servos.torque() == left


def test_an_adapter_pulled_out_ends_the_replay(tmp_path: Path) -> None:
    with virtual_servos(tmp_path, "faults: [{kind: unplug, at: 2.0}]") as servos:
        slowly = servos.replay("--live", "--yes", "--speed", "0.1")
        live = subprocess.run(slowly, capture_output=True, text=True, timeout=60, check=False)
        assert live.returncode == 4, live.stderr
        check_message(live.stderr, re.compile("^error: "), Cause.PORT, "unreachable")
        assert servos.process.wait(timeout=20) == 0


def test_the_link_of_running_servos_is_neither_taken_over_nor_removed(rig: Rig, tmp_path: Path) -> None:
    link = tmp_path / "ttyDXL"
    first = PseudoTerminal(line_for_map(rig.map), link)
    with raises(PortError, str(first.device)):
        PseudoTerminal(line_for_map(rig.map), link)
    assert os.readlink(link) == first.device
    # Somebody else's by the time it ends.
    link.unlink()
    link.symlink_to("/dev/null")
    first.close()
    assert os.readlink(link) == "/dev/null"


def test_a_link_that_leads_nowhere_is_replaced_and_removed(rig: Rig, tmp_path: Path) -> None:
    link = tmp_path / "ttyDXL"
    link.symlink_to("/dev/pts/none")
    terminal = PseudoTerminal(line_for_map(rig.map), link)
    assert os.readlink(link) == terminal.device
    terminal.close()
    assert not link.is_symlink()
