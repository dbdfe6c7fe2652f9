"""Exceptions raised by replays and hardware commands: one class per cause, each with an exit code."""

from __future__ import annotations

from typing import Any, ClassVar

from dynsim.errors import DynsimError


class ServoMapError(DynsimError):
    """A servo map, fault script or gate file is unreadable or invalid; the message states file, line, key and fix."""


class PortError(DynsimError):
    """The port cannot be opened, is in use by another process, or has failed."""

    exit_code: ClassVar[int] = 3


class VerificationFailed(DynsimError):
    """The servos on the bus do not match the servo map or are not ready to move."""

    exit_code: ClassVar[int] = 3


class ReplayAborted(DynsimError):
    """An abort rule stopped the replay; the fault policy was applied, and the log contains the reason.

    Attributes
    ----------
    result : ReplayResult
        End state, measured record and timing of the run up to the abort.
    """

    exit_code: ClassVar[int] = 4

    def __init__(self, message: str, *, result: Any = None) -> None:
        super().__init__(message)
        self.result = result


class ReplayInterrupted(ReplayAborted):
    """The user or a signal stopped the replay."""

    exit_code: ClassVar[int] = 130


class OutputsFailed(DynsimError):
    """The motion succeeded, but the log, the record or another output could not be written."""

    exit_code: ClassVar[int] = 1


class ComparisonGateFailed(DynsimError):
    """The measured run differs from the simulated run by more than the gate file allows."""

    exit_code: ClassVar[int] = 5
