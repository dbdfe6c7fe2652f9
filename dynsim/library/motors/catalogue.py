"""Catalogue of motors: servos with the data sheets of Dynamixel models and of joints of industrial robots.

Sources are in :mod:`dynsim.config.data_sheets`. Gains, friction and inertias are assumed, unless they were fitted to a
robot. A joint of an industrial robot is a servo that delivers its maximum torque up to its maximum speed; for this, the
catalogue assumes twice the voltage that this speed requires.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import ModuleType
from typing import Any, Literal, cast

from pydantic import create_model

from dynsim.compile.protocols import BuildContext
from dynsim.config.base import NonNegative, Positive, default
from dynsim.config.data_sheets import GEAR_FRICTION, JOINT_SHEETS, SERVO_SHEETS, JointSheet, ServoSheet
from dynsim.model.drives import Servo, ServoParameters

STIFFNESS_VOLTS = 58.6 / 12.0
"""Gain in position mode per supply voltage [1/rad], as for the MX-106."""
RISE_TIME = 0.01 * 4.71 / 8.4
"""Time constant J ω_0/τ_stall of rotor and gear without load [s], as for the assumed inertia of a MX-106."""
NOMINAL = 0.2
"""Continuous torque as a fraction of the stall torque, estimated by ROBOTIS (robotis.us, Torque Ratings, 2020)."""
BUS_VOLTAGE = 48.0
"""Supply voltage of the joints of industrial robots [V] (assumed); it scales currents only."""
ARMATURE = 0.1
"""Inertia of rotor and gear at a joint of an industrial robot [kg m²] (assumed, as in mujoco_menagerie)."""

# Values of T2 Snake-3 that replace the assumed values of a servo: the joints were fitted to its measured sag, and the
# wheels run in velocity mode.
_SNAKE: dict[str, dict[str, Any]] = {
    "MX-106": {
        "k_p_V_per_rad": (NonNegative, 58.6, "gain: 41 N m/rad, fitted to the measured sag of T2 Snake-3"),
        "coulomb_friction_N_m": (NonNegative, 0.8, "gear friction, fitted to the measured sag of T2 Snake-3"),
        "rotor_inertia_kg_m2": (NonNegative, 0.01, "rotor inertia at the output shaft (assumed)"),
    },
    "MX-28": {
        "mode": (Literal["position", "velocity"], "velocity", "quantity that the servo controls"),
        "coulomb_friction_N_m": (NonNegative, 0.0, "gear friction; none, because the velocity loop compensates for it"),
        "rotor_inertia_kg_m2": (NonNegative, 2e-4, "rotor inertia at the output shaft (assumed)"),
    },
}


def _servo(sheet: ServoSheet) -> dict[str, Any]:
    """Return type, default and description of the keys of a Dynamixel servo."""
    stall, speed = sheet.stall_torque, round(sheet.no_load_speed, 2)
    inertia = float(f"{RISE_TIME * stall / speed:.2g}")
    return {
        "voltage_V": (Positive, sheet.rated_voltage, "supply voltage of the data sheet; also limits the voltage"),
        "stall_torque_N_m": (Positive, stall, f"stall torque (data sheet: {sheet.source})"),
        "no_load_speed_rad_per_s": (Positive, speed, f"no-load speed, {sheet.no_load_rpm:g} rpm (data sheet)"),
        "nominal_torque_N_m": (
            Positive | None,
            round(NOMINAL * stall, 4),
            "continuous torque: a fifth of the stall torque",
        ),
        "k_p_V_per_rad": (
            NonNegative,
            round(STIFFNESS_VOLTS * sheet.rated_voltage, 2),
            "gain in position mode (assumed)",
        ),
        "k_v_V_s_per_rad": (NonNegative, 20.0, "gain in velocity mode (assumed)"),
        "coulomb_friction_N_m": (NonNegative, round(GEAR_FRICTION * stall, 4), "gear friction (assumed)"),
        "rotor_inertia_kg_m2": (NonNegative, inertia, "rotor inertia at the output shaft (assumed)"),
    } | _SNAKE.get(sheet.name, {})


def _joint(sheet: JointSheet) -> dict[str, Any]:
    """Return type, default and description of the keys of a joint of an industrial robot."""
    volts = BUS_VOLTAGE / (2 * sheet.torque)
    return {
        "voltage_V": (Positive, BUS_VOLTAGE, "supply voltage (assumed)"),
        "stall_torque_N_m": (
            Positive,
            2 * sheet.torque,
            "twice the maximum torque (assumed); torque_limit_N_m limits it",
        ),
        "no_load_speed_rad_per_s": (Positive, round(2 * sheet.speed, 4), "twice the maximum speed (assumed)"),
        "torque_limit_N_m": (Positive | None, sheet.torque, f"maximum torque (data sheet: {sheet.source})"),
        "k_p_V_per_rad": (NonNegative, round(sheet.stiffness * volts, 3), f"{sheet.stiffness:g} N m/rad (assumed)"),
        "k_d_V_s_per_rad": (NonNegative, round(sheet.damping * volts, 3), f"{sheet.damping:g} N m s/rad (assumed)"),
        "rotor_inertia_kg_m2": (NonNegative, ARMATURE, "inertia of rotor and gear (assumed)"),
    }


def build(config: ServoParameters, context: BuildContext) -> Servo:
    """Return the servo of ``context.joint``."""
    name: str = config.type  # type: ignore[attr-defined]
    return replace(config.servo(context.joint), sheet=_SERVOS[name].name if name in _SERVOS else name)


_SERVOS = {sheet.motor_type: sheet for sheet in SERVO_SHEETS.values()}
NAMES = (*_SERVOS, *JOINT_SHEETS)
"""Types of motor in this catalogue."""


@cache
def member(name: str) -> ModuleType:
    """Return the member of the family for one of the ``NAMES``; its ``Config`` is an attribute of this module, too."""
    if name in _SERVOS:
        keys, title = (
            _servo(_SERVOS[name]),
            f"ROBOTIS Dynamixel {_SERVOS[name].name} with its rated values.",
        )
    else:
        keys, title = _joint(JOINT_SHEETS[name]), f"Joint of an industrial robot: {JOINT_SHEETS[name].joints}."
    fields = {key: (kind, default(value, text)) for key, (kind, value, text) in keys.items()}
    model = cast(Any, create_model)(
        name, __base__=ServoParameters, __module__=__name__, __doc__=title, type=(Literal[name], ...), **fields
    )
    module = ModuleType(f"{__name__}.{name}", title)
    vars(module).update(Config=model, build=build)
    return module


def __getattr__(name: str) -> Any:
    """Return the ``Config`` of a member, which is created when it is used for the first time."""
    if name in NAMES:
        return member(name).Config
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
