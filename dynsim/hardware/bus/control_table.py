"""Control tables of MX(2.0) and X servos with Protocol 2.0.

Source: ROBOTIS e-Manual, chapter "Control Table" on the page of each model; the rated values are in
:mod:`dynsim.config.data_sheets`. The limits stored in a servo depend on its firmware version, so that the replay reads
them from the servo; only the virtual servos use the defaults in this module.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import IntEnum

from dynsim.config.data_sheets import SERVO_SHEETS, ServoSheet

TICKS_PER_TURN = 4096
SINGLE_TURN, EXTENDED_TURNS = (0, TICKS_PER_TURN - 1), (-1_048_575, 1_048_575)
"""Lowest and highest goal [ticks] in position mode and in extended position mode."""
RAD_PER_TICK = 2 * math.pi / TICKS_PER_TURN
RAD_S_PER_UNIT = 0.229 * 2 * math.pi / 60  # unit 0.229 rpm of present, goal and profile velocity
RAD_S2_PER_UNIT = 214.577 / 60**2 * 2 * math.pi  # unit 214.577 rev/min² of the profile acceleration
VOLT_PER_UNIT = 0.1
WATCHDOG_SECONDS_PER_UNIT = 0.020
RETURN_DELAY_SECONDS_PER_UNIT = 2e-6
BROADCAST_ID = 254
MAX_ID = 252
EEPROM_END = 64
"""Registers below this address keep their values when the power is off."""

BAUD_RATES = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
"""Bit rates [bit/s], indexed by the code stored at address 8. The Python client library rejects 4.5 Mbit/s."""


class OperatingMode(IntEnum):
    """Operating modes: values of the register at address 11."""

    CURRENT = 0
    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    CURRENT_BASED_POSITION = 5
    PWM = 16


HARDWARE_ERRORS = {0: "input voltage", 2: "overheating", 3: "encoder", 4: "electrical shock", 5: "overload"}
"""Meaning of the bits in the register at address 70."""


def describe_hardware_error(register: int) -> str:
    """Return the names of the errors whose bits are set in the hardware error register (address 70)."""
    names = [name for bit, name in HARDWARE_ERRORS.items() if register >> bit & 1]
    return ", ".join(names) or f"no known bit (0x{register:02x})"


@dataclass(frozen=True)
class Field:
    """One register in a control table.

    Attributes
    ----------
    address, size : int
        Address of the first byte, and number of bytes.
    default : int
        Value after power-on (RAM) or at delivery (EEPROM).
    low, high : int | None
        Range of values that may be written; None if it is limited only by the number of bytes.
    writable, signed : bool
    """

    address: int
    size: int
    default: int = 0
    low: int | None = None
    high: int | None = None
    writable: bool = True
    signed: bool = False

    @property
    def in_eeprom(self) -> bool:
        """True if the value is kept when the power is off, and can be written only while the torque is off."""
        return self.address < EEPROM_END

    def decode(self, data: bytes) -> int:
        """Decode the bytes ``data`` to an integer; it may be negative, unlike the result of getData of the library."""
        return int.from_bytes(data, "little", signed=self.signed)

    def encode(self, value: int) -> bytes:
        """Encode ``value`` to bytes; raise OverflowError if it is negative and the field is unsigned."""
        return int(value).to_bytes(self.size, "little", signed=self.signed)


@dataclass(frozen=True)
class ServoModel(ServoSheet):
    """Specifications of one servo model: its data sheet and its control table.

    Attributes
    ----------
    ampere_per_unit : float
        Unit of the registers for the present current and the goal current, if the model has these registers [A].
    fields : dict[str, Field]
        Control table; the keys are the names of the registers.
    indirect : tuple of (int, int, int)
        Blocks of indirect addresses, see :data:`INDIRECT_BLOCKS`.
    """

    ampere_per_unit: float = 0.0
    fields: dict[str, Field] = field(default_factory=dict, repr=False)
    indirect: tuple[tuple[int, int, int], ...] = ()

    @property
    def turn_mark(self) -> Field:
        """RAM register that marks a verified count of turns: the last indirect address of the first block.

        The servo resets it, like its count of turns, when it starts. The mark has no effect on the motion.
        """
        pointers, data, count = self.indirect[0]
        return Field(pointers + 2 * (count - 1), 2, data + count - 1)

    @property
    def measures_current(self) -> bool:
        """True if address 126 contains a current, False if it contains a load in units of 0.1 % of the stall torque."""
        return "present_current" in self.fields

    def registers_in(self, start: int, data: bytes) -> dict[str, int]:
        """Decode all registers that are completely contained in ``data``; its first byte has the address ``start``."""
        return {
            name: item.decode(data[item.address - start : item.address - start + item.size])
            for name, item in self.fields.items()
            if start <= item.address and item.address + item.size <= start + len(data)
        }

    @property
    def torque_constant(self) -> float:
        """Output torque per ampere [N·m/A], computed for the stalled servo (unverified for other loads)."""
        return self.stall_torque / self.stall_current

    def torque(self, effort: int) -> float:
        """Return the output torque [N·m] that is estimated from ``effort``, the signed register at address 126."""
        if self.measures_current:
            return effort * self.ampere_per_unit * self.torque_constant
        return effort * 1e-3 * self.stall_torque

    def effort(self, torque: float) -> int:
        """Return the value of the register at address 126 for an output torque [N·m]."""
        if self.measures_current:
            return round(torque / self.torque_constant / self.ampere_per_unit)
        return round(torque / self.stall_torque * 1e3)


_COMMON = {
    "model_number": Field(0, 2, writable=False),
    "model_information": Field(2, 4, writable=False),
    "firmware": Field(6, 1, 45, writable=False),
    "id": Field(7, 1, 1, 0, MAX_ID),
    "baud": Field(8, 1, 1, 0, 7),
    "return_delay": Field(9, 1, 250, 0, 254),
    "drive_mode": Field(10, 1, 0, 0, 0x0D),
    "operating_mode": Field(11, 1, OperatingMode.POSITION),
    "shadow_id": Field(12, 1, 255, 0, 255),
    "protocol": Field(13, 1, 2, 1, 2),
    "homing_offset": Field(20, 4, 0, -1_044_479, 1_044_479, signed=True),
    "moving_threshold": Field(24, 4, 10, 0, 1023),
    "temperature_limit": Field(31, 1, 80, 0, 100),
    "max_voltage": Field(32, 2, 160, 95, 160),
    "min_voltage": Field(34, 2, 95, 95, 160),
    "pwm_limit": Field(36, 2, 885, 0, 885),
    "velocity_limit": Field(44, 4, 230, 0, 1023),
    "max_position": Field(48, 4, 4095, 0, 4095),
    "min_position": Field(52, 4, 0, 0, 4095),
    "shutdown": Field(63, 1, 0x34, 0, 0x3D),
    "torque_enable": Field(64, 1, 0, 0, 1),
    "led": Field(65, 1, 0, 0, 1),
    "status_return_level": Field(68, 1, 2, 0, 2),
    "registered_instruction": Field(69, 1, writable=False),
    "hardware_error": Field(70, 1, writable=False),
    "velocity_i_gain": Field(76, 2, 1920, 0, 16383),
    "velocity_p_gain": Field(78, 2, 100, 0, 16383),
    "position_d_gain": Field(80, 2, 0, 0, 16383),
    "position_i_gain": Field(82, 2, 0, 0, 16383),
    "position_p_gain": Field(84, 2, 850, 0, 16383),
    "feedforward_2nd_gain": Field(88, 2, 0, 0, 16383),
    "feedforward_1st_gain": Field(90, 2, 0, 0, 16383),
    "bus_watchdog": Field(98, 1, 0, 0, 127, signed=True),
    "goal_pwm": Field(100, 2, 885, signed=True),
    "goal_velocity": Field(104, 4, 0, signed=True),
    "profile_acceleration": Field(108, 4, 0, 0, 32767),
    "profile_velocity": Field(112, 4, 0, 0, 32767),
    "goal_position": Field(116, 4, 0, signed=True),
    "realtime_tick": Field(120, 2, writable=False),
    "moving": Field(122, 1, writable=False),
    "moving_status": Field(123, 1, writable=False),
    "present_pwm": Field(124, 2, writable=False, signed=True),
    "present_velocity": Field(128, 4, writable=False, signed=True),
    "present_position": Field(132, 4, writable=False, signed=True),
    "velocity_trajectory": Field(136, 4, writable=False, signed=True),
    "position_trajectory": Field(140, 4, writable=False, signed=True),
    "present_voltage": Field(144, 2, writable=False),
    "present_temperature": Field(146, 1, writable=False),
}

_LOAD = {"present_load": Field(126, 2, writable=False, signed=True)}
_EXTERNAL_PORTS = {f"external_port_mode_{k}": Field(55 + k, 1, 3, 0, 3) for k in (1, 2, 3)} | {
    f"external_port_data_{k}": Field(150 + 2 * k, 2) for k in (1, 2, 3)
}


def _current(limit: int) -> dict[str, Field]:
    """Return the extra registers for a current sensor; ``limit`` is the default and maximum current limit."""
    return {
        "current_limit": Field(38, 2, limit, 0, limit),
        "goal_current": Field(102, 2, 0, signed=True),
        "present_current": Field(126, 2, writable=False, signed=True),
    }


def _delivered(fields: dict[str, Field], **defaults: int) -> dict[str, Field]:
    """Return the same registers with different factory defaults for some of them."""
    return fields | {name: replace(fields[name], default=value) for name, value in defaults.items()}


_MX = _COMMON | {"acceleration_limit": Field(40, 4, 32767, 0, 32767)}
_X = _delivered(_COMMON, position_p_gain=800) | {
    "startup_configuration": Field(60, 1, 0, 0, 3),
    "backup_ready": Field(147, 1, writable=False),
}
_XL430 = (
    _delivered(_X, temperature_limit=72, velocity_i_gain=1000, position_d_gain=4000, position_p_gain=640)
    | {"max_voltage": Field(32, 2, 140, 60, 140), "min_voltage": Field(34, 2, 60, 60, 140)}
    | _LOAD
)
_XC430 = (
    _X
    | _LOAD
    | {
        "max_voltage": Field(32, 2, 160, 60, 160),
        "min_voltage": Field(34, 2, 60, 60, 160),
    }
)
_XM430, _X540 = _X | _current(1193), _X | _EXTERNAL_PORTS | _current(2047)
_XL330 = _delivered(_X, temperature_limit=70, velocity_i_gain=1600, velocity_p_gain=180, position_p_gain=400) | {
    "protocol": Field(13, 1, 2, 2, 22),
    "max_voltage": Field(32, 2, 70, 31, 70),
    "min_voltage": Field(34, 2, 35, 31, 70),
    "velocity_limit": Field(44, 4, 445, 0, 2047),
    "pwm_slope": Field(62, 1, 140, 1, 255),
    "shutdown": Field(63, 1, 0x35, 0, 0x3D),
} | _current(1750)  # fmt: skip

INDIRECT_BLOCKS = ((168, 224, 28), (578, 634, 28))
"""Blocks of indirect addresses: address of the first two-byte pointer, address of the first data byte, and number of
pointers."""
INDIRECT_XL330 = ((168, 208, 20),)
"""Block of indirect addresses of XL330 servos."""
MODELS = {
    name: ServoModel(
        **vars(SERVO_SHEETS[name]),
        ampere_per_unit=ampere_per_unit,
        fields=_delivered(fields, velocity_limit=velocity_limit),
        indirect=INDIRECT_XL330 if fields is _XL330 else INDIRECT_BLOCKS,
    )
    # Name, default velocity limit, registers, and unit of current [A].
    for name, velocity_limit, fields, ampere_per_unit in (
        ("MX-106", 210, _MX | _current(2047), 3.36e-3),
        ("MX-64", 435, _MX | _current(1941), 3.36e-3),
        ("MX-28", 230, _MX | _LOAD, 3.36e-3),
        ("XL330-M077", 1620, _XL330, 1e-3),
        ("XL330-M288", 445, _XL330, 1e-3),
        ("XL430-W250", 265, _XL430, 3.36e-3),
        ("XC430-W150", 460, _delivered(_XC430, moving_threshold=20, position_p_gain=460), 3.36e-3),
        ("XC430-W240", 306, _delivered(_XC430, position_p_gain=700), 3.36e-3),
        ("XM430-W210", 330, _XM430, 2.69e-3),
        ("XM430-W350", 200, _XM430, 2.69e-3),
        ("XM540-W150", 230, _X540, 2.69e-3),
        ("XM540-W270", 128, _X540, 2.69e-3),
        ("XH540-W150", 300, _X540, 2.69e-3),
        ("XH540-W270", 167, _X540, 2.69e-3),
    )
}
MX_106, MX_28 = MODELS["MX-106"], MODELS["MX-28"]
MODEL_BY_NUMBER = {model.number: model for model in MODELS.values()}

TABLE_SIZE = 662
STATE_BLOCK = (126, 10)
"""Address and length of the block read from every servo in each cycle: effort (2), velocity (4) and position (4)."""
RAW_BLOCK = (124, 12)
"""The same block with the PWM (2) before it, which is read in each cycle if the bus has time for it."""
PWM_PER_UNIT = 1 / 885
"""Unit of present, goal and maximum PWM, as a fraction of the supply voltage."""
HEALTH_BLOCK = (64, 83)
"""Address and length of the block that is read from the servos in turn: registers from torque enable to temperature."""
