"""Simulation in a separate process, which a pilot drives and servos follow, and its connection to the servos.

    process of the servos                              process of the simulation
    ---------------------                              -------------------------
    writes its time to shared memory       ──▶         ServoFollower.ready: the next tick may be simulated
    waits for a pilot in shared memory     ◀──         ServoFollower.report_pilot: a browser is connected
    reads a pipe without waiting           ◀──         ServoFollower.after_tick: writes a posture for each tick

The control loop of the servos runs in a separate interpreter, so that compilation, browsers or disks cannot block it.
"""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from types import TracebackType
from typing import Any

import numpy as np

from dynsim.engine.recording import save_drive
from dynsim.errors import CheckRefused, DynsimError, RecordError
from dynsim.hardware.bus.protocol import require_posix
from dynsim.hardware.replay.check import LiftLookahead, Sample, lead
from dynsim.hardware.replay.output import ignore_stops
from dynsim.hardware.replay.trajectory import GROUNDED as LIFTED
from dynsim.hardware.replay.trajectory import column_of
from dynsim.hardware.servo_map import ServoMap
from dynsim.record import Record
from dynsim.scenario import Scenario
from dynsim.studies.processes import signals_held
from dynsim.system import interruption
from dynsim.teleop.snake import Array, Session, SpeedLimits, begin
from dynsim.teleop.web.live import DriveReport, LiveDrive

NOT_STARTED = -math.inf
"""Time that the servos report before they have reached the initial posture."""
NICENESS = 5
REGULAR, BROKEN, NOT_LIFTED = 0.0, 1.0, 2.0
"""Codes that state how a drive ended; they are sent after a time of NaN."""


@dataclass(frozen=True)
class DriveRequest:
    """Inputs for a drive."""

    scenario: Scenario
    servo_map: ServoMap
    limits: SpeedLimits
    longest: float
    http_port: int
    until_closed: bool
    folder: Path


@dataclass(frozen=True)
class Ready:
    """Data that the servo process needs before the servos move; ``step`` is the time between samples [s]."""

    address: str
    still: Record
    first: Sample
    step: float


@dataclass(frozen=True)
class Done:
    """Result of a drive; ``driven`` is its duration [s], and ``failure`` is an error in simulating or saving it."""

    report: DriveReport
    driven: float
    saved: bool
    failure: DynsimError | None


class Columns:
    """Signals and columns of a simulation that the servos of a map follow.

    Raises
    ------
    CheckRefused
        If a signal or column does not exist or is not available in a live drive, or if the robot lifts wheels but the
        map has no ``lifts``.
    """

    def __init__(self, session: Session, servo_map: ServoMap) -> None:
        still, known = session.still, session.joints()
        if servo_map.lifts is None and LIFTED in known:
            raise CheckRefused(
                "the robot lifts wheel pairs but the servo map has no 'lifts', so they would drag on the floor; "
                "add an entry 'lifts' to the map"
            )
        self._lifts = servo_map.lifts
        if self._lifts is not None and self._lifts.signal not in known:
            raise CheckRefused(
                f"lifts.signal: {self._lifts.signal!r} is not available in a live drive; use one of {', '.join(known)}"
            )
        self._session = session
        self._fixed = np.array([servo.hold_at or 0.0 for servo in servo_map.servos])
        # Index of each servo, signal and column of its angle, and signal and column of its rate (None for held rates).
        self._sources: list[tuple[int, tuple[str, int], tuple[str, int] | None]] = []
        for index, servo in enumerate(servo_map.servos):
            if servo.hold_at is not None:
                continue
            follows = servo.kind.follows
            signals = {follows.position: "rad"}
            if follows.rates == "continuous":
                signals[follows.velocity] = "rad/s"
            for name, unit in signals.items():
                column_of(still, name, servo, unit)
            if missing := [name for name in signals if name not in known]:
                raise CheckRefused(
                    f"{servo.joint}: signal {missing[0]!r} is not available in a live drive (signals: "
                    f"{', '.join(known)}); for a sampled controller, use 'rates: held'"
                )
            position, *rates = ((name, still.labels[name].index(servo.label)) for name in signals)
            self._sources.append((index, position, rates[0] if rates else None))

    def sample(self) -> Sample:
        """Return the present angles [rad] and rates [rad/s] as a sample."""
        joints = self._session.joints()
        position, velocity = self._fixed.copy(), np.zeros(len(self._fixed))
        for index, (signal, column), rates in self._sources:
            position[index] = joints[signal][column]
            if rates is not None:
                velocity[index] = joints[rates[0]][rates[1]]
        return Sample(self._session.time, position, velocity)

    def base(self, yaw: tuple[str, list[int]]) -> tuple[Array, Array]:
        """Return the yaw angles of the base part [rad] and which wheel pairs are on the ground.

        ``yaw`` contains the signal with the yaw angles and their columns.
        """
        assert self._lifts is not None
        joints = self._session.joints()
        signal, columns = yaw
        return joints[signal][columns], joints[self._lifts.signal]


