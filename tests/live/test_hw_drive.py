"""Live drives in processes: a raw client drives, virtual servos follow. No times are asserted."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from support.disturbed import WORLDS, disturb, fill, press_until_it_ends
from support.messages import mentions, says
from support.processes import wait_for
from support.teleop_clients import Client, Teleop
from websockets.exceptions import ConnectionClosed

from dynsim import Record, load_scenario, simulate
from dynsim.hardware.replay.check import check_motion
from dynsim.hardware.replay.output import ReplayState
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.servo_map import SHIPPED, load_servo_map
from dynsim.teleop.web.live import NOT_READY
from dynsim.teleop.web.pilot import RELEASED, SILENT

pytestmark = pytest.mark.long

# A busy machine may not run the loop for a while: patience where a real robot would abort.
MAP = """\
robot: six
bus: {baud: 1000000, rate: 50, latency: 0.2}
safety: {policy: decelerate, at_end: hold, watchdog: 2.0, missed_cycles: 25, late_cycles: 25, following_cycles: 25,
  torque_cycles: 25, approach_velocity: 1.0, start_distance: 2.0, supply: {lowest: 10.5, highest: 14.0}}
kinds:
  joint:
    model: MX-106
    mode: position
    follows: {position: q, velocity: v}
    limits: {position_deg: [-120, 120], velocity: 3.0, torque: 6.0}
    following_error: 0.3
servos:
  base_yaw: {kind: joint, id: 1}
  shoulder_pitch: {kind: joint, id: 2, sign: -1}
  elbow_pitch: {kind: joint, id: 3}
  forearm_roll: {kind: joint, id: 4}
  wrist_pitch: {kind: joint, id: 5}
  tool_roll: {kind: joint, id: 6}
"""
NARROW = MAP.replace("base_yaw: {kind: joint", "base_yaw: {kind: narrow").replace(
    "servos:",
    """\
  narrow:
    model: MX-106
    mode: position
    follows: {position: q, velocity: v}
    limits: {position_deg: [-2, 2], velocity: 3.0, torque: 6.0}
    following_error: 0.3
servos:""",
)
"""The base may turn by 2° either way."""


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """The kernels are compiled before anyone waits for them."""
    simulate(load_scenario("six_axis_arm", None, {"duration_s": 0.1}))


class Drive(Teleop):
    """A process of ``dynsim hw drive``."""

    @property
    def servos(self) -> Path:
        return self.folder / "servos"

    def simulation(self) -> int:
        """The process of the simulation."""
        own = [
            pid
            for pid in Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
            if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
        ]
        (simulation_pid,) = map(int, own)
        return simulation_pid

    def begin(self) -> Client:
        """A pilot, once the robot is where it begins."""
        client = self.connect()
        client.take()
        client.until("state", lambda state: state != NOT_READY)
        client.wish({}, held=False)
        return client

    def measured(self) -> tuple[Record, dict]:
        summary = json.loads((self.servos / "summary.json").read_text(encoding="utf-8"))
        return Record.load(self.servos / "measured.h5"), summary

    def ended(self, code: int) -> None:
        assert self.finish() == code, self.said
        # The helper process of multiprocessing ends when it sees that the drive has ended.
        wait_for(self.group_is_gone, failure="a process is left")


@pytest.fixture
def drives(tmp_path: Path) -> Iterator[Callable[..., Drive]]:
    """Starts drives of an arm; none of them is left running."""
    started: list[Drive] = []

    def starts(*arguments: str, text: str = MAP, port: str = "virtual", scenario: str = "six_axis_arm") -> Drive:
        (tmp_path / "six.yaml").write_text(text, encoding="utf-8")
        words = (scenario, "--map", str(tmp_path / "six.yaml"), "--port", port, *arguments)
        drive = Drive(tmp_path / "drive", *words, command=("hw", "drive"))
        started.append(drive)
        return drive

    yield starts
    for drive in started:
        if drive.process.poll() is None:
            os.killpg(drive.process.pid, signal.SIGKILL)
            drive.process.wait()
        if drive.process.stdout is not None:
            drive.process.stdout.close()


def pull(client: Client, axes: dict[str, float], distance: float) -> None:
    """Drive until the hand has gone so far [m]; a busy machine may seem to be silent on the way."""
    begun, state = None, ""
    while True:
        client.wish(axes, held=state != "silent")
        frame = client.until("hand")
        hand, state = np.array(frame["hand"]), frame["state"]
        begun = hand if begun is None else begun
        if np.abs(hand - begun).max() > distance:
            return


def followed(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Time of the simulation and goals, in the cycles of the drive."""
    rows = np.isfinite(record["record_time"])
    time, goals = record["record_time"][rows], record["q_goal"][rows]
    period = 1.0 / 50.0
    assert np.diff(time).min() >= 0.0
    # Whatever was late: from goal to goal never more than a period of the simulation. A cycle in which the port failed
    # has sent its goals and left no row.
    struck = record["state"][rows][1:] == ReplayState.FAULT
    assert (np.diff(time) <= np.where(struck, 2.0, 1.0) * period * (1.0 + 1e-9)).all()
    return time, goals


