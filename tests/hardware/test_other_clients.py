"""Dynamixel clients (dynamixel_sdk, dynamixel_easy_sdk, rustypot, our bus) on the serial port of `dynsim hw virtual`.

No reply times are asserted: the clients get longer time-outs, as a busy machine may delay the virtual servos.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import dynamixel_sdk as sdk
import pytest
from dynamixel_sdk import COMM_SUCCESS, PortHandler, Protocol2PacketHandler
from support.processes import started, wait_for

from dynsim.hardware.bus.control_table import BAUD_RATES, MODELS, MX_106, RAD_PER_TICK

pytestmark = pytest.mark.long

FIELDS = MX_106.fields
BAUD = 1_000_000
FACTORY_BAUD = 57_600
LATENCY_MS = 500  # in place of what the SDK allows for the adapter's latency timer
MODEL_OF = {1: "MX-106", 2: "XM430-W350", 3: "XL430-W250", 4: "XH540-W270"}
FRICTION = 3  # ticks between the shaft at rest and its goal
NUMBER_OF = {id_: MODELS[name].number for id_, name in MODEL_OF.items()}
MAP = """\
robot: four
bus: {baud: 1000000, rate: 50}
safety: {supply: {lowest: 10, highest: 13}}
kinds:
  mx: &kind
    model: MX-106
    mode: position
    follows: {position: q, velocity: v}
    limits: {position_deg: [-60, 60], velocity: 3.0, torque: 1.0}
    following_error: 0.2
  xm: {<<: *kind, model: XM430-W350}
  xl: {<<: *kind, model: XL430-W250}
  xh: {<<: *kind, model: XH540-W270}
servos:
  a: {kind: mx, id: 1}
  b: {kind: xm, id: 2}
  c: {kind: xl, id: 3}
  d: {kind: xh, id: 4}
"""


@pytest.fixture
def device(tmp_path: Path) -> Iterator[str]:
    """Four models behind a serial device, in a process of their own."""
    (tmp_path / "four.yaml").write_text(MAP, encoding="utf-8")
    link = tmp_path / "ttyDXL"
    command = [sys.executable, "-m", "dynsim", "hw", "virtual", "--map", tmp_path / "four.yaml", "--link", link]
    with started([str(part) for part in command], tmp_path / "stderr"):
        wait_for(link.is_symlink)
        yield str(link)


@pytest.fixture
def port(device: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[PortHandler]:
    """The library's own port, with patience."""
    monkeypatch.setattr(sys.modules[PortHandler.__module__], "LATENCY_TIMER", LATENCY_MS)
    handler = PortHandler(device)
    assert handler.setBaudRate(BAUD)
    yield handler
    handler.closePort()


def patiently(answers: Callable[[], bool]) -> None:
    """Until a servo that starts anew answers again."""
    wait_for(answers, failure="it never answered again")


