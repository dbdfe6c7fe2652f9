"""Size check of a record, and the end of complete and incomplete runs, for both engines."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NoReturn

from dynsim.errors import ScenarioError, SimulationInterrupted, SimulationStopped
from dynsim.record import Record
from dynsim.scenario import Scenario
from dynsim.system import interruption


def check_size(scenario: Scenario, rows: int, columns: int) -> None:
    """Raise an error if a record is larger than ``record.size_limit_GB``.

    Raises
    ------
    ScenarioError
        If the record is too large; the message contains the recording rate that would fit.
    """
    rate, limit = scenario.record.rate_hz, scenario.record.size_limit_GB
    size = 8e-9 * rows * columns
    if size > limit:
        raise ScenarioError(
            f"record.rate_hz = {rate:g}: {scenario.duration_s:g} s of {columns} columns need {size:.3g} GB; the limit "
            f"(record.size_limit_GB) is {limit:g} GB; {rate * limit / size:.3g} Hz would fit"
        )


def interrupted(scenario: Scenario, time: float, state: dict[str, Any]) -> SimulationInterrupted:
    """Return the exception for a run that Ctrl-C interrupted at a time [s]."""
    return SimulationInterrupted(
        f"interrupted at t = {time:.3f} s of {scenario.duration_s:g} s", time=time, state=state
    )


def mark_stopped(stop: SimulationStopped, record: Record) -> None:
    """Mark the record as incomplete and add the reason to its summary and provenance."""
    record.complete = False
    record.summary["warnings"].append(f"incomplete: {stop}")
    record.provenance["stopped"] = {"time_s": stop.time, "reason": str(stop), "kind": stop.kind, "state": stop.state}


def raise_stopped(stop: SimulationStopped, record: Record) -> NoReturn:
    """Mark the record as incomplete, unless it is already marked, and raise ``stop`` with it."""
    if "stopped" not in record.provenance:
        mark_stopped(stop, record)
    stop.record = record
    raise stop


def run_to_end(
    work: Callable[[], None], interrupt: Callable[[], SimulationInterrupted], record: Callable[[], Record]
) -> Record:
    """Do the work of a run and return its record; from its end on, signals are postponed.

    Parameters
    ----------
    work : callable
        Runs to the end.
    interrupt : callable
        Returns the exception for a run that Ctrl-C ended.
    record : callable
        Returns the record up to now.

    Raises
    ------
    SimulationStopped
        If the run ended early; ``error.record`` is its record.
    """
    stop: SimulationStopped | None = None
    try:
        work()
        interruption.keep()
    except SimulationStopped as ended:
        interruption.keep()
        stop = ended
    except KeyboardInterrupt:
        interruption.keep()
        interruption.answered()
        stop = interrupt()
    result = record() if stop is None or stop.record is None else stop.record
    if stop is not None:
        raise_stopped(stop, result)
    return result