class ServoFollower:
    """A :class:`~dynsim.teleop.web.live.Follower` that sends postures to the process of the servos.

    Parameters
    ----------
    session : Session
        Simulation.
    servo_map : ServoMap
        Map of the servos.
    samples : Connection
        Pipe through which the postures are sent.
    servo_time : array
        Shared memory that contains the time of the servos [s], and 1 if a pilot is connected.

    Raises
    ------
    CheckRefused
        As for :class:`Columns`.
    """

    def __init__(self, session: Session, servo_map: ServoMap, samples: Connection, servo_time: Any) -> None:
        self._session, self._columns = session, Columns(session, servo_map)
        self.lookahead = LiftLookahead(session.still, servo_map, session.period) if servo_map.lifts else None
        # Time by which the simulation may be ahead of the servos [s].
        self._ahead = lead(servo_map) + (self.lookahead.delay if self.lookahead is not None else 0.0)
        self._samples, self._servo_time = samples, servo_time
        self.first = self._columns.sample()
        if self.lookahead is not None:
            self.first = self.lookahead.begin(self.first, *self._columns.base(self.lookahead.yaw))

    @property
    def begun(self) -> bool:
        return self._servo_time[0] > NOT_STARTED

    @property
    def ready(self) -> bool:
        return (self._session.ticks + 1) * self._session.period <= self._servo_time[0] + self._ahead

    def report_pilot(self) -> None:
        self._servo_time[1] = 1.0

    @property
    def steady(self) -> bool:
        return self.lookahead is None or self.lookahead.steady(self._session.time)

    def after_tick(self) -> None:
        sample, lookahead = self._columns.sample(), self.lookahead
        for whole in [sample] if lookahead is None else lookahead.add(sample, *self._columns.base(lookahead.yaw)):
            self._send(whole)

    def finish(self) -> None:
        """Send the pending samples after the last tick."""
        for sample in self.lookahead.remaining() if self.lookahead is not None else []:
            self._send(sample)

    def end(self, how: float) -> None:
        """Send the code that states how the drive ended, and close the pipe."""
        self._send(Sample(math.nan, np.full_like(self.first.position, how), np.zeros_like(self.first.position)))
        self._samples.close()

    def _send(self, sample: Sample) -> None:
        rows = np.broadcast_arrays(sample.position, sample.velocity, sample.lift, sample.lift_rate)
        # If the process of the servos no longer exists, this is reported elsewhere.
        with suppress(OSError):
            os.write(self._samples.fileno(), np.concatenate([[sample.time], *rows]).tobytes())


