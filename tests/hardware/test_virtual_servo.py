"""Virtual servos against the manual: registers, limits, watchdog, modes, profile, supply, reboot, late answers."""

from __future__ import annotations

import numpy as np
import pytest
from dynamixel_sdk import Protocol2PacketHandler

from dynsim.hardware.bus.control_table import MX_28, MX_106, RAD_PER_TICK, OperatingMode, describe_hardware_error
from dynsim.hardware.bus.dynamixel_bus import DynamixelBus
from dynsim.hardware.bus.packet import StatusError
from dynsim.hardware.bus.protocol import VirtualClock
from dynsim.hardware.virtual.faults import FaultScript
from dynsim.hardware.virtual.line import VirtualLine, VirtualPort
from dynsim.hardware.virtual.servos import BOOT_TIME, PHYSICS_STEP, ServoRegisters
from dynsim.hardware.virtual.simulated_plant import MotorLaw

F = MX_106.fields
BAUD_CODE = 3


@pytest.fixture
def line() -> VirtualLine:
    servos = {1: ServoRegisters(MX_106, 1, BAUD_CODE), 2: ServoRegisters(MX_28, 2, BAUD_CODE)}
    servos[2]["operating_mode"] = OperatingMode.VELOCITY
    return VirtualLine(servos, positions=[2048 * RAD_PER_TICK, 0.0])


@pytest.fixture
def bus(line: VirtualLine) -> DynamixelBus:
    return DynamixelBus(VirtualPort(line, VirtualClock(), baud=1_000_000))


def write(line: VirtualLine, id_: int, name: str, value: int) -> StatusError:
    field = line.servos.registers[id_].model.fields[name]
    return line.servos.write(id_, field.address, field.encode(value))


def test_eeprom_is_locked_while_torque_is_on(line) -> None:
    assert write(line, 1, "return_delay", 0) == StatusError.NONE
    write(line, 1, "torque_enable", 1)
    assert write(line, 1, "return_delay", 5) == StatusError.ACCESS
    assert line.servos.registers[1]["return_delay"] == 0


def test_read_only_unknown_and_out_of_range_writes_are_refused(line) -> None:
    assert write(line, 1, "present_position", 7) == StatusError.ACCESS
    assert line.servos.write(1, 64, b"\2") == StatusError.DATA_RANGE
    assert line.servos.write(1, 117, b"\2") == StatusError.ACCESS
    assert line.servos.write(1, 116, b"\2\0") == StatusError.DATA_LENGTH
    assert line.servos.write(1, 660, b"\0\0\0") == StatusError.ACCESS
    assert write(line, 2, "operating_mode", OperatingMode.CURRENT) == StatusError.DATA_RANGE


def test_goals_beyond_the_servos_own_limits_are_refused_and_ignored(line) -> None:
    write(line, 1, "max_position", 3000)
    before = line.servos.registers[1]["goal_position"]
    assert write(line, 1, "goal_position", 3001) == StatusError.DATA_LIMIT
    assert line.servos.registers[1]["goal_position"] == before
    assert write(line, 1, "operating_mode", OperatingMode.CURRENT_BASED_POSITION) == StatusError.NONE
    assert write(line, 1, "goal_position", 3001) == StatusError.NONE, "mode 5 knows no position limits"
    assert write(line, 2, "goal_velocity", line.servos.registers[2]["velocity_limit"] + 1) == StatusError.DATA_LIMIT


def test_a_write_of_several_items_is_all_or_nothing(line) -> None:
    data = F["profile_velocity"].encode(50) + F["goal_position"].encode(9999)
    assert line.servos.write(1, 112, data) == StatusError.DATA_LIMIT
    assert line.servos.registers[1]["profile_velocity"] == 0


def test_the_watchdog_stops_the_servo_and_makes_goals_read_only(line) -> None:
    write(line, 1, "torque_enable", 1)
    write(line, 1, "bus_watchdog", 5)
    write(line, 1, "goal_position", 3000)
    line.servos.last_packet[:] = line.time
    line.advance(line.time + 0.11)
    stopped_at = line.servos.registers[1]["goal_position"]
    line.advance(line.time + 1.0)
    assert line.servos.registers[1]["bus_watchdog"] == -1
    assert write(line, 1, "goal_position", 2000) == StatusError.DATA_RANGE
    assert abs(line.servos.plant.velocity[0]) < 1e-3
    assert line.servos.registers[1]["goal_position"] == stopped_at
    assert write(line, 1, "bus_watchdog", 0) == StatusError.NONE
    assert write(line, 1, "goal_position", 2000) == StatusError.NONE


def test_reboot_clears_ram_and_answers_after_a_while(line, bus) -> None:
    bus.write(1, F["profile_velocity"], 40)
    bus.write(1, F["torque_enable"], 1)
    Protocol2PacketHandler().reboot(bus.port, 1)
    assert 1 not in bus.sync_read((1, 2), 126, 10).replies
    bus.port.clock.sleep_until(bus.port.clock.now() + BOOT_TIME)
    assert bus.read(1, F["profile_velocity"]) == 0
    assert bus.read(1, F["torque_enable"]) == 0
    assert bus.read(2, F["id"]) == 2


