"""Injection of scripted faults: failing servos, a dead port, corrupted or delayed status packets."""

from __future__ import annotations

import random
from typing import Any

from dynsim.hardware.bus.packet import crc16
from dynsim.hardware.virtual.faults import FaultScript, WrongRegister
from dynsim.hardware.virtual.servos import OVERHEATING, OVERLOAD, VirtualServos


class Injection:
    """Apply the faults of a script that are not part of the servo model.

    Attributes
    ----------
    unplugged : bool
        True if the adapter was unplugged.
    """

    def __init__(self, servos: VirtualServos, script: FaultScript) -> None:
        self.unplugged = False
        self._servos = servos
        self._script = script
        self._random = random.Random(script.seed)
        self._fired: set[int] = set()

    @property
    def echo(self) -> bool:
        """True if the adapter echoes all sent bytes."""
        return any(fault.kind == "echo" for fault in self._servos.active_faults())

    def apply(self) -> None:
        """Apply the faults that change a servo: once when they become active, a jam at every step."""
        servos = self._servos
        servos.set_power(on=not any(fault.kind == "supply_loss" for fault in servos.active_faults()))
        for number, fault in enumerate(self._script.faults):
            if not fault.active(servos.time - servos.torque_since):
                continue
            if fault.kind == "stuck" and fault.id in servos.registers:
                servos.plant.stop(servos.ids.index(fault.id))
            if number in self._fired:
                continue
            self._fired.add(number)
            if fault.kind == "unplug":
                self.unplugged = True
            if getattr(fault, "id", None) in servos.registers:
                self._apply_to_servo(fault)

    def _apply_to_servo(self, fault: Any) -> None:
        servos, id_ = self._servos, fault.id
        index = servos.ids.index(id_)
        registers = servos.registers[id_]
        if isinstance(fault, WrongRegister):
            name = {"wrong_model": "model_number", "wrong_firmware": "firmware", "wrong_mode": "operating_mode"}[
                fault.kind
            ]
            registers[name] = fault.value
            servos.reload(index)
        match fault.kind:
            case "drop_off":
                servos.dead.add(id_)
                registers["torque_enable"] = 0
                servos.reload(index)
            case "reboot":
                servos.reboot(id_)
            case "overload":
                servos.raise_error(index, OVERLOAD)
            case "overheat":
                servos.temperature[index] = registers["temperature_limit"] + 1.0
                servos.raise_error(index, OVERHEATING)
            case "watchdog_trip":
                servos.trip_watchdog(index)
            case "backlash":
                servos.play[index] = servos.plant.position[index]

    def disturb(self, id_: int, frame: bytes, arrival: float) -> list[tuple[float, bytes]]:
        """Return the arrival time and the bytes of a status packet after the scripted faults; empty if it is lost."""
        chance = self._random.random
        for fault in self._servos.active_faults():
            if getattr(fault, "id", None) not in (None, id_):
                continue
            match fault.kind:
                case "lost_status" if chance() < fault.probability:
                    return []
                case "truncated_status" if chance() < fault.probability:
                    frame = frame[: self._random.randrange(1, len(frame))]
                case "bad_crc" if chance() < fault.probability:
                    at = self._random.randrange(7, len(frame))
                    frame = frame[:at] + bytes([frame[at] ^ 1 << self._random.randrange(8)]) + frame[at + 1 :]
                case "noise" if chance() < fault.probability:
                    frame = self._random.randbytes(self._random.randrange(1, 12)) + frame
                case "late_status" if chance() < fault.probability:
                    arrival += fault.delay
                case "duplicate_id":
                    # Both servos drive the line and a zero bit wins. The frames differ in the measured values only.
                    frame = bytes(a & b for a, b in zip(frame, self._duplicate_frame(frame), strict=True))
        return [(arrival, frame)]

    def _duplicate_frame(self, frame: bytes) -> bytes:
        if len(frame) < 15:
            return frame
        body = bytearray(frame[:-2])
        for k in range(9, len(body)):
            body[k] ^= self._random.randrange(4)
        return bytes(body) + crc16(body).to_bytes(2, "little")
