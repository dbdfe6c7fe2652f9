"""Outputs of a running replay: log file (``tail -f``), recorded cycles, progress.

The loop keeps its outputs in memory and never waits; a thread writes them to files or a display. So a disk that is full
or slow, or a terminal that accepts no output, does not delay the loop.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import signal
import struct
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from enum import IntEnum
from pathlib import Path
from typing import Any, ParamSpec, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar

from dynsim.hardware.bus.control_table import VOLT_PER_UNIT, describe_hardware_error
from dynsim.hardware.bus.protocol import Clock
from dynsim.hardware.errors import PortError
from dynsim.hardware.replay.rules import Cause, Cycle, Fault
from dynsim.hardware.replay.verify import LimitRow
from dynsim.hardware.servo_map import ServoMap
from dynsim.record import Record
from dynsim.record.scene import Scene
from dynsim.system.files import INCOMPLETE, lock
from dynsim.system.terminal import plain

# Types of a replay: states, stop request and its signal handlers, progress, timing statistics, result.


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


INTERVAL = 0.5
"""Between two writes [s]: a process that is killed loses the outputs of about this time."""
PATIENCE = 5.0
"""Longest wait for a blocked file or display after the run [s]."""
LOG_INTERVAL = 1.0
"""Between two lines about the following error [s]."""
PART = "measured.part"
"""Name of the file that grows during a run; the measured record takes its place at the end."""
PART_FORMAT = 1
MEASURED, SUMMARY, LOG = "measured.h5", "summary.json", "replay.log"
REGISTERS, REGISTERS_AFTER_FAULT = "registers.json", "registers_after_fault.json"
FILES = (PART, MEASURED, SUMMARY, LOG, REGISTERS, REGISTERS_AFTER_FAULT, INCOMPLETE)
MADE_OF_THEM = ("comparison.*", "figures")
"""Files that other commands write beside a measured record."""

P = ParamSpec("P")
T = TypeVar("T")


class Journal:
    """Keeps the state of a replay, and passes it to log and observer. Nothing here raises.

    Attributes
    ----------
    state : ReplayState
    log : RunLog
    observer : callable, optional
        Called with a Progress after every cycle and on every change of state.
    failures : dict
        The first error of every output that failed, by its name; that output is off since.
    """

    def __init__(
        self,
        clock: Clock,
        recorder: Recorder,
        log: RunLog,
        observer: Callable[[ReplayProgress], None] | None,
        stop: StopRequest,
    ) -> None:
        self.state = ReplayState.CONNECT
        self.observer = observer
        self.log = log
        self.failures: dict[str, BaseException] = {}
        self._clock = clock
        self._recorder = recorder
        self._stop = stop
        self._origin = clock.now()
        self._last_logged = -math.inf
        self._kept: list[tuple[float, str, str]] | None = None

    def guard(self, name: str, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T | None:
        """Run an output; None when it fails, and from then on without trying.

        Parameters
        ----------
        name : str
            Its name: what :attr:`failures` lists, and what is switched off by an error.
        call : callable
            A KeyboardInterrupt or SystemExit out of it becomes a request to stop: nothing may leave a moving robot.
        """
        if name in self.failures:
            return None
        try:
            return call(*args, **kwargs)
        except Exception as error:
            self.failures[name] = error
        except BaseException as error:
            self.failures[name] = error
            self._stop()
        if name != "log":
            self.say(f"{name} failed and is off from here: {self.failures[name]!r}")
        return None

    def enter(self, state: ReplayState) -> None:
        self.state = state
        self.say("enter")
        self._observe(0.0, 0.0)

    def say(self, text: str) -> None:
        line = (self._clock.now() - self._origin, self.state.name, text)
        if self._kept is None:
            self._write(*line)
        else:
            self._kept.append(line)

    def report(self, following_error: float, fraction: float) -> None:
        """After a cycle: the worst following error [rad], and how much of the motion is done."""
        if self._kept is not None:
            return
        now = self._clock.now()
        if now - self._last_logged >= LOG_INTERVAL:
            self._last_logged = now
            hottest = self._recorder.hottest
            self.say(
                f"following error {following_error:.4f} rad"
                + (f", hottest {hottest:.0f} °C" if hottest == hottest else "")
            )
        self._observe(fraction, following_error)

    @contextmanager
    def held_back(self) -> Iterator[None]:
        """Within, nothing leaves: what is said is written afterwards, and the observer hears of nothing.

        A disk or a terminal that blocks cannot delay what happens to the robot meanwhile.
        """
        self._kept = []
        try:
            yield
        finally:
            kept, self._kept = self._kept, None
            for line in kept:
                self._write(*line)

    def _write(self, time: float, state: str, text: str) -> None:
        self.guard("log", self.log.write, time, state, text)
        if self.log.failure is not None:
            self.failures.setdefault("log", self.log.failure)

    def _observe(self, fraction: float, following_error: float) -> None:
        if self.observer and self._kept is None:
            progress = ReplayProgress(self.state, fraction, following_error, self._recorder.hottest)
            self.guard("progress", self.observer, progress)


Rows = NDArray[np.void]
SCALARS = struct.Struct("=5d3i")
"""Of a row."""


def row_type(servos: int) -> np.dtype[np.void]:
    """One cycle of so many servos, as it lies in memory: without gaps, in the byte order of the machine.

    ``time``, ``origin`` (the clock when the path began, NaN before), ``path_time``, ``lateness`` and ``exchange`` in
    [s]; positions [rad], velocities [rad/s] and torques [N·m] of joints, NaN where a status was missed; supply [V],
    temperature [°C].
    """
    seconds = ["time", "origin", "path_time", "lateness", "exchange"]
    numbers = ["state", "stray", "skipped"]
    joints = ["goal_position", "goal_velocity", "position", "velocity", "torque", "volts", "celsius"]
    return np.dtype(
        [(name, "f8") for name in seconds]
        + [(name, "i4") for name in numbers]
        + [(name, "f8", (servos,)) for name in joints]
        + [("alert", "?", (servos,))]
    )


class Recorder:
    """Collects the timed cycles of a replay, as rows that never change: another thread may take them meanwhile.

    Attributes
    ----------
    type : dtype
        Of a row.
    hottest : float
        Servo [°C], NaN before the first health read.
    """

    def __init__(self, servo_map: ServoMap) -> None:
        count = len(servo_map.servos)
        self.type = row_type(count)
        self.hottest = math.nan
        self._rows: list[bytes] = []
        self._columns = {servo.id: column for column, servo in enumerate(servo_map.servos)}
        self._volts, self._celsius = np.full(count, np.nan), np.full(count, np.nan)

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, cycle: Cycle, state: ReplayState, path_time: float, origin: float) -> None:
        """Keep one cycle.

        Parameters
        ----------
        path_time, origin : time along the path, and of its beginning on the clock [s]; NaN before it has begun
        """
        if cycle.health:
            for id_, registers in cycle.health.items():
                self._volts[self._columns[id_]] = registers["present_voltage"] * VOLT_PER_UNIT
                self._celsius[self._columns[id_]] = registers["present_temperature"]
            self.hottest = float(np.nanmax(self._celsius))
        scalars = SCALARS.pack(
            cycle.time, origin, path_time, cycle.lateness, cycle.exchange, state, cycle.stray, cycle.skipped
        )
        # Some microseconds faster than to assign them field by field, and this is done in every cycle.
        arrays: tuple[Any, ...] = (
            cycle.goal_position,
            cycle.goal_velocity,
            cycle.position,
            cycle.velocity,
            cycle.torque,
            self._volts,
            self._celsius,
            cycle.alert,
        )
        self._rows.append(b"".join((scalars, *arrays)))

    def since(self, first: int) -> bytes:
        """Rows from number ``first`` on."""
        return b"".join(self._rows[first:])

    def all(self) -> Rows:
        return np.frombuffer(self.since(0), dtype=self.type)


@dataclass(frozen=True)
class Layout:
    """What the columns of rows are called in a record.

    Signals measured carry the names and labels of the signals followed; ``<name>_goal`` is what was commanded.

    Attributes
    ----------
    joints : list of str
    labels : list of str
        Of the columns of the signals that the joints follow.
    positions, velocities : list of str
        The signal that each joint follows; held joints are among those of their kind.
    provenance : dict
    """

    joints: list[str]
    labels: list[str]
    positions: list[str]
    velocities: list[str]
    provenance: dict[str, Any]

    @classmethod
    def of(cls, servo_map: ServoMap, provenance: dict[str, Any]) -> Layout:
        servos = servo_map.servos
        return cls(
            list(servo_map.joints),
            [servo.label for servo in servos],
            [servo.kind.follows.position for servo in servos],
            [servo.kind.follows.velocity for servo in servos],
            provenance,
        )

    def groups(self) -> Iterator[tuple[str, str, list[int]]]:
        """(signal, "position" or "velocity", columns)."""
        for source, names in (("position", self.positions), ("velocity", self.velocities)):
            for name in dict.fromkeys(names):
                yield name, source, [column for column, other in enumerate(names) if other == name]


class GrowingFile:
    """A file that can be read while it grows; nobody else's, and held until it is closed.

    See :func:`dynsim.system.files.lock`.

    Attributes
    ----------
    path : Path

    Raises
    ------
    OSError
        It cannot be made, or is there already.
    """

    def __init__(self, path: Path) -> None:
        # Not buffered: what a buffer still holds would be tried again, and fail again, when it is closed.
        self.path = path
        self._stream = path.open("xb", buffering=0)
        try:
            lock(self._stream.fileno(), wait=False)
        except OSError:
            self.discard()
            raise

    def append(self, data: bytes) -> None:
        """Raises OSError."""
        left = memoryview(data)
        while left:
            left = left[self._stream.write(left) or 0 :]

    def sync(self) -> None:
        """Wait until the disk has it. Raises OSError."""
        os.fsync(self._stream.fileno())

    def close(self) -> None:
        """Raises OSError."""
        self._stream.close()

    def discard(self) -> None:
        """Close and remove it: the run that it was made for does not begin."""
        with suppress(OSError):
            self._stream.close()
        with suppress(OSError):
            self.path.unlink()


class RunLog:
    """Lines "time [s]  state  text". They reach the file by :meth:`pump`, which another thread calls.

    Parameters
    ----------
    path : path or None
        None: the lines are only in ``lines``.

    Attributes
    ----------
    lines : list of str
    failure : Exception or None
        Why the file ends before the run did.
    wake : callable
        Called after every line: the thread that pumps may be asleep.

    Raises
    ------
    OSError
        The file cannot be made.
    """

    name = "log"

    def __init__(self, path: Path | None) -> None:
        self.lines: list[str] = []
        self.failure: Exception | None = None
        self.wake: Callable[[], None] = lambda: None
        self._file = GrowingFile(path) if path else None
        self._written = 0

    def write(self, time: float, state: str, text: str) -> None:
        self.lines.append(plain(f"{time:10.4f}  {state:<13}  {text}"))
        self.wake()

    def pump(self) -> None:
        count = len(self.lines)
        if self._file and count > self._written:
            text = "\n".join([*self.lines[self._written : count], ""])
            self._written = count
            self._file.append(text.encode("utf-8", errors="backslashreplace"))

    def close(self) -> None:
        if self._file:
            self._file.close()

    def discard(self) -> None:
        if self._file:
            self._file.discard()


class RowStream:
    """The rows of a replay on their way to ``measured.part``: one line of JSON, then rows as they lie in memory.

    Parameters
    ----------
    path : path
    recorder : Recorder
    layout : Layout
    scene : Scene or None
        Of the replayed record.

    Raises
    ------
    OSError
        The file cannot be made, or its first line not be written.
    """

    name = "streamed record"

    def __init__(self, path: Path, recorder: Recorder, layout: Layout, scene: Scene | None) -> None:
        self.failure: Exception | None = None
        self._recorder = recorder
        self._written = 0
        header = {
            "format": PART_FORMAT,
            "row": recorder.type.descr,
            "layout": vars(layout),
            "scene": scene.to_json() if scene else "",
        }
        self._file = GrowingFile(path)
        try:
            self._file.append(json.dumps(header, default=str).encode("utf-8") + b"\n")
        except BaseException:
            self._file.discard()
            raise

    def discard(self) -> None:
        self._file.discard()

    def pump(self) -> None:
        rows = self._recorder.since(self._written)
        if rows:
            self._written += len(rows) // self._recorder.type.itemsize
            self._file.append(rows)
            self._file.sync()

    def close(self) -> None:
        self._file.close()


class Outlet(Protocol):
    """Something that takes what the loop has left in memory to where it can be seen."""

    name: str
    failure: Exception | None

    def pump(self) -> None:
        """Take what has come since the last call. May raise: then it is not called again."""
        ...

    def close(self) -> None:
        """After the last call of ``pump``, also after one that failed."""
        ...


class Background:
    """A thread that pumps outlets, at least every ``interval`` [s] and whenever it is woken.

    Raises
    ------
    RuntimeError
        The system gives no thread; the outlets are closed.
    """

    def __init__(self, outlets: Sequence[Outlet], interval: float) -> None:
        self._outlets = outlets
        self._interval = interval
        self._woken = threading.Event()
        self._ending = False
        self._at_work: Outlet | None = None
        # Not waited for when Python ends: a terminal may be held for ever.
        self._thread = threading.Thread(target=self._run, name="dynsim outlets", daemon=True)
        try:
            self._thread.start()
        except BaseException:
            self._close_outlets()
            raise

    def wake(self) -> None:
        self._woken.set()

    def close(self, patience: float = PATIENCE) -> dict[str, Exception]:
        """Pump once more and end; the first error of every outlet that failed, by name.

        Parameters
        ----------
        patience : longest wait [s]; an outlet that does not come back in this time has failed with a TimeoutError
        """
        self._ending = True
        self.wake()
        self._thread.join(patience)
        failures = {outlet.name: outlet.failure for outlet in self._outlets if outlet.failure is not None}
        stuck = self._at_work
        if self._thread.is_alive() and stuck is not None:
            failures.setdefault(stuck.name, TimeoutError(f"does not answer for {patience:g} s"))
        return failures

    def _run(self) -> None:
        while not self._ending:
            self._woken.wait(self._interval)
            self._woken.clear()
            self._each("pump")
        self._each("pump")
        self._close_outlets()

    def _each(self, method: str) -> None:
        for outlet in self._outlets:
            if outlet.failure is None:
                self._guard(outlet, method)
        self._at_work = None

    def _close_outlets(self) -> None:
        for outlet in self._outlets:
            self._guard(outlet, "close")
        self._at_work = None

    def _guard(self, outlet: Any, method: str) -> None:
        self._at_work = outlet
        try:
            getattr(outlet, method)()
        except Exception as error:
            outlet.failure = outlet.failure or error


def move_away(folder: Path) -> Path | None:
    """Move what an earlier replay left to a folder ``previous_1``, ``previous_2``, … within; None if there is nothing.

    Raises
    ------
    PortError
        Another replay is writing there.
    OSError
        Something cannot be moved.
    """
    paths = [folder / name for name in FILES if os.path.lexists(folder / name)]
    if not paths:
        return None
    if is_held(folder / PART):
        raise PortError(f"{folder}: another replay is writing there; give this one another folder (--out)")
    if folder / PART in paths or folder / MEASURED in paths:
        paths += [path for pattern in MADE_OF_THEM for path in folder.glob(pattern)]
    target = _new_folder(folder)
    for path in paths:
        path.rename(target / path.name)
    return target


def is_held(part: Path) -> bool:
    """Whether the process that writes a streamed record is alive. Raises OSError."""
    try:
        descriptor = os.open(part, os.O_RDONLY)
    except FileNotFoundError:
        return False
    try:
        return not lock(descriptor, wait=False)
    finally:
        os.close(descriptor)


def _new_folder(folder: Path) -> Path:
    for number in itertools.count(1):
        target = folder / f"previous_{number}"
        try:
            target.mkdir()
        except FileExistsError:
            continue
        return target
    raise AssertionError


# The progress bar of a replay, drawn in its own thread so that a blocked terminal cannot delay the motion.


DRAWING_INTERVAL = 0.1
"""Between two drawings [s]."""
DISPLAY_PATIENCE = 1.0
"""Longest wait for a terminal that accepts no output, after the run [s]."""


class Display:
    """A bar with state, following error and temperature; called with a Progress, it shows the last one.

    Attributes
    ----------
    failure : Exception or None
        Why nothing is drawn any more.
    """

    name = "progress bar"

    def __init__(self, console: Console) -> None:
        self.failure: Exception | None = None
        self._latest: ReplayProgress | None = None
        self._bar = Bar(
            TextColumn("{task.description:<13}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TextColumn("following error {task.fields[error]:6.4f} rad"),
            TextColumn("hottest {task.fields[temperature]}"),
            console=console,
            transient=True,
            auto_refresh=False,
            # What other threads print must not wait for this one.
            redirect_stdout=False,
            redirect_stderr=False,
        )
        self._task = self._bar.add_task("", total=1.0, error=0.0, temperature="-")

    def __call__(self, progress: ReplayProgress) -> None:
        self._latest = progress

    def pump(self) -> None:
        latest, self._latest = self._latest, None
        if latest is None:
            return
        known = latest.temperature == latest.temperature
        self._bar.start()
        self._bar.update(
            self._task,
            description=latest.state.name,
            completed=latest.fraction,
            error=latest.following_error,
            temperature=f"{latest.temperature:.0f} °C" if known else "-",
            refresh=True,
        )

    def close(self) -> None:
        self._bar.stop()


@contextmanager
def displayed(console: Console, failures: dict[str, BaseException]) -> Iterator[Display | None]:
    """A display that draws itself within the block; None where the system gives no thread for it.

    Why it did not, or did so no more, joins ``failures`` at the end of the block.
    """
    display = Display(console)
    try:
        background = Background([display], DRAWING_INTERVAL)
    except RuntimeError as error:
        failures[display.name] = error
        yield None
        return
    try:
        yield display
    finally:
        failures |= background.close(DISPLAY_PATIENCE)
