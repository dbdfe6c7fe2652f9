"""What no servo of a model can do, or protects itself from: limits of a map beyond that are mistakes."""

from __future__ import annotations

import math
from collections.abc import Iterable

from dynsim.hardware.bus.control_table import RAD_PER_TICK, RAD_S_PER_UNIT, VOLT_PER_UNIT, ServoModel

HIGHEST_SUPPLY = 14.8
"""Of the recommended range of the MX series [V]; speed and torque grow with the supply."""
RATED_SUPPLY = 12.0
FURTHEST_OFF = 1.0
"""Following error of a position servo beyond which the rule would watch nothing [rad]."""

ROOM = 20.0
"""Temperature of a room, and so of a servo that has not moved yet [°C]."""

Objection = tuple[str, str]
"""Dotted key of the map within the part that is looked at, and what is wrong with it."""


def rounded_up(value: float) -> float:
    """A short number to offer instead of one that was refused, not below ``value``: to 1e-4."""
    return math.ceil(value * 1e4) / 1e4


def highest_speed(model: ServoModel) -> float:
    """Speed without load at the highest recommended supply [rad/s]."""
    return model.no_load_speed * HIGHEST_SUPPLY / RATED_SUPPLY


def highest_torque(model: ServoModel) -> float:
    """Stall torque at the highest recommended supply [N·m]."""
    return model.stall_torque * HIGHEST_SUPPLY / RATED_SUPPLY


def objections_to_limits(
    model: ServoModel,
    gear: float,
    *,
    turns_to_angle: bool,
    position_deg: tuple[float, float] | None,
    velocity: float,
    torque: float,
    following_error: float,
) -> Iterable[Objection]:
    """What a joint of this model and gear cannot do, and rules that could never fire.

    Parameters
    ----------
    gear : float
        Servo turns per joint turn.
    turns_to_angle : bool
        The servo is in position mode; else in velocity mode.
    position_deg, velocity, torque, following_error :
        Of the map: [°], [rad/s], [N·m], [rad] (in velocity mode [rad/s]).
    """
    speed, stall = highest_speed(model) / gear, highest_torque(model) * gear
    if velocity > speed:
        yield "limits.velocity", f"a {model.name} turns this joint at {speed:.3g} rad/s at most"
    if torque > stall:
        yield "limits.torque", f"a {model.name} stalls at {stall:.3g} N m here: the rule would never fire"
    if torque < (least := model.torque(1) * gear):
        yield "limits.torque", f"is below what a {model.name} can tell from none; use {rounded_up(least):g} N m or more"
    unit, name = (RAD_PER_TICK, "rad") if turns_to_angle else (RAD_S_PER_UNIT, "rad/s")
    if following_error < unit / gear:
        yield "following_error", f"is below what the servo can tell; use {rounded_up(unit / gear):g} {name} or more"
    if not turns_to_angle and position_deg is not None:
        yield (
            "limits.position_deg",
            "a servo in velocity mode is not held to angles; leave it out, or use mode: position",
        )
    if turns_to_angle and position_deg is not None:
        span = position_deg[1] - position_deg[0]
        if span * gear > 360.0:
            yield "limits.position_deg", f"position mode knows one turn of the servo, {360 / gear:.4g}° of this joint"
        if following_error > FURTHEST_OFF:
            yield "following_error", f"is more than {FURTHEST_OFF:g} rad: the rule would watch nothing"
    elif following_error > velocity:
        yield "following_error", "is more than limits.velocity: a servo that stands still would not be noticed"


def objections_to_safety(
    models: Iterable[ServoModel], temperature: float, supply: tuple[float, float]
) -> Iterable[Objection]:
    """Thresholds at which the servos have long protected themselves, by going limp.

    Parameters
    ----------
    temperature : float
        [°C].
    supply : tuple of float
        Lowest and highest [V].
    """
    if supply[0] >= supply[1]:
        yield "supply.lowest", "is not below supply.highest"
    if temperature <= ROOM:
        yield "temperature_max", f"is no more than the {ROOM:g} °C of a room: every run would abort; use 65 or so"
    for model in models:
        hottest = model.fields["temperature_limit"].default
        low, high = model.fields["min_voltage"].low, model.fields["max_voltage"].high
        if temperature > hottest:
            yield "temperature_max", f"a {model.name} goes limp at {hottest} °C"
        if low is not None and supply[0] < low * VOLT_PER_UNIT:
            yield "supply.lowest", f"a {model.name} does not work below {low * VOLT_PER_UNIT:g} V"
        if high is not None and supply[1] > high * VOLT_PER_UNIT:
            yield "supply.highest", f"a {model.name} does not work above {high * VOLT_PER_UNIT:g} V"
