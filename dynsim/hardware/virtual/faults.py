"""Fault scripts of virtual servos: kind, servo, time and probability of each fault, reproducible by a seed."""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, model_validator

from dynsim.config.base import StrictConfig, error_at
from dynsim.hardware.servo_map import read_yaml

Probability = Annotated[float, Field(ge=0, le=1)]


class _Timed(StrictConfig):
    """Fault that is active from ``at`` [s after the first torque enable] for ``duration`` [s].

    Without ``at`` it is always active; without ``duration`` it does not end.
    """

    at: Annotated[float, Field(ge=0)] | None = None
    duration: Annotated[float, Field(gt=0)] | None = None

    def active(self, since_torque: float) -> bool:
        """Return True if the fault is active ``since_torque`` [s] after the first torque enable (−∞ before it)."""
        start, end = self.span
        return start <= since_torque < end

    @property
    def span(self) -> tuple[float, float]:
        """Start and end of the fault [s after the first torque enable]; −∞ and ∞ if it is always active."""
        if self.at is None:
            return -math.inf, math.inf
        return self.at, self.at + (self.duration or math.inf)


class LineFault(_Timed):
    """Damage to the status packets of one servo, or of all servos without ``id``."""

    kind: Literal["lost_status", "truncated_status", "bad_crc", "noise"]
    id: int | None = None
    probability: Probability = 1.0


class LateStatus(_Timed):
    """Status packets that are delayed by ``delay`` [s]; with n periods, cycle k + n receives the answer of cycle k."""

    kind: Literal["late_status"]
    id: int | None = None
    delay: Annotated[float, Field(gt=0)]
    probability: Probability = 1.0


class PortFault(_Timed):
    """An adapter that echoes all sent bytes, or is unplugged."""

    kind: Literal["echo", "unplug"]


class ServoFault(_Timed):
    """Duplicate ID, loss of power or cable, restart, shutdown after an error, tripped watchdog, or jam of a servo."""

    kind: Literal["duplicate_id", "drop_off", "reboot", "overload", "overheat", "watchdog_trip", "stuck"]
    id: int


class WrongRegister(_Timed):
    """A servo that does not match the map: its register contains ``value``."""

    kind: Literal["wrong_model", "wrong_firmware", "wrong_mode"]
    id: int
    value: Annotated[int, Field(ge=0)]

    @model_validator(mode="after")
    def _fits(self) -> WrongRegister:
        """Reject a value that is too large for the register."""
        largest = 2**16 - 1 if self.kind == "wrong_model" else 2**8 - 1
        if self.value > largest:
            raise error_at("value", f"the register holds at most {largest}")
        return self


class AngleFault(_Timed):
    """Backlash of the shaft, or a jump of the measured position, by ``angle`` [rad]."""

    kind: Literal["backlash", "offset_jump"]
    id: int
    angle: float


class VoltageSag(_Timed):
    """A drop of the supply voltage by ``drop`` [V]."""

    kind: Literal["voltage_sag"]
    drop: Annotated[float, Field(gt=0)]


class SupplyLoss(_Timed):
    """Loss of supply for ``duration`` [s]: all servos lose torque and do not answer, then restart from their EEPROM."""

    kind: Literal["supply_loss"]
    at: Annotated[float, Field(ge=0)]
    duration: Annotated[float, Field(gt=0)] = 0.3


class TemperatureRamp(_Timed):
    """A servo that warms by ``heating_rate`` [K/s] in addition to its losses."""

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
    """Faults of one run.

    Attributes
    ----------
    seed : int
        Seed of all random choices.
    faults : list
    """

    seed: int = 0
    faults: list[Fault] = Field(default_factory=list)

    @model_validator(mode="after")
    def _servos_are_there(self, info: ValidationInfo) -> FaultScript:
        """Reject faults of unknown servos, if the IDs are in the validation context ``{"ids": ...}``."""
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
        Allowed servo IDs; default: any.

    Raises
    ------
    ServoMapError
        If the file is missing, is not YAML or has an invalid entry; the message has file and line.
    """
    return read_yaml(Path(path), FaultScript, {"ids": ids})
