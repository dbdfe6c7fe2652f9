"""Scan of a port for servos at all bit rates, and torque off for all of them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

from dynsim.hardware.bus.control_table import MODEL_BY_NUMBER, MX_106
from dynsim.hardware.bus.dynamixel_bus import DynamixelBus, open_serial_port
from dynsim.hardware.bus.protocol import NoAnswer, RequestRefused, TerminalError
from dynsim.hardware.errors import PortError

SCAN_BAUD_RATES = (57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
STOP_BAUD_RATES = (3_000_000, 1_000_000, 57_600, 115_200, 2_000_000, 4_000_000)
"""The most common rates come first."""


SHOWN = (
    "operating_mode",
    "return_delay",
    "present_voltage",
    "present_temperature",
    "torque_enable",
    "hardware_error",
)
"""Registers that are read of every servo."""


@dataclass(frozen=True)
class Found:
    """A servo that answered a scan.

    Attributes
    ----------
    id, model, firmware, baud : int
    registers : dict
        Of ``SHOWN``, by name; -1 where the servo did not tell it.
    """

    id: int
    model: int
    firmware: int
    baud: int
    registers: dict[str, int]

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
    servos = []
    for baud in bauds:
        bus = DynamixelBus(open_serial_port(port, baud))
        try:
            for id_, (model, firmware) in sorted(bus.ping_all().items()):
                registers = {name: _register(bus, id_, name) for name in SHOWN}
                servos.append(Found(id_, model, firmware, baud, registers))
        finally:
            bus.close()
    return servos


def _register(bus: DynamixelBus, id_: int, name: str) -> int:
    try:
        return bus.read(id_, MX_106.fields[name])
    except (NoAnswer, RequestRefused):
        return -1


@dataclass(frozen=True)
class Asked:
    """Who obeyed a broadcast torque off.

    Attributes
    ----------
    torque : dict
        Still on, by ID; True also for a servo that does not answer.
    trouble : tuple of str
        Where the port failed, so that not everybody may have heard it or been asked.
    """

    torque: dict[int, bool]
    trouble: tuple[str, ...]


def stop_all(port: str, bauds: tuple[int, ...] = STOP_BAUD_RATES, ids: tuple[int, ...] = ()) -> Asked:
    """Broadcast torque off at every bit rate first, and only then ask who obeyed.

    Works beside a running replay: the port is not locked. Once it was sent nothing is raised any more.

    Parameters
    ----------
    ids : tuple of int
        Whom to ask; everybody who answers a ping if empty.

    Raises
    ------
    PortError
        The port cannot be opened or died, and torque off was not sent.
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
            _ask_for_torque(port, baud, ids, torque)
        except PortError as error:
            trouble.append(error)
    return Asked(torque, tuple(dict.fromkeys(map(str, trouble))))


def _torque_off(port: str, baud: int) -> None:
    bus = DynamixelBus(open_serial_port(port, baud, exclusive=False))
    try:
        bus.torque_off_all()
        # Closing throws away what the driver has not sent yet.
        bus.port.ser.flush()
    except (OSError, TerminalError) as error:
        raise PortError(f"{port}: the port died ({error})") from error
    finally:
        bus.close()


def _ask_for_torque(port: str, baud: int, ids: tuple[int, ...], torque: dict[int, bool]) -> None:
    bus = DynamixelBus(open_serial_port(port, baud, exclusive=False))
    try:
        for id_ in ids or bus.ping_all():
            torque.setdefault(id_, True)
            with suppress(NoAnswer, RequestRefused):
                torque[id_] = bool(bus.read(id_, MX_106.fields["torque_enable"]))
    finally:
        bus.close()
