"""Exceptions of dynsim: one class per cause, each with the exit code of the command line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar


class DynsimError(Exception):
    """Base of all errors a user can meet; printed without a traceback."""

    exit_code: ClassVar[int] = 2


def brief(value: object) -> str:
    """Any value in an error message: in one line, and not long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def first_few(names: Sequence[str], most: int = 4) -> str:
    """Names for a sentence: the first, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


class ScenarioError(DynsimError):
    """A scenario cannot be read or is not valid: the message names file, line, key, value and the fix."""


class PluginError(DynsimError):
    """A member of a family that is not there, or is in a package outside dynsim and does not work."""


class ModelError(DynsimError):
    """A description of bodies, joints, motors or contacts that no physics can be made of.

    Attributes
    ----------
    keys : tuple
        Where in a scenario the fault is, for its line; empty where no one key is to blame.
    """

    def __init__(self, message: str, *, keys: tuple[int | str, ...] = ()) -> None:
        super().__init__(message)
        self.keys = keys


class UnreachableReference(DynsimError):
    """A reference path that the named joints cannot follow (time and distance are in the message).

    Attributes
    ----------
    keys : tuple
        Those of the path in a scenario, as of a :class:`ModelError`.
    """

    keys: ClassVar[tuple[int | str, ...]] = ("controller", "hand", "path")


class CheckRefused(DynsimError):
    """A motion that a robot must not make, or cannot; joint or body, time and margin are in the message."""


class RecordError(DynsimError):
    """A record cannot be written or read."""


class MissingEntry(RecordError, KeyError):
    """A record has no signal, or its summary no entry, of that name; the message lists those that there are."""

    # A KeyError shows its message in quotes.
    __str__ = Exception.__str__


class SimulationStopped(DynsimError):
    """The simulation could not go on (divergence, no solution, no progress).

    Attributes
    ----------
    kind : str
        Why, in a word, such as ``step_too_small``; empty where it is not the engine of the dynamics that stopped.
    time : float
        Simulated time of the stop [s].
    state : dict[str, Any]
        The last good state, by name.
    record : Record | None
        What was simulated until then.
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
        # Exceptions travel between processes by their arguments alone; the state and record must come along.
        return _rebuild, (type(self), str(self), self.time, self.state, self.kind, self.record)


class SimulationInterrupted(SimulationStopped):
    """The user pressed Ctrl-C; what was simulated so far is kept and marked incomplete."""

    exit_code: ClassVar[int] = 130


def _rebuild(
    made: type[SimulationStopped], message: str, time: float, state: dict[str, Any], kind: str, record: Any
) -> Any:
    stop = made(message, time=time, state=state, kind=kind)
    stop.record = record
    return stop
