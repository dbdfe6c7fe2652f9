"""Keys common to all motors of a scenario, and those of a geared brushed DC motor ([WM] eqs 16–25)."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from dynsim.config.base import NonNegative, Positive, StrictConfig, Vector3, error_at
from dynsim.model.drives import Motor


def limit(value: float | None) -> float:
    """The value of an optional limit: infinite for none."""
    return np.inf if value is None else value


class DriveParameters(StrictConfig):
    """A motor of any kind: what it weighs, and what it stands for ever."""

    mass_kg: NonNegative = Field(
        default=0.0, description="of motor and gear, a point mass on the link before the joint"
    )
    mass_point_m: Vector3 | None = Field(
        default=None, description="where, in that link's frame; default: at the motor's joint"
    )

    nominal_torque_N_m: Positive | None = Field(
        default=None, description="that motor and gear stand for ever, at the joint; N at a prismatic joint"
    )

    @model_validator(mode="after")
    def _check_mass(self) -> Self:
        if self.mass_point_m is not None and self.mass_kg == 0.0:
            raise error_at("mass_point_m", "has no effect without mass_kg")
        return self

    @property
    def mass_point(self) -> NDArray[np.float64] | None:
        """Where its mass is, (3,) [m]; None: at the joint."""
        return None if self.mass_point_m is None else np.array(self.mass_point_m)

    @property
    def nominal_torque(self) -> float:
        """[N m or N], infinite where it is not known."""
        return limit(self.nominal_torque_N_m)


class MotorParameters(DriveParameters):
    """L di/dt = u − R i − K k v; joint torque K k i − I_m k² v̇ − d_m k² v."""

    torque_constant_N_m_per_A: Positive
    resistance_ohm: Positive
    inductance_H: Positive
    rotor_inertia_kg_m2: NonNegative
    gear_ratio: Positive = Field(description="motor turns per joint turn; at a prismatic joint rad of the motor per m")
    gear_damping_N_m_s_per_rad: NonNegative = Field(default=0.0, description="on the motor side")
    coulomb_friction_N_m: NonNegative = Field(
        default=0.0, description="of the gear, at the joint: holds at rest; N at a prismatic joint; unilateral law"
    )
    voltage_limit_V: Positive | None = None
    nominal_current_A: Positive | None = Field(
        default=None, description="that it stands for ever: a run that needs more warns"
    )
    peak_current_A: Positive | None = Field(default=None, description="limit of its driver")

    @model_validator(mode="after")
    def _check_currents(self) -> Self:
        if limit(self.peak_current_A) < (self.nominal_current_A or 0.0):
            raise error_at("peak_current_A", f"is less than nominal_current_A = {self.nominal_current_A:g}")
        return self

    @field_validator("inductance_H", mode="before")
    @classmethod
    def _not_zero(cls, value: Any) -> Any:
        """L = 0 is a circuit many know from textbooks: say what to take instead."""
        if value == 0:
            raise ValueError("must be positive; for none take 1e-6 with integrator.method: auto or radau5")
        return value

    def motor(self, joint: str) -> Motor:
        """The motor on the joint of that name."""
        return Motor(
            joint=joint,
            torque_constant=self.torque_constant_N_m_per_A,
            resistance=self.resistance_ohm,
            inductance=self.inductance_H,
            rotor_inertia=self.rotor_inertia_kg_m2,
            gear_ratio=self.gear_ratio,
            gear_damping=self.gear_damping_N_m_s_per_rad,
            dry_friction=self.coulomb_friction_N_m,
            voltage_limit=limit(self.voltage_limit_V),
            mass=self.mass_kg,
            mass_point=self.mass_point,
            current_limit=limit(self.peak_current_A),
            nominal_current=limit(self.nominal_current_A),
            nominal_torque=self.nominal_torque,
        )