def simulate(request: DriveRequest, control: Connection, samples: Connection, servo_time: Any) -> None:
    """Run in the process of the simulation: send Ready or an error, drive, save the drive, and send Done.

    The drive ends when a message arrives on ``control``, or when the process of the servos ends.
    """
    # A terminal sends signals to all processes of a group; only the process of the servos handles them.
    ignore_stops()
    # Lower the priority of this process, so that the servos have priority on a busy computer.
    with suppress(AttributeError, OSError):
        os.nice(NICENESS)
    drives: SimpleQueue[LiveDrive] = SimpleQueue()
    threading.Thread(target=_end_on_message, args=(control, drives), name="dynsim ending", daemon=True).start()
    try:
        session = begin(request.scenario, limits=request.limits, longest=request.longest)
        follower = ServoFollower(session, request.servo_map, samples, servo_time)
        drive = LiveDrive(session, request.scenario.variant or request.scenario.name, follower)
        address = drive.open(request.http_port)
    except Exception as error:
        known = isinstance(error, DynsimError)
        _send_message(control, error if known else DynsimError(f"the simulation failed: {error!r}"))
        return
    how = BROKEN
    refused: CheckRefused | None = None
    try:
        drives.put(drive)
        _send_message(control, Ready(address, session.still, follower.first, session.period))
        if drive.run(until_closed=request.until_closed).stop is None:
            follower.finish()
            how = REGULAR
    except CheckRefused as error:
        how, refused, drive.report.ended = NOT_LIFTED, error, str(error)
    except DynsimError as error:
        drive.report.ended = str(error)
    finally:
        follower.end(how)
        drive.close()
    _send_message(control, _saved(session, drive.report, request.folder, refused))


def _saved(session: Session, report: DriveReport, folder: Path, refused: CheckRefused | None) -> Done:
    time = session.ticks * session.period
    stop, report.stop = report.stop, None  # contains a record, which is not needed in the other process
    if session.ticks == 0:
        return Done(report, time, saved=False, failure=stop)
    try:
        save_drive(session.record() if stop is None or stop.record is None else stop.record, folder)
    except Exception as error:
        failure = error if isinstance(error, DynsimError) else RecordError(f"the drive could not be saved: {error!r}")
        return Done(report, time, saved=False, failure=failure)
    return Done(report, time, saved=True, failure=refused if stop is None else type(stop)(str(stop)))


def _send_message(control: Connection, message: Any) -> None:
    with suppress(OSError):
        control.send(message)


def _end_on_message(control: Connection, drives: SimpleQueue[LiveDrive]) -> None:
    """Wait for a message or for the end of the process of the servos, then end the drive, also if it starts later."""
    try:
        why = str(control.recv())
    except (EOFError, OSError):
        why = "the process of the servos has ended"
        if drives.empty():
            # The drive has not started, and no process waits for it.
            os._exit(1)
    drives.get().end(why, at_once=True)


# The servo side of a drive: start and end the process of the simulation, and follow its postures.


CHUNK_SIZE = 1 << 16
FAULTS = {
    BROKEN: "the simulation stopped early",
    NOT_LIFTED: "the servos cannot lift the wheel pairs that the simulated robot lifts",
}
POLL_INTERVAL = 0.2
"""Interval between checks for Ctrl-C while waiting for the simulation [s]."""
PATIENCE = 5.0
"""Maximum time to wait until a process ends after it has finished its work [s]."""


