"""Several servos on one line, each with its own bit rate and ID, under the maker's client library."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from dynamixel_easy_sdk.control_table import ControlTable
from dynamixel_sdk import (
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    GroupBulkRead,
    GroupBulkWrite,
    GroupSyncRead,
    GroupSyncWrite,
    Protocol2PacketHandler,
)

from dynsim.hardware.bus.control_table import BAUD_RATES, MODELS, MX_28, MX_106, ServoModel
from dynsim.hardware.bus.packet import Packet, StatusError, crc16, encode, encode_fast
from dynsim.hardware.bus.protocol import VirtualClock
from dynsim.hardware.virtual.line import VirtualLine, VirtualPort
from dynsim.hardware.virtual.servos import BOOT_TIME, CURRENT_NOISE, ServoRegisters

F = MX_106.fields
BAUD, BAUD_CODE = 1_000_000, 3
LIBRARY = Protocol2PacketHandler()
KINDS = list(MODELS.values())


class Line:
    """Servos 1, 2, … and a port of the client library on them."""

    def __init__(self, *models: ServoModel) -> None:
        servos = {id_: ServoRegisters(model, id_, BAUD_CODE) for id_, model in enumerate(models, start=1)}
        self.line = VirtualLine(servos, positions=[3.0 + 0.1 * id_ for id_ in servos])
        self.servos = self.line.servos
        self.port = VirtualPort(self.line, VirtualClock(), baud=BAUD)

    def write(self, id_: int, name: str, value: int) -> tuple[int, int]:
        field = F[name]
        return LIBRARY.writeTxRx(self.port, id_, field.address, field.size, list(field.encode(value)))

    def read(self, id_: int, name: str) -> int:
        data, result, error = LIBRARY.readTxRx(self.port, id_, F[name].address, F[name].size)
        assert (result, error) == (COMM_SUCCESS, 0)
        return F[name].decode(bytes(data))

    def answers(self, id_: int, *, baud: int = BAUD) -> bool:
        self.port.setBaudRate(baud)
        return LIBRARY.ping(self.port, id_)[1] == COMM_SUCCESS

    def wait(self, seconds: float) -> None:
        self.port.clock.sleep_until(self.port.clock.now() + seconds)


@pytest.fixture
def three() -> Line:
    return Line(MX_106, MX_28, MODELS["XM430-W350"])


def test_a_servo_with_another_bit_rate_hears_nothing_and_the_others_go_on(three: Line) -> None:
    assert three.write(2, "baud", BAUD_RATES.index(57_600)) == (COMM_SUCCESS, 0), "acknowledged at the old rate"
    assert not three.answers(2)
    assert three.answers(1)
    assert three.answers(2, baud=57_600)
    assert not three.answers(1, baud=57_600)
    assert set(LIBRARY.broadcastPing(three.port)[0]) == {2}
    three.port.setBaudRate(BAUD)
    assert set(LIBRARY.broadcastPing(three.port)[0]) == {1, 3}
    LIBRARY.write1ByteTxOnly(three.port, 254, F["led"].address, 1)
    assert [three.servos.registers[id_]["led"] for id_ in (1, 2, 3)] == [1, 0, 1]


def test_a_servo_with_another_bit_rate_starves_its_watchdog(three: Line) -> None:
    three.write(2, "baud", BAUD_RATES.index(57_600))
    three.port.setBaudRate(57_600)
    for id_ in (2,):
        three.write(id_, "torque_enable", 1)
        three.write(id_, "bus_watchdog", 5)
    three.port.setBaudRate(BAUD)
    three.write(1, "torque_enable", 1)
    three.write(1, "bus_watchdog", 5)
    for _ in range(30):
        three.wait(0.01)
        assert three.read(1, "torque_enable") == 1
    assert three.read(1, "bus_watchdog") == 5
    assert three.servos.registers[2]["bus_watchdog"] == -1


def test_another_id_takes_effect_at_once(three: Line) -> None:
    assert three.write(2, "id", 40) == (COMM_SUCCESS, 0), "acknowledged with the old ID"
    assert not three.answers(2)
    assert three.read(40, "id") == 40
    assert LIBRARY.ping(three.port, 40)[0] == MX_28.number
    assert set(LIBRARY.broadcastPing(three.port)[0]) == {1, 3, 40}
    three.write(40, "torque_enable", 1)
    assert three.write(40, "id", 2) == (COMM_SUCCESS, StatusError.ACCESS), "locked while torque is on"
    assert three.servos.registers[2]["torque_enable"] == 1, "in the simulation it is named by the ID it had"


def test_two_servos_with_one_id_garble_each_other_but_both_obey(three: Line) -> None:
    three.write(2, "id", 1)
    _, result, _ = LIBRARY.readTxRx(three.port, 1, F["present_position"].address, 4)
    assert result != COMM_SUCCESS
    assert result != COMM_RX_TIMEOUT
    three.write(1, "led", 1)
    assert [three.servos.registers[id_]["led"] for id_ in (1, 2, 3)] == [1, 1, 0]


def test_a_servo_in_another_protocol_is_silent_and_the_others_are_not(three: Line) -> None:
    assert three.write(2, "protocol", 1) == (COMM_SUCCESS, 0)
    assert not three.answers(2)
    assert set(LIBRARY.broadcastPing(three.port)[0]) == {1, 3}
    assert three.write(2, "protocol", 2)[0] == COMM_RX_TIMEOUT


@pytest.mark.parametrize(
    ("option", "id_", "baud"),
    [(0xFF, 1, 57_600), (0x01, 2, 57_600), (0x02, 2, BAUD)],
    ids=["all", "not ID", "not both"],
)
def test_a_factory_reset_keeps_what_it_is_told_to(three: Line, option: int, id_: int, baud: int) -> None:
    three.write(2, "return_delay", 7)
    three.write(2, "torque_enable", 1)
    three.write(2, "profile_velocity", 40)
    assert LIBRARY.factoryReset(three.port, 2, option) == (COMM_SUCCESS, 0)
    three.port.setBaudRate(baud)
    assert not three.answers(id_ if id_ != 1 else 2, baud=baud), "it starts anew"
    three.wait(BOOT_TIME)
    assert [three.read(id_, name) for name in ("id", "return_delay", "torque_enable", "profile_velocity")] == [
        id_,
        F["return_delay"].default,
        0,
        0,
    ]
    assert LIBRARY.ping(three.port, id_)[0] == MX_28.number


def test_a_factory_reset_of_everybody_spares_ids_or_is_not_carried_out(three: Line) -> None:
    for id_ in (1, 2, 3):
        three.write(id_, "return_delay", 7)
    LIBRARY.factoryReset(three.port, 254, 0xFF)
    three.wait(BOOT_TIME)
    assert [three.read(id_, "return_delay") for id_ in (1, 2, 3)] == [7, 7, 7]
    LIBRARY.factoryReset(three.port, 254, 0x02)
    three.wait(BOOT_TIME)
    assert [three.read(id_, "return_delay") for id_ in (1, 2, 3)] == [250, 250, 250]
    assert LIBRARY.factoryReset(three.port, 1, 0x07) == (COMM_SUCCESS, StatusError.DATA_RANGE)


def test_fast_reads_have_the_bytes_of_the_manual() -> None:
    """Example of the e-Manual, Protocol 2.0, Fast Sync Read: positions of IDs 3, 7 and 4."""
    positions = {3: 166, 7: 2079, 4: 1023}
    replies = [Packet(id_, 0x55, position.to_bytes(4, "little")) for id_, position in positions.items()]
    first, second, third = encode_fast(replies, [4, 4, 4])
    assert first == bytes.fromhex("ff ff fd 00 fe 19 00 55 00 03 a6 00 00 00 84 08")
    assert second == bytes.fromhex("00 07 1f 08 00 00 16 ca")
    assert third[:-2] == bytes.fromhex("00 04 ff 03 00 00")
    assert crc16((first + second + third)[:-2]) == int.from_bytes(third[-2:], "little")


def measured(line: Line, name: str) -> list[int]:
    for index in range(len(line.servos.ids)):
        line.servos.measure(index)
    return [registers[name] for registers in line.servos.registers.values()]


@pytest.mark.parametrize("exchange", [GroupSyncRead.txRxPacket, GroupSyncRead.fastSyncRead], ids=["sync", "fast sync"])
def test_sync_reads_of_the_library(three: Line, exchange: Callable[[GroupSyncRead], int]) -> None:
    group = GroupSyncRead(three.port, LIBRARY, F["present_position"].address, 4)
    for id_ in (3, 1, 2):
        group.addParam(id_)
    assert exchange(group) == COMM_SUCCESS
    read = [group.getData(id_, F["present_position"].address, 4) for id_ in (1, 2, 3)]
    assert read == measured(three, "present_position")
    assert len(set(read)) == 3


@pytest.mark.parametrize("exchange", [GroupBulkRead.txRxPacket, GroupBulkRead.fastBulkRead], ids=["bulk", "fast bulk"])
def test_bulk_reads_of_the_library(three: Line, exchange: Callable[[GroupBulkRead], int]) -> None:
    group = GroupBulkRead(three.port, LIBRARY)
    group.addParam(1, F["present_position"].address, 4)
    group.addParam(2, F["present_voltage"].address, 2)
    group.addParam(3, F["present_temperature"].address, 1)
    assert exchange(group) == COMM_SUCCESS
    read = [
        group.getData(1, F["present_position"].address, 4),
        group.getData(2, F["present_voltage"].address, 2),
        group.getData(3, F["present_temperature"].address, 1),
    ]
    names = ("present_position", "present_voltage", "present_temperature")
    assert read == [measured(three, name)[k] for k, name in enumerate(names)]


def test_behind_a_silent_servo_a_fast_read_breaks_off_and_a_sync_read_does_not(three: Line) -> None:
    three.servos.dead.add(2)
    ask = F["present_position"].address.to_bytes(2, "little") + b"\4\0" + bytes([1, 2, 3])
    slow = three.line.transmit(encode(Packet(254, 0x82, ask)), 1.0, BAUD)
    fast = three.line.transmit(encode(Packet(254, 0x8A, ask)), 2.0, BAUD)
    assert [len(frame) for _, frame in slow] == [15, 15]
    assert [len(frame) for _, frame in fast] == [8 + 8]
    assert fast[0][1][5] == 1 + 3 * 8, "the length is that of the whole packet"


def test_a_fast_read_is_faster_by_the_heads_and_the_pauses(three: Line) -> None:
    for registers in three.servos.registers.values():
        registers["return_delay"] = 50  # 100 µs
    ask = F["present_position"].address.to_bytes(2, "little") + b"\4\0" + bytes([1, 2, 3])
    slow = three.line.transmit(encode(Packet(254, 0x82, ask)), 1.0, BAUD)[-1][0] - 1.0
    fast = three.line.transmit(encode(Packet(254, 0x8A, ask)), 2.0, BAUD)[-1][0] - 2.0
    pauses, byte = 2 * (100e-6 + 20e-6), 10 / BAUD
    assert slow - fast == pytest.approx(pauses + (3 * 15 - (8 + 3 * 8)) * byte, rel=1e-6)


def test_bulk_and_sync_writes_of_the_library(three: Line) -> None:
    bulk = GroupBulkWrite(three.port, LIBRARY)
    bulk.addParam(1, F["led"].address, 1, [1])
    bulk.addParam(2, F["profile_velocity"].address, 4, [50, 0, 0, 0])
    assert bulk.txPacket() == COMM_SUCCESS
    sync = GroupSyncWrite(three.port, LIBRARY, F["profile_acceleration"].address, 4)
    for id_ in (1, 3):
        sync.addParam(id_, [id_, 0, 0, 0])
    assert sync.txPacket() == COMM_SUCCESS
    assert three.read(1, "led") == 1
    assert three.read(2, "profile_velocity") == 50
    assert [three.read(id_, "profile_acceleration") for id_ in (1, 2, 3)] == [1, 0, 3]


def test_a_registered_write_is_forgotten_by_a_restart(three: Line) -> None:
    assert LIBRARY.regWriteTxRx(three.port, 1, F["led"].address, 1, [1]) == (COMM_SUCCESS, 0)
    assert three.read(1, "registered_instruction") == 1
    assert LIBRARY.reboot(three.port, 1) == (COMM_SUCCESS, 0)
    three.wait(BOOT_TIME)
    LIBRARY.action(three.port, 254)
    assert three.read(1, "led") == 0
    assert three.read(1, "registered_instruction") == 0


def test_turns_are_cleared_at_rest_only(three: Line) -> None:
    three.write(1, "operating_mode", 1)
    three.write(1, "torque_enable", 1)
    three.write(1, "goal_velocity", 150)
    three.wait(3.0)
    assert LIBRARY.clearMultiTurn(three.port, 1) == (COMM_SUCCESS, StatusError.RESULT_FAIL)
    assert three.read(1, "present_position") > 4096
    three.write(1, "torque_enable", 0)
    three.wait(1.0)
    assert LIBRARY.clearMultiTurn(three.port, 1) == (COMM_SUCCESS, 0)
    assert 0 <= three.read(1, "present_position") < 4096


@pytest.mark.parametrize("model", KINDS, ids=lambda model: model.name)
def test_the_tables_are_those_of_the_makers_own_model_files(model: ServoModel) -> None:
    """Model number, and address and size of every register the maker's library knows by a name of ours."""
    names = {
        "Max Voltage Limit": "max_voltage",
        "Min Voltage Limit": "min_voltage",
        "Max Position Limit": "max_position",
        "Min Position Limit": "min_position",
        "Secondary(Shadow) ID": "shadow_id",
        "Protocol Type": "protocol",
        "Firmware Version": "firmware",
        "Baud Rate": "baud",
        "Return Delay Time": "return_delay",
        "Hardware Error Status": "hardware_error",
        "Present Input Voltage": "present_voltage",
        "BUS Watchdog": "bus_watchdog",
    }
    table = {
        names.get(name, name.lower().replace(" ", "_")): (item.address, item.size)
        for name, item in ControlTable.getControlTable(model.number).items()
        if not name.startswith("Indirect")
    }
    assert ControlTable.getModelName(model.number) in (
        f"{model.name.lower().replace('-', '_')}.model",
        f"{model.name.lower()}.model",
    )
    ours = {name: (field.address, field.size) for name, field in model.fields.items()}
    assert {name: ours.get(name) for name in table} == table
    # What is not in the file is the MX-28's acceleration limit or came with later firmware.
    assert set(ours) - set(table) <= {"acceleration_limit", "startup_configuration", "backup_ready"}


