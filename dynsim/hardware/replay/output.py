"""States, results and outputs of a replay: stop requests, log file, recorded cycles, and progress bar.

The control loop keeps its outputs in memory and never waits; another thread writes them to files or to a display.
Therefore a full or slow disk, or a terminal that does not accept output, cannot delay the loop. The log file can be
followed during the replay (``tail -f``).
"""

from __future__ import annotations

import itertools
import json
import math
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from enum import IntEnum
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar

from dynsim.hardware.bus.control_table import VOLT_PER_UNIT, describe_hardware_error
from dynsim.hardware.bus.protocol import Clock
from dynsim.hardware.errors import PortError
from dynsim.hardware.replay.rules import Cause, Cycle, Fault, LimitRow
from dynsim.hardware.servo_map import ServoMap
from dynsim.record import Record
from dynsim.record.scene import Scene
from dynsim.system.files import INCOMPLETE, lock
from dynsim.system.terminal import plain

# Data types for a replay: states, stop requests and signal handlers, progress, timing statistics, and the result.


class ReplayState(IntEnum):
    """State of a replay, which is recorded in each cycle."""

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
ROBOT_STATES = {HOLDING: "holding", LIMP: "off", SILENT: "unreachable"}
"""State of the robot if all servos are in the same state; a state that is not listed here keeps its name."""


class StopRequest:
    """Counter for Ctrl-C and other signals: the first requests a controlled stop, the second requests torque off."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, *_: Any) -> None:
        self.count += 1

    @property
    def for_release(self) -> bool:
        """True if the user requests torque off."""
        return self.count >= 2

    def check(self) -> None:
        """Raise Stopped if the user has requested a stop."""
        if self.count:
            raise Stopped(Fault(Cause.INTERRUPTED, "stopped by the user"))


def _available(*names: str) -> list[signal.Signals]:
    return [getattr(signal, name) for name in names if hasattr(signal, name)]


# By default, these signals would end the process and leave a moving robot to its watchdogs. Several signals from this
# group count as one request, because a second request switches the torque off and would let the robot fall: if a
# terminal is closed, both the system and the shell send SIGHUP, and `timeout` sends SIGTERM to the process and to its
# group.
_STOP_SIGNALS = _available(
    "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGVTALRM", "SIGPROF", "SIGXCPU",
    "SIGIO", "SIGPWR", "SIGSTKFLT",
)  # fmt: skip
# Signals that are sent if a terminal no longer exists or cannot be written to, or if a disk quota is exceeded. They are
# ignored, so that only the write fails.
_IGNORED_SIGNALS = _available("SIGTTOU", "SIGTTIN", "SIGPIPE", "SIGXFSZ")


@contextmanager
def stop_on_signals(stop: StopRequest) -> Iterator[None]:
    """Convert signals within the block to stop requests; an exception in a handler would interrupt a bus transaction.

    Each Ctrl-C counts as one request. SIGTERM, SIGHUP, SIGQUIT (Ctrl-\\), SIGTSTP (Ctrl-Z, which would leave a moving
    robot without goals) and all other signals that end a process request a controlled stop only, however often they are
    sent. If SIGHUP is ignored (``nohup``), it stays ignored.
    """

    def request_stop(*_: Any) -> None:
        stop.count = max(stop.count, 1)

    handlers: dict[signal.Signals, Any] = {signal.SIGINT: stop}
    handlers |= dict.fromkeys(_STOP_SIGNALS, request_stop) | dict.fromkeys(_IGNORED_SIGNALS, signal.SIG_IGN)
    for number in _available("SIGHUP"):
        if signal.getsignal(number) == signal.SIG_IGN:
            del handlers[number]
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            # None means that the handler was set by C code, so that Python cannot restore it.
            if handler is not None:
                signal.signal(number, handler)


def ignore_stops() -> None:
    """Ignore stop signals in this process, because its parent process handles them and ends it."""
    for number in (signal.SIGINT, *_STOP_SIGNALS):
        signal.signal(number, signal.SIG_IGN)


@dataclass(frozen=True)
class ReplayProgress:
    """Progress of a replay after a cycle, to be displayed.

    Attributes
    ----------
    state : ReplayState
    fraction : float
        Completed fraction of the current motion, 0 to 1.
    following_error : float
        Largest following error among all joints [rad].
    temperature : float
        Temperature of the hottest servo [°C]; NaN as long as it is unknown.
    """

    state: ReplayState
    fraction: float
    following_error: float
    temperature: float


@dataclass(frozen=True)
class ServoEnd:
    """State of one servo at the end of a replay.

    Attributes
    ----------
    joint : str
    id : int
    torque : bool or None
        True if the torque is on. This and the following values are None if the servo did not answer.
    error : int or None
        Hardware error register.
    position, velocity : float or None
        Joint position [rad] and velocity [rad/s].
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
        """Return the values as a dictionary for summaries, with units in the keys."""
        values = asdict(self)
        values["position_rad"], values["velocity_rad_s"] = values.pop("position"), values.pop("velocity")
        return values

    def __str__(self) -> str:
        text = f"{self.joint} (ID {self.id}): {self.doing}"
        if self.error:
            text += f", error: {describe_hardware_error(self.error)}"
        return text if self.position is None else f"{text}, {self.position:.4f} rad, {self.velocity:.3f} rad/s"


