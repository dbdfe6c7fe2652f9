"""Defects of dynamixel-sdk 4.1.0, each with a test that the bus of dynsim works despite it.

If the first half of a test fails, the library is repaired, and the workaround in dynsim/hardware/bus/dynamixel_bus.py
can be removed.
"""

from __future__ import annotations

import os
import re
import termios
import time
import tty
from collections import deque

import pytest
import serial
from dynamixel_sdk import (
    COMM_PORT_BUSY,
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    GroupSyncRead,
    GroupSyncWrite,
    PortHandler,
    Protocol2PacketHandler,
)
from support.messages import raises

from dynsim.hardware.bus.control_table import BROADCAST_ID, MX_106, STATE_BLOCK
from dynsim.hardware.bus.dynamixel_bus import WRITE_TIMEOUT, DynamixelBus, open_serial_port
from dynsim.hardware.bus.packet import STATUS, Decoder, Packet, encode
from dynsim.hardware.bus.protocol import NoAnswer
from dynsim.hardware.errors import PortError
from dynsim.hardware.virtual.line import VirtualPort

F = MX_106.fields


class ScriptedPort(PortHandler):
    """A port that keeps what is written and reads what the test put there."""

    def __init__(self, incoming: bytes = b"") -> None:
        super().__init__("scripted")
        self.written = bytearray()
        self.incoming = deque(incoming)
        self.milliseconds = 0.0
        self.interrupt = False

    def getCurrentTime(self) -> float:
        self.milliseconds += 0.1
        return self.milliseconds

    def clearPort(self) -> None:
        return

    def getBytesAvailable(self) -> int:
        return len(self.incoming)

    def writePort(self, packet: list[int]) -> int:
        self.written += bytes(packet)
        return len(packet)

    def readPort(self, length: int) -> bytes:
        if self.interrupt:
            raise KeyboardInterrupt
        return bytes(self.incoming.popleft() for _ in range(min(length, len(self.incoming))))


@pytest.fixture
def stock() -> Protocol2PacketHandler:
    return Protocol2PacketHandler()


@pytest.fixture
def bus(rig) -> DynamixelBus:
    return rig.prepare().replay.bus


def line_of(bus: DynamixelBus):
    assert isinstance(bus.port, VirtualPort)
    return bus.port.line


def test_1_an_interrupted_read_blocks_every_later_write(stock) -> None:
    port = ScriptedPort()
    port.interrupt = True
    with pytest.raises(KeyboardInterrupt):
        stock.readTxRx(port, 1, 132, 4)
    port.written.clear()
    assert stock.write1ByteTxOnly(port, BROADCAST_ID, 64, 0) == COMM_PORT_BUSY
    assert not port.written

    DynamixelBus(port).torque_off_all()
    assert [packet.parameters for packet in Decoder().feed(port.written)] == [b"\x40\x00\x00"] * 3


def test_2_one_lost_status_hides_the_servos_behind_it(bus, stock) -> None:
    line_of(bus).servos.dead.add(1)
    group = GroupSyncRead(bus.port, stock, *STATE_BLOCK)
    for id_ in (1, 2, 7):
        group.addParam(id_)
    assert group.txRxPacket() != COMM_SUCCESS
    assert not group.isAvailable(2, 132, 4)
    assert not group.isAvailable(7, 132, 4)

    assert sorted(bus.sync_read((1, 2, 7), *STATE_BLOCK).replies) == [2, 7]


def test_2_a_cut_status_takes_the_next_one_with_it(stock) -> None:
    cut, good = encode(Packet(1, STATUS, bytes(10)))[:-6], encode(Packet(2, STATUS, bytes(10)))
    port = ScriptedPort(cut + good)
    port.setPacketTimeoutMillis(50)
    seen = [stock.rxPacket(port, False)[1] for _ in range(2)]
    assert COMM_SUCCESS not in seen

    assert list(DynamixelBus(ScriptedPort(cut + good)).sync_read((1, 2), *STATE_BLOCK).replies) == [2]


