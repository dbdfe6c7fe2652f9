"""Replay session: opens the port, runs the replay, writes its files, and raises its failures as exceptions."""

from __future__ import annotations

import errno
import json
import sys
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

from dynsim.errors import DynsimError, brief
from dynsim.hardware.bus.protocol import Bus, Clock
from dynsim.hardware.errors import OutputsFailed, PortError, ReplayAborted, ReplayInterrupted, VerificationFailed
from dynsim.hardware.replay.check import MotionTask
from dynsim.hardware.replay.machine import RECORD, Replay
from dynsim.hardware.replay.measured import write_measured
from dynsim.hardware.replay.output import (
    INTERVAL,
    LOG,
    MEASURED,
    PART,
    SUMMARY,
    Background,
    GrowingFile,
    ReplayResult,
    move_away,
    row_stream,
)
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.servo_map import ServoMap
from dynsim.system.files import write_json

Failures = dict[str, BaseException]


def run_replay(
    motion: MotionTask,
    servo_map: ServoMap,
    connection: AbstractContextManager[tuple[Bus, Clock]],
    folder: Path,
    *,
    live: bool = False,
    **options: Any,
) -> ReplayResult:
    """Replay a checked motion; write ``measured.h5``, ``summary.json``, ``replay.log`` and register dumps.

    Files of an earlier replay are moved to a subfolder first. During the replay, a separate thread writes the log and
    saves the cycles in ``measured.part``. If this process dies, :func:`dynsim.hardware.replay.measured.recover` can
    build a record from this file.

    Parameters
    ----------
    motion : MotionTask
    servo_map : ServoMap
    connection : context manager
        Context manager that yields the bus and the clock, see :func:`dynsim.hardware.ports.bus_on`.
    folder : Path
        Output folder.
    live : bool
        If False, perform a dry run, in which the robot does not move.
    **options
        Further options for :class:`dynsim.hardware.replay.machine.Replay`.

    Raises
    ------
    PortError, VerificationFailed
        If the replay failed before any servo was armed.
    ReplayInterrupted
        If a signal stopped the run.
    ReplayAborted
        If an abort rule stopped the run.
    OutputsFailed
        If the motion succeeded but an output could not be written.
    """
    failures: Failures = {}
    result: ReplayResult | None = None
    try:
        with connection as (bus, clock):
            replay = Replay(motion, servo_map, bus, clock, live=live, dump_folder=folder, **options)
            background = _open_outputs(replay, folder)
            try:
                replay.run()
            except Exception as error:
                # All errors before the record is built are faults.
                failures[RECORD] = error
            finally:
                result = replay.result
                failures |= background.close() | replay.journal.failures
    except BaseException as error:
        if result is None and (isinstance(error, DynsimError) or not isinstance(error, Exception)):
            raise
        if result is None:
            raise PortError(f"unexpected error: {brief(error)}; nothing was moved") from error
        if not isinstance(error, Exception):
            _save(result, folder, failures)
            raise
        # The result and its end state are valid, because only closing the port has failed.
        failures["port"] = error
    _save(result, folder, failures)
    raise_for(result, folder, failures)
    return result


@contextmanager
def shown_by(folder: Path) -> Iterator[Failures]:
    """Report failures to display a replay in the block in the same way as files that could not be written.

    The failures, also those of standard output, are added to ``outputs_failed`` in the summary, which has been written
    before.

    Parameters
    ----------
    folder : Path
        Folder with the summary.

    Yields
    ------
    failures : dict
        Dictionary to which the block adds other failures.

    Raises
    ------
    OutputsFailed
        If there are failures and the block has raised no error; if it has raised an error, a warning reports them.
    """
    failures: Failures = {}
    try:
        yield failures
    except DynsimError as error:
        _flush(failures)
        if failures:
            warnings.warn(_failure_text(failures), stacklevel=3)
            # After other errors, the summary may belong to an earlier replay.
            if isinstance(error, ReplayAborted | OutputsFailed):
                _add_to_summary(folder, failures)
        raise
    except Exception as error:
        # An error of this program outside the motion, whose end state has been logged.
        text = (
            f"unexpected error: {brief(error)}; for the end state of the robot, see {folder / LOG}{_recovery(folder)}"
        )
        raise ReplayAborted(text) from error
    _flush(failures)
    if failures:
        _add_to_summary(folder, failures)
        raise OutputsFailed(f"the replay succeeded, but {_failure_text(failures)}; see {folder / LOG}")


