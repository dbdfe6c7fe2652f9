"""Ctrl-C and other signals in every state of a replay: one for a controlled stop, a second one for torque off."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.messages import check_message, raises

from dynsim.errors import SimulationStopped
from dynsim.hardware.bus.packet import Instruction, Packet
from dynsim.hardware.errors import ReplayAborted
from dynsim.hardware.replay.output import UNARMED, ReplayProgress, ReplayState, StopRequest, stop_on_signals
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.replay.session import run_replay
from dynsim.record import Record

from .conftest import Run, check_goals_within_limits

ON_THE_WAY = [
    ReplayState.CONNECT,
    ReplayState.VERIFY,
    ReplayState.ARM,
    ReplayState.MOVE_TO_START,
    ReplayState.SETTLE,
    ReplayState.REPLAY,
    ReplayState.DISARM,
]


def interrupted(rig, state: ReplayState, signals: list[int], *, policy: str = "decelerate", after: int = 1):
    """Run with real signals raised at the ``after``-th report from ``state``."""
    stop = StopRequest()
    run = rig.prepare(stop=stop, policy=policy)
    seen = 0

    def observe(progress: ReplayProgress) -> None:
        nonlocal seen
        if progress.state == state:
            seen += 1
            if seen == after:
                for number in signals:
                    os.kill(os.getpid(), number)

    run.replay.journal.observer = observe
    with stop_on_signals(stop):
        run.result = run.replay.run()
    assert stop.count == len(signals)
    return run


def broadcast_torque_off(run) -> list[float]:
    """Times of the packets that switch torque off for everybody."""
    return [
        time
        for time, packet in run.sent
        if packet.instruction == Instruction.WRITE and packet.id == 254 and packet.parameters == b"\x40\x00\x00"
    ]


# Each state with one policy, in turn, in the default tests.
@pytest.mark.parametrize(
    ("state", "policy"),
    [
        pytest.param(state, policy, marks=() if (number + k) % 3 == 0 else pytest.mark.long)
        for number, state in enumerate(ON_THE_WAY)
        for k, policy in enumerate(["hold", "decelerate", "off"])
    ],
    ids=lambda value: getattr(value, "name", value),
)
def test_second_ctrl_c_switches_the_torque_off_at_every_state(rig, state: ReplayState, policy: str) -> None:
    run = interrupted(rig, state, [signal.SIGINT, signal.SIGINT], policy=policy)
    assert len(broadcast_torque_off(run)) >= 3
    assert run.result.end_state == "off"
    assert run.result.torque_still_on == ()
    assert not any(servo["torque_enable"] for servo in run.line.servos.registers.values())
    assert not run.result.policy_goals or run.result.fault_state == ReplayState.DISARM


@pytest.mark.parametrize("state", ON_THE_WAY, ids=lambda state: state.name)
def test_first_ctrl_c_is_a_controlled_stop(rig, state: ReplayState) -> None:
    run = interrupted(rig, state, [signal.SIGINT])
    torque = [servo["torque_enable"] for servo in run.line.servos.registers.values()]
    if state == ReplayState.DISARM:
        # The motion is over: disarming goes on to its end.
        assert run.result.fault is None
        assert not any(torque)
        return
    assert run.result.fault.cause == Cause.INTERRUPTED
    assert run.result.fault_state == state
    if state in (ReplayState.CONNECT, ReplayState.VERIFY):
        assert run.result.end_state == "not armed"
        assert not broadcast_torque_off(run), "a robot that is held by an earlier run must not fall"
        assert not run.goals()
    elif state == ReplayState.ARM:
        assert run.result.end_state == "off"
        assert not any(torque)
    else:
        assert run.result.end_state == "holding"
        assert all(torque)
        run.line.advance(run.line.time + 1.0)
        assert np.abs(run.line.servos.plant.velocity).max() < 1e-2


# Those nobody survives, those of terminals and pipes (below), of jobs that go on, and of broken programs.
UNHEEDED = {
    "SIGKILL",
    "SIGSTOP",
    "SIGPIPE",
    "SIGTTIN",
    "SIGTTOU",
    "SIGXFSZ",
    "SIGCHLD",
    "SIGCONT",
    "SIGURG",
    "SIGWINCH",
}
# Those that people and systems send to end a process.
SENT = {"SIGTERM", "SIGHUP", "SIGQUIT", "SIGXCPU", "SIGUSR1"}
BROKEN = {"SIGSEGV", "SIGBUS", "SIGILL", "SIGFPE", "SIGABRT", "SIGTRAP", "SIGSYS"}


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(number, marks=() if number.name in SENT else pytest.mark.long)
        for number in signal.Signals
        if number.name not in {"SIGINT", "SIGRTMIN", "SIGRTMAX"} | UNHEEDED | BROKEN
    ],
    ids=lambda number: number.name,
)
@pytest.mark.usefixtures("hang_ups")
def test_other_signals_stop_like_ctrl_c(rig, number: int) -> None:
    run = interrupted(rig, ReplayState.REPLAY, [number], after=30)
    assert run.result.fault.cause == Cause.INTERRUPTED
    assert run.result.end_state == "holding"


def test_ctrl_c_under_the_policy_off_comes_to_rest_before_it_releases(rig) -> None:
    run = interrupted(rig, ReplayState.REPLAY, [signal.SIGINT], policy="off", after=30)
    assert run.result.end_state == "off"
    moved = [value for _, id_, value in run.result.policy_goals if id_ == 7]
    assert moved[-1] == 0
    assert min(broadcast_torque_off(run)) > run.result.policy_goals[-1][0]


def test_second_ctrl_c_during_the_controlled_stop_releases_at_once(rig) -> None:
    stop = StopRequest()
    run = rig.prepare(stop=stop)
    reads = 0

    def listen(time: float, packet: Packet) -> None:
        nonlocal reads
        run.sent.append((time, packet))
        if run.replay.journal.state in (ReplayState.REPLAY, ReplayState.FAULT):
            reads += packet.instruction == Instruction.SYNC_READ
            if (reads, stop.count) in ((60, 0), (72, 1)):
                stop()

    run.line.listener = listen
    result = run.replay.run()
    assert result.end_state == "off"
    assert not any(servo["torque_enable"] for servo in run.line.servos.registers.values())
    run.line.advance(run.line.time + 2 * run.map.safety.watchdog)
    left = [servo["bus_watchdog"] for servo in run.line.servos.registers.values()]
    assert left == [0, 0, 0], "the next one finds goals that can be written"
    last_goal = max(time for time, _, _ in run.goals())
    assert min(broadcast_torque_off(run)) > last_goal
    assert last_goal - result.fault_time < run.map.safety.stop_time / 2


def test_handlers_are_given_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    with stop_on_signals(StopRequest()):
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
def test_an_exception_out_of_the_blue_still_stops_the_robot(rig, tmp_path: Path, error: type[BaseException]) -> None:
    """Without the signal handlers a Ctrl-C lands in the middle of a read: the policy is carried out all the same."""
    run = rig.prepare(policy="off")
    read = run.replay.bus.port.readPort

    def read_port(length: int) -> bytes:
        if run.clock.now() > 1.9 and not thrown:
            thrown.append(run.clock.now())
            raise error("out of the blue")
        return read(length)

    thrown: list[float] = []
    run.replay.bus.port.readPort = read_port
    with pytest.raises(error):
        run_replay(rig.motion(), rig.map, nullcontext((run.replay.bus, run.clock)), tmp_path, live=True, policy="off")
    assert thrown
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert (summary["faults"][0]["cause"], summary["end_state"]) == (Cause.PROGRAM.value, "off")
    assert not any(servo["torque_enable"] for servo in run.line.servos.registers.values())
    assert len(Record.load(tmp_path / "measured.h5")) > 10


def failing_port(run: Run, at: int) -> SimpleNamespace:
    """Let the ``at``-th call of the port raise an error that nothing expects; the namespace counts the calls."""
    port, calls = run.replay.bus.port, SimpleNamespace(count=0)

    def wrapped(method: Callable[..., Any]) -> Callable[..., Any]:
        def call_port(*arguments: Any) -> Any:
            calls.count += 1
            if calls.count == at:
                raise ZeroDivisionError("out of the blue " * 20)
            return method(*arguments)

        return call_port

    port.readPort, port.writePort = wrapped(port.readPort), wrapped(port.writePort)
    return calls


@pytest.mark.parametrize("share", [0.0, 0.02, 0.1, 0.3, 0.32, 0.34, 0.4, 0.6, 0.8, 0.9, 0.96, 0.98, 0.995])
def test_an_error_at_any_exchange_is_a_fault_with_end_state_and_record(rig, tmp_path: Path, share: float) -> None:
    whole = rig.prepare()
    calls = failing_port(whole, 0)
    whole.replay.run()
    run = rig.prepare()
    failing_port(run, 1 + int(share * (calls.count - 1)))
    with raises(ReplayAborted, "ZeroDivisionError", "end state") as error:
        run_replay(rig.motion(), rig.map, nullcontext((run.replay.bus, run.clock)), tmp_path, live=True)
    assert len(str(error.value).splitlines()) == 1
    result = error.value.result
    assert result.fault.cause == Cause.PROGRAM
    assert "Traceback" in (tmp_path / "replay.log").read_text(encoding="utf-8")
    assert not Record.load(tmp_path / "measured.h5").complete
    torque = [bool(servo["torque_enable"]) for servo in run.line.servos.registers.values()]
    if result.fault_state in UNARMED:
        assert (result.end_state, any(torque)) == ("not armed", False)
    else:
        assert result.end_state == ("holding" if all(torque) else "off")
        assert [servo.torque for servo in result.servos] == torque
    check_goals_within_limits(run)


def test_a_simulated_robot_that_stops_is_a_fault_with_a_record(rig) -> None:
    run = rig.prepare(policy="hold")
    step, stops = run.line.servos.plant.step, []

    def stopping(dt: float, drive: Any) -> None:
        if run.replay.journal.state == ReplayState.REPLAY and run.clock.now() > 1.9 and not stops:
            stops.append(SimulationStopped("stopped at t = 1.9 s: the contact at tip opens and closes"))
            raise stops[0]
        step(dt, drive)

    run.line.servos.plant.step = stopping
    result = run.replay.run()
    assert result.fault.cause == Cause.SIMULATION
    check_message(result.fault.text, "--plant", str(stops[0]))
    assert len(result.record)
    assert result.end_state == "holding"


def test_a_robot_found_holding_is_not_dropped_by_a_ctrl_c_while_arming(rig) -> None:
    stop = StopRequest()
    run = rig.prepare(stop=stop)
    for id_ in run.map.ids:
        run.line.servos.write(id_, 64, b"\1")
    run.replay.journal.observer = lambda progress: stop() if progress.state == ReplayState.ARM else None
    result = run.replay.run()
    assert result.fault_state == ReplayState.ARM
    assert result.end_state == "holding"
    assert all(servo["torque_enable"] for servo in run.line.servos.registers.values())
