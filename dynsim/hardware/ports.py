"""Open the servo bus on a named port, real or virtual."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from dynsim.hardware.bus.dynamixel_bus import DynamixelBus, latency_timer, open_serial_port
from dynsim.hardware.bus.protocol import Clock, PacedClock, VirtualClock
from dynsim.hardware.errors import VerificationFailed
from dynsim.hardware.servo_map import ServoMap
from dynsim.hardware.virtual.faults import FaultScript
from dynsim.hardware.virtual.line import VirtualPort, line_for_map

VIRTUAL = "virtual"
PSEUDO_TERMINAL_LATENCY = 0.05
"""Latency allowed for virtual servos on a pseudo-terminal [s]: a busy computer may suspend their process."""


@contextmanager
def bus_on(
    port: str,
    servo_map: ServoMap,
    *,
    script: FaultScript | None = None,
    plant: Any = None,
    posture: Mapping[str, float] | None = None,
    in_wall_time: bool = False,
) -> Iterator[tuple[DynamixelBus, Clock]]:
    """Open the servo bus on a port, and close it when the block ends.

    Parameters
    ----------
    port : str
        Serial device, or "virtual" for virtual servos in this process.
    servo_map : ServoMap
        Map with the servos and the settings of the bus.
    script : FaultScript, optional
        Faults that the virtual servos simulate.
    plant : optional
        Plant that the virtual servos drive.
    posture : mapping of str to float, optional
        Initial joint angles of the virtual servos [rad].
    in_wall_time : bool, optional
        If True, virtual servos run in real time, or slower on a busy computer; otherwise their clock does not wait.

    Yields
    ------
    bus : DynamixelBus
    clock : Clock

    Raises
    ------
    PortError
        If the port cannot be opened.
    VerificationFailed
        If the latency timer of the adapter is too long for the control loop.
    """
    if port == VIRTUAL:
        line = line_for_map(servo_map, script=script, plant=plant, posture=posture or {})
        clock: Clock = PacedClock() if in_wall_time else VirtualClock()
        handler: Any = VirtualPort(line, clock, baud=servo_map.bus.baud)
    else:
        clock = Clock()
        timer = latency_timer(port)
        if timer is not None and timer > 1:
            raise VerificationFailed(
                f"{port}: the latency timer of the adapter is {timer} ms (limit 1 ms); set it with "
                f"echo 1 | sudo tee /sys/bus/usb-serial/devices/{Path(port).resolve().name}/latency_timer"
            )
        handler = open_serial_port(port, servo_map.bus.baud)
    latency = servo_map.bus.latency
    if port != VIRTUAL and str(Path(port).resolve()).startswith("/dev/pts/"):
        latency = max(latency, PSEUDO_TERMINAL_LATENCY)
    with closing(DynamixelBus(handler, latency=latency, return_delay=servo_map.bus.return_delay)) as bus:
        yield bus, clock
