"""Fault scripts for virtual servos: kind, servo, time and probability of each fault; a seed makes them reproducible."""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, model_validator

from dynsim.config.base import StrictConfig, error_at
from dynsim.hardware.bus.control_table import MX_106
from dynsim.hardware.servo_map import read_yaml

Probability = Annotated[float, Field(ge=0, le=1)]


class _Timed(StrictConfig):
    """Fault that is active from ``at`` [s after the torque of any servo is first enabled] for ``duration`` [s].

    A fault without ``at`` is always active; a fault without ``duration`` does not end.
    """

    at: Annotated[float, Field(ge=0)] | None = None
    duration: Annotated[float, Field(gt=0)] | None = None

    def active(self, since_torque: float) -> bool:
        """Return True if the fault is active ``since_torque`` [s] after torque was first enabled (−∞ if never)."""
        start, end = self.span
        return start <= since_torque < end

    @property
    def span(self) -> tuple[float, float]:
        """Start and end of the fault [s after the first torque enable]; −∞ and ∞ if it is always active."""
        if self.at is None:
            return -math.inf, math.inf
        return self.at, self.at + (self.duration or math.inf)


class LineFault(_Timed):
    """Damage to the status packets of one servo, or of all servos if there is no ``id``."""

    kind: Literal["lost_status", "truncated_status", "bad_crc", "noise"]
    id: int | None = None
    probability: Probability = 1.0


class LateStatus(_Timed):
    """Delay of status packets by ``delay`` [s]; if this is n periods, cycle k + n receives the answer to cycle k."""

    kind: Literal["late_status"]
    id: int | None = None
    delay: Annotated[float, Field(gt=0)]
    probability: Probability = 1.0


class PortFault(_Timed):
    """Fault of the adapter: it echoes all bytes that are sent, or is unplugged."""

    kind: Literal["echo", "unplug"]


class ServoFault(_Timed):
    """Fault of one servo: duplicate ID, lost power or cable, restart, shutdown by an error, watchdog trip, or jam."""

    kind: Literal["duplicate_id", "drop_off", "reboot", "overload", "overheat", "watchdog_trip", "stuck"]
    id: int


class WrongRegister(_Timed):
    """Servo that does not match the map, because one of its registers contains ``value``."""

    kind: Literal["wrong_model", "wrong_firmware", "wrong_mode"]
    id: int
    value: Annotated[int, Field(ge=0)]

    @property
    def register(self) -> str:
        """Name of the register."""
        return {"wrong_model": "model_number", "wrong_firmware": "firmware", "wrong_mode": "operating_mode"}[self.kind]

    @model_validator(mode="after")
    def _fits(self) -> WrongRegister:
        """Reject a value that is too large for the register."""
        largest = 256 ** MX_106.fields[self.register].size - 1
        if self.value > largest:
            raise error_at("value", f"the register holds at most {largest}")
        return self


class AngleFault(_Timed):
    """Backlash of the shaft, or a jump of the measured position, by ``angle`` [rad]."""

    kind: Literal["backlash", "offset_jump"]
    id: int
    angle: float


class VoltageSag(_Timed):
    """Drop in the supply voltage by ``drop`` [V]."""

    kind: Literal["voltage_sag"]
    drop: Annotated[float, Field(gt=0)]


class SupplyLoss(_Timed):
    """Loss of the supply for ``duration`` [s]: no servo has torque or answers; later all restart from their EEPROM."""

    kind: Literal["supply_loss"]
    at: Annotated[float, Field(ge=0)]
    duration: Annotated[float, Field(gt=0)] = 0.3


class TemperatureRamp(_Timed):
    """Warming of a servo by ``heating_rate`` [K/s], in addition to the warming caused by its losses."""

    kind: Literal["temperature_ramp"]
    id: int
    heating_rate: Annotated[float, Field(gt=0)]


Fault = Annotated[
    LineFault
    | LateStatus
    | PortFault
    | ServoFault
    | WrongRegister
    | AngleFault
    | VoltageSag
    | SupplyLoss
    | TemperatureRamp,
    Field(discriminator="kind"),
]


class FaultScript(StrictConfig):
    """Faults to be injected in one run.

    Attributes
    ----------
    seed : int
        Seed for all random choices.
    faults : list
    """

    seed: int = 0
    faults: list[Fault] = Field(default_factory=list)

    @model_validator(mode="after")
    def _servos_are_there(self, info: ValidationInfo) -> FaultScript:
        """Reject faults of unknown servos if the known IDs are passed in the validation context as ``{"ids": ...}``."""
        ids = info.context["ids"] if info.context else None
        for number, fault in enumerate(self.faults):
            id_ = getattr(fault, "id", None)
            if ids is not None and id_ is not None and id_ not in ids:
                there = ", ".join(map(str, sorted(ids)))
                raise error_at(f"faults.{number}.id", f"unknown servo ID; IDs: {there}")
        return self


def load_fault_script(path: str | Path, ids: Collection[int] | None = None) -> FaultScript:
    """Read a fault script.

    Parameters
    ----------
    path : str or Path
    ids : collection of int, optional
        Allowed servo IDs; by default, all IDs are allowed.

    Raises
    ------
    ServoMapError
        If the file is missing, is not YAML or has an invalid entry; the message states the file and the line.
    """
    return read_yaml(Path(path), FaultScript, {"ids": ids})
