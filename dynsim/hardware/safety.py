"""Sections of a servo map that concern all servos: serial line, supply, and abort limits.

The rules that apply these limits: :mod:`dynsim.hardware.replay.rules`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, Literal

from pydantic import Field, model_validator

from dynsim.config.base import Positive, StrictConfig, error_at
from dynsim.hardware.bus.control_table import BAUD_RATES
from dynsim.hardware.strict_yaml import Objection, Within, rounded_up

LONGEST_REACTION = 0.5
"""From the first cycle that shows a fault to the rule that declares it [s]."""
STOP_CYCLES = 3
"""A stop along the path takes as many cycles at least."""
ROUNDED = 1e-9
"""Part of a time by which a number of cycles may seem to exceed it."""

FaultPolicy = Literal["hold", "decelerate", "off"]

# 4.5 Mbit/s is the servos' but not the client library's.
_BAUD_CHOICES = [rate for rate in BAUD_RATES if rate <= 4_000_000]


class BusSettings(StrictConfig):
    """The serial line.

    Attributes
    ----------
    baud : int
        [bit/s].
    rate : float
        Goal and state cycles per second [Hz].
    latency : float
        What adapter and operating system may add to an answer [s].
    return_delay : float
        Longest return delay a servo may have stored [s].
    """

    baud: Annotated[int, Field(json_schema_extra={"enum": _BAUD_CHOICES})] = 3_000_000
    rate: Positive = 200.0
    latency: Annotated[
        Positive, Within(1e-4, 2.54, "s", "no adapter answers at once, and no watchdog waits longer")
    ] = 2e-3
    return_delay: Annotated[float, Field(ge=0, le=508e-6)] = 0.0

    @model_validator(mode="after")
    def _baud_is_one_of_the_servos(self) -> BusSettings:
        if self.baud not in _BAUD_CHOICES:
            raise error_at("baud", f"is not one of {', '.join(map(str, _BAUD_CHOICES))}")
        return self


class Supply(StrictConfig):
    """Voltage range in which the robot may move [V]."""

    lowest: Positive = 10.0
    highest: Positive = 14.8


class Safety(StrictConfig):
    """When to abort, and how to stop.

    Attributes
    ----------
    policy : "hold", "decelerate" or "off"
        What to do on a fault: freeze where the robot is; slow down along the path and hold; release torque.
    stop_time : float
        Time in which `decelerate` comes to rest [s].
    run_up : float
        Acceleration of the stretch added where a record begins or ends in motion [rad/s²].
    approach_velocity : float
        Top speed of the move to the start posture [rad/s].
    start_distance : float
        A joint further than this from the start posture is asked about once more [rad].
    watchdog : float
        Servos stop by themselves when the bus is silent for this long [s].
    missed_cycles, late_cycles, following_cycles, torque_cycles : int
        Consecutive cycles of one servo without a status, of late deadlines, of following error and of too much torque
        that abort.
    temperature_max : float
        [°C].
    at_end : "off" or "hold"
        Torque after a run that went well. A robot that falls when limp holds.
    """

    policy: FaultPolicy = "decelerate"
    stop_time: Annotated[float, Field(gt=0, le=3.0)] = 0.3
    run_up: Annotated[Positive, Within(0.01, 1e5, "rad/s²", "takes minutes, or is a knock")] = 2.0
    approach_velocity: Annotated[Positive, Within(1e-3, 1.0, "rad/s", "nobody has checked the way to the start")] = 0.3
    start_distance: Annotated[
        Positive, Within(1e-3, 2 * math.pi, "rad", "no joint would ever, or always, be asked about")
    ] = 0.5
    watchdog: Annotated[float, Field(ge=0.02, le=2.54)] = 0.2
    missed_cycles: Annotated[int, Field(ge=1, le=100)] = 3
    late_cycles: Annotated[int, Field(ge=1, le=1000)] = 5
    following_cycles: Annotated[int, Field(ge=1, le=100)] = 5
    torque_cycles: Annotated[int, Field(ge=1, le=100)] = 10
    temperature_max: Positive = 65.0
    supply: Supply = Supply()
    at_end: Literal["off", "hold"] = "off"


def objections_to_times(bus: BusSettings, safety: Safety) -> Iterable[Objection]:
    """Rules that would fire too late to matter at the rate of the map, and stops shorter than cycles."""
    if bus.latency >= safety.watchdog:
        yield "bus.latency", "is not below safety.watchdog: one lost answer would trip the watchdogs"
    for key in ("missed_cycles", "late_cycles", "following_cycles", "torque_cycles"):
        reaction = getattr(safety, key) / bus.rate
        if reaction > LONGEST_REACTION * (1 + ROUNDED):
            most = int(LONGEST_REACTION * bus.rate * (1 + ROUNDED))
            fix = f"use {most} or less" if most else "use a higher bus.rate"
            yield f"safety.{key}", f"takes {reaction:.3g} s at {bus.rate:g} Hz, reactions {LONGEST_REACTION:g} s; {fix}"
    if safety.missed_cycles / bus.rate >= safety.watchdog:
        yield (
            "safety.missed_cycles",
            f"takes {safety.missed_cycles / bus.rate:.3g} s at {bus.rate:g} Hz: the watchdogs would trip first, after "
            f"{safety.watchdog:g} s; use fewer, or a longer safety.watchdog",
        )
    if safety.stop_time < STOP_CYCLES / bus.rate:
        yield (
            "safety.stop_time",
            f"is less than {STOP_CYCLES} cycles of {bus.rate:g} Hz; use {rounded_up(STOP_CYCLES / bus.rate):g} or more",
        )