class PipeFeed:
    """A :class:`~dynsim.hardware.replay.check.Feed` from another process.

    Attributes
    ----------
    over : bool
    fault : str
    """

    def __init__(self, samples: Connection, servo_time: Any, servo_map: ServoMap) -> None:
        self.over, self.fault = False, ""
        self._descriptor = samples.fileno()
        os.set_blocking(self._descriptor, False)
        self._samples, self._servo_time = samples, servo_time
        # A frame has the time, then angles, rates, and the angles and rates of the lifting.
        self._size = 8 * (1 + 4 * len(servo_map.servos))
        self._bytes = b""
        self._gone = False

    def take(self, most: int) -> Sequence[Sample]:
        self._read()
        size = self._size
        samples: list[Sample] = []
        while len(self._bytes) >= size and len(samples) < most and not self.over and not self.fault:
            numbers = np.frombuffer(self._bytes[:size])
            self._bytes = self._bytes[size:]
            if not math.isnan(numbers[0]):
                samples.append(Sample(float(numbers[0]), *numbers[1:].reshape(4, -1)))
            elif numbers[1] in FAULTS:
                self.fault = FAULTS[numbers[1]]
            else:
                self.over = True
        if self._gone and len(self._bytes) < size and not self.over and not self.fault:
            self.fault = "the process of the simulation has ended"
        return samples

    def report_time(self, time: float) -> None:
        self._servo_time[0] = time

    def close(self) -> None:
        """Close the pipe."""
        self._samples.close()

    def _read(self) -> None:
        with suppress(BlockingIOError):
            while not self._gone:
                piece = os.read(self._descriptor, CHUNK_SIZE)
                self._gone = not piece
                self._bytes += piece


@contextmanager
def safe_path() -> Iterator[None]:
    """Prevent a Python process that is started in the block from importing modules of the working directory."""
    name = "PYTHONSAFEPATH"
    if name in os.environ:
        yield
        return
    os.environ[name] = "1"
    try:
        yield
    finally:
        del os.environ[name]


class SimulationProcess:
    """Process that simulates a drive; it is a context manager that ends the process when the block ends.

    Attributes
    ----------
    feed : PipeFeed
    """

    def __init__(self, request: DriveRequest) -> None:
        """Start the process. Raises PortError on a system without POSIX pipes."""
        require_posix("servos that follow a live drive")
        self._done = False
        context: Any = get_context("spawn")
        self._control, control = context.Pipe()
        samples, sender = context.Pipe(duplex=False)
        # Starting Python's resource tracker unblocks signals, so start it before the signals are blocked.
        with safe_path():
            resource_tracker.ensure_running()
        with signals_held(), safe_path():
            servo_time = context.RawArray("d", [NOT_STARTED, 0.0])
            self._process = context.Process(
                target=simulate, args=(request, control, sender, servo_time), name="dynsim simulation", daemon=True
            )
            self._process.start()
        # Close these ends of the pipes in this process; otherwise it would not notice that the other process has ended.
        control.close()
        sender.close()
        self._servo_time = servo_time
        self.feed = PipeFeed(samples, servo_time, request.servo_map)

    def __enter__(self) -> SimulationProcess:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._control.close()
        self._process.join(PATIENCE if self._done else 0.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self.feed.close()

    def ready(self) -> Ready:
        """Wait until the simulation can be driven; this may include the time to compile kernels.

        Raises
        ------
        DynsimError
            If the simulation fails to start.
        """
        while not self._control.poll(POLL_INTERVAL):
            interruption.check()
        message = self._receive()
        if isinstance(message, DynsimError):
            raise message
        assert isinstance(message, Ready)
        return message

    def wait_for_pilot(self) -> None:
        """Wait until a browser is connected, because servos must not be armed before.

        Raises
        ------
        DynsimError
            If the drive ends before.
        """
        while not self._servo_time[1]:
            interruption.check()
            if self._control.poll(POLL_INTERVAL):
                raise DynsimError(f"the drive ended before a pilot was connected: {self._receive().report.ended}")

    def finish(self, why: str) -> Done:
        """End the drive, if it has not ended yet, and wait until it has been saved.

        Raises
        ------
        DynsimError
            If the process ended before the drive was saved.
        """
        with suppress(OSError):
            self._control.send(why)
        message = self._receive()
        assert isinstance(message, Done)
        self._done = True
        return message

    def _receive(self) -> Any:
        try:
            return self._control.recv()
        except (EOFError, OSError):
            self._process.join(PATIENCE)
            text = f"the process of the simulation ended with code {self._process.exitcode}"
            raise DynsimError(f"{text}; the drive is not saved") from None