def test_every_instruction_of_the_makers_library(port: PortHandler) -> None:
    library = Protocol2PacketHandler()

    def alive(id_: int) -> bool:
        return library.ping(port, id_)[1] == COMM_SUCCESS

    assert library.ping(port, 2) == (NUMBER_OF[2], COMM_SUCCESS, 0)
    assert {id_: model for id_, (model, _) in library.broadcastPing(port)[0].items()} == NUMBER_OF
    # write and read of 1, 2 and 4 bytes, in one go and in two
    for size, name, value in ((1, "led", 1), (2, "position_p_gain", 700), (4, "profile_velocity", 123)):
        address = FIELDS[name].address
        assert getattr(library, f"write{size}ByteTxRx")(port, 2, address, value) == (COMM_SUCCESS, 0)
        assert getattr(library, f"read{size}ByteTxRx")(port, 2, address) == (value, COMM_SUCCESS, 0)
        assert getattr(library, f"write{size}ByteTxOnly")(port, 3, address, value) == COMM_SUCCESS
        time.sleep(0.1)  # its acknowledgement, which nobody waits for
        assert getattr(library, f"read{size}ByteTx")(port, 3, address) == COMM_SUCCESS
        assert getattr(library, f"read{size}ByteRx")(port, 3) == (value, COMM_SUCCESS, 0)
    # registered writes
    assert library.regWriteTxRx(port, 1, FIELDS["led"].address, 1, [1]) == (COMM_SUCCESS, 0)
    assert library.regWriteTxOnly(port, 4, FIELDS["led"].address, 1, [1]) == COMM_SUCCESS
    time.sleep(0.1)
    assert [library.read1ByteTxRx(port, id_, FIELDS["led"].address)[0] for id_ in (1, 4)] == [0, 0]
    assert library.action(port, sdk.BROADCAST_ID) == COMM_SUCCESS
    assert [library.read1ByteTxRx(port, id_, FIELDS["led"].address)[0] for id_ in (1, 4)] == [1, 1]
    # groups
    write = sdk.GroupSyncWrite(port, library, FIELDS["profile_acceleration"].address, 4)
    for id_ in MODEL_OF:
        write.addParam(id_, [id_, 0, 0, 0])
    assert write.txPacket() == COMM_SUCCESS
    for exchange in ("txRxPacket", "fastSyncRead"):
        sync_read = sdk.GroupSyncRead(port, library, FIELDS["profile_acceleration"].address, 4)
        for id_ in MODEL_OF:
            sync_read.addParam(id_)
        assert getattr(sync_read, exchange)() == COMM_SUCCESS, exchange
        accelerations = [sync_read.getData(id_, FIELDS["profile_acceleration"].address, 4) for id_ in MODEL_OF]
        assert accelerations == list(MODEL_OF), exchange
    bulk_write = sdk.GroupBulkWrite(port, library)
    bulk_write.addParam(1, FIELDS["led"].address, 1, [0])
    bulk_write.addParam(2, FIELDS["profile_velocity"].address, 4, [99, 0, 0, 0])
    assert bulk_write.txPacket() == COMM_SUCCESS
    for exchange in ("txRxPacket", "fastBulkRead"):
        bulk_read = sdk.GroupBulkRead(port, library)
        bulk_read.addParam(1, FIELDS["led"].address, 1)
        bulk_read.addParam(2, FIELDS["profile_velocity"].address, 4)
        assert getattr(bulk_read, exchange)() == COMM_SUCCESS, exchange
        assert bulk_read.getData(1, FIELDS["led"].address, 1) == 0
        assert bulk_read.getData(2, FIELDS["profile_velocity"].address, 4) == 99
    assert library.clearMultiTurn(port, 1) == (COMM_SUCCESS, 0)
    # restart and factory reset
    assert library.reboot(port, 2) == (COMM_SUCCESS, 0)
    patiently(lambda: alive(2))
    assert library.read4ByteTxRx(port, 2, FIELDS["profile_velocity"].address)[0] == 0
    assert library.factoryReset(port, 4, 0x01) == (COMM_SUCCESS, 0)
    port.setBaudRate(FACTORY_BAUD)
    patiently(lambda: alive(4))
    assert library.read1ByteTxRx(port, 4, FIELDS["return_delay"].address)[0] == FIELDS["return_delay"].default
    assert set(library.broadcastPing(port)[0]) == {4}
    assert library.write1ByteTxRx(port, 4, FIELDS["baud"].address, BAUD_RATES.index(BAUD)) == (COMM_SUCCESS, 0)
    port.setBaudRate(BAUD)
    # ID and protocol
    assert library.write1ByteTxRx(port, 4, FIELDS["id"].address, 9) == (COMM_SUCCESS, 0)
    assert library.write1ByteTxRx(port, 3, FIELDS["protocol"].address, 1) == (COMM_SUCCESS, 0)
    assert set(library.broadcastPing(port)[0]) == {1, 2, 9}


