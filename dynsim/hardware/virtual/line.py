"""A virtual half-duplex line with servos: takes the bytes of requests, returns those of answers with arrival times.

:class:`dynsim.hardware.virtual.port.VirtualPort` puts a line under the client library on a virtual clock,
:mod:`dynsim.hardware.virtual.pseudo_terminal` behind a serial device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import serial

from dynsim.hardware.bus.control_table import BAUD_RATES, RAD_PER_TICK, RETURN_DELAY_SECONDS_PER_UNIT
from dynsim.hardware.bus.packet import STATUS, Decoder, Packet
from dynsim.hardware.servo_map import ServoMap
from dynsim.hardware.virtual.faults import FaultScript
from dynsim.hardware.virtual.firmware import Firmware
from dynsim.hardware.virtual.injection import Injection
from dynsim.hardware.virtual.registers import ServoRegisters
from dynsim.hardware.virtual.servo_plant import ServoPlant
from dynsim.hardware.virtual.servos import PHYSICS_STEP, VirtualServos

BYTE_TIMEOUT = 5e-3
"""Longest pause within a packet [s] (unverified)."""
TURNAROUND = 20e-6
"""Time a servo takes beyond its return delay before it answers [s] (unverified)."""
ADAPTER_LATENCY = 1e-3
"""From the wire to the reader: a USB adapter with its latency timer at 1 ms [s]."""

Listener = Callable[[float, Packet], None]


class VirtualLine:
    """N servos on one half-duplex line.

    Parameters
    ----------
    servos : mapping of int to ServoRegisters
        By ID.
    positions : sequence of float
        Initial servo angles [rad], 0 at tick 0.
    plant : ServoPlant, optional
        What the servos move; every one its own inertia if not given.
    script : FaultScript
    listener : callable, optional
        Called with (time, packet) for every valid packet that a servo can hear.
    """

    def __init__(
        self,
        servos: Mapping[int, ServoRegisters],
        *,
        positions: Iterable[float],
        plant: ServoPlant | None = None,
        script: FaultScript | None = None,
        listener: Listener | None = None,
    ) -> None:
        script = script or FaultScript()
        self.servos = VirtualServos(servos, positions=positions, plant=plant, script=script)
        self.listener = listener
        self._faults = Injection(self.servos, script)
        self._firmware = Firmware(self.servos)
        self._decoders: dict[int, Decoder] = {}
        self._heard = 0.0
        self._faults.apply()

    @property
    def time(self) -> float:
        """[s]."""
        return self.servos.time

    @property
    def unplugged(self) -> bool:
        """The adapter was pulled out."""
        return self._faults.unplugged

    def advance(self, now: float) -> None:
        """Let time pass until ``now`` [s]."""
        while now - self.servos.time >= PHYSICS_STEP:
            self.servos.step(now)
            self._faults.apply()

    @property
    def baud(self) -> int:
        """What the first servo is set to [bit/s]."""
        return next(iter(self.servos.registers.values())).baud

    def transmit(self, data: bytes, start: float, baud: int) -> list[tuple[float, bytes]]:
        """Put bytes on the line at ``start`` [s]; the answers, each with the time its last byte reaches the reader.

        Raises
        ------
        OSError
            The adapter was pulled out.
        """
        end = start + len(data) * 10 / baud
        self.advance(end)
        if self.unplugged:
            raise serial.SerialException(5, "Input/output error")
        arrivals: list[tuple[float, bytes]] = []
        if self._faults.echo:
            arrivals.append((end + ADAPTER_LATENCY, data))
        # A packet that stopped half-way is given up after a while.
        given_up = start - self._heard > BYTE_TIMEOUT
        self._heard = end
        # To servos at another bit rate this is noise.
        if baud in self.servos.hearing:
            decoder = self._decoders.setdefault(baud, Decoder())
            packets = [*decoder.flush()] if given_up else []
            for packet in [*packets, *decoder.feed(data)]:
                if packet.instruction != STATUS and baud in self.servos.hearing:
                    arrivals += self._execute(packet, end, baud)
        return arrivals

    def _execute(self, packet: Packet, now: float, baud: int) -> list[tuple[float, bytes]]:
        hearing = self.servos.hearing[baud]
        self.servos.hear(hearing, now)
        if self.listener:
            self.listener(now, packet)
        arrivals: list[tuple[float, bytes]] = []
        for answer in self._firmware.answers(packet, hearing):
            first = answer.servos[0]
            if not answer.chained:
                now += self.servos.registers[first]["return_delay"] * RETURN_DELAY_SECONDS_PER_UNIT + TURNAROUND
            now += len(answer.frame) * 10 / baud
            arrivals += self._faults.disturb(first, answer.frame, now + ADAPTER_LATENCY)
        return arrivals


def line_for_map(servo_map: ServoMap, **options: Any) -> VirtualLine:
    """The servos of a map as they should be configured, every joint at its zero.

    Keyword arguments are those of :class:`VirtualLine`; ``posture`` [rad by joint] starts joints elsewhere.
    """
    posture = options.pop("posture", {})
    angles = []
    for servo in servo_map.servos:
        start = posture.get(servo.joint, servo.hold_at or 0.0)
        low, high = servo.position_limits
        angles.append(servo.to_ticks(min(max(start, low), high)) * RAD_PER_TICK)
    servos = {}
    for servo in servo_map.servos:
        registers = ServoRegisters(servo.model, servo.id, BAUD_RATES.index(servo_map.bus.baud))
        registers["operating_mode"] = servo.operating_mode
        registers["return_delay"] = int(servo_map.bus.return_delay / RETURN_DELAY_SECONDS_PER_UNIT)
        servos[servo.id] = registers
    return VirtualLine(servos, positions=angles, **options)