def check_against_the_simulation(drive: Drive, *, in_trouble: bool = False) -> Record:
    """The goals are where the simulation was, until servos are in trouble; its script gives it again."""
    simulated, (measured, _) = Record.load(drive.folder / "record.h5"), drive.measured()
    time, goals = followed(measured)
    expected = np.column_stack([np.interp(time, simulated.time, column) for column in simulated["q"].T])
    if in_trouble:
        well = measured["state"][np.isfinite(measured["record_time"])] == ReplayState.REPLAY
        goals, expected = goals[well], expected[well]
    # Error of a chord over 5 ms at the 6.5 rad/s² with which the arm sags at first: 2.0e-5 rad; a tick is 1.5e-3.
    assert goals == pytest.approx(expected, abs=5e-5)
    again = simulate(load_scenario(drive.folder / "scenario.yaml"))
    for name in simulated:
        assert np.array_equal(simulated[name], again[name], equal_nan=True), name
    return simulated


def test_servos_follow_a_pilot_and_leave_a_run(drives: Callable[..., Drive]) -> None:
    drive = drives()
    client = drive.begin()
    pull(client, {"y": 1.0}, 0.05)
    pull(client, {"z": -1.0}, 0.02)
    client.say(do="end")
    drive.ended(0)
    simulated = check_against_the_simulation(drive)
    measured, summary = drive.measured()
    assert summary["end_state"] == "holding"
    assert measured.complete
    assert measured["state"][-1] == ReplayState.SETTLE
    assert followed(measured)[0][-1] == pytest.approx(simulated.time[-1], abs=0.006)
    assert np.ptp(measured["q"], axis=0).max() > 0.05
    assert b"measured" in (drive.folder / "view.html").read_bytes()
    compared = dynsim("hw", "compare", drive.folder / "record.h5", drive.servos / "measured.h5")
    assert compared.returncode == 0, compared.stderr
    comparison = json.loads((drive.servos / "comparison.json").read_text(encoding="utf-8"))
    assert 0.02 < comparison["delay_s"] < 0.08  # 43.5 ms by the law of the motors
    assert "hw compare" in drive.said


