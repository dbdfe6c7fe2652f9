"""A replay session: opens the port, runs the replay, writes its files, and raises its failures as exceptions."""

from __future__ import annotations

import errno
import json
import warnings
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

from dynsim.errors import DynsimError
from dynsim.hardware.bus.protocol import Bus, Clock
from dynsim.hardware.errors import OutputsFailed, PortError, ReplayAborted, ReplayInterrupted, VerificationFailed
from dynsim.hardware.replay.machine import RECORD, Replay
from dynsim.hardware.replay.measured import write_measured
from dynsim.hardware.replay.output import (
    INTERVAL,
    LOG,
    MEASURED,
    PART,
    SUMMARY,
    Background,
    ReplayResult,
    RowStream,
    RunLog,
    move_away,
)
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.replay.trajectory import MotionTask
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
    """Replay a checked motion; ``measured.h5``, ``summary.json``, ``replay.log`` and register dumps go to ``folder``.

    What an earlier replay left there is moved away first. While the replay runs its log and its cycles are written by a
    thread of their own, the cycles to ``measured.part``: when this process dies
    :func:`dynsim.hardware.replay.measured.recover` makes a record of it.

    ``connection`` gives bus and clock (:func:`dynsim.hardware.ports.bus_on`); the options are those of
    :class:`dynsim.hardware.replay.machine.Replay`.

    Raises
    ------
    PortError, VerificationFailed
        Nothing was armed.
    ReplayInterrupted
        A signal stopped the run.
    ReplayAborted
        An abort rule did.
    OutputsFailed
        The motion went well, but something could not be written.
    """
    failures: Failures = {}
    result: ReplayResult | None = None
    try:
        with connection as (bus, clock):
            log, moved = _open_log(folder)
            replay = Replay(motion, servo_map, bus, clock, live=live, log=log, dump_folder=folder, **options)
            background = _stream(replay, log, folder)
            try:
                if moved:
                    replay.journal.say(f"the result of an earlier replay is now in {moved}")
                result = replay.run()
            finally:
                failures |= background.close()
            failures |= replay.journal.failures
    except Exception as error:
        if result is None:
            raise
        # The robot has been left as the result says; only closing the port has failed.
        failures["port"] = error
    _save(result, folder, failures)
    raise_for(result, folder, failures)
    return result


@contextmanager
def shown_by(outputs: Mapping[str, Any], folder: Path) -> Iterator[Failures]:
    """Within the block a replay is shown; what failed of that is told like the files that could not be written.

    It joins ``outputs_failed`` in the summary, which was written before. The block leaves failures in the dictionary
    that it is given; those of ``outputs``, streams by name that keep their ``failure``, join them.

    Raises
    ------
    OutputsFailed
        Where nothing else was raised in the block; else it is a warning.
    """
    failures: Failures = {}
    try:
        yield failures
    except DynsimError as error:
        _flush(outputs, failures)
        if failures:
            warnings.warn(_lost(failures), stacklevel=3)
            # With other errors the summary may be that of an earlier replay.
            if isinstance(error, ReplayAborted | OutputsFailed):
                _add_to_summary(folder, failures)
        raise
    _flush(outputs, failures)
    if failures:
        _add_to_summary(folder, failures)
        raise OutputsFailed(f"the replay went well; {_lost(failures)}; see {folder / LOG}")


def _flush(outputs: Mapping[str, Any], failures: Failures) -> None:
    for name, stream in outputs.items():
        if stream is not None:
            stream.flush()
        failure = getattr(stream, "failure", None)
        # A reader that wants no more (``| head``) is no failure.
        if failure is not None and failure.errno != errno.EPIPE:
            failures[name] = failure


def _add_to_summary(folder: Path, failures: Failures) -> None:
    # Where it cannot be added it is still told on standard error.
    with suppress(OSError, ValueError, DynsimError):
        summary = json.loads((folder / SUMMARY).read_bytes())
        write_json(folder / SUMMARY, summary | {"outputs_failed": summary["outputs_failed"] | _named(failures)})


def _open_log(folder: Path) -> tuple[RunLog, Path | None]:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        moved = move_away(folder)
        log = RunLog(folder / LOG)
    except OSError as error:
        raise PortError(f"{folder}: cannot be written ({error.strerror}); nothing was moved") from error
    return log, moved


def _stream(replay: Replay, log: RunLog, folder: Path) -> Background:
    stream = None
    try:
        stream = RowStream(folder / PART, replay.recorder, replay.layout, replay.motion.scene)
        background = Background([log, stream], INTERVAL)
    except (OSError, RuntimeError) as error:
        # What holds nothing would pass for a replay that died.
        for outlet in (log, stream):
            if outlet is not None:
                outlet.discard()
        raise PortError(f"{folder}: cannot be written ({error}); nothing was moved") from error
    log.wake = background.wake
    return background


def _save(result: ReplayResult, folder: Path, failures: Failures) -> None:
    """Write record and summary, and remove the streamed record that they replace; errors join ``failures``."""
    try:
        if RECORD not in failures:
            summary = result.record.summary | {"outputs_failed": _named(failures)}
            write_measured(result.record, summary, folder)
    except Exception as error:
        failures[RECORD] = error
    if RECORD not in failures:
        # The record is whole, whatever becomes of what it replaces.
        try:
            (folder / PART).unlink()
        except OSError as error:
            failures[f"removal of {PART}"] = error
            _add_to_summary(folder, failures)
        return
    # What happened to the robot is told even where there is no room for its record.
    try:
        write_json(folder / SUMMARY, result.summary() | {"outputs_failed": _named(failures)})
    except Exception as error:
        failures["summary"] = error


def _named(failures: Failures) -> dict[str, str]:
    return {name: str(error) or type(error).__name__ for name, error in failures.items()}


def _lost(failures: Failures) -> str:
    return "; ".join(f"{name} failed: {text}" for name, text in _named(failures).items())


def raise_for(result: ReplayResult, folder: Path, failures: Failures) -> None:
    """Turn a fault, or else a failure of outputs, into the exception that carries its exit code.

    Raises
    ------
    VerificationFailed, PortError, ReplayInterrupted, ReplayAborted, OutputsFailed
    """
    lost = _lost(failures)
    if failures and RECORD not in failures:
        lost += f"; {folder / MEASURED} is complete"
    elif (folder / PART).exists():
        lost += f"; `dynsim hw recover {folder}` makes a record of what reached the disk"
    fault, state = result.fault, result.fault_state
    if fault is None or state is None:
        if failures:
            raise OutputsFailed(f"the motion went well, robot left {result.end_state}; {lost}")
        return
    unconfirmed = ""
    if result.torque_still_on:
        unconfirmed = f"; torque off NOT confirmed by ID {', '.join(map(str, result.torque_still_on))}"
    left = f"robot left {result.end_state}{unconfirmed}; see {folder / LOG}{'; ' + lost if lost else ''}"
    if fault.cause == Cause.INTERRUPTED:
        raise ReplayInterrupted(f"{result.fault_text}; {left}", result=result)
    if fault.cause == Cause.VERIFICATION:
        raise VerificationFailed(fault.text)
    if fault.cause == Cause.PORT and result.end_state == "not armed":
        raise PortError(fault.text)
    raise ReplayAborted(f"{result.fault_text}; {left}", result=result)
