"""Runs on a port, from opening it to the files left behind: replay, scan, stop."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dynsim.files import json_text, replace_together
from dynsim.hardware.bus import NoAnswer, RequestRefused
from dynsim.hardware.check import CheckedMotion
from dynsim.hardware.clock import Clock, VirtualClock, WallClock
from dynsim.hardware.control_table import MODEL_BY_NUMBER, MX_106, RETURN_DELAY_SECONDS_PER_UNIT, VOLT_PER_UNIT
from dynsim.hardware.dynamixel_bus import DynamixelBus, latency_timer, open_serial_port
from dynsim.hardware.errors import PortError, ReplayAborted, ReplayInterrupted, VerificationFailed
from dynsim.hardware.replay import Progress, Replay, ReplayResult, StopRequest
from dynsim.hardware.rules import Cause
from dynsim.hardware.run_log import RunLog
from dynsim.hardware.servo_map import FaultPolicy, ServoMap
from dynsim.hardware.virtual_bus import VirtualPort, line_for_map
from dynsim.hardware.virtual_faults import FaultScript

VIRTUAL = "virtual"
PSEUDO_TERMINAL_LATENCY = 0.05
"""Servos behind a pseudo-terminal are a program, which a busy computer may not run for a while [s]."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
SCAN_BAUD_RATES = (57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
STOP_BAUD_RATES = (3_000_000, 1_000_000, 57_600, 115_200, 2_000_000, 4_000_000)
"""Those in use come first."""


@contextmanager
def stop_on_signals(stop: StopRequest) -> Iterator[None]:
    """Signals only count up ``stop``: an exception out of a handler would tear a bus transaction in two."""
    before = {number: signal.signal(number, stop) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def bus_on(
    port: str, servo_map: ServoMap, *, script: FaultScript | None = None, plant: Any = None
) -> Iterator[tuple[DynamixelBus, Clock]]:
    """The bus behind a port name, "virtual" being servos in memory on a virtual clock.

    Raises
    ------
    PortError
        The port cannot be opened.
    VerificationFailed
        The adapter's latency timer is too long for the loop.
    """
    clock: Clock
    if port == VIRTUAL:
        clock = VirtualClock()
        line = line_for_map(servo_map, script=script, plant=plant)
        handler: Any = VirtualPort(line, clock, baud=servo_map.bus.baud)
    else:
        clock = WallClock()
        timer = latency_timer(port)
        if timer is not None and timer > 1:
            raise VerificationFailed(
                f"{port}: the adapter's latency timer is {timer} ms, the loop needs 1 ms: "
                f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{Path(port).resolve().name}/latency_timer"
            )
        handler = open_serial_port(port, servo_map.bus.baud)
    latency = servo_map.bus.latency
    if port != VIRTUAL and str(Path(port).resolve()).startswith("/dev/pts/"):
        latency = max(latency, PSEUDO_TERMINAL_LATENCY)
    bus = DynamixelBus(handler, latency=latency, return_delay=servo_map.bus.return_delay)
    try:
        yield bus, clock
    finally:
        bus.close()


def run_replay(
    motion: CheckedMotion,
    servo_map: ServoMap,
    port: str,
    folder: Path,
    *,
    policy: FaultPolicy | None = None,
    live: bool = False,
    write_eeprom: bool = False,
    script: FaultScript | None = None,
    plant: Any = None,
    stop: StopRequest | None = None,
    observer: Callable[[Progress], None] | None = None,
    provenance: dict[str, Any] | None = None,
) -> ReplayResult:
    """Replay a checked motion; ``measured.h5``, ``summary.json``, ``replay.log`` and register dumps go to ``folder``.

    Parameters are those of :class:`dynsim.hardware.replay.Replay` and :func:`bus_on`; on virtual servos ``live`` goes
    without saying.

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
    with log, bus_on(port, servo_map, script=script, plant=plant) as (bus, clock):
        replay = Replay(
            motion,
            servo_map,
            bus,
            clock,
            policy=policy,
            live=live or port == VIRTUAL,
            write_eeprom=write_eeprom,
            stop=stop,
            log=log,
            dump_folder=folder,
            observer=observer,
            provenance={"port": port, **(provenance or {})},
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
        raise ReplayInterrupted(f"interrupted in {state.name}; {left}", result=result)
    if fault.cause == Cause.VERIFICATION:
        raise VerificationFailed(fault.text)
    if fault.cause == Cause.PORT and result.end_state == "not armed":
        raise PortError(fault.text)
    raise ReplayAborted(f"{fault.cause} in {state.name}: {fault.text}; {left}", result=result)


@dataclass(frozen=True)
class Found:
    """A servo that answered a scan.

    Attributes
    ----------
    id, model, firmware, baud, mode : int
    return_delay : float
        [s].
    voltage, temperature : float
        [V], [°C].
    torque : bool
    hardware_error : int
    """

    id: int
    model: int
    firmware: int
    baud: int
    mode: int
    return_delay: float
    voltage: float
    temperature: float
    torque: bool
    hardware_error: int

    @property
    def model_name(self) -> str:
        return MODEL_BY_NUMBER[self.model].name if self.model in MODEL_BY_NUMBER else f"model {self.model}"


def scan(port: str, bauds: tuple[int, ...] = SCAN_BAUD_RATES) -> list[Found]:
    """Every servo that answers a broadcast ping at one of the bit rates. Reads only.

    Raises
    ------
    PortError
        The port cannot be opened or died.
    """
    found = []
    for baud in bauds:
        bus = DynamixelBus(open_serial_port(port, baud))
        try:
            for id_, (model, firmware) in sorted(bus.ping_all().items()):
                found.append(_describe(bus, id_, model, firmware, baud))
        finally:
            bus.close()
    return found


def _describe(bus: DynamixelBus, id_: int, model: int, firmware: int, baud: int) -> Found:
    def value(name: str) -> int:
        try:
            return bus.read(id_, MX_106.fields[name])
        except (NoAnswer, RequestRefused):
            return -1

    return Found(
        id=id_,
        model=model,
        firmware=firmware,
        baud=baud,
        mode=value("operating_mode"),
        return_delay=value("return_delay") * RETURN_DELAY_SECONDS_PER_UNIT,
        voltage=value("present_voltage") * VOLT_PER_UNIT,
        temperature=value("present_temperature"),
        torque=value("torque_enable") != 0,
        hardware_error=value("hardware_error"),
    )


def stop_all(port: str, bauds: tuple[int, ...] = STOP_BAUD_RATES, ids: tuple[int, ...] = ()) -> dict[int, bool]:
    """Broadcast torque off at every bit rate first, and only then ask who obeyed.

    Works beside a running replay: the port is not locked.

    Parameters
    ----------
    ids : tuple of int
        Whom to ask; everybody who answers a ping if empty.

    Returns
    -------
    dict
        Torque still on, by ID; True also for a servo that does not answer.

    Raises
    ------
    PortError
        The port cannot be opened or died.
    """
    for baud in bauds:
        _torque_off(port, baud)
    torque: dict[int, bool] = {}
    for baud in bauds:
        bus = DynamixelBus(open_serial_port(port, baud, exclusive=False))
        try:
            for id_ in ids or bus.ping_all():
                try:
                    torque[id_] = bool(bus.read(id_, MX_106.fields["torque_enable"]))
                except (NoAnswer, RequestRefused):
                    torque.setdefault(id_, True)
        finally:
            bus.close()
    return torque


def _torque_off(port: str, baud: int) -> None:
    bus = DynamixelBus(open_serial_port(port, baud, exclusive=False))
    try:
        bus.torque_off_all()
        # Closing throws away what the driver has not sent yet.
        bus.port.ser.flush()
    finally:
        bus.close()
