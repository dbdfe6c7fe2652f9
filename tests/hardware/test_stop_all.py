"""`dynsim hw stop`: failures after torque off are reported as not confirmed, and delay nothing."""

from __future__ import annotations

import os
import pty
import re
import sys
import tty
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import serial
from support.messages import check_message, says

from dynsim import cli
from dynsim.hardware.bus import scan
from dynsim.hardware.bus.dynamixel_bus import SerialPort
from dynsim.hardware.bus.protocol import VirtualClock
from dynsim.hardware.bus.scan import STOP_BAUD_RATES, stop_all
from dynsim.hardware.errors import PortError
from dynsim.hardware.virtual.line import VirtualLine, VirtualPort, line_for_map

DISCONNECTED = "device reports readiness to read but returned no data (device disconnected or multiple access on port?)"


class Ports:
    """Stands for `open_serial_port`; those at the bit rates in ``broken`` fail to open, send or read."""

    def __init__(self, line: VirtualLine) -> None:
        self.line = line
        self.broken: dict[int, str] = {}
        self._clock = VirtualClock()

    def __call__(self, name: str, baud: int, *, exclusive: bool = True) -> VirtualPort:
        assert not exclusive
        how = self.broken.get(baud, "")
        if how == "open":
            raise PortError(f"{name}: cannot be opened")
        port: Any = VirtualPort(self.line, self._clock, baud=baud)
        port.ser = SimpleNamespace(flush=lambda: None)

        def fail(*_: object) -> None:
            raise serial.SerialException(DISCONNECTED)

        if how == "read":
            port.readPort = fail
        if how == "send":
            port.writePort = fail
        return port


@pytest.fixture
def ports(rig, monkeypatch: pytest.MonkeyPatch) -> Ports:
    line = line_for_map(rig.map)
    for id_ in rig.map.ids:
        line.servos.write(id_, 64, b"\1")
    ports = Ports(line)
    monkeypatch.setattr(scan, "open_serial_port", ports)
    return ports


def stop(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *options: object) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["dynsim", "hw", "stop", "--port", "P", *map(str, options)])
    with pytest.raises(SystemExit) as leaving:
        cli.main()
    said = capsys.readouterr()
    return int(leaving.value.code or 0), said.out + said.err


def limp(ports: Ports) -> bool:
    return not any(servo["torque_enable"] for servo in ports.line.servos.registers.values())


def test_all_confirm(ports: Ports, monkeypatch, capsys, map_file) -> None:
    assert stop(monkeypatch, capsys) == (0, "torque off, confirmed by 3 servos\n")
    assert limp(ports)
    assert stop(monkeypatch, capsys, "--map", map_file)[0] == 0


def test_a_port_that_fails_once_torque_off_was_sent_is_not_confirmed(
    ports: Ports, monkeypatch, capsys, map_file
) -> None:
    ports.broken = {1_000_000: "read"}
    code, said = stop(monkeypatch, capsys, "--map", map_file)
    assert code == 3
    check_message(said, "ID 1, 2, 7", "virtual", phrase="sent")
    assert limp(ports)
    code, said = stop(monkeypatch, capsys)
    assert code == 3
    check_message(said, "virtual", phrase="sent")


@pytest.mark.parametrize("how", ["open", "send", "read"])
def test_one_bit_rate_that_fails_keeps_the_others_from_nothing(ports: Ports, monkeypatch, capsys, how: str) -> None:
    ports.broken = {3_000_000: how}
    code, said = stop(monkeypatch, capsys)
    assert limp(ports)
    assert code == 3
    check_message(said, re.compile("^error: "), phrase="unconfirmed")
    assert stop_all("P", ids=(1, 2, 7)).torque == {1: False, 2: False, 7: False}


@pytest.mark.parametrize("how", ["open", "send"])
def test_where_nothing_was_sent_that_is_what_is_told(ports: Ports, monkeypatch, capsys, how: str) -> None:
    ports.broken = dict.fromkeys(STOP_BAUD_RATES, how)
    code, said = stop(monkeypatch, capsys)
    assert code == 3
    assert not says(said, "sent")
    assert not limp(ports)


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    master, slave = pty.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize("exclusive", [False, True])
def test_an_empty_read_is_no_bytes_on_a_shared_port_only(terminal, monkeypatch, exclusive: bool) -> None:
    """Somebody else is faster: the bytes that were announced are gone."""
    master, device = terminal
    port = SerialPort(device, exclusive=exclusive)
    assert port.setBaudRate(57_600)
    read = serial.Serial.read

    def robbed(self: serial.Serial, length: int) -> bytes:
        select = serial.serialposix.select.select

        def taken(*arguments: Any) -> Any:
            ready = select(*arguments)
            if ready[0]:
                os.read(self.fd, 100)
            return ready

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(serial.serialposix.select, "select", taken)
            return read(self, length)

    monkeypatch.setattr(serial.Serial, "read", robbed)
    try:
        os.write(master, b"answer")
        if exclusive:
            with pytest.raises(serial.SerialException, match="returned no data"):
                port.readPort(100)
        else:
            assert port.readPort(100) == b""
    finally:
        port.closePort()