def _flush(failures: Failures) -> None:
    """Add the failure of standard output."""
    if sys.stdout is not None:
        sys.stdout.flush()
    failure = getattr(sys.stdout, "failure", None)
    # A reader that closes the pipe early (``| head``) is not a failure.
    if failure is not None and failure.errno != errno.EPIPE:
        failures["standard output"] = failure


def _add_to_summary(folder: Path, failures: Failures) -> None:
    # If the summary cannot be changed, the failure is still reported on standard error.
    with suppress(OSError, ValueError, DynsimError):
        summary = json.loads((folder / SUMMARY).read_bytes())
        write_json(folder / SUMMARY, summary | {"outputs_failed": summary["outputs_failed"] | _messages(failures)})


def _open_outputs(replay: Replay, folder: Path) -> Background:
    """Move the files of an earlier replay away, and open log and streamed record."""
    log, files = replay.journal.log, list[GrowingFile]()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        moved = move_away(folder)
        files.append(GrowingFile("log", folder / LOG, log.pending))
        files.append(row_stream(folder / PART, replay.recorder, replay.layout, replay.motion.scene))
        background = Background(files, INTERVAL)
    except (OSError, RuntimeError) as error:
        # Remove the empty files; otherwise they would look like the files of a replay that died.
        for file in files:
            file.discard()
        reason = getattr(error, "strerror", None) or error
        raise PortError(f"{folder}: cannot be written ({reason}); nothing was moved") from error
    log.wake = background.wake
    if moved:
        replay.journal.add_line(f"files of an earlier replay were moved to {moved}")
    return background


def _save(result: ReplayResult, folder: Path, failures: Failures) -> None:
    """Write the record and the summary, remove the streamed record that they replace; add errors to ``failures``."""
    try:
        if RECORD not in failures:
            summary = result.record.summary | {"outputs_failed": _messages(failures)}
            write_measured(result.record, summary, folder)
    except Exception as error:
        failures[RECORD] = error
    if RECORD not in failures:
        # The record is complete, even if the streamed record cannot be removed.
        try:
            (folder / PART).unlink()
        except OSError as error:
            failures[f"removal of {PART}"] = error
            _add_to_summary(folder, failures)
        return
    # Write the end state of the robot even if there is no space for the record.
    try:
        write_json(folder / SUMMARY, result.summary() | {"outputs_failed": _messages(failures)})
    except Exception as error:
        failures["summary"] = error


def _messages(failures: Failures) -> dict[str, str]:
    return {name: str(error) or type(error).__name__ for name, error in failures.items()}


def _failure_text(failures: Failures) -> str:
    return "; ".join(f"{name} failed: {text}" for name, text in _messages(failures).items())


def _recovery(folder: Path) -> str:
    """Return how to recover the record, if it has not been written."""
    return f"; `dynsim hw recover {folder}` builds a record from the saved cycles" if (folder / PART).exists() else ""


def raise_for(result: ReplayResult, folder: Path, failures: Failures) -> None:
    """Raise the exception that corresponds to the fault or to failed outputs; return if there are none.

    Raises
    ------
    VerificationFailed, PortError, ReplayInterrupted, ReplayAborted, OutputsFailed
    """
    lost = _failure_text(failures)
    if failures and RECORD not in failures:
        lost += f"; {folder / MEASURED} is complete"
    else:
        lost += _recovery(folder)
    fault = result.fault
    if fault is None:
        if failures:
            raise OutputsFailed(f"the motion succeeded (end state: {result.end_state}), but {lost}")
        return
    unconfirmed = ""
    if result.torque_still_on:
        unconfirmed = f"; torque off NOT confirmed by ID {', '.join(map(str, result.torque_still_on))}"
    left = f"end state: {result.end_state}{unconfirmed}; see {folder / LOG}{'; ' + lost if lost else ''}"
    if fault.cause == Cause.INTERRUPTED:
        raise ReplayInterrupted(f"{result.fault_text}; {left}", result=result)
    if fault.cause == Cause.VERIFICATION:
        raise VerificationFailed(fault.text)
    if fault.cause == Cause.PORT and result.end_state == "not armed":
        raise PortError(fault.text)
    raise ReplayAborted(f"{result.fault_text}; {left}", result=result)