def test_3_group_reads_drop_the_alert_bit(bus, stock) -> None:
    line_of(bus).servos.registers[2]["hardware_error"] = 1
    group = GroupSyncRead(bus.port, stock, *STATE_BLOCK)
    group.addParam(2)
    assert group.txRxPacket() == COMM_SUCCESS
    assert not hasattr(group, "getError")
    assert len(group.data_dict[2]) == STATE_BLOCK[1]

    replies = bus.sync_read((1, 2), *STATE_BLOCK).replies
    assert (replies[1].alert, replies[2].alert) == (False, True)


def test_4_a_request_that_needs_stuffing_is_sent_without(stock) -> None:
    port = ScriptedPort()
    stock.writeTxOnly(port, 1, 116, 4, [0xFF, 0xFF, 0xFD, 0x00])
    assert bytes([0xFF, 0xFF, 0xFD, 0x00]) in port.written[7:]
    assert list(Decoder().feed(port.written)) == []

    bus = DynamixelBus(ScriptedPort())
    with raises(ValueError, "FF FF FD"):
        bus.sync_write(F["goal_position"], {1: 0x00FDFFFF})
    with raises(ValueError, "FF FF FD"):
        bus.write(1, F["goal_position"], 0x00FDFFFF)


def test_4_some_stuffed_answers_are_mangled(stock) -> None:
    body = bytes.fromhex("ff ff fd 05 ff fd fd 01 02 03")
    frame = encode(Packet(1, STATUS, body))
    port = ScriptedPort(frame)
    port.setPacketTimeoutMillis(50)
    packet, result = stock.rxPacket(port, False)
    assert result == COMM_SUCCESS
    length = packet[5] | packet[6] << 8
    assert bytes(packet[9 : 7 + length - 2]) != body

    assert DynamixelBus(ScriptedPort(frame)).sync_read((1,), *STATE_BLOCK).replies[1].data == body


def test_4_fast_sync_read_does_not_unstuff(stock) -> None:
    # Velocity −1 then position 0x0BFD: FF FF FF FF FD 0B 00 00, which a servo stuffs. Error, ID, data, checksum.
    body = b"\x55\x00\x01" + bytes.fromhex("00 00 ff ff ff ff fd fd 0b 00 00") + b"\0\0"
    frame = b"\xff\xff\xfd\x00\xfe" + (len(body) + 2).to_bytes(2, "little") + body
    frame += stock.updateCRC(0, frame, len(frame)).to_bytes(2, "little")
    port = ScriptedPort(frame)
    group = GroupSyncRead(port, stock, *STATE_BLOCK)
    group.addParam(1)
    assert group.fastSyncReadTxPacket() == COMM_SUCCESS
    assert group.fastSyncReadRxPacket() == COMM_SUCCESS
    assert group.getData(1, 132, 4) != 0x0BFD

    true = bytes.fromhex("00 00 ff ff ff ff fd 0b 00 00")
    answer = DynamixelBus(ScriptedPort(encode(Packet(1, STATUS, true)))).sync_read((1,), *STATE_BLOCK)
    assert F["present_position"].decode(answer.replies[1].data[6:10]) == 0x0BFD


def test_5_data_is_unsigned_and_refused_goals_go_unnoticed(bus, stock) -> None:
    line = line_of(bus)
    line.servos.registers[1]["homing_offset"] = -4000
    group = GroupSyncRead(bus.port, stock, 132, 4)
    group.addParam(1)
    assert group.txRxPacket() == COMM_SUCCESS
    assert group.getData(1, 132, 4) > 1 << 31
    assert bus.read(1, F["present_position"]) < 0

    before = line.servos.registers[2]["goal_position"]
    write = GroupSyncWrite(bus.port, stock, 116, 4)
    write.addParam(2, list((5000).to_bytes(4, "little")))
    assert write.txPacket() == COMM_SUCCESS
    assert line.servos.registers[2]["goal_position"] == before


