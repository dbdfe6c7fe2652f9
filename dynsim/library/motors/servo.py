"""A position servo from its data sheet: voltage loop, limits of voltage, current and torque, friction of the gear."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import NonNegative, Positive, error_at
from dynsim.model.drives import Servo
from dynsim.model.motor_parameters import DriveParameters, limit


class Config(DriveParameters):
    """Everything at the output shaft: K_m = U / ω_0 and R = U K_m / τ_stall at ``voltage_V``, which limits the voltage.

    The gains are the servo's own; those of the controller are for DC motors.
    """

    type: Literal["servo"]
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
        description="below it the Coulomb friction fades; default: it holds at rest in time stepping, else 0.01",
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

    @model_validator(mode="after")
    def _check_gains(self) -> Self:
        gains = {"position": ("k_p_V_per_rad", "k_d_V_s_per_rad"), "velocity": ("k_v_V_s_per_rad",)}
        own = gains.pop(self.mode)
        if getattr(self, own[0]) == 0.0:
            raise error_at(own[0], f"must be positive in mode {self.mode}")
        for foreign in sum(gains.values(), ()):
            if getattr(self, foreign) != 0.0:
                raise error_at(foreign, f"has no effect in mode {self.mode}")
        return self


def build(config: Config, context: BuildContext) -> Servo:
    """The servo on ``context.joint``."""
    torque_constant = config.voltage_V / config.no_load_speed_rad_per_s
    return Servo(
        joint=context.joint,
        torque_constant=torque_constant,
        resistance=config.voltage_V * torque_constant / config.stall_torque_N_m,
        k_p=config.k_p_V_per_rad,
        k_d=config.k_d_V_s_per_rad,
        k_v=config.k_v_V_s_per_rad,
        velocity_mode=config.mode == "velocity",
        armature=config.rotor_inertia_kg_m2,
        reflected_damping=config.gear_damping_N_m_s_per_rad,
        coulomb_friction=config.coulomb_friction_N_m,
        coulomb_speed=config.coulomb_speed_rad_per_s,
        voltage_limit=config.voltage_V,
        current_limit=limit(config.current_limit_A),
        torque_limit=limit(config.torque_limit_N_m),
        mass=config.mass_kg,
        mass_point=config.mass_point,
        nominal_current=limit(config.nominal_current_A),
        nominal_torque=config.nominal_torque,
    )
