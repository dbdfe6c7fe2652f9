"""Types of a replay: states, stop request and its signal handlers, progress, timing statistics, result."""

from __future__ import annotations

import math
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from enum import IntEnum
from typing import Any

from dynsim.hardware.bus.control_table import describe_hardware_error
from dynsim.hardware.replay.rules import Cause, Fault
from dynsim.hardware.replay.verify import LimitRow
from dynsim.record import Record


class ReplayState(IntEnum):
    """Where the replay is; recorded cycle by cycle."""

    CONNECT = 0
    VERIFY = 1
    ARM = 2
    MOVE_TO_START = 3
    SETTLE = 4
    REPLAY = 5
    DISARM = 6
    FAULT = 7
    DRY_RUN = 8


UNARMED = (ReplayState.CONNECT, ReplayState.VERIFY, ReplayState.DRY_RUN)

NOT_ARMED = "not armed"

HOLDING, LIMP, MOVING = "holding", "limp: off", "moving"
SILENT, TRIPPED = "does not answer", "watchdog tripped"
WHOLE = {HOLDING: "holding", LIMP: "off", SILENT: "unreachable"}
"""End state of the robot where all its servos have the same one; other states keep their names."""


class StopRequest:
    """Counts the user's Ctrl-C (or other signals): the first asks for a controlled stop, the second for torque off."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, *_: Any) -> None:
        self.count += 1

    @property
    def for_release(self) -> bool:
        """The user wants torque off, now."""
        return self.count >= 2

    def check(self) -> None:
        """Raises Stopped when the user has asked for a stop."""
        if self.count:
            raise Stopped(Fault(Cause.INTERRUPTED, "stopped by the user"))


def _there(*names: str) -> list[signal.Signals]:
    return [getattr(signal, name) for name in names if hasattr(signal, name)]


# Of these only the first counts. When a terminal is closed both the system and the shell send SIGHUP, and `timeout`
# sends SIGTERM to the process and to its group: nobody has asked twice, and a robot that is let go falls.
# The others would end the process, and leave a moving robot to its watchdogs.
_ONCE = _there(
    "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGVTALRM", "SIGPROF", "SIGXCPU",
    "SIGIO", "SIGPWR", "SIGSTKFLT",
)  # fmt: skip
# Of a terminal that the process may not write to or that is gone, and of a disk quota: the write fails, nothing else.
_PASSED_OVER = _there("SIGTTOU", "SIGTTIN", "SIGPIPE", "SIGXFSZ")


@contextmanager
def stop_on_signals(stop: StopRequest) -> Iterator[None]:
    """Signals only count up ``stop``: an exception out of a handler would tear a bus transaction in two.

    Ctrl-C counts every time; SIGTERM, SIGHUP, SIGQUIT (Ctrl-\\), SIGTSTP (Ctrl-Z, which would leave a moving robot
    without goals) and all others by which a process ends ask for the controlled stop only. A SIGHUP
    that is ignored (``nohup``) stays so.
    """

    def ask_once(*_: Any) -> None:
        stop.count = max(stop.count, 1)

    handlers: dict[signal.Signals, Any] = {signal.SIGINT: stop}
    handlers |= dict.fromkeys(_ONCE, ask_once) | dict.fromkeys(_PASSED_OVER, signal.SIG_IGN)
    for number in _there("SIGHUP"):
        if signal.getsignal(number) == signal.SIG_IGN:
            del handlers[number]
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            # None: set by C code, which Python cannot give back.
            if handler is not None:
                signal.signal(number, handler)


def ignore_stops() -> None:
    """Of a process that ends when another one says so: the signals that ask that one for a stop mean nothing here."""
    for number in (signal.SIGINT, *_ONCE):
        signal.signal(number, signal.SIG_IGN)


@dataclass(frozen=True)
class ReplayProgress:
    """What a display may show after every cycle.

    Attributes
    ----------
    state : ReplayState
    fraction : float
        Of the current motion, 0 to 1.
    following_error : float
        Worst of all joints [rad].
    temperature : float
        Hottest servo [°C], NaN before it is known.
    """

    state: ReplayState
    fraction: float
    following_error: float
    temperature: float


@dataclass(frozen=True)
class ServoEnd:
    """One servo at the end.

    Attributes
    ----------
    joint : str
    id : int
    torque : bool or None
        Whether it is on; None, as all that follows, where the servo did not answer.
    error : int or None
        Hardware error register.
    position, velocity : float or None
        Of the joint [rad], [rad/s].
    doing : str
        "holding", "limp: off", "limp: <hardware error>", "moving", "watchdog tripped" or "does not answer".
    """

    joint: str
    id: int
    torque: bool | None = None
    error: int | None = None
    position: float | None = None
    velocity: float | None = None
    doing: str = SILENT

    def as_dict(self) -> dict[str, Any]:
        """With units in the names, for summaries."""
        values = asdict(self)
        values["position_rad"], values["velocity_rad_s"] = values.pop("position"), values.pop("velocity")
        return values

    def __str__(self) -> str:
        text = f"{self.joint} (ID {self.id}): {self.doing}"
        if self.error:
            text += f", error: {describe_hardware_error(self.error)}"
        return text if self.position is None else f"{text}, {self.position:.4f} rad, {self.velocity:.3f} rad/s"


def of_the_whole(servos: Sequence[ServoEnd]) -> str:
    """One phrase for all servos: "holding", "off", "unreachable", or who does what.

    The largest group is counted, the others are named, as in
    "mixed: 16 holding; wheel1, wheel2 does not answer; elbow limp: overload".
    """
    groups: dict[str, list[str]] = {}
    for servo in servos:
        groups.setdefault(servo.doing, []).append(servo.joint)
    if len(groups) <= 1:
        doing = next(iter(groups), SILENT)
        return WHOLE.get(doing, doing)
    largest = max(groups, key=lambda doing: len(groups[doing]))
    descriptions = [
        f"{len(joints)} {doing}" if doing == largest and len(joints) > 1 else f"{', '.join(joints)} {doing}"
        for doing, joints in sorted(groups.items(), key=lambda group: -len(group[1]))
    ]
    return f"mixed: {'; '.join(descriptions)}"


@dataclass(frozen=True)
class TimingStatistics:
    """How well the loop kept its deadlines.

    Attributes
    ----------
    cycles, skipped_cycles, missed_statuses, stray_bytes : int
    period_mean, period_max, lateness_p50, lateness_p99, lateness_max, exchange_mean, exchange_max : float
        Time between cycle starts, start after the deadline, writing all goals and reading all states [s].
    path_late : float
        By how much the path ended later than planned, for the cycles that were skipped on it [s].
    """

    cycles: int
    skipped_cycles: int
    missed_statuses: int
    stray_bytes: int
    period_mean: float
    period_max: float
    lateness_p50: float
    lateness_p99: float
    lateness_max: float
    path_late: float
    exchange_mean: float
    exchange_max: float

    def as_dict(self) -> dict[str, float | int]:
        """With the unit in the name, for summaries."""
        seconds = {f"{name}_s": value for name, value in vars(self).items() if isinstance(value, float)}
        return {name: value for name, value in vars(self).items() if isinstance(value, int)} | seconds


@dataclass
class ReplayResult:
    """How a replay ended.

    Attributes
    ----------
    end_state : str
        What the robot was read to do at the end: "holding", "off", "mixed: ..." (who does what), "unreachable" (nobody
        answers; armed servos stop by their own watchdogs), or "not armed" where nothing was switched on.
    servos : tuple of ServoEnd
        What every servo was read to do.
    faults : list of Fault
        All that were declared, one of each cause; the first one stopped the motion.
    fault_state : ReplayState | None
        Where the first one struck.
    fault_time : float
        Of the first one, on the replay's clock [s], NaN without one.
    policy_goals : list
        (clock time, ID, register value) of every goal sent after the fault.
    record : Record
    timing : TimingStatistics | None
    torque_still_on : tuple of int
        IDs that did not confirm torque off.
    limits : tuple of LimitRow
        Limits that the servos have stored, beside the map's.
    """

    end_state: str = NOT_ARMED
    servos: tuple[ServoEnd, ...] = ()
    faults: list[Fault] = field(default_factory=list)
    fault_state: ReplayState | None = None
    fault_time: float = math.nan
    policy_goals: list[tuple[float, int, int]] = field(default_factory=list)
    record: Record = field(default_factory=lambda: Record([]))
    timing: TimingStatistics | None = None
    torque_still_on: tuple[int, ...] = ()
    limits: tuple[LimitRow, ...] = ()

    @property
    def fault(self) -> Fault | None:
        """The one that stopped the motion, the gravest of its cycle."""
        return self.faults[0] if self.faults else None

    @property
    def fault_text(self) -> str:
        """All faults in words, the first one with the state it struck in; empty without one."""
        first = f" in {self.fault_state.name}" if self.fault_state is not None else ""
        texts = [f"{fault.cause}{'' if number else first}: {fault.text}" for number, fault in enumerate(self.faults)]
        return "; ".join(texts)

    def summary(self) -> dict[str, Any]:
        """How it ended, for ``summary.json``."""
        summary: dict[str, Any] = {
            "end_state": self.end_state,
            "servos": [servo.as_dict() for servo in self.servos],
        }
        if self.fault is not None:
            summary |= {"fault": self.fault.cause.value, "fault_text": self.fault.text}
            summary["faults"] = [
                {"cause": fault.cause.value, "text": fault.text, "ids": fault.ids} for fault in self.faults
            ]
        return summary

    def declare(self, fault: Fault) -> None:
        """Add a fault; what has the cause of an earlier one joins it."""
        for number, known in enumerate(self.faults):
            if known.cause == fault.cause:
                ids = known.ids + tuple(id_ for id_ in fault.ids if id_ not in known.ids)
                self.faults[number] = replace(known, text=_joined(known.text, fault.text), ids=ids)
                return
        self.faults.append(fault)


def _joined(first: str, second: str) -> str:
    """Texts "who: what" of one cause; what befell several is said once."""
    who, _, text = first.partition(": ")
    other, _, the_same = second.partition(": ")
    return f"{who}, {other}: {text}" if text and text == the_same else f"{first}; {second}"


class Stopped(Exception):
    """The replay cannot go on: rules, the user or a servo say so."""

    def __init__(self, *faults: Fault) -> None:
        super().__init__("; ".join(fault.text for fault in faults))
        self.faults = faults