def test_indirect_data_reads_what_its_pointer_names(line) -> None:
    line.servos.measure(0)
    for k in range(4):
        assert line.servos.write(1, 168 + 2 * k, (132 + k).to_bytes(2, "little")) == StatusError.NONE
    assert line.servos.registers[1].read(224, 4) == line.servos.registers[1].read(132, 4)
    assert int.from_bytes(line.servos.registers[1].read(224, 4), "little") == 2048


def test_turns_are_counted_until_the_mode_changes(line) -> None:
    write(line, 2, "torque_enable", 1)
    write(line, 2, "goal_velocity", 200)
    line.advance(line.time + 2.0)
    line.servos.measure(1)
    assert line.servos.registers[2]["present_position"] > 4096
    write(line, 2, "torque_enable", 0)
    line.advance(line.time + 1.0)
    write(line, 2, "operating_mode", OperatingMode.EXTENDED_POSITION)
    line.servos.measure(1)
    assert 0 <= line.servos.registers[2]["present_position"] < 4096


def test_reverse_mode_turns_the_shaft_but_not_the_homing_offset(line) -> None:
    write(line, 1, "homing_offset", 100)
    line.servos.measure(0)
    assert line.servos.registers[1]["present_position"] == 2148
    write(line, 1, "drive_mode", 1)
    line.servos.measure(0)
    assert line.servos.registers[1]["present_position"] == -2048 + 100


def test_voltage_sags_with_current(line) -> None:
    write(line, 1, "torque_enable", 1)
    write(line, 1, "goal_position", 4000)
    line.advance(line.time + 0.003)
    line.servos.measure(0)
    assert line.servos.registers[1]["present_voltage"] < 120
    assert line.servos.registers[1]["present_current"] != 0
    assert line.servos.registers[1]["moving"] == 1


def test_the_profile_velocity_limits_the_set_point(line) -> None:
    write(line, 1, "torque_enable", 1)
    write(line, 1, "profile_velocity", 20)  # 0.48 rad/s
    write(line, 1, "goal_position", 3000)
    line.advance(line.time + 1.0)
    speed = line.servos.plant.velocity[0]
    assert speed == pytest.approx(20 * 0.229 * 2 * np.pi / 60, rel=0.02)


def test_the_step_response_is_that_of_the_motor_law(line) -> None:
    """Small step, no saturation: q = 1 − (1 + ω t) e^(−ω t), ω = 2k/d (critically damped)."""
    law = MotorLaw([MX_106])
    omega = 2 * law.stiffness[0] / law.damping[0]
    write(line, 1, "torque_enable", 1)
    start = line.servos.plant.position[0]
    write(line, 1, "goal_position", 2048 + 50)
    t = 0.05
    line.advance(line.time + t)
    step = 50 * RAD_PER_TICK
    expected = step * (1 - (1 + omega * t) * np.exp(-omega * t))
    # Semi-implicit Euler at 2 ms: error of order ω·dt = 9 %.
    assert line.servos.plant.position[0] - start == pytest.approx(expected, rel=0.09)


def test_no_servo_exceeds_its_no_load_speed(line) -> None:
    write(line, 1, "torque_enable", 1)
    write(line, 1, "goal_position", 4095)
    fastest = 0.0
    for _ in range(200):
        line.advance(line.time + 2.5 * PHYSICS_STEP)
        fastest = max(fastest, abs(line.servos.plant.velocity[0]))
    assert 0.8 * MX_106.no_load_speed < fastest <= MX_106.no_load_speed


def test_status_return_level_silences_acknowledgements(line, bus) -> None:
    from dynsim.hardware.bus.protocol import NoAnswer

    line.servos.registers[1]["status_return_level"] = 1
    assert bus.read(1, F["id"]) == 1
    with pytest.raises(NoAnswer):
        bus.write(1, F["led"], 1)
    assert line.servos.registers[1]["led"] == 1
    line.servos.registers[1]["status_return_level"] = 0
    with pytest.raises(NoAnswer):
        bus.read(1, F["id"])
    assert Protocol2PacketHandler().ping(bus.port, 1)[0] == 321


def test_registered_writes_wait_for_the_action(line, bus) -> None:
    library = Protocol2PacketHandler()
    library.regWriteTxRx(bus.port, 1, 65, 1, [1])
    assert line.servos.registers[1]["led"] == 0
    bus.port.is_using = False
    library.action(bus.port, 254)
    assert line.servos.registers[1]["led"] == 1


def test_the_bits_of_the_error_register_have_names() -> None:
    assert describe_hardware_error(0x24) == "overheating, overload"
    assert describe_hardware_error(0x80) == "no known bit (0x80)"


def test_effort_registers_convert_both_ways() -> None:
    assert MX_106.torque(MX_106.effort(3.0)) == pytest.approx(3.0, abs=0.01)
    assert MX_28.torque(MX_28.effort(-1.0)) == pytest.approx(-1.0, abs=0.01)


