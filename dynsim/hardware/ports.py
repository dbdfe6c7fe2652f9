"""Opening of a bus by the name of its port, real or virtual."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dynsim.hardware.bus.dynamixel_bus import DynamixelBus, latency_timer, open_serial_port
from dynsim.hardware.bus.protocol import Clock, VirtualClock, WallClock
from dynsim.hardware.errors import VerificationFailed
from dynsim.hardware.servo_map import ServoMap
from dynsim.hardware.virtual.faults import FaultScript
from dynsim.hardware.virtual.line import VirtualPort, line_for_map

VIRTUAL = "virtual"
PSEUDO_TERMINAL_LATENCY = 0.05
"""Latency allowed to virtual servos behind a pseudo-terminal, as a busy computer may suspend their process [s]."""


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
    """The bus behind a port name, "virtual" being servos in memory on a virtual clock, or ``in_wall_time``.

    ``script`` and ``plant`` are for virtual servos, and so is ``posture``, in which they stand at first [rad by joint].

    Raises
    ------
    PortError
        The port cannot be opened.
    VerificationFailed
        The adapter's latency timer is too long for the loop.
    """
    clock: Clock
    if port == VIRTUAL:
        line = line_for_map(servo_map, script=script, plant=plant, posture=posture or {})
        clock = WallClock(time.monotonic()) if in_wall_time else VirtualClock()
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
