"""Exceptions of replays and hardware commands, one class per cause, with exit codes."""

from __future__ import annotations

from typing import Any, ClassVar

from dynsim.errors import DynsimError


class ServoMapError(DynsimError):
    """A servo map, fault script or gate file that cannot be read or is not valid (file, line, key, fix)."""


class PortError(DynsimError):
    """The port cannot be opened, is held by another process, or died."""

    exit_code: ClassVar[int] = 3


class VerificationFailed(DynsimError):
    """The servos on the bus are not the ones of the map, or are not fit to move."""

    exit_code: ClassVar[int] = 3


class ReplayAborted(DynsimError):
    """An abort rule fired; the fault policy was carried out and the reason is in the log.

    Attributes
    ----------
    result : ReplayResult
        End state, measured record and timing of the run until then.
    """

    exit_code: ClassVar[int] = 4

    def __init__(self, message: str, *, result: Any = None) -> None:
        super().__init__(message)
        self.result = result


class ReplayInterrupted(ReplayAborted):
    """The user (or a signal) stopped the replay."""

    exit_code: ClassVar[int] = 130


class OutputsFailed(DynsimError):
    """The motion went well, but the log, the record or what else tells of it could not be written."""

    exit_code: ClassVar[int] = 1


class ComparisonGateFailed(DynsimError):
    """The measured run is further from the simulated one than the gate file allows."""

    exit_code: ClassVar[int] = 5
