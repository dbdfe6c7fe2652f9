"""All servos on a port, whatever their bit rate: who answers, and torque off for everybody."""

from __future__ import annotations

from dataclasses import dataclass

from dynsim.hardware.bus.control_table import MODEL_BY_NUMBER, MX_106, RETURN_DELAY_SECONDS_PER_UNIT, VOLT_PER_UNIT
from dynsim.hardware.bus.dynamixel_bus import DynamixelBus, open_serial_port
from dynsim.hardware.bus.protocol import NoAnswer, RequestRefused

SCAN_BAUD_RATES = (57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)
STOP_BAUD_RATES = (3_000_000, 1_000_000, 57_600, 115_200, 2_000_000, 4_000_000)
"""Those in use come first."""


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