@pytest.mark.parametrize("model", KINDS, ids=lambda model: model.name)
def test_every_model_follows_a_goal_and_tells_its_effort(model: ServoModel) -> None:
    line = Line(model)
    assert LIBRARY.ping(line.port, 1)[0] == model.number
    line.write(1, "torque_enable", 1)
    goal = line.read(1, "present_position") + 200
    line.write(1, "goal_position", goal)
    line.wait(0.01)
    effort = "present_current" if model.measures_current else "present_load"
    line.servos.measure(0)
    noise = 4 * CURRENT_NOISE * model.stall_torque
    assert model.torque(line.servos.registers[1][effort]) == pytest.approx(
        line.servos.plant.torque[0], abs=0.02 + noise
    )
    line.wait(1.0)
    assert abs(line.read(1, "present_position") - goal) <= 3, "the friction of the gear is 2.7 ticks of the stiffness"
    assert line.servos.registers[1]["velocity_limit"] * 0.229 == pytest.approx(
        model.no_load_speed * 60 / 6.2832, rel=0.6 if model.name == "MX-64" else 0.1
    ), "the factory's limit is about the no-load speed"


def test_the_profile_is_told_to_those_who_read_it(three: Line) -> None:
    three.write(1, "torque_enable", 1)
    start = three.read(1, "present_position")
    three.write(1, "profile_velocity", 20)
    three.write(1, "goal_position", start - 500)
    three.wait(0.5)
    assert three.read(1, "velocity_trajectory") == -20
    at = three.servos.time
    set_point = three.read(1, "position_trajectory")
    three.wait(0.4)
    moved = three.read(1, "position_trajectory") - set_point
    seconds = three.servos.time - at
    assert moved == pytest.approx(-20 * 0.229 / 60 * 4096 * seconds, abs=2)
    assert three.read(1, "present_position") > set_point + moved, "the shaft is behind its set point"
