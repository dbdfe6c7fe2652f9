"""Scan a port for servos at all bit rates, and switch off the torque of all servos."""

from __future__ import annotations

from contextlib import closing, suppress
from dataclasses import dataclass

from dynsim.hardware.bus.control_table import MODEL_BY_NUMBER, MX_106
from dynsim.hardware.bus.dynamixel_bus import DynamixelBus, open_serial_port
from dynsim.hardware.bus.protocol import NoAnswer, RequestRefused, TerminalError
from dynsim.hardware.errors import PortError

SCAN_BAUD_RATES = (57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
STOP_BAUD_RATES = (3_000_000, 1_000_000, 57_600, 115_200, 2_000_000, 4_000_000)
"""Bit rates at which the command "torque off" is sent; the most common rates come first."""


SCANNED_REGISTERS = (
    "operating_mode",
    "return_delay",
    "present_voltage",
    "present_temperature",
    "torque_enable",
    "hardware_error",
)
"""Registers that are read from every servo."""


@dataclass(frozen=True)
class ScannedServo:
    """A servo that answered a scan.

    Attributes
    ----------
    id, model, firmware, baud : int
    registers : dict
        Values of the ``SCANNED_REGISTERS`` by name; -1 if the servo did not return the register.
    """

    id: int
    model: int
    firmware: int
    baud: int
    registers: dict[str, int]

    @property
    def model_name(self) -> str:
        return MODEL_BY_NUMBER[self.model].name if self.model in MODEL_BY_NUMBER else f"model {self.model}"


def scan(port: str, bauds: tuple[int, ...] = SCAN_BAUD_RATES) -> list[ScannedServo]:
    """Return all servos that answer a broadcast ping at one of the bit rates [bit/s], without writing to servos.

    Raises
    ------
    PortError
        If the port cannot be opened or fails.
    """
    servos = []
    for baud in bauds:
        with closing(DynamixelBus(open_serial_port(port, baud))) as bus:
            for id_, (model, firmware) in sorted(bus.ping_all().items()):
                registers = {name: _register(bus, id_, name) for name in SCANNED_REGISTERS}
                servos.append(ScannedServo(id_, model, firmware, baud, registers))
    return servos


def _register(bus: DynamixelBus, id_: int, name: str) -> int:
    try:
        return bus.read(id_, MX_106.fields[name])
    except (NoAnswer, RequestRefused):
        return -1


@dataclass(frozen=True)
class StopResult:
    """Torque state of the servos after a broadcast "torque off".

    Attributes
    ----------
    torque : dict
        For each ID, True if the torque is still on or the servo does not answer.
    trouble : tuple of str
        Errors of the port; if there are any, some servos may not have received the command, or may not have been read.
    """

    torque: dict[int, bool]
    trouble: tuple[str, ...]


def stop_all(port: str, bauds: tuple[int, ...] = STOP_BAUD_RATES, ids: tuple[int, ...] = ()) -> StopResult:
    """Broadcast "torque off" at every bit rate, then read whether the torque of each servo is off.

    This works even during a replay, because the port is opened without a lock. Once the command has been sent at one of
    the bit rates, no error is raised.

    Parameters
    ----------
    port : str
        Serial device.
    bauds : tuple of int
        Bit rates [bit/s].
    ids : tuple of int
        IDs of the servos to read; if empty, all servos that answer a ping are read.

    Raises
    ------
    PortError
        If the command could not be sent at any bit rate.
    """
    trouble: list[PortError] = []
    for baud in bauds:
        try:
            _torque_off(port, baud)
        except PortError as error:
            trouble.append(error)
    if len(trouble) == len(bauds):
        raise trouble[0]
    torque = dict.fromkeys(ids, True)
    for baud in bauds:
        try:
            _read_torque(port, baud, ids, torque)
        except PortError as error:
            trouble.append(error)
    return StopResult(torque, tuple(dict.fromkeys(map(str, trouble))))


def _torque_off(port: str, baud: int) -> None:
    with closing(DynamixelBus(open_serial_port(port, baud, exclusive=False))) as bus:
        try:
            bus.torque_off_all()
            # Closing discards bytes that the driver has not sent yet.
            bus.port.ser.flush()
        except (OSError, TerminalError) as error:
            raise PortError(f"{port}: the port died ({error})") from error


def _read_torque(port: str, baud: int, ids: tuple[int, ...], torque: dict[int, bool]) -> None:
    with closing(DynamixelBus(open_serial_port(port, baud, exclusive=False))) as bus:
        for id_ in ids or bus.ping_all():
            torque.setdefault(id_, True)
            with suppress(NoAnswer, RequestRefused):
                torque[id_] = bool(bus.read(id_, MX_106.fields["torque_enable"]))
