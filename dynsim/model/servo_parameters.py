"""Data-sheet parameters of a servo in position or velocity mode, all at the output shaft."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from dynsim.config.base import NonNegative, Positive, error_at
from dynsim.model.drives import Servo
from dynsim.model.motor_parameters import DriveParameters, limit

# Gains that each mode uses; the first must be positive.
GAINS = {"position": ("k_p_V_per_rad", "k_d_V_s_per_rad"), "velocity": ("k_v_V_s_per_rad",)}


class ServoParameters(DriveParameters):
    """Everything at the output shaft: K_m = U / ω_0 and R = U K_m / τ_stall at ``voltage_V``, which limits the voltage.

    The gains are the servo's own; those of the controller are for DC motors.
    """

    voltage_V: Positive = Field(description="supply, at which stall torque and no-load speed hold")
    stall_torque_N_m: Positive
    no_load_speed_rad_per_s: Positive
    mode: Literal["position", "velocity"] = Field(
        default="position", description="what of the reference the servo follows"
    )
    k_p_V_per_rad: NonNegative = Field(default=0.0, description="position mode")
    k_d_V_s_per_rad: NonNegative = Field(default=0.0, description="position mode")
    k_v_V_s_per_rad: NonNegative = Field(default=0.0, description="velocity mode")
    rotor_inertia_kg_m2: NonNegative = Field(default=0.0, description="of rotor and gear, at the output shaft")
    gear_damping_N_m_s_per_rad: NonNegative = Field(default=0.0, description="at the output shaft")
    coulomb_friction_N_m: NonNegative = Field(default=0.0, description="of the gear, at the output shaft")
    coulomb_speed_rad_per_s: Positive | None = Field(
        default=None,
        description="below it the Coulomb friction fades; default: 0.01, under the unilateral law it holds at rest",
    )
    current_limit_A: Positive | None = None
    torque_limit_N_m: Positive | None = Field(default=None, description="of the current, without the gear's friction")
    nominal_current_A: Positive | None = Field(
        default=None, description="that it stands for ever: a run that needs more warns"
    )

    @model_validator(mode="after")
    def _check_currents(self) -> Self:
        if limit(self.current_limit_A) < (self.nominal_current_A or 0.0):
            raise error_at("nominal_current_A", f"is more than current_limit_A = {self.current_limit_A:g}")
        return self

    @model_validator(mode="before")
    @classmethod
    def _gains_of_the_mode(cls, data: Any) -> Any:
        """Set the default gains of the other mode to 0: the user did not write them, and they have no effect."""
        if not isinstance(data, Mapping):
            return data
        mode = data.get("mode", cls.model_fields["mode"].default)
        others = [key for name, keys in GAINS.items() if name != mode for key in keys]
        return {**{key: 0.0 for key in others if cls.model_fields[key].default}, **data} if mode in GAINS else data

    @model_validator(mode="after")
    def _check_gains(self) -> Self:
        own = GAINS[self.mode][0]
        if getattr(self, own) == 0.0:
            raise error_at(own, f"must be positive in mode {self.mode}")
        for name, keys in GAINS.items():
            for key in keys:
                if name != self.mode and getattr(self, key) != 0.0:
                    raise error_at(key, f"has no effect in mode {self.mode}")
        return self

    def servo(self, joint: str) -> Servo:
        """The servo on the joint of that name."""
        torque_constant = self.voltage_V / self.no_load_speed_rad_per_s
        return Servo(
            joint=joint,
            torque_constant=torque_constant,
            resistance=self.voltage_V * torque_constant / self.stall_torque_N_m,
            k_p=self.k_p_V_per_rad,
            k_d=self.k_d_V_s_per_rad,
            k_v=self.k_v_V_s_per_rad,
            velocity_mode=self.mode == "velocity",
            armature=self.rotor_inertia_kg_m2,
            reflected_damping=self.gear_damping_N_m_s_per_rad,
            coulomb_friction=self.coulomb_friction_N_m,
            coulomb_speed=self.coulomb_speed_rad_per_s,
            voltage_limit=self.voltage_V,
            current_limit=limit(self.current_limit_A),
            torque_limit=limit(self.torque_limit_N_m),
            mass=self.mass_kg,
            mass_point=self.mass_point,
            nominal_current=limit(self.nominal_current_A),
            nominal_torque=self.nominal_torque,
        )