def test_the_makers_easy_library(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    easy = pytest.importorskip("dynamixel_easy_sdk")
    monkeypatch.setattr(sys.modules[PortHandler.__module__], "LATENCY_TIMER", LATENCY_MS)
    connector = easy.Connector(device, BAUD)
    motors = {motor.id: motor for motor in connector.createAllMotors()}
    assert {id_: motor.model_number for id_, motor in motors.items()} == NUMBER_OF
    motor = motors[2]
    for get, name in (
        ("getMaxPositionLimit", "max_position"),
        ("getMinPositionLimit", "min_position"),
        ("getVelocityLimit", "velocity_limit"),
        ("getCurrentLimit", "current_limit"),
        ("getPWMLimit", "pwm_limit"),
    ):
        assert getattr(motor, get)() == MODELS["XM430-W350"].fields[name].default
    motor.setOperatingMode(easy.OperatingMode.VELOCITY)
    motor.setVelocityLimit(150)
    motor.setHomingOffset(10)
    assert motor.getPresentPosition() == 2048 + 10
    motor.setHomingOffset(0)
    motor.enableTorque()
    motor.setGoalVelocity(100)
    wait_for(lambda: motor.getPresentVelocity() > 90)
    with pytest.raises(easy.DxlRuntimeError):
        motor.setGoalVelocity(151)
    motor.disableTorque()
    assert motor.getOperatingMode() == easy.OperatingMode.VELOCITY

    # groups: one block of all (sync), then different ones (bulk)
    group, others = connector.createGroupExecutor(), [motors[id_] for id_ in (1, 3, 4)]
    for other in others:
        group.addCmd(other.stageEnableTorque())
    group.executeWrite()
    group.clearStagedWriteCommands()
    for other in others:
        group.addCmd(other.stageSetGoalPosition(2000 + 10 * other.id))
        group.addCmd(other.stageGetPresentPosition())
    group.executeWrite()
    wait_for(
        lambda: all(
            abs(at - 2000 - 10 * id_) <= FRICTION for at, id_ in zip(group.executeRead(), (1, 3, 4), strict=True)
        )
    )
    mixed = connector.createGroupExecutor()
    mixed.addCmd(motors[1].stageLEDOn())
    mixed.addCmd(motors[3].stageDisableTorque())
    mixed.addCmd(motors[1].stageIsLEDOn())
    mixed.addCmd(motors[3].stageGetPresentVelocity())
    mixed.executeWrite()
    lit, velocity = mixed.executeRead()
    assert lit == 1
    assert abs(velocity) <= 2  # it may still be coming to rest

    motors[3].changeID(30)
    assert motors[3].ping() == NUMBER_OF[3]
    motors[3].factoryResetExceptIDAndBaudRate()
    wait_for(lambda: set(connector.broadcastPing()) == {1, 2, 4, 30})
    motors[1].reboot()
    wait_for(lambda: 1 in connector.broadcastPing())
    assert motors[1].isTorqueOn() == 0
    connector.closePort()


def test_rustypot(device: str) -> None:
    rustypot = pytest.importorskip("rustypot")
    controller = rustypot.Xl430PyController
    client = controller(device, BAUD, 2.0)
    assert client.ping(3)
    assert client.broadcast_scan() == NUMBER_OF
    assert client.read_model_number(3) == [NUMBER_OF[3]]
    ids = list(MODEL_OF)
    for fast in (False, True):
        client.set_fast_sync_read(fast)
        assert client.sync_read_present_position(ids) == [2048] * 4
        assert client.sync_read_raw_data(ids, FIELDS["present_position"].address, 4) == [b"\x00\x08\x00\x00"] * 4
    client.set_fast_sync_read(False)
    client.sync_write_torque_enable(ids, [1, 1, 1, 1])
    client.sync_write_goal_position(ids, [2048 + 50 * id_ for id_ in ids])
    wait_for(
        lambda: all(
            abs(at - 2048 - 50 * id_) <= FRICTION
            for id_, at in zip(ids, client.sync_read_present_position(ids), strict=True)
        )
    )
    client.write_torque_enable(1, 0)
    assert client.read_torque_enable(1) == [0]
    assert client.reboot(2)
    wait_for(lambda: client.ping(2))
    assert client.read_torque_enable(2) == [0]
    client.factory_reset(3)
    client.close()
    definition = controller.definition()
    with rustypot.Bus(device, BAUD, 2.0, dict.fromkeys(ids, definition)) as bus:
        assert bus.set_torque([1, 4], False) == {}
        bus.change_id(definition, 4, 40)
        bus.change_baudrate(definition, 1, FACTORY_BAUD)
        wait_for(lambda: set(bus.broadcast_scan(definition)) >= {2, 40})
        assert 1 not in bus.broadcast_scan(definition)
        bus.set_baudrate(FACTORY_BAUD)
        assert bus.broadcast_scan(definition)[1] == NUMBER_OF[1]


STEERING = """
import sys, time
from dynsim.hardware.bus.control_table import MX_106
from dynsim.hardware.bus.dynamixel_bus import DynamixelBus, open_serial_port
field = MX_106.fields
bus = DynamixelBus(open_serial_port(sys.argv[1], 1_000_000, exclusive=False), latency=2.0)
bus.write(1, field["operating_mode"], 1)
bus.write(1, field["torque_enable"], 1)
bus.write(1, field["bus_watchdog"], 10)
while True:
    bus.sync_write(field["goal_velocity"], {1: 50})
    print("told", file=sys.stderr, flush=True)
    time.sleep(0.02)
"""


def test_the_servos_see_a_client_that_is_stopped(device: str, port: PortHandler, tmp_path: Path) -> None:
    """SIGSTOP: nobody speaks for longer than the watchdog, and the wheel stands still without being told to."""
    library = Protocol2PacketHandler()

    def read(name: str) -> Any:
        data, result, _ = library.readTxRx(port, 1, FIELDS[name].address, FIELDS[name].size)
        return FIELDS[name].decode(bytes(data)) if result == COMM_SUCCESS else None

    with started([sys.executable, "-c", STEERING, device], tmp_path / "steering") as client:
        client.wait_for("told", count=30)
        os.kill(client.process.pid, signal.SIGSTOP)
        # Every packet feeds the watchdog: it is left alone for longer than that between two looks.
        for _ in range(20):
            time.sleep(1.0)
            if read("bus_watchdog") == -1:
                break
        assert read("bus_watchdog") == -1
        assert read("torque_enable") == 1
        assert abs(read("present_velocity")) <= 1
        at = read("present_position")
        messages = client.stderr.count("told")
        os.kill(client.process.pid, signal.SIGCONT)
        client.wait_for("told", count=messages + 20)
        # It throws away what waits to be read, before each request.
        os.kill(client.process.pid, signal.SIGSTOP)
        assert abs(read("present_position") - at) <= 1, "goals are read-only until the watchdog is cleared"
        assert read("bus_watchdog") == -1


def test_the_robot_of_a_scenario_behind_the_device(tmp_path: Path) -> None:
    """`--plant`: the servos stand where the scenario starts, not at zero."""
    link = tmp_path / "ttyDXL"
    arguments = ["--map", "arm", "--link", link, "--plant", "elbow_comparison", "--variant", "two_elbows"]
    command = [sys.executable, "-m", "dynsim", "hw", "virtual", *map(str, arguments)]
    with started(command, tmp_path / "stderr"):
        wait_for(link.is_symlink, timeout=500.0)  # kernels may have to be compiled
        read = subprocess.run(
            [sys.executable, "-c", POSTURE, str(link)], capture_output=True, text=True, timeout=120, check=True
        )
    from dynsim.hardware.servo_map import load_servo_map
    from dynsim.scenario import build, load_scenario

    robot = build.robot(load_scenario("elbow_comparison", variant="two_elbows"))
    start = dict(zip(robot.joint_names, robot.initial, strict=True))
    ticks = dict(zip(load_servo_map("arm").ids, map(int, read.stdout.split()), strict=True))
    for servo in load_servo_map("arm").servos:
        assert abs(servo.to_angle(ticks[servo.id]) - start[servo.label]) < 2 * RAD_PER_TICK
    assert max(map(abs, start.values())) > 0.1


POSTURE = """
import sys
from dynsim.hardware.bus.dynamixel_bus import DynamixelBus, open_serial_port
from dynsim.hardware.servo_map import load_servo_map
servo_map = load_servo_map("arm")
bus = DynamixelBus(open_serial_port(sys.argv[1], servo_map.bus.baud), latency=2.0)
print(*[bus.read(servo.id, servo.model.fields["present_position"]) for servo in servo_map.servos])
"""