def test_6_a_dead_terminal_raises_more_than_serial_errors() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    name = os.ttyname(slave)
    stock_port = PortHandler(name)
    assert stock_port.setBaudRate(1_000_000)
    assert stock_port.ser.write_timeout is None
    assert not PortHandler(name).setBaudRate(4_500_000)
    port = open_serial_port(name, 1_000_000, exclusive=False)
    os.close(slave)
    os.close(master)
    with pytest.raises((termios.error, OSError)):
        stock_port.clearPort()
    with raises(PortError, re.compile(r"^/dev/\S+: "), "Input/output error"):
        DynamixelBus(port).torque_off_all()
    with raises(PortError, re.compile(r"^/dev/\S+: "), "Input/output error"):
        DynamixelBus(port).sync_read((1,), *STATE_BLOCK)
    stock_port.ser.close()
    DynamixelBus(port).close()


def test_6_a_process_that_was_stopped_in_a_write_has_written(monkeypatch: pytest.MonkeyPatch) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    write = os.write

    def stopped(descriptor: int, data: bytes) -> int:
        written = write(descriptor, data)
        time.sleep(1.2 * WRITE_TIMEOUT)
        return written

    port = open_serial_port(os.ttyname(slave), 1_000_000)
    port.ser.write_timeout = WRITE_TIMEOUT
    monkeypatch.setattr(os, "write", stopped)
    with pytest.raises(serial.SerialTimeoutException):
        port.ser.write(b"abc")
    assert port.writePort(list(b"def")) == 3
    assert os.read(master, 10) == b"abcdef"
    port.closePort()
    os.close(slave)
    os.close(master)


def test_6_a_port_that_blocks_is_given_up() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    port = open_serial_port(os.ttyname(slave), 1_000_000)
    bus = DynamixelBus(port)
    # Nobody reads the other end: the buffer fills, a write would wait for ever.
    with pytest.raises(PortError):
        _fill(bus)
    bus.close()
    os.close(slave)
    os.close(master)


def _fill(bus: DynamixelBus) -> None:
    for _ in range(10_000):
        bus.torque_off_all()


def test_6_missing_ports_and_bit_rates_are_one_clear_line() -> None:
    with raises(PortError, "/dev/ttyDoesNotExist"):
        open_serial_port("/dev/ttyDoesNotExist", 1_000_000)
    master, slave = os.openpty()
    with raises(PortError, "4500000"):
        open_serial_port(os.ttyname(slave), 4_500_000)
    with pytest.raises(serial.SerialException):
        serial.Serial("/dev/ttyDoesNotExist")
    os.close(slave)
    os.close(master)


class LatePort(ScriptedPort):
    """A port whose answer to each request comes 80 ms after it."""

    def __init__(self, answer: bytes) -> None:
        super().__init__()
        self.answer = answer
        self.requests = 0

    def writePort(self, packet: list[int]) -> int:
        self.requests += 1
        self.sent = self.milliseconds
        self.incoming.extend(self.answer)
        return super().writePort(packet)

    def getBytesAvailable(self) -> int:
        return len(self.incoming) if self.milliseconds > self.sent + 80.0 else 0

    def readPort(self, length: int) -> bytes:
        return super().readPort(min(length, self.getBytesAvailable()))


def test_7_single_reads_and_writes_wait_34_ms_only(stock) -> None:
    data = encode(Packet(1, STATUS, b"\x01"))
    _, result, _ = stock.readTxRx(LatePort(data), 1, 64, 1)
    assert result == COMM_RX_TIMEOUT

    late = LatePort(data)
    assert DynamixelBus(late, latency=0.2).read(1, F["torque_enable"]) == 1
    written = LatePort(encode(Packet(1, STATUS)))
    DynamixelBus(written, latency=0.2).write(1, F["torque_enable"], 1)
    assert (late.requests, written.requests) == (1, 1)
    with pytest.raises(NoAnswer):
        DynamixelBus(LatePort(b"")).write(1, F["torque_enable"], 1)
