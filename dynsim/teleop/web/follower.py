"""Process of a simulation that is driven by a pilot and followed by servos.

    loop of the servos                                 this process
    ------------------                                 ------------
    writes how far its time is, shared     ──▶         ServoFollower.ready: the next tick may be simulated
    reads a pipe without waiting           ◀──         ServoFollower.hear: writes a posture for every tick

The loop of the servos has an interpreter of its own, so compilation, browsers or disks in this process do not block it.
"""

from __future__ import annotations

import math
import os
import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from dynsim.engine.recording import save_drive
from dynsim.errors import CheckRefused, DynsimError, RecordError
from dynsim.hardware.bus.protocol import require_posix
from dynsim.hardware.replay.drive import LiftLookahead, Sample, lead
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

NOT_YET = -math.inf
"""Time that the servos report before they have reached the initial posture."""
NICENESS = 5
REGULAR, BROKEN, NOT_LIFTED = 0.0, 1.0, 2.0
"""Codes of the end of a drive, sent after a time that is not a number."""


@dataclass(frozen=True)
class DriveRequest:
    """Inputs of a drive."""

    scenario: Scenario
    servo_map: ServoMap
    limits: SpeedLimits
    longest: float
    http_port: int
    until_closed: bool
    folder: Path


@dataclass(frozen=True)
class Ready:
    """What the servos must know before they move; ``step`` is that of the samples [s]."""

    address: str
    still: Record
    first: Sample
    step: float


@dataclass(frozen=True)
class Done:
    """How the drive went; ``saved`` is false where there was nothing to save, ``failure`` says why it was not."""

    report: DriveReport
    driven: float
    saved: bool
    failure: DynsimError | None


def frame_of(servos: int, lifting: int) -> struct.Struct:
    """A sample in the pipe: time, angles, rates, and what lifting adds to both at the joints that lift wheels."""
    return struct.Struct(f"={1 + 2 * (servos + lifting)}d")


def lifting_columns(servo_map: ServoMap) -> list[int]:
    """Joints that lift wheel pairs, by their place in the map."""
    return [servo_map.joints.index(joint) for joint in servo_map.lifts.joints] if servo_map.lifts else []


class Columns:
    """Which of a simulation's joints the servos of a map follow.

    Raises
    ------
    CheckRefused
        There is no such signal or column, a live drive does not have it, or the robot lifts wheels and the map does
        not say how.
    """

    def __init__(self, session: Session, servo_map: ServoMap) -> None:
        still, known = session.still, session.joints()
        if servo_map.lifts is None and LIFTED in known:
            raise CheckRefused(
                "the robot lifts wheel pairs and the servo map does not say how: without it they would drag over the "
                "floor. Add an entry `lifts` to the map"
            )
        self._lifts = servo_map.lifts
        if self._lifts is not None and self._lifts.signal not in known:
            raise CheckRefused(f"lifts.signal: a live drive has no {self._lifts.signal!r}; it has {', '.join(known)}")
        self._session = session
        self._position = np.array([servo.hold_at or 0.0 for servo in servo_map.servos])
        self._velocity = np.zeros(len(self._position))
        # Index of the servo, where its angle is, and where its rate; held rates are differences of the angles.
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
                    f"{servo.joint} follows the signal {missing[0]!r}, which a live drive does not have; it has "
                    f"{', '.join(known)}. Rates of a sampled controller are `rates: held`"
                )
            position, *rates = ((name, still.labels[name].index(servo.label)) for name in signals)
            self._sources.append((index, position, rates[0] if rates else None))

    def now(self) -> tuple[Array, Array]:
        """Angles [rad] and rates [rad/s] in the order of the map, shape (N,)."""
        joints = self._session.joints()
        for index, (signal, column), rates in self._sources:
            self._position[index] = joints[signal][column]
            if rates is not None:
                self._velocity[index] = joints[rates[0]][rates[1]]
        return self._position, self._velocity

    def sample(self) -> Sample:
        """The same, at the time of the simulation."""
        position, velocity = self.now()
        return Sample(self._session.time, position.copy(), velocity.copy())

    def base(self, yaw: tuple[str, list[int]]) -> tuple[Array, Array]:
        """Yaw angles of the base part, from columns of a signal [rad], and which wheel pairs are on the ground."""
        assert self._lifts is not None
        joints = self._session.joints()
        signal, columns = yaw
        return joints[signal][columns], joints[self._lifts.signal]


