"""Fault scripts of virtual servos: kind, servo, time and probability of each fault; reproducible by seed."""

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
    """Active from ``at`` [s after the first torque enable] for ``duration`` [s]; absent: always, for good."""

    at: Annotated[float, Field(ge=0)] | None = None
    duration: Annotated[float, Field(gt=0)] | None = None

    def active(self, since_torque: float) -> bool:
        """True at ``since_torque`` [s] after the first torque enable (−∞ before it)."""
        start, end = self.span
        return start <= since_torque < end

    @property
    def span(self) -> tuple[float, float]:
        """When it begins and ends [s after the first torque enable]; −∞ and ∞ for one that is always there."""
        if self.at is None:
            return -math.inf, math.inf
        return self.at, self.at + (self.duration or math.inf)


class LineFault(_Timed):
    """Trouble with status packets, of one servo or (no ``id``) of all."""

    kind: Literal["lost_status", "truncated_status", "bad_crc", "noise"]
    id: int | None = None
    probability: Probability = 1.0


class LateStatus(_Timed):
    """Status packets come later by ``delay`` [s]: by n periods, and cycle k + n gets the answer of cycle k."""

    kind: Literal["late_status"]
    id: int | None = None
    delay: Annotated[float, Field(gt=0)]
    probability: Probability = 1.0


class PortFault(_Timed):
    """The adapter echoes what is sent, or is pulled out."""

    kind: Literal["echo", "unplug"]


class ServoFault(_Timed):
    """A second servo with the same ID; power or cable lost; a restart; an error shutdown; a tripped watchdog; a jam."""

    kind: Literal["duplicate_id", "drop_off", "reboot", "overload", "overheat", "watchdog_trip", "stuck"]
    id: int


class WrongRegister(_Timed):
    """A servo that is not the one of the map: ``value`` stands in its register."""

    kind: Literal["wrong_model", "wrong_firmware", "wrong_mode"]
    id: int
    value: Annotated[int, Field(ge=0)]


class AngleFault(_Timed):
    """Play of the shaft, or a jump of the measured position, of ``angle`` [rad]."""

    kind: Literal["backlash", "offset_jump"]
    id: int
    angle: float


class VoltageSag(_Timed):
    """The supply drops by ``drop`` [V]."""

    kind: Literal["voltage_sag"]
    drop: Annotated[float, Field(gt=0)]


class SupplyLoss(_Timed):
    """No volts for ``duration`` [s]: every servo is limp and silent, then starts anew with what its EEPROM holds."""

    kind: Literal["supply_loss"]
    at: Annotated[float, Field(ge=0)]
    duration: Annotated[float, Field(gt=0)] = 0.3


class TemperatureRamp(_Timed):
    """A servo warms by ``heating_rate`` [K/s] on top of its own losses."""

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
        Of every random choice the faults make.
    faults : list
    """

    seed: int = 0
    faults: list[Fault] = Field(default_factory=list)

    @model_validator(mode="after")
    def _servos_are_there(self, info: ValidationInfo) -> FaultScript:
        """Validated with the context ``{"ids": ...}`` a fault of a servo that is not among them is an error."""
        ids = info.context["ids"] if info.context else None
        for number, fault in enumerate(self.faults):
            id_ = getattr(fault, "id", None)
            if ids is not None and id_ is not None and id_ not in ids:
                there = ", ".join(map(str, sorted(ids)))
                raise error_at(f"faults.{number}.id", f"no servo has this ID; there are {there}")
        return self


def load_fault_script(path: str | Path, ids: Collection[int] | None = None) -> FaultScript:
    """Read a fault script for servos with these IDs, of which it may name no others (any if not given).

    Raises
    ------
    ServoMapError
        Missing file, bad YAML or bad entry, with file and line.
    """
    return read_yaml(Path(path), FaultScript, {"ids": ids})