def dynsim(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dynsim", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize("how", ["silent", pytest.param("gone", marks=pytest.mark.slow)])
def test_a_pilot_who_says_nothing_stops_the_servos(drives: Callable[..., Drive], how: str) -> None:
    drive = drives()
    client = drive.begin()
    pull(client, {"y": 1.0}, 0.03)
    if how == "gone":
        client.close()
        client = drive.connect()
    else:
        client.until("state", lambda state: state == "silent")
    # It comes to rest in 0.2 s, and stays there.
    at = client.until("time")["time"]
    client.until("time", lambda now: now > at + 1.2)
    if how == "gone":
        client.take()
    else:
        client.wish({}, held=False)
    pull(client, {"y": -1.0}, 0.02)
    client.say(do="end")
    drive.ended(0)
    check_against_the_simulation(drive)
    time, goals = followed(drive.measured()[0])
    still = (time > at + 0.3) & (time < at + 1.1)
    assert still.sum() > 20
    # What its gravity and its controller still do.
    assert np.ptp(goals[still], axis=0).max() < 2e-4
    assert np.ptp(goals[time > at + 1.2], axis=0).max() > 5e-3


def test_a_pilot_cannot_leave_the_limits_of_the_map(drives: Callable[..., Drive]) -> None:
    drive = drives(text=NARROW)
    client = drive.begin()
    with pytest.raises(ConnectionClosed):
        pull(client, {"y": 1.0}, np.inf)
    # The pilot looks at the page, not at the terminal.
    assert mentions(client.over, Cause.LIMIT, "base_yaw", "position")
    drive.ended(4)
    assert mentions(" ".join(drive.said.split()), "base_yaw", "position")
    record, summary = drive.measured()
    assert summary["fault"] == "limit"
    assert summary["end_state"] == "holding"
    goals = followed(record)[1][:, 0]
    assert 0.8 * np.radians(2.0) < np.abs(goals).max() <= np.radians(2.0)
    check_against_the_simulation(drive)


def test_ctrl_c_stops_and_a_second_one_releases(drives: Callable[..., Drive], tmp_path: Path) -> None:
    drive = drives()
    client = drive.begin()
    client.drive({"y": 1.0}, 0.6)
    drive.process.send_signal(signal.SIGINT)
    drive.ended(130)
    assert drive.measured()[1]["end_state"] == "holding"
    check_against_the_simulation(drive)
    (tmp_path / "drive").rename(tmp_path / "first")
    two = drives()
    two.begin().drive({"y": 1.0}, 0.3)
    two.process.send_signal(signal.SIGINT)
    wait_for(lambda: "FAULT" in (two.servos / "replay.log").read_text() or two.process.poll() is not None)
    two.process.send_signal(signal.SIGINT)
    two.ended(130)
    assert two.measured()[1]["end_state"] in ("off", "holding")  # the second may come when it is over
    assert (two.folder / "record.h5").exists()


def test_servos_are_not_armed_before_a_pilot_is_connected(drives: Callable[..., Drive]) -> None:
    drive = drives()
    # The page is served, but no browser has opened it.
    time.sleep(1.0)
    assert drive.process.poll() is None
    assert not drive.servos.exists()
    drive.process.send_signal(signal.SIGINT)
    drive.ended(130)
    assert not drive.servos.exists()


def test_a_terminal_sends_its_ctrl_c_to_all_processes(drives: Callable[..., Drive]) -> None:
    drive = drives()
    drive.begin().drive({"y": 1.0}, 0.4)
    os.killpg(drive.process.pid, signal.SIGINT)
    drive.ended(130)
    assert drive.measured()[1]["end_state"] == "holding"
    check_against_the_simulation(drive)


def test_a_simulation_that_stands_still_makes_no_burst(drives: Callable[..., Drive]) -> None:
    drive = drives()
    client = drive.begin()
    pull(client, {"y": 1.0}, 0.03)
    simulation, log = drive.simulation(), drive.servos / "replay.log"
    os.kill(simulation, signal.SIGSTOP)
    lines = len(log.read_text().splitlines())
    # A line in every second.
    wait_for(lambda: len(log.read_text().splitlines()) >= lines + 3)
    os.kill(simulation, signal.SIGCONT)
    pull(client, {"y": 1.0}, 0.02)
    client.say(do="end")
    drive.ended(0)
    check_against_the_simulation(drive)
    measured, _ = drive.measured()
    time, _ = followed(measured)
    assert (np.diff(time) < 1e-9).sum() > 50, "it has stood still"


def test_a_simulation_that_is_killed_ends_the_drive_by_the_policy(drives: Callable[..., Drive]) -> None:
    drive = drives()
    drive.begin().drive({"y": 1.0}, 0.4)
    os.kill(drive.simulation(), signal.SIGKILL)
    drive.ended(4)
    said = " ".join(drive.said.split())
    assert says(said, "simulation gone")
    assert not (drive.folder / "record.h5").exists()
    record, summary = drive.measured()
    assert summary["fault"] == "simulation"
    assert summary["end_state"] == "holding"
    followed(record)


def test_servos_that_are_gone_end_the_simulation(drives: Callable[..., Drive]) -> None:
    drive = drives()
    client, time_s = drive.begin(), 0.0
    while time_s < 0.3:  # simulated time, which lags behind the clock on a busy machine
        client.wish({"y": 1.0})
        time_s = client.until("time")["time"]
    drive.process.kill()
    drive.process.wait()
    wait_for(drive.group_is_gone, failure="the simulation goes on")
    assert Record.load(drive.folder / "record.h5").time[-1] >= 0.2


@pytest.mark.parametrize(("policy", "end"), [("decelerate", "mixed: 5 holding; elbow_pitch limp"), ("off", "")])
def test_a_fault_of_a_servo_ends_the_drive_by_the_policy(
    drives: Callable[..., Drive], tmp_path: Path, policy: str, end: str
) -> None:
    faults = tmp_path / "faults.yaml"
    faults.write_text("faults:\n  - {kind: overload, id: 3, at: 3.0}\n", encoding="utf-8")
    drive = drives("--faults", str(faults), "--policy", policy)
    client = drive.begin()
    with pytest.raises(ConnectionClosed):
        pull(client, {"y": 0.3}, np.inf)
    drive.ended(4)
    _, summary = drive.measured()
    assert summary["fault"] == Cause.ALERT
    assert summary["end_state"].startswith(end)
    assert all(servo["torque"] == (policy != "off" and servo["id"] != 3) for servo in summary["servos"])
    check_against_the_simulation(drive, in_trouble=True)


def test_hw_stop_releases_a_robot_that_is_driven(drives: Callable[..., Drive], tmp_path: Path) -> None:
    """Through a serial port, from where it stands: who holds the key while it moves to its start drives nothing."""
    device, table = tmp_path / "ttyDXL", tmp_path / "six.yaml"
    table.write_text(MAP, encoding="utf-8")
    command = [sys.executable, "-m", "dynsim", "hw", "virtual", "--map", str(table), "--link", str(device)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as virtual:
        try:
            assert virtual.stdout is not None
            assert mentions(virtual.stdout.readline(), "6")
            drive = drives("--live", "--yes", port=str(device))
            client = drive.connect()
            client.take()
            states: list[str] = []
            # A robot that was ready before the first command is driven at once.
            while not {RELEASED, "driving"} & {*states}:
                # On a busy machine the pilot may seem to be silent, which lasts until the key is released.
                client.wish({"y": 1.0}, held=states[-1:] != [SILENT])
                states.append(client.until("state")["state"])
            assert "driving" not in states or states.count(NOT_READY) < 3
            client.wish({}, held=False)
            client.drive({"y": 1.0}, 0.3)
            client.until("state", lambda state: state == "driving")
            stopped = dynsim("hw", "stop", "--port", device, "--map", table)
            # 3: torque off was sent, but the drive received the answers of some servos.
            assert stopped.returncode in (0, 3), stopped.stderr
            drive.ended(4)
        finally:
            virtual.kill()
    # By which rule it was noticed depends on who got whose answers.
    assert drive.measured()[1]["end_state"] == "off"
    check_against_the_simulation(drive, in_trouble=True)


def test_a_real_port_is_a_dry_run_without_live(drives: Callable[..., Drive], tmp_path: Path) -> None:
    device, table = tmp_path / "ttyDXL", tmp_path / "six.yaml"
    table.write_text(MAP, encoding="utf-8")
    command = [sys.executable, "-m", "dynsim", "hw", "virtual", "--map", str(table), "--link", str(device)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as virtual:
        try:
            assert virtual.stdout is not None
            assert mentions(virtual.stdout.readline(), "6")
            arguments = ("six_axis_arm", "--map", table, "--port", device, "--out", tmp_path / "out")
            dry = dynsim("hw", "drive", *arguments)
            assert dry.returncode == 0, dry.stderr
            assert "--live" in dry.stdout
            assert not (tmp_path / "out" / "record.h5").exists()
        finally:
            virtual.kill()


SNAKE = (SHIPPED / "snake.yaml").read_text(encoding="utf-8")
for patient in (
    ("latency: 0.002 ", "latency: 0.2 "),
    ("rate: 200 ", "rate: 50 "),
    ("watchdog: 0.2 ", "watchdog: 2.0 "),
    ("policy: decelerate", "missed_cycles: 25\n  late_cycles: 25\n  following_cycles: 25\n  policy: decelerate"),
    # A key that seems to be released for a moment stops the wheels.
    ("limits: {velocity: 5.0, torque: 1.8}", "limits: {velocity: 5.0, torque: 1.8, shaking: 20.0}"),
):
    assert patient[0] in SNAKE
    SNAKE = SNAKE.replace(*patient)


def keep_driving(client: Client, axes: dict[str, float], until_mode: int) -> None:
    """A request waits for as long as the key is held; a busy machine may seem to be silent, so it is said again."""
    mode, state = 0, ""
    while mode != until_mode:
        client.wish(axes, held=state != "silent", mode=until_mode)
        frame = client.until("mode")
        mode, state = frame["mode"], frame["state"]


def test_a_snake_changes_its_modes(drives: Callable[..., Drive]) -> None:
    """Keys that follow too soon wait, and so does the end: the record is one that can be replayed."""
    drive = drives(text=SNAKE, scenario="snake_operator")
    client = drive.begin()
    client.drive({"x": 1.0}, 0.4)
    keep_driving(client, {"x": 1.0}, until_mode=4)
    keep_driving(client, {"gamma": 1.0}, until_mode=2)
    client.drive({"x": 1.0}, 0.04, mode=3)
    client.say(do="end")
    drive.ended(0)
    simulated = Record.load(drive.folder / "record.h5")
    assert set(simulated["mode"].tolist()) >= {1, 2, 4}
    servo_map = load_servo_map(drive.folder.parent / "six.yaml")
    path = check_motion(simulated, servo_map).path
    measured, summary = drive.measured()
    assert summary["end_state"] == "holding"
    rows = np.isfinite(measured["record_time"])
    time, goals = measured["record_time"][rows], measured["phi_goal"][rows]
    joints = [servo_map.joints.index(name) for name in measured.labels["phi_goal"]]
    np.testing.assert_allclose(goals, np.array([path.at(t)[0][joints] for t in time]), rtol=0, atol=1e-12)
    assert time[-1] == pytest.approx(simulated.time[-1])
    compared = dynsim("hw", "compare", drive.folder / "record.h5", drive.servos / "measured.h5")
    assert compared.returncode == 0, compared.stderr


def test_a_map_that_does_not_say_how_wheels_are_lifted_is_refused(tmp_path: Path) -> None:
    """A snake with its wheels on the ground would be dragged over it; an arm has no wheels."""
    for name, table, names in (
        ("snake_operator", "arm", ["lifts"]),
        ("six_axis_arm", "snake", ["lifts.signal", "'grounded'"]),
    ):
        refused = dynsim("hw", "drive", name, "--map", table, "--port", "virtual", "--out", tmp_path / "out")
        assert refused.returncode == 2
        assert mentions(" ".join(refused.stderr.split()), *names)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "text", "names"),
    [
        (("--port", "/dev/null", "--faults", "f.yaml"), MAP, ["--faults", "--port virtual"]),
        (
            ("--port", "virtual"),
            MAP.replace("tool_roll:", "tail:"),
            ["six.yaml:18: servos.tail", "'tail'", "'q'"],
        ),
        (("--port", "virtual", "--rate", "4000"), MAP, ["--rate"]),
        (
            ("--port", "virtual"),
            MAP.replace("[-120, 120]", "[-45, 45]"),
            ["2", "elbow_pitch", "position", "1.0472 rad"],
        ),
        (("--port", "/dev/nothing"), MAP, ["/dev/nothing"]),
    ],
)
def test_what_cannot_be_is_said_before_anything_moves(
    tmp_path: Path, arguments: tuple[str, ...], text: str, names: list[str]
) -> None:
    (tmp_path / "six.yaml").write_text(text, encoding="utf-8")
    refused = dynsim(
        "hw", "drive", "six_axis_arm", "--map", tmp_path / "six.yaml", *arguments, "--out", tmp_path / "out"
    )
    assert refused.returncode in (2, 3)
    assert mentions(" ".join(refused.stderr.split()), *names)
    assert "Traceback" not in refused.stderr
    assert not (tmp_path / "out" / "servos" / "measured.h5").exists()


@pytest.mark.parametrize("world", WORLDS)
def test_a_drive_keeps_its_cycle(
    drives: Callable[..., Drive], world: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disturb(world, tmp_path, monkeypatch)
    drive = drives()
    client = drive.begin()
    pull(client, {"y": 1.0}, 0.02)
    client.say(do="end")
    drive.ended(1 if world == "dead disk" else 0)
    check_against_the_simulation(drive)
    measured, summary = drive.measured()
    assert measured.complete
    assert "fault" not in summary
    # A cycle that waits for the slow disk takes a second.
    assert np.diff(measured.time).max() < 0.8
    assert summary["outputs_failed"].keys() == ({"streamed record"} if world == "dead disk" else set())


def test_a_drive_with_blocked_output_ends_at_ctrl_c(drives: Callable[..., Drive]) -> None:
    drive = drives()
    assert drive.process.stdout is not None
    fill(drive.process.stdout.fileno())
    client = drive.begin()
    pull(client, {"y": 1.0}, 0.02)
    drive.process.send_signal(signal.SIGINT)
    # The robot stops, and everything is saved, before anything is printed.
    wait_for((drive.servos / "summary.json").exists)
    wait_for((drive.folder / "summary.json").exists)
    assert press_until_it_ends(drive.process) == 130
    wait_for(drive.group_is_gone, failure="a process is left")
    measured, summary = drive.measured()
    assert summary["end_state"] == "holding"
    assert summary["fault"] == Cause.INTERRUPTED.value
    assert len(measured) > 10