class ServoFollower:
    """A :class:`~dynsim.teleop.web.live.Follower` behind a pipe.

    Parameters
    ----------
    session : the simulation
    servo_map : of the servos
    samples : the pipe
    heard : shared memory with the time of the servos [s]

    Raises
    ------
    CheckRefused
        See :class:`Columns`.
    """

    def __init__(self, session: Session, servo_map: ServoMap, samples: Connection, heard: Any) -> None:
        self._session, self._columns = session, Columns(session, servo_map)
        self.lookahead = LiftLookahead(session.still, servo_map, session.period) if servo_map.lifts else None
        # By how much the simulation may be ahead of the servos [s].
        self._ahead = lead(servo_map) + (self.lookahead.delay if self.lookahead is not None else 0.0)
        self._samples, self._heard, self._lifting = samples, heard, lifting_columns(servo_map)
        self.first = self._columns.sample()
        self._frame = frame_of(len(self.first.position), len(self._lifting))
        if self.lookahead is not None:
            self.first = self.lookahead.begin(self.first, *self._columns.base(self.lookahead.yaw))

    @property
    def begun(self) -> bool:
        return self._heard[0] > NOT_YET

    @property
    def ready(self) -> bool:
        return (self._session.ticks + 1) * self._session.period <= self._heard[0] + self._ahead

    @property
    def steady(self) -> bool:
        return self.lookahead is None or self.lookahead.steady(self._session.time)

    def hear(self) -> None:
        sample, lookahead = self._columns.sample(), self.lookahead
        for whole in [sample] if lookahead is None else lookahead.add(sample, *self._columns.base(lookahead.yaw)):
            self._tell(whole)

    def finish(self) -> None:
        """There was no tick that is not to be followed: what is held back goes on."""
        for sample in self.lookahead.remaining() if self.lookahead is not None else []:
            self._tell(sample)

    def end(self, how: float) -> None:
        """There are no more samples."""
        self._write(math.nan, how, *[0.0] * (self._frame.size // 8 - 2))
        self._samples.close()

    def _tell(self, sample: Sample) -> None:
        added: list[float] = []
        for values in (sample.lift, sample.lift_rate) if self._lifting else ():
            added += np.asarray(values)[self._lifting].tolist()
        self._write(sample.time, *sample.position, *sample.velocity, *added)

    def _write(self, *numbers: float) -> None:
        # Servos that are gone are told of elsewhere.
        with suppress(OSError):
            os.write(self._samples.fileno(), self._frame.pack(*numbers))


def simulate(request: DriveRequest, control: Connection, samples: Connection, heard: Any) -> None:
    """What the process does: says Ready or an error, drives, saves, and says Done.

    It ends when it is told to by any word, or when whoever would tell it is gone.
    """
    # A terminal sends these to all processes of a group; only the one with the servos heeds them.
    ignore_stops()
    # On a busy computer the servos come first.
    with suppress(AttributeError, OSError):
        os.nice(NICENESS)
    ending = _Ending(control)
    try:
        session = begin(request.scenario, limits=request.limits, longest=request.longest)
        follower = ServoFollower(session, request.servo_map, samples, heard)
        drive = LiveDrive(session, request.scenario.variant or request.scenario.name, follower)
        address = drive.open(request.http_port)
    except Exception as error:
        _say(control, error if isinstance(error, DynsimError) else DynsimError(f"the simulation failed: {error!r}"))
        return
    how = BROKEN
    refused: CheckRefused | None = None
    try:
        ending.of(drive)
        _say(control, Ready(address, session.still, follower.first, session.period))
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
    _say(control, _saved(session, drive.report, request.folder, refused))


def _saved(session: Session, report: DriveReport, folder: Path, refused: CheckRefused | None) -> Done:
    time = session.ticks * session.period
    stop, report.stop = report.stop, None  # it holds a record, which need not go through the pipe
    if session.ticks == 0:
        return Done(report, time, saved=False, failure=stop)
    try:
        save_drive(session.record() if stop is None or stop.record is None else stop.record, folder)
    except DynsimError as error:
        return Done(report, time, saved=False, failure=error)
    except Exception as error:
        return Done(report, time, saved=False, failure=RecordError(f"the drive was not saved: {error!r}"))
    return Done(report, time, saved=True, failure=refused if stop is None else type(stop)(str(stop)))


def _say(control: Connection, message: Any) -> None:
    with suppress(OSError):
        control.send(message)


class _Ending:
    """Hears in a thread of its own that the drive is to end."""

    def __init__(self, control: Connection) -> None:
        self._drive: LiveDrive | None = None
        self._why = ""
        self._lock = threading.Lock()
        self._control = control
        threading.Thread(target=self._listen, name="dynsim ending", daemon=True).start()

    def of(self, drive: LiveDrive) -> None:
        """Whose end it is."""
        with self._lock:
            self._drive = drive
            if self._why:
                drive.end(self._why, at_once=True)

    def _listen(self) -> None:
        try:
            why = str(self._control.recv())
        except (EOFError, OSError):
            why = "the process with the servos has gone"
            if self._drive is None:
                # Nothing has begun, and nobody waits for it.
                os._exit(1)
        with self._lock:
            self._why = why
            if self._drive is not None:
                self._drive.end(why, at_once=True)


# The servo side of a drive: starts and ends the simulation's process, and follows its postures.


PIECE = 1 << 16
FAULTS = {
    BROKEN: "the simulation has ended by itself",
    NOT_LIFTED: "wheel pairs cannot be lifted as the pilot's robot has them",
}
LOOK = 0.2
"""Interval of the checks for Ctrl-C while waiting for the simulation [s]."""
PATIENCE = 5.0
"""Longest wait for the end of a process that has finished its work [s]."""


class PipeFeed:
    """A :class:`~dynsim.hardware.replay.drive.Feed` from another process.

    Attributes
    ----------
    over : bool
    fault : str
    """

    def __init__(self, samples: Connection, heard: Any, servo_map: ServoMap) -> None:
        self.over, self.fault = False, ""
        self._descriptor = samples.fileno()
        os.set_blocking(self._descriptor, False)
        self._samples, self._heard = samples, heard
        self._servos, self._lifting = len(servo_map.servos), lifting_columns(servo_map)
        self._frame = frame_of(self._servos, len(self._lifting))
        self._bytes = b""
        self._gone = False

    def take(self, most: int) -> Sequence[Sample]:
        self._read()
        size = self._frame.size
        samples: list[Sample] = []
        while len(self._bytes) >= size and len(samples) < most and not self.over and not self.fault:
            numbers = np.array(self._frame.unpack(self._bytes[:size]))
            self._bytes = self._bytes[size:]
            time, values = float(numbers[0]), numbers[1:]
            if time == time:
                samples.append(self._sample(time, values))
            elif values[0] in FAULTS:
                self.fault = FAULTS[values[0]]
            else:
                self.over = True
        if self._gone and len(self._bytes) < size and not self.over and not self.fault:
            self.fault = "the process of the simulation is gone"
        return samples

    def report_time(self, time: float) -> None:
        self._heard[0] = time

    def close(self) -> None:
        """Nothing more is wanted."""
        self._samples.close()

    def _sample(self, time: float, values: Array) -> Sample:
        count, joints = self._servos, self._lifting
        position, velocity, added = values[:count], values[count : 2 * count], values[2 * count :]
        if not joints:
            return Sample(time, position, velocity)
        lift = np.zeros((2, count))
        lift[:, joints] = added.reshape(2, -1)
        return Sample(time, position, velocity, lift[0], lift[1])

    def _read(self) -> None:
        with suppress(BlockingIOError):
            while not self._gone:
                piece = os.read(self._descriptor, PIECE)
                self._gone = not piece
                self._bytes += piece


@contextmanager
def safe_path() -> Iterator[None]:
    """Python that is started within does not run a ``signal.py`` of the working directory."""
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
    """A drive in a process of its own; within its block, after which nothing of it is left.

    Attributes
    ----------
    feed : PipeFeed
    """

    def __init__(self, request: DriveRequest) -> None:
        """Start it; raises PortError on a system without POSIX's pipes."""
        require_posix("servos that follow a live drive")
        self._done = False
        context: Any = get_context("spawn")
        self._control, control = context.Pipe()
        samples, there = context.Pipe(duplex=False)
        # Python's own helper lets signals through again when it is started: not while they are held.
        with safe_path():
            resource_tracker.ensure_running()
        with signals_held(), safe_path():
            heard = context.RawArray("d", [NOT_YET])
            self._process = context.Process(
                target=simulate, args=(request, control, there, heard), name="dynsim simulation", daemon=True
            )
            self._process.start()
        # Their ends here would hide the end of the process.
        control.close()
        there.close()
        self.feed = PipeFeed(samples, heard, request.servo_map)

    def __enter__(self) -> SimulationProcess:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._control.close()
        self._process.join(PATIENCE if self._done else 0.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self.feed.close()

    @property
    def pid(self) -> int:
        """Of the process."""
        return int(self._process.pid)

    def ready(self) -> Ready:
        """Wait until it can be driven; kernels may have to be compiled for that.

        Raises
        ------
        DynsimError
            It cannot.
        """
        while not self._control.poll(LOOK):
            interruption.check()
        said = self._hear()
        if isinstance(said, DynsimError):
            raise said
        assert isinstance(said, Ready)
        return said

    def finish(self, why: str) -> Done:
        """End the drive, unless it has ended, and wait until it is saved.

        Raises
        ------
        DynsimError
            The process was gone before.
        """
        with suppress(OSError):
            self._control.send(why)
        said = self._hear()
        assert isinstance(said, Done)
        self._done = True
        return said

    def _hear(self) -> Any:
        try:
            return self._control.recv()
        except (EOFError, OSError):
            self._process.join(PATIENCE)
            text = f"the process of the simulation ended with code {self._process.exitcode}"
            raise DynsimError(f"{text}; what was driven is not saved") from None