def robot_state(servos: Sequence[ServoEnd]) -> str:
    """Return the state of the robot: "holding", "off", "unreachable", or "mixed: …" with the states of the servos.

    For the state that most servos have in common, the text contains only their number; for other states, it lists the
    joints, for example "mixed: 16 holding; wheel1, wheel2 does not answer; elbow limp: overload".
    """
    groups: dict[str, list[str]] = {}
    for servo in servos:
        groups.setdefault(servo.doing, []).append(servo.joint)
    if len(groups) <= 1:
        doing = next(iter(groups), SILENT)
        return ROBOT_STATES.get(doing, doing)
    largest = max(groups, key=lambda doing: len(groups[doing]))
    descriptions = [
        f"{len(joints)} {doing}" if doing == largest and len(joints) > 1 else f"{', '.join(joints)} {doing}"
        for doing, joints in sorted(groups.items(), key=lambda group: -len(group[1]))
    ]
    return f"mixed: {'; '.join(descriptions)}"


Timing = dict[str, float | int]
"""Timing statistics of the control loop.

Numbers of ``cycles``, ``skipped_cycles``, ``missed_statuses`` and ``stray_bytes``; times in [s]:

- ``period_mean_s``, ``period_max_s``: time between the starts of cycles
- ``lateness_p50_s``, ``lateness_p99_s``, ``lateness_max_s``: delay of a start after its deadline
- ``path_late_s``: delay of the end of the path because of skipped cycles
- ``exchange_mean_s``, ``exchange_max_s``: time to write all goals and read all states
"""


