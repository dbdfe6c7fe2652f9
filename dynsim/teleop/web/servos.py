"""The servo side of a drive: starts and ends the simulation's process, and follows its postures."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

import numpy as np

from dynsim.errors import DynsimError
from dynsim.hardware.posix import require_posix
from dynsim.hardware.replay.incremental_path import Sample
from dynsim.hardware.replay.motion import Array
from dynsim.hardware.servo_map import ServoMap
from dynsim.studies.processes import signals_held
from dynsim.system import interruption
from dynsim.teleop.web.follower import (
    BROKEN,
    NOT_LIFTED,
    NOT_YET,
    Done,
    DriveRequest,
    Ready,
    frame_of,
    lifting_columns,
    simulate,
)

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

    def tell(self, time: float) -> None:
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
