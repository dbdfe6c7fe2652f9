"""Exceptions raised by dynsim: one class per cause, each with an exit code for the command line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar


class DynsimError(Exception):
    """Base class of all dynsim errors; the command line prints them without a traceback.

    Attributes
    ----------
    exit_code : int
        Exit code of the command line: 2 for invalid input, 3 if a run stopped early, 130 after Ctrl-C.

    Examples
    --------
    >>> import dynsim
    >>> try:
    ...     dynsim.load_scenario("single_pendulum", overrides={"duration_s": -1})
    ... except dynsim.DynsimError as error:
    ...     print(type(error).__name__, error.exit_code)
    ScenarioError 2
    """

    exit_code: ClassVar[int] = 2


def brief(value: object) -> str:
    """Return the ``repr`` of a value for an error message, on one line and shortened to 80 characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def first_few(names: Sequence[str], most: int = 4) -> str:
    """Return the first ``most`` names, separated by commas, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


class ScenarioError(DynsimError):
    """A scenario cannot be read or is invalid; the message states the file, line, key, value and fix."""


class PluginError(DynsimError):
    """A plug-in (surface, motor, path, plant or controller) does not exist, or its package fails to load."""


class ModelError(DynsimError):
    """Bodies, joints, motors or contacts do not define a valid physical model.

    Attributes
    ----------
    keys : tuple
        Path of the faulty key in the scenario, used to look up its line; empty if no single key is at fault.
    """

    def __init__(self, message: str, *, keys: tuple[int | str, ...] = ()) -> None:
        super().__init__(message)
        self.keys = keys


class UnreachableReference(DynsimError):
    """The joints cannot follow a reference path; the message states the time and the reason.

    Attributes
    ----------
    keys : tuple
        Key of the reference path in the scenario, as in :class:`ModelError`.
    """

    keys: ClassVar[tuple[int | str, ...]] = ("controller", "hand", "path")


class CheckRefused(DynsimError):
    """A robot cannot or must not execute a motion; the message states the joint or body, the time and the margin."""


class RecordError(DynsimError):
    """A record cannot be written or read."""


class MissingEntry(RecordError, KeyError):
    """A record has no signal (or its summary has no entry) with the requested name; the message lists all names."""

    # A KeyError would print its message in quotes.
    __str__ = Exception.__str__


class SimulationStopped(DynsimError):
    """The simulation could not continue (divergence, no solution, no progress).

    Attributes
    ----------
    kind : str
        Reason as one word, such as ``step_too_small``; empty if the dynamics engine did not cause the stop.
    time : float
        Simulated time of the stop [s].
    state : dict[str, Any]
        Last valid state: the value of each quantity, by name.
    record : Record | None
        Results up to the stop, if any.
    """

    exit_code: ClassVar[int] = 3

    def __init__(
        self, message: str, *, time: float = float("nan"), state: dict[str, Any] | None = None, kind: str = ""
    ) -> None:
        super().__init__(message)
        self.kind = kind
        self.time = time
        self.state = state or {}
        self.record: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        # By default, an exception is pickled with its arguments only; add the state and the record.
        return _rebuild, (type(self), str(self), self.time, self.state, self.kind, self.record)


class SimulationInterrupted(SimulationStopped):
    """The user pressed Ctrl-C; the results so far are kept and marked incomplete."""

    exit_code: ClassVar[int] = 130


def _rebuild(
    made: type[SimulationStopped], message: str, time: float, state: dict[str, Any], kind: str, record: Any
) -> Any:
    stop = made(message, time=time, state=state, kind=kind)
    stop.record = record
    return stop