@dataclass
class ReplayResult:
    """Result of a replay.

    Attributes
    ----------
    end_state : str
        State of the robot, as read at the end: "holding", "off", "mixed: ..." (states of the servos), "unreachable" (no
        servo answers; the watchdogs stop armed servos), or "not armed" (no torque was switched on).
    servos : tuple of ServoEnd
        State of each servo, as read at the end.
    faults : list of Fault
        Declared faults, one for each cause; the first fault stopped the motion.
    fault_state : ReplayState | None
        State in which the first fault occurred.
    fault_time : float
        Time of the first fault on the clock of the replay [s]; NaN if there was no fault.
    policy_goals : list
        (clock time, ID, register value) of each goal that was sent after the fault.
    record : Record
        Measured record.
    timing : Timing
        Empty before the second cycle.
    torque_still_on : tuple of int
        IDs of the servos that did not confirm that their torque is off.
    limits : tuple of LimitRow
        Limits stored in the servos, next to the limits in the map.
    """

    end_state: str = NOT_ARMED
    servos: tuple[ServoEnd, ...] = ()
    faults: list[Fault] = field(default_factory=list)
    fault_state: ReplayState | None = None
    fault_time: float = math.nan
    policy_goals: list[tuple[float, int, int]] = field(default_factory=list)
    record: Record = field(default_factory=lambda: Record([]))
    timing: Timing = field(default_factory=dict)
    torque_still_on: tuple[int, ...] = ()
    limits: tuple[LimitRow, ...] = ()

    @property
    def fault(self) -> Fault | None:
        """Fault that stopped the motion, which is the most severe fault of its cycle; None if there was no fault."""
        return self.faults[0] if self.faults else None

    @property
    def fault_text(self) -> str:
        """Text with all faults, and with the state in which the first one occurred; empty if there was no fault."""
        first = f" in {self.fault_state.name}" if self.fault_state is not None else ""
        texts = [f"{fault.cause}{'' if number else first}: {fault.text}" for number, fault in enumerate(self.faults)]
        return "; ".join(texts)

    def summary(self) -> dict[str, Any]:
        """Return the end state and the faults, to be written to ``summary.json``."""
        summary: dict[str, Any] = {"end_state": self.end_state, "servos": [servo.as_dict() for servo in self.servos]}
        if self.fault is not None:
            summary |= {"fault": self.fault.cause.value, "fault_text": self.fault.text}
            summary["faults"] = [
                {"cause": fault.cause.value, "text": fault.text, "ids": fault.ids} for fault in self.faults
            ]
        return summary

    def declare(self, fault: Fault) -> None:
        """Add a fault, or merge it into an earlier fault with the same cause."""
        for number, known in enumerate(self.faults):
            if known.cause == fault.cause:
                ids = known.ids + tuple(id_ for id_ in fault.ids if id_ not in known.ids)
                text = known.text if fault.text in known.text else _joined(known.text, fault.text)
                self.faults[number] = replace(known, text=text, ids=ids)
                return
        self.faults.append(fault)


def _joined(first: str, second: str) -> str:
    """Join two texts "servo: problem" with the same cause; if the problems are equal, write the problem only once."""
    who, _, text = first.partition(": ")
    other, _, the_same = second.partition(": ")
    return f"{who}, {other}: {text}" if text and text == the_same else f"{first}; {second}"


class Stopped(Exception):
    """The replay must stop because of an abort rule, the user or a servo."""

    def __init__(self, *faults: Fault) -> None:
        super().__init__("; ".join(fault.text for fault in faults))
        self.faults = faults