def test_a_packet_may_come_in_pieces_but_not_for_ever(line) -> None:
    from dynsim.hardware.bus.packet import Packet, encode

    ping = encode(Packet(1, 1))
    assert line.transmit(ping[:6], 0.0, 1_000_000) == []
    assert len(line.transmit(ping[6:], 0.001, 1_000_000)) == 1
    assert line.transmit(ping[:6], 0.002, 1_000_000) == []
    assert len(line.transmit(ping, 0.1, 1_000_000)) == 1, "half a packet from long ago does not spoil the next"


def scripted_line(*faults: dict) -> VirtualLine:
    servos = {1: ServoRegisters(MX_106, 1, BAUD_CODE), 2: ServoRegisters(MX_28, 2, BAUD_CODE)}
    script = FaultScript.model_validate({"faults": list(faults)})
    return VirtualLine(servos, positions=[2048 * RAD_PER_TICK, 0.0], script=script)


def test_a_loss_of_the_supply_leaves_servos_limp_and_started_anew() -> None:
    line = scripted_line({"kind": "supply_loss", "at": 0.5})
    bus = DynamixelBus(VirtualPort(line, VirtualClock(), baud=1_000_000))
    bus.write(1, F["return_delay"], 10)
    bus.write(1, F["torque_enable"], 1)
    bus.write(1, F["profile_velocity"], 40)
    bus.write(1, F["bus_watchdog"], 100)
    line.servos.raise_error(1, 1 << 2)
    lost = line.servos.torque_since + 0.5

    def answers(after: float) -> bool:
        bus.port.clock.sleep_until(lost + after)
        return set(bus.sync_read((1, 2), 126, 10).replies) == {1, 2}

    assert answers(-0.01)
    assert not answers(0.01)
    assert line.servos.registers[1]["torque_enable"] == 0
    assert not answers(0.29)
    assert not answers(0.3 + BOOT_TIME - 0.02)
    assert answers(0.3 + BOOT_TIME + 0.01)
    assert [bus.read(1, F[name]) for name in ("torque_enable", "profile_velocity", "bus_watchdog")] == [0, 0, 0]
    assert bus.read(2, F["hardware_error"]) == 0
    assert bus.read(1, F["return_delay"]) == 10, "EEPROM stays"
    assert bus.read(1, F["present_voltage"]) == 120


@pytest.mark.parametrize(("drop", "dies"), [(5.9, False), (6.1, True)])
def test_servos_die_below_six_volts_and_start_anew_above(drop: float, dies: bool) -> None:
    """Whoever is silent draws nothing; with the supply back they are limp, as after any start."""
    line = scripted_line({"kind": "voltage_sag", "drop": drop, "at": 0.5, "duration": 0.5})
    write(line, 1, "torque_enable", 1)
    line.advance(0.7)
    assert line.servos.receives(1) != dies
    assert line.servos.registers[1]["torque_enable"] == (not dies)
    line.advance(0.9)
    assert line.servos.receives(1) != dies, "a start cannot come to its end without volts"
    line.advance(1.1 + BOOT_TIME)
    assert line.servos.receives(1)
    assert line.servos.registers[1]["torque_enable"] == (not dies)
    line.servos.measure(0)
    assert line.servos.registers[1]["present_voltage"] == 120


def test_a_fault_in_a_long_silence_is_not_slept_over() -> None:
    """With torque off nothing moves and time passes in one step, but not past a loss of the supply."""
    line = scripted_line({"kind": "supply_loss", "at": 1.0})
    write(line, 1, "torque_enable", 1)
    write(line, 1, "torque_enable", 0)
    write(line, 1, "profile_velocity", 40)
    line.advance(60.0)
    assert line.servos.registers[1]["profile_velocity"] == 0
    assert line.servos.receives(1)


@pytest.mark.parametrize("periods", [1, 2, 3])
def test_a_late_status_is_the_answer_to_an_earlier_request(periods: int) -> None:
    """A servo ``periods`` late tells cycle k + periods where it was in cycle k."""
    line = scripted_line({"kind": "late_status", "id": 2, "delay": periods * 0.01})
    write(line, 2, "operating_mode", OperatingMode.VELOCITY)
    write(line, 2, "torque_enable", 1)
    write(line, 2, "goal_velocity", 100)
    line.advance(0.5)
    port = VirtualPort(line, VirtualClock(), baud=1_000_000)
    reported, true = [], []
    for cycle in range(10):
        port.clock.sleep_until(1.0 + 0.01 * cycle)
        # One that has missed no answer: after that it knows those to earlier requests.
        reply = DynamixelBus(port).sync_read((1, 2), 132, 4).replies.get(2)
        reported.append(reply and F["present_position"].decode(reply.data))
        true.append(line.servos.registers[2]["present_position"])
    assert reported[:periods] == [None] * periods
    assert reported[periods:] == true[:-periods]
