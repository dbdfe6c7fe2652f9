"""Registers of one virtual servo, with the access rules of the real one."""

from __future__ import annotations

from collections.abc import Collection

from dynsim.hardware.bus.control_table import (
    BAUD_RATES,
    INDIRECT_BLOCKS,
    TABLE_SIZE,
    Field,
    OperatingMode,
    ServoModel,
)
from dynsim.hardware.bus.packet import StatusError

GOAL_FIELDS = ("goal_pwm", "goal_current", "goal_velocity", "goal_position")
MODES = {
    True: (0, 1, 3, 4, 5, 16),  # with current sensor
    False: (1, 3, 4, 16),
}


class ServoRegisters:
    """Control table of one servo.

    Attributes
    ----------
    model : ServoModel
    """

    def __init__(self, model: ServoModel, id_: int, baud_code: int) -> None:
        self.model = model
        self._table = bytearray(TABLE_SIZE)
        self._field_at = {item.address: name for name, item in model.fields.items()}
        # Each read of a state needs a dozen registers: their addresses are looked up once.
        self._places = {
            name: (slice(item.address, item.address + item.size), item.size, item.signed)
            for name, item in model.fields.items()
        }
        self.reset()
        self["id"], self["baud"] = id_, baud_code

    def __getitem__(self, name: str) -> int:
        span, _, signed = self._places[name]
        return int.from_bytes(self._table[span], "little", signed=signed)

    def __setitem__(self, name: str, value: int) -> None:
        span, size, signed = self._places[name]
        self._table[span] = value.to_bytes(size, "little", signed=signed)

    @property
    def baud(self) -> int:
        """[bit/s]."""
        return BAUD_RATES[self["baud"]]

    def reset(self, keep: Collection[str] = ()) -> None:
        """All as delivered, but for the registers named in ``keep``."""
        kept = {name: self[name] for name in keep}
        for name, item in self.model.fields.items():
            self[name] = kept.get(name, item.default)
        self["model_number"] = self.model.number
        self.restart()

    def restart(self) -> None:
        """RAM as after power-on."""
        for name, item in self.model.fields.items():
            if not item.in_eeprom:
                self[name] = item.default
        for pointers, data, count in INDIRECT_BLOCKS:
            for k in range(count):
                self._table[pointers + 2 * k : pointers + 2 * k + 2] = (data + k).to_bytes(2, "little")
                self._table[data + k] = 0
        if "goal_current" in self.model.fields:
            self["goal_current"] = self["current_limit"]
        self["goal_pwm"] = self["pwm_limit"]

    def read(self, address: int, length: int) -> bytes | None:
        """Bytes, indirect ones resolved; None outside of the table."""
        if length < 1 or address + length > TABLE_SIZE:
            return None
        if address + length <= INDIRECT_BLOCKS[0][1]:
            return bytes(self._table[address : address + length])
        return bytes(self._table[self._resolve(a)] for a in range(address, address + length))

    def write(self, address: int, data: bytes) -> StatusError:
        """Write consecutive items, all or none."""
        if not data or address + len(data) > TABLE_SIZE:
            return StatusError.ACCESS
        end = address + len(data)
        direct = end <= INDIRECT_BLOCKS[0][0]
        targets = range(address, end) if direct else [self._resolve(a) for a in range(address, end)]
        pending: list[tuple[str, int]] = []
        position = 0
        while position < len(targets):
            start = targets[position]
            if not direct and self._is_pointer(start):
                if self["torque_enable"]:
                    return StatusError.ACCESS
                self._table[start] = data[position]
                position += 1
                continue
            if not direct and start == address + position and self._is_indirect_data(start):
                self._table[start] = data[position]
                position += 1
                continue
            name = self._field_at.get(start)
            if name is None:
                return StatusError.ACCESS
            item = self.model.fields[name]
            whole = range(start, start + item.size)
            if targets[position : position + item.size] != (whole if direct else [*whole]):
                return StatusError.DATA_LENGTH
            value = item.decode(data[position : position + item.size])
            error = self._objection(name, item, value)
            if error:
                return error
            pending.append((name, value))
            position += item.size
        for name, value in pending:
            self[name] = value
        return StatusError.NONE

    def _objection(self, name: str, field: Field, value: int) -> StatusError:
        if not field.writable:
            return StatusError.ACCESS
        if field.in_eeprom and self["torque_enable"]:
            return StatusError.ACCESS
        if field.low is not None and not field.low <= value <= (field.high or 0):
            return StatusError.DATA_RANGE
        if name == "operating_mode" and value not in MODES[self.model.measures_current]:
            return StatusError.DATA_RANGE
        if name in GOAL_FIELDS:
            if self["bus_watchdog"] == -1:
                return StatusError.DATA_RANGE
            low, high = self._goal_range(name)
            if not low <= value <= high:
                return StatusError.DATA_LIMIT
        if name == "torque_enable" and value and self["hardware_error"] & self["shutdown"]:
            return StatusError.RESULT_FAIL
        return StatusError.NONE

    def _goal_range(self, name: str) -> tuple[int, int]:
        if name == "goal_position":
            if self["operating_mode"] == OperatingMode.POSITION:
                return self["min_position"], self["max_position"]
            # Multi-turn modes know no position limits.
            return -1_048_575, 1_048_575
        limit = self[
            {"goal_pwm": "pwm_limit", "goal_current": "current_limit", "goal_velocity": "velocity_limit"}[name]
        ]
        return -limit, limit

    def _resolve(self, address: int) -> int:
        for pointers, data, count in INDIRECT_BLOCKS:
            if data <= address < data + count:
                at = pointers + 2 * (address - data)
                target = int.from_bytes(self._table[at : at + 2], "little")
                # A pointer to another indirect byte would be followed only once by the real servo.
                return target if target < TABLE_SIZE else address
        return address

    @staticmethod
    def _is_pointer(address: int) -> bool:
        return any(pointers <= address < pointers + 2 * count for pointers, _, count in INDIRECT_BLOCKS)

    @staticmethod
    def _is_indirect_data(address: int) -> bool:
        return any(data <= address < data + count for _, data, count in INDIRECT_BLOCKS)