INTERVAL = 0.5
"""Time between two writes [s]; if the process is killed, the output of about this time is lost."""
PATIENCE = 5.0
"""Maximum time to wait for a blocked file or display after the run [s]."""
LOG_INTERVAL = 1.0
"""Time between two log lines with the following error [s]."""
PART = "measured.part"
"""Name of the file to which the rows are written during a run; at the end, the measured record replaces it."""
PART_FORMAT = 2
MEASURED, SUMMARY, LOG = "measured.h5", "summary.json", "replay.log"
REGISTERS, REGISTERS_AFTER_FAULT = "registers.json", "registers_after_fault.json"
FILES = (PART, MEASURED, SUMMARY, LOG, REGISTERS, REGISTERS_AFTER_FAULT, INCOMPLETE)
DERIVED_FILES = ("comparison.*", "figures")
"""Files that other commands write next to a measured record."""

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(eq=False)
class Journal:
    """State of a replay, which is reported to the log and to an observer. The methods do not raise exceptions.

    Attributes
    ----------
    clock : Clock
    recorder : Recorder
    log : RunLog
    observer : callable, optional
        Called with a ReplayProgress after each cycle and at each change of state.
    stop : StopRequest
    state : ReplayState
    failures : dict
        First error of each output that failed, by the name of the output; a failed output is disabled.
    """

    clock: Clock
    recorder: Recorder
    log: RunLog
    observer: Callable[[ReplayProgress], None] | None
    stop: StopRequest
    state: ReplayState = ReplayState.CONNECT
    failures: dict[str, BaseException] = field(default_factory=dict)
    _last_logged: float = -math.inf
    _buffer: list[tuple[float, str, str]] | None = None

    def __post_init__(self) -> None:
        self._origin = self.clock.now()

    def guard(self, name: str, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T | None:
        """Call a function that writes an output; if it fails, disable this output.

        Parameters
        ----------
        name : str
            Name of the output in :attr:`failures`.
        call : callable
            Function to call. If it raises KeyboardInterrupt or SystemExit, the exception becomes a stop request, so
            that the program does not abandon a moving robot.

        Returns
        -------
        object or None
            Result of the call; None if the call fails or the output is disabled.
        """
        if name in self.failures:
            return None
        try:
            return call(*args, **kwargs)
        except Exception as error:
            self.failures[name] = error
        except BaseException as error:
            self.failures[name] = error
            self.stop()
        if name != "log":
            self.add_line(f"{name} failed and is now disabled: {self.failures[name]!r}")
        return None

    def enter(self, state: ReplayState) -> None:
        self.state = state
        self.add_line("enter")
        self._observe(0.0, 0.0)

    def add_line(self, text: str) -> None:
        line = (self.clock.now() - self._origin, self.state.name, text)
        if self._buffer is None:
            self._write(*line)
        else:
            self._buffer.append(line)

    def report(self, following_error: float, fraction: float) -> None:
        """Report the largest following error [rad] and the completed fraction of the motion after a cycle."""
        if self._buffer is not None:
            return
        now = self.clock.now()
        if now - self._last_logged >= LOG_INTERVAL:
            self._last_logged = now
            hottest = self.recorder.hottest
            self.add_line(
                f"following error {following_error:.4f} rad"
                + (f", hottest {hottest:.0f} °C" if hottest == hottest else "")
            )
        self._observe(fraction, following_error)

    @contextmanager
    def buffered(self) -> Iterator[None]:
        """Buffer all log lines until the block ends, and do not call the observer in the meantime.

        Therefore a blocked disk or terminal cannot delay the commands that are sent to the robot within the block.
        """
        self._buffer = []
        try:
            yield
        finally:
            lines, self._buffer = self._buffer, None
            for line in lines:
                self._write(*line)

    def _write(self, time: float, state: str, text: str) -> None:
        self.guard("log", self.log.write, time, state, text)

    def _observe(self, fraction: float, following_error: float) -> None:
        if self.observer and self._buffer is None:
            progress = ReplayProgress(self.state, fraction, following_error, self.recorder.hottest)
            self.guard("progress", self.observer, progress)


Rows = NDArray[np.void]


def row_type(servos: int) -> np.dtype[np.void]:
    """Return the data type of a row, which stores one cycle of ``servos`` servos, packed and in native byte order.

    ``time``, ``origin`` (clock time at which the path starts; NaN before the start), ``path_time``, ``lateness`` and
    ``exchange`` are in [s]. Joint positions [rad], velocities [rad/s] and torques [N·m] are NaN if a status was missed.
    The supply voltage is in [V], the temperature in [°C]. The other values are those of a ``Cycle``.
    """
    seconds = ["time", "origin", "path_time", "lateness", "exchange"]
    numbers = ["state", "stray", "skipped"]
    joints = ["goal_position", "goal_velocity", "position", "velocity", "torque", "volts", "celsius"]
    joints += ["current", "load", "pwm", "goal_register", "read_time"]
    return np.dtype(
        [(name, "f8") for name in seconds]
        + [(name, "i4") for name in numbers]
        + [(name, "f8", (servos,)) for name in joints]
        + [("alert", "?", (servos,))]
    )


class Recorder:
    """Recorder that stores the cycles of a replay as immutable rows, which another thread may read in the meantime.

    Attributes
    ----------
    type : dtype
        Data type of a row.
    hottest : float
        Temperature of the hottest servo [°C]; NaN before the first health read.
    """

    def __init__(self, servo_map: ServoMap) -> None:
        count = len(servo_map.servos)
        self.type = row_type(count)
        self._names = self.type.names or ()
        self.hottest = math.nan
        self._rows: list[bytes] = []
        self._taken = 0
        self._columns = {servo.id: column for column, servo in enumerate(servo_map.servos)}
        self._volts, self._celsius = np.full(count, np.nan), np.full(count, np.nan)

    def add(self, cycle: Cycle, state: ReplayState, path_time: float, origin: float) -> None:
        """Add one cycle.

        Parameters
        ----------
        cycle : Cycle
        state : ReplayState
        path_time, origin : float
            Time along the path, and clock time at which the path starts [s]; NaN before the start.
        """
        if cycle.health:
            for id_, registers in cycle.health.items():
                self._volts[self._columns[id_]] = registers["present_voltage"] * VOLT_PER_UNIT
                self._celsius[self._columns[id_]] = registers["present_temperature"]
            self.hottest = float(np.nanmax(self._celsius))
        values = vars(cycle) | {"origin": origin, "path_time": path_time, "state": state}
        values |= {"volts": self._volts, "celsius": self._celsius}
        self._rows.append(np.array(tuple(values[name] for name in self._names), dtype=self.type).tobytes())

    def pending(self) -> bytes:
        """Return the rows since the last call."""
        rows = self._rows[self._taken :]
        self._taken += len(rows)
        return b"".join(rows)

    def all(self) -> Rows:
        return np.frombuffer(b"".join(self._rows), dtype=self.type)


@dataclass(frozen=True)
class Layout:
    """Names of signals and columns under which the data in the rows appear in a record.

    Measured signals have the names and labels of the signals that the servos follow; ``<name>_goal`` is the command.

    Attributes
    ----------
    joints : list of str
    labels : list of str
        Labels of the columns that the joints follow.
    positions, velocities : list of str
        Names of the signals that each joint follows; for a joint with a fixed angle, the signals of its kind.
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
        """Yield, for each signal, its name, the quantity ("position" or "velocity"), and its columns.

        The second servo of a pair, whose label is the label of the first, has no column.
        """
        for source, names in (("position", self.positions), ("velocity", self.velocities)):
            for name in dict.fromkeys(names):
                columns = [column for column, other in enumerate(names) if other == name]
                first = {self.labels[column]: column for column in reversed(columns)}
                yield name, source, [column for column in columns if first[self.labels[column]] == column]


class Outlet:
    """Output that transfers data of the control loop from memory to a file or to a display.

    Attributes
    ----------
    name : str
    failure : Exception or None
        First error; no data are written after it.
    """

    name: str
    failure: Exception | None = None

    def pump(self) -> None:
        """Write the data that have been added since the last call. After an exception, it is not called again."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the output after the last call of ``pump``, even if this call failed."""


class GrowingFile(Outlet):
    """New file that can be read while it grows; it is locked until it is closed.

    The lock is described in :func:`dynsim.system.files.lock`.

    Parameters
    ----------
    name : str
    path : Path
    pending : callable
        Returns the data since its last call.
    durable : bool
        If True, each call of :meth:`pump` waits until its data are on the disk.

    Raises
    ------
    OSError
        If the file cannot be created or already exists.
    """

    def __init__(self, name: str, path: Path, pending: Callable[[], bytes], *, durable: bool = False) -> None:
        self.name, self._pending, self._durable = name, pending, durable
        self._path = path
        # Do not buffer: after an error, closing the file would try to write the buffer again, and would fail again.
        self._stream = path.open("xb", buffering=0)
        try:
            lock(self._stream.fileno(), wait=False)
        except OSError:
            self.discard()
            raise

    def append(self, data: bytes) -> None:
        """Append data to the file. Raises OSError."""
        left = memoryview(data)
        while left:
            left = left[self._stream.write(left) or 0 :]

    def pump(self) -> None:
        if data := self._pending():
            self.append(data)
            if self._durable:
                os.fsync(self._stream.fileno())

    def close(self) -> None:
        self._stream.close()

    def discard(self) -> None:
        """Close and remove the file, because the run for which it was created does not start."""
        with suppress(OSError):
            self._stream.close()
        with suppress(OSError):
            self._path.unlink()


class RunLog:
    """Log with lines "time [s]  state  text", kept in memory; another thread may write them to a file.

    Attributes
    ----------
    lines : list of str
    wake : callable
        Called after each line, to wake the thread that writes the lines.
    """

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.wake: Callable[[], None] = lambda: None
        self._taken = 0

    def write(self, time: float, state: str, text: str) -> None:
        self.lines.append(plain(f"{time:10.4f}  {state:<13}  {text}"))
        self.wake()

    def pending(self) -> bytes:
        """Return the lines since the last call."""
        lines = self.lines[self._taken :]
        self._taken += len(lines)
        return "".join(f"{line}\n" for line in lines).encode("utf-8", errors="backslashreplace")


def row_stream(path: Path, recorder: Recorder, layout: Layout, scene: Scene | None) -> GrowingFile:
    """Create ``measured.part`` for the rows of a replay: one line of JSON, then binary rows.

    Raises
    ------
    OSError
        If the file cannot be created or its first line cannot be written.
    """
    header = {
        "format": PART_FORMAT,
        "row": recorder.type.descr,
        "layout": vars(layout),
        "scene": scene.to_json() if scene else "",
    }
    file = GrowingFile("streamed record", path, recorder.pending, durable=True)
    try:
        file.append(json.dumps(header, default=str).encode("utf-8") + b"\n")
    except BaseException:
        file.discard()
        raise
    return file


class Background:
    """Thread that calls ``pump`` of all outlets every ``interval`` [s] and whenever it is woken.

    Raises
    ------
    RuntimeError
        If the thread cannot be started; the outlets are closed in this case.
    """

    def __init__(self, outlets: Sequence[Outlet], interval: float) -> None:
        self._outlets = outlets
        self._interval = interval
        self._woken = threading.Event()
        self._ending = False
        self._at_work: Outlet | None = None
        # A daemon thread, so that Python can exit even if a terminal blocks indefinitely.
        self._thread = threading.Thread(target=self._run, name="dynsim outlets", daemon=True)
        try:
            self._thread.start()
        except BaseException:
            self._close_outlets()
            raise

    def wake(self) -> None:
        self._woken.set()

    def close(self, patience: float = PATIENCE) -> dict[str, Exception]:
        """Call ``pump`` one last time, end the thread, and return the first error of each outlet that has failed.

        Parameters
        ----------
        patience : float
            Maximum time to wait [s]; if an outlet takes longer, its error is a TimeoutError.
        """
        self._ending = True
        self.wake()
        self._thread.join(patience)
        failures = {outlet.name: outlet.failure for outlet in self._outlets if outlet.failure is not None}
        stuck = self._at_work
        if self._thread.is_alive() and stuck is not None:
            failures.setdefault(stuck.name, TimeoutError(f"no response for {patience:g} s"))
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
    """Move the files of an earlier replay to a new subfolder ``previous_1``, ``previous_2``, …

    Returns
    -------
    Path or None
        The subfolder; None if there are no such files.

    Raises
    ------
    PortError
        If another replay is still writing to the folder.
    OSError
        If a file cannot be moved.
    """
    paths = [folder / name for name in FILES if os.path.lexists(folder / name)]
    if not paths:
        return None
    if is_locked(folder / PART):
        raise PortError(f"{folder}: another replay is writing to it; choose another --out")
    if folder / PART in paths or folder / MEASURED in paths:
        paths += [path for pattern in DERIVED_FILES for path in folder.glob(pattern)]
    target = _new_folder(folder)
    for path in paths:
        path.rename(target / path.name)
    return target


def is_locked(part: Path) -> bool:
    """Return True if the process that is writing a streamed record is still alive. Raises OSError."""
    try:
        with part.open("rb") as stream:
            return not lock(stream.fileno(), wait=False)
    except FileNotFoundError:
        return False


def _new_folder(folder: Path) -> Path:
    for number in itertools.count(1):
        with suppress(FileExistsError):
            (target := folder / f"previous_{number}").mkdir()
            return target
    raise AssertionError


# Progress bar of a replay; a separate thread draws it, so that a blocked terminal cannot delay the motion.


DRAWING_INTERVAL = 0.1
"""Time between two drawings [s]."""
DISPLAY_PATIENCE = 1.0
"""Maximum time to wait for a blocked terminal after the run [s]."""


class Display(Outlet):
    """Progress bar with state, following error and temperature, which shows the latest ReplayProgress of a replay."""

    name = "progress bar"

    def __init__(self, console: Console) -> None:
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
            # Do not redirect: the output of other threads must not wait for this thread.
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
    """Show a progress bar within the block; yield None if the thread that draws it cannot be started.

    If the display has failed, its error is added to ``failures`` at the end of the block.
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
