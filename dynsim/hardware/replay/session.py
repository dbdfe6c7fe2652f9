"""A replay from opening its port to the files it leaves behind."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from dynsim.files import json_text, replace_together
from dynsim.hardware.bus.clock import Clock
from dynsim.hardware.bus.protocol import Bus
from dynsim.hardware.errors import PortError, ReplayAborted, ReplayInterrupted, VerificationFailed
from dynsim.hardware.replay.check import CheckedMotion
from dynsim.hardware.replay.machine import Replay
from dynsim.hardware.replay.rules import Cause
from dynsim.hardware.replay.run_log import RunLog
from dynsim.hardware.replay.states import Progress, ReplayResult, StopRequest
from dynsim.hardware.servo_map import FaultPolicy, ServoMap

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def stop_on_signals(stop: StopRequest) -> Iterator[None]:
    """Signals only count up ``stop``: an exception out of a handler would tear a bus transaction in two."""
    before = {number: signal.signal(number, stop) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run_replay(
    motion: CheckedMotion,
    servo_map: ServoMap,
    connection: AbstractContextManager[tuple[Bus, Clock]],
    folder: Path,
    *,
    policy: FaultPolicy | None = None,
    live: bool = False,
    write_eeprom: bool = False,
    stop: StopRequest | None = None,
    observer: Callable[[Progress], None] | None = None,
    provenance: dict[str, Any] | None = None,
) -> ReplayResult:
    """Replay a checked motion; ``measured.h5``, ``summary.json``, ``replay.log`` and register dumps go to ``folder``.

    ``connection`` gives bus and clock (:func:`dynsim.hardware.ports.bus_on`) and is entered once the folder is there;
    the other parameters are those of :class:`dynsim.hardware.replay.machine.Replay`.

    Raises
    ------
    PortError, VerificationFailed
        Nothing was armed.
    ReplayInterrupted
        A signal stopped the run.
    ReplayAborted
        An abort rule did.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        log = RunLog(folder / "replay.log")
    except OSError as error:
        raise PortError(f"{folder}: cannot be written ({error.strerror}); nothing was moved") from error
    with log, connection as (bus, clock):
        replay = Replay(
            motion,
            servo_map,
            bus,
            clock,
            policy=policy,
            live=live,
            write_eeprom=write_eeprom,
            stop=stop,
            log=log,
            dump_folder=folder,
            observer=observer,
            provenance=provenance,
        )
        result = replay.run()
    try:
        summary = json_text(result.record.summary).encode("utf-8")
        replace_together(folder, {"measured.h5": result.record.to_hdf5(), "summary.json": summary})
    finally:
        # What happened to the robot matters more than a full disk.
        raise_for(result, folder)
    return result


def raise_for(result: ReplayResult, folder: Path) -> None:
    """Turn a fault into the exception that carries its exit code.

    Raises
    ------
    VerificationFailed, PortError, ReplayInterrupted, ReplayAborted
    """
    fault, state = result.fault, result.fault_state
    if fault is None or state is None:
        return
    unconfirmed = ""
    if result.torque_still_on:
        unconfirmed = f"; torque off NOT confirmed by ID {', '.join(map(str, result.torque_still_on))}"
    left = f"robot left {result.end_state}{unconfirmed}; see {folder / 'replay.log'}"
    if fault.cause == Cause.INTERRUPTED:
        others = "".join(f"{other.cause}: {other.text}; " for other in result.faults[1:])
        raise ReplayInterrupted(f"interrupted in {state.name}; {others}{left}", result=result)
    if fault.cause == Cause.VERIFICATION:
        raise VerificationFailed(fault.text)
    if fault.cause == Cause.PORT and result.end_state == "not armed":
        raise PortError(fault.text)
    others = "".join(f"; {other.cause}: {other.text}" for other in result.faults[1:])
    raise ReplayAborted(f"{fault.cause} in {state.name}: {fault.text}{others}; {left}", result=result)
